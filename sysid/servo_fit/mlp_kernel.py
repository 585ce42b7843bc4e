"""Compiled products of many small MLPs with one hidden layer, and their gradients (numba).

All networks of a joint have the same inputs and few weights. The activations of one network fit
into the fastest cache, so each network is finished before the next one begins: no array of all
hidden units of all networks is written to memory, which is what costs PyTorch most of its time.
`Mlp` makes both directions one differentiable function of PyTorch.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit


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
        forward(*(t.detach().numpy() for t in (weight_0, bias_0, weight_1, inputs, out)))
        return out

    @staticmethod
    def backward(ctx, *of_outputs):
        """Gradients of the weights."""
        found = [torch.empty_like(t) for t in ctx.saved_tensors[:3]]
        given = (*ctx.saved_tensors, of_outputs[0].contiguous(), *found)
        backward(*(t.detach().numpy() for t in given))
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
def forward(weight_0, bias_0, weight_1, inputs, out):
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
def backward(weight_0, bias_0, weight_1, inputs, of_outputs, of_0, of_bias, of_1):
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
