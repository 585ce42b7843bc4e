"""Parts of a calibration file: one joint, number by number.

A number is a `Quantity`: its value, its 90 % interval, and whether the data identified it.
`Actuator` leads from command to motion, `Feedback` from motion to reading; the two are measured,
stored and simulated apart. `Selection` and `Scores` justify the model. Every name ends in its unit,
and every class refuses unknown keys, text in place of numbers, and numbers outside their plausible
range.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from pupper_sysid.common import border
from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters

UNIT_OF_NAME = {
    "loss": "1",
    "stiffness": "1/s²",
    "damping": "1/s",
    "friction_loss": "rad/s²",
    "effort_limit": "rad/s²",
    "back_emf": "1/s",
    "duty_per_rad": "1/rad",
    "duty_s_per_rad": "s/rad",
    "load_friction_quadratic_per_nm": "1/(N·m)",
    "delay_steps_min": "physics steps",
    "delay_steps_max": "physics steps",
}
"""Units of the names that do not end in one; the torques are ratios to the armature there."""


def unit_of(name: str) -> str:
    """Unit of the calibration quantity `name`; empty if it has none.

    Examples
    --------
    >>> unit_of("damping_nm_s_per_rad"), unit_of("dead_time_s"), unit_of("loss")
    ('N·m·s/rad', 's', '1')
    """
    return UNIT_OF_NAME.get(name) or border.unit_of(name)


def _python_number(value: Any) -> Any:
    """A NumPy scalar as a Python number, the only kind in strict validation and YAML."""
    return value.item() if isinstance(value, np.generic) else value


Number = Annotated[float, BeforeValidator(_python_number)]
Whole = Annotated[int, BeforeValidator(_python_number)]
NotNegative = Annotated[Number, Field(ge=0)]


class Part(BaseModel):
    """Strict, frozen part of a file: no unknown key, no conversion, no NaN, no infinity."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        frozen=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )


class Quantity(Part):
    """One number with its 90 % interval, and whether the data identify it."""

    EXAMPLE: ClassVar[str] = (
        "{value: …, low: …, high: …, identified: yes | ratio only | no, why: …}"
    )

    value: Number
    """The number, in the unit at the end of its name."""
    low: Number | None = None
    """Lower end of the 90 % interval; null where there is none."""
    high: Number | None = None
    """Upper end of the 90 % interval; null where there is none."""
    identified: Literal["yes", "ratio only", "no"]
    """yes; ratio only (its ratio to the armature is known, its scale is assumed); or no."""
    why: str | None = None
    """Why it is not (fully) identified, or null. Needed where `identified` is no."""

    @model_validator(mode="after")
    def _check(self) -> Quantity:
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValueError(f"low is {self.low} and high is {self.high}; low must not exceed high")
        if self.identified == "no" and not self.why:
            raise ValueError("identified is no, so `why` must give the reason")
        return self

    def scaled(self, factor: float) -> Quantity:
        """The number and its interval times a positive `factor`."""
        ends = (self.value, self.low, self.high)
        value, low, high = (None if end is None else factor * end for end in ends)
        return self.model_copy(update={"value": value, "low": low, "high": high})


@dataclass(frozen=True)
class PlausibleRange:
    """Values that a quantity can plausibly have; beyond them the unit is wrong.

    Attributes
    ----------
    low, high : float
        Smallest and largest value, in the quantity's unit.
    looks_like : str
        Probable unit of a larger number, for example "milliseconds".
    factor : float
        From that unit to the quantity's; 0 if unknown.
    """

    low: float
    high: float
    looks_like: str = ""
    factor: float = 0.0

    def __call__(self, quantity: Quantity | None) -> Quantity | None:
        """`quantity`, unless one of its numbers is outside the range."""
        if quantity is not None:
            for number in (quantity.value, quantity.low, quantity.high):
                if number is not None and (problem := self.problem(number)):
                    raise ValueError(problem)
        return quantity

    def problem(self, number: float) -> str:
        """Fault of `number` in words; empty if it is in the range."""
        if self.low <= number <= self.high:
            return ""
        text = f"{number:g} is outside the possible {self.low:g} to {self.high:g}"
        if self.looks_like and abs(number) > self.high:
            text += f"; this looks like {self.looks_like}"
            text += f": write {number * self.factor:g}" if self.factor else ""
        return text


