"""A recording's commands on the whole simulated robot, compared with the robot's readings."""
