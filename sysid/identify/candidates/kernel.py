"""Compiled simulation of the candidate models: the inner loop of every fit (numba).

`LANES` candidates are stepped abreast through one trial: the delayed command, the servo, and the
position at the moments of the readings, without an array of all positions of all candidates. The
arithmetic is, operation for operation, that of `CandidateModel.simulate`, which is its definition
and the reference of its tests. Compiled once per machine, on first use, and cached.
"""

from __future__ import annotations

import numpy as np
from numba import njit

LANES = 16
"""Candidates abreast: two registers of AVX-512, four of AVX2."""

KINDS = (
    "pure_delay", "fopdt", "sopdt", "dc_servo", "delayed_pd", "delayed_pd_backlash",
    "sparse_equation",
)  # fmt: skip
"""Names of the models; a model's place is its number below."""

# No reordering of sums and no fused multiplication: stick-slip would turn the last bit into
# another trajectory, and the NumPy reference could not be compared with.
SAFE = {"nnan", "nsz"}


@njit(fastmath=SAFE, error_model="numpy", inline="always")
def clip(x, limit):
    """`x` within `±limit`; ternaries, which vectorise."""
    x = limit if x > limit else x
    return -limit if x < -limit else x


@njit(fastmath=SAFE, error_model="numpy")
def _constants(kind, values, who, h, p):
    """Constants `p` (9, LANES) of one step of `h` seconds for the candidates `who`."""
    for i in range(LANES):
        v = values[who[i]]
        p[0, i] = v[0]
        if kind == 1:
            p[1, i] = np.exp(-h / v[1])
        elif kind == 2:
            p[1, i] = h * v[1] * v[1]
            p[2, i] = 1.0 / (1.0 + 2 * h * v[2] * v[1] + (h * v[1]) ** 2)
        elif kind == 3:
            p[1, i] = v[2]
            p[2, i] = 1.0 / (1.0 + h * v[2] / v[3])
            p[3, i] = h * v[1] * p[2, i]
        elif kind == 4 or kind == 5:
            p[1, i], p[2, i], p[3, i] = v[1], v[2], v[3]
            p[4, i] = v[4] * h
            p[5, i] = h / (1.0 + h * (v[1] + v[5]))
            p[6, i] = 0.5 * v[6] if kind == 5 else 0.0
            p[7, i] = v[5]
            p[8, i] = h / (1.0 + h * v[5])
        elif kind == 6:
            p[0, i], p[1, i], p[2, i] = v[0] * h, v[1] * h, v[2]
            p[3, i], p[4, i], p[5, i] = 0.5 * h * v[3], v[4] * (0.5 * h), v[5] * h


@njit(fastmath=SAFE, error_model="numpy")
def _simulate(kind, values, dead_time, who, command, steps, pad, h, stop, track):
    """Positions of the candidates `who` after each step, into rows 1 … `steps` of `track`."""
    p = np.zeros((9, LANES))
    y, v, s, d = np.zeros(LANES), np.zeros(LANES), np.zeros(LANES), np.zeros(LANES)
    play, part, shift = np.zeros(LANES), np.zeros(LANES), np.zeros(LANES, np.int64)
    _constants(kind, values, who, h, p)
    for i in range(LANES):
        whole = int(np.floor(dead_time[who[i]]))
        shift[i], part[i] = pad - whole, dead_time[who[i]] - whole
        track[0, i] = 0.0
    for k in range(steps):
        for i in range(LANES):
            now = command[k + shift[i]]
            d[i] = (command[k + shift[i] - 1] - now) * part[i] + now
        if kind == 4 or kind == 5:
            for i in range(LANES):
                s[i] += clip(d[i] - s[i], p[4, i])
                wanted = (s[i] - y[i]) * p[0, i] - p[1, i] * v[i]
                force = clip(wanted, p[3, i])
                gain = p[5, i] if force == wanted else p[8, i]
                force -= p[7, i] * v[i]
                force += clip((v[i] * (1.0 / h) + force) * stop, p[2, i])
                v[i] += force * gain
                y[i] += v[i] * h
                track[k + 1, i] = y[i]
            if kind == 5:
                for i in range(LANES):
                    low, high = y[i] - p[6, i], y[i] + p[6, i]
                    x = play[i] if play[i] > low else low
                    play[i] = high if x > high else x
                    track[k + 1, i] = play[i]
        elif kind == 0:
            for i in range(LANES):
                track[k + 1, i] = d[i] * p[0, i]
        elif kind == 1:
            for i in range(LANES):
                y[i] = p[1, i] * y[i] + (1 - p[1, i]) * d[i]
                track[k + 1, i] = y[i] * p[0, i]
        elif kind == 2:
            for i in range(LANES):
                v[i] = (v[i] + p[1, i] * (d[i] - y[i])) * p[2, i]
                y[i] += h * v[i]
                track[k + 1, i] = y[i] * p[0, i]
        elif kind == 3:
            for i in range(LANES):
                free = (v[i] + h * clip(p[0, i] * (d[i] - y[i]), p[1, i])) * p[2, i]
                v[i] = free - clip(free, p[3, i])
                y[i] += h * v[i]
                track[k + 1, i] = y[i]
        else:
            for i in range(LANES):
                error = d[i] - y[i]
                loss = p[3, i] + abs(v[i]) * p[4, i]
                x = v[i] - v[i] * loss
                x += p[0, i] * error
                x += clip(error, p[2, i]) * p[1, i]
                x -= clip(x, p[5, i])
                v[i] = x / (loss + 1.0)
                y[i] += v[i] * h
                track[k + 1, i] = y[i]


