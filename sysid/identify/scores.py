"""How far a simulated servo is from the readings of a sweep, in every way that says something.

A reading on a polled bus is old, so one error is not enough: fresh readings at their own times,
all rows at the time their value was measured, and all rows as logged (`naive`), which flatters
nobody and misleads everybody.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.identify.output_error import TrialData, look_up


@dataclass(frozen=True)
class Scores:
    """How far a model is from the readings, RMS [rad], and in percent of their spread.

    Attributes
    ----------
    fresh, held, naive : float
        Free run against fresh rows when they were measured; all rows when their value was
        measured; all rows at their own send time.
    one_step : float
        Model's move from one fresh row to the next, against the readings' move.
    leave_one_out : float
        Free run on fresh rows of frequencies the fit has not seen; NaN with one frequency.
    leave_one_out_by_frequency : dict of float to float
        The same per frequency (per trial number where there are no tones).
    fit_percent : float
        100 (1 - RMS / standard deviation of the fresh readings).
    """

    fresh: float
    held: float
    naive: float
    one_step: float
    leave_one_out: float
    leave_one_out_by_frequency: dict[float, float]
    fit_percent: float


def score(
    track: NDArray[np.float64], data: Sequence[TrialData], held_out: dict[float, NDArray]
) -> Scores:
    """Scores of simulated positions.

    Parameters
    ----------
    track : ndarray, shape (steps + 1, trials)
        Position at step edges, relative to rest [rad].
    data : sequence of TrialData
    held_out : dict of float to ndarray
        Residuals on each left-out frequency, from fits that have not seen it.
    """
    fresh, held, naive, one_step, spread = [], [], [], [], []
    for n, t in enumerate(data):
        model = look_up(track[:, n], t.sample_step)
        fresh.append(model - t.sample_rad)
        one_step.append(np.diff(model) - np.diff(t.sample_rad))
        seen = np.isfinite(t.row_rad)
        held.append((look_up(track[:, n], t.held_step) - t.row_rad)[seen])
        naive.append((look_up(track[:, n], t.row_step) - t.row_rad)[seen])
        spread.append(t.sample_rad - t.sample_rad.mean())
    left = {name: rms([r]) for name, r in held_out.items()}
    return Scores(
        rms(fresh), rms(held), rms(naive), rms(one_step),
        rms(list(held_out.values())) if held_out else float("nan"), left,
        100.0 * (1.0 - rms(fresh) / max(rms(spread), 1e-9)),
    )  # fmt: skip


def rms(parts: Sequence[NDArray]) -> float:
    """Root mean square of all numbers of all parts; NaN if there are none."""
    everything = np.concatenate(parts)
    return float(np.sqrt(np.mean(everything**2))) if len(everything) else float("nan")
