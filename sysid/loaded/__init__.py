"""Identify servos under load: position loop, motor, friction and gravity, in N·m."""
