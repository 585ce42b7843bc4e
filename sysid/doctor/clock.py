"""Checks of a recording's time stamps: unit, order, gaps, and whether a tone is what it is called.

They run before anything whose memory or time grows with the recorded time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.tones import least_squares, sine_design
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, Finding
from pupper_sysid.sysid.recordings.recording import Trial

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
    found = [*_unit(loop), *_budget(spans), *_order(trials, gaps)]
    if any(f.verdict == REFUSE for f in found):
        return found
    return [*found, *_two_clocks(trials, loop), *_gaps(gaps, loop)]


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
    drift = float(np.ptp(np.quantile(apart, (0.02, 0.98))))
    if drift > max(_READ_APART_S, _READ_APART_LOOPS * loop):
        return [Finding("clocks_apart", CARE, {"drift_s": drift})]
    return []


def _gaps(gaps: NDArray[np.float64], loop: float) -> list[Finding]:
    found = []
    late = gaps[gaps > _LONG_GAP * loop]
    lost = float(late.sum() / max(gaps.sum(), 1e-12))
    if lost > _LOST_TIME:
        return [Finding("gaps", REFUSE, {"percent": 100 * lost, "longest_s": late.max()})]
    if np.std(gaps) > _UNEVEN * loop:
        found.append(
            Finding(
                "uneven_loop", CARE, {"jitter_ms": 1000.0 * np.std(gaps), "loop_ms": 1000.0 * loop}
            )
        )
    if len(late):
        found.append(
            Finding("loop_stood_still", CARE, {"times": len(late), "longest_s": late.max()})
        )
    return found


def tone_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Tones that the loop cannot show, and commands that are not the tone they are called."""
    loop = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in trials])))
    tones = [t for t in trials if t.frequency_hz > 0]
    fast = [t for t in tones if t.frequency_hz * loop * _ROWS_PER_PERIOD > 1]
    wrong = [t for t in tones if all(t is not f for f in fast) and _tone_share(t) < _IS_TONE]
    found = []
    if wrong:
        first, own = wrong[0], _strongest_hz(wrong[0])
        found.append(
            Finding(
                "not_its_tone",
                REFUSE if 2 * (len(wrong) + len(fast)) > len(tones) else CARE,
                {"trial": first.number, "called_hz": first.frequency_hz, "strongest_hz": own},
            )
        )
    if fast:
        highest = max(t.frequency_hz for t in fast)
        found.append(
            Finding(
                "too_few_rows_a_period",
                REFUSE if len(fast) == len(tones) else CARE,
                {"frequency_hz": highest, "rows": 1 / max(highest * loop, 1e-300)},
            )
        )
    return found


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
        left = value[part] - design @ least_squares(design, value[part])
        best = max(best, 1 - float(np.var(left)) / total)
    return best


def _strongest_hz(trial: Trial) -> float:
    """Frequency of the largest peak of the command's spectrum [Hz]."""
    rows = min(len(trial.send_time_s), 1 << 14)
    time = np.linspace(trial.send_time_s[0], trial.send_time_s[-1], rows)
    value = np.interp(time, trial.send_time_s, trial.command_rad)
    power = np.abs(np.fft.rfft(value - value.mean(), 4 * rows))
    return float(np.argmax(power) / (4 * (time[1] - time[0]) * rows))