@njit(inline="always")
def fill_lanes(first, count, who):
    """Fill `who` with candidates from `first` on, the first repeated where there are too few."""
    used = min(LANES, count - first)
    for i in range(LANES):
        who[i] = first + (i if i < used else 0)
    return used


@njit(cache=True, nogil=True, fastmath=SAFE, error_model="numpy")
def positions(kind, values, dead_time, command, pad, h, stop, out):
    """Simulate each candidate on one trial.

    Parameters
    ----------
    kind : int
        Place of the model in `KINDS`.
    values : ndarray, shape (candidates, parameters)
        Without dead time and offset.
    dead_time : ndarray, shape (candidates,)
        In steps.
    command : ndarray, shape (pad + steps,)
        `pad` steps of rest, then the command of each step [rad].
    pad : int
    h : float
        Duration of a step [s].
    stop : float
        Minus the share of the speed that dry friction removes in a step.
    out : ndarray, shape (steps + 1, candidates)
        Overwritten with positions at the edges of the steps [rad].
    """
    steps, count = len(out) - 1, len(values)
    who, track = np.zeros(LANES, np.int64), np.empty((steps + 1, LANES))
    for first in range(0, count, LANES):
        used = fill_lanes(first, count, who)
        _simulate(kind, values, dead_time, who, command, steps, pad, h, stop, track)
        for k in range(steps + 1):
            for i in range(used):
                out[k, first + i] = track[k, i]


@njit(cache=True, nogil=True, fastmath=SAFE, error_model="numpy")
def residuals(kind, values, dead_time, offset, command, step, reading, pad, h, stop, out):
    """Model minus reading of each candidate on one trial.

    Parameters as for `positions`, and

    Parameters
    ----------
    offset : ndarray, shape (candidates,)
        Added to every position [rad].
    step, reading : ndarray, shape (samples,)
        When the readings were measured, in steps, and their values [rad].
    out : ndarray, shape (candidates, samples)
        Overwritten [rad].
    """
    count, samples = out.shape
    steps = min(int(np.ceil(np.max(step))) + 1, len(command) - pad) if samples else 0
    who, track = np.zeros(LANES, np.int64), np.empty((steps + 1, LANES))
    for first in range(0, count, LANES):
        used = fill_lanes(first, count, who)
        _simulate(kind, values, dead_time, who, command, steps, pad, h, stop, track)
        for n in range(samples):
            row = min(int(step[n]), steps - 1)
            part = step[n] - row
            for i in range(used):
                low = track[row, i]
                position = low + part * (track[row + 1, i] - low)
                out[first + i, n] = position + offset[first + i] - reading[n]


@njit(cache=True, nogil=True, fastmath=SAFE, error_model="numpy")
def moments_if_later(
    kind, values, dead_time, command, step, reading, later, pad, h, stop, total, square
):
    """Sums of residuals and of their squares if each candidate had moved later.

    Parameters as for `residuals`, and

    Parameters
    ----------
    later : ndarray, shape (delays,)
        In steps.
    total, square : ndarray, shape (delays, candidates)
        The sums are added to them [rad, rad²].
    """
    count, steps = len(values), len(command) - pad
    who, track = np.zeros(LANES, np.int64), np.empty((steps + 1, LANES))
    for first in range(0, count, LANES):
        used = fill_lanes(first, count, who)
        _simulate(kind, values, dead_time, who, command, steps, pad, h, stop, track)
        for m in range(len(later)):
            for n in range(len(step)):
                moment = max(step[n] - later[m], 0.0)
                row = min(int(moment), steps - 1)
                part = moment - row
                for i in range(used):
                    low = track[row, i]
                    error = low + part * (track[row + 1, i] - low) - reading[n]
                    total[m, first + i] += error
                    square[m, first + i] += error * error
