"""Evaluation of policies: tables of walks, falls, and a page about them."""
