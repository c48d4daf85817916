"""Looking at a robot: video files and windows. Numbers come in as numpy arrays; nothing here steps a simulation."""