_TIME = AfterValidator(PlausibleRange(0, 1, "milliseconds", 1e-3))
_AGE = AfterValidator(PlausibleRange(0, 10, "milliseconds", 1e-3))
_LAG = AfterValidator(PlausibleRange(-1, 1, "milliseconds", 1e-3))
_TORQUE = AfterValidator(PlausibleRange(0, 100, "N·mm", 1e-3))
_RATIO = AfterValidator(PlausibleRange(0, 1e9))
_SMALL_ANGLE = AfterValidator(PlausibleRange(0, 0.1, "degrees", float(np.pi / 180)))
_OFFSET = AfterValidator(
    PlausibleRange(-2 * float(np.pi), 2 * float(np.pi), "degrees", float(np.pi / 180))
)


NO_SPEED_LIMIT_RAD_S = 1000.0
"""Speed limit of a set-point that is not limited."""
_NO_BACK_EMF = Quantity(value=0.0, identified="no", why="the model has no back-EMF")


class RatiosToArmature(Part):
    """The actuator's numbers over its armature, which positions in free air identify."""

    stiffness: Annotated[Quantity, _RATIO]
    """Stiffness over armature [1/s²]."""
    damping: Annotated[Quantity, _RATIO]
    """Damping over armature [1/s]."""
    friction_loss: Annotated[Quantity, _RATIO]
    """Dry friction over armature [rad/s²]."""
    effort_limit: Annotated[Quantity, _RATIO]
    """Effort limit over armature [rad/s²]: the servo's largest acceleration."""
    back_emf: Annotated[Quantity, _RATIO] = _NO_BACK_EMF
    """Back-EMF over armature [1/s]."""


class Scale(Part):
    """Torque anchor that turns the ratios into torques."""

    anchor: Literal["stall torque", "preset", "loaded recording"]
    """Kind of the anchor."""
    value_nm: NotNegative
    """Torque that is taken as known [N·m]."""
    source: str
    """Source of that torque."""


PARAMETER_KEYS = {
    "stiffness": "stiffness_nm_per_rad",
    "damping": "damping_nm_s_per_rad",
    "friction_loss": "friction_loss_nm",
    "armature": "armature_kg_m2",
    "effort_limit": "effort_limit_nm",
    "velocity_limit": "velocity_limit_rad_s",
    "dead_time_s": "dead_time_s",
    "back_emf": "back_emf_nm_s_per_rad",
}
"""Fields of `DelayedPDParameters` and their names in `Actuator`."""


