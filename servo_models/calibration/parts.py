"""Parts of a calibration file: one joint, number by number.

A number is a `Quantity`: its value, its 90 % interval, and whether the data identified it.
`Actuator` leads from command to motion, `Feedback` from motion to reading; the two are measured,
stored and simulated apart. `Selection` and `Scores` justify the model. Every name ends in its unit,
and every class refuses unknown keys, text in place of numbers, and numbers outside their plausible
range.

`OperatingPoint` is the P gain, the armature and the load that the numbers are for. Stiffness is in
proportion to the P gain of the servo's position loop, and an armature is that of motor and gears
alone or holds what the joint moved, too. Two sets of numbers can be compared only where both are
known, so every file that is written from a calibration states them. `FittedServo` is the servo at
any P gain and load.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from pupper_sysid.common.border import Part
from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.servo_models.calibration.quantity import (
    AGE,
    ARMATURE,
    DAMPING,
    LAG,
    LARGE,
    OFFSET,
    RATIO,
    SHARE,
    SMALL_ANGLE,
    SPEED,
    STIFFNESS,
    TIME,
    TORQUE,
    NotNegative,
    Number,
    PlausibleRange,
    Quantity,
    Whole,
)
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters
from pupper_sysid.servo_models.step_size import CONTINUOUS_S


class RecordedLoad(Part):
    """A load that a servo was recorded with."""

    inertia_kg_m2: NotNegative
    """About the joint [kg·m²]."""
    gravity_nm: NotNegative
    """Largest torque of gravity [N·m]."""


class FittedServo(Part):
    """Position loop, motor and friction of a servo that was fitted with more than DelayedPD has.

    That is a servo under load, at several P gains, or with a profile of its set-point.

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
    back_emf_nm_s_per_rad: Annotated[Quantity, DAMPING]
    """Torque lost per velocity [N·m·s/rad]."""
    armature_kg_m2: Annotated[Quantity, ARMATURE]
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
    load_friction_quadratic_per_nm: Annotated[Quantity | None, LARGE] = None
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
    acceleration_limit_rad_s2: Annotated[Quantity | None, LARGE] = None
    """Largest acceleration of the set-point [rad/s²]; null where it follows commands at once."""
    velocity_limit_rad_s: Annotated[Quantity | None, SPEED] = None
    """Largest speed of the set-point [rad/s]; null where it has none."""
    gravity_nm: Annotated[Quantity | None, TORQUE] = None
    """Largest torque of gravity of an unknown load [N·m]; null where the load was known."""
    hanging_rad: Annotated[Quantity | None, OFFSET] = None
    """Position at which the load hangs [rad], less that of the recording's header."""

    def parameters(self, dead_time_s: float) -> LoadedServoParameters:
        """The numbers themselves, without intervals."""
        values = {
            name: value.value
            for name, key in LOADED_KEYS.items()
            if (value := getattr(self, key)) is not None
        }
        return LoadedServoParameters(**{"duty_s_per_rad": 0.0, **values}, dead_time_s=dead_time_s)

    def how_far_tested(self, p_gain: float) -> str:
        """What the recordings say of a P gain, in a sentence.

        Examples
        --------
        >>> part = FittedServo.model_construct(p_gains_tested=(8.0, 16.0, 32.0))
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
    name: next(name + end for end in _ENDINGS if name + end in FittedServo.model_fields)
    for name in (f.name for f in fields(LoadedServoParameters) if f.name != "dead_time_s")
}
"""Fields of `LoadedServoParameters` and their names in `FittedServo`."""


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
        source = "predicted" + ("" if self.p_gain is None else f" from {self.p_gain:g}")
        return self.model_copy(update={"p_gain": float(p_gain), "p_gain_source": source})


P_GAINS = (1e-3, 1e5)
"""Smallest and largest P gain of a position loop, whatever the unit of its register."""
NO_SPEED_LIMIT_RAD_S = 1000.0
"""Speed limit of a set-point that is not limited."""
_NO_BACK_EMF = Quantity(value=0.0, identified="no", why="the model has no back-EMF")


class RatiosToArmature(Part):
    """The actuator's numbers over its armature, which positions in free air identify."""

    stiffness: Annotated[Quantity, RATIO]
    """Stiffness over armature [1/s²]."""
    damping: Annotated[Quantity, RATIO]
    """Damping over armature [1/s]."""
    friction_loss: Annotated[Quantity, RATIO]
    """Dry friction over armature [rad/s²]."""
    effort_limit: Annotated[Quantity, RATIO]
    """Effort limit over armature [rad/s²]: the servo's largest acceleration."""
    back_emf: Annotated[Quantity, RATIO] = _NO_BACK_EMF
    """Back-EMF over armature [1/s]."""
    damping_and_back_emf: Annotated[Quantity | None, RATIO] = None
    """Sum of the two over armature [1/s]: inside of the effort limit they brake alike, so it may be
    known where they are not. Null in older files."""


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
    stiffness_nm_per_rad: Annotated[Quantity, STIFFNESS]
    """Torque per position error [N·m/rad]."""
    damping_nm_s_per_rad: Annotated[Quantity, DAMPING]
    """Torque per velocity [N·m·s/rad]."""
    friction_loss_nm: Annotated[Quantity, TORQUE]
    """Dry (Coulomb) friction [N·m]."""
    armature_kg_m2: Annotated[Quantity, ARMATURE]
    """Reflected inertia at the joint [kg·m²]; `operating_point.armature` says whether with the
    load."""
    effort_limit_nm: Annotated[Quantity, TORQUE]
    """Largest torque [N·m]."""
    velocity_limit_rad_s: Annotated[Quantity, SPEED]
    """Largest rate of the set-point [rad/s]; 1000 where it is not limited."""
    dead_time_s: Annotated[Quantity, TIME]
    """Dead time from a command's arrival to its first effect on the torque [s]."""
    back_emf_nm_s_per_rad: Annotated[Quantity, DAMPING] = _NO_BACK_EMF
    """Torque lost per velocity outside of the effort limit [N·m·s/rad]."""
    command_jitter_s: Annotated[Quantity, TIME] = Quantity(
        value=0.0, identified="no", why="not measured"
    )
    """Standard deviation of the latency of commands [s]; exponential, its mean in the dead time."""
    delay_steps_min: Annotated[Whole, Field(ge=0)]
    """Smallest dead time to train with, in whole physics steps."""
    delay_steps_max: Annotated[Whole, Field(ge=0)]
    """Largest dead time to train with, in whole physics steps."""
    physics_step_s: Annotated[Number, Field(gt=0, le=0.1)]
    """Length of a physics step [s]."""
    numbers_in: Literal["continuous time", "physics steps"] = "physics steps"
    """Whether the numbers are the servo's own, or those with which MuJoCo's servo in steps of
    `physics_step_s` moves like it, as in older files."""
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
    def per_inertia(self) -> dict[str, Quantity]:
        """What positions in free air identify, by the names of the fitted parameters."""
        ratios = self.ratios_to_armature
        return {
            "dead_time_s": self.dead_time_s, "stiffness_per_s2": ratios.stiffness,
            "damping_per_s": ratios.damping, "friction_rad_s2": ratios.friction_loss,
            "effort_rad_s2": ratios.effort_limit,
            "velocity_limit_rad_s": self.velocity_limit_rad_s, "back_emf_per_s": ratios.back_emf,
        }  # fmt: skip

    @property
    def fitted_step_s(self) -> float:
        """Step in which the numbers hold [s]; `CONTINUOUS_S` for the servo's own."""
        return CONTINUOUS_S if self.numbers_in == "continuous time" else self.physics_step_s

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
        step_s = self.physics_step_s
        return self.delay_steps_min * step_s, self.delay_steps_max * step_s

    @model_validator(mode="after")
    def _check(self) -> Actuator:
        low, high = self.delay_steps_min, self.delay_steps_max
        if low > high:
            raise ValueError(f"delay_steps_min is {low} and delay_steps_max is {high}; swap them")
        return self


