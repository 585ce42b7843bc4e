"""Compiled simulation of `servo_models.loaded_servo`: the inner loop of every fit (numba).

`LANES` candidates are stepped abreast through one run, as in `sysid.identify.candidates.kernel`.
The arithmetic is that of `LoadedServo`, which is its definition and the reference of its tests.
Compiled once per machine, on first use, and cached.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pupper_sysid.servo_models.loaded_servo import START_ERROR_RAD
from pupper_sysid.sysid.identify.candidates.kernel import LANES, SAFE, clip, fill_lanes

OFFSET, WIDTH = 19, 20
"""Column of the offset, and number of columns: `loaded_servo.COLUMNS`, then the gravity [N·m] and
the hanging position [rad] that are added to the load's, and the offset of readings [rad]."""

NO_RAMP_RAD_S2 = 1e6
"""Acceleration of the set-point from which on it follows the command at once."""
_PI, _PER_PI = 3.141592653589793, 0.3183098861837907


@njit(fastmath=SAFE, error_model="numpy", inline="always")
def _sin(x):
    """Sine to 1e-9: a Taylor series after folding; unlike the library's it fits in a register."""
    n = np.rint(x * _PER_PI)
    r = x - n * _PI
    odd = n - 2.0 * np.floor(0.5 * n)
    q = r * r
    s = 1.0 - q * (1 / 156.0)
    s = 1.0 - q * (1 / 110.0) * s
    s = 1.0 - q * (1 / 72.0) * s
    s = 1.0 - q * (1 / 42.0) * s
    s = 1.0 - q * (1 / 20.0) * s
    s = 1.0 - q * (1 / 6.0) * s
    return r * s * (1.0 - 2.0 * odd)


@njit(fastmath=SAFE, error_model="numpy")
def _simulate(
    values, dead_time, who, run, p_gain, load, ramp_share, start, steps, pad, h, stop, track
):
    """Positions of the candidates `who` after each step, into rows 1 … `steps` of `track`."""
    y, v, c, on = np.zeros(LANES), np.zeros(LANES), np.zeros(LANES), np.zeros(LANES)
    g, rate = np.zeros(LANES), np.zeros(LANES)
    part, shift = np.zeros(LANES), np.zeros(LANES, np.int64)
    p = np.zeros((len(values[0]) + 1, LANES))
    friction, firmware, ramp = False, False, False
    for i in range(LANES):
        w = values[who[i]]
        whole = int(np.floor(dead_time[who[i]]))
        shift[i], part[i] = pad - whole, dead_time[who[i]] - whole
        inertia = w[4] + load[0]
        for j in range(len(w)):
            p[j, i] = w[j]
        for j in (2, 3, 5, 6, 12):  # torques over the inertia
            p[j, i] = w[j] / inertia
        p[0, i] = w[0] * p_gain
        p[4, i] = (load[1] + w[17]) / inertia
        p[7, i] = 1.0 / (w[7] * w[7])
        p[10, i] = w[10] * inertia
        p[13, i] = p[3, i] * w[13]
        p[16, i] = w[16] * ramp_share
        p[18, i] = load[2] + w[18]
        y[i] = start - w[19]
        g[i] = y[i]
        track[0, i] = y[i]
        friction = friction or w[6] + w[8] + w[9] + w[10] > 0.0
        firmware = firmware or w[14] + w[15] > 0.0
        ramp = ramp or p[16, i] < NO_RAMP_RAD_S2
    for k in range(steps):
        volt = run[2, k + pad]
        for i in range(LANES):
            now, on_now = run[0, k + shift[i]], run[1, k + shift[i]]
            c[i] = (run[0, k + shift[i] - 1] - now) * part[i] + now
            on[i] = (run[1, k + shift[i] - 1] - on_now) * part[i] + on_now
        if ramp:
            for i in range(LANES):
                way = c[i] - g[i]
                far = np.sqrt(2.0 * p[16, i] * abs(way))
                wanted = clip(way * (1.0 / h), far)
                rate[i] += clip(wanted - rate[i], p[16, i] * h)
                g[i] += rate[i] * h
                c[i] = g[i] if p[16, i] < NO_RAMP_RAD_S2 else c[i]
        for i in range(LANES):
            error = c[i] - y[i]
            start_duty = 0.0
            if firmware:
                error -= clip(error, p[14, i])
                start_duty = p[15, i] * clip(error * (1.0 / START_ERROR_RAD), 1.0)
            wanted = error * p[0, i] - p[1, i] * v[i] + start_duty
            duty = clip(wanted, 1.0)
            top = p[2, i] * volt * on[i]
            back = p[13, i] + (p[3, i] - p[13, i]) * on[i]
            drawn = duty * top - back * v[i]
            motor = clip(drawn, p[12, i])
            damping = p[1, i] * top if duty == wanted else 0.0
            damping = damping + back if motor == drawn else 0.0
            weight = -p[4, i] * _sin(y[i] - p[18, i])
            limit = p[5, i]
            if friction:
                standing = 1.0 / (1.0 + v[i] * v[i] * p[7, i])
                load_friction = p[8, i] * abs(motor) + p[9, i] * abs(weight)
                limit += p[6, i] * standing + (1.0 + p[11, i] * standing) * load_friction
                limit += p[10, i] * motor * motor
            force = motor + weight
            force += clip((v[i] * (1.0 / h) + force) * stop, limit)
            v[i] += force * h / (1.0 + h * damping)
            y[i] += v[i] * h
            track[k + 1, i] = y[i]


