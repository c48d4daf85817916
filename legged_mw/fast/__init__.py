"""Speed only: the step compiler, skipped physics kernels, kernels of the update. All works without this folder."""