class Feedback(Part):
    """From motion to reading: see `servo_models.held_feedback`."""

    poll_period_s: Annotated[Quantity, TIME]
    """Time between polls of the servo [s]; 0 if every reading is fresh."""
    loss: Annotated[Quantity, AfterValidator(PlausibleRange(0, 0.999, "percent", 1e-2))]
    """Probability that a poll fails silently, as a fraction of 1."""
    quantum_rad: Annotated[Quantity, SMALL_ANGLE]
    """Quantisation step [rad]; 0 if readings are continuous."""
    offset_rad: Annotated[Quantity, OFFSET]
    """Reading minus position in the recordings of this calibration [rad]: the error of their zero.
    Simulations and other recordings do not take it over."""
    mean_age_s: Annotated[Quantity, AGE]
    """Mean feedback age when the host reads [s]."""


class Lag(Part):
    """The lag budget; a preset has none."""

    lag_s: Annotated[Quantity | None, LAG] = None
    """From a command's edge to the motion [s]: the servo's lag."""
    raw_lag_s: Annotated[Quantity | None, LAG] = None
    """Cross-correlation of all rows [s]: lag, stale readings and zero-order hold."""
    fresh_lag_s: Annotated[Quantity | None, LAG] = None
    """The same on fresh rows only [s]: lag and zero-order hold."""


