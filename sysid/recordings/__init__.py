"""Recordings: the file format, its validation, and other layouts."""
