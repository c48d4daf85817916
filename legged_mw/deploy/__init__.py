"""Run an exported policy in another simulator or on a robot.

Needs numpy, mujoco, onnxruntime and pyyaml; neither torch nor warp.
"""
