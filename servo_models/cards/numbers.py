"""Numbers of a servo card: a position loop in duty with a DC motor, or a PD servo in torque.

A published servo model is one of two things. `PositionLoop` is what the servo is: the firmware
turns the position error into a duty cycle, the duty drives a DC motor, and gears rub::

    duty   = clip(duty_per_rad * P * (set-point - position), ±duty_limit)
    torque = stall_torque * duty - (back_emf + viscous_friction) * velocity

P is the register's value; `stall_torque` holds at full duty and the card's supply voltage, and is
proportional to it. `TorquePD` is what a simulator's file states: `servo_models.delayed_pd`.

The first becomes the second for one P gain and one voltage (`PositionLoop.as_pd`)::

    stiffness    = duty_per_rad * P * stall_torque
    effort limit = duty_limit * stall_torque
    back-EMF     = back_emf + viscous_friction        (acts outside of the effort limit)

Stribeck and load-dependent friction have no place in the second and are left out. Both become the
parameters of `servo_models.loaded_servo` (`loaded`), which has them, and the load; `LoadedLoop`
holds those themselves, for our own fits. A number is a `Quantity`; one that was published without
an interval may be written as the bare number.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer

from pupper_sysid.common.border import Part
from pupper_sysid.servo_models.calibration import parts
from pupper_sysid.servo_models.calibration.parts import NO_SPEED_LIMIT_RAD_S
from pupper_sysid.servo_models.calibration.quantity import (
    ARMATURE,
    DAMPING,
    SHARE,
    SPEED,
    STIFFNESS,
    TIME,
    TORQUE,
    PlausibleRange,
    Quantity,
    unit_of,
)
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters

UNSTATED = "stated without an interval"
"""Why a bare number of a card is not identified."""

_SHARES = (
    "load_friction_static", "off_brake", "start_duty", "duty_limit", "stribeck_exponent",
    "load_friction_motor", "load_friction_load", "load_stribeck_motor", "load_stribeck_load",
)  # fmt: skip
_UNITS: dict[str, str] = {
    "load_quadratic_motor": "1/(N·m)", "load_quadratic_load": "1/(N·m)",
    **dict.fromkeys(_SHARES, "1"),
}  # fmt: skip


def unit(name: str) -> str:
    """Unit of the card's quantity `name`; empty if it has none.

    Examples
    --------
    >>> unit("duty_per_rad"), unit("armature_kg_m2")
    ('1/rad', 'kg·m²')
    """
    return _UNITS.get(name) or unit_of(name)


def _bare(number: Any) -> Any:
    """A bare number as a quantity without interval."""
    if isinstance(number, bool) or not isinstance(number, int | float):
        return number
    return {"value": float(number), "identified": "no", "why": UNSTATED}


def _plainest(quantity: Quantity) -> Any:
    """A quantity as the file shows it: the bare number where there is no more to say."""
    bare = quantity.why == UNSTATED and quantity.low is None and quantity.high is None
    return quantity.value if bare else quantity.model_dump(mode="json")


def stated(value: float) -> Quantity:
    """A number that was published without an interval."""
    return Quantity.model_validate(_bare(value))


Cited = Annotated[Quantity, BeforeValidator(_bare), PlainSerializer(_plainest)]
"""A quantity that a file may state as the bare number."""

_SHARE_OF_1 = AfterValidator(PlausibleRange(0, 1, "percent", 1e-2))


def _value_or(quantity: Quantity | None, absent: float = 0.0) -> float:
    return absent if quantity is None else quantity.value


class TorquePD(Part):
    """PD servo in torque, as simulators' files state it; see `servo_models.delayed_pd`."""

    model: Literal["delayed_pd"]
    """Kind of these numbers."""
    stiffness_nm_per_rad: Annotated[Cited, STIFFNESS]
    """Torque per position error [N·m/rad]."""
    damping_nm_s_per_rad: Annotated[Cited | None, DAMPING] = None
    """Torque per velocity inside of the effort limit (MuJoCo's kv) [N·m·s/rad]."""
    friction_loss_nm: Annotated[Cited, TORQUE]
    """Dry (Coulomb) friction [N·m]."""
    armature_kg_m2: Annotated[Cited, ARMATURE]
    """Reflected inertia of motor and gears at the joint [kg·m²]."""
    effort_limit_nm: Annotated[Cited, TORQUE]
    """Largest torque [N·m]."""
    velocity_limit_rad_s: Annotated[Cited | None, SPEED] = None
    """Largest rate of the set-point [rad/s]; null where it is not limited."""
    back_emf_nm_s_per_rad: Annotated[Cited | None, DAMPING] = None
    """Torque lost per velocity outside of the effort limit (MuJoCo's joint damping) [N·m·s/rad]."""
    dead_time_s: Annotated[Cited | None, TIME] = None
    """From a command's arrival to its first effect [s]; null where the source has none."""

    @property
    def parameters(self) -> DelayedPDParameters:
        """The numbers as the servo model takes them; an unknown dead time is 0."""
        return DelayedPDParameters(
            stiffness=self.stiffness_nm_per_rad.value,
            damping=_value_or(self.damping_nm_s_per_rad),
            friction_loss=self.friction_loss_nm.value,
            armature=self.armature_kg_m2.value,
            effort_limit=self.effort_limit_nm.value,
            velocity_limit=_value_or(self.velocity_limit_rad_s, NO_SPEED_LIMIT_RAD_S),
            dead_time_s=_value_or(self.dead_time_s),
            back_emf=_value_or(self.back_emf_nm_s_per_rad),
        )

    def loaded(self, p_gain: float = 1.0) -> LoadedServoParameters:
        """The same servo as a position loop whose P gain is `p_gain`.

        A limit on the set-point's speed has no place there and is left out.
        """
        effort = self.effort_limit_nm.value
        return LoadedServoParameters(
            duty_per_rad=self.stiffness_nm_per_rad.value / (p_gain * effort),
            duty_s_per_rad=_value_or(self.damping_nm_s_per_rad) / effort,
            stall_torque=effort,
            back_emf=_value_or(self.back_emf_nm_s_per_rad),
            armature=self.armature_kg_m2.value,
            friction_loss=self.friction_loss_nm.value,
            dead_time_s=_value_or(self.dead_time_s),
        )

    @property
    def top_speed_rad_s(self) -> float | None:
        """Speed at which back-EMF and dry friction use up the largest torque [rad/s].

        The set-point's limit if that is lower; None where neither is known.
        """
        limits = [] if self.velocity_limit_rad_s is None else [self.velocity_limit_rad_s.value]
        brake = _value_or(self.back_emf_nm_s_per_rad)
        if brake > 0:
            spare_torque = max(self.effort_limit_nm.value - self.friction_loss_nm.value, 0.0)
            limits.append(spare_torque / brake)
        return min(limits, default=None)


