"""Watching and driving robots: a stage that moves, viewers that show it, a pilot. numpy, mujoco and yaml; torch in env_stage.py alone."""
