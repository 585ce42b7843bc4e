"""A number of a calibration: value, 90 % interval, whether the data identified it; its checks."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from pupper_sysid.common import border
from pupper_sysid.common.border import Part
from pupper_sysid.common.interval import Interval

UNIT_OF_NAME = {
    "loss": "1",
    "stiffness": "1/s²",
    "damping": "1/s",
    "friction_loss": "rad/s²",
    "effort_limit": "rad/s²",
    "back_emf": "1/s",
    "damping_and_back_emf": "1/s",
    "duty_per_rad": "1/rad",
    "duty_s_per_rad": "s/rad",
    "load_friction_quadratic_per_nm": "1/(N·m)",
    "residual_over_noise": "1",
    "r_hat": "1",
    "effective_draws": "draws",
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


_UNIT_ENDING = re.compile(
    "_(per_s2|per_s|per_nm|rad_s2|nm_s_per_rad|nm_per_rad|kg_m2|rad_s|(?<!per_)rad|nm|s)$"
)
_WORDS = {
    "effort_rad_s2": "effort limit", "friction_rad_s2": "friction loss", "back_emf": "back-EMF",
    "damping_and_back_emf": "damping + back-EMF",
}  # fmt: skip


def words_of(name: str) -> str:
    """A quantity's name without its unit, as tables and sentences have it.

    Examples
    --------
    >>> words_of("dead_time_s"), words_of("stiffness_per_s2"), words_of("duty_per_rad")
    ('dead time', 'stiffness', 'duty per rad')
    """
    return _WORDS.get(name) or _UNIT_ENDING.sub("", name).replace("_", " ")


def _python_number(value: Any) -> Any:
    """A NumPy scalar as a Python number, the only kind in strict validation and YAML."""
    return value.item() if isinstance(value, np.generic) else value


Number = Annotated[float, BeforeValidator(_python_number)]
Whole = Annotated[int, BeforeValidator(_python_number)]
NotNegative = Annotated[Number, Field(ge=0)]


_Part = TypeVar("_Part", bound=Part)


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

    def __repr__(self) -> str:
        ends = "" if self.low is None or self.high is None else f", {self.low:.4g}…{self.high:.4g}"
        return f"Quantity({self.value:.4g}{ends}, identified: {self.identified})"

    @property
    def interval(self) -> Interval:
        """The number with its ends; an end that it does not have is the number itself."""
        low, high = (self.value if end is None else end for end in (self.low, self.high))
        return Interval(self.value, low, high)

    def scaled(self, factor: float) -> Quantity:
        """The number and its interval times a positive `factor`."""
        ends = (self.value, self.low, self.high)
        value, low, high = (None if end is None else factor * end for end in ends)
        return self.model_copy(update={"value": value, "low": low, "high": high})


@dataclass(frozen=True)
class PlausibleRange:
    """Values that a quantity can plausibly have; beyond them the unit is wrong.

    Low and high are in the quantity's unit; `looks_like` is the probable unit of a larger number,
    such as "milliseconds", and `factor` leads from that to the quantity's, 0 if unknown.
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

    def cut(self, quantity: Quantity) -> Quantity:
        """`quantity` within the range; not identified if its value was outside."""
        value, low, high = (
            None if number is None else min(max(number, self.low), self.high)
            for number in (quantity.value, quantity.low, quantity.high)
        )
        assert value is not None
        identified, why = quantity.identified, quantity.why
        if value != quantity.value:
            identified = "no"
            why = (
                f"its estimate, {quantity.value:.3g}, is outside the possible {self.low:g} to "
                f"{self.high:g}"
            )
        return Quantity(value=value, low=low, high=high, identified=identified, why=why)

    def problem(self, number: float) -> str:
        """Fault of `number` in words; empty if it is in the range."""
        if self.low <= number <= self.high:
            return ""
        text = f"{number:g} is outside the possible {self.low:g} to {self.high:g}"
        if self.looks_like and abs(number) > self.high:
            text += f"; this looks like {self.looks_like}"
            text += f": write {number * self.factor:g}" if self.factor else ""
        return text


def quantity_of(
    interval: Interval, known: Literal["yes", "ratio only"] = "yes", why: str | None = None
) -> Quantity:
    """A measured interval as a quantity; its ends are never inside of its value.

    A value that is not finite becomes 0 and is not identified; an end that is not finite is left
    out. `known` is what the data identified, unless there is a reason `why` not.

    Examples
    --------
    >>> quantity_of(Interval(0.02, 0.01, float("inf"))).high is None
    True
    >>> quantity_of(Interval(float("nan"), 0.01, 0.03)).identified
    'no'
    """
    if not np.isfinite(interval.value):
        why, interval = "its estimate is not finite", Interval(0.0, np.nan, np.nan)
    low, high = (float(end) if np.isfinite(end) else None for end in (interval.low, interval.high))
    value = float(interval.value)
    return Quantity(
        value=value,
        low=None if low is None else min(low, value),
        high=None if high is None else max(high, value),
        identified="no" if why else known,
        why=why or (None if known == "yes" else "scale from the torque anchor"),
    )


def measured(kind: type[_Part], **entries: Any) -> _Part:
    """A part of a calibration with numbers of a fit, each cut to its plausible range.

    A file with other numbers is refused; a fit that ends there is a finding: the quantity is not
    identified, and says so. Entries are the part's fields, some of them a `Quantity`.
    """
    for name, entry in entries.items():
        if not isinstance(entry, Quantity):
            continue
        for check in kind.model_fields[name].metadata:
            if isinstance(span := getattr(check, "func", None), PlausibleRange):
                entries[name] = span.cut(entry)
    return kind(**entries)


_DEGREES = "degrees", float(np.pi / 180)
TIME = AfterValidator(PlausibleRange(0, 1, "milliseconds", 1e-3))
AGE = AfterValidator(PlausibleRange(0, 10, "milliseconds", 1e-3))
LAG = AfterValidator(PlausibleRange(-2, 2, "milliseconds", 1e-3))
TORQUE = AfterValidator(PlausibleRange(0, 100, "N·mm", 1e-3))
STIFFNESS = AfterValidator(PlausibleRange(0, 1e5))
DAMPING = AfterValidator(PlausibleRange(0, 1e4))
ARMATURE = AfterValidator(PlausibleRange(1e-12, 10, "g·cm²", 1e-7))
SPEED = AfterValidator(PlausibleRange(0, 1000, "degrees per second"))
LARGE = AfterValidator(PlausibleRange(0, 1e6))
RATIO = AfterValidator(PlausibleRange(0, 1e9))
SMALL_ANGLE = AfterValidator(PlausibleRange(0, 0.1, *_DEGREES))
OFFSET = AfterValidator(PlausibleRange(-2 * float(np.pi), 2 * float(np.pi), *_DEGREES))
SHARE = AfterValidator(PlausibleRange(0, 100))
