"""Evaluation and analysis of trained policies."""
