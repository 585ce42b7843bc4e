"""Checks of command and position, each on its own: units, wraps, spikes, stops, interpolation.

Every check takes the trials of one joint and its quantisation step, and returns findings. Limits
come from the step, from the loop and from what servos can do, which the constants state.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.tones import fit_sine
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, USE, Finding
from pupper_sysid.sysid.feedback.rows import fresh_rows
from pupper_sysid.sysid.recordings.recording import Trial

_COARSEST_RAD = 0.055  # no servo has a quantisation step of three degrees
_LARGEST_RAD = 3.3  # no joint of a legged robot turns further from zero
_FASTEST_RAD_S, _FAST_RAD_S = 60.0, 20.0  # three times and what a good servo of this size does
_LEVELS = 10  # values of a reading, from which on a coarse step is that of an encoder
_ENCODER_BITS = range(10, 17)
_SAME_STEP = 0.002
_PINNED = (0.10, 0.20)  # share of readings at an extreme, beyond the command's own
_NOTED_RAD, _FAR_RAD, _TURNED_RAD = 0.1, 1.3, 2.9  # of an offset; the last is nearly half a turn
_ENOUGH_TRIALS = 3
_WRAP_RAD, _UNUSUAL = 2.5, 8.0
_FEW_STEPS = 8
_FROZEN_S, _LATE_S, _FROZEN_SHARE = 1.0, 0.5, 0.5
_SPIKES = 0.002  # share of readings
_STRAIGHT, _SLOPES = 0.25, 0.3


def motion_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Whether there is a command that moves and a position that does."""
    command = np.concatenate([t.command_rad for t in trials])
    position = np.concatenate([t.position_rad for t in trials])
    position = position[np.isfinite(position)]
    if not len(position):
        text = ("there is no reading at all: check the servo's plug, id and power, then record "
                "again.")  # fmt: skip
    elif np.ptp(command) < 1e-3:
        text = (f"the command never changes: {trials[0].joint} was not swept. Record it with "
                "`pupper-sysid sweep`.")  # fmt: skip
    elif np.ptp(position) < max(3 * min(step, _COARSEST_RAD), 5e-3):
        text = ("the command moves and the reading does not: torque off, wrong servo id, or a "
                "servo that no longer answers. Power it again and look at it move.")  # fmt: skip
    else:
        if np.ptp(position) >= _FEW_STEPS * step:
            return []
        return [Finding(CARE, f"the joint moves by {np.ptp(position) / step:.0f} quantisation "
                              "steps only. Record with a larger amplitude.")]  # fmt: skip
    return [Finding(REFUSE, text)]


def unit_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Angles that cannot be radians, whatever their amplitude, unless their unit is stated."""
    if all(t.unit_stated for t in trials):
        return []
    cure = "Angles must be radians: multiply degrees by 0.0174533."
    largest = max(float(np.max(np.abs(t.command_rad))) for t in trials)
    if largest > _LARGEST_RAD:
        text = f"commands reach {largest:.1f}, which no joint can do in radians: they look"
    elif step > _COARSEST_RAD and _levels(trials) >= _LEVELS:
        text = f"readings come in steps of {step:.3g}, too coarse for radians: they look"
    elif (speed := _speed(trials)) > _FASTEST_RAD_S:
        text = f"the joint moves at {speed:.0f} rad/s, faster than any servo: angles look"
    elif speed > _FAST_RAD_S:
        return [Finding(CARE, f"the joint moves at {speed:.0f} rad/s, faster than servos of this "
                              f"size do. {cure}")]  # fmt: skip
    elif bits := _degree_encoder(step):
        return [Finding(CARE, f"readings come in steps of {step:.5g}, which is a turn of 360 over "
                              f"2^{bits}: they look like degrees. {cure}")]  # fmt: skip
    else:
        return []
    return [Finding(REFUSE, f"{text} like degrees. {cure}")]


def wrap_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Jumps that no servo can make: a wrapped angle, or single wrong readings."""
    turns = spikes = rows = 0
    for t in trials:
        seen = np.flatnonzero(np.isfinite(t.position_rad))
        value, time = t.position_rad[seen], t.read_time_s[seen]
        rows += len(seen)
        new = np.concatenate([[0], np.flatnonzero(np.diff(value)) + 1]) if len(value) else []
        if len(new) < 4:
            continue
        # a held value may be old: the jump took as long as nothing new was read
        move = np.diff(value[new])
        taken = np.maximum(np.diff(time[new]), 1e-6)
        usual = _UNUSUAL * float(np.median(np.abs(move)))
        far = np.abs(move) > np.maximum(_FASTEST_RAD_S * taken, max(5 * step + 0.2, usual))
        returned = np.abs(move[:-1] + move[1:]) < 0.3 * np.abs(move[:-1])
        back = far[:-1] & far[1:] & returned
        spikes += int(back.sum())
        lone = far.copy()
        lone[:-1] &= ~back
        lone[1:] &= ~back
        turns += int(np.sum(lone & (np.abs(move) > _WRAP_RAD)))
    found = []
    if turns:
        found.append(Finding(REFUSE, f"readings jump by about a turn {turns} times within a row, "
                                     "which looks like an angle wrapped at ±π or at the encoder's "
                                     "end. Unwrap it (numpy.unwrap), or mount the horn so that "
                                     "the range is not crossed."))  # fmt: skip
    if spikes:
        share = spikes / max(rows, 1)
        found.append(Finding(REFUSE if share > 10 * _SPIKES else CARE,
                             f"{spikes} single readings lie farther away than a servo can move: "
                             "wrong bytes from the bus. Leave them empty, and check cable and "
                             "baud rate."))  # fmt: skip
    return found


