"""Results of `backlash`: hysteresis per P gain, dead zone and play per joint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result, flat, plain


@dataclass(frozen=True, kw_only=True)
class GainHysteresis(Result):
    """Hysteresis at one P gain.

    Attributes
    ----------
    p_gain : float
        NaN if the recording does not say it.
    hysteresis_rad : Interval
        Command difference between strokes up and down at the same reading and no speed.
    lag_s : Interval
        Lag behind a slow ramp: back-EMF over stiffness, and the dead time.
    strokes : int
    """

    p_gain: float
    hysteresis_rad: Interval
    lag_s: Interval
    strokes: int


@dataclass(frozen=True, kw_only=True)
class JointBacklash(Result):
    """Hysteresis, dead zone and backlash of one joint.

    Attributes
    ----------
    gains : tuple of GainHysteresis
    dead_zone_rad : Interval or None
        Half of the hysteresis that does not shrink with the gain. Its lower end is 0 where friction
        explains all; None with a single gain.
    backlash_rad : Interval or None
        Play between motor and output; None without a load that reveals it.
    notes : tuple of str
        What could not be told apart, and what would.
    """

    gains: tuple[GainHysteresis, ...]
    dead_zone_rad: Interval | None
    backlash_rad: Interval | None
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        parts = [f"hysteresis {_degrees(g.hysteresis_rad)} at P {g.p_gain:g}" for g in self.gains]
        for name, value in (("dead zone", self.dead_zone_rad), ("backlash", self.backlash_rad)):
            parts.append(f"{name} {'not determined' if value is None else _degrees(value)}")
        return ", ".join(parts)

    def rows(self) -> list[dict[str, Any]]:
        """One row per P gain; dead zone and backlash, which have no gain, stand in each."""
        return [
            gain.rows()[0]
            | flat(plain({"dead_zone_rad": self.dead_zone_rad, "backlash_rad": self.backlash_rad}))
            for gain in self.gains
        ]


def _degrees(value: Interval) -> str:
    best, low, high = np.degrees([value.value, value.low, value.high])
    return f"{best:.2f}° [{low:.2f}, {high:.2f}]"
