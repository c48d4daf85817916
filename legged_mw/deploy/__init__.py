"""An exported policy on another physics, or on a robot. Needs numpy, mujoco, onnxruntime and pyyaml; neither torch nor warp."""
