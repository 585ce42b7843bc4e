"""The robot as a MuJoCo model, its ground and its reference trot."""
