"""Sparse equations of motion: a servo model read off the data, with a term only where it earns it."""