def frozen_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Readings that stop changing while the command goes on, or do not change in some trials."""
    longest = [_frozen_s(t) for t in trials]
    found, frozen = [], sum(s > 0 for s in longest)
    if frozen:
        found.append(Finding(REFUSE if 2 * frozen > len(trials) else CARE,
                             f"in {frozen} of {len(trials)} trials the reading stays the same for "
                             f"up to {max(longest):.1f} s while the command moves on: the servo no "
                             "longer answered, or its torque was off. Record these trials "
                             "again."))  # fmt: skip
    still = _still(trials, step)
    if still:
        found.append(Finding(REFUSE if 2 * len(still) > len(trials) else CARE,
                             f"the reading does not move in trial{'s' if still[1:] else ''} "
                             f"{', '.join(map(str, still[:5]))}, and does in others that are no "
                             "slower: the servo no longer answered, or its torque was off. Record "
                             "again."))  # fmt: skip
    return found


def interpolation_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Positions that were interpolated on a straight line between readings."""
    if step > 0:
        return []  # a drawn line would not stay on the encoder's steps
    straight = total = 0
    slopes = []
    for t in trials:
        value, time = t.position_rad, t.read_time_s
        rate = np.diff(value) / np.maximum(np.diff(time), 1e-9)
        tops = max(float(np.nanmax(np.abs(rate))) if np.isfinite(rate).any() else 0.0, 1e-9)
        moving = np.abs(rate[1:]) > 0.02 * tops
        same = moving & (np.abs(np.diff(rate)) < 1e-4 * tops)
        straight, total = straight + int(same.sum()), total + int(moving.sum())
        slopes.append(np.round(rate[1:][same] / tops, 3))
    if straight < 30 or straight < _STRAIGHT * total:
        return []
    _, often = np.unique(np.concatenate(slopes), return_counts=True)
    if often.max() > _SLOPES * straight:
        return []  # a servo at its speed limit moves straight as well, always at one rate
    return [Finding(CARE, f"{100 * straight / total:.0f} % of the positions lie on straight lines "
                          "between others: the log was interpolated, and when its readings were "
                          "taken is lost. Use the log as it was recorded.")]  # fmt: skip


def stop_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Readings that stay at an extreme: a mechanical stop, a limit, a saturated encoder."""
    # friction flattens the tops of a slow tone; a stop does it in every trial, or by more. A known
    # load stands still where friction holds it
    excess = [_pinned(t, step) for t in trials if t.load is None]
    pinned = [e for e in excess if e > _PINNED[0]]
    often = 2 * len(pinned) > len(excess) >= _ENOUGH_TRIALS
    if not pinned or (max(excess) < _PINNED[1] and not often):
        return []
    return [Finding(CARE, f"readings stay at their highest or lowest value in {len(pinned)} of "
                          f"{len(trials)} trials, up to {100 * max(pinned):.0f} % of the time more "
                          "than the command does: a limit or a mechanical stop clips the motion. "
                          "Record with a smaller amplitude.")]  # fmt: skip


def offset_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """A constant between command and reading: the joint's zero, or a whole turn."""
    away = offset(trials)
    if not abs(away) > _NOTED_RAD or any(t.load is not None for t in trials):
        return []  # a known load sags; the fit under load finds the zero
    if abs(away) > _TURNED_RAD:
        return [Finding(REFUSE, f"readings are {away:.2f} rad away from the commands, half a turn "
                                "or more: the encoder's zero or a multiple of 2π. Subtract it from "
                                "`position_rad`, or calibrate the joint's zero.")]  # fmt: skip
    return [Finding(CARE if abs(away) > _FAR_RAD else USE,
                    f"readings are offset by {away:.3f} rad from the commands; the offset is "
                    "fitted, but check the joint's zero.")]  # fmt: skip


