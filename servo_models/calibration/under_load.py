"""Block `under_load` of a calibration: the servo at any P gain and load."""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated

from pydantic import AfterValidator, Field

from pupper_sysid.servo_models.calibration.quantity import (
    OFFSET,
    SHARE,
    SMALL_ANGLE,
    TORQUE,
    NotNegative,
    Number,
    Part,
    PlausibleRange,
    Quantity,
)
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters


class RecordedLoad(Part):
    """A load that a servo was recorded with."""

    inertia_kg_m2: NotNegative
    """About the joint [kg·m²]."""
    gravity_nm: NotNegative
    """Largest torque of gravity [N·m]."""


class UnderLoad(Part):
    """Position loop, motor and friction of a servo recorded under load or at several P gains.

    See `servo_models.loaded_servo` for the equations; a term that is null was not needed.
    """

    structure: str
    """Terms of the model that were fitted, in words."""
    known_load: bool
    """Whether the load is known; otherwise all torques take their scale from the anchor."""
    p_gain: Annotated[Number, Field(gt=0)]
    """P gain that the stiffness of `actuator` is for, the register's value."""
    p_gains_tested: Annotated[tuple[Number, ...], Field(strict=False)]
    """P gains of the recordings."""
    loads_tested: Annotated[tuple[RecordedLoad, ...], Field(strict=False)] = ()
    """Loads of the recordings."""
    reference_voltage_v: Annotated[Number, Field(gt=0)] | None = None
    """Supply voltage that the stall torque is for; null where it is not scaled with the voltage."""
    duty_per_rad: Annotated[Quantity, SHARE]
    """Duty per position error and unit of the P gain [1/rad]."""
    duty_s_per_rad: Annotated[Quantity | None, SHARE] = None
    """Duty per velocity, inside of the limit on the duty [s/rad]."""
    stall_torque_nm: Annotated[Quantity, AfterValidator(PlausibleRange(0, 1000, "N·mm", 1e-3))]
    """Torque at full duty and standstill [N·m]."""
    back_emf_nm_s_per_rad: Annotated[Quantity, AfterValidator(PlausibleRange(0, 1e4))]
    """Torque lost per velocity [N·m·s/rad]."""
    armature_kg_m2: Annotated[Quantity, AfterValidator(PlausibleRange(1e-12, 10, "g·cm²", 1e-7))]
    """Reflected inertia of motor and gears, with the load's where that is unknown [kg·m²]."""
    friction_loss_nm: Annotated[Quantity, TORQUE]
    """Dry friction at speed without load [N·m]."""
    stribeck_friction_nm: Annotated[Quantity | None, TORQUE] = None
    """Dry friction at standstill beyond that [N·m]."""
    stribeck_speed_rad_s: Annotated[Quantity | None, SHARE] = None
    """Speed at which half of what standstill adds to the friction is left [rad/s]."""
    load_friction_motor: Annotated[Quantity | None, SHARE] = None
    """Dry friction per torque of the motor."""
    load_friction_load: Annotated[Quantity | None, SHARE] = None
    """Dry friction per torque of the load's weight."""
    load_friction_quadratic_per_nm: Annotated[
        Quantity | None, AfterValidator(PlausibleRange(0, 1e6))
    ] = None
    """Dry friction per squared torque of the motor [1/(N·m)]."""
    load_friction_static: Annotated[Quantity | None, SHARE] = None
    """By what share friction per torque is larger at standstill."""
    torque_limit_nm: Annotated[Quantity | None, TORQUE] = None
    """Largest torque of the motor, a limit on its current [N·m]."""
    off_brake: Annotated[Quantity | None, SHARE] = None
    """Share of the back-EMF that remains with the torque off; null if it never was."""
    dead_zone_rad: Annotated[Quantity | None, SMALL_ANGLE] = None
    """Error that the position loop ignores [rad]."""
    start_duty: Annotated[Quantity | None, SHARE] = None
    """Duty added wherever there is an error."""
    acceleration_limit_rad_s2: Annotated[
        Quantity | None, AfterValidator(PlausibleRange(0, 1e6))
    ] = None
    """Largest acceleration of the set-point [rad/s²]; null where it follows commands at once."""
    gravity_nm: Annotated[Quantity | None, TORQUE] = None
    """Largest torque of gravity of an unknown load [N·m]; null where the load was known."""
    hanging_rad: Annotated[Quantity | None, OFFSET] = None
    """Position at which the load hangs [rad], less that of the recording's header."""

    def servo(self, dead_time_s: float) -> LoadedServoParameters:
        """The numbers themselves, without intervals."""
        own = {
            name: value.value
            for name, key in LOADED_KEYS.items()
            if (value := getattr(self, key)) is not None
        }
        return LoadedServoParameters(**{"duty_s_per_rad": 0.0, **own}, dead_time_s=dead_time_s)

    def how_far_tested(self, p_gain: float) -> str:
        """What the recordings say of a P gain, in a sentence.

        Examples
        --------
        >>> part = UnderLoad.model_construct(p_gains_tested=(8.0, 16.0, 32.0))
        >>> part.how_far_tested(16), part.how_far_tested(20)
        ('P 16 was recorded.', 'P 20 lies between recorded gains, 16 and 32.')
        >>> part.how_far_tested(64)
        'P 64 was not tested: it is 2 times the nearest recorded gain, 32.'
        """
        known = sorted(self.p_gains_tested)
        if p_gain in known:
            return f"P {p_gain:g} was recorded."
        below, above = [g for g in known if g < p_gain], [g for g in known if g > p_gain]
        if below and above:
            return f"P {p_gain:g} lies between recorded gains, {below[-1]:g} and {above[0]:g}."
        near = below[-1] if below else above[0]
        return (
            f"P {p_gain:g} was not tested: it is {p_gain / near:.2g} times the nearest recorded "
            f"gain, {near:g}."
        )


_ENDINGS = ("", "_nm", "_nm_s_per_rad", "_kg_m2", "_rad_s", "_rad_s2", "_per_nm")
LOADED_KEYS = {
    name: next(name + end for end in _ENDINGS if name + end in UnderLoad.model_fields)
    for name in (f.name for f in fields(LoadedServoParameters) if f.name != "dead_time_s")
}
"""Fields of `LoadedServoParameters` and their names in `UnderLoad`."""
