"""What to record next: optimal design of a sweep, its plan file, recording until narrow enough."""
