"""Arrays for fitting: windows of commands and the readings in them, all joints side by side.

A window covers `WINDOW` ticks and is preceded by as many commands as a model remembers (`past`), so
windows can be shuffled and computed in parallel, and none extends over a pause. Joints with fewer
windows or readings than others are padded; `used` marks what counts.

The linear baseline is a servo as a filter of its last commands, fitted robustly:

    position = bias + Σ fir[k] · command[t - k],

by ridge regression under Huber's loss (iteratively re-weighted least squares), so that outliers,
such as a fall or a delayed poll, have little weight. The prior size of a coefficient decays with
the age of its command by `FADE_S` (the diagonal kernel of regularised FIR identification; Chen,
Ohlsson and Ljung, Automatica 2012), so that no filter length has to be chosen. The ridge is chosen
by held-out groups.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.signals import rms, robust_sd
from pupper_sysid.sysid.servo_fit.data import Run, ServoData, look_up_weights

WINDOW = 48

_FEWEST = 10
_STRETCHES = 3
_MEMORY_S = 0.5

Part = Callable[[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]], NDArray[np.bool_]]
"""Mask of a part (training, test), from trial number, time in the trial [s] and group."""


def everything(
    number: NDArray[np.int64], elapsed_s: NDArray[np.float64], group: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """The part that is all data."""
    return np.ones(len(number), bool)


def only(group: int) -> Part:
    """The part that is one group."""
    return lambda number, elapsed_s, groups: groups == group


def without(group: int) -> Part:
    """The part that is every group but one."""
    return lambda number, elapsed_s, groups: (groups != group) & (groups >= 0)


def chosen(run: Run, part: Part) -> NDArray[np.bool_]:
    """Mask of the counted readings of a run that belong to a part, shape (fresh,)."""
    row = run.readings.rows
    return part(run.number[row], run.reading_elapsed_s, run.group[row])


def chosen_rows(run: Run, part: Part) -> NDArray[np.bool_]:
    """Mask of the rows of a run that belong to a part, shape (rows,)."""
    return part(run.number, run.elapsed_s, run.group)


@dataclass(frozen=True)
class Samples:
    """Windows of all joints."""

    command: NDArray[np.float32]
    """Shape (joints, windows, past + WINDOW + 2). Normalised, oldest first. Output `k` of a window
    is the position after command `past - 1 + k`; a window has `WINDOW + 3` outputs."""
    index: NDArray[np.int64]
    """First of the four outputs that a reading is looked up in, shape (joints, windows,
    readings)."""
    weight: NDArray[np.float32]
    """Shape (joints, windows, readings, 4)."""
    target: NDArray[np.float32]
    """Normalised position, shape (joints, windows, readings)."""
    group: NDArray[np.int64]
    """Shape (joints, windows, readings)."""
    used: NDArray[np.bool_]
    """Shape (joints, windows, readings)."""
    normalisation: dict[str, NDArray[np.float64]]
    """`command_center`, `command_scale`, `position_center`, `position_scale`, each (joints,)."""
    past: int

    @property
    def windows(self) -> int:
        """Number of windows, padding included."""
        return self.command.shape[1]

    def at_readings(self, taps: int) -> NDArray[np.float64]:
        """Last `taps` commands, newest first, at readings (joints, windows, readings, taps)."""
        view = np.lib.stride_tricks.sliding_window_view(self.command, taps, axis=-1)
        # output k has newest command past - 1 + k: the window of taps that ends there
        history = view[:, :, self.past - taps :, ::-1]
        four = self.index[..., None] + np.arange(4)
        joint = np.arange(len(history))[:, None, None, None]
        window = np.arange(self.windows)[None, :, None, None]
        out = np.zeros((*self.index.shape, taps))
        for n in range(4):
            out += self.weight[..., n, None] * history[joint, window, four[..., n, None]][..., 0, :]
        return out


def grouped(data: ServoData, part: Part) -> tuple[ServoData, str | None]:
    """Data whose part has groups to hold out, and a note if they had to be made.

    A part of one group is cut into stretches. The first rows after a boundary belong to no stretch,
    because the servo's motion there depends on the stretch before.
    """
    present = set().union(*(_groups_in(data, joint, part) for joint in data.joints))
    if len(present) > 1:
        return data, None

    def cut(run: Run) -> NDArray[np.int64]:
        inside = np.flatnonzero(chosen_rows(run, part))
        memory = int(np.ceil(_MEMORY_S / data.period_s))
        group = np.full(len(run.number), -1)
        for n, rows in enumerate(np.array_split(inside, _STRETCHES)):
            group[rows[min(memory, len(rows) // 2) if n else 0 :]] = n
        return group

    names = [f"stretch {n + 1}" for n in range(_STRETCHES)]
    group = data.groups[next(iter(present))] if present else "nothing"
    return _regrouped(data, names, cut), (
        f"There is one group to learn from ({group}), so models are chosen by holding out "
        "stretches of it. Record more loops or tones to test how they generalise."
    )


def merged_groups(data: ServoData, most: int = 5) -> ServoData:
    """The same data with at most `most` groups to hold out; similar tones are kept apart."""
    if len(data.groups) <= most:
        return data

    def by_frequency(g: int) -> tuple[float, str]:
        label = data.groups[g]
        number = label.removesuffix(" Hz")
        return (float(number) if number != label else 0.0), label

    order = sorted(range(len(data.groups)), key=by_frequency)
    fold = np.empty(len(order) + 1, int)
    fold[-1] = -1
    for place, g in enumerate(order):
        fold[g] = place % most
    names = [", ".join(data.groups[g] for g in order[n::most]) for n in range(most)]
    return _regrouped(data, names, lambda run: fold[run.group])


def with_two_groups(data: ServoData, part: Part) -> ServoData:
    """The data without groups that have no readings, such as a tone cut short."""
    present = {joint: _groups_in(data, joint, part) - {-1} for joint in data.joints}
    for joint, groups in present.items():
        if len(groups) < 2:
            seen = ", ".join(data.groups[g] for g in groups) or "nothing"
            raise InputError(
                f"{joint} has readings of {seen} only, others of more, so it cannot be tested on "
                "what it has not seen. Leave it out of `joints`, record it again, or split by time "
                "(`train_before_s`, `test_after_s`)."
            )
    used = sorted(set().union(*present.values()))
    place = np.full(len(data.groups) + 1, -1)
    place[used] = np.arange(len(used))
    return _regrouped(data, [data.groups[g] for g in used], lambda run: place[run.group])


def _groups_in(data: ServoData, joint: str, part: Part) -> set[int]:
    """Groups of a joint's counted readings in a part."""
    return {int(g) for r in data.runs[joint] for g in r.group[r.readings.rows][chosen(r, part)]}


