"""Exports a run as network, contract and scene, which are compared with the training first. rl imports none of it."""