class Actuator(Part):
    """From command to motion: see `servo_models.delayed_pd`."""

    model: Literal["delayed_pd"]
    """Servo model of these numbers."""
    stiffness_nm_per_rad: Annotated[Quantity, AfterValidator(PlausibleRange(0, 1e5))]
    """Torque per position error [N·m/rad]."""
    damping_nm_s_per_rad: Annotated[Quantity, AfterValidator(PlausibleRange(0, 1e4))]
    """Torque per velocity [N·m·s/rad]."""
    friction_loss_nm: Annotated[Quantity, _TORQUE]
    """Dry (Coulomb) friction [N·m]."""
    armature_kg_m2: Annotated[Quantity, AfterValidator(PlausibleRange(1e-12, 10, "g·cm²", 1e-7))]
    """Reflected inertia and load at the joint [kg·m²]."""
    effort_limit_nm: Annotated[Quantity, _TORQUE]
    """Largest torque [N·m]."""
    velocity_limit_rad_s: Annotated[
        Quantity, AfterValidator(PlausibleRange(0, 1000, "degrees per second"))
    ]
    """Largest rate of the set-point [rad/s]; 1000 where it is not limited."""
    dead_time_s: Annotated[Quantity, _TIME]
    """Dead time from a command's arrival to its first effect on the torque [s]."""
    back_emf_nm_s_per_rad: Annotated[Quantity, AfterValidator(PlausibleRange(0, 1e4))] = (
        _NO_BACK_EMF
    )
    """Torque lost per velocity outside of the effort limit [N·m·s/rad]."""
    command_jitter_s: Annotated[Quantity, _TIME] = Quantity(
        value=0.0, identified="no", why="not measured"
    )
    """Standard deviation of the latency of commands [s]; exponential, its mean in the dead time."""
    delay_steps_min: Annotated[Whole, Field(ge=0)]
    """Smallest dead time to train with, in whole physics steps."""
    delay_steps_max: Annotated[Whole, Field(ge=0)]
    """Largest dead time to train with, in whole physics steps."""
    physics_step_s: Annotated[Number, Field(gt=0, le=0.1)]
    """Length of a physics step [s]."""
    ratios_to_armature: RatiosToArmature
    """Ratios that were identified."""
    scale: Scale
    """Torque anchor that sets the scale."""

    @property
    def parameters(self) -> DelayedPDParameters:
        """The numbers themselves, without intervals."""
        values = {field: getattr(self, key).value for field, key in PARAMETER_KEYS.items()}
        return DelayedPDParameters(**values)

    @property
    def top_speed_rad_s(self) -> float:
        """No-load speed, or without back-EMF the largest rate of the set-point [rad/s]."""
        brake = self.back_emf_nm_s_per_rad.value
        return self.effort_limit_nm.value / brake if brake else self.velocity_limit_rad_s.value

    @property
    def dead_time_interval_s(self) -> tuple[float, float]:
        """Dead times to train with [s]: the interval, or whole steps, as presets publish."""
        if self.dead_time_s.low is not None and self.dead_time_s.high is not None:
            return self.dead_time_s.low, self.dead_time_s.high
        return (
            self.delay_steps_min * self.physics_step_s,
            self.delay_steps_max * self.physics_step_s,
        )

    @model_validator(mode="after")
    def _check(self) -> Actuator:
        if self.delay_steps_min > self.delay_steps_max:
            raise ValueError(
                f"delay_steps_min is {self.delay_steps_min} and delay_steps_max is "
                f"{self.delay_steps_max}; swap them"
            )
        return self


class RecordedLoad(Part):
    """A load that a servo was recorded with."""

    inertia_kg_m2: NotNegative
    """About the joint [kg·m²]."""
    gravity_nm: NotNegative
    """Largest torque of gravity [N·m]."""


