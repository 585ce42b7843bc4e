"""Lag budget of one joint: how much is feedback age, command hold and servo.

    raw lag = feedback age + command hold (half a loop) + servo lag
    servo lag = dead time + dynamics

`lag_budget` measures the raw lag and its three parts; the dead time needs a model
(`sysid.identify.joint_fit`). Estimators, each on all rows and on fresh rows:

* integer cross-correlation, which resolves whole loop periods only;
* sub-sample cross-correlation, bounded to one period of the tone;
* sine phase per trial; and the phase slope over all tones, where a lag common to all frequencies
  has no whole-period ambiguity below half a second.

The default, "hold-aware", is the phase slope of fresh rows at their measurement times, against the
zero-order-held command. Intervals are from a bootstrap over periods.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result, derived, flat
from pupper_sysid.sysid.doctor.checks import cautions
from pupper_sysid.sysid.feedback.poll_lattice import (
    PollLattice,
    Readings,
    find_poll_lattice,
    quantum,
    readings,
)
from pupper_sysid.sysid.lag.tone import ToneResponse, tone_response
from pupper_sysid.sysid.recordings.recording import Trial

LONGEST_LAG_S = 0.5

_BLOCK_S = 0.5  # of the bootstrap where there are no periods
_ONE_TONE_HZ = 0.05  # closer than that is one tone, twice
_MOVES = 0.1  # gain below which a servo is stuck, and its readings are noise
_FOLLOWS = 0.5  # of the largest gain: below, a tone says nothing about the delay
_USUAL_AGE_S = 0.03  # of feedback: where to look for the raw lag of a tone


@dataclass(frozen=True, kw_only=True)
class FrequencyLag:
    """Response of the joint to one tone.

    Attributes
    ----------
    frequency_hz : float
    gain, phase_deg : float
        Of fresh readings against the held command.
    lag_s : Interval
    raw_lag_s, raw_gain : float
        Of all rows at their own times.
    trial : int
    """

    frequency_hz: float
    gain: float
    phase_deg: float
    lag_s: Interval
    raw_lag_s: float
    raw_gain: float
    trial: int


@dataclass(frozen=True, kw_only=True)
class LagBudget(Result):
    """Parts of one joint's lag.

    Attributes
    ----------
    joint : str
    raw_lag_s : Interval
        From a command's row to the position's row, all rows.
    fresh_lag_s : Interval
        The same of fresh rows at their measurement times.
    lag_s : Interval
        From a command's edge to the measured motion: the servo's own lag.
    feedback_age_s, command_hold_s : float
        What the bus adds: `raw_lag_s - fresh_lag_s` and `fresh_lag_s - lag_s`.
    dead_time_s : Interval or None
        Part of `lag_s` before the servo moves; None if no model was fitted.
    feedback : PollLattice
    quantum_rad : float
        Quantisation step of the readings; 0 if there is none.
    offset_rad : float
        Reading minus position, from the fitted model.
    by_frequency : tuple of FrequencyLag
        Empty if the recording has no tones.
    estimators_s : dict of str to float
        Lag by every estimator; NaN where one does not apply.
    noise_rad : float
        RMS of fresh readings about their tones; NaN if there are none.
    warnings : tuple of str
    """

    joint: str
    raw_lag_s: Interval
    fresh_lag_s: Interval
    lag_s: Interval
    feedback_age_s: float
    command_hold_s: float
    dead_time_s: Interval | None = None
    feedback: PollLattice
    quantum_rad: float
    offset_rad: float = math.nan
    by_frequency: tuple[FrequencyLag, ...]
    estimators_s: dict[str, float]
    noise_rad: float
    warnings: tuple[str, ...]

    @derived
    def dynamics_s(self) -> float:
        """Part of the servo's lag that is not dead time [s]."""
        return self.lag_s.value - (self.dead_time_s.value if self.dead_time_s else math.nan)

    def rows(self) -> list[dict[str, Any]]:
        """A single row, without the estimators."""
        return [flat(replace(self, estimators_s={}).to_dict())]

    def __str__(self) -> str:
        servo = f"{1e3 * self.lag_s.value:.0f} ms servo"
        if self.dead_time_s:
            servo += (
                f" ({1e3 * self.dead_time_s.value:.0f} ms dead time + "
                f"{1e3 * self.dynamics_s:.0f} ms dynamics)"
            )
        return (
            f"raw lag {1e3 * self.raw_lag_s.value:.0f} ms = "
            f"{1e3 * self.feedback_age_s:.0f} ms feedback age + "
            f"{1e3 * self.command_hold_s:.0f} ms command hold + {servo}."
        )


