"""Estimators, concurrent students, distillation, recurrent networks. PPO does not import them."""
