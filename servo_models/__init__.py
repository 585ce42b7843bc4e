"""Say where a servo will be, given what it was told, and what its encoder will report."""

from servo_models.delayed_pd import DelayedPD, DelayedPDParameters
from servo_models.held_feedback import HeldFeedback
from servo_models.interface import ServoModel

__all__ = ["DelayedPD", "DelayedPDParameters", "HeldFeedback", "ServoModel"]
