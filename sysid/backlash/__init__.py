"""Hysteresis, dead zone and backlash of a servo from slow strokes."""