def _regrouped(
    data: ServoData, names: Sequence[str], group: Callable[[Run], NDArray[np.int64]]
) -> ServoData:
    """The same data with other groups, called `names`."""
    runs = {j: tuple(replace(r, group=group(r)) for r in data.runs[j]) for j in data.runs}
    return replace(data, runs=runs, groups=tuple(names))


def samples(data: ServoData, part: Part, past: int) -> Samples:
    """Windows over all runs of all joints, with the readings of `part`."""
    parts = {
        j: [_windows(run, chosen(run, part), past) for run in data.runs[j]] for j in data.joints
    }
    norm = {k: np.zeros(len(data.joints)) for k in (
        "command_center", "command_scale", "position_center", "position_scale")}  # fmt: skip
    for n, joint in enumerate(data.joints):
        uses = [chosen(run, part) for run in data.runs[joint]]
        position = np.concatenate(
            [r.position_rad[u] for r, u in zip(data.runs[joint], uses, strict=True)]
        )
        command = np.concatenate(
            [r.command_rad for r, u in zip(data.runs[joint], uses, strict=True) if u.any()] or [[]]
        )
        if len(position) < _FEWEST:
            raise InputError(
                f"{joint}: only {len(position)} readings to learn from; even a linear model needs "
                f"{_FEWEST}. Record longer, or train on more of it."
            )
        if np.std(command) < 1e-3:
            raise InputError(
                f"{joint}: its commands hardly change (by {1e3 * np.ptp(command):.1f} mrad), so no "
                "model can be fitted. Leave it out of `joints`, or record a sweep."
            )
        norm["command_center"][n], norm["command_scale"][n] = command.mean(), command.std()
        norm["position_center"][n] = position.mean()
        norm["position_scale"][n] = max(position.std(), 1e-4)
    count = max(sum(len(p[0]) for p in parts[j]) for j in data.joints)
    most = max(p[1].shape[1] for j in data.joints for p in parts[j])
    shape = (len(data.joints), count, most)
    command = np.zeros((len(data.joints), count, past + WINDOW + 2), np.float32)
    index, group = np.zeros(shape, np.int64), np.full(shape, -1)
    weight, target = np.zeros((*shape, 4), np.float32), np.zeros(shape, np.float32)
    used = np.zeros(shape, bool)
    for n, joint in enumerate(data.joints):
        at = 0
        for c, i, w, t, g, u in parts[joint]:
            here, width = slice(at, at + len(c)), i.shape[1]
            command[n, here] = (c - norm["command_center"][n]) / norm["command_scale"][n]
            index[n, here, :width], weight[n, here, :width] = i, w
            target[n, here, :width] = (t - norm["position_center"][n]) / norm["position_scale"][n]
            group[n, here, :width], used[n, here, :width] = g, u
            at += len(c)
    return Samples(command, index, weight, target, group, used, norm, past)


