"""The published claims, tested again: uses the tool, is not part of the wheel."""
