"""Checks of cause and effect: the position is that of a servo that follows this command.

An echo, noise, an unrelated or an inverted position, one that moves before its command, and a
scale or zero that changes, by what `sysid.doctor.following` explains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, minimize_scalar

from pupper_sysid.sysid.doctor.clock import clock_findings
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, Finding
from pupper_sysid.sysid.doctor.following import Following, following
from pupper_sysid.sysid.feedback.quantisation import quantum
from pupper_sysid.sysid.recordings.recording import Trial

_UNRELATED, _LOOSE = 0.25, 0.6  # share of the position's variance that the command explains
_ECHO_ROWS, _ECHO_SHARE = 30, 0.99
_ECHO_STEPS, _ECHO_PAST_ROWS = 2.0, 5  # half steps that the command moves within so many rows
_ECHO_OF_ROW = 0.01  # of the command's motion in a row: no servo is as precise in time
_ECHO_TRAVEL = 8.0  # steps: within fewer any lag looks like an echo
_DELAYED_STEPS = 10.0  # per row: then a lag that changes by a tenth of a row shows
_LONGEST_ECHO_S, _MOST_SHIFTS = 0.6, 60
_FAR_TOO_LARGE, _TOO_LARGE, _SMALL, _STILL = 2.0, 1.5, 0.5, 0.1
_DRIFT_RAD, _DRIFT_SHARE = 0.1, 0.3
_SAME_TONE_HZ = 0.02
_DIFFERENT = 0.35  # of the gain
_UNITS = {
    "degrees": 57.29578, "counts of 4,096 a turn": 651.8986, "counts of 1,024 a turn": 162.97466,
    "milliradians": 1000.0,
}  # fmt: skip
_SAME_SCALE = 0.35  # of the logarithm
_NO_ONE_LAG = 0.3
_TURNS, _TURN_SHARE = 4, 0.2
_MUCH_BETTER = 0.5
_FASTEST_S = 0.001  # lag that no servo has
_NO_PERIOD_S = 0.1  # no tone of a sweep repeats within it
_AMBIGUOUS = 0.01  # a tone may be late by a half or whole period as well


def causality_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Faults of the relation between the command and the position of one joint."""
    if echo := _echo(trials, step):
        return [echo]
    how = following(trials, step)
    if how is None:
        return []
    refused = _scale(how) or _not_a_servo(trials, how)
    if refused:
        return [refused]
    return [*_loose(trials, how), *_drift(trials, how), *_changed(trials, how)]


def crossed(trials_by_joint: Mapping[str, Sequence[Trial]]) -> dict[str, Finding]:
    """Joints whose position follows the command of another one, recorded at the same time."""
    found = {}
    for joint, trials in trials_by_joint.items():
        others = {
            name: theirs
            for name, theirs in trials_by_joint.items()
            if name != joint and trials and _simultaneous(trials, theirs)
        }
        if not others or any(f.verdict == REFUSE for f in clock_findings(trials)):
            continue
        step = quantum(trials)
        own = following(trials, step)
        if own is None or own.score > 1 - _MUCH_BETTER / 4:
            continue
        for other, theirs in others.items():
            instead = [
                replace(t, command_rad=o.command_rad, initial_command_rad=o.initial_command_rad)
                for t, o in zip(trials, theirs, strict=True)
            ]
            how = following(instead, step)
            if how and 1 - how.score < _MUCH_BETTER * (1 - own.score):
                text = (
                    f"its position follows the command of {other} and not its own: the joints are "
                    "mixed up. Check servo ids and the joint map."
                )
                found[joint] = Finding(REFUSE, text)
                break
    return found


def _simultaneous(one: Sequence[Trial], other: Sequence[Trial]) -> bool:
    return len(one) == len(other) and all(
        len(a.send_time_s) == len(b.send_time_s)
        and abs(a.send_time_s[0] - b.send_time_s[0]) < 1.0
        and np.ptp(b.command_rad) > 1e-3
        for a, b in zip(one, other, strict=True)
    )


