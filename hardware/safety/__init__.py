"""Limits, monitoring and emergency stop between a program and its servos."""
