"""Watch and drive robots: a stage simulates, a viewer shows it, a pilot holds the user's input.

Needs numpy, mujoco and yaml. Only playing.py imports torch.
"""
