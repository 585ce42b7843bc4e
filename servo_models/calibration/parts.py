"""The parts of a calibration file: what is known of one joint, number by number.

A number is a `Quantity`: its value, its 90 % interval, and whether the data identified it at all.
`Actuator` is what the servo does with a command; `Feedback` is what makes a reading of it old,
coarse and off; the two are measured, stored and simulated apart. `Selection` and `Scores` say why
this model was believed. Every name ends in its unit, and every class refuses unknown keys, text in
place of numbers, and numbers that only another unit could explain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from pupper_sysid.common import border
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters

UNIT_OF_NAME = {
    "loss": "1",
    "stiffness": "1/s²",
    "damping": "1/s",
    "friction_loss": "rad/s²",
    "effort_limit": "rad/s²",
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
    """A NumPy scalar as the Python number it is: strict validation and YAML know no other."""
    return value.item() if isinstance(value, np.generic) else value


Number = Annotated[float, BeforeValidator(_python_number)]
Whole = Annotated[int, BeforeValidator(_python_number)]
NotNegative = Annotated[Number, Field(ge=0)]


class Part(BaseModel):
    """A strict, frozen piece of a file: no unknown key, no conversion, no NaN, no infinity."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        frozen=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )


class Quantity(Part):
    """One number, how well it is known, and whether the data say anything about it."""

    EXAMPLE: ClassVar[str] = (
        "{value: …, low: …, high: …, identified: yes | ratio only | no, why: …}"
    )

    value: Number
    """The number itself, in the unit that ends the name it stands under."""
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


@dataclass(frozen=True)
class PlausibleRange:
    """The values a quantity can have at all; beyond them the unit is wrong, not the servo.

    Attributes
    ----------
    low, high : float
        Smallest and largest possible value, in the quantity's unit.
    looks_like : str
        What a larger number probably is, for example "milliseconds".
    factor : float
        What turns that into the quantity's unit; 0 if unknown.
    """

    low: float
    high: float
    looks_like: str = ""
    factor: float = 0.0

    def __call__(self, quantity: Quantity | None) -> Quantity | None:
        """`quantity`, unless one of its numbers is impossible."""
        if quantity is not None:
            for number in (quantity.value, quantity.low, quantity.high):
                if number is not None and (problem := self.problem(number)):
                    raise ValueError(problem)
        return quantity

    def problem(self, number: float) -> str:
        """What is wrong with `number`; empty if it is possible."""
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


class RatiosToArmature(Part):
    """What free-air positions do identify: the actuator's numbers divided by its armature."""

    stiffness: Annotated[Quantity, _RATIO]
    """Stiffness over armature [1/s²]."""
    damping: Annotated[Quantity, _RATIO]
    """Damping over armature [1/s]."""
    friction_loss: Annotated[Quantity, _RATIO]
    """Dry friction over armature [rad/s²]."""
    effort_limit: Annotated[Quantity, _RATIO]
    """Effort limit over armature [rad/s²]: the largest acceleration the servo can give."""


class Scale(Part):
    """What turned the ratios into torques."""

    anchor: Literal["stall torque", "preset", "loaded recording"]
    """Kind of the anchor."""
    value_nm: NotNegative
    """The torque that was taken as known [N·m]."""
    source: str
    """Where that torque comes from."""


PARAMETER_KEYS = {
    "stiffness": "stiffness_nm_per_rad",
    "damping": "damping_nm_s_per_rad",
    "friction_loss": "friction_loss_nm",
    "armature": "armature_kg_m2",
    "effort_limit": "effort_limit_nm",
    "velocity_limit": "velocity_limit_rad_s",
    "dead_time_s": "dead_time_s",
}
"""Field of `DelayedPDParameters` and its name in `Actuator`."""


class Actuator(Part):
    """What the servo does with a command: see `servo_models.delayed_pd`."""

    model: Literal["delayed_pd"]
    """The servo model these numbers belong to."""
    stiffness_nm_per_rad: Annotated[Quantity, AfterValidator(PlausibleRange(0, 1e5))]
    """Torque per position error [N·m/rad]."""
    damping_nm_s_per_rad: Annotated[Quantity, AfterValidator(PlausibleRange(0, 1e4))]
    """Torque per velocity [N·m·s/rad]."""
    friction_loss_nm: Annotated[Quantity, _TORQUE]
    """Dry (Coulomb) friction [N·m]."""
    armature_kg_m2: Annotated[Quantity, AfterValidator(PlausibleRange(1e-12, 10, "g·cm²", 1e-7))]
    """All inertia the servo feels, its own rotor's included [kg·m²]."""
    effort_limit_nm: Annotated[Quantity, _TORQUE]
    """Largest torque [N·m]."""
    velocity_limit_rad_s: Annotated[
        Quantity, AfterValidator(PlausibleRange(0, 1000, "degrees per second"))
    ]
    """Largest rate of the set-point [rad/s]."""
    dead_time_s: Annotated[Quantity, _TIME]
    """Dead time from a command's arrival to its first effect on the torque [s]."""
    delay_steps_min: Annotated[Whole, Field(ge=0)]
    """Smallest delay to train with, in whole physics steps."""
    delay_steps_max: Annotated[Whole, Field(ge=0)]
    """Largest delay to train with, in whole physics steps."""
    physics_step_s: Annotated[Number, Field(gt=0, le=0.1)]
    """Length of a physics step [s]."""
    ratios_to_armature: RatiosToArmature
    """The ratios that were identified."""
    scale: Scale
    """The torque anchor that set the scale."""

    @property
    def parameters(self) -> DelayedPDParameters:
        """The numbers themselves, without intervals."""
        values = {field: getattr(self, key).value for field, key in PARAMETER_KEYS.items()}
        return DelayedPDParameters(**values)

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


