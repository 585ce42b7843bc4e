"""Candidate servo models of calibration, and their compiled simulation."""
