"""Fit linear filters, MLPs and LSTMs of all joints; choose hyper-parameters by held-out groups.

`fit_network` gives one model for the whole training part and one per held-out group. The errors of
the latter on their own group choose the ridge, the weight decay and the length of training, and
give the predictive band. With `nested`, the hyper-parameters of a group's model are chosen without
that group, too.

`fit_published` trains the servo networks of the paper as published: "Reinforcement Learning on
Cost-Constrained Quadrupedal Hardware" (Mini Pupper 2), section on servo models and its released
code. Per joint they take displacements from the standing pose in plain radians. The MLP has the
last 5 commands and the last position as inputs (6 → 32 → 32 → 1, ReLU), the LSTM (no code was
released: 32 units are assumed) the newest command and the last position. Both learn the next
position one step ahead from measured ones, by mean squared error and Adam; in use they run on their
own predictions. The released code keeps the weights that are best on the test loop; here training
ends after a fixed number of epochs, so that nothing is selected on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import DEFAULT_POSE
from pupper_sysid.common.processes.workers import keep_freed_memory
from pupper_sysid.servo_models.networks import CommandNetwork, RecurrentNetwork
from pupper_sysid.sysid.servo_fit import windows
from pupper_sysid.sysid.servo_fit.data import ServoData
from pupper_sysid.sysid.servo_fit.training import LSTM, MLP, Checkpoint, train
from pupper_sysid.sysid.servo_fit.windows import Part, chosen_rows

Learned = CommandNetwork | RecurrentNetwork
_LSTM_MEMORY_S = 1.5
_AS_GOOD = 0.01  # of the logarithm of the error: one percent


@dataclass(frozen=True)
class NetworkFit:
    """Models of all joints."""

    model: Learned
    """Fitted to the whole training part."""
    held_out: dict[int, Learned]
    """Per group, the model fitted without it."""
    choices: dict[str, float]
    """Hyper-parameters chosen by held-out groups."""
    interrupted: bool
    """Whether Ctrl-C ended the training; the best so far was kept."""


def past_ticks(period_s: float) -> int:
    """Commands before a window that the models of this module need."""
    return max(windows.taps(period_s), round(_LSTM_MEMORY_S / period_s))


def fit_network(
    kind: str,
    joints: Sequence[str],
    period_s: float,
    data: windows.Samples,
    seed: int,
    nested: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> NetworkFit:
    """Fit one kind of model ("fir", "mlp" or "lstm") to all joints.

    `data` has `past_ticks(period_s)` commands before each window. With `nested` the
    hyper-parameters of each held-out model are chosen without its group, too. `progress` is called
    with steps done and steps in all.
    """
    groups = [int(g) for g in np.unique(data.group[data.used]) if g >= 0]
    nested = nested and len(groups) > 2  # a pair of two would leave nothing to learn from
    sets = windows.training_sets(groups, nested and kind != "fir")
    linear, ridge = _best_linear(data, groups, sets, period_s)
    build = partial(_build, joints, period_s, data, linear)
    choices: dict[str, float] = {"ridge": ridge}
    filters = {g: build(1 + n, {}) for n, g in enumerate(groups)}
    linear_fit = NetworkFit(build(0, {}), filters, choices, False)
    if kind == "fir":
        return linear_fit

    recipe = MLP if kind == "mlp" else LSTM
    # groups that choose a model: for the final one all, for a group's own model the others
    purposes: dict[int | None, list[tuple[int, int]]] = {
        None: [(n, g) for n, s in enumerate(sets) for g in s if len(s) == 1]
    }
    for outer in groups if nested else []:
        purposes[outer] = [
            (n, g)
            for n, s in enumerate(sets)
            for g in s
            if len(s) == 2 and outer in s and g != outer
        ]
    checkpoints: list[dict[str, NDArray]] = []
    steps_done: list[int] = []
    judged: dict[int | None, list[NDArray]] = {purpose: [] for purpose in purposes}
    held_back = 0

    def watch(now: Checkpoint) -> bool:
        nonlocal held_back
        checkpoints.append(now.weights)
        steps_done.append(now.step)
        for purpose, looks in purposes.items():
            ratios = [
                np.log(
                    _group_rms(now.error[..., n, :], data, g)
                    / _group_rms(linear.residual[..., n, None], data, g)
                )
                for n, g in looks
            ]
            judged[purpose].append(np.nanmean(np.stack(ratios), axis=(0, 1)))  # per decay
        lowest = [float(s.min()) for s in judged[None]]
        held_back = 0 if lowest[-1] <= min(lowest) + _AS_GOOD else held_back + 1
        return held_back >= recipe.patience

    interrupted = train(
        kind, recipe, period_s, data, linear, sets, seed, watch,
        (lambda done: progress(done, recipe.steps)) if progress else None,
    )  # fmt: skip
    if not checkpoints:  # interrupted before the first comparison: the linear part is the best
        return replace(linear_fit, interrupted=True)

    def kept(purpose: int | None, n: int) -> Learned:
        when, decay = _choose(judged[purpose])
        weights = {k: w[:, n, decay] for k, w in checkpoints[when].items()}
        return build(n, weights)

    when, decay = _choose(judged[None])
    choices |= {"weight_decay": recipe.decays[decay], "steps": steps_done[when]}
    held_out = {g: kept(g if nested else None, 1 + n) for n, g in enumerate(groups)}
    return NetworkFit(kept(None, 0), held_out, choices, interrupted)


def _choose(judged: list[NDArray]) -> tuple[int, int]:
    """Checkpoint and decay to keep: of those that are as good, the least regularised.

    Networks of a fold have less data than the final ones and often extrapolate, and so need more
    regularisation than the final fit.
    """
    table = np.stack(judged)
    best = np.argwhere(table <= np.nanmin(table) + _AS_GOOD)
    when, decay = min(best, key=lambda c: (c[1], -c[0]))
    return int(when), int(decay)


def _best_linear(
    data: windows.Samples, groups: list[int], sets: list[frozenset[int]], period_s: float
) -> tuple[windows.LinearFits, float]:
    """Linear models with the ridge that predicts held-out groups best."""
    singles = sets[: len(groups) + 1]
    scored = []
    for ridge in windows.RIDGES:
        fits = windows.fit_linear(data, singles, period_s, ridge)
        errors = [
            np.log(_group_rms(fits.residual[..., n + 1, None], data, g))
            for n, g in enumerate(groups)
        ]
        scored.append((float(np.nanmean(np.stack(errors))), ridge, fits))
    _, ridge, fits = min(scored, key=lambda s: s[0])
    return (
        fits if len(sets) == len(singles) else windows.fit_linear(data, sets, period_s, ridge)
    ), ridge


def _group_rms(error: NDArray, data: windows.Samples, group: int) -> NDArray[np.float64]:
    """RMS over a group's readings, shape (joints, candidates); NaN where a joint has none."""
    seen = data.used & (data.group == group)
    count = seen.sum((1, 2)).astype(float)
    total = np.sum(np.where(seen[..., None], error.astype(float) ** 2, 0.0), axis=(1, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(total / count[:, None])


def _build(
    joints: Sequence[str],
    period_s: float,
    data: windows.Samples,
    linear: windows.LinearFits,
    n: int,
    weights: dict[str, NDArray],
) -> Learned:
    """Model of training set `n`; members of an MLP become one wide layer."""
    parameters: dict[str, NDArray] = {
        **data.normalisation, "fir": linear.fir[:, n], "fir_bias": linear.bias[:, n],
        "bound": linear.scale[:, n],
    }  # fmt: skip
    if "weight_hidden" in weights:
        parameters |= weights
        return RecurrentNetwork(joints, period_s, parameters, warm_up=data.past + 1)
    if weights:
        members, units = weights["bias_0"].shape[1:]
        count = linear.fir.shape[-1]
        first = np.moveaxis(weights["weight_0"], 1, 2).reshape(len(joints), count, members * units)
        parameters |= {
            "weight_0": first * windows.fading(count, period_s)[:, None],
            "bias_0": weights["bias_0"].reshape(len(joints), members * units),
            "weight_1": weights["weight_1"].reshape(len(joints), members * units, 1) / members,
            "bias_1": weights["bias_1"].mean(1)[:, None],
        }
    return CommandNetwork(joints, period_s, parameters)


_COMMANDS, _UNITS = 5, 32
_BATCH, _LEARNING_RATE, _WEIGHT_DECAY = 64, 1e-3, 1e-5
_EPOCHS = {"mlp": 2000, "lstm": 400}


def fit_published(
    arch: str,
    data: ServoData,
    part: Part,
    seed: int,
    progress: Callable[[float], None] | None = None,
) -> CommandNetwork | RecurrentNetwork:
    """Train the published MLP or LSTM of every joint on a part of the data."""
    torch.set_num_threads(1)
    keep_freed_memory()
    generator = torch.Generator().manual_seed(seed)
    trials = [_trials(data, joint, part) for joint in data.joints]
    joints = len(trials)
    pose = np.array([DEFAULT_POSE[j] for j in data.joints])
    scale = {
        "command_center": pose, "command_scale": np.ones(joints),
        "position_center": pose, "position_scale": np.ones(joints),
        "bound": np.full(joints, np.inf), "fir_bias": np.zeros(joints),
    }  # fmt: skip
    say = progress or (lambda share: None)
    if arch == "mlp":
        weights = _mlp(trials, generator, say)
        parameters = scale | weights | {"fir": np.zeros((joints, _COMMANDS))}
        return CommandNetwork(data.joints, data.period_s, parameters, feedback=True)
    weights = _lstm(trials, generator, say)
    parameters = scale | weights | {"fir": np.zeros((joints, 1))}
    return RecurrentNetwork(data.joints, data.period_s, parameters, feedback=True, warm_up=0)


_Trial = tuple[NDArray[np.float64], NDArray[np.float64]]


def _trials(data: ServoData, joint: str, part: Part) -> list[_Trial]:
    """Commands and positions of each trial's training rows, as displacements from the pose."""
    trials = []
    for run in data.runs[joint]:
        inside = chosen_rows(run, part) & np.isfinite(run.trial.position_rad)
        for number in np.unique(run.number):
            rows = inside & (run.number == number)
            if rows.sum() > _COMMANDS + 1:
                trials.append(
                    (run.command_rad[rows] - DEFAULT_POSE[joint],
                     run.trial.position_rad[rows] - DEFAULT_POSE[joint])
                )  # fmt: skip
    if not trials:
        raise InputError(f"{joint}: no trial is long enough for the published networks.")
    return trials


def _mlp(
    trials: list[list[_Trial]], generator: torch.Generator, say: Callable[[float], None]
) -> dict[str, NDArray]:
    rows = []
    for joint_trials in trials:
        parts = []
        for command, position in joint_trials:
            t = np.arange(_COMMANDS, len(command) - 1)
            seen = np.stack([command[t - k] for k in range(_COMMANDS)] + [position[t]], axis=-1)
            parts.append(np.column_stack([seen, position[t + 1]]))
        rows.append(np.concatenate(parts))
    count = max(len(r) for r in rows)
    # joints with fewer rows repeat some of them in an epoch
    table = torch.from_numpy(np.stack([np.resize(r, (count, r.shape[1])) for r in rows])).float()
    x, y = table[..., :-1], table[..., -1:]
    sizes = (_COMMANDS + 1, _UNITS, _UNITS, 1)
    layers = []
    for a, b in pairwise(sizes):  # torch.nn.Linear's own initialisation
        bound = a**-0.5
        layers += [
            (2 * torch.rand(len(rows), a, b, generator=generator) - 1) * bound,
            (2 * torch.rand(len(rows), 1, b, generator=generator) - 1) * bound,
        ]
    for p in layers:
        p.requires_grad_(True)

    def forward(h: torch.Tensor) -> torch.Tensor:
        for n in range(0, len(layers), 2):
            h = torch.baddbmm(layers[n + 1], h, layers[n])
            h = torch.relu(h) if n < len(layers) - 2 else h
        return h

    optimiser = torch.optim.Adam(layers, _LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, _EPOCHS["mlp"])
    for epoch in range(_EPOCHS["mlp"]):
        for chosen in torch.randperm(count, generator=generator).split(_BATCH):
            optimiser.zero_grad()
            loss = ((forward(x[:, chosen]) - y[:, chosen]) ** 2).mean((1, 2)).sum()
            loss.backward()
            optimiser.step()
        falling.step()
        say((epoch + 1) / _EPOCHS["mlp"])
    names = [f"{kind}_{n}" for n in range(3) for kind in ("weight", "bias")]
    values = dict(zip(names, (p.detach().numpy() for p in layers), strict=True))
    return {k: v[:, 0] if k.startswith("bias") else v for k, v in values.items()}


def _lstm(
    trials: list[list[_Trial]], generator: torch.Generator, say: Callable[[float], None]
) -> dict[str, NDArray]:
    joints, most = len(trials), max(len(t) for t in trials)
    longest = max(len(c) for of_joint in trials for c, _ in of_joint)
    x, y = torch.zeros(longest - 1, joints, most, 2), torch.zeros(longest - 1, joints, most)
    counted = torch.zeros_like(y)
    for j, of_joint in enumerate(trials):
        for n, (command, position) in enumerate(of_joint):
            rows = len(command) - 1
            x[:rows, j, n, 0] = torch.from_numpy(command[:-1])
            x[:rows, j, n, 1] = torch.from_numpy(position[:-1])
            y[:rows, j, n] = torch.from_numpy(position[1:])
            counted[:rows, j, n] = 1.0

    def uniform(*size: int) -> torch.Tensor:
        drawn = (2 * torch.rand(joints, *size, generator=generator) - 1) * _UNITS**-0.5
        return drawn.requires_grad_(True)

    w = {
        "weight_input": uniform(2, 4 * _UNITS), "weight_hidden": uniform(_UNITS, 4 * _UNITS),
        "bias": uniform(1, 4 * _UNITS), "weight_out": uniform(_UNITS, 1), "bias_out": uniform(1, 1),
    }  # fmt: skip
    optimiser = torch.optim.Adam(w.values(), _LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, _EPOCHS["lstm"])
    for epoch in range(_EPOCHS["lstm"]):
        drive = torch.matmul(x, w["weight_input"]) + w["bias"]
        hidden = cell = torch.zeros(joints, most, _UNITS)
        seen = []
        for t in range(longest - 1):
            i, f, g, o = torch.baddbmm(drive[t], hidden, w["weight_hidden"]).chunk(4, -1)
            cell = torch.sigmoid(f) * cell + torch.sigmoid(i) * torch.tanh(g)
            hidden = torch.sigmoid(o) * torch.tanh(cell)
            seen.append(hidden)
        out = (torch.matmul(torch.stack(seen), w["weight_out"]) + w["bias_out"])[..., 0]
        loss = (((out - y) ** 2 * counted).sum((0, 2)) / counted.sum((0, 2))).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        falling.step()
        say((epoch + 1) / _EPOCHS["lstm"])
    v = {k: p.detach().numpy() for k, p in w.items()}
    return {
        "weight_input": v["weight_input"][:, None], "weight_hidden": v["weight_hidden"][:, None],
        "bias": v["bias"], "weight_out": v["weight_out"][:, None, :, 0],
        "bias_out": v["bias_out"][:, 0],
    }  # fmt: skip
