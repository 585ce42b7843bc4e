"""Checks of time stamps, command and position, each on its own.

Every check takes the trials of one joint and its quantisation step, and returns findings. Limits
come from the step, from the loop and from what servos can do, which the constants state.
Checks of time stamps run before anything whose memory or time grows with the recorded time.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.tones import fit_sine, least_squares, sine_design
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, USE, Finding
from pupper_sysid.sysid.feedback.staleness import fresh_rows
from pupper_sysid.sysid.recordings.recording import Trial

COARSEST_RAD = 0.055  # no servo has a quantisation step of three degrees
_LARGEST_RAD = 3.3  # no joint of a legged robot turns further from zero
_FASTEST_RAD_S, _FAST_RAD_S = 60.0, 20.0  # three times and what a good servo of this size does
_LEVELS = 10  # values of a reading, from which on a coarse step is that of an encoder
_ENCODER_BITS = range(10, 16)  # of a turn: finer steps are those of radians, too
_SAME_STEP = 0.002
_NOTED_RAD, _FAR_RAD, _TURNED_RAD = 0.1, 1.3, 2.9  # of an offset; the last is nearly half a turn
_FEW_STEPS = 8
_FROZEN_S, _LATE_S, _FROZEN_SHARE = 1.0, 0.5, 0.5
_STRAIGHT, _SLOPES = 0.25, 0.3


def motion_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Whether there is a command that moves and a position that does."""
    command = np.concatenate([t.command_rad for t in trials])
    position = np.concatenate([t.position_rad for t in trials])
    position = position[np.isfinite(position)]
    if not len(position):
        return [Finding("no_readings", REFUSE)]
    if np.ptp(command) < 1e-3:
        return [Finding("constant_command", REFUSE, {"joint": trials[0].joint})]
    if np.ptp(position) < max(3 * min(step, COARSEST_RAD), 5e-3):
        return [Finding("does_not_move", REFUSE)]
    if np.ptp(position) < _FEW_STEPS * step:
        return [Finding("few_steps", CARE, {"steps": np.ptp(position) / step})]
    return []


def unit_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Angles that cannot be radians, whatever their amplitude, unless their unit is stated."""
    whole_turn = abs(abs(offset(trials)) - 2 * np.pi) < _NOTED_RAD  # the zero, not the unit
    if whole_turn or all(t.unit_stated for t in trials):
        return []
    cure = "Angles must be radians: multiply degrees by 0.0174533."
    largest = max(float(np.max(np.abs(t.command_rad))) for t in trials)
    position = np.concatenate([t.position_rad for t in trials])
    if largest > _LARGEST_RAD:
        text = f"commands reach {largest:.1f}, which no joint can do in radians: they look"
    elif step > COARSEST_RAD and len(np.unique(position)) >= _LEVELS:
        text = f"readings come in steps of {step:.3g}, too coarse for radians: they look"
    elif (speed := _speed(trials)) > _FASTEST_RAD_S:
        text = f"the joint moves at {speed:.0f} rad/s, faster than any servo: angles look"
    elif speed > _FAST_RAD_S:
        return [Finding("fast_joint", CARE, {"speed_rad_s": speed, "cure": cure})]
    elif bits := _degree_encoder(step):
        return [Finding("degrees_by_step", CARE, {"step": step, "bits": bits, "cure": cure})]
    else:
        return []
    return [Finding("degrees", REFUSE, {"evidence": text, "cure": cure})]


def frozen_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Readings that stop changing while the command goes on, or do not change in some trials."""
    longest = [_frozen_s(t) for t in trials]
    findings, frozen = [], sum(s > 0 for s in longest)
    if frozen:
        values = {"trials": frozen, "of": len(trials), "longest_s": max(longest)}
        findings.append(Finding("frozen", REFUSE if 2 * frozen > len(trials) else CARE, values))
    if still := _still(trials, step):
        verdict = REFUSE if 2 * len(still) > len(trials) else CARE
        values = {"plural": "s" if still[1:] else "", "trials": ", ".join(map(str, still[:5]))}
        findings.append(Finding("still_trials", verdict, values))
    return findings


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
    return [Finding("interpolated", CARE, {"percent": 100 * straight / total})]


