"""Subcommands of `pupper-analyze`."""
