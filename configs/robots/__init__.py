"""Robots, one a file: what any task of the robot shares. A task names a robot first and what it does second."""
