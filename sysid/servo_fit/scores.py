"""Errors of servo models, the intervals that go with them, and what to compare them with.

A model is run freely from the start of each run. Its error is taken at the readings that count, at
their own times (`free_run`); at every row when its value was measured (`held`); and at every row as
logged against the predicted reading (`raw`), which is the model's mean over the instants at which
the reading may have been measured (`Run.reading_tick`). Where every row counts, `free_run` is of
predicted readings, too. `one_step` is the error when the model may start from the last reading:
persistence scores well there, so it says little. Repeatability, where a command was repeated, is
the least error that a model can reach. Intervals resample stretches of time.

Readings that a model predicts on the clock of ticks have an age and an offset. The offset is a
property of the recording (its zero, or its joint map's), not of the servo: for every model alike it
is the median of reading minus predicted reading.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls

from pupper_sysid.common.interval import HALF_WIDTH_SD, Interval
from pupper_sysid.common.results import internal
from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, AtControlRate, ServoModel
from pupper_sysid.servo_models.networks import CommandNetwork, RecurrentNetwork
from pupper_sysid.sysid.fit.predict import ReadingRule, ages
from pupper_sysid.sysid.servo_fit.data import Run, ServoData, look_up
from pupper_sysid.sysid.servo_fit.windows import Part, chosen, chosen_rows, everything

LINEAR = "linear, fitted here"  # name of the linear filter among compared models

_BLOCK_S = 0.5
_DRAWS = 1000


@dataclass(frozen=True)
class Errors:
    """Errors of one model on one joint [rad], model minus reading, in order of time."""

    free_run: NDArray[np.float64]
    one_step: NDArray[np.float64]
    """`free_run` and `one_step`: at the readings that count."""
    speed: NDArray[np.float64]
    """Of the model at those readings [rad/s]."""
    block: list[tuple[str, int, int]]
    """Stretch of time each of those readings belongs to."""
    held: NDArray[np.float64]
    raw: NDArray[np.float64]
    """`held` and `raw`: at rows."""


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Root mean square and mean absolute errors on one joint, or means over joints [rad]."""

    rmse_one_step_rad: float
    rmse_free_run_rad: float
    rmse_held_rad: float
    rmse_raw_rad: float
    mae_held_rad: float
    mae_raw_rad: float


@dataclass(frozen=True, kw_only=True)
class ModelScores:
    """Scores of one model."""

    joints: dict[str, Scores]
    mean: Scores
    """Over joints."""
    rmse_free_run_rad: Interval
    """Of the mean."""
    errors: dict[str, Errors] = internal()
    offset_rad: dict[str, float] = field(default_factory=dict)
    """By joint, reading minus prediction of these recordings; empty for a model fitted here."""
    age_spread_rad: dict[str, float] = field(default_factory=dict)
    """By joint, the part of the raw error that the unknown age of readings makes: a perfect model
    would have it. 0 where readings are dated."""
    readings: dict[str, ReadingRule] = field(default_factory=dict)
    """By joint, when a calibration says that readings were measured."""

    @classmethod
    def of(cls, errors_of: dict[str, Errors], seed: int, **more: Any) -> ModelScores:
        """Scores of errors; `seed` is that of the bootstrap, `more` the fields with a default."""
        joints = {
            joint: Scores(
                rmse_one_step_rad=rms(e.one_step), rmse_free_run_rad=rms(e.free_run),
                rmse_held_rad=rms(e.held), rmse_raw_rad=rms(e.raw),
                mae_held_rad=mean_known(np.abs(e.held)), mae_raw_rad=mean_known(np.abs(e.raw)),
            )
            for joint, e in errors_of.items()
        }  # fmt: skip
        return cls(joints=joints, mean=mean(joints), rmse_free_run_rad=interval(errors_of, seed),
                   errors=errors_of, **more)  # fmt: skip


_S = TypeVar("_S", bound=Scores)


def mean(joints: Mapping[str, _S]) -> _S:
    """Mean over joints of every score, where it is known."""
    every = list(joints.values())
    return type(every[0])(
        **{f.name: mean_known([getattr(s, f.name) for s in every]) for f in fields(every[0])}
    )


Band = tuple[float, float]  # noise [rad] and timing [s] of a predictive band

Tracks = dict[str, list[NDArray[np.float64]]]
"""Per joint and run, positions [rad] at the ticks, or a whole number of times per tick, the start
included."""


