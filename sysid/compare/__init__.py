"""Compare models with recordings, and calibrations with the truth of an emulated robot."""
