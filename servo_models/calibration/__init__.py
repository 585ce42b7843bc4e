"""The calibration file: measured actuators and feedback of a robot's servos."""
