"""Fleets: a calibration or a servo model for each of many robots, side by side."""
