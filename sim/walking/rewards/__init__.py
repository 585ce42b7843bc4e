"""Rewards of the walking task: weights, terms, and what they know of the last strides."""
