"""Calibrations for other simulators, one module per target."""
