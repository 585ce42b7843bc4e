"""When was each reading measured? Poll lattice and its search."""