def start_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """A header that says the joint starts where it does not."""
    first = min(trials, key=lambda t: t.send_time_s[0])
    seen = np.flatnonzero(np.isfinite(first.position_rad))
    rest, began = first.initial_command_rad, first.command_rad[0]
    if not len(seen) or rest == began:
        return []
    stands = first.position_rad[seen[0]] - offset(trials)
    reach = max(float(np.ptp(first.command_rad)), _NOTED_RAD)
    if abs(rest - stands) < reach or abs(rest - began) < reach:
        return []
    return [Finding(CARE, f"`start_pose_rad` is {rest:.2f}, and the joint stands at {stands:.2f} "
                          "rad when the first trial begins. Correct the header, or leave the pose "
                          "out.")]  # fmt: skip


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


def _speed(trials: Sequence[Trial]) -> float:
    """Speed of the position that one row in ten exceeds, in the fastest trial [rad/s]."""
    fastest = 0.0
    for t in trials:
        seen = np.isfinite(t.position_rad)
        value, time = t.position_rad[seen], t.read_time_s[seen]
        width = max(1, int(np.searchsorted(time - time[0], 0.04))) if len(time) else 1
        if len(value) <= 4 * width:
            continue
        rate = np.abs(value[width:] - value[:-width]) / np.maximum(
            time[width:] - time[:-width], 1e-6
        )
        fastest = max(fastest, float(np.quantile(rate, 0.9)))
    return fastest


def _levels(trials: Sequence[Trial]) -> int:
    return len(np.unique(np.concatenate([t.position_rad for t in trials])))


def _still(trials: Sequence[Trial], step: float) -> list[int]:
    """Numbers of the trials whose joint rests where, in another as fast, it follows."""
    spans = []
    for t in trials:
        seen = t.position_rad[np.isfinite(t.position_rad)]
        command = float(np.ptp(t.command_rad))
        moved = float(np.ptp(seen)) if len(seen) else 0.0
        spans.append((t, command, moved))
    least = max(3 * min(step, _COARSEST_RAD), 2e-3)
    follow = [(t, c) for t, c, m in spans if m > 0.5 * c > 5 * least]
    return [
        t.number
        for t, command, moved in spans
        if moved < least
        and any(command > 0.9 * c and not t.frequency_hz > f.frequency_hz + 1e-6 for f, c in follow)
    ]


def _degree_encoder(step: float) -> int:
    """Bits of the encoder whose step in degrees this is; 0 if it is none."""
    for bits in _ENCODER_BITS:
        if abs(step * 2**bits / 360 - 1) < _SAME_STEP:
            return bits
    return 0


def _frozen_s(trial: Trial) -> float:
    """Longest time for which the reading stays while the command moves over half of its range [s].

    Only in a trial whose joint otherwise follows by half as far or more. The last half second of
    commands does not count: a late servo has yet to follow them.
    """
    seen = np.flatnonzero(np.isfinite(trial.position_rad))
    position, command = trial.position_rad[seen], trial.command_rad[seen]
    span = float(np.ptp(command)) if len(seen) else 0.0
    if len(seen) < 20 or np.ptp(position) < 0.5 * span or span < 1e-3:
        return 0.0
    time = trial.read_time_s[seen]
    edges = np.concatenate([[0], np.flatnonzero(np.diff(position)) + 1, [len(position)]])
    longest = 0.0
    for first, last in pairwise(edges):
        lasts = float(time[last - 1] - time[first])
        if lasts <= max(_FROZEN_S, longest):
            continue
        owed = np.searchsorted(time, time[last - 1] - _LATE_S)
        if np.ptp(command[first : max(owed, first + 1)]) > _FROZEN_SHARE * span:
            longest = lasts
    return longest


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
