"""Dynamixel servos (protocol 2.0) on a serial line: frames, registers, and the bus made of them."""
