"""Lag budget of one joint: how much is stale readings, command hold and servo.

    raw lag = lag of stale readings + command hold (half a loop) + servo lag
    servo lag = dead time + dynamics

`lag_budget` measures the raw lag and its three parts; the dead time needs a model
(`sysid.fit.joint_fit`). Only the dead time is the servo's own: the lag moves with gain,
amplitude and load.

* Tones (`sysid.lag.tone`), named, found in the command, or the lines of a multisine: the phase
  slope of fresh rows at their measurement times, against the zero-order-held command, without the
  staircase's ripple. Intervals are from a bootstrap over periods.
* Any other motion: the time shift of the held command that resembles the
  motion best, through an impulse response fitted to the readings.

The usual `estimators` stand beside it, on all rows and on fresh rows: integer cross-correlation,
which resolves whole loop periods only; sub-sample cross-correlation, bounded to one period of the
tone; sine phase per trial, and the phase slope over all tones.

The lag of a motion of any kind is the shift τ at which the correlation of y(t) and c(t - τ) over
continuous time is largest; y is the joint's motion, c the command as the bus holds it. For one tone
that is its phase delay. For any other motion it is the phase delay of the cross-spectrum S between
command and position, averaged over frequency f with the weight f² |S(f)|: over the band that was
excited.

A staircase read at one phase of the loop correlates alike for every shift within a loop, so
readings and commands are not correlated here. An impulse response is fitted to them
(`sysid.lag.step_response`), and its correlation with the command's own, in continuous time, has its
largest value at the lag. That is as uncertain as the response between two readings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.results import Result, derived, flat
from pupper_sysid.common.signals import rms
from pupper_sysid.sysid.doctor.checks import cautions
from pupper_sysid.sysid.doctor.writers import scatter_findings
from pupper_sysid.sysid.feedback.poll_lattice import (
    NO_LOSS,
    PollLattice,
    Readings,
    find_poll_lattice,
    quantum,
    readings,
)
from pupper_sysid.sysid.lag.step_response import (
    LONGEST_S,
    ImpulseResponse,
    joint_impulse_response,
    joint_stretches,
    rough_lag,
)
from pupper_sysid.sysid.lag.tone import (
    FOLLOWS,
    ToneResponse,
    lag_near,
    line_responses,
    responses,
    slope,
    tone_lags,
    tone_weights,
    without_ripple,
)
from pupper_sysid.sysid.recordings.recording import Trial

_MOVES = 0.1  # gain below which a servo is stuck, and its readings are noise
_USUAL_AGE_S = 0.03  # of feedback: where to look for the raw lag of a tone
_EXPLAINED = 0.1  # share of the motion, below which it is no answer to the command
_NEAR_END_S = 0.02
_ALONE_HZ = 1.3  # up to there the lowest tone's own period is longer than any lag
_USUAL_SHIFT_S = 0.15  # about the lag, where rows' own correlation is looked for


@dataclass(frozen=True, kw_only=True)
class FrequencyLag:
    """Response of the joint to one tone."""

    frequency_hz: float
    gain: float
    phase_deg: float
    """`gain` and `phase_deg`: of fresh readings against the held command."""
    lag_s: Interval
    raw_lag_s: float
    raw_gain: float
    """`raw_lag_s` and `raw_gain`: of all rows at their own times."""
    trial: int


@dataclass(frozen=True, kw_only=True)
class LagBudget(Result):
    """Parts of one joint's lag."""

    joint: str
    raw_lag_s: Interval
    """From a command's row to the reading of a position, all rows; without tones, the sum of its
    parts."""
    fresh_lag_s: Interval
    """The same of fresh rows at their measurement times."""
    lag_s: Interval
    """From the held command to the motion: the servo's lag at the gain, amplitude and load of this
    recording. Of tones the phase delay, of other motion as in `sysid.lag.lag_budget`."""
    stale_lag_s: float
    command_hold_s: float
    """`stale_lag_s` and `command_hold_s`: what the bus adds: `raw_lag_s - fresh_lag_s` and
    `fresh_lag_s - lag_s`. Stale readings add less to the lag of a fast tone than their mean age
    (`feedback.mean_age_s`). The hold is half a loop, and with tones what readings at one phase of
    the loop see of the ripple."""
    dead_time_s: Interval | None = None
    """Part of `lag_s` before the servo moves; None if no model was fitted."""
    feedback: PollLattice
    quantum_rad: float
    """Quantisation step of the readings; 0 if there is none."""
    offset_rad: float = math.nan
    """Reading minus position, from the fitted model."""
    by_frequency: tuple[FrequencyLag, ...]
    """By tone, whether named or found in the command; empty if the recording has none."""
    estimators_s: dict[str, float]
    """Lag by every estimator; NaN where one does not apply."""
    noise_rad: float
    """RMS of fresh readings about their tones; NaN if there are none."""
    warnings: tuple[str, ...]

    @derived
    def dynamics_s(self) -> float:
        """Part of the servo's lag that is not dead time [s]."""
        return self.lag_s.value - (self.dead_time_s.value if self.dead_time_s else math.nan)

    @derived
    def lag_range(self) -> str:
        """What the servo's lag is a mean over, in words; empty without tones.

        The lag of a tone is what a motion at its frequency shows; the mean is of no motion.
        """
        if not self.by_frequency:
            return ""
        most = max(f.gain for f in self.by_frequency)
        followed = [f for f in self.by_frequency if f.gain >= FOLLOWS * most]  # as `tone_weights`
        hz = sorted({float(f"{f.frequency_hz:.3g}") for f in followed})
        if len(hz) == 1:
            return f"at {hz[0]:g} Hz"
        lags = sorted(1e3 * f.lag_s.value for f in followed)
        return f"mean over {hz[0]:g}–{hz[-1]:g} Hz; {lags[0]:.0f}–{lags[-1]:.0f} ms by tone"

    def with_dead_time(self, dead_time_s: Interval, offset_rad: float) -> LagBudget:
        """The budget with a fitted model's dead time and offset.

        A dead time longer than the lag leaves nothing for the dynamics: a warning says so.
        """
        warnings = self.warnings
        if dead_time_s.value > self.lag_s.value:
            apart = dead_time_s.low > self.lag_s.high
            warnings += (
                f"{self.joint}: the model's dead time ({1e3 * dead_time_s.value:.1f} ms) is longer "
                f"than the lag ({1e3 * self.lag_s.value:.1f} ms), "
                + ("so one of them is wrong." if apart else "within their intervals.")
                + " The dynamics are not identified.",
            )
        return replace(self, dead_time_s=dead_time_s, offset_rad=offset_rad, warnings=warnings)

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
            f"{1e3 * self.stale_lag_s:.0f} ms stale readings + "
            f"{1e3 * self.command_hold_s:.0f} ms command hold + {servo}"
            f"{f' ({self.lag_range})' if self.lag_range else ''}."
        )


