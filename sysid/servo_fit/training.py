"""Train the networks of all joints, all held-out folds and all candidates in one computation.

Every network corrects a linear filter (`sysid.servo_fit.windows`) fitted to the same readings, and
is scored at the readings' own times in free run. Its inputs are commands only, so its one-step and
free-run errors are equal. Candidates differ in weight decay and in the length of training; the
choice is made by held-out groups.

Products of many small LSTMs and MLPs, and their gradients, are compiled (numba). One LSTM's states
fit into the fastest cache, so each window of each network is run to its end, and in the gradient
back to its beginning, before the next one: PyTorch spends its time on starting small products and
on arrays of all networks. Hyperbolic tangents are a quotient of polynomials, as in Eigen
(`generic_fast_tanh_float`), correct to a few units of the last of 24 bits.

The MLPs have one hidden layer. All networks of a joint have the same inputs and few weights. The
activations of one network fit into the fastest cache, so each network is finished before the next
one begins: no array of all hidden units of all networks is written to memory, which is what costs
PyTorch most of its time. `Mlp` makes both directions one differentiable function of PyTorch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from pupper_sysid.common.processes.workers import keep_freed_memory
from pupper_sysid.sysid.servo_fit.windows import WINDOW, LinearFits, Samples, fading, learns_from


class Lstm(torch.autograd.Function):
    """Outputs of LSTMs with one input, from rest.

    `Lstm.apply(weight_input, weight_hidden, bias, weight_out, inputs, past)` with `weight_input`
    and `bias` (joints, networks, gates), `weight_hidden` (joints, networks, units, gates),
    `weight_out` (joints, networks, units), `inputs` (joints, windows, steps), which has no
    gradient, and `past`, the first step with an output, gives (joints, networks, windows,
    steps - past), without the bias of the outputs. The gates are input, forget, cell and output,
    `units` of each. All are of 32 bits.
    """

    @staticmethod
    def forward(ctx, weight_input, weight_hidden, bias, weight_out, inputs, past):
        """Outputs; the states are not kept."""
        ctx.save_for_backward(weight_input, weight_hidden, bias, weight_out, inputs)
        ctx.past = past
        out = torch.empty(*weight_out.shape[:2], inputs.shape[1], inputs.shape[2] - past)
        arrays = (weight_input, weight_hidden, bias, weight_out, inputs, out)
        _lstm_forward_pass(*(t.detach().numpy() for t in arrays))
        return out

    @staticmethod
    def backward(ctx, *of_outputs):
        """Gradients of the weights."""
        gradients = [torch.zeros_like(t) for t in ctx.saved_tensors[:4]]
        arrays = (*ctx.saved_tensors, of_outputs[0].contiguous(), *gradients)
        _lstm_backward(*(t.detach().numpy() for t in arrays))
        return (*gradients, None, None)


@njit(fastmath=True, error_model="numpy", inline="always")
def _tanh(x):
    most = np.float32(7.905311)
    x = min(max(x, -most), most)
    s = x * x
    p = s * np.float32(-2.76076847742355e-16) + np.float32(2.00018790482477e-13)
    p = s * p + np.float32(-8.60467152213735e-11)
    p = s * p + np.float32(5.12229709037114e-08)
    p = s * p + np.float32(1.48572235717979e-05)
    p = s * p + np.float32(6.37261928875436e-04)
    p = s * p + np.float32(4.89352455891786e-03)
    q = s * np.float32(1.19825839466702e-06) + np.float32(1.18534705686654e-04)
    q = s * q + np.float32(2.26843463243900e-03)
    q = s * q + np.float32(4.89352518554385e-03)
    return x * p / q


@njit(fastmath=True, error_model="numpy", inline="always")
def _sigmoid(x):
    return np.float32(0.5) * _tanh(np.float32(0.5) * x) + np.float32(0.5)


@njit(fastmath=True, error_model="numpy")
def _run(weight_input, weight_hidden, bias, x, gates, cell, bent, hidden):
    """Run one network on one window.

    Rows 1 … of `cell`, `bent` (tanh of the cell) and `hidden` and rows 0 … of `gates` are
    overwritten; row 0 of the first three is the state at rest.
    """
    units = cell.shape[1]
    for t in range(len(x)):
        row = gates[t]
        for k in range(4 * units):
            row[k] = bias[k] + x[t] * weight_input[k]
        for u in range(units % 2, units, 2):  # two at a time save memory traffic
            a, b = hidden[t, u], hidden[t, u + 1]
            for k in range(4 * units):
                row[k] += a * weight_hidden[u, k] + b * weight_hidden[u + 1, k]
        if units % 2:
            for k in range(4 * units):
                row[k] += hidden[t, 0] * weight_hidden[0, k]
        for k in range(2 * units):
            row[k] = _sigmoid(row[k])
        for k in range(2 * units, 3 * units):
            row[k] = _tanh(row[k])
        for k in range(3 * units, 4 * units):
            row[k] = _sigmoid(row[k])
        for u in range(units):
            cell[t + 1, u] = row[units + u] * cell[t, u] + row[u] * row[2 * units + u]
            bent[t + 1, u] = _tanh(cell[t + 1, u])
            hidden[t + 1, u] = row[3 * units + u] * bent[t + 1, u]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _lstm_forward_pass(weight_input, weight_hidden, bias, weight_out, inputs, out):
    """Fill `out` (joints, networks, windows, outputs); arguments as of `Lstm`."""
    joints, networks, units = weight_out.shape
    windows, steps = inputs.shape[1:]
    first = steps - out.shape[3]
    gates = np.empty((steps, 4 * units), np.float32)
    cell, bent, hidden = np.zeros((3, steps + 1, units), np.float32)
    for j in range(joints):
        for q in range(networks):
            for w in range(windows):
                _run(
                    weight_input[j, q], weight_hidden[j, q], bias[j, q], inputs[j, w],
                    gates, cell, bent, hidden,
                )  # fmt: skip
                for t in range(first, steps):
                    total = np.float32(0.0)
                    for u in range(units):
                        total += weight_out[j, q, u] * hidden[t + 1, u]
                    out[j, q, w, t - first] = total


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _lstm_backward(
    weight_input, weight_hidden, bias, weight_out, inputs, of_outputs,
    of_input, of_hidden, of_bias, of_out,
):  # fmt: skip
    """Add to the gradients of the weights, given those of the outputs; arguments as of `Lstm`."""
    joints, networks, units = weight_out.shape
    windows, steps = inputs.shape[1:]
    first = steps - of_outputs.shape[3]
    one = np.float32(1.0)
    gates = np.empty((steps, 4 * units), np.float32)
    cell, bent, hidden = np.zeros((3, steps + 1, units), np.float32)
    of_cell, of_state = np.empty((2, units), np.float32)
    for j in range(joints):
        for q in range(networks):
            recurrent, last = weight_hidden[j, q], weight_out[j, q]
            to_hidden, to_input, to_bias = of_hidden[j, q], of_input[j, q], of_bias[j, q]
            to_out = of_out[j, q]
            for w in range(windows):
                x = inputs[j, w]
                _run(weight_input[j, q], recurrent, bias[j, q], x, gates, cell, bent, hidden)
                of_cell[:] = np.float32(0.0)
                of_state[:] = np.float32(0.0)
                for t in range(steps - 1, -1, -1):
                    row = gates[t]
                    if t >= first:
                        of_output = of_outputs[j, q, w, t - first]
                        for u in range(units):
                            to_out[u] += of_output * hidden[t + 1, u]
                            of_state[u] += of_output * last[u]
                    for u in range(units):  # the gates give way to their gradients
                        i, f = row[u], row[units + u]
                        g, o = row[2 * units + u], row[3 * units + u]
                        now, s = bent[t + 1, u], of_state[u]
                        c = of_cell[u] + s * o * (one - now * now)
                        row[u] = c * g * i * (one - i)
                        row[units + u] = c * cell[t, u] * f * (one - f)
                        row[2 * units + u] = c * i * (one - g * g)
                        row[3 * units + u] = s * now * o * (one - o)
                        of_cell[u] = c * f
                    for k in range(4 * units):
                        to_input[k] += x[t] * row[k]
                        to_bias[k] += row[k]
                    for u in range(units):
                        h, total = hidden[t, u], np.float32(0.0)
                        for k in range(4 * units):
                            to_hidden[u, k] += h * row[k]
                            total += recurrent[u, k] * row[k]
                        of_state[u] = total


class Mlp(torch.autograd.Function):
    """Outputs of networks with one layer of rectified units.

    `Mlp.apply(weight_0, bias_0, weight_1, inputs)` with `weight_0` (joints, networks, taps,
    units), `bias_0` and `weight_1` (joints, networks, units), and `inputs` (joints, taps,
    samples), which has no gradient, gives (joints, networks, samples), without the bias of the
    outputs. All are of 32 bits.
    """

    @staticmethod
    def forward(ctx, weight_0, bias_0, weight_1, inputs):
        """Outputs; the hidden units are not kept."""
        ctx.save_for_backward(weight_0, bias_0, weight_1, inputs)
        out = torch.empty(*weight_1.shape[:2], inputs.shape[-1])
        _mlp_forward_pass(*(t.detach().numpy() for t in (weight_0, bias_0, weight_1, inputs, out)))
        return out

    @staticmethod
    def backward(ctx, *of_outputs):
        """Gradients of the weights."""
        gradients = [torch.empty_like(t) for t in ctx.saved_tensors[:3]]
        arrays = (*ctx.saved_tensors, of_outputs[0].contiguous(), *gradients)
        _mlp_backward(*(t.detach().numpy() for t in arrays))
        return (*gradients, None)


@njit(fastmath=True, error_model="numpy", inline="always")
def _before_bend(weight_0, bias, x, unit, hidden):
    """Input of one hidden unit for every sample; four taps at a time save memory traffic."""
    taps, samples = x.shape
    for n in range(samples):
        hidden[n] = bias
    whole = taps - taps % 4
    for t in range(0, whole, 4):
        a, b = weight_0[t, unit], weight_0[t + 1, unit]
        c, d = weight_0[t + 2, unit], weight_0[t + 3, unit]
        for n in range(samples):
            hidden[n] += a * x[t, n] + b * x[t + 1, n] + c * x[t + 2, n] + d * x[t + 3, n]
    for t in range(whole, taps):
        a = weight_0[t, unit]
        for n in range(samples):
            hidden[n] += a * x[t, n]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _mlp_forward_pass(weight_0, bias_0, weight_1, inputs, out):
    """Fill `out` (joints, networks, samples); arguments as of `Mlp`."""
    joints, networks, _, units = weight_0.shape
    hidden = np.empty(inputs.shape[2], np.float32)
    for j in range(joints):
        for q in range(networks):
            total = out[j, q]
            total[:] = np.float32(0.0)
            for u in range(units):
                _before_bend(weight_0[j, q], bias_0[j, q, u], inputs[j], u, hidden)
                w = weight_1[j, q, u]
                for n in range(len(hidden)):
                    total[n] += w * max(hidden[n], np.float32(0.0))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _mlp_backward(weight_0, bias_0, weight_1, inputs, of_outputs, of_0, of_bias, of_1):
    """Fill the gradients of the weights, given those of the outputs; arguments as of `Mlp`."""
    joints, networks, taps, units = weight_0.shape
    samples = inputs.shape[2]
    hidden = np.empty(samples, np.float32)
    whole = taps - taps % 4
    for j in range(joints):
        x = inputs[j]
        for q in range(networks):
            of_output = of_outputs[j, q]
            for u in range(units):
                _before_bend(weight_0[j, q], bias_0[j, q, u], x, u, hidden)
                w, one, bias = weight_1[j, q, u], np.float32(0.0), np.float32(0.0)
                for n in range(samples):
                    one += of_output[n] * max(hidden[n], np.float32(0.0))
                    hidden[n] = w * of_output[n] if hidden[n] > 0 else np.float32(0.0)
                    bias += hidden[n]
                of_1[j, q, u], of_bias[j, q, u] = one, bias
                for t in range(0, whole, 4):
                    a, b = np.float32(0.0), np.float32(0.0)
                    c, d = np.float32(0.0), np.float32(0.0)
                    for n in range(samples):
                        a += hidden[n] * x[t, n]
                        b += hidden[n] * x[t + 1, n]
                        c += hidden[n] * x[t + 2, n]
                        d += hidden[n] * x[t + 3, n]
                    of_0[j, q, t, u], of_0[j, q, t + 1, u] = a, b
                    of_0[j, q, t + 2, u], of_0[j, q, t + 3, u] = c, d
                for t in range(whole, taps):
                    a = np.float32(0.0)
                    for n in range(samples):
                        a += hidden[n] * x[t, n]
                    of_0[j, q, t, u] = a


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
    """Train an "mlp" or "lstm" until `watch` returns True, the steps are used up, or Ctrl-C.

    `linear` is of the same training `sets`, each the groups that a network leaves out. `watch` is
    called with each `Checkpoint`, `progress` with the number of steps done. Returns whether it was
    interrupted.
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
    learns = np.stack([learns_from(data, s) for s in sets], axis=1)
    arrays = {
        "command": data.command, "index": data.index, "weight": data.weight,
        "residual": np.moveaxis(linear.residual, -1, 1), "learns": learns,
        "bound": linear.scale, "spread": linear.spread,
    }  # fmt: skip
    every = {
        k: torch.from_numpy(np.ascontiguousarray(v, np.int64 if k == "index" else np.float32))
        for k, v in arrays.items()
    }
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
                errors = error_of(part, averaged=True)[:, :, :, 0]
                parts.append(errors.permute(0, 3, 4, 1, 2).numpy())
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


