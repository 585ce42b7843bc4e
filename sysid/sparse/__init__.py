"""Sparse equations of motion (SINDy): a term is kept only where it earns its place."""