_SHARE = AfterValidator(PlausibleRange(0, 100))


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
    duty_per_rad: Annotated[Quantity, _SHARE]
    """Duty per position error and unit of the P gain [1/rad]."""
    duty_s_per_rad: Annotated[Quantity | None, _SHARE] = None
    """Duty per velocity, inside of the limit on the duty [s/rad]."""
    stall_torque_nm: Annotated[Quantity, AfterValidator(PlausibleRange(0, 1000, "N·mm", 1e-3))]
    """Torque at full duty and standstill [N·m]."""
    back_emf_nm_s_per_rad: Annotated[Quantity, AfterValidator(PlausibleRange(0, 1e4))]
    """Torque lost per velocity [N·m·s/rad]."""
    armature_kg_m2: Annotated[Quantity, AfterValidator(PlausibleRange(1e-12, 10, "g·cm²", 1e-7))]
    """Reflected inertia of motor and gears, with the load's where that is unknown [kg·m²]."""
    friction_loss_nm: Annotated[Quantity, _TORQUE]
    """Dry friction at speed without load [N·m]."""
    stribeck_friction_nm: Annotated[Quantity | None, _TORQUE] = None
    """Dry friction at standstill beyond that [N·m]."""
    stribeck_speed_rad_s: Annotated[Quantity | None, _SHARE] = None
    """Speed at which half of what standstill adds to the friction is left [rad/s]."""
    load_friction_motor: Annotated[Quantity | None, _SHARE] = None
    """Dry friction per torque of the motor."""
    load_friction_load: Annotated[Quantity | None, _SHARE] = None
    """Dry friction per torque of the load's weight."""
    load_friction_quadratic_per_nm: Annotated[
        Quantity | None, AfterValidator(PlausibleRange(0, 1e6))
    ] = None
    """Dry friction per squared torque of the motor [1/(N·m)]."""
    load_friction_static: Annotated[Quantity | None, _SHARE] = None
    """By what share friction per torque is larger at standstill."""
    torque_limit_nm: Annotated[Quantity | None, _TORQUE] = None
    """Largest torque of the motor, a limit on its current [N·m]."""
    off_brake: Annotated[Quantity | None, _SHARE] = None
    """Share of the back-EMF that remains with the torque off; null if it never was."""
    dead_zone_rad: Annotated[Quantity | None, _SMALL_ANGLE] = None
    """Error that the position loop ignores [rad]."""
    start_duty: Annotated[Quantity | None, _SHARE] = None
    """Duty added wherever there is an error."""
    acceleration_limit_rad_s2: Annotated[
        Quantity | None, AfterValidator(PlausibleRange(0, 1e6))
    ] = None
    """Largest acceleration of the set-point [rad/s²]; null where it follows commands at once."""
    gravity_nm: Annotated[Quantity | None, _TORQUE] = None
    """Largest torque of gravity of an unknown load [N·m]; null where the load was known."""
    hanging_rad: Annotated[Quantity | None, _OFFSET] = None
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


LOADED_KEYS = {
    "duty_per_rad": "duty_per_rad",
    "duty_s_per_rad": "duty_s_per_rad",
    "stall_torque": "stall_torque_nm",
    "back_emf": "back_emf_nm_s_per_rad",
    "armature": "armature_kg_m2",
    "friction_loss": "friction_loss_nm",
    "stribeck_friction": "stribeck_friction_nm",
    "stribeck_speed": "stribeck_speed_rad_s",
    "load_friction_motor": "load_friction_motor",
    "load_friction_load": "load_friction_load",
    "load_friction_quadratic": "load_friction_quadratic_per_nm",
    "load_friction_static": "load_friction_static",
    "torque_limit": "torque_limit_nm",
    "off_brake": "off_brake",
    "dead_zone_rad": "dead_zone_rad",
    "start_duty": "start_duty",
    "acceleration_limit": "acceleration_limit_rad_s2",
}
"""Fields of `LoadedServoParameters` and their names in `UnderLoad`."""


class Feedback(Part):
    """From motion to reading: see `servo_models.held_feedback`."""

    poll_period_s: Annotated[Quantity, _TIME]
    """Time between polls of the servo [s]; 0 if every reading is fresh."""
    loss: Annotated[Quantity, AfterValidator(PlausibleRange(0, 0.999, "percent", 1e-2))]
    """Probability that a poll fails silently, as a fraction of 1."""
    quantum_rad: Annotated[Quantity, _SMALL_ANGLE]
    """Quantisation step [rad]; 0 if readings are continuous."""
    offset_rad: Annotated[Quantity, _OFFSET]
    """Reading minus position in the recordings of this calibration [rad]: the error of their zero.
    Simulations and other recordings do not take it over."""
    mean_age_s: Annotated[Quantity, _AGE]
    """Mean feedback age when the host reads [s]."""


class Lag(Part):
    """The lag budget; a preset has none."""

    lag_s: Annotated[Quantity | None, _LAG] = None
    """From a command's edge to the motion [s]: the servo's own lag."""
    raw_lag_s: Annotated[Quantity | None, _LAG] = None
    """Cross-correlation of all rows [s]: lag, stale readings and zero-order hold."""
    fresh_lag_s: Annotated[Quantity | None, _LAG] = None
    """The same on fresh rows only [s]: lag and zero-order hold."""