def _some(every: dict[str, torch.Tensor], chosen) -> dict[str, torch.Tensor]:
    """Some windows of every array that has them, and `look`, which looks readings up.

    `look` (joints, windows, outputs, readings) has the four weights of each reading.
    """
    arrays = dict(every)
    for name in ("command", "index", "weight"):
        arrays[name] = every[name][:, chosen]
    for name in ("residual", "learns"):
        arrays[name] = every[name][:, :, chosen]
    index, weight = arrays["index"], arrays["weight"]
    look = torch.zeros(*index.shape[:2], WINDOW + 3, index.shape[2])
    for n in range(4):
        look.scatter_add_(2, index[:, :, None] + n, weight[:, :, None, :, n])
    return arrays | {"look": look}


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
    stacked = [w[k].flatten(1, 3) for k in ("weight_0", "bias_0", "weight_1")]
    out = Mlp.apply(*stacked, x) + w["bias_1"].reshape(joints, -1, 1)
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
    flat = {k: v.flatten(1, 3) for k, v in w.items()}
    out = Lstm.apply(
        flat["weight_input"][:, :, 0], flat["weight_hidden"], flat["bias"], flat["weight_out"],
        command.contiguous(), past - 1,
    )  # fmt: skip
    out = out + flat["bias_out"][:, :, None, None]
    return out.reshape(*shape, *out.shape[2:])
