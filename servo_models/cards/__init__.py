"""Servo cards: numbers of one servo type without a robot, with their source and licence."""
