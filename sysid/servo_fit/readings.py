"""Readings that a model predicts on the clock of ticks: their age, rows, and their offset.

The offset is a property of the recording (its zero, or its joint map's), not of the servo: for
every model alike it is the median of reading minus predicted reading.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.interface import ServoModel
from pupper_sysid.sysid.fit.predict import ReadingRule, ages
from pupper_sysid.sysid.servo_fit.data import Run, ServoData
from pupper_sysid.sysid.servo_fit.scores import Tracks, counted_ticks, predicted, stacked
from pupper_sysid.sysid.servo_fit.scores import tracks as free_tracks
from pupper_sysid.sysid.servo_fit.windows import Part, chosen, everything


def with_ages(data: ServoData, rules: Mapping[str, ReadingRule]) -> ServoData:
    """The same data, the readings of `expected` joints at the ages that they may have."""

    def aged(run: Run, rule: ReadingRule) -> Run:
        if rule.rule != "expected":
            return run
        old = ages(rule.poll_period_s, rule.loss) / data.period_s
        return replace(run, reading_tick=np.maximum(run.row_tick[:, None] - old, 0.0))

    return replace(
        data, runs={j: tuple(aged(r, rules[j]) for r in runs) for j, runs in data.runs.items()}
    )


def as_rows(data: ServoData, joints: Sequence[str]) -> ServoData:
    """The same data for a model that was fitted to rows: it predicts readings, age and all."""

    def logged(run: Run) -> Run:
        return replace(run, reading_tick=run.row_tick[:, None], held_tick=run.row_tick)

    return replace(
        data,
        runs={
            j: tuple(map(logged, runs)) if j in joints else runs for j, runs in data.runs.items()
        },
    )


FreeRun = Callable[[NDArray[np.float64]], Tracks]
"""From the offset of each run [rad], shape (runs, joints), to tracks without it."""


def learned_run(model: ServoModel, data: ServoData) -> FreeRun:
    """Free run of a learned model from the rest that a recording states, or its first reading."""
    _, start, _ = stacked(data)
    unknown = np.zeros(start.shape)
    for n, joint in enumerate(data.joints):
        for e, own in enumerate(data.runs[joint]):
            unknown[e, n] = not own.rest_known
    return lambda offset: free_tracks(model, data, start - unknown * offset)


def run_with_offset(
    run: FreeRun, data: ServoData, part: Part = everything
) -> tuple[Tracks, dict[str, float]]:
    """Free run of a model, shifted by the offset of each recording.

    Parameters
    ----------
    run : FreeRun
    data : ServoData
    part : Part
        Which readings the offset is estimated from.

    Returns
    -------
    tracks : Tracks
    offset_rad : dict of str to float
        By joint; the mean over recordings.
    """
    offset = np.zeros(stacked(data)[1].shape)
    tracks = run(offset)
    found = offsets(tracks, data, part)
    for _ in range(2):  # the offset may move the start, and with it a little itself
        for n, joint in enumerate(data.joints):
            for e, own in enumerate(data.runs[joint]):
                offset[e, n] = found[joint][own.recording]
        tracks = run(offset)
        found = offsets(tracks, data, part)
    shifted = {
        joint: [
            track + found[joint][own.recording]
            for track, own in zip(tracks[joint], data.runs[joint], strict=True)
        ]
        for joint in data.joints
    }
    return shifted, {j: float(np.mean(list(own.values()))) for j, own in found.items()}


def offsets(tracks: Tracks, data: ServoData, part: Part) -> dict[str, dict[int, float]]:
    """Median of reading minus predicted reading, by joint and recording [rad].

    Readings outside of `part` do not count; 0 where a recording has none of a joint.
    """
    found: dict[str, dict[int, float]] = {}
    for joint in data.joints:
        apart: dict[int, list[NDArray[np.float64]]] = {}
        for track, run in zip(tracks[joint], data.runs[joint], strict=True):
            value = predicted(track, run, counted_ticks(run, data.modes[joint]))
            apart.setdefault(run.recording, []).append(
                (run.position_rad - value)[chosen(run, part) & np.isfinite(value)]
            )
        found[joint] = {
            recording: float(np.median(every)) if (every := np.concatenate(parts)).size else 0.0
            for recording, parts in apart.items()
        }
    return found


def received(run: Run, period_s: float) -> NDArray[np.float64]:
    """Commands of a run as the bus sent them, averaged over physics steps, to beyond its last tick.

    Parameters
    ----------
    run : Run
    period_s : float
        Between ticks.
    """
    trial = run.on_physics(np.ones(len(run.tick), bool))
    tail = math.ceil(period_s / TIME_STEP_S) + 1
    return np.pad(trial.command, (0, tail), mode="edge")


def on_ticks(positions: NDArray[np.float64], run: Run, period_s: float) -> NDArray[np.float64]:
    """Positions at physics steps as a track: several times per tick, at the run's own times.

    Parameters
    ----------
    positions : ndarray, shape (steps + 1,)
        From the run's first command on, beyond its last tick.
    run : Run
    period_s : float
        Between ticks; the last one has no other.
    """
    per_tick = max(1, math.ceil(period_s / TIME_STEP_S))
    send = run.trial.send_time_s - run.trial.send_time_s[0]
    edges = np.append(send, send[-1] + period_s)
    ticks = np.arange(per_tick * len(send) + 1) / per_tick
    step = np.interp(ticks, np.arange(len(edges)), edges) / TIME_STEP_S
    return np.interp(step, np.arange(len(positions)), positions)
