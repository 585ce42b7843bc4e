"""Emulated servos: in free air, with a pendulum, on a bench, or as the joints of a robot."""