class Scores(Part):
    """Error of the model on the recording; null where it was not scored."""

    rmse_one_step_rad: NotNegative | None = None
    """Root mean square error one loop period ahead [rad]."""
    rmse_free_run_raw_rad: NotNegative | None = None
    """Free-run error on raw rows [rad]."""
    rmse_free_run_fresh_rad: NotNegative | None = None
    """Free-run error on fresh rows [rad]."""
    rmse_free_run_held_rad: NotNegative | None = None
    """Free-run error on all rows, the model sampled at the poll instants (held) [rad]."""
    rmse_leave_one_frequency_out_rad: NotNegative | None = None
    """Free-run error on fresh rows of frequencies that were left out of the fit [rad]."""
    rmse_unseen_runs_rad: NotNegative | None = None
    """Under load: free-run error on fresh rows of runs that were left out of the fit [rad]."""
    fit_percent: Number | None = None
    """100 · (1 − RMSE / standard deviation of the reading) on fresh rows [%]."""
    residual_over_noise: NotNegative | None = None
    """Free-run error over the noise of readings, which is found without the model: about 1 where
    the model describes the servo."""
    r_hat: NotNegative | None = None
    """R̂ of the draws behind the intervals: they have converged where it is below 1.03."""
    effective_draws: NotNegative | None = None
    """Independent draws that those of each number are worth, at least."""


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
    """Free-run error on raw rows [rad]."""
    rmse_leave_one_frequency_out_rad: NotNegative | None = None
    """Free-run error on frequencies that were left out of the fit [rad]."""
    mae_unseen_runs_rad: NotNegative | None = None
    """Under load: mean absolute free-run error on fresh rows of runs that were left out of the fit,
    mean over runs [rad]."""
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

    operating_point: OperatingPoint | None = None
    """What the numbers of `actuator` hold for; null in older files, see `holds_at`."""
    actuator: Actuator
    """From command to motion."""
    servo: FittedServo | None = None
    """The servo as it was fitted, at any P gain and load; null where `actuator` is all of it."""
    feedback: Feedback
    """From motion to reading."""
    lag: Lag = Lag()
    """The lag budget."""
    selection: Selection
    """Choice of the model."""
    scores: Scores = Scores()
    """Errors of the chosen model."""
    between_recordings: dict[str, NotNegative] = Field(default_factory=dict)
    """Of several recordings: standard deviation between them of the logarithm of a fitted number
    (0.05 is 5 %), by its name. The intervals include it."""
    warnings: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Reasons for distrust, in sentences."""

    def __repr__(self) -> str:
        servo, feedback = self.actuator, self.feedback
        dead, interval = servo.dead_time_s, ""
        if dead.low is not None and dead.high is not None:
            interval = f" ({1e3 * dead.low:.1f}…{1e3 * dead.high:.1f})"
        poll_s = feedback.poll_period_s.value
        polls = f"polled every {1e3 * poll_s:.1f} ms" if poll_s else "readings not polled"
        return (
            f"dead time {1e3 * dead.value:.1f}{interval} ms, "
            f"stiffness {servo.stiffness_nm_per_rad.value:.3g} N·m/rad, "
            f"effort limit {servo.effort_limit_nm.value:.3g} N·m; {polls}"
        )

    @property
    def holds_at(self) -> OperatingPoint:
        """What the numbers of `actuator` hold for; of an older file, as far as it says."""
        if self.operating_point is not None:
            return self.operating_point
        block = self.servo
        if block is None:
            return OperatingPoint(armature="servo and load")
        return OperatingPoint(
            p_gain=block.p_gain, armature="servo" if block.known_load else "servo and load"
        )

    def at_p_gain(self, p_gain: float) -> JointCalibration:
        """The same servo at another P gain, the register's value, with stiffness in proportion."""
        if self.servo is None:
            raise InputError(
                "This calibration holds at the P gain that it was recorded with. Record several "
                "gains, or a known load, to predict others."
            )
        refuse_outside("`p_gain`", p_gain, *P_GAINS)
        share = p_gain / self.servo.p_gain
        actuator = self.actuator
        ratios = actuator.ratios_to_armature
        ratio = {"stiffness": ratios.stiffness.scaled(share)}
        stiffness = {
            "stiffness_nm_per_rad": actuator.stiffness_nm_per_rad.scaled(share),
            "ratios_to_armature": ratios.model_copy(update=ratio),
        }
        return self.model_copy(
            update={
                "actuator": actuator.model_copy(update=stiffness),
                "servo": self.servo.model_copy(update={"p_gain": float(p_gain)}),
                "operating_point": self.holds_at.at_p_gain(p_gain),
            }
        )
