"""Data of the report's figures.

`tracks` is the free run of a fitted model beside commands and readings; `hold_runs` counts for how
many rows readings stay the same, beside the prediction of the poll lattice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pupper_sysid.common.interval import LEVEL
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice
from pupper_sysid.sysid.fit.results import JointCalibrationResult
from pupper_sysid.sysid.fit.run import Run, at_steps, free_run
from pupper_sysid.sysid.fit.structure import candidate
from pupper_sysid.sysid.lag.joint_response import FrequencyResponse

LONGEST_RUN = 12
"""Hold runs of this many rows and more share the last bar."""


@dataclass(frozen=True)
class Track:
    """One trial: command, model and readings; angles from rest [rad], times [s].

    Attributes
    ----------
    frequency_hz : float
        NaN if the trial is no tone.
    time_s, command_rad, model_rad : ndarray, shape (steps,)
        On the physics clock, from the trial's start.
    fresh_time_s, fresh_rad : ndarray, shape (fresh,)
        Fresh readings at the time they were measured.
    row_time_s, row_rad : ndarray, shape (rows,)
        Every reading at the time of its row; NaN where missing.
    fresh_error_rad, row_error_rad : ndarray
        Reading minus model at those times.
    fresh_speed_rad_s, row_speed_rad_s : ndarray
        Speed of the model at those times.
    """

    frequency_hz: float
    time_s: NDArray[np.float64]
    command_rad: NDArray[np.float64]
    model_rad: NDArray[np.float64]
    fresh_time_s: NDArray[np.float64]
    fresh_rad: NDArray[np.float64]
    row_time_s: NDArray[np.float64]
    row_rad: NDArray[np.float64]
    fresh_error_rad: NDArray[np.float64]
    row_error_rad: NDArray[np.float64]
    fresh_speed_rad_s: NDArray[np.float64]
    row_speed_rad_s: NDArray[np.float64]


def tracks(result: JointCalibrationResult, model: str | None = None) -> list[Track]:
    """Free run of a fitted model on every trial of its joint.

    Parameters
    ----------
    result : JointCalibrationResult
    model : str, optional
        Name of a candidate model; by default the one that simulators run.
    """
    if not result.runs:
        return []
    model = model or result.simulated_model
    fitted = candidate(model)
    values = np.array([result.candidate_models[model].values[name] for name in fitted.names])
    simulated = free_run(fitted, values, result.runs)
    return [_track(*pair) for pair in zip(result.runs, simulated, strict=True)]


def _track(run: Run, simulated: NDArray) -> Track:
    steps, rest = run.steps, run.rest_rad
    # over a few steps: dry friction makes the speed of a single one jump
    smooth = np.convolve(np.pad(simulated, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    speed = np.gradient(smooth, TIME_STEP_S)
    return Track(
        run.frequency_hz,
        np.arange(steps) * np.float64(TIME_STEP_S), run.command - rest, simulated[:steps] - rest,
        TIME_STEP_S * run.sample_step, run.sample_rad - rest,
        TIME_STEP_S * run.row_step, run.row_rad - rest,
        run.sample_rad - at_steps(simulated, run.sample_step),
        run.row_rad - at_steps(simulated, run.row_step),
        at_steps(speed, run.sample_step), at_steps(speed, run.row_step),
    )  # fmt: skip


def window(track: Track, periods: float = 2.5, longest_s: float = 3.0) -> tuple[float, float]:
    """Start and end of the stretch of `track` to show [s]: steady tone, or largest motion."""
    end = float(track.time_s[-1])
    if track.frequency_hz > 0:
        length = min(periods / track.frequency_hz, end)
        start = min(0.5 * end, end - length)
        return start, start + length
    if end <= longest_s:
        return 0.0, end
    travel = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(track.command_rad)))])
    width = int(longest_s / TIME_STEP_S)
    start = float(track.time_s[int(np.argmax(travel[width:] - travel[:-width]))])
    return start, start + longest_s


def within(time: NDArray, start: float, stop: float) -> NDArray[np.bool_]:
    """Which times lie within a stretch, its ends included."""
    return (time >= start) & (time <= stop)


def some_tracks(found: list[Track], count: int = 4) -> list[Track]:
    """At most `count` tracks, spread over their frequencies, slowest first."""
    order = sorted(found, key=lambda t: t.frequency_hz if t.frequency_hz > 0 else 0.0)
    seen: dict[float, Track] = {}
    for n, track in enumerate(order):
        seen.setdefault(
            round(track.frequency_hz, 2) if track.frequency_hz > 0 else -float(n), track
        )
    order = list(seen.values())
    index = np.unique(np.round(np.linspace(0, len(order) - 1, min(count, len(order)))).astype(int))
    return [order[i] for i in index]


def response_errors(response: FrequencyResponse) -> tuple[NDArray, NDArray]:
    """Half of the 90 % intervals of gain [dB] and phase [degrees], shape (tones,) each."""
    along = response.response / np.abs(response.response)
    sd = []
    for direction in (along, 1j * along):
        u = np.stack([direction.real, direction.imag], axis=-1)
        sd.append(np.sqrt(np.einsum("ni,nij,nj->n", u, response.covariance, u)))
    relative = ndtri((1 + LEVEL) / 2) * np.array(sd) / np.abs(response.response)
    return 20 / np.log(10) * relative[0], np.degrees(relative[1])


@dataclass(frozen=True)
class HoldRuns:
    """For how many rows a reading stays the same.

    Attributes
    ----------
    lattice : PollLattice
    count : ndarray of int, shape (LONGEST_RUN,)
        Runs of 1, 2, … rows; the last holds all longer ones.
    expected : ndarray, shape (LONGEST_RUN,), or None
        Predicted by the poll period and the share of lost polls; None without a lattice.
    """

    lattice: PollLattice
    count: NDArray[np.int64]
    expected: NDArray[np.float64] | None


def hold_runs(
    histograms: Sequence[tuple[int, ...]], loop_periods_s: Sequence[float], lattice: PollLattice
) -> HoldRuns:
    """Hold runs of one joint, counted by the doctor and predicted by its poll lattice.

    Parameters
    ----------
    histograms : sequence of tuple of int
        Runs of 1, 2, … rows in each recording; they are added.
    loop_periods_s : sequence of float
        Of each recording.
    lattice : PollLattice
    """
    count = np.zeros(LONGEST_RUN, dtype=np.int64)
    for histogram in histograms:
        length = np.clip(np.arange(len(histogram)), 0, LONGEST_RUN - 1)
        np.add.at(count, length, np.array(histogram, dtype=np.int64))
    if lattice.kind != "lattice" or not count.any() or not np.isfinite(lattice.loss):
        return HoldRuns(lattice, count, None)
    rows = lattice.poll_period_s / float(np.median(loop_periods_s))
    return HoldRuns(lattice, count, count.sum() * _expected(rows, lattice.loss))


def _expected(period_rows: float, loss: float) -> NDArray[np.float64]:
    """Share of runs of 1, 2, … rows when each poll, `period_rows` apart, fails with `loss`.

    Between two good polls lie k periods with probability (1 - loss) loss^(k-1). A gap of x rows,
    at a random phase of the loop, is seen as floor(x) or ceil(x) rows, on average as x.
    """
    share = np.zeros(LONGEST_RUN + 1)
    k = np.arange(1, 200)
    weight = (1 - loss) * loss ** (k - 1)
    gap = k * period_rows
    for rows, chance in ((np.floor(gap), 1 - gap % 1), (np.floor(gap) + 1, gap % 1)):
        np.add.at(share, np.clip(rows, 0, LONGEST_RUN).astype(int), weight * chance)
    return share[1:] / max(share[1:].sum(), 1e-12)  # several polls within a row leave one run