def lag_budget(
    joint: str,
    trials: Sequence[Trial],
    rng: np.random.Generator,
    lattice: PollLattice | None = None,
) -> LagBudget:
    """Measure the lag of one joint from all of its trials, and what the bus adds to it."""
    trials = [t.powered() for t in trials]
    lattice = lattice or find_poll_lattice(trials, rng.spawn(1)[0])
    read = [readings(t, lattice) for t in trials]
    if sum(len(r.rows) for r in read) < 16:
        raise InputError(
            f"{joint}: only {sum(len(r.rows) for r in read)} readings differ from the one before, "
            "too few to measure a lag. Was the joint moving and its torque on? See "
            "`pupper-sysid doctor`."
        )
    other = None
    if lattice.readings == "cannot tell":
        # they may be live after all: dated to their reads, with all rows of a joint that stands
        live = replace(lattice, kind="every read", readings="live")
        other = _seen(joint, trials, [readings(t, live) for t in trials], rng, False)
    try:
        seen = _seen(joint, trials, read, rng, lattice.kind == "lattice")
    except InputError:
        if other is None:
            raise
        seen = other  # too few readings that changed, and nothing else is wrong with them
    tones, raw = seen.tones, seen.raw
    uneven = [f"{joint}: {f.text}" for f in scatter_findings(trials, lattice)]
    warnings = [*cautions(joint, trials), *uneven, *_warnings(joint, seen)]
    doubt = max(t.read_time_doubt_s for t in trials)
    if lattice.kind == "unresolved":
        doubt += lattice.time_doubt_s
        warnings.append(
            f"{joint}: readings are held, but their poll period could not be found; fresh readings "
            "are dated to the middle between two reads, which may bias all lags by half a loop "
            f"({1e3 * lattice.time_doubt_s:.0f} ms). A longer sweep would settle it."
        )
    if lattice.kind == "lattice" and not math.isfinite(lattice.loss):
        warnings.append(
            f"{joint}: the share of lost polls is not identified: {NO_LOSS}. Record a faster "
            "motion."
        )
    fresh, lag = seen.fresh.widened(doubt), seen.lag.widened(doubt)
    by_frequency = tuple(replace(f, lag_s=f.lag_s.widened(doubt)) for f in seen.by_frequency())
    if other is not None:
        fresh, lag = _hull(fresh, other.fresh), _hull(lag, other.lag)
        if len(other.tones) == len(tones):
            by_frequency = tuple(
                replace(a, lag_s=_hull(a.lag_s, b.lag_s))
                for a, b in zip(by_frequency, other.by_frequency(), strict=True)
            )
    noise = rms([tone.residual_rad for tone in tones])
    return LagBudget(
        joint=joint, raw_lag_s=raw, fresh_lag_s=fresh, lag_s=lag,
        stale_lag_s=raw.value - fresh.value, command_hold_s=fresh.value - lag.value,
        feedback=lattice, quantum_rad=quantum(trials), by_frequency=by_frequency,
        estimators_s=estimators(trials, read, tones, lag.value), noise_rad=noise,
        warnings=tuple(warnings),
    )  # fmt: skip


