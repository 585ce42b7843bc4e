"""A recording's commands on the whole simulated robot, held against the robot's own readings."""
