"""Compiled products of many small LSTMs and MLPs, and their gradients (numba).

One LSTM's states fit into the fastest cache, so each window of each network is run to its end,
and in the gradient back to its beginning, before the next one: PyTorch spends its time on starting
small products and on arrays of all networks. Hyperbolic tangents are a quotient of polynomials, as
in Eigen (`generic_fast_tanh_float`), correct to a few units of the last of 24 bits.

The MLPs have one hidden layer. All networks of a joint have the same inputs and few weights. The
activations of one network fit into the fastest cache, so each network is finished before the next
one begins: no array of all hidden units of all networks is written to memory, which is what costs
PyTorch most of its time. `Mlp` makes both directions one differentiable function of PyTorch.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit


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
        given = (weight_input, weight_hidden, bias, weight_out, inputs, out)
        _lstm_forward(*(t.detach().numpy() for t in given))
        return out

    @staticmethod
    def backward(ctx, *of_outputs):
        """Gradients of the weights."""
        found = [torch.zeros_like(t) for t in ctx.saved_tensors[:4]]
        given = (*ctx.saved_tensors, of_outputs[0].contiguous(), *found)
        _lstm_backward(*(t.detach().numpy() for t in given))
        return (*found, None, None)


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
def _lstm_forward(weight_input, weight_hidden, bias, weight_out, inputs, out):
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
                        given = of_outputs[j, q, w, t - first]
                        for u in range(units):
                            to_out[u] += given * hidden[t + 1, u]
                            of_state[u] += given * last[u]
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
        _mlp_forward(*(t.detach().numpy() for t in (weight_0, bias_0, weight_1, inputs, out)))
        return out

    @staticmethod
    def backward(ctx, *of_outputs):
        """Gradients of the weights."""
        found = [torch.empty_like(t) for t in ctx.saved_tensors[:3]]
        given = (*ctx.saved_tensors, of_outputs[0].contiguous(), *found)
        _mlp_backward(*(t.detach().numpy() for t in given))
        return (*found, None)


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
def _mlp_forward(weight_0, bias_0, weight_1, inputs, out):
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
            given = of_outputs[j, q]
            for u in range(units):
                _before_bend(weight_0[j, q], bias_0[j, q, u], x, u, hidden)
                w, one, bias = weight_1[j, q, u], np.float32(0.0), np.float32(0.0)
                for n in range(samples):
                    one += given[n] * max(hidden[n], np.float32(0.0))
                    hidden[n] = w * given[n] if hidden[n] > 0 else np.float32(0.0)
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
