"""Errors of a simulated servo on the readings of runs.

A reading on a polled bus is old, so one error is not enough: fresh readings at their measurement
times; all rows at the time their value was measured (held); and all rows at their read (raw), which
counts stale readings as errors of the model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import Result
from pupper_sysid.common.signals import rms
from pupper_sysid.sysid.fit.run import Run, at_steps, fresh_residuals
from pupper_sysid.sysid.fit.search import Fit
from pupper_sysid.sysid.fit.structure import Structure


@dataclass(frozen=True, kw_only=True)
class Scores(Result):
    """RMS errors of a model [rad], and the fit in percent of the readings' spread.

    Attributes
    ----------
    rmse_fresh_rad, rmse_held_rad, rmse_raw_rad : float
        Free run against fresh rows when they were measured; all rows when their value was
        measured; all rows when they were read.
    rmse_one_step_rad : float
        Model's move from one fresh row to the next, against the readings' move.
    rmse_leave_one_frequency_out_rad : float
        Free run on fresh rows of frequencies the fit has not seen; NaN with one frequency, and
        where runs are left out instead.
    rmse_by_left_out_frequency_rad : dict of str to float
        The same by frequency [Hz].
    fit_percent : float
        100 (1 - RMS / standard deviation of the fresh readings).
    rmse_unseen_runs_rad : float
        Of motions without tones, several gains or loads: free run on fresh rows of runs that the
        fit has not seen; else NaN.
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
        """Error on unseen motion: on runs, or on frequencies."""
        runs = self.rmse_unseen_runs_rad
        return runs if np.isfinite(runs) else self.rmse_leave_one_frequency_out_rad


def score(
    tracks: Sequence[NDArray[np.float64]],
    runs: Sequence[Run],
    held_out: Mapping[str, NDArray] | None = None,
) -> Scores:
    """Scores of simulated readings.

    `tracks` of shape (steps + 1,) each: readings at step edges [rad]. `held_out`: residuals on what
    was left out, from `held_out_residuals`.
    """
    fresh, held, raw, one_step, spread = [], [], [], [], []
    for track, run in zip(tracks, runs, strict=True):
        model = at_steps(track, run.sample_step)
        fresh.append(model - run.sample_rad)
        one_step.append(np.diff(model) - np.diff(run.sample_rad))
        held.append(known(at_steps(track, run.held_step) - run.row_rad))
        raw.append(known(at_steps(track, run.row_step) - run.row_rad))
        if len(run.sample_rad):
            spread.append(run.sample_rad - run.sample_rad.mean())
    left_out = dict(held_out or {})
    unseen, tones = rms(*left_out.values()), all(_is_number(name) for name in left_out)
    return Scores(
        rmse_fresh_rad=rms(*fresh),
        rmse_held_rad=rms(*held),
        rmse_raw_rad=rms(*raw),
        rmse_one_step_rad=rms(*one_step),
        rmse_leave_one_frequency_out_rad=unseen if tones else float("nan"),
        rmse_by_left_out_frequency_rad={n: rms(r) for n, r in left_out.items()} if tones else {},
        fit_percent=100.0 * (1.0 - rms(*fresh) / max(rms(*spread), 1e-9)),
        rmse_unseen_runs_rad=float("nan") if tones else unseen,
    )


def held_out_residuals(
    structure: Structure,
    fits: Sequence[Fit],
    folds: Mapping[str, NDArray[np.bool_]],
    runs: Sequence[Run],
) -> dict[str, NDArray[np.float64]]:
    """Residuals on the runs of each fold [rad], from the fit that has not seen them.

    `fits`: one per fold. `folds`: from `sysid.fit.search.folds_of`.
    """
    return {
        name: np.concatenate(
            fresh_residuals(
                structure, structure.decode(fit.point),
                [r for r, gone in zip(runs, out, strict=True) if gone],
            )
        )
        for (name, out), fit in zip(folds.items(), fits, strict=True)
    }  # fmt: skip


def known(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The numbers that are finite."""
    return values[np.isfinite(values)]


def _is_number(name: str) -> bool:
    return name.replace(".", "", 1).isdigit()
