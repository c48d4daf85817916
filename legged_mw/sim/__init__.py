"""The interface to the simulator. It has numbers, names and torch tensors, and no knowledge of tasks."""
