"""Feetech servos on a serial line: frames, registers, and the bus made of them."""