def raw_and_fresh_lag(
    joint: str, trials: Sequence[Trial], rng: np.random.Generator, lattice: PollLattice
) -> tuple[float, float]:
    """The lag of all rows as logged, and of fresh readings at the time they were measured [s]."""
    read = [readings(t, lattice) for t in trials]
    seen = _seen(joint, trials, read, rng, lattice.kind == "lattice")
    return seen.raw.value, seen.fresh.value


@dataclass(frozen=True)
class _Seen:
    """What readings dated in one way show."""

    tones: list[ToneResponse]
    near_s: float | None
    raw: Interval
    fresh: Interval
    lag: Interval

    def by_frequency(self) -> tuple[FrequencyLag, ...]:
        if not self.tones:
            return ()
        frequency = np.array([t.frequency_hz for t in self.tones])
        lags = tone_lags(np.array([t.response for t in self.tones]), frequency, self.near_s)
        rows = []
        for t, lag in zip(self.tones, map(float, lags), strict=True):
            f, raw = t.frequency_hz, t.raw / t.command_rows
            interval = Interval.of_draws(lag, lag_near(t.response_draws, f, lag))
            rows.append(
                FrequencyLag(
                    frequency_hz=f, gain=abs(t.response), phase_deg=-360.0 * f * lag,
                    lag_s=interval, raw_lag_s=float(lag_near(raw, f, lag + _USUAL_AGE_S)),
                    raw_gain=abs(raw), trial=t.trial,
                )
            )  # fmt: skip
        return tuple(rows)


def _seen(
    joint: str, trials: Sequence[Trial], read: Sequence[Readings], rng: np.random.Generator,
    polled: bool,
) -> _Seen:  # fmt: skip
    """Measure the lag with readings dated as in `read`."""
    tones: list[ToneResponse] = []
    for t, r in zip(trials, read, strict=True):
        tones += line_responses(t, r, rng)
    if tones:
        moved = max(abs(t.response) for t in tones)
        if moved < _MOVES:
            raise InputError(
                f"{joint}: it moved by at most {100 * moved:.0f} % of its command, so there is no "
                "lag to measure. Was its torque on, and does it turn freely?"
            )
        near = None
        if min(t.frequency_hz for t in tones) > _ALONE_HZ:
            near = rough_lag(joint_stretches(joint, trials, read))
        if not polled:  # polls meet all phases of the loop, so there is no ripple to take out
            tones = without_ripple(trials, read, tones, rng, near)
        raw, fresh, lag = (slope(tones, p, near) for p in ("raw_rows", "fresh_rows", "fresh_held"))
        return _Seen(tones, near, raw, fresh, lag)
    impulse = joint_impulse_response(joint, trials, read, rng)
    # motion that is no answer to the command
    if impulse.explained < _EXPLAINED:
        raise InputError(
            f"{joint}: the command explains {100 * max(impulse.explained, 0):.0f} % of the motion, "
            "so there is no lag to measure. Was its torque on, and do commands and positions "
            "belong to one joint? See `pupper-sysid doctor`."
        )
    _, alike = _resemblance(impulse)
    if np.mean(impulse.masses.sum(axis=1) < 0) > 0.95 and -alike.min() > alike.max():
        raise InputError(
            f"{joint}: it moves against its command (gain {impulse.gain:.2f}), so there is no lag "
            "to measure. Turn the sign of its position or of its command; a servo that is late by "
            "half a period of a fast motion looks the same: record a slower one."
        )
    drawn = shift_draws(impulse, rng)
    near = float(np.median(drawn))
    sd = max(r.time_sd_s for r in read)
    lag = Interval.of_draws(near, drawn + sd * rng.standard_normal(len(drawn)))
    fresh = _later(lag, command_hold(trials))
    around = fresh.value - _USUAL_SHIFT_S, fresh.value + _USUAL_SHIFT_S
    shifts = [
        (len(r.rows), row_shift(t, t.read_time_s, t.position_rad, *around)
         - row_shift(t, r.time_s, r.position_rad, *around))
        for t, r in zip(trials, read, strict=True)
    ]  # fmt: skip
    count, age = np.array([s for s in shifts if np.isfinite(s[1])] or [(1.0, 0.0)]).T
    return _Seen([], near, _later(fresh, float(np.average(age, weights=count))), fresh, lag)