def _windows(run: Run, use: NDArray[np.bool_], past: int) -> tuple[NDArray, ...]:
    """Commands, and per window the readings' index, weight, target, group and use."""
    ticks = len(run.command_rad)
    starts = np.arange(0, ticks + 1, WINDOW)
    padded = np.concatenate(
        [
            np.full(past + 1, run.initial_rad),
            run.command_rad,
            np.full(WINDOW + 2, run.command_rad[-1]),
        ]
    )
    command = np.stack([padded[s : s + past + WINDOW + 2] for s in starts])
    floor, weight = look_up_weights(run.tick)
    window = floor // WINDOW
    most = max(int(np.bincount(window).max(initial=0)), 1)
    shape = (len(starts), most)
    index, group = np.zeros(shape, np.int64), np.full(shape, -1)
    weights, target, used = np.zeros((*shape, 4)), np.zeros(shape), np.zeros(shape, bool)
    for n in range(len(starts)):
        inside = np.flatnonzero(window == n)
        here = (n, slice(0, len(inside)))
        index[here] = floor[inside] - starts[n]  # output 0 is the tick before the window
        weights[here], target[here] = weight[inside], run.position_rad[inside]
        group[here], used[here] = run.group[run.readings.rows[inside]], use[inside]
    keep = used.any(axis=1)
    return command[keep], index[keep], weights[keep], target[keep], group[keep], used[keep]


def training_sets(groups: Sequence[int], nested: bool) -> list[frozenset[int]]:
    """Groups that each fit leaves out: none, each, and, if nested, every pair."""
    sets = [frozenset(), *(frozenset({g}) for g in groups)]
    if nested:
        sets += [frozenset({a, b}) for n, a in enumerate(groups) for b in groups[n + 1 :]]
    return sets


HISTORY_S = 0.4
"""Memory of a model [s]: a servo responds after 40 ms and oscillates for up to 200 ms more."""

FADE_S = 0.1
RIDGES = (1e-4, 1e-3, 1e-2)
_HUBER = 1.5  # in robust standard deviations
_ITERATIONS = 8


@dataclass(frozen=True)
class LinearFits:
    """Linear models of all joints, one per training set, in normalised units."""

    fir: NDArray[np.float64]
    """Shape (joints, sets, taps)."""
    bias: NDArray[np.float64]
    """Shape (joints, sets)."""
    residual: NDArray[np.float64]
    """Reading minus model, shape (joints, windows, readings, sets)."""
    scale: NDArray[np.float64]
    """RMS of the residuals the model was fitted to, shape (joints, sets)."""
    spread: NDArray[np.float64]
    """The same of their bulk (`robust_sd`), shape (joints, sets)."""


def taps(period_s: float) -> int:
    """Number of commands in `HISTORY_S` at a control period [s]."""
    return max(3, round(HISTORY_S / period_s))


def fading(count: int, period_s: float) -> NDArray[np.float64]:
    """Prior size of the coefficients of the last `count` commands, newest first."""
    return np.exp(-np.arange(count) * period_s / FADE_S)


def fit_linear(
    data: Samples, sets: Sequence[frozenset[int]], period_s: float, ridge: float
) -> LinearFits:
    """Fit every joint on every training set.

    Each of `sets` is the groups that a fit leaves out. `ridge` is in units of the number of
    readings; commands and positions have unit variance.
    """
    count = taps(period_s)
    fade = fading(count, period_s)
    x = data.at_readings(count) * fade
    joints = len(x)
    fir, bias = np.zeros((joints, len(sets), count)), np.zeros((joints, len(sets)))
    residual = np.zeros((*data.target.shape, len(sets)))
    scale, spread = np.ones((joints, len(sets))), np.ones((joints, len(sets)))
    for j in range(joints):
        for n, left_out in enumerate(sets):
            use = learns_from(data, left_out)[j]
            if not use.any():  # a joint with no other group: the mean, which is zero
                residual[j, :, :, n] = data.target[j]
                continue
            a = np.column_stack([x[j][use], np.ones(int(use.sum()))])
            w, r = _robust(a, data.target[j][use].astype(float), ridge)
            fir[j, n], bias[j, n] = w[:-1] * fade, w[-1]
            residual[j, :, :, n] = data.target[j] - x[j] @ w[:-1] - w[-1]
            scale[j, n] = max(rms(r), 1e-3)
            spread[j, n] = max(robust_sd(r), 1e-3)
    return LinearFits(fir, bias, residual, scale, spread)


def learns_from(data: Samples, left_out: frozenset[int]) -> NDArray[np.bool_]:
    """Mask of the readings of a fit that leaves out some groups; none close to a boundary."""
    if not left_out:
        return data.used
    return data.used & (data.group >= 0) & ~np.isin(data.group, list(left_out))


def _robust(a: NDArray, y: NDArray, ridge: float) -> tuple[NDArray, NDArray]:
    penalty = np.eye(a.shape[1])
    penalty[-1, -1] = 1e-9  # the bias is free
    weight, w = np.ones(len(y)), np.zeros(a.shape[1])
    r = y
    for _ in range(_ITERATIONS):
        weighted = a * weight[:, None]
        w = np.linalg.solve(weighted.T @ a + ridge * weight.sum() * penalty, weighted.T @ y)
        r = y - a @ w
        sigma = max(robust_sd(r), 1e-6)
        weight = np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(r), 1e-12))
    return w, r
