"""The simulator seam: takes numbers and names, hands out torch tensors; knows no reward, command or config."""
