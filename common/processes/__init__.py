"""This process and those that it starts: signals, workers, memory."""