def tracks(model: ServoModel, data: ServoData, start: NDArray | None = None) -> Tracks:
    """Free run of a model, whose last axis is the joints of `data`, over every run.

    `start` [rad], shape (runs, joints), is where each run starts; by default as recorded.
    """
    commands, recorded, _ = stacked(data)
    start = recorded if start is None else start
    model.reset(start)
    rest = np.asarray(model.step(start), float)  # where the model is, with its own offset
    model.reset(start)
    if isinstance(model, AtControlRate):  # all of its steps: it moves a lot within a slow tick
        return by_run(data, rest, model.every_step(commands), model.count)
    return by_run(data, rest, model.rollout(commands))


def by_run(data: ServoData, start: NDArray, positions: ArrayLike, per_tick: int = 1) -> Tracks:
    """Tracks of positions after each step, shape (steps, runs, joints), the shorter runs padded.

    `start` has shape (runs, joints); `per_tick` is the number of steps per command.
    """
    out = np.concatenate([start[None], np.asarray(positions, float)])
    return {
        joint: [
            out[: per_tick * len(r.command_rad) + 1, e, n] for e, r in enumerate(data.runs[joint])
        ]
        for n, joint in enumerate(data.joints)
    }


def steps_per_tick(track: NDArray, run: Run) -> int:
    """How many positions per tick a track of `run` has."""
    return (len(track) - 1) // len(run.command_rad)


def predicted(track: NDArray, run: Run, tick: NDArray[np.float64]) -> NDArray[np.float64]:
    """Readings that a track of `run` predicts: its mean over equally probable instants.

    `tick` has shape (readings, instants).
    """
    at = look_up(track, steps_per_tick(track, run) * tick.ravel())
    return at.reshape(tick.shape).mean(axis=1)


def counted_ticks(run: Run, mode: str) -> NDArray[np.float64]:
    """Instants of the readings that count, shape (fresh, instants)."""
    return run.reading_tick[run.readings.rows] if mode == "all" else run.tick[:, None]


def errors(
    model: ServoModel | None, free_run: Tracks, data: ServoData, part: Part
) -> dict[str, Errors]:
    """Errors of a model on a part of the data, given its free run from `tracks`."""
    ahead = None
    if isinstance(model, CommandNetwork | RecurrentNetwork) and model.feedback:
        commands, start, position = stacked(data)
        model.reset(start)
        ahead = by_run(data, start, model.one_step(commands, position))
    firsts = [data.runs[joint][0].trial.send_time_s for joint in data.joints[:2]]
    # of joints that were recorded one at a time the stretches are independent
    apart = len(firsts) == 2 and not np.array_equal(firsts[0], firsts[1])
    by_joint = {}
    for joint in data.joints:
        parts, alone = [], joint if apart else ""
        for n, run in enumerate(data.runs[joint]):
            track = free_run[joint][n]
            when = counted_ticks(run, data.modes[joint])
            error = predicted(track, run, when) - run.position_rad
            use, rows = chosen(run, part) & np.isfinite(error), chosen_rows(run, part)
            if ahead is None:  # the model's move from the last reading on, added to that reading
                step = np.diff(error, prepend=np.nan)
            else:
                step = look_up(ahead[joint][n], np.round(run.tick)) - run.position_rad
            speed = np.gradient(track) * steps_per_tick(track, run) / data.period_s
            times = zip(run.number[run.readings.rows], run.reading_elapsed_s, use, strict=True)
            held = predicted(track, run, run.held_tick[:, None]) - run.trial.position_rad
            raw = predicted(track, run, run.reading_tick) - run.trial.position_rad
            parts.append(
                Errors(
                    free_run=error[use],
                    one_step=step[use & np.isfinite(step)],
                    speed=np.abs(predicted(speed, run, when)[use]),
                    block=[(alone, int(t), int(s / _BLOCK_S)) for t, s, used in times if used],
                    held=held[rows & np.isfinite(held)],
                    raw=raw[rows & np.isfinite(raw)],
                )
            )
        by_joint[joint] = _joined(parts)
    return by_joint


def pooled(parts: Sequence[dict[str, Errors]]) -> dict[str, Errors]:
    """Errors on several parts, each from a model that has not seen it, as one."""
    return {joint: _joined([part[joint] for part in parts]) for joint in parts[0]}


def _joined(parts: Sequence[Errors]) -> Errors:
    arrays = {
        name: np.concatenate([getattr(p, name) for p in parts])
        for name in ("free_run", "one_step", "speed", "held", "raw")
    }
    return Errors(**arrays, block=[b for p in parts for b in p.block])


def mean_known(values: ArrayLike) -> float:
    """Mean of the finite values; NaN if there are none."""
    values = np.asarray(values, float)
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def persistence(data: ServoData, part: Part) -> dict[str, float]:
    """RMS [rad] of the last reading as the prediction of the next, per joint."""
    rms_of = {}
    for joint in data.joints:
        moves = [np.diff(r.position_rad, prepend=np.nan)[chosen(r, part)] for r in data.runs[joint]]
        every = np.concatenate(moves)
        rms_of[joint] = rms(every[np.isfinite(every)])
    return rms_of