def lag_budget(
    joint: str,
    trials: Sequence[Trial],
    rng: np.random.Generator,
    lattice: PollLattice | None = None,
) -> LagBudget:
    """Measure the lag of one joint and what the bus adds to it.

    Parameters
    ----------
    joint : str
    trials : sequence of Trial
        All of this joint.
    rng : numpy.random.Generator
        For the bootstrap.
    lattice : PollLattice, optional
        If it has been found already.

    Raises
    ------
    InputError
        If nothing moves, or there are too few fresh readings to say anything.
    """
    lattice = lattice or find_poll_lattice(trials, rng.spawn(1)[0])
    read = [readings(t, lattice) for t in trials]
    if sum(len(r.rows) for r in read) < 16:
        raise InputError(
            f"{joint}: only {sum(len(r.rows) for r in read)} readings differ from the one before, "
            "too few to measure a lag. Was the joint moving and its torque on? See "
            "`pupper-sysid doctor`."
        )
    tones = [tone_response(t, r, rng) for t, r in zip(trials, read, strict=True)]
    tones = [t for t in tones if t is not None]
    warnings = list(cautions(joint, trials))
    if tones:
        moved = max(abs(t.response) for t in tones)
        if moved < _MOVES:
            raise InputError(
                f"{joint}: it moved by at most {100 * moved:.0f} % of its command, so there is no "
                "lag to measure. Was its torque on, and does it turn freely?"
            )
        raw = _slope(tones, "raw_rows")
        fresh = _slope(tones, "fresh_rows")
        lag = _slope(tones, "fresh_held")
        lost = [t for t, w in zip(tones, tone_weights(tones), strict=True) if w == 0]
        if lost:
            listed = ", ".join(f"{t.frequency_hz:.3g}" for t in lost)
            warnings.append(
                f"{joint}: at {listed} Hz it moves less than half as far as commanded, so these "
                "tones are left out of the lag; record them with a smaller amplitude."
            )
        if len({round(t.frequency_hz, 2) for t in tones}) == 1:
            warnings.append(
                f"{joint}: one frequency only, so a lag of one period "
                f"({1e3 / tones[0].frequency_hz:.0f} ms) more would look the same; record several."
            )
    else:
        raw, fresh, lag = _shifts(trials, read, rng)
        warnings.append(
            f"{joint}: no tones in this recording, so the lag is one time shift of all its "
            "motion. Record a sweep for a lag per frequency."
        )
    frequency = np.array([t.frequency_hz for t in tones])
    lags = tone_lags(np.array([t.response for t in tones]), frequency) if tones else []
    by_frequency = tuple(_at_frequency(t, float(own)) for t, own in zip(tones, lags, strict=True))
    doubt = max(t.read_time_doubt_s for t in trials)
    if lattice.kind == "unresolved":
        doubt += lattice.time_doubt_s
        warnings.append(
            f"{joint}: readings are held, but their poll period could not be found; fresh readings "
            "are dated to the middle between two reads, which may bias all lags by half a loop "
            f"({1e3 * lattice.time_doubt_s:.0f} ms). A longer sweep would settle it."
        )
    fresh, lag = fresh.widened(doubt), lag.widened(doubt)
    return LagBudget(
        joint=joint,
        raw_lag_s=raw,
        fresh_lag_s=fresh,
        lag_s=lag,
        feedback_age_s=raw.value - fresh.value,
        command_hold_s=fresh.value - lag.value,
        feedback=lattice,
        quantum_rad=quantum(trials),
        by_frequency=tuple(replace(f, lag_s=f.lag_s.widened(doubt)) for f in by_frequency),
        estimators_s=_estimators(trials, read, tones, lag.value),
        noise_rad=float(np.sqrt(np.mean([t.residual_rad**2 for t in tones])))
        if tones
        else math.nan,
        warnings=tuple(warnings),
    )


# --------------------------------------------------------------------------- phase slope

_PAIRS = {
    "raw_rows": ("raw", "command_rows"),
    "fresh_rows": ("fresh", "command_rows"),
    "fresh_held": ("fresh", "command_held"),
}


def _slope(tones: Sequence[ToneResponse], pair: str) -> Interval:
    """Lag common to all tones: the slope of the phase through the origin, with its interval."""
    output, command = _PAIRS[pair]
    frequency = np.array([t.frequency_hz for t in tones])
    response = np.array([getattr(t, output) / getattr(t, command) for t in tones])
    draws = np.stack([getattr(t, f"{output}_draws") / getattr(t, command) for t in tones])
    weight = tone_weights(tones)
    lags = tone_lags(response, frequency)
    drawn = _lag_near(draws, frequency[:, None], lags[:, None])
    return Interval.of_draws(float(weight @ lags), weight @ drawn)


