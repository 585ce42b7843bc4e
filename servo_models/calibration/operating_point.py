"""Operating point of a calibration: the P gain, the armature and the load that its numbers are for.

Stiffness is in proportion to the P gain of the servo's position loop, and an armature is that of
motor and gears alone or holds what the joint moved, too. Two sets of numbers can be compared only
where both are known, so every file that is written from a calibration states them.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pupper_sysid.servo_models.calibration.quantity import Number, Part

Armature = Literal["servo", "servo and load"]
"""What an armature includes: motor and gears alone, or also the inertia of what the joint moved."""

ARMATURES: dict[Armature, str] = {
    "servo": "motor and gears, without link and load",
    "servo and load": "motor and gears with the link and load that the joint moved",
}
"""The definitions of an armature in words."""

NOT_STATED = "not stated"


class OperatingPoint(Part):
    """What the numbers of an actuator hold for."""

    p_gain: Annotated[Number, Field(gt=0)] | None = None
    """P gain of the position loop that the stiffness is for, the register's value; null where it is
    not known."""
    p_gain_source: str = NOT_STATED
    """Where that gain comes from, in words."""
    armature: Armature
    """What `armature_kg_m2` includes."""
    load: str = NOT_STATED
    """What the joint carried in the recordings, in words."""

    @property
    def gain_text(self) -> str:
        """The P gain in words.

        Examples
        --------
        >>> OperatingPoint(armature="servo").gain_text
        'P gain not stated'
        >>> OperatingPoint(p_gain=32.0, p_gain_source="of all runs", armature="servo").gain_text
        'P gain 32 (of all runs)'
        """
        if self.p_gain is None:
            return f"P gain {NOT_STATED}"
        source = "" if self.p_gain_source == NOT_STATED else f" ({self.p_gain_source})"
        return f"P gain {self.p_gain:g}{source}"

    def __str__(self) -> str:
        return f"{self.gain_text}; armature: {ARMATURES[self.armature]}; load: {self.load}"

    def at_p_gain(self, p_gain: float) -> OperatingPoint:
        """The same at another P gain."""
        if p_gain == self.p_gain:
            return self
        source = "predicted"
        if self.p_gain is not None:
            source = f"predicted from {self.p_gain:g}"
        return self.model_copy(update={"p_gain": float(p_gain), "p_gain_source": source})