class PositionLoop(Part):
    """Position loop in duty, DC motor and friction of the gears.

    The friction is that of Rhoban's "Better actuator models" (BAM), M1 to M6: its frictions beyond
    Coulomb's are null where a model has none.
    """

    model: Literal["position_loop"]
    """Kind of these numbers."""
    duty_per_rad: Annotated[Cited, SHARE]
    """Duty per unit of the P register and radian of position error [1/rad]."""
    duty_limit: Annotated[Cited, _SHARE_OF_1]
    """Largest duty, as a fraction of 1."""
    stall_torque_nm: Annotated[Cited, TORQUE]
    """Torque at full duty and the card's supply voltage, at standstill [N·m]."""
    back_emf_nm_s_per_rad: Annotated[Cited, DAMPING]
    """Torque lost per velocity by the motor's back-EMF [N·m·s/rad]."""
    armature_kg_m2: Annotated[Cited, ARMATURE]
    """Reflected inertia of motor and gears at the joint [kg·m²]."""
    friction_loss_nm: Annotated[Cited, TORQUE]
    """Dry (Coulomb) friction [N·m]."""
    viscous_friction_nm_s_per_rad: Annotated[Cited | None, DAMPING] = None
    """Torque lost per velocity in the gears [N·m·s/rad]."""
    stribeck_friction_nm: Annotated[Cited | None, TORQUE] = None
    """Dry friction that is added at standstill [N·m]."""
    stribeck_speed_rad_s: Annotated[Cited | None, SPEED] = None
    """Speed over which it fades [rad/s]."""
    stribeck_exponent: Annotated[Cited | None, SHARE] = None
    """Its decay is exp(-(speed / stribeck_speed)^exponent)."""
    load_friction_motor: Annotated[Cited | None, SHARE] = None
    """Friction per torque of the motor."""
    load_friction_load: Annotated[Cited | None, SHARE] = None
    """Friction per torque of the load."""
    load_stribeck_motor: Annotated[Cited | None, SHARE] = None
    """Friction per torque of the motor that is added at standstill."""
    load_stribeck_load: Annotated[Cited | None, SHARE] = None
    """Friction per torque of the load that is added at standstill."""
    load_quadratic_motor: Annotated[Cited | None, SHARE] = None
    """Friction per squared torque of the motor that is added at standstill [1/(N·m)]."""
    load_quadratic_load: Annotated[Cited | None, SHARE] = None
    """Friction per squared torque of the load that is added at standstill [1/(N·m)]."""
    velocity_limit_rad_s: Annotated[Cited | None, SPEED] = None
    """Largest rate of the set-point [rad/s]; null where it is not limited."""
    dead_time_s: Annotated[Cited | None, TIME] = None
    """From a command's arrival to its first effect [s]; null where the source has none."""

    def as_pd(self, p_gain: float) -> TorquePD:
        """The same servo as a PD in torque at one P gain; see the module's text.

        A number that is a product of several has no interval.
        """
        stall = self.stall_torque_nm.value
        velocity = self.back_emf_nm_s_per_rad.value + _value_or(self.viscous_friction_nm_s_per_rad)
        return TorquePD(
            model="delayed_pd",
            stiffness_nm_per_rad=stated(self.duty_per_rad.value * p_gain * stall),
            friction_loss_nm=self.friction_loss_nm,
            armature_kg_m2=self.armature_kg_m2,
            effort_limit_nm=stated(self.duty_limit.value * stall),
            velocity_limit_rad_s=self.velocity_limit_rad_s,
            back_emf_nm_s_per_rad=stated(velocity),
            dead_time_s=self.dead_time_s,
        )

    def loaded(self) -> LoadedServoParameters:
        """The same servo with the frictions of `servo_models.loaded_servo`.

        Exact for the loop and the motor: a limit on the duty scales the torque at full duty and the
        gain. With the torque off the gears' viscous friction remains. BAM's Stribeck friction fades
        as exp(-(v / v0)^a), here as 1 / (1 + (v / v1)^2) with the same speed at which half is left.
        Friction per torque is that of a motor that works against its load, and its addition at
        standstill one share for motor and load. Squared terms (at most 0.01 per N·m) and a limit on
        the set-point's speed are left out.
        """
        limit = self.duty_limit.value
        viscous = _value_or(self.viscous_friction_nm_s_per_rad)
        brake = self.back_emf_nm_s_per_rad.value + viscous
        motor, load = _value_or(self.load_friction_motor), _value_or(self.load_friction_load)
        at_rest = _value_or(self.load_stribeck_motor) + _value_or(self.load_stribeck_load)
        half = math.log(2) ** (1 / max(_value_or(self.stribeck_exponent, 2.0), 1e-3))
        return LoadedServoParameters(
            duty_per_rad=self.duty_per_rad.value / limit,
            duty_s_per_rad=0.0,
            stall_torque=limit * self.stall_torque_nm.value,
            back_emf=brake,
            armature=self.armature_kg_m2.value,
            friction_loss=self.friction_loss_nm.value,
            dead_time_s=_value_or(self.dead_time_s),
            stribeck_friction=_value_or(self.stribeck_friction_nm),
            stribeck_speed=max(_value_or(self.stribeck_speed_rad_s, 0.1) * half, 1e-6),
            load_friction_motor=motor,
            load_friction_load=load,
            load_friction_static=at_rest / (motor + load) if motor + load else 0.0,
            off_brake=viscous / brake if brake else 0.0,
        )

    @property
    def left_out_of_pd(self) -> str:
        """What `as_pd` leaves out, as a sentence; empty if nothing."""
        names = {
            "Stribeck friction": self.stribeck_friction_nm,
            "load-dependent friction": self.load_friction_load,
        }
        omitted = [name for name, number in names.items() if number is not None]
        return f"Left out of the PD: {' and '.join(omitted)}." if omitted else ""


