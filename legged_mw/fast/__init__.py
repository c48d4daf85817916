"""Faster training: the step compiler, skipped physics kernels, kernels of the update. All works without them."""