def _warnings(joint: str, seen: _Seen) -> list[str]:
    tones, lag, warnings = seen.tones, seen.lag, []
    if not tones:
        warnings.append(
            f"{joint}: no tones in this recording, so the lag is the time shift of its held "
            "command that resembles the motion best. Record a sweep for a lag per frequency."
        )
    lost = [t for t, w in zip(tones, tone_weights(tones), strict=True) if w == 0] if tones else []
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
    if not EARLIEST_S + _NEAR_END_S < lag.low <= lag.high < LONGEST_S - _NEAR_END_S:
        warnings.append(
            f"{joint}: the lag's interval reaches the end of its search range "
            f"({1e3 * EARLIEST_S:.0f} to {1e3 * LONGEST_S:.0f} ms), so the lag is not identified."
        )
    return warnings


def _later(interval: Interval, by: float) -> Interval:
    return Interval(interval.value + by, interval.low + by, interval.high + by)


def _hull(one: Interval, other: Interval) -> Interval:
    return Interval(one.value, min(one.low, other.low), max(one.high, other.high))


def estimators(
    trials: Sequence[Trial], read: Sequence[Readings], tones: Sequence[ToneResponse], lag_s: float
) -> dict[str, float]:
    """All estimators side by side, each the mean over trials [s]; `lag_s` is the budget's."""
    pairs = list(zip(trials, read, strict=True))
    each = {
        "integer cross-correlation, all rows": [_integer(t, None) for t in trials],
        "integer cross-correlation, fresh rows": [_integer(t, r.rows) for t, r in pairs],
        "sub-sample cross-correlation, all rows": [
            row_shift(t, t.read_time_s, t.position_rad, 0.0, _longest(t)) for t in trials
        ],
        "sub-sample cross-correlation, fresh rows": [
            row_shift(t, r.time_s, r.position_rad, 0.0, _longest(t)) for t, r in pairs
        ],
    }
    frequency = np.array([t.frequency_hz for t in tones])
    for pair, name in (("raw_rows", "all rows"), ("fresh_rows", "fresh rows")):
        lags = list(tone_lags(responses(tones, pair)[0], frequency)) if tones else []
        each[f"sine phase, {name}"] = lags
    result = {
        k: float(np.nanmean(v)) if np.isfinite(v).any() else float("nan") for k, v in each.items()
    }
    if tones:
        result["phase slope, all rows"] = slope(tones, "raw_rows").value
        result["phase slope, fresh rows"] = slope(tones, "fresh_rows").value
        result["hold-aware (default)"] = lag_s
    return result


def _longest(trial: Trial) -> float:
    return min(LONGEST_S, 1.0 / trial.frequency_hz if trial.frequency_hz > 0 else LONGEST_S)