def _echo(trials: Sequence[Trial], step: float) -> Finding | None:
    """The position is the command itself, some rows late, to within a quantisation step.

    Nearly all rows must agree to within half a step while the command moves: however coarse the
    steps, a servo's inertia and friction carry its readings over some of them earlier or later.
    """
    loop = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in trials])))
    moves = np.concatenate([np.abs(np.diff(t.command_rad)) for t in trials])
    usual = float(np.median(moves[moves > 0])) if (moves > 0).any() else 0.0
    near = max(0.55 * step + 1e-5, _ECHO_OF_ROW * usual)  # the step may not have been found
    least = _ECHO_STEPS * near
    moving = [np.flatnonzero(_recent_travel(t.command_rad) > least) for t in trials]
    if max(float(np.ptp(t.command_rad)) for t in trials) < _ECHO_TRAVEL * step:
        return None
    for shift in range(min(round(_LONGEST_ECHO_S / max(loop, 1e-4)), _MOST_SHIFTS) + 1):
        parts = []
        for t, rows in zip(trials, moving, strict=True):
            sent = rows[rows + shift < len(t.position_rad)]
            parts.append(t.position_rad[sent + shift] - t.command_rad[sent])
        left = np.concatenate([np.zeros(0), *parts])
        left = left[np.isfinite(left)]
        if len(left) < _ECHO_ROWS:
            break
        middle = 0.5 * float(np.sum(np.quantile(left, (0.01, 0.99))))
        if np.mean(np.abs(left - middle) <= near) >= _ECHO_SHARE:
            late = f"{shift} row{'s' if shift != 1 else ''} late" if shift else "in the same row"
            text = (
                f"the position is the command itself, {late}: an echo and no measurement. Read the "
                "servo's Present_Position, not its goal."
            )
            return Finding(REFUSE, text)
    return _delayed(trials, near, loop)


def _recent_travel(command: NDArray[np.float64]) -> NDArray[np.float64]:
    """Range of the command over each row and those just before it [rad]."""
    padded = np.concatenate([np.full(_ECHO_PAST_ROWS, command[0]), command])
    return np.ptp(np.lib.stride_tricks.sliding_window_view(padded, _ECHO_PAST_ROWS + 1), axis=1)


def _delayed(trials: Sequence[Trial], near: float, loop: float) -> Finding | None:
    """The position is the command at a constant time before, between rows as well."""
    rows = [_rows_after_motion(t, _DELAYED_STEPS * near) for t in trials]
    if sum(map(len, rows)) < _ECHO_ROWS:
        return None

    def left(lag: float) -> NDArray[np.float64]:
        parts = [
            t.position_rad[r] - np.interp(t.read_time_s[r] - lag, t.send_time_s, t.command_rad)
            for t, r in zip(trials, rows, strict=True)
        ]
        away = np.concatenate(parts)
        return away - 0.5 * float(np.sum(np.quantile(away, (0.01, 0.99))))

    def spread(lag: float) -> float:
        return float(np.mean(left(lag) ** 2))

    coarse = min(np.arange(-loop, _LONGEST_ECHO_S / 2, loop / 2), key=spread)
    around = (coarse - loop / 2, coarse + loop / 2)
    fine: OptimizeResult = minimize_scalar(spread, bounds=around, method="bounded")
    late = float(fine["x"])
    if np.mean(np.abs(left(late)) <= near) < _ECHO_SHARE:
        return None
    text = (
        f"the position is the command itself, {1e3 * late:.1f} ms late at every speed: an "
        "echo or a computed value and no measurement. Read the servo's Present_Position, not its "
        "goal."
    )
    return Finding(REFUSE, text)


def _rows_after_motion(trial: Trial, least: float) -> NDArray[np.int64]:
    """Rows up to four after the command moved by more than `least`: no servo is there yet."""
    moved = np.abs(np.diff(trial.command_rad, prepend=trial.command_rad[0])) > least
    soon = np.convolve(moved, np.ones(5))[: len(moved)] > 0
    return np.flatnonzero(np.isfinite(trial.position_rad) & soon)


def _scale(how: Following) -> Finding | None:
    """A position of another unit or scale than the command, whatever its sign."""
    known = np.abs(how.gain[np.isfinite(how.gain)])
    if not len(known) or how.explained < _LOOSE:
        return None
    gain, best = float(np.median(known)), float(np.max(known))
    for value, large, small in (
        (gain, "positions", "commands"), (1 / max(gain, 1e-9), "commands", "positions"),
    ):  # fmt: skip
        unit = next((u for u, f in _UNITS.items() if abs(np.log(value / f)) < _SAME_SCALE), None)
        if unit:
            text = (
                f"{large} are {value:.0f} times as large as {small}, which looks like {unit}. "
                "Convert them to radians: degrees times 0.0174533, counts times 2π over the counts "
                "of a turn."
            )
            return Finding(REFUSE, text)
    if gain > _FAR_TOO_LARGE:
        text = (
            f"the joint moves {gain:.2f} times as far as commanded, which no position servo does: "
            "check the scale (counts per radian, gear, joint map), then record again."
        )
        return Finding(REFUSE, text)
    # where a servo cannot follow it moves less: the scale is what it shows at its best
    if best < _STILL:
        text = (
            f"the joint moves by {100 * best:.0f} % of its command at best: torque off, blocked, "
            "or another scale. Check that it turns freely."
        )
        return Finding(REFUSE, text)
    return None