def repeatability(data: ServoData, part: Part) -> dict[str, float]:
    """RMS difference of trials with equal commands over √2 [rad], per joint; NaN without any.

    A model that predicts the mean of the repetitions has this error.
    """
    rms_of = {}
    for joint in data.joints:
        trials = []
        for run in data.runs[joint]:
            inside = chosen_rows(run, part)
            for number in np.unique(run.number):
                rows = run.number == number
                trials.append((run.command_rad[rows], run.trial.position_rad[rows], inside[rows]))
        apart = []
        for n, (command, position, inside) in enumerate(trials):
            for m, (other, theirs, _) in enumerate(trials):
                same = m != n and len(other) == len(command)
                if inside.any() and same and np.abs(other - command).max() < 1e-6:
                    apart.append((position - theirs)[inside] / np.sqrt(2))
        every = np.concatenate(apart) if apart else np.empty(0)
        rms_of[joint] = rms(every[np.isfinite(every)])
    return rms_of


def block_draws(
    errors_of: Mapping[str, Errors], seed: int
) -> tuple[dict[tuple[str, int, int], int], NDArray[np.int64]]:
    """Place of each stretch of time, and how often each is drawn, shape (draws, stretches)."""
    blocks = sorted({b for e in errors_of.values() for b in e.block})
    even = np.full(len(blocks), 1 / len(blocks))
    draws = np.random.default_rng(seed).multinomial(len(blocks), even, _DRAWS)
    return {b: n for n, b in enumerate(blocks)}, draws


def interval(
    errors_of: dict[str, Errors], seed: int, other: dict[str, Errors] | None = None
) -> Interval:
    """Mean over joints of the free-run RMS [rad], with its interval by block bootstrap.

    With `other`, the difference of the two models' RMS: the same stretches are drawn for both.
    """

    def value(models: dict[str, Errors]) -> float:
        return mean_known([rms(e.free_run) for e in models.values()])

    place, draws = block_draws(errors_of, seed)

    def drawn(models: dict[str, Errors]) -> NDArray[np.float64]:
        means = []
        for e in models.values():
            index = np.array([place[b] for b in e.block], int)
            total = np.bincount(index, e.free_run**2, len(place))
            count = np.bincount(index, minlength=len(place))
            with np.errstate(invalid="ignore"):
                means.append(np.sqrt((draws @ total) / (draws @ count)))
        return np.nanmean(means, axis=0)

    if other is None:
        return Interval.of_draws(value(errors_of), drawn(errors_of))
    return Interval.of_draws(value(errors_of) - value(other), drawn(errors_of) - drawn(other))


def band(errors_of: Errors) -> Band:
    """Noise [rad] and timing [s] of a band: error variance = noise² + (timing · speed)².

    The form that readings of a polled servo have: counts, plus an uncertain time of measurement.
    """
    squares, speed = errors_of.free_run**2, errors_of.speed
    if len(squares) < 5:
        return float("nan"), float("nan")
    # one outlier must not widen the band for all: cap at five times the median's equivalent
    squares = np.minimum(squares, 25 * 2.198 * np.median(squares))
    weight = 1.0 / np.maximum(squares.mean() + 0 * speed, 1e-12)
    a = np.column_stack([np.ones_like(speed), speed**2]) * weight[:, None]
    noise, timing = nnls(a, squares * weight)[0]
    return float(np.sqrt(noise)), float(np.sqrt(timing))


