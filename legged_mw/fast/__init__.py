"""Speed alone: the step compiler, skipped physics kernels, the update's kernels. Without this folder all works, slower."""
