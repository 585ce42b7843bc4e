"""A robot and a bus that behave like the measured ones."""

from sim.emulated_bus import EmulatedBus
from sim.emulated_robot import EmulatedRobot, EmulatedServo, RobotSpec, draw_robot, random_spec

__all__ = [
    "EmulatedBus",
    "EmulatedRobot",
    "EmulatedServo",
    "RobotSpec",
    "draw_robot",
    "random_spec",
]