class Feedback(Part):
    """Why a reading is old, coarse and off: see `servo_models.held_feedback`."""

    poll_period_s: Annotated[Quantity, _TIME]
    """Time between polls of the servo [s]; 0 if every read is fresh."""
    loss: Annotated[Quantity, AfterValidator(PlausibleRange(0, 0.999, "percent", 1e-2))]
    """Probability that a poll fails silently, a fraction of 1."""
    quantum_rad: Annotated[Quantity, _SMALL_ANGLE]
    """Size of one count [rad]; 0 if readings are continuous."""
    offset_rad: Annotated[Quantity, _OFFSET]
    """Reading minus position, constant [rad]."""
    mean_age_s: Annotated[Quantity, _AGE]
    """Mean age of a reading when the host takes it [s]."""


class Lag(Part):
    """The lag budget; a preset has none."""

    lag_s: Annotated[Quantity | None, _LAG] = None
    """From a command's edge to the motion the host can see [s]: the servo's own lag."""
    naive_lag_s: Annotated[Quantity | None, _LAG] = None
    """What a cross-correlation of all rows says [s]: lag, feedback age and command hold."""
    fresh_lag_s: Annotated[Quantity | None, _LAG] = None
    """The same on fresh rows only [s]: lag and command hold."""


class Scores(Part):
    """How far the model is from the recording; null where it was not scored."""

    rmse_one_step_rad: NotNegative | None = None
    """Root mean square error one loop period ahead [rad]."""
    rmse_free_run_naive_rad: NotNegative | None = None
    """Free-run error against all rows as they stand, held ones included [rad]."""
    rmse_free_run_fresh_rad: NotNegative | None = None
    """Free-run error against fresh rows [rad]."""
    rmse_free_run_held_rad: NotNegative | None = None
    """Free-run error against all rows, the model sampled at the poll instants [rad]."""
    rmse_leave_one_frequency_out_rad: NotNegative | None = None
    """Free-run error on frequencies the fit has not seen, fresh rows [rad]."""
    fit_percent: Number | None = None
    """100 · (1 − RMSE / standard deviation of the reading) on fresh rows [%]."""


class CandidateModel(Part):
    """One candidate model and its scores."""

    model: Annotated[str, Field(min_length=1)]
    """Name of the model."""
    parameter_count: Annotated[Whole, Field(ge=0)]
    """How many numbers were fitted."""
    rmse_fresh_rad: NotNegative | None = None
    """Free-run error on fresh rows [rad]."""
    rmse_held_rad: NotNegative | None = None
    """Free-run error on all rows, the model sampled at the poll instants [rad]."""
    rmse_naive_rad: NotNegative | None = None
    """Free-run error on all rows as they stand [rad]."""
    rmse_leave_one_frequency_out_rad: NotNegative | None = None
    """Free-run error on frequencies the fit has not seen [rad]."""
    fit_percent: Number | None = None
    """Share of the fresh reading's variation that the model explains [%]."""
    parameters: dict[str, Number] = Field(default_factory=dict)
    """The fitted numbers by name, each name with its unit."""


class Selection(Part):
    """Which candidate model was chosen."""

    model: Annotated[str, Field(min_length=1)]
    """The chosen model."""
    candidate_models: Annotated[tuple[CandidateModel, ...], Field(strict=False)] = ()
    """All candidate models, simplest first; empty for a preset."""


class JointCalibration(Part):
    """All that is known of one joint."""

    actuator: Actuator
    """What the servo does with a command."""
    feedback: Feedback
    """What makes a reading of it old, coarse and off."""
    lag: Lag = Lag()
    """The lag budget."""
    selection: Selection
    """Why this model."""
    scores: Scores = Scores()
    """How good it is."""
    warnings: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """What to distrust, in sentences."""
