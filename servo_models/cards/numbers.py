"""Numbers of a servo card: a position loop in duty with a DC motor, or a PD servo in torque.

A published servo model is one of two things. `PositionLoop` is what the servo is: the firmware
turns the position error into a duty cycle, the duty drives a DC motor, and gears rub::

    duty   = clip(error_gain * P * (set-point - position), ±duty_limit)
    torque = stall_torque * duty - (back_emf + viscous_friction) * velocity

P is the register's value; `stall_torque` holds at full duty and the card's supply voltage, and is
proportional to it. `TorquePD` is what a simulator's file states: `servo_models.delayed_pd`.

The first becomes the second for one P gain and one voltage (`PositionLoop.as_pd`)::

    stiffness    = error_gain * P * stall_torque
    effort limit = duty_limit * stall_torque
    back-EMF     = back_emf + viscous_friction        (acts outside of the effort limit)

Stribeck and load-dependent friction have no place in the second and are left out. A number is a
`Quantity`; one that was published without an interval may be written as the bare number.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer

from pupper_sysid.servo_models.calibration.parts import (
    NO_SPEED_LIMIT_RAD_S,
    Part,
    PlausibleRange,
    Quantity,
    unit_of,
)
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters

UNSTATED = "stated without an interval"
"""Why a bare number of a card is not identified."""

_UNITS = {
    "error_gain": "1/rad",
    "duty_limit": "1",
    "stribeck_exponent": "1",
    "load_friction_motor": "1",
    "load_friction_external": "1",
    "load_stribeck_motor": "1",
    "load_stribeck_external": "1",
    "load_quadratic_motor": "1/(N·m)",
    "load_quadratic_external": "1/(N·m)",
}


def unit(name: str) -> str:
    """Unit of the card's quantity `name`; empty if it has none.

    Examples
    --------
    >>> unit("error_gain"), unit("armature_kg_m2")
    ('1/rad', 'kg·m²')
    """
    return _UNITS.get(name) or unit_of(name)


def _bare(given: Any) -> Any:
    """A bare number as a quantity without interval."""
    if isinstance(given, bool) or not isinstance(given, int | float):
        return given
    return {"value": float(given), "identified": "no", "why": UNSTATED}


def _plainest(quantity: Quantity) -> Any:
    """A quantity as the file shows it: the bare number where there is no more to say."""
    bare = quantity.why == UNSTATED and quantity.low is None and quantity.high is None
    return quantity.value if bare else quantity.model_dump(mode="json")


def stated(value: float) -> Quantity:
    """A number that was published without an interval."""
    return Quantity.model_validate(_bare(value))


Cited = Annotated[Quantity, BeforeValidator(_bare), PlainSerializer(_plainest)]
"""A quantity that a file may state as the bare number."""

_TORQUE = AfterValidator(PlausibleRange(0, 100, "N·mm", 1e-3))
_DAMPING = AfterValidator(PlausibleRange(0, 1e4))
_STIFFNESS = AfterValidator(PlausibleRange(0, 1e5))
_ARMATURE = AfterValidator(PlausibleRange(1e-12, 10, "g·cm²", 1e-7))
_SPEED = AfterValidator(PlausibleRange(0, 1000, "degrees per second"))
_TIME = AfterValidator(PlausibleRange(0, 1, "milliseconds", 1e-3))
_SHARE = AfterValidator(PlausibleRange(0, 1, "percent", 1e-2))
_FACTOR = AfterValidator(PlausibleRange(0, 100))


def _or(quantity: Quantity | None, absent: float = 0.0) -> float:
    return absent if quantity is None else quantity.value


class TorquePD(Part):
    """PD servo in torque, as simulators' files state it; see `servo_models.delayed_pd`."""

    model: Literal["delayed_pd"]
    """Kind of these numbers."""
    stiffness_nm_per_rad: Annotated[Cited, _STIFFNESS]
    """Torque per position error [N·m/rad]."""
    damping_nm_s_per_rad: Annotated[Cited | None, _DAMPING] = None
    """Torque per velocity inside of the effort limit (MuJoCo's kv) [N·m·s/rad]."""
    friction_loss_nm: Annotated[Cited, _TORQUE]
    """Dry (Coulomb) friction [N·m]."""
    armature_kg_m2: Annotated[Cited, _ARMATURE]
    """Reflected inertia of motor and gears at the joint [kg·m²]."""
    effort_limit_nm: Annotated[Cited, _TORQUE]
    """Largest torque [N·m]."""
    velocity_limit_rad_s: Annotated[Cited | None, _SPEED] = None
    """Largest rate of the set-point [rad/s]; null where it is not limited."""
    back_emf_nm_s_per_rad: Annotated[Cited | None, _DAMPING] = None
    """Torque lost per velocity outside of the effort limit (MuJoCo's joint damping) [N·m·s/rad]."""
    dead_time_s: Annotated[Cited | None, _TIME] = None
    """From a command's arrival to its first effect [s]; null where the source has none."""

    @property
    def parameters(self) -> DelayedPDParameters:
        """The numbers as the servo model takes them; an unknown dead time is 0."""
        return DelayedPDParameters(
            stiffness=self.stiffness_nm_per_rad.value,
            damping=_or(self.damping_nm_s_per_rad),
            friction_loss=self.friction_loss_nm.value,
            armature=self.armature_kg_m2.value,
            effort_limit=self.effort_limit_nm.value,
            velocity_limit=_or(self.velocity_limit_rad_s, NO_SPEED_LIMIT_RAD_S),
            dead_time_s=_or(self.dead_time_s),
            back_emf=_or(self.back_emf_nm_s_per_rad),
        )

    @property
    def top_speed_rad_s(self) -> float | None:
        """Speed at which back-EMF and dry friction use up the largest torque [rad/s].

        The set-point's limit if that is lower; None where neither is known.
        """
        limits = [] if self.velocity_limit_rad_s is None else [self.velocity_limit_rad_s.value]
        brake = _or(self.back_emf_nm_s_per_rad)
        if brake > 0:
            left = max(self.effort_limit_nm.value - self.friction_loss_nm.value, 0.0)
            limits.append(left / brake)
        return min(limits, default=None)


