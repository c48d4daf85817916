"""The simulator seam: takes numbers and names, hands out torch tensors; does not know what they are for."""