def offset_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """A constant between command and reading: the joint's zero, or a whole turn."""
    away = offset(trials)
    if not abs(away) > _NOTED_RAD or any(t.load is not None for t in trials):
        return []  # a known load sags; the fit under load finds the zero
    if abs(away) > _TURNED_RAD:
        return [Finding("turned", REFUSE, {"offset_rad": away})]
    return [Finding("offset", CARE if abs(away) > _FAR_RAD else USE, {"offset_rad": away})]


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
    return [Finding("start_pose", CARE, {"header_rad": rest, "stands_rad": stands})]


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


def _still(trials: Sequence[Trial], step: float) -> list[int]:
    """Numbers of the trials whose joint rests where, in another as fast, it follows."""
    spans = []
    for t in trials:
        seen = t.position_rad[np.isfinite(t.position_rad)]
        command = float(np.ptp(t.command_rad))
        moved = float(np.ptp(seen)) if len(seen) else 0.0
        spans.append((t, command, moved))
    least = max(3 * min(step, COARSEST_RAD), 2e-3)
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


LONGEST_S = 7200.0
"""Longest recorded time of a joint [s]: 3.6 million physics steps."""

_SLOWEST_LOOP_S = 0.5  # a servo has come to rest between two rows
_FASTEST_LOOP_S = 2e-5  # no bus carries a command and a reading in less
_UNEVEN = 0.2  # of the loop period
_LONG_GAP = 3.0  # loop periods
_LOST_TIME = 0.25  # share of the recorded time that may lie in gaps
_DISORDER = 0.1  # share of rows
_READ_APART_S, _READ_APART_LOOPS = 0.2, 5.0
_READ_EARLY_LOOPS, _READ_EARLY_S = 1.5, 0.005  # a turn that reads first is one loop early
_ROWS_PER_PERIOD = 2.2  # with two a tone and its mirror image look alike
_IS_TONE = 0.5  # of the command's variance; a square wave has 0.81
_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}


def disorder(trial: Trial) -> int:
    """Rows whose send or read time is not later than that of the row before."""
    return int(np.sum((np.diff(trial.send_time_s) <= 0) | (np.diff(trial.read_time_s) <= 0)))


def clock_findings(trials: Sequence[Trial]) -> list[Finding]:
    """Faults of the time stamps of one joint, three rows or more per trial."""
    gaps = np.concatenate([np.diff(t.send_time_s) for t in trials])
    loop = float(np.median(gaps))
    spans = np.array([t.send_time_s[-1] - t.send_time_s[0] for t in trials])
    findings = [*_unit(loop), *_budget(spans), *_order(trials, gaps)]
    if any(f.verdict == REFUSE for f in findings):
        return findings
    return [*findings, *_two_clocks(trials, loop), *_gaps(gaps, loop)]


def _unit(loop: float) -> list[Finding]:
    if not np.isfinite(loop) or loop > _SLOWEST_LOOP_S:
        unit, scale = next(
            (u for u in _UNITS.items() if _FASTEST_LOOP_S < loop / u[1] <= _SLOWEST_LOOP_S / 2),
            ("", 1.0),
        )
        cure = (f"They look like {unit}: divide them by {scale:g}." if unit
                else "Times must be seconds, with 10 rows or more per second.")  # fmt: skip
        return [Finding("loop_too_slow", REFUSE, {"loop_s": loop, "cure": cure})]
    if 0 < loop < _FASTEST_LOOP_S:
        return [Finding("loop_too_fast", REFUSE, {"loop_us": 1000000.0 * loop})]
    return []


def _budget(spans: NDArray[np.float64]) -> list[Finding]:
    longest, total = float(spans.max()), float(spans.sum())
    if not total <= LONGEST_S:
        where = "its longest trial spans" if longest > LONGEST_S else "its trials together span"
        span = longest if longest > LONGEST_S else total
        return [Finding("too_long", REFUSE, {"where": where, "span_s": span, "most_s": LONGEST_S})]
    return []


def _order(trials: Sequence[Trial], gaps: NDArray[np.float64]) -> list[Finding]:
    wrong = sum(disorder(t) for t in trials)
    if not wrong:
        return []
    verdict = REFUSE if wrong > _DISORDER * len(gaps) else CARE
    return [Finding("disordered_times", verdict, {"rows": wrong})]