def _integer(trial: Trial, rows: NDArray | None) -> float:
    """Lag in whole loop periods at which raw correlation peaks [s]."""
    c = trial.command_rad - trial.command_rad.mean()
    loop = float(np.median(np.diff(trial.send_time_s)))
    shifts = np.arange(0, max(2, min(int(_longest(trial) / loop), len(c) // 2)))
    rows = np.flatnonzero(np.isfinite(trial.position_rad)) if rows is None else rows
    rows = rows[rows >= shifts[-1]]
    if len(rows) < 8:
        return float("nan")
    y = trial.position_rad[rows] - trial.position_rad[rows].mean()
    return float(shifts[int(np.argmax([np.sum(y * c[rows - s]) for s in shifts]))] * loop)


EARLIEST_S = -0.05  # search range of a lag: from here to `LONGEST_S`

_STEP_S = 0.002
_NEAR_S = 0.2
_MOST_ROWS = 4000

_Product = tuple[NDArray[np.float64], NDArray[np.float64]]


def shift_draws(response: ImpulseResponse, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draws of the lag that impulse responses and the recording's own command give [s].

    Where the motion resembles its command most, upright: of a fast motion the gain at standstill,
    and with it a sign, is not known.

    `rng` draws where the mass within a bin sits.
    """
    edges, masses = response.edges_s, response.masses
    everywhere, alike = _resemblance(response)
    centre = everywhere[int(np.argmax(alike))]
    products = [s.autocorrelation(LONGEST_S + edges[-1]) for s in response.stretches]
    shift = np.arange(max(EARLIEST_S, centre - _NEAR_S), min(LONGEST_S, centre + _NEAR_S), _STEP_S)
    command = _correlation(products, edges, shift)
    draws, blocks = response.weights.shape
    mixed = (response.weights @ command.reshape(blocks, -1)).reshape(draws, *command.shape[1:])
    lag = _peaks(np.einsum("dj,djt->dt", masses, mixed), shift)
    # the response is constant within a bin; a jump may be anywhere in it
    share = np.sqrt(np.sum((masses * np.diff(edges)) ** 2, axis=1) / 12)
    share /= np.maximum(np.abs(masses.sum(axis=1)), 0.1)
    lag = lag + share * rng.standard_normal(draws)
    # few blocks: Student's quantile instead of the normal one
    wider = stdtrit(max(blocks - 1, 1), (1 + LEVEL) / 2) / stdtrit(1e6, (1 + LEVEL) / 2)
    return np.median(lag) + wider * (lag - np.median(lag))


def _resemblance(response: ImpulseResponse) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Correlation of the motion with the command, all over the search range: shifts [s], values.

    Of the mean response: draws differ in where they begin, and medians of single bins are none.
    """
    products = [s.autocorrelation(LONGEST_S + response.edges_s[-1]) for s in response.stretches]
    shifts = np.arange(EARLIEST_S, LONGEST_S, 2.5 * _STEP_S)
    command = _correlation(products, response.edges_s, shifts).sum(axis=0)
    return shifts, response.masses.mean(axis=0) @ command


def _correlation(
    products: Sequence[_Product], edges: NDArray, shift_s: NDArray
) -> NDArray[np.float64]:
    """Correlation of the command with its mean over each bin, shape (blocks, bins, shifts)."""
    before = shift_s - edges[:, None]
    parts = []
    for time, product in products:
        step = time[1] - time[0]
        pieces = 0.5 * step * (product[:, 1:] + product[:, :-1])
        area = np.concatenate([np.zeros((len(product), 1)), np.cumsum(pieces, axis=1)], axis=1)
        at = (before - time[0]) / step
        row = np.clip(at.astype(int), 0, len(time) - 2)
        part = np.clip(at - row, 0.0, 1.0)
        inside = area[:, row] + part * (area[:, row + 1] - area[:, row])
        parts.append((inside[:, :-1] - inside[:, 1:]) / np.diff(edges)[:, None])
    return np.concatenate(parts)


def _peaks(score: NDArray, shift: NDArray) -> NDArray[np.float64]:
    """Position of the maximum of each row, refined by the parabola through its top."""
    k = np.clip(np.argmax(score, axis=1), 1, len(shift) - 2)
    row = np.arange(len(score))
    before, top, after = score[row, k - 1], score[row, k], score[row, k + 1]
    bend = before - 2 * top + after
    part = 0.5 * (before - after) / np.where(bend < 0, bend, -np.inf)
    return shift[k] + np.clip(part, -1.0, 1.0) * (shift[1] - shift[0])


def command_hold(trials: Sequence[Trial]) -> float:
    """By how much the held command lags the line through its rows, weighted by its motion [s].

    Half a loop where the loop is even.
    """
    gap = np.concatenate([np.diff(t.send_time_s) for t in trials])
    moved = np.concatenate([np.diff(t.command_rad) for t in trials]) ** 2
    moved = moved if moved.sum() > 0 else np.ones(len(gap))
    return float(0.5 * moved.sum() / np.sum(moved / gap))


def row_shift(
    trial: Trial, time_s: NDArray, position_rad: NDArray, earliest_s: float, latest_s: float
) -> float:
    """Shift at which readings correlate best with the line through the rows' commands [s].

    Readings may be NaN; with fewer than 8 others the shift is NaN.
    """
    here = np.flatnonzero(np.isfinite(position_rad))
    if len(here) < 8:
        return float("nan")
    here = here[:: len(here) // _MOST_ROWS + 1]  # bounded, however long the recording
    shift = np.arange(earliest_s, max(latest_s, earliest_s + 4 * _STEP_S), _STEP_S)
    past = np.interp(time_s[here, None] - shift, trial.send_time_s, trial.command_rad)
    past -= past.mean(axis=0)
    y = position_rad[here] - position_rad[here].mean()
    scale = np.sqrt(np.maximum(np.sum(past**2, axis=0), 1e-18))
    return float(_peaks((y @ past / scale)[None], shift)[0])
