"""Servo models: predict servo position from commanded position."""
