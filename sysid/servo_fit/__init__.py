"""Servo models fitted to recordings, scored on unseen data."""
