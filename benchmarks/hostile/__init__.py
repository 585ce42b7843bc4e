"""Hostile files, options and outputs for `benchmarks/file_campaign.py`."""
