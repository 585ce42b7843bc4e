"""Lag budget, tones and frequency response."""