class Scores(Part):
    """Error of the model on the recording; null where it was not scored."""

    rmse_one_step_rad: NotNegative | None = None
    """Root mean square error one loop period ahead [rad]."""
    rmse_free_run_raw_rad: NotNegative | None = None
    """Free-run error on all rows as logged (raw) [rad]."""
    rmse_free_run_fresh_rad: NotNegative | None = None
    """Free-run error on fresh rows [rad]."""
    rmse_free_run_held_rad: NotNegative | None = None
    """Free-run error on all rows, the model sampled at the poll instants (held) [rad]."""
    rmse_leave_one_frequency_out_rad: NotNegative | None = None
    """Free-run error on fresh rows of frequencies that were left out of the fit [rad]."""
    fit_percent: Number | None = None
    """100 · (1 − RMSE / standard deviation of the reading) on fresh rows [%]."""


class CandidateModel(Part):
    """One candidate model and its scores."""

    model: Annotated[str, Field(min_length=1)]
    """Name of the model."""
    parameter_count: Annotated[Whole, Field(ge=0)]
    """Number of fitted parameters."""
    rmse_fresh_rad: NotNegative | None = None
    """Free-run error on fresh rows [rad]."""
    rmse_held_rad: NotNegative | None = None
    """Free-run error on all rows, the model sampled at the poll instants (held) [rad]."""
    rmse_raw_rad: NotNegative | None = None
    """Free-run error on all rows as logged (raw) [rad]."""
    rmse_leave_one_frequency_out_rad: NotNegative | None = None
    """Free-run error on frequencies that were left out of the fit [rad]."""
    fit_percent: Number | None = None
    """100 · (1 − RMSE / standard deviation of the reading) on fresh rows [%]."""
    parameters: dict[str, Number] = Field(default_factory=dict)
    """Fitted numbers by name; each name ends in its unit."""


class Selection(Part):
    """Which candidate model was chosen."""

    model: Annotated[str, Field(min_length=1)]
    """The chosen model."""
    candidate_models: Annotated[tuple[CandidateModel, ...], Field(strict=False)] = ()
    """All candidate models, simplest first; empty for a preset."""


class JointCalibration(Part):
    """Calibration of one joint."""

    actuator: Actuator
    """From command to motion."""
    under_load: UnderLoad | None = None
    """The servo at any P gain and load; null where it was recorded at one gain in free air."""
    feedback: Feedback
    """From motion to reading."""
    lag: Lag = Lag()
    """The lag budget."""
    selection: Selection
    """Choice of the model."""
    scores: Scores = Scores()
    """Errors of the chosen model."""
    warnings: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Reasons for distrust, in sentences."""

    def at_p_gain(self, p_gain: float) -> JointCalibration:
        """The same servo at another P gain: its stiffness is in proportion.

        Parameters
        ----------
        p_gain : float
            The register's value, > 0.

        Raises
        ------
        InputError
            If the calibration is of one gain (the file has no `under_load`), or the gain is not
            positive.
        """
        if self.under_load is None:
            raise InputError(
                "This calibration holds at the P gain that it was recorded with. Record several "
                "gains, or a known load, to predict others."
            )
        if not p_gain > 0:
            raise InputError(f"A P gain of {p_gain:g} is none: give a positive number.")
        share = p_gain / self.under_load.p_gain
        own = self.actuator
        ratio = own.ratios_to_armature.stiffness.scaled(share)
        stiffness = {
            "stiffness_nm_per_rad": own.stiffness_nm_per_rad.scaled(share),
            "ratios_to_armature": own.ratios_to_armature.model_copy(update={"stiffness": ratio}),
        }
        return self.model_copy(
            update={
                "actuator": own.model_copy(update=stiffness),
                "under_load": self.under_load.model_copy(update={"p_gain": float(p_gain)}),
            }
        )
