"""Checks of a joint's command and position signals, for the doctor.

A finding is a verdict and a sentence that says what to do. `unusable` has the faults that make
every number wrong, `doubtful` those that ask for care.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.tones import fit_sine
from pupper_sysid.sysid.feedback.poll_lattice import fresh_rows
from pupper_sysid.sysid.recordings.recording import Trial

USE, CARE, REFUSE = "use", "use with care", "do not use"

_DEGREES = 180 / np.pi
_COARSEST_RAD = 0.05  # no servo has a quantisation step of three degrees
_LARGEST_RAD = 3.3  # no joint of a legged robot turns further from zero
_FASTEST_RAD_S = 40.0  # twice what a good servo of this size does
_SLOW_HZ = 2.5  # below it a lag of 0.2 s is less than half a period
_SHIFT_S = 0.05
_PINNED = (0.10, 0.20)  # share of readings at an extreme, beyond the command's own


@dataclass(frozen=True)
class Finding:
    """A verdict on a joint and the sentence that goes with it."""

    verdict: str
    text: str


def unusable(joint: str, trials: Sequence[Trial], step: float) -> list[Finding]:
    """The first fault found that makes every number of this joint wrong.

    Parameters
    ----------
    joint : str
    trials : sequence of Trial
        All of this joint, three rows or more each.
    step : float
        Quantisation step [rad].
    """
    command = np.concatenate([t.command_rad for t in trials])
    position = np.concatenate([t.position_rad for t in trials])
    position = position[np.isfinite(position)]
    text = None
    if not len(position):
        text = ("there is no reading at all: check the servo's plug, id and power, then record "
                "again.")  # fmt: skip
    elif np.ptp(command) < 1e-3:
        text = (f"the command never changes: {joint} was not swept. Record it with "
                "`pupper-sysid sweep`.")  # fmt: skip
    elif np.ptp(position) < max(3 * step, 5e-3):
        text = ("the command moves and the reading does not: torque off, wrong servo id, or a "
                "servo that no longer answers. Power it again and look at it move.")  # fmt: skip
    elif (column := _in_degrees(trials, step)) is not None:
        text = f"{column} like degrees. Multiply them by 0.0174533 and run this again."
    elif _swapped(trials):
        text = ("the position moves before the command does: the columns command_rad and "
                "position_rad look swapped. Swap them back.")  # fmt: skip
    return [Finding(REFUSE, text)] if text else []


def doubtful(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Faults that leave the recording usable with care."""
    found = []
    ratio = amplitude_ratio(trials)
    if ratio < 0.3 or ratio > 3:
        found.append(Finding(CARE, f"the joint moves {ratio:.2f} times as far as commanded: check "
                                   "the scale (counts per radian) and mechanical stops, or "
                                   "record slower tones."))  # fmt: skip
    # friction flattens the tops of a slow tone; a stop does it in every trial, or by more
    excess = [_pinned(t, step) for t in trials]
    pinned = [e for e in excess if e > _PINNED[0]]
    if max(excess) < _PINNED[1] and 2 * len(pinned) <= len(trials):
        pinned = []
    if pinned:
        found.append(Finding(CARE, f"readings stay at their highest or lowest value in "
                                   f"{len(pinned)} of {len(trials)} trials, up to "
                                   f"{100 * max(pinned):.0f} % of the time more than the command "
                                   "does: a limit or a mechanical stop clips the motion. Record "
                                   "with a smaller amplitude."))  # fmt: skip
    away = abs(offset(trials))
    if away > 0.1:
        found.append(Finding(USE, f"readings are offset by {away:.3f} rad from the commands; the "
                                  "offset is fitted, but check the joint's zero."))  # fmt: skip
    return found


def amplitude_ratio(trials: Sequence[Trial]) -> float:
    """Range of the position over range of the command, median over the trials that move."""
    ratios = [
        np.ptp(t.position_rad[seen]) / np.ptp(t.command_rad)
        for t in trials
        if (seen := np.isfinite(t.position_rad)).any() and np.ptp(t.command_rad) > 1e-3
    ]
    return float(np.median(ratios)) if ratios else float("nan")


def offset(trials: Sequence[Trial]) -> float:
    """Mean of the fresh readings minus mean of the command [rad].

    Of a tone, the constant beside a sine fitted over its last whole periods, where neither the
    onset nor a cut period leans on the mean; tones weigh by their fresh readings. Without tones,
    of all rows.
    """
    tones = [o for t in trials if t.frequency_hz > 0 and (o := _tone_offset(t)) is not None]
    if tones:
        value, weight = np.transpose(tones)
        return float(np.average(value, weights=weight))
    seen = [np.isfinite(t.position_rad) for t in trials]
    away = [(t.position_rad - t.command_rad)[s] for t, s in zip(trials, seen, strict=True)]
    every = np.concatenate(away)
    return float(every.mean()) if len(every) else float("nan")


