"""A robot and a bus that behave like the measured ones."""
