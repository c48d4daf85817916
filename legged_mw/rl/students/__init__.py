"""Learners beside plain PPO: estimators, concurrent students, distillation, recurrent networks. PPO does not import them."""
