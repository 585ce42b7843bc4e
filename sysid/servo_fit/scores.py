"""How good a servo model is, in scores that cannot flatter it.

Free run: the model is shown commands only, from the start of each run, however long. Its error is
taken at the readings that count, at their own times (`free_run`); at every row when the value it
shows was measured, that is through the hold (`held`); and at every row as the log has it (`raw`).
`one_step` is the error when it may start from the last reading, which says little: "nothing moves"
scores well there. Beside them stand how well the robot repeats itself where a command was repeated,
which no model can beat by much, and intervals from resampling stretches of time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.servo_models.command_network import CommandNetwork
from pupper_sysid.servo_models.interface import ServoModel
from pupper_sysid.servo_models.recurrent_network import RecurrentNetwork
from pupper_sysid.sysid.servo_fit.data import ServoData, look_up
from pupper_sysid.sysid.servo_fit.windows import Part, chosen, chosen_rows

_BLOCK_S = 0.5
_DRAWS = 1000
LEVEL = 0.90


@dataclass(frozen=True)
class Errors:
    """Errors of one model on one joint [rad], model minus reading, in order of time.

    Attributes
    ----------
    free_run, one_step : ndarray
        At the readings that count.
    speed : ndarray
        Of the model at those readings [rad/s].
    block : list of tuple
        Stretch of time each of those readings belongs to.
    held, raw : ndarray
        At rows.
    """

    free_run: NDArray[np.float64]
    one_step: NDArray[np.float64]
    speed: NDArray[np.float64]
    block: list[tuple[str, int, int]]
    held: NDArray[np.float64]
    raw: NDArray[np.float64]


Tracks = dict[str, list[NDArray[np.float64]]]
"""Per joint and run, positions at its ticks [rad], the start included."""


def tracks(model: ServoModel, data: ServoData) -> Tracks:
    """Free run of `model`, whose last axis is the joints of `data`, over every run."""
    commands, start, _ = _stacked(data)
    model.reset(start)
    out = np.concatenate([start[None], np.asarray(model.rollout(commands), float)])
    return {
        joint: [out[: len(r.command_rad) + 1, e, n] for e, r in enumerate(data.runs[joint])]
        for n, joint in enumerate(data.joints)
    }


def errors(model: ServoModel, found: Tracks, data: ServoData, part: Part) -> dict[str, Errors]:
    """Errors of a model on a part of the data, given its free run from `tracks`."""
    ahead = None
    if isinstance(model, CommandNetwork | RecurrentNetwork) and model.feedback:
        ahead = _one_step_tracks(model, data)
    made = {}
    for joint in data.joints:
        parts = []
        for n, run in enumerate(data.runs[joint]):
            track = found[joint][n]
            error = look_up(track, run.tick) - run.position_rad
            use, rows = chosen(run, part), chosen_rows(run, part)
            if ahead is None:  # the model's move from the last reading on, added to that reading
                step = np.diff(error, prepend=np.nan)
            else:
                step = look_up(ahead[joint][n], np.round(run.tick)) - run.position_rad
            speed = np.gradient(track) / data.period_s
            seconds = run.reading_elapsed_s
            alone = run.trial.joint if _alone(data) else ""
            names = [
                (alone, int(t), int(s / _BLOCK_S))
                for t, s in zip(run.number[run.readings.rows], seconds, strict=True)
            ]
            held = look_up(track, run.held_tick) - run.trial.position_rad
            raw = look_up(track, run.row_tick) - run.trial.position_rad
            parts.append(
                (error[use], step[use], look_up(speed, run.tick)[use],
                 [b for b, u in zip(names, use, strict=True) if u],
                 held[rows & np.isfinite(held)], raw[rows & np.isfinite(raw)])
            )  # fmt: skip
        e, s, v, b, h, r = zip(*parts, strict=True)
        one = np.concatenate(s)
        made[joint] = Errors(
            np.concatenate(e), one[np.isfinite(one)], np.abs(np.concatenate(v)),
            [x for y in b for x in y], np.concatenate(h), np.concatenate(r),
        )  # fmt: skip
    return made


def pooled(parts: Sequence[dict[str, Errors]]) -> dict[str, Errors]:
    """Errors on several parts, each from a model that has not seen it, as one."""
    return {
        joint: Errors(
            free_run=np.concatenate([p[joint].free_run for p in parts]),
            one_step=np.concatenate([p[joint].one_step for p in parts]),
            speed=np.concatenate([p[joint].speed for p in parts]),
            block=[b for p in parts for b in p[joint].block],
            held=np.concatenate([p[joint].held for p in parts]),
            raw=np.concatenate([p[joint].raw for p in parts]),
        )
        for joint in parts[0]
    }


def rms(values: ArrayLike) -> float:
    """Root mean square; NaN of nothing."""
    values = np.asarray(values, float)
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def mean_known(values: ArrayLike) -> float:
    """Mean of the finite values; NaN if there are none."""
    values = np.asarray(values, float)
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def persistence(data: ServoData, part: Part) -> dict[str, float]:
    """RMS [rad] of "it stays where it was last read", per joint."""
    found = {}
    for joint in data.joints:
        moves = [np.diff(r.position_rad, prepend=np.nan)[chosen(r, part)] for r in data.runs[joint]]
        every = np.concatenate(moves)
        found[joint] = rms(every[np.isfinite(every)])
    return found


def repeatability(data: ServoData, part: Part) -> dict[str, float]:
    """RMS difference of trials with equal commands over √2 [rad], per joint; NaN without any.

    What the robot does differently each time: a model that knew the mean would score this.
    """
    found = {}
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
        found[joint] = rms(every[np.isfinite(every)])
    return found


def interval(
    found: dict[str, Errors], seed: int, other: dict[str, Errors] | None = None
) -> tuple[float, float]:
    """90 % interval of the mean over joints of the free-run RMS [rad], by block bootstrap.

    With `other`, of the difference of the two models' RMS: the same stretches are drawn for both.
    """
    blocks = sorted({b for e in found.values() for b in e.block})
    place = {b: n for n, b in enumerate(blocks)}
    draws = np.random.default_rng(seed).multinomial(
        len(blocks), np.full(len(blocks), 1 / len(blocks)), _DRAWS
    )

    def drawn(models: dict[str, Errors]) -> NDArray[np.float64]:
        means = []
        for e in models.values():
            index = np.array([place[b] for b in e.block], int)
            total = np.bincount(index, e.free_run**2, len(blocks))
            count = np.bincount(index, minlength=len(blocks))
            with np.errstate(invalid="ignore"):
                means.append(np.sqrt((draws @ total) / (draws @ count)))
        return np.nanmean(means, axis=0)

    sample = drawn(found) - (drawn(other) if other is not None else 0.0)
    low, high = np.quantile(sample, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def band(found: Errors) -> tuple[float, float]:
    """Noise [rad] and timing [s] of a band: error variance = noise² + (timing · speed)².

    The form that readings of a polled servo have: counts, plus an uncertain time of measurement.
    """
    squares, speed = found.free_run**2, found.speed
    if len(squares) < 5:
        return float("nan"), float("nan")
    # one outlier must not widen the band for all: cap at five times the median's equivalent
    squares = np.minimum(squares, 25 * 2.198 * np.median(squares))
    weight = 1.0 / np.maximum(squares.mean() + 0 * speed, 1e-12)
    a = np.column_stack([np.ones_like(speed), speed**2]) * weight[:, None]
    from scipy.optimize import nnls

    noise, timing = nnls(a, squares * weight)[0]
    return float(np.sqrt(noise)), float(np.sqrt(timing))


def _alone(data: ServoData) -> bool:
    """Whether the joints were recorded one at a time: their stretches are then independent."""
    if len(data.joints) < 2:
        return False
    first, second = (data.runs[j][0].trial for j in data.joints[:2])
    return not np.array_equal(first.send_time_s, second.send_time_s)


def _stacked(data: ServoData) -> tuple[NDArray, NDArray, NDArray]:
    """Commands and readings (steps, runs, joints), and where each run starts (runs, joints)."""
    most = max(len(found) for found in data.runs.values())
    steps = max(len(r.command_rad) for found in data.runs.values() for r in found)
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


def _one_step_tracks(model: CommandNetwork | RecurrentNetwork, data: ServoData) -> Tracks:
    commands, start, position = _stacked(data)
    model.reset(start)
    out = np.concatenate([start[None], model.one_step(commands, position).astype(float)])
    return {
        joint: [out[: len(r.command_rad) + 1, e, n] for e, r in enumerate(data.runs[joint])]
        for n, joint in enumerate(data.joints)
    }
