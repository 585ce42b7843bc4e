"""The servo networks of the paper, trained as published.

"Reinforcement Learning on Cost-Constrained Quadrupedal Hardware" (Mini Pupper 2), section on servo
models and its released code: per joint, displacements from the standing pose in plain radians. The
MLP has the last 5 commands and the last position as inputs (6 → 32 → 32 → 1, ReLU), the LSTM (no
code was released: 32 units are assumed) the newest command and the last position. Both learn the
next position one step ahead from measured ones, by mean squared error and Adam; in use they run on
their own predictions. The released code keeps the weights that are best on the test loop; here
training ends after a fixed number of epochs, so that nothing is selected on it.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import DEFAULT_POSE
from pupper_sysid.common.processes.workers import keep_freed_memory
from pupper_sysid.servo_models.networks import CommandNetwork, RecurrentNetwork
from pupper_sysid.sysid.servo_fit.data import ServoData
from pupper_sysid.sysid.servo_fit.windows import Part, chosen_rows

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
    found = []
    for run in data.runs[joint]:
        inside = chosen_rows(run, part) & np.isfinite(run.trial.position_rad)
        for number in np.unique(run.number):
            rows = inside & (run.number == number)
            if rows.sum() > _COMMANDS + 1:
                found.append(
                    (run.command_rad[rows] - DEFAULT_POSE[joint],
                     run.trial.position_rad[rows] - DEFAULT_POSE[joint])
                )  # fmt: skip
    if not found:
        raise InputError(f"{joint}: no trial is long enough for the published networks.")
    return found


def _mlp(
    trials: list[list[_Trial]], generator: torch.Generator, say: Callable[[float], None]
) -> dict[str, NDArray]:
    rows = []
    for own in trials:
        parts = []
        for command, position in own:
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
    longest = max(len(c) for own in trials for c, _ in own)
    x, y = torch.zeros(longest - 1, joints, most, 2), torch.zeros(longest - 1, joints, most)
    counted = torch.zeros_like(y)
    for j, own in enumerate(trials):
        for n, (command, position) in enumerate(own):
            rows = len(command) - 1
            x[:rows, j, n, 0] = torch.from_numpy(command[:-1])
            x[:rows, j, n, 1] = torch.from_numpy(position[:-1])
            y[:rows, j, n] = torch.from_numpy(position[1:])
            counted[:rows, j, n] = 1.0

    def uniform(*size: int) -> torch.Tensor:
        made = (2 * torch.rand(joints, *size, generator=generator) - 1) * _UNITS**-0.5
        return made.requires_grad_(True)

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
