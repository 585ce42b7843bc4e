"""Policy networks and the files that hold them."""