def peak_speed(trials: Sequence[Trial]) -> float:
    """Fastest command over a loop period or 20 ms, whichever is longer [rad/s]."""
    peaks = [0.0]
    for t in trials:
        loop = max(float(np.median(np.diff(t.send_time_s))), 1e-4)
        width = min(max(1, round(0.02 / loop)), len(t.send_time_s) - 1)
        time = np.maximum(t.send_time_s[width:] - t.send_time_s[:-width], 1e-4)
        peaks.append(float(np.max(np.abs(t.command_rad[width:] - t.command_rad[:-width]) / time)))
    return max(peaks)


def _in_degrees(trials: Sequence[Trial], step: float) -> str | None:
    """Which column looks like degrees, as the beginning of a sentence."""
    ratio = amplitude_ratio(trials)
    if 0.7 * _DEGREES < ratio < 1.4 * _DEGREES:
        return f"positions are {ratio:.0f} times as large as commands, which looks"
    if 0.7 * _DEGREES < 1 / max(ratio, 1e-9) < 1.4 * _DEGREES:
        return f"commands are {1 / ratio:.0f} times as large as positions, which looks"
    largest = max(float(np.max(np.abs(t.command_rad))) for t in trials)
    if largest > _LARGEST_RAD:
        return f"commands reach {largest:.1f}, which no joint can do in radians: they look"
    speeds = [2 * np.pi * t.frequency_hz * np.ptp(t.command_rad) / 2 for t in trials
              if t.frequency_hz > 0]  # fmt: skip
    if speeds and max(speeds) > _FASTEST_RAD_S:
        return f"tones reach {max(speeds):.0f} rad/s, faster than any servo: angles look"
    if step > _COARSEST_RAD:
        return f"readings come in steps of {step:.2f}, too coarse for radians: they look"
    return None


def _swapped(trials: Sequence[Trial]) -> bool:
    """Whether the position is ahead of the command.

    Faster tones wrap: half a period late looks like early. Where there are only such, the column
    that is held must be the one called the command as well.
    """
    slow = [t for t in trials if not t.frequency_hz > _SLOW_HZ]
    if slow:
        return _lead(slow) > 0
    return _lead(trials) > 0 and _changes(trials, "command_rad") < 0.8 * _changes(
        trials, "position_rad"
    )


def _lead(trials: Sequence[Trial]) -> float:
    """Correlation of the position with the command to come, minus that with the command past."""
    total = 0.0
    for t in trials:
        seen = np.isfinite(t.position_rad)
        reach = max(1, round(_SHIFT_S / max(float(np.median(np.diff(t.send_time_s))), 1e-4)))
        if seen.mean() < 0.5 or len(seen) < 4 * reach:
            continue
        y = np.where(seen, t.position_rad - t.position_rad[seen].mean(), 0.0)
        u = t.command_rad - t.command_rad.mean()
        total += float(y[:-reach] @ u[reach:] - y[reach:] @ u[:-reach])
    return total


def _changes(trials: Sequence[Trial], column: str) -> float:
    return float(np.mean(np.concatenate([np.diff(getattr(t, column)) != 0 for t in trials])))


def _pinned(trial: Trial, step: float) -> float:
    """Share of readings at an extreme of the trial, beyond the share of the command at its own."""
    position = trial.position_rad[np.isfinite(trial.position_rad)]
    if len(position) < 20 or np.ptp(position) < 10 * max(step, 1e-6):
        return 0.0
    near = max(1.5 * step, 0.01 * float(np.ptp(position)))

    def dwell(value: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([np.mean(value < value.min() + near), np.mean(value > value.max() - near)])

    return float(np.max(dwell(position) - dwell(trial.command_rad)))


def _tone_offset(trial: Trial) -> tuple[float, int] | None:
    rows, end = fresh_rows(trial), trial.send_time_s[-1]
    periods = np.floor((end - trial.send_time_s[0]) * trial.frequency_hz) - 1
    if periods < 1:
        return None
    start = end - periods / trial.frequency_hz
    rows = rows[trial.read_time_s[rows] > start]
    if len(rows) < 8:
        return None

    def constant(time: NDArray[np.float64], value: NDArray[np.float64]) -> float:
        return float(fit_sine(2 * np.pi * trial.frequency_hz * time, value).offset)

    sent = trial.send_time_s > start
    command = constant(trial.send_time_s[sent], trial.command_rad[sent])
    return constant(trial.read_time_s[rows], trial.position_rad[rows]) - command, len(rows)