def _not_a_servo(trials: Sequence[Trial], how: Following) -> Finding | None:
    loop = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in trials])))
    text = None
    if how.explained < _UNRELATED:
        text = (
            f"the command explains {100 * how.explained:.0f} % of the position's motion: the two "
            "have nothing to do with each other. Check that both are of the same joint and on the "
            "same clock."
        )
    elif (
        how.early_lag_s < -0.2 * loop - 1e-3
        and _turns(trials) >= _TURNS
        and how.better(how.early_score, 0.0 if how.early_lag_s > -_NO_PERIOD_S else _AMBIGUOUS)
    ):
        text = (
            f"the position moves {-1e3 * how.early_lag_s:.0f} ms before the command does: the "
            "columns command_rad and position_rad look swapped, or a row holds the command of "
            "another time. Swap them back, or shift one."
        )
    elif how.lag_s < _FASTEST_S and how.at_once:
        text = (
            f"the position goes with the command ({1e3 * how.lag_s:.1f} ms after it, as it was "
            "held): an echo with noise, or positions stamped too early. Read the servo's "
            "Present_Position, and stamp it when it is read."
        )
    elif how.better(how.inverted_score, _AMBIGUOUS):
        text = (
            "the position moves against the command: its sign is inverted. Change the direction "
            "in the joint map, or multiply one column by -1."
        )
    return None if text is None else Finding(REFUSE, text)


def _turns(trials: Sequence[Trial]) -> int:
    """How often commands turn round, by a fifth of their range or more.

    On a single way a bend, such as that of a load's sag, looks like a shift in time; on the way
    back it does not.
    """
    count = 0
    for t in trials:
        least, extreme, way = _TURN_SHARE * float(np.ptp(t.command_rad)), t.command_rad[0], 0
        for value in t.command_rad if least > 0 else ():
            if way >= 0 and value < extreme - least:
                count, way, extreme = count + (way > 0), -1, value
            elif way <= 0 and value > extreme + least:
                count, way, extreme = count + (way < 0), 1, value
            elif (value - extreme) * (way or 1) > 0:
                extreme = value
    return count


def _loose(trials: Sequence[Trial], how: Following) -> list[Finding]:
    found = []
    if how.explained < _LOOSE:
        text = (
            f"the command explains {100 * how.explained:.0f} % of the position's motion: noise, "
            "play or a load moves the joint as well. Record with a larger amplitude and a free "
            "joint."
        )
        found.append(Finding(CARE, text))
    elif how.explained - how.score > _NO_ONE_LAG:
        text = (
            "no lag below 0.8 s fits all trials: they are of different joints or settings, one "
            "column is not what it is called, or readings are older than that. Look at the trials "
            "one by one."
        )
        found.append(Finding(CARE, text))
    # a known load is held at a part of the command, the lower the P gain the less
    free = [t.load is None for t in trials]
    gain = how.gain[np.isfinite(how.gain) & free]
    if len(gain) and (np.median(gain) > _TOO_LARGE or np.max(gain) < _SMALL):
        shown = float(np.median(gain) if np.median(gain) > _TOO_LARGE else np.max(gain))
        text = (
            f"the joint moves {shown:.2f} times as far as commanded: check the scale (counts per "
            "radian) and mechanical stops, or record slower tones."
        )
        found.append(Finding(CARE, text))
    return found


def _drift(trials: Sequence[Trial], how: Following) -> list[Finding]:
    """A zero that moves during a trial; under a load that is known gravity moves it."""
    for t, left in zip(trials, how.residual_rad, strict=True):
        half = len(left) // 2
        if half < 20 or t.load is not None:
            continue
        moved = abs(float(np.median(left[:half]) - np.median(left[half:])))
        if moved > max(_DRIFT_RAD, _DRIFT_SHARE * float(np.ptp(t.command_rad))):
            text = (
                f"the joint's zero moves by {moved:.2f} rad within a trial: a slipping horn, a "
                "servo that restarted, or two recordings in one trial. Record again."
            )
            return [Finding(CARE, text)]
    return []


def _changed(trials: Sequence[Trial], how: Following) -> list[Finding]:
    """Trials of one tone and amplitude that differ."""
    tones = [
        (t.frequency_hz, float(np.ptp(t.command_rad)), g, t.p_gain)
        for t, g in zip(trials, how.gain, strict=True)
        if t.frequency_hz > 0 and np.isfinite(g)
    ]
    for n, (f, a, g, p) in enumerate(tones):
        for f2, a2, g2, p2 in tones[:n]:
            alike = abs(f - f2) < _SAME_TONE_HZ and abs(a - a2) < 0.05 * a
            alike &= p == p2 or not np.isfinite(p + p2)  # another P gain moves differently
            if alike and abs(g - g2) > _DIFFERENT * max(abs(g), abs(g2)):
                text = (
                    f"two trials of {f:.3g} Hz differ: the joint moves {g:.2f} and {g2:.2f} times "
                    "as far as commanded. Settings, supply or load changed between them: use them "
                    "apart."
                )
                return [Finding(CARE, text)]
    return []
