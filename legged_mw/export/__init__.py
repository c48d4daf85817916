"""Export a run as network, contract and scene, after a comparison with the training. rl imports nothing from it."""