class PositionLoop(Part):
    """Position loop in duty, DC motor and friction of the gears.

    The friction is that of Rhoban's "Better actuator models" (BAM), M1 to M6: its frictions beyond
    Coulomb's are null where a model has none.
    """

    model: Literal["position_loop"]
    """Kind of these numbers."""
    error_gain: Annotated[Cited, _FACTOR]
    """Duty per unit of the P register and radian of position error [1/rad]."""
    duty_limit: Annotated[Cited, _SHARE]
    """Largest duty, as a fraction of 1."""
    stall_torque_nm: Annotated[Cited, _TORQUE]
    """Torque at full duty and the card's supply voltage, at standstill [N·m]."""
    back_emf_nm_s_per_rad: Annotated[Cited, _DAMPING]
    """Torque lost per velocity by the motor's back-EMF [N·m·s/rad]."""
    armature_kg_m2: Annotated[Cited, _ARMATURE]
    """Reflected inertia of motor and gears at the joint [kg·m²]."""
    friction_loss_nm: Annotated[Cited, _TORQUE]
    """Dry (Coulomb) friction [N·m]."""
    viscous_friction_nm_s_per_rad: Annotated[Cited | None, _DAMPING] = None
    """Torque lost per velocity in the gears [N·m·s/rad]."""
    stribeck_friction_nm: Annotated[Cited | None, _TORQUE] = None
    """Dry friction that is added at standstill [N·m]."""
    stribeck_velocity_rad_s: Annotated[Cited | None, _SPEED] = None
    """Speed over which it fades [rad/s]."""
    stribeck_exponent: Annotated[Cited | None, _FACTOR] = None
    """Its decay is exp(-(speed / stribeck_velocity)^exponent)."""
    load_friction_motor: Annotated[Cited | None, _FACTOR] = None
    """Friction per torque of the motor."""
    load_friction_external: Annotated[Cited | None, _FACTOR] = None
    """Friction per torque of the load."""
    load_stribeck_motor: Annotated[Cited | None, _FACTOR] = None
    """Friction per torque of the motor that is added at standstill."""
    load_stribeck_external: Annotated[Cited | None, _FACTOR] = None
    """Friction per torque of the load that is added at standstill."""
    load_quadratic_motor: Annotated[Cited | None, _FACTOR] = None
    """Friction per squared torque of the motor that is added at standstill [1/(N·m)]."""
    load_quadratic_external: Annotated[Cited | None, _FACTOR] = None
    """Friction per squared torque of the load that is added at standstill [1/(N·m)]."""
    velocity_limit_rad_s: Annotated[Cited | None, _SPEED] = None
    """Largest rate of the set-point [rad/s]; null where it is not limited."""
    dead_time_s: Annotated[Cited | None, _TIME] = None
    """From a command's arrival to its first effect [s]; null where the source has none."""

    def as_pd(self, p_gain: float, voltage_share: float = 1.0) -> TorquePD:
        """The same servo as a PD in torque; see the module's text.

        Parameters
        ----------
        p_gain : float
            P gain, the register's value.
        voltage_share : float
            Supply voltage over that of the card.

        Returns
        -------
        TorquePD
            A number that is a product of several has no interval.
        """
        stall = self.stall_torque_nm.value * voltage_share
        velocity = self.back_emf_nm_s_per_rad.value + _or(self.viscous_friction_nm_s_per_rad)
        return TorquePD(
            model="delayed_pd",
            stiffness_nm_per_rad=stated(self.error_gain.value * p_gain * stall),
            friction_loss_nm=self.friction_loss_nm,
            armature_kg_m2=self.armature_kg_m2,
            effort_limit_nm=stated(self.duty_limit.value * stall),
            velocity_limit_rad_s=self.velocity_limit_rad_s,
            back_emf_nm_s_per_rad=stated(velocity),
            dead_time_s=self.dead_time_s,
        )

    @property
    def left_out_of_pd(self) -> str:
        """What `as_pd` leaves out, as a sentence; empty if nothing."""
        names = {
            "Stribeck friction": self.stribeck_friction_nm,
            "load-dependent friction": self.load_friction_external,
        }
        left = [name for name, number in names.items() if number is not None]
        return f"Left out of the PD: {' and '.join(left)}." if left else ""


ServoNumbers = Annotated[PositionLoop | TorquePD, Field(discriminator="model")]
"""Numbers of one specimen of a servo."""