def _two_clocks(trials: Sequence[Trial], loop: float) -> list[Finding]:
    apart = np.concatenate([t.read_time_s - t.send_time_s for t in trials])
    middle = float(np.median(apart))
    if abs(middle) > max(_READ_APART_S, _READ_APART_LOOPS * loop):
        return [Finding("two_clocks", REFUSE, {"apart_s": middle})]
    early = -middle
    if early > max(_READ_EARLY_S, _READ_EARLY_LOOPS * loop):
        return [Finding("read_early", CARE, {"early_ms": 1000.0 * early, "loops": early / loop})]
    doubt_ms = 1e3 * max(t.read_time_doubt_s for t in trials)
    if rate := max((t.clock_drift for t in trials), key=abs):
        return [Finding("clocks_drift", CARE, {"percent": 100 * rate, "doubt_ms": doubt_ms})]
    if growth := max((t.falls_behind_s for t in trials), key=abs):
        return [Finding("falls_behind", CARE, {"growth_ms": 1e3 * growth, "doubt_ms": doubt_ms})]
    drift = float(np.ptp(np.quantile(apart, (0.02, 0.98))))
    if drift > max(_READ_APART_S, _READ_APART_LOOPS * loop):
        return [Finding("clocks_apart", CARE, {"drift_s": drift})]
    return []


def _gaps(gaps: NDArray[np.float64], loop: float) -> list[Finding]:
    findings = []
    late = gaps[gaps > _LONG_GAP * loop]
    lost = float(late.sum() / max(gaps.sum(), 1e-12))
    if lost > _LOST_TIME:
        return [Finding("gaps", REFUSE, {"percent": 100 * lost, "longest_s": late.max()})]
    if np.std(gaps) > _UNEVEN * loop:
        values = {"jitter_ms": 1e3 * np.std(gaps), "loop_ms": 1e3 * loop}
        findings.append(Finding("uneven_loop", CARE, values))
    if len(late):
        values = {"times": len(late), "longest_s": late.max()}
        findings.append(Finding("loop_stood_still", CARE, values))
    return findings


def tone_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Tones that the loop cannot show, and commands that are not the tone they are called."""
    loop = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in trials])))
    tones = [t for t in trials if t.frequency_hz > 0]
    fast = [t for t in tones if t.frequency_hz * loop * _ROWS_PER_PERIOD > 1]
    wrong = [t for t in tones if all(t is not f for f in fast) and _tone_share(t) < _IS_TONE]
    findings = []
    if wrong:
        first, strongest_hz = wrong[0], _strongest_hz(wrong[0])
        verdict = REFUSE if 2 * (len(wrong) + len(fast)) > len(tones) else CARE
        values = {
            "trial": first.number,
            "called_hz": first.frequency_hz,
            "strongest_hz": strongest_hz,
        }
        findings.append(Finding("not_its_tone", verdict, values))
    if fast:
        highest = max(t.frequency_hz for t in fast)
        verdict = REFUSE if len(fast) == len(tones) else CARE
        values = {"frequency_hz": highest, "rows": 1 / max(highest * loop, 1e-300)}
        findings.append(Finding("too_few_rows_a_period", verdict, values))
    return findings


def _tone_share(trial: Trial) -> float:
    """Share of the command's variance that a sine of its nominal frequency explains.

    Of the best three periods: a lead-in rests, and a trial may outlast its tone.
    """
    time, value = trial.send_time_s, trial.command_rad
    periods = float(np.ptp(time)) * trial.frequency_hz
    length = min(len(time), max(8, round(len(time) * min(1.0, 3 / max(periods, 1e-9)))))
    best = 0.0
    for first in np.linspace(0, max(len(time) - length, 0), 5).astype(int):
        part = slice(first, first + length)
        total = float(np.var(value[part]))
        if total < 1e-12:
            continue
        design = sine_design(2 * np.pi * trial.frequency_hz * (time[part] - time[first]))
        residuals = value[part] - design @ least_squares(design, value[part])
        best = max(best, 1 - float(np.var(residuals)) / total)
    return best


def _strongest_hz(trial: Trial) -> float:
    """Frequency of the largest peak of the command's spectrum [Hz]."""
    rows = min(len(trial.send_time_s), 1 << 14)
    time = np.linspace(trial.send_time_s[0], trial.send_time_s[-1], rows)
    value = np.interp(time, trial.send_time_s, trial.command_rad)
    power = np.abs(np.fft.rfft(value - value.mean(), 4 * rows))
    return float(np.argmax(power) / (4 * (time[1] - time[0]) * rows))
