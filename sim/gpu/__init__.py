"""The robots on another engine: mujoco-warp, on a CUDA device."""