class LoadedLoop(Part):
    """Parameters of `servo_models.loaded_servo`, with units: what this tool fits under load."""

    model: Literal["loaded_servo"]
    """Kind of these numbers."""
    duty_per_rad: Annotated[Cited, SHARE]
    """Duty per unit of the P register and radian of position error [1/rad]."""
    stall_torque_nm: Annotated[Cited, TORQUE]
    """Torque at full duty and the card's supply voltage, at standstill [N·m]."""
    back_emf_nm_s_per_rad: Annotated[Cited, DAMPING]
    """Torque lost per velocity: back-EMF of motor, viscous friction of gears [N·m·s/rad]."""
    armature_kg_m2: Annotated[Cited, ARMATURE]
    """Reflected inertia of motor and gears at the joint [kg·m²]."""
    friction_loss_nm: Annotated[Cited, TORQUE]
    """Dry friction at speed without load [N·m]."""
    dead_time_s: Annotated[Cited | None, TIME] = None
    """From a command's arrival to its first effect [s]."""
    duty_s_per_rad: Annotated[Cited | None, SHARE] = None
    """Duty per velocity, inside of the limit on the duty [s/rad]."""
    stribeck_friction_nm: Annotated[Cited | None, TORQUE] = None
    """Dry friction at standstill beyond `friction_loss_nm` [N·m]."""
    stribeck_speed_rad_s: Annotated[Cited | None, SPEED] = None
    """Speed at which half of it is left [rad/s]."""
    load_friction_motor: Annotated[Cited | None, SHARE] = None
    """Dry friction per torque of the motor."""
    load_friction_load: Annotated[Cited | None, SHARE] = None
    """Dry friction per torque of the load's weight."""
    load_friction_quadratic_per_nm: Annotated[Cited | None, SHARE] = None
    """Dry friction per squared torque of the motor [1/(N·m)]."""
    load_friction_static: Annotated[Cited | None, SHARE] = None
    """By what share friction per torque is larger at standstill."""
    torque_limit_nm: Annotated[Cited | None, TORQUE] = None
    """Largest torque of the motor, a limit on its current [N·m]."""
    off_brake: Annotated[Cited | None, _SHARE_OF_1] = None
    """Share of the back-EMF that remains with the torque off."""
    dead_zone_rad: Annotated[Cited | None, SHARE] = None
    """Half-width of the error that the loop ignores [rad]."""
    start_duty: Annotated[Cited | None, _SHARE_OF_1] = None
    """Duty added wherever there is an error."""
    acceleration_limit_rad_s2: Cited | None = None
    """Largest acceleration of the set-point [rad/s²]."""
    velocity_limit_rad_s: Annotated[Cited | None, SPEED] = None
    """Largest speed of the set-point [rad/s]."""

    def loaded(self) -> LoadedServoParameters:
        """The numbers as the servo model takes them; an unknown dead time is 0."""
        values = {
            name: getattr(self, key).value
            for name, key in LOADED_KEYS.items()
            if getattr(self, key) is not None
        }
        return LoadedServoParameters(**{"duty_s_per_rad": 0.0, "dead_time_s": 0.0} | values)

    def as_pd(self, p_gain: float) -> TorquePD:
        """The same servo as a PD in torque; see `LoadedServoParameters.delayed_pd`."""
        stall = self.stall_torque_nm.value
        damping = _value_or(self.duty_s_per_rad) * stall
        return TorquePD(
            model="delayed_pd",
            stiffness_nm_per_rad=stated(self.duty_per_rad.value * p_gain * stall),
            damping_nm_s_per_rad=stated(damping) if damping else None,
            friction_loss_nm=self.friction_loss_nm,
            armature_kg_m2=self.armature_kg_m2,
            effort_limit_nm=stated(min(stall, _value_or(self.torque_limit_nm, math.inf))),
            back_emf_nm_s_per_rad=self.back_emf_nm_s_per_rad,
            dead_time_s=self.dead_time_s,
        )

    @property
    def left_out_of_pd(self) -> str:
        """What `as_pd` leaves out, as a sentence; empty if nothing."""
        names = {
            "Stribeck friction": self.stribeck_friction_nm,
            "load-dependent friction": self.load_friction_load or self.load_friction_motor,
            "dead zone": self.dead_zone_rad,
            "start duty": self.start_duty,
            "limit on the set-point's acceleration": self.acceleration_limit_rad_s2,
        }
        omitted = [name for name, number in names.items() if number is not None]
        return f"Left out of the PD: {', '.join(omitted)}." if omitted else ""


LOADED_KEYS = parts.LOADED_KEYS | {"dead_time_s": "dead_time_s"}
"""Fields of `LoadedServoParameters` and their names in `LoadedLoop`."""

ServoNumbers = Annotated[PositionLoop | LoadedLoop | TorquePD, Field(discriminator="model")]
"""Numbers of one specimen of a servo."""
