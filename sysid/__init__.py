"""From recordings to calibrations."""
