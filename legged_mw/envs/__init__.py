"""Environments: the MDP in torch. It uses the simulator only through the interface in sim/."""