def band_half_width(band_of: Band, speed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Half of the 90 % band about a free run [rad], at a speed [rad/s]."""
    return HALF_WIDTH_SD * np.sqrt(band_of[0] ** 2 + (band_of[1] * speed) ** 2)


def stacked(data: ServoData) -> tuple[NDArray, NDArray, NDArray]:
    """Commands, starts (runs, joints) and readings (steps, runs, joints), all padded."""
    most = max(len(runs_of) for runs_of in data.runs.values())
    steps = max(len(r.command_rad) for runs_of in data.runs.values() for r in runs_of)
    commands = np.zeros((steps, most, len(data.joints)))
    position, start = np.zeros_like(commands), np.zeros((most, len(data.joints)))
    for n, joint in enumerate(data.joints):
        for e, run in enumerate(data.runs[joint]):
            rows = len(run.command_rad)
            commands[:rows, e, n], commands[rows:, e, n] = run.command_rad, run.command_rad[-1]
            start[e, n] = run.initial_rad
            seen = run.trial.position_rad
            here = np.maximum.accumulate(np.where(np.isfinite(seen), np.arange(rows), 0))
            position[:rows, e, n] = np.nan_to_num(seen[here], nan=run.initial_rad)
            position[rows:, e, n] = position[rows - 1, e, n]
    return commands, start, position


def with_ages(data: ServoData, rules: Mapping[str, ReadingRule]) -> ServoData:
    """The same data, the readings of `expected` joints at the ages that they may have."""
    aged = dict(data.runs)
    for joint in (j for j in data.runs if rules[j].rule == "expected"):
        old = ages(rules[joint].poll_period_s, rules[joint].loss) / data.period_s
        aged[joint] = tuple(
            replace(r, reading_tick=np.maximum(r.row_tick[:, None] - old, 0.0))
            for r in data.runs[joint]
        )
    return replace(data, runs=aged)


def as_rows(data: ServoData, joints: Sequence[str]) -> ServoData:
    """The same data for a model that was fitted to rows: it predicts readings, age and all."""
    logged = {
        j: tuple(replace(r, reading_tick=r.row_tick[:, None], held_tick=r.row_tick) for r in runs)
        for j, runs in data.runs.items()
        if j in joints
    }
    return replace(data, runs=data.runs | logged)


FreeRun = Callable[[NDArray[np.float64]], Tracks]
"""From the offset of each run [rad], shape (runs, joints), to tracks without it."""


def learned_run(model: ServoModel, data: ServoData) -> FreeRun:
    """Free run of a learned model from the rest that a recording states, or its first reading."""
    _, start, _ = stacked(data)
    unknown = np.zeros(start.shape)
    for n, joint in enumerate(data.joints):
        for e, run in enumerate(data.runs[joint]):
            unknown[e, n] = not run.rest_known
    return lambda offset: tracks(model, data, start - unknown * offset)


def run_with_offset(
    run: FreeRun, data: ServoData, part: Part = everything
) -> tuple[Tracks, dict[str, float]]:
    """Free run of a model, shifted by the offset of each recording, and the offsets.

    The offset is estimated from the readings of `part`; returned is the mean over recordings [rad],
    by joint.
    """
    offset = np.zeros(stacked(data)[1].shape)
    tracks = run(offset)
    shifts = offsets(tracks, data, part)
    for _ in range(2):  # the offset may move the start, and with it a little itself
        for n, joint in enumerate(data.joints):
            for e, run_of in enumerate(data.runs[joint]):
                offset[e, n] = shifts[joint][run_of.recording]
        tracks = run(offset)
        shifts = offsets(tracks, data, part)
    shifted = {
        joint: [
            track + shifts[joint][run_of.recording]
            for track, run_of in zip(tracks[joint], data.runs[joint], strict=True)
        ]
        for joint in data.joints
    }
    return shifted, {j: float(np.mean(list(run_of.values()))) for j, run_of in shifts.items()}


def offsets(tracks: Tracks, data: ServoData, part: Part) -> dict[str, dict[int, float]]:
    """Median of reading minus predicted reading, by joint and recording [rad].

    Readings outside of `part` do not count; 0 where a recording has none of a joint.
    """
    medians: dict[str, dict[int, float]] = {}
    for joint in data.joints:
        apart: dict[int, list[NDArray[np.float64]]] = {}
        for track, run in zip(tracks[joint], data.runs[joint], strict=True):
            value = predicted(track, run, counted_ticks(run, data.modes[joint]))
            apart.setdefault(run.recording, []).append(
                (run.position_rad - value)[chosen(run, part) & np.isfinite(value)]
            )
        medians[joint] = {
            recording: float(np.median(every)) if (every := np.concatenate(parts)).size else 0.0
            for recording, parts in apart.items()
        }
    return medians


def received(run: Run, period_s: float) -> NDArray[np.float64]:
    """Commands of a run as the bus sent them, by physics steps, to beyond its last tick."""
    trial = run.on_physics(np.ones(len(run.tick), bool))
    tail = math.ceil(period_s / TIME_STEP_S) + 1
    return np.pad(trial.command, (0, tail), mode="edge")


def on_ticks(positions: NDArray[np.float64], run: Run, period_s: float) -> NDArray[np.float64]:
    """Positions at physics steps as a track: several times per tick, at the run's own times.

    `positions`, shape (steps + 1,), are from the run's first command to beyond its last tick.
    """
    per_tick = max(1, math.ceil(period_s / TIME_STEP_S))
    send = run.trial.send_time_s - run.trial.send_time_s[0]
    edges = np.append(send, send[-1] + period_s)
    ticks = np.arange(per_tick * len(send) + 1) / per_tick
    step = np.interp(ticks, np.arange(len(edges)), edges) / TIME_STEP_S
    return np.interp(step, np.arange(len(positions)), positions)
