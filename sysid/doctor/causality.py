"""Echoes and crossed joints: the position is the command itself, or follows another joint's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, minimize_scalar

from pupper_sysid.sysid.doctor.clock import clock_findings
from pupper_sysid.sysid.doctor.explanations import Servo, explain
from pupper_sysid.sysid.doctor.findings import REFUSE, Finding
from pupper_sysid.sysid.feedback.quantisation import quantum
from pupper_sysid.sysid.recordings.recording import Trial

_ECHO_ROWS, _ECHO_SHARE = 30, 0.99
_ECHO_STEPS, _ECHO_PAST_ROWS = 2.0, 5  # half steps that the command moves within so many rows
_ECHO_OF_ROW = 0.01  # of the command's motion in a row: no servo is as precise in time
_ECHO_TRAVEL = 8.0  # steps: within fewer any lag looks like an echo
_DELAYED_STEPS = 10.0  # per row: then a lag that changes by a tenth of a row shows
_LONGEST_ECHO_S, _MOST_SHIFTS = 0.6, 60
_MUCH_BETTER = 0.5


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
        own = _servo(trials, step)
        if own is None or own.unexplained < _MUCH_BETTER / 4:
            continue
        for other, theirs in others.items():
            instead = [
                replace(t, command_rad=o.command_rad, initial_command_rad=o.initial_command_rad)
                for t, o in zip(trials, theirs, strict=True)
            ]
            theirs_instead = _servo(instead, step)
            if theirs_instead and theirs_instead.unexplained < _MUCH_BETTER * own.unexplained:
                found[joint] = Finding("other_joint", REFUSE, {"other": other}, joint)
                break
    return found


def _servo(trials: Sequence[Trial], step: float) -> Servo | None:
    """The best servo of positive gain; None where too little moves."""
    base = explain(trials, step)
    if base is None:
        return None
    return base.best(1.0, np.broadcast_to(base.lags_s >= -0.5 * base.grid_s, base.total_s.shape))


def _simultaneous(one: Sequence[Trial], other: Sequence[Trial]) -> bool:
    return len(one) == len(other) and all(
        len(a.send_time_s) == len(b.send_time_s)
        and abs(a.send_time_s[0] - b.send_time_s[0]) < 1.0
        and np.ptp(b.command_rad) > 1e-3
        for a, b in zip(one, other, strict=True)
    )


def echo(trials: Sequence[Trial], step: float) -> Finding | None:
    """The position is the command itself, some rows late, to within a quantisation step.

    Nearly all rows must agree to within half a step while the command moves: however coarse the
    steps, a servo's inertia and friction carry its readings over some of them earlier or later.
    """
    loop = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in trials])))
    moves = np.concatenate([np.abs(np.diff(t.command_rad)) for t in trials])
    usual = float(np.median(moves[moves > 0])) if (moves > 0).any() else 0.0
    near = max(0.55 * step + 1e-5, _ECHO_OF_ROW * usual)  # the step may not have been found
    least = _ECHO_STEPS * near
    travels = [np.cumsum(np.abs(np.diff(t.command_rad, prepend=t.command_rad[0]))) for t in trials]
    if max(float(np.ptp(t.command_rad)) for t in trials) < _ECHO_TRAVEL * step:
        return None
    for shift in range(min(round(_LONGEST_ECHO_S / max(loop, 1e-4)), _MOST_SHIFTS) + 1):
        parts = []
        for t, travel in zip(trials, travels, strict=True):
            # a servo's way from one command to the next lies in the rows before and after a motion
            row = np.arange(max(len(travel) - shift, 0))
            moves = travel[row + shift] - travel[np.maximum(row - _ECHO_PAST_ROWS, 0)] > least
            sent = row[moves]
            parts.append(t.position_rad[sent + shift] - t.command_rad[sent])
        left = np.concatenate([np.zeros(0), *parts])
        left = left[np.isfinite(left)]
        if len(left) < _ECHO_ROWS:
            break
        middle = 0.5 * float(np.sum(np.quantile(left, (0.01, 0.99))))
        if np.mean(np.abs(left - middle) <= near) >= _ECHO_SHARE:
            late = f"{shift} row{'s' if shift != 1 else ''} late" if shift else "in the same row"
            return Finding("echo", REFUSE, {"late": late})
    return _delayed(trials, near, loop)


def _delayed(trials: Sequence[Trial], near: float, loop: float) -> Finding | None:
    """The position is the command at a constant time before, between rows as well."""
    # as many as the longest lag takes: the way from one command to the next is among them
    count = round(_LONGEST_ECHO_S / 2 / max(loop, 1e-4)) + _ECHO_PAST_ROWS
    rows = [_rows_after_motion(t, _DELAYED_STEPS * near, count) for t in trials]
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
    return Finding("echo_between_rows", REFUSE, {"late_ms": 1e3 * late})


def _rows_after_motion(trial: Trial, least: float, count: int) -> NDArray[np.int64]:
    """Rows up to `count` after the command moved by more than `least` in one."""
    moved = np.abs(np.diff(trial.command_rad, prepend=trial.command_rad[0])) > least
    total = np.cumsum(moved)
    before = np.concatenate([np.zeros(min(count, len(total)), np.int64), total[:-count]])
    return np.flatnonzero(np.isfinite(trial.position_rad) & (total > before[: len(total)]))