def tone_weights(tones: Sequence[ToneResponse]) -> NDArray[np.float64]:
    """Weight of each tone in the joint's lag: inverse variance, 0 where the servo cannot follow.

    Below half of the largest gain the torque or speed limit clips the motion, and its phase is no
    delay.
    """
    gain = np.array([abs(t.response) for t in tones])
    weight = 1.0 / np.array([t.lag_variance_s2 for t in tones])
    weight = np.where(gain >= _FOLLOWS * gain.max(), weight, 0.0)
    return weight / weight.sum()


def tone_lags(response: NDArray, frequency_hz: NDArray) -> NDArray[np.float64]:
    """Lag of every tone [s], the right whole period of each included.

    A phase leaves the lag open to whole periods. The lowest tone has the longest period and
    settles itself below 2 Hz; above, the lag on which all tones agree best settles it. From there
    each tone takes the period nearest to the lag of the tone below it, for a servo's lag changes
    by far less than half a period from one tone to the next.

    Parameters
    ----------
    response : ndarray of complex, shape (tones,)
    frequency_hz : ndarray, shape (tones,)
    """
    order = np.argsort(frequency_hz, kind="stable")
    lowest = frequency_hz[order[0]]
    if lowest <= 2.0:
        near = 0.4 / lowest  # from a tenth of a period early to nine tenths late
    else:
        near = _common_lag(response, frequency_hz)
    lags = np.empty(len(order))
    for i in order:
        near = lags[i] = _lag_near(response[i], frequency_hz[i], near)
    return lags


def _common_lag(response: NDArray, frequency: NDArray) -> float:
    """The lag on which all phases agree best."""
    spacing = np.diff(np.unique(frequency))
    # two trials of one tone differ by the error of their fits only
    spacing = spacing[spacing > _ONE_TONE_HZ]
    # tones repeat their common phase pattern after 1 / (smallest spacing); one tone, after 1 / f
    repeat = 1.0 / (spacing.min() if len(spacing) else frequency[0])
    lags = np.arange(0.0, min(LONGEST_LAG_S, 0.95 * repeat), 2e-4)
    turned = np.angle(response)[:, None] + 2 * np.pi * frequency[:, None] * lags
    return float(lags[int(np.argmax(np.cos(turned).sum(axis=0)))])


def _lag_near(response, frequency, centre):
    """Lag of a phase, in the period around `centre` [s]; arrays broadcast."""
    turned = np.angle(response * np.exp(2j * np.pi * frequency * centre))
    return centre - turned / (2 * np.pi * frequency)


def _at_frequency(tone: ToneResponse, lag: float) -> FrequencyLag:
    f, response = tone.frequency_hz, tone.response
    draws = _lag_near(tone.response_draws, f, lag)
    raw = tone.raw / tone.command_rows
    return FrequencyLag(
        frequency_hz=f,
        gain=abs(response),
        phase_deg=-360.0 * f * lag,
        lag_s=Interval.of_draws(lag, draws),
        raw_lag_s=float(_lag_near(raw, f, lag + _USUAL_AGE_S)),
        raw_gain=abs(raw),
        trial=tone.trial,
    )


# ------------------------------------------------------------------- time shift, any excitation


def _shifts(
    trials: Sequence[Trial], read: Sequence[Readings], rng: np.random.Generator, draws: int = 400
) -> tuple[Interval, Interval, Interval]:
    """Naive, fresh and servo lag as the shift of the command that correlates best."""
    lags = np.arange(0.0, LONGEST_LAG_S, 1e-3)
    results = []
    for kind in _PAIRS:
        parts = [_shift_sums(t, r, kind, lags) for t, r in zip(trials, read, strict=True)]
        sums = np.concatenate(parts)  # (blocks, 6, lags)
        weights = rng.exponential(size=(draws, len(sums)))
        value = _best_shift(sums.sum(axis=0), lags)
        drawn = [_best_shift(np.tensordot(w, sums, axes=1), lags) for w in weights]
        results.append(Interval.of_draws(value, np.array(drawn)))
    return results[0], results[1], results[2]


