"""Environments: the MDP in torch, on top of the simulator seam."""
