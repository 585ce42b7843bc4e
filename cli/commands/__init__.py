"""Subcommands of the programs; those that are read together share a module."""
