"""Rhythm of a gyro: a robot's IMU log beside the trunk of the simulated robot on the ground.

A log is a CSV file with a column of times and one per axis. Both signals get the same estimator, a
least-squares periodogram (Lomb-Scargle with a constant per frequency, J. VanderPlas, "Understanding
the Lomb-Scargle Periodogram", 2018), since a log's rows are not evenly spaced.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lombscargle

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import content
from pupper_sysid.common.reading.csv_table import read_table
from pupper_sysid.common.results import Result

Array = NDArray[np.float64]

_RATES, _ACCELERATIONS = ("gx", "gy", "gz"), ("ax", "ay", "az")
STEP_S = 0.02
"""Between samples of the simulated gyro: the rate at which robots log theirs."""

_TIMES, _MOST_BYTES = ("timestamp", "time_s"), 100e6
_SETTLE_S, _SHORTEST_S = 2.0, 5.0
_LOW_HZ, _HIGH_HZ = 0.5, 10.0
_PER_BIN = 8  # frequencies per 1 / duration


@dataclass(frozen=True, kw_only=True)
class Gyro(Result):
    """Spectrum of a gyro; each number for x, y and z."""

    deviation_rad_s: tuple[float, ...]
    """Standard deviation; of several robots their mean."""
    peak_hz: tuple[float, ...]
    """Frequency of 0.5 to 10 Hz whose sine explains most; NaN of an axis that does not turn."""
    peak_share: tuple[float, ...]
    """Share of the variance that this sine explains."""


@dataclass(frozen=True)
class ImuLog:
    """Samples of an IMU."""

    time_s: Array
    """From the first sample on, shape (n,)."""
    rate_rad_s: Array
    """Shape (n, 3)."""
    acceleration_m_s2: Array
    """NaN where none was logged, shape (n, 3)."""


def read_imu(path: Path) -> ImuLog:
    """Read the log of an IMU.

    It is a CSV file with the columns `timestamp` or `time_s` [s], `gx`, `gy`, `gz` [rad/s], and
    perhaps `ax`, `ay`, `az` [m/s²].
    """
    data = content(path, _MOST_BYTES, "Give a shorter log.")
    table = read_table(path, data.decode("utf-8", errors="replace"))
    name = next((n for n in _TIMES if n in table.numbers), _TIMES[0])
    needed = (name, *_RATES)
    if missing := [n for n in needed if n not in table.numbers]:
        raise InputError(
            f"{path} has no column {missing[0]}. An IMU log has the columns {', '.join(needed)} "
            "(s and rad/s)."
        )
    values = np.stack([table.numbers[n] for n in needed], axis=1)
    whole = np.isfinite(values).all(axis=1)
    nothing = np.full(len(values), np.nan)
    acceleration = np.stack([table.numbers.get(n, nothing) for n in _ACCELERATIONS], axis=1)
    values, acceleration = values[whole], acceleration[whole]
    time = values[:, 0]
    if (np.diff(time) <= 0).any():
        raise InputError(f"{path}: its times do not increase. Give one log per file.")
    if not len(time) or np.ptp(time) < _SETTLE_S + _SHORTEST_S:
        raise InputError(
            f"{path} is shorter than {_SETTLE_S + _SHORTEST_S:g} s, which a rhythm needs. Give a "
            "longer log."
        )
    return ImuLog(time - time[0], values[:, 1:], acceleration)


def spectrum(time_s: Array, rates_rad_s: Sequence[Array]) -> Gyro | None:
    """Spectrum after the first two seconds; None if less than five are left.

    Rates have the shape (n, 3); spectra of several robots are averaged.
    """
    late = time_s >= _SETTLE_S
    time = time_s[late]
    if not len(rates_rad_s) or len(time) < 2 or np.ptp(time) < _SHORTEST_S - STEP_S:
        return None
    highest = min(_HIGH_HZ, 0.5 / float(np.median(np.diff(time))))
    at = np.arange(_LOW_HZ, highest, 1.0 / (_PER_BIN * float(np.ptp(time))))
    rates = np.stack([rate[late] for rate in rates_rad_s])
    deviation = rates.std(axis=1).mean(axis=0)
    peaks = []
    for axis, turning in enumerate(deviation > 0):
        power = np.zeros(len(at))
        for rate in rates[..., axis] if turning else ():
            power += lombscargle(time, rate, 2 * np.pi * at, normalize=True, floating_mean=True)
        best = int(power.argmax())
        peaks.append((float(at[best]) if turning else float("nan"), power[best] / len(rates)))
    peak_hz, peak_share = zip(*peaks, strict=True)
    return Gyro(
        deviation_rad_s=tuple(map(float, deviation)), peak_hz=peak_hz,
        peak_share=tuple(map(float, peak_share)),
    )  # fmt: skip
