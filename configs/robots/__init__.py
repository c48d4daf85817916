"""Robots, one a file: the config that all tasks of a robot share. A task's bases are a robot, then a skill."""
