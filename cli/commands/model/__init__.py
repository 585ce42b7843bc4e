"""Commands that fit and compare servo models."""