@njit(cache=True, nogil=True, fastmath=SAFE, error_model="numpy")
def positions(values, dead_time, run, p_gain, load, ramp_share, start, pad, h, stop, out):
    """Simulate each candidate on one run.

    Parameters
    ----------
    values : ndarray, shape (candidates, WIDTH)
    dead_time : ndarray, shape (candidates,)
        In steps.
    run : ndarray, shape (3, pad + steps)
        Command of each step [rad], share of it for which the torque is on, and supply voltage over
        the reference, after `pad` steps of rest.
    p_gain : float
    load : ndarray, shape (3,)
        Inertia [kg·m²], gravity [N·m], hanging position [rad].
    ramp_share : float
        Largest acceleration of the set-point in this run over the servo's; inf where it has none.
    start : float
        Reading at rest before the run [rad].
    pad : int
    h : float
        Duration of a step [s].
    stop : float
        Minus the share of the speed that dry friction removes in a step.
    out : ndarray, shape (steps + 1, candidates)
        Overwritten with readings at the edges of the steps [rad].
    """
    steps, count = len(out) - 1, len(values)
    who, track = np.zeros(LANES, np.int64), np.empty((steps + 1, LANES))
    for first in range(0, count, LANES):
        used = fill_lanes(first, count, who)
        _simulate(
            values, dead_time, who, run, p_gain, load, ramp_share, start, steps, pad, h, stop, track
        )
        for k in range(steps + 1):
            for i in range(used):
                out[k, first + i] = track[k, i] + values[first + i, OFFSET]


@njit(cache=True, nogil=True, fastmath=SAFE, error_model="numpy")
def residuals(
    values, dead_time, run, p_gain, load, ramp_share, start, step, reading, pad, h, stop, out
):
    """Model minus reading of each candidate on one run.

    Parameters as for `positions`, and

    Parameters
    ----------
    step, reading : ndarray, shape (samples,)
        When the readings were measured, in steps, and their values [rad].
    out : ndarray, shape (candidates, samples)
        Overwritten [rad].
    """
    count, samples = out.shape
    steps = min(int(np.ceil(np.max(step))) + 1, run.shape[1] - pad) if samples else 0
    who, track = np.zeros(LANES, np.int64), np.empty((steps + 1, LANES))
    for first in range(0, count, LANES):
        used = fill_lanes(first, count, who)
        _simulate(
            values, dead_time, who, run, p_gain, load, ramp_share, start, steps, pad, h, stop, track
        )
        for n in range(samples):
            row = min(int(step[n]), steps - 1)
            part = step[n] - row
            for i in range(used):
                low = track[row, i]
                position = low + part * (track[row + 1, i] - low)
                out[first + i, n] = position + values[first + i, OFFSET] - reading[n]


@njit(cache=True, nogil=True, fastmath=SAFE, error_model="numpy")
def costs(
    values, dead_time, run, p_gain, load, ramp_share, start, step, reading, noise, pad, h, stop, out
):
    """Soft-L1 cost of each candidate on one run: Σ sqrt(1 + r²) − 1, r a residual over the noise.

    Parameters as for `residuals`, and

    Parameters
    ----------
    noise : float
        [rad].
    out : ndarray, shape (candidates,)
        Overwritten.
    """
    count, samples = len(out), len(step)
    steps = min(int(np.ceil(np.max(step))) + 1, run.shape[1] - pad) if samples else 0
    who, track = np.zeros(LANES, np.int64), np.empty((steps + 1, LANES))
    offset, total = np.zeros(LANES), np.zeros(LANES)
    for first in range(0, count, LANES):
        used = fill_lanes(first, count, who)
        _simulate(
            values, dead_time, who, run, p_gain, load, ramp_share, start, steps, pad, h, stop, track
        )
        for i in range(LANES):
            offset[i], total[i] = values[who[i], OFFSET], 0.0
        for n in range(samples):
            row = min(int(step[n]), steps - 1)
            part, read = step[n] - row, reading[n]
            for i in range(LANES):
                low = track[row, i]
                position = low + part * (track[row + 1, i] - low)
                r = (position + offset[i] - read) / noise
                total[i] += np.sqrt(1.0 + r * r) - 1.0
        for i in range(used):
            out[first + i] = total[i]
