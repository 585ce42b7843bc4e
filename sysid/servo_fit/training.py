"""Train the networks of all joints, all held-out folds and all candidates in one computation.

Every network corrects a linear filter (`sysid.servo_fit.windows`) fitted to the same readings, and
is scored at the readings' own times in free run. Its inputs are commands only, so its one-step and
free-run errors are equal. Candidates differ in weight decay and in the length of training; the
choice is made by held-out groups.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pupper_sysid.common.processes.workers import keep_freed_memory
from pupper_sysid.sysid.servo_fit.kernels import Lstm, Mlp
from pupper_sysid.sysid.servo_fit.windows import WINDOW, LinearFits, Samples, fading, learns_from

_BEND = 3.0  # robust standard deviations beyond which a reading pulls with constant force
_ROWS_PER_STEP = 4096
_MEANS = (0.9, 0.999)  # of Adam: of gradients and of their squares
_LARGEST_GRADIENT = 10.0


@dataclass(frozen=True)
class Recipe:
    """Hyper-parameters of a kind of network."""

    units: int
    """Hidden units of one member."""
    members: int
    """Networks that are averaged."""
    decays: tuple[float, ...]
    """Weight decays to choose from, relative to the sum of squared errors: as in a posterior, twice
    the data need half the decay per reading, so a choice made on folds fits the whole."""
    steps: int
    """Optimiser steps, with a learning rate that falls to zero as a cosine."""
    learning_rate: float
    check_every: int
    patience: int
    """`check_every` and `patience`: steps between comparisons of the candidates; training stops
    after `patience` comparisons without improvement."""


MLP = Recipe(20, 4, (0.1, 0.3, 1.0, 3.0), 400, 5e-3, 100, 2)
LSTM = Recipe(16, 2, (0.1, 1.0), 200, 5e-3, 50, 3)


@dataclass(frozen=True)
class Checkpoint:
    """All networks at one step of training."""

    step: int
    error: NDArray[np.float32]
    """Model minus reading of the averaged members, normalised, shape (joints, windows, readings,
    sets, decays)."""
    weights: dict[str, NDArray[np.float32]]
    """Each (joints, sets, decays, members, …)."""


def train(
    kind: str,
    recipe: Recipe,
    period_s: float,
    data: Samples,
    linear: LinearFits,
    sets: Sequence[frozenset[int]],
    seed: int,
    watch: Callable[[Checkpoint], bool],
    progress: Callable[[int], None] | None = None,
) -> bool:
    """Train until `watch` returns True, the steps are used up, or Ctrl-C.

    Parameters
    ----------
    kind : {"mlp", "lstm"}
    recipe : Recipe
    period_s : float
        Time between commands [s].
    data : Samples
    linear : LinearFits
        Of the same training sets.
    sets : sequence of frozenset of int
        Groups that each network leaves out.
    seed : int
    watch : callable
        Called with each `Checkpoint`; True stops.
    progress : callable, optional
        Called with the number of steps done.

    Returns
    -------
    bool
        Whether it was interrupted.
    """
    torch.set_num_threads(1)
    keep_freed_memory()
    generator = torch.Generator().manual_seed(seed)
    batches = np.random.default_rng(seed)
    shape = (len(data.command), len(sets), len(recipe.decays), recipe.members)
    fade = torch.from_numpy(fading(linear.fir.shape[-1], period_s).astype(np.float32))
    make, forward = (_mlp, _mlp_forward) if kind == "mlp" else (_lstm, _lstm_forward)
    # candidates and folds start from the same networks, so that luck does not choose among them
    start = make((len(data.command), 1, 1, recipe.members), recipe.units, fade, generator)
    weights = {
        k: w.expand(*shape, *w.shape[4:]).clone().requires_grad_(True) for k, w in start.items()
    }
    adam = _Adam(list(weights.values()))
    every = _tensors(data, linear, sets)
    readings = every["learns"].sum((-1, -2)).clamp(min=1)[:, :, None, None]  # per joint and set
    decay = torch.tensor(recipe.decays)[:, None] / (recipe.units * readings)
    per_step = max(1, _ROWS_PER_STEP // WINDOW)

    def error_of(part: dict[str, torch.Tensor], averaged: bool = False) -> torch.Tensor:
        """Model minus reading, shape (joints, sets, decays, members, windows, readings)."""
        out = forward(weights, part["command"], fade, data.past)
        bound = part["bound"][:, :, None, None, None, None]
        if averaged and kind == "mlp":  # its members run as one wide layer within one bound
            out = out.mean(3, keepdim=True)
        out = bound * torch.tanh(out / bound)
        out = out.mean(3, keepdim=True) if averaged else out
        joints, *_, windows, outputs = out.shape
        flat = out.reshape(joints, -1, windows, outputs).transpose(1, 2)
        seen = torch.matmul(flat, part["look"]).transpose(1, 2)
        seen = seen.reshape(*out.shape[:4], windows, -1)
        return seen - part["residual"][:, :, None, None]

    def checkpoint(step: int) -> Checkpoint:
        parts = []
        with torch.no_grad():
            for low in range(0, data.windows, 4 * per_step):
                part = _some(every, slice(low, low + 4 * per_step))
                found = error_of(part, averaged=True)[:, :, :, 0]
                parts.append(found.permute(0, 3, 4, 1, 2).numpy())
            now = {k: w.detach().numpy().copy() for k, w in weights.items()}
        return Checkpoint(step, np.concatenate(parts, axis=1), now)

    part = _some(every, slice(0, per_step))
    try:
        for step in range(recipe.steps + 1):
            if step and (step % recipe.check_every == 0) and watch(checkpoint(step)):
                break
            if step == recipe.steps:
                break
            if data.windows > per_step:
                chosen = batches.choice(data.windows, per_step, replace=False)
                part = _some(every, torch.from_numpy(chosen))
            bend = _BEND * part["spread"][:, :, None, None, None, None]
            loss = bend**2 * (torch.sqrt(1 + (error_of(part) / bend) ** 2) - 1) * 2
            counted = part["learns"][:, :, None, None]
            # mean over the readings of a set, then sum over independent networks
            total = (loss * counted).sum((-1, -2)) / counted.sum((-1, -2)).clamp(min=1)
            size = sum((w**2).flatten(4).sum(-1) for k, w in weights.items() if "weight" in k)
            largest = _LARGEST_GRADIENT * total.numel() ** 0.5
            rate = 0.5 * recipe.learning_rate * (1 + np.cos(np.pi * step / recipe.steps))
            adam.descend((total + decay * size).sum(), rate, largest)
            if progress:
                progress(step + 1)
    except KeyboardInterrupt:
        return True
    return False


def _tensors(
    data: Samples, linear: LinearFits, sets: Sequence[frozenset[int]]
) -> dict[str, torch.Tensor]:
    learns = np.stack([learns_from(data, s) for s in sets], axis=1)
    arrays = {
        "command": data.command, "index": data.index, "weight": data.weight,
        "residual": np.moveaxis(linear.residual, -1, 1), "learns": learns,
        "bound": linear.scale, "spread": linear.spread,
    }  # fmt: skip
    return {
        k: torch.from_numpy(np.ascontiguousarray(v, np.int64 if k == "index" else np.float32))
        for k, v in arrays.items()
    }


def _some(every: dict[str, torch.Tensor], chosen) -> dict[str, torch.Tensor]:
    """Some windows of every array that has them, and `look`, which looks readings up.

    `look` (joints, windows, outputs, readings) has the four weights of each reading.
    """
    found = dict(every)
    for name in ("command", "index", "weight"):
        found[name] = every[name][:, chosen]
    for name in ("residual", "learns"):
        found[name] = every[name][:, :, chosen]
    index, weight = found["index"], found["weight"]
    look = torch.zeros(*index.shape[:2], WINDOW + 3, index.shape[2])
    for n in range(4):
        look.scatter_add_(2, index[:, :, None] + n, weight[:, :, None, :, n])
    return found | {"look": look}


class _Adam:
    """Adam (Kingma and Ba, 2015); `torch.optim` takes longer to import than to train a joint."""

    def __init__(self, weights: list[torch.Tensor]) -> None:
        self._weights = weights
        self._means = [(torch.zeros_like(w), torch.zeros_like(w)) for w in weights]
        self._steps = 0

    def descend(self, loss: torch.Tensor, rate: float, largest: float) -> None:
        """One step, with a gradient whose norm is at most `largest`."""
        gradients = torch.autograd.grad(loss, self._weights)
        norm = float(torch.sqrt(sum(((g**2).sum() for g in gradients), torch.zeros(()))))
        keep = min(1.0, largest / (norm + 1e-6))
        self._steps += 1
        a, b = _MEANS
        whole, whole_square = 1 - a**self._steps, 1 - b**self._steps
        with torch.no_grad():
            for w, g, (mean, square) in zip(self._weights, gradients, self._means, strict=True):
                g = g * keep
                mean.lerp_(g, 1 - a)
                square.mul_(b).addcmul_(g, g, value=1 - b)
                w.addcdiv_(mean, square.sqrt().div_(whole_square**0.5).add_(1e-8),
                           value=-rate / whole)  # fmt: skip


# ------------------------------------------------------------------------------- networks


def _mlp(
    shape, units: int, fade: torch.Tensor, generator: torch.Generator
) -> dict[str, torch.Tensor]:
    def normal(*size: int, sd: float) -> torch.Tensor:
        return sd * torch.randn(*shape, *size, generator=generator)

    return {
        "weight_0": normal(len(fade), units, sd=float((fade**2).sum()) ** -0.5),
        "bias_0": normal(units, sd=0.3),
        "weight_1": normal(units, sd=0.1 * units**-0.5),
        "bias_1": torch.zeros(*shape),
    }


def _mlp_forward(
    w: dict[str, torch.Tensor], command: torch.Tensor, fade: torch.Tensor, past: int
) -> torch.Tensor:
    """Outputs (*shape, windows, WINDOW + 3) of commands (joints, windows, past + WINDOW + 2)."""
    joints, sets, decays, members, taps, _ = w["weight_0"].shape
    history = command[..., past - taps :].unfold(-1, taps, 1).flip(-1)  # newest first
    windows, outputs = history.shape[1:3]
    x = (history * fade).reshape(joints, windows * outputs, taps).mT.contiguous()
    own = [w[k].flatten(1, 3) for k in ("weight_0", "bias_0", "weight_1")]
    out = Mlp.apply(*own, x) + w["bias_1"].reshape(joints, -1, 1)
    return out.reshape(joints, sets, decays, members, windows, outputs)


def _lstm(
    shape, units: int, fade: torch.Tensor, generator: torch.Generator
) -> dict[str, torch.Tensor]:
    def uniform(*size: int) -> torch.Tensor:
        return (2 * torch.rand(*shape, *size, generator=generator) - 1) * units**-0.5

    return {
        "weight_input": uniform(1, 4 * units),
        "weight_hidden": uniform(units, 4 * units),
        "bias": uniform(4 * units),
        "weight_out": 0.1 * uniform(units),
        "bias_out": torch.zeros(*shape),
    }


def _lstm_forward(
    w: dict[str, torch.Tensor], command: torch.Tensor, fade: torch.Tensor, past: int
) -> torch.Tensor:
    """Outputs (*shape, windows, WINDOW + 3) of commands (joints, windows, past + WINDOW + 2)."""
    shape = w["bias_out"].shape
    own = {k: v.flatten(1, 3) for k, v in w.items()}
    out = Lstm.apply(
        own["weight_input"][:, :, 0], own["weight_hidden"], own["bias"], own["weight_out"],
        command.contiguous(), past - 1,
    )  # fmt: skip
    out = out + own["bias_out"][:, :, None, None]
    return out.reshape(*shape, *out.shape[2:])
