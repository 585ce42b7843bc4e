"""The calibration file: what was measured of a robot's servos."""