def _shift_sums(trial: Trial, read: Readings, kind: str, lags: NDArray) -> NDArray[np.float64]:
    """Sums behind the correlation of position and shifted command, per block of half a second."""
    if kind == "raw_rows":
        rows = np.flatnonzero(np.isfinite(trial.position_rad))
        time, position = trial.send_time_s[rows], trial.position_rad[rows]
    else:
        time, position = read.time_s, read.position_rad
    block = np.floor((time - time[:1]) / _BLOCK_S)
    edges = [0, *(np.flatnonzero(np.diff(block)) + 1), len(time)] if len(time) else []
    sums = np.empty((max(len(edges) - 1, 0), 6, len(lags)))
    # a block at a time: all lags of all rows would be gigabytes for a long walk
    for n, (first, last) in enumerate(pairwise(edges)):
        y, past = position[first:last], time[first:last, None] - lags
        if kind == "fresh_held":
            row = np.searchsorted(trial.send_time_s, past, side="right") - 1
            c = np.where(row < 0, trial.initial_command_rad, trial.command_rad[np.maximum(row, 0)])
        else:
            c = np.interp(past, trial.send_time_s, trial.command_rad)
        one = np.ones(len(lags))
        sums[n] = (
            len(y) * one, y.sum() * one, c.sum(axis=0), (y @ y) * one, y @ c, (c * c).sum(axis=0),
        )  # fmt: skip
    return sums


def _best_shift(sums: NDArray, lags: NDArray) -> float:
    n, y, c, yy, yc, cc = sums
    covariance = yc - y * c / n
    scale = np.sqrt(np.maximum((yy - y * y / n) * (cc - c * c / n), 1e-18))
    return _parabolic_peak(covariance / scale, lags)


def _parabolic_peak(score: NDArray, lags: NDArray) -> float:
    """Position of the maximum of a sampled curve, refined by the parabola through its top."""
    k = int(np.argmax(score))
    if not 0 < k < len(score) - 1:
        return float(lags[k])
    left, top, right = score[k - 1 : k + 2]
    bend = left - 2 * top + right
    return float(lags[k] + (0.5 * (left - right) / bend if bend < 0 else 0.0) * (lags[1] - lags[0]))


# ------------------------------------------------------------------------- for comparison


def _estimators(
    trials: Sequence[Trial], read: Sequence[Readings], tones: Sequence[ToneResponse], lag: float
) -> dict[str, float]:
    """All estimators side by side, each the mean over trials [s]."""
    pairs = list(zip(trials, read, strict=True))
    found = {
        "integer cross-correlation, all rows": [_integer(t, None) for t in trials],
        "integer cross-correlation, fresh rows": [_integer(t, r.rows) for t, r in pairs],
        "sub-sample cross-correlation, all rows": [_bounded(t, r, "raw_rows") for t, r in pairs],
        "sub-sample cross-correlation, fresh rows": [
            _bounded(t, r, "fresh_rows") for t, r in pairs
        ],
    }
    frequency = np.array([t.frequency_hz for t in tones])
    for kind, name in (("raw_rows", "all rows"), ("fresh_rows", "fresh rows")):
        output, command = _PAIRS[kind]
        response = np.array([getattr(t, output) / getattr(t, command) for t in tones])
        found[f"sine phase, {name}"] = list(tone_lags(response, frequency)) if tones else []
    result = {
        k: float(np.nanmean(v)) if np.isfinite(v).any() else float("nan") for k, v in found.items()
    }
    if tones:
        result["phase slope, all rows"] = _slope(tones, "raw_rows").value
        result["phase slope, fresh rows"] = _slope(tones, "fresh_rows").value
        result["hold-aware (default)"] = lag
    return result


def _longest(trial: Trial) -> float:
    return min(LONGEST_LAG_S, 1.0 / trial.frequency_hz if trial.frequency_hz > 0 else LONGEST_LAG_S)


def _integer(trial: Trial, rows: NDArray | None) -> float:
    """Lag in whole loop periods at which raw correlation peaks [s]."""
    c = trial.command_rad - trial.command_rad.mean()
    loop = float(np.median(np.diff(trial.send_time_s)))
    shifts = np.arange(0, max(2, int(_longest(trial) / loop)))
    rows = np.flatnonzero(np.isfinite(trial.position_rad)) if rows is None else rows
    rows = rows[rows >= shifts[-1]]
    if len(rows) < 8:
        return float("nan")
    y = trial.position_rad[rows] - trial.position_rad[rows].mean()
    return float(shifts[int(np.argmax([np.sum(y * c[rows - s]) for s in shifts]))] * loop)


def _bounded(trial: Trial, read: Readings, kind: str) -> float:
    lags = np.arange(0.0, _longest(trial), 1e-3)
    sums = _shift_sums(trial, read, kind, lags)
    return _best_shift(sums.sum(axis=0), lags) if len(sums) else float("nan")
