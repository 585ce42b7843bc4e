"""The emulated robot: servos, buses and protocols with the faults of real ones."""
