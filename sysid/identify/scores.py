"""Errors of a simulated servo on the readings of a sweep.

A reading on a polled bus is old, so one error is not enough: fresh readings at their measurement
times; all rows at the time their value was measured (held); and rows as logged (raw), which count
stale readings as errors of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import Result
from pupper_sysid.sysid.identify.candidates.simulation import TrialData, look_up


@dataclass(frozen=True, kw_only=True)
class Scores(Result):
    """RMS errors of a model [rad], and the fit in percent of the readings' spread.

    Attributes
    ----------
    rmse_fresh_rad, rmse_held_rad, rmse_raw_rad : float
        Free run against fresh rows when they were measured; all rows when their value was
        measured; all rows at their own send time.
    rmse_one_step_rad : float
        Model's move from one fresh row to the next, against the readings' move.
    rmse_leave_one_frequency_out_rad : float
        Free run on fresh rows of frequencies the fit has not seen; NaN with one frequency.
    rmse_by_left_out_frequency_rad : dict of str to float
        The same by frequency [Hz] (by trial number where there are no tones).
    fit_percent : float
        100 (1 - RMS / standard deviation of the fresh readings).
    rmse_unseen_runs_rad : float
        Of a servo under load: free run on fresh rows of runs (of other gains, loads or motions)
        the fit has not seen; else NaN.
    """

    rmse_fresh_rad: float
    rmse_held_rad: float
    rmse_raw_rad: float
    rmse_one_step_rad: float
    rmse_leave_one_frequency_out_rad: float
    rmse_by_left_out_frequency_rad: dict[str, float]
    fit_percent: float
    rmse_unseen_runs_rad: float = float("nan")

    @property
    def rmse_unseen_rad(self) -> float:
        """Error on unseen motion: on runs under load, on frequencies else."""
        runs = self.rmse_unseen_runs_rad
        return runs if np.isfinite(runs) else self.rmse_leave_one_frequency_out_rad


def score(
    tracks: Sequence[NDArray[np.float64]], data: Sequence[TrialData], held_out: dict[float, NDArray]
) -> Scores:
    """Scores of simulated positions.

    Parameters
    ----------
    tracks : sequence of ndarray, shape (steps + 1,) each
        Position at step edges, relative to rest [rad].
    data : sequence of TrialData
    held_out : dict of float to ndarray
        Residuals on each left-out frequency, from fits that have not seen it.
    """
    fresh, held, raw, one_step, spread = [], [], [], [], []
    for track, t in zip(tracks, data, strict=True):
        model = look_up(track, t.sample_step)
        fresh.append(model - t.sample_rad)
        one_step.append(np.diff(model) - np.diff(t.sample_rad))
        seen = np.isfinite(t.row_rad)
        dated = seen & np.isfinite(t.held_step)
        held.append(look_up(track, t.held_step[dated]) - t.row_rad[dated])
        raw.append((look_up(track, t.row_step) - t.row_rad)[seen])
        spread.append(t.sample_rad - t.sample_rad.mean())
    return Scores(
        rmse_fresh_rad=rms(fresh),
        rmse_held_rad=rms(held),
        rmse_raw_rad=rms(raw),
        rmse_one_step_rad=rms(one_step),
        rmse_leave_one_frequency_out_rad=rms(list(held_out.values())),
        rmse_by_left_out_frequency_rad={f"{name:g}": rms([r]) for name, r in held_out.items()},
        fit_percent=100.0 * (1.0 - rms(fresh) / max(rms(spread), 1e-9)),
    )


def rms(parts: Sequence[NDArray]) -> float:
    """Root mean square of all numbers of all parts; NaN if there are none."""
    everything = np.concatenate([np.empty(0), *parts])
    return float(np.sqrt(np.mean(everything**2))) if len(everything) else float("nan")
