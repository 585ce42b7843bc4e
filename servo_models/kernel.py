"""Compiled simulation of a servo on one run: the inner loop of every fit, score and comparison.

`LANES` candidates are stepped abreast: the delayed command, the set-point's profile, the position
loop, motor, gears and load, and the position at the moments of the readings, without an array of
all positions of all candidates. `servo_models.loaded_servo` has the equations; they stand a step a
line in `tests/reference/servo.py`, and tests hold the two together. What a servo does not have is
not computed: the branches stand outside of the loops over candidates.

The linear models (`LINEAR`) have no limits and no friction; they are what other people fit, and
stand beside the servo in tables. Compiled once per machine, on first use, and cached.
"""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np import arrayobj
from numpy.typing import NDArray

from pupper_sysid.servo_models.loaded_servo import START_ERROR_RAD

LANES = 16
"""Candidates abreast: two registers of AVX-512, four of AVX2."""

COLUMNS = (
    "stiffness", "damping", "effort_limit", "back_emf", "armature", "friction_loss",
    "velocity_limit", "acceleration_limit", "stribeck_friction", "stribeck_speed",
    "load_friction_motor", "load_friction_load", "load_friction_quadratic",
    "load_friction_static", "torque_limit", "off_brake", "dead_zone_rad", "start_duty",
    "gravity_nm", "hanging_rad", "backlash_rad", "integral_per_s", "link_share", "link_hz",
    "link_damping_ratio", "offset_rad",
)  # fmt: skip
"""A candidate's numbers, in order: those of the servo without its dead time, then the gravity [N·m]
and hanging position [rad] that are added to the load's, play, the integral gain over the
proportional one [1/s], a flexible link (its share of the inertia, its frequency and damping ratio
on a held motor), and the offset of readings [rad]."""
OFFSET, WIDTH = len(COLUMNS) - 1, len(COLUMNS)

_LIMITS = ("velocity_limit", "acceleration_limit", "torque_limit", "effort_limit")
ABSENT = np.array([
    np.inf if name in _LIMITS else {"armature": 1.0, "stribeck_speed": 0.1}.get(name, 0.0)
    for name in COLUMNS
])  # fmt: skip
"""A candidate without any of the terms: limits that are infinite, an inertia of 1, else 0."""

SERVO = 0
LINEAR = {"pure_delay": 1, "fopdt": 2, "sopdt": 3}
"""Numbers of the linear models; their columns are their own parameters, the offset the last."""
SPARSE = 4
"""Number of `servo_models.sparse_equation`; its columns are its coefficients, then the offset."""


def _on_stack(*shape: int) -> Any:
    """Compiled function that returns an uninitialised array of a fixed shape on the stack.

    Unlike arrays of the heap such arrays are known not to overlap, without which the loops over
    candidates are not vectorised. They end with the function that makes them.
    """
    kind = types.Array(types.float64, len(shape), "C")

    def codegen(context, builder, signature, args):
        double = context.get_data_type(types.float64)
        sizes = [context.get_constant(types.intp, n) for n in shape]
        steps = [
            context.get_constant(types.intp, 8 * prod(shape[n + 1 :])) for n in range(len(shape))
        ]
        array = context.make_array(kind)(context, builder)
        arrayobj.populate_array(
            array, cgutils.alloca_once(builder, double, size=prod(shape)), sizes, steps,
            context.get_constant(types.intp, 8), None,
        )  # fmt: skip
        return array._getvalue()

    @intrinsic
    def array(typingctx):
        return kind(), codegen

    return array


_lanes, _table = _on_stack(LANES), _on_stack(WIDTH, LANES)

_PI, _PER_PI = 3.141592653589793, 0.3183098861837907

# No reordering of sums and no fused multiplication: stick-slip would turn the last bit into
# another trajectory, and the NumPy reference could not be compared with.
SAFE = {"nnan", "nsz"}


@njit(fastmath=SAFE, error_model="numpy", inline="always")
def clip(x, limit):
    """`x` within `±limit`; ternaries, which vectorise."""
    x = limit if x > limit else x
    return -limit if x < -limit else x


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
def _delayed(held, row, k, shift, part, out):
    """Row `row` of `held` at step `k`, a fraction of a step earlier or later for each candidate."""
    for i in range(LANES):
        now = held[row, k + shift[i]]
        out[i] = (held[row, k + shift[i] - 1] - now) * part[i] + now


@njit(fastmath=SAFE, error_model="numpy", inline="always")
def _acting(x, h):
    """Time for which a step's torque acts against a damping of `x` per step [s].

    (1 - exp(-x)) / x of the step, here to 1 % up to x = 2.5.
    """
    return h / (1.0 + x * (0.5 + x * (1 / 12.0)))


@njit(fastmath=SAFE, error_model="numpy", inline="always")
def _slowed(v, force, limit, step):
    """Velocity after a step under a force and dry friction, which turns where the velocity does."""
    forward = (v > 0.0) | ((v == 0.0) & (force > 0.0))
    slowed = v + (force - limit if forward else force + limit) * step
    goes_on = slowed > 0.0 if forward else slowed < 0.0
    apart = v - slowed
    # share of the step after the standstill; a joint that creeps comes to stand still exactly
    rest = -slowed / (apart if apart != 0.0 else 1.0)
    turned = (force - clip(force, limit)) * step * rest
    return slowed if goes_on else turned


@njit(fastmath=SAFE, error_model="numpy")
def _servo(values, ids, held, edges, until, gain, load, start, steps, pad, h, shift, part, track):
    """Positions of the servos `ids` after each step, into rows 1 … `steps` of `track`."""
    p = _table()
    y, v, s = _lanes(), _lanes(), _lanes()
    earlier, now, cut = _lanes(), _lanes(), _lanes()
    next_, next_cut_ = _lanes(), _lanes()
    before, after = _lanes(), _lanes()
    one, two, share = _lanes(), _lanes(), _lanes()
    on, rate, play, per_limit = _lanes(), _lanes(), _lanes(), _lanes()
    summed, most_summed, mean_error = _lanes(), _lanes(), _lanes()
    braked, clipped, drive, free = _lanes(), _lanes(), _lanes(), _lanes()
    begin, error, acting, pull, limit = _lanes(), _lanes(), _lanes(), _lanes(), _lanes()
    link, link_speed = _lanes(), _lanes()
    slew = friction = firmware = profile = gravity = backlash = flexible = False
    for i in range(LANES):
        w = values[ids[i]]
        for j in range(WIDTH):
            p[j, i] = w[j]
        inertia = (w[4] + load[0]) * (1.0 - w[22])
        p[0, i] = w[0] * gain / inertia
        for j in (1, 2, 3, 5, 8, 14):  # torques over the inertia
            p[j, i] = w[j] / inertia
        p[6, i] = w[6] * h
        per_limit[i] = 1.0 / p[6, i]
        p[9, i] = 1.0 / (w[9] * w[9])
        p[12, i] = w[12] * inertia
        p[17, i] = w[17] * p[2, i]
        p[18, i] = (load[1] + w[18]) / inertia
        p[19, i] = load[2] + w[19]
        p[20, i] = 0.5 * w[20]
        braked[i] = _acting(h * (p[1, i] + p[3, i]), h)
        clipped[i] = _acting(h * p[3, i], h)
        y[i] = start - w[OFFSET]
        s[i], play[i] = y[i], y[i]
        v[i], rate[i], on[i] = 0.0, 0.0, 1.0
        summed[i], most_summed[i] = 0.0, p[2, i] / max(p[0, i], 1e-12)
        p[21, i] = h * w[21]
        p[22, i] = w[22] / (1.0 - w[22]) / h
        p[23, i] = h * (2.0 * _PI * w[23]) * (2.0 * _PI * w[23])
        p[24, i] = 2.0 * h * w[24] * (2.0 * _PI * w[23])
        link[i], link_speed[i] = y[i], 0.0
        track[0, i] = y[i]
        slew = slew or w[6] < np.inf
        profile = profile or w[7] < np.inf
        friction = friction or w[8] + w[10] + w[11] + w[12] > 0.0
        firmware = firmware or w[16] + w[17] + w[21] > 0.0
        gravity = gravity or p[18, i] != 0.0
        backlash = backlash or w[20] > 0.0
        flexible = flexible or w[22] > 0.0
    supply = held.shape[0] > 1
    plain = not (friction or firmware or gravity or supply or flexible)
    for i in range(LANES):
        plain = plain and not p[14, i] < np.inf
    earliest, latest = shift[0], shift[0]
    for i in range(1, LANES):
        earliest, latest = min(earliest, shift[i]), max(latest, shift[i])
    direct = plain and not (slew or profile or backlash)
    half = 0.5 * h
    for k in range(steps):
        # whether one command fills the windows of all candidates
        steady = until[k + earliest - 2] >= k + latest
        if steady and direct:
            command = edges[0, k + earliest]
            for i in range(LANES):
                middle = y[i] + v[i] * half
                demand = (command - middle) * p[0, i] - p[1, i] * v[i]
                force = clip(demand, p[2, i])
                unclipped = 1.0 if force == demand else 0.0
                step = clipped[i] + (braked[i] - clipped[i]) * unclipped
                v[i] = _slowed(v[i], force - p[3, i] * v[i], p[5, i], step)
                y[i] = middle + v[i] * half
                track[k + 1, i] = y[i]
            continue
        if steady:
            for i in range(LANES):
                share[i] = 0.0
                before[i] = edges[0, k + earliest]
                after[i] = edges[0, k + earliest]
        else:
            # the window of this step: the last `part` of one step, the first of the next
            for i in range(LANES):
                at = k + shift[i]
                earlier[i], now[i], next_[i] = edges[0, at - 2], edges[0, at - 1], edges[0, at]
                cut[i], next_cut_[i] = edges[1, at - 1], edges[1, at]
            for i in range(LANES):
                later, next_cut = next_[i], next_cut_[i]
                first, end = now[i], 1.0 - part[i]
                old = cut[i] - end
                inside = 1.0 if old > 0.0 else 0.0
                old = old if old > 0.0 else 0.0
                changed = 1.0 if next_cut < end else 0.0
                stays = next_cut if next_cut < end else end
                b = first + (earlier[i] - first) * inside
                a = first + (later - first) * changed
                mean = earlier[i] * old + first * (part[i] - old + stays) + later * (end - stays)
                apart = b - a
                apart = apart if abs(apart) > 1e-12 else 1.0
                x = (mean - a) / apart
                before[i], after[i] = b, a
                x = x if x > 0.0 else 0.0
                share[i] = x if x < 1.0 else 1.0
        if profile:
            for i in range(LANES):
                one[i] = 0.0
            for part_of in range(1 if steady else 0, 2):
                for i in range(LANES):
                    limited = p[7, i] < np.inf
                    most = p[7, i] if limited else 0.0
                    weight = 1.0 - share[i] if part_of else share[i]
                    way = (after[i] if part_of else before[i]) - s[i]
                    long = h * weight if weight > 1e-6 else 1e-6 * h
                    # at which the step may end for the profile to come to rest at the command
                    brake = 0.5 * long * most
                    toward = rate[i] if way > 0.0 else -rate[i]
                    room = brake * brake + 2.0 * (most * abs(way) - brake * toward)
                    fastest = np.sqrt(room if room > brake * brake else brake * brake) - brake
                    fastest = fastest if fastest < p[6, i] / h else p[6, i] / h
                    change = clip(clip(way / long, fastest) - rate[i], most * long)
                    rate[i] += change
                    move = (rate[i] - 0.5 * change) * long
                    move = move if limited else clip(way, p[6, i] * weight)
                    moving = weight if limited else abs(move) * per_limit[i]
                    one[i] += weight * (s[i] + move) - 0.5 * moving * move
                    s[i] += move
            for i in range(LANES):
                curved = 1.0 if p[7, i] < np.inf or p[6, i] < np.inf else 0.0
                mean = one[i]
                one[i] = before[i] + (mean - before[i]) * curved
                two[i] = after[i] + (mean - after[i]) * curved
        elif slew:
            # a set-point that arrives within its part of the step waits there for the rest of it
            for i in range(LANES):
                one[i] = 0.0
            for part_of in range(1 if steady else 0, 2):
                for i in range(LANES):
                    weight = 1.0 - share[i] if part_of else share[i]
                    target = after[i] if part_of else before[i]
                    move = clip(target - s[i], p[6, i] * weight)
                    s[i] += move
                    one[i] += weight * s[i] - 0.5 * move * abs(move) * per_limit[i]
            for i in range(LANES):
                two[i] = one[i]
        else:
            for i in range(LANES):
                one[i] = before[i]
                two[i] = after[i]
        for i in range(LANES):
            drive[i], free[i], begin[i], error[i], mean_error[i] = 0.0, 0.0, 0.0, 0.0, 0.0
        for part_of in range(1 if steady else 0, 2):
            for i in range(LANES):
                x = two[i] if part_of else one[i]
                error[i] = x - (y[i] + v[i] * half)
            if firmware:
                for i in range(LANES):
                    x = error[i] - clip(error[i], p[16, i])
                    begin[i] = p[17, i] * clip(x * (1.0 / START_ERROR_RAD), 1.0)
                    error[i] = x + summed[i]
                    mean_error[i] += (1.0 - share[i] if part_of else share[i]) * x
            for i in range(LANES):
                weight = 1.0 - share[i] if part_of else share[i]
                demand = error[i] * p[0, i] - p[1, i] * v[i] + begin[i]
                reached = clip(demand, p[2, i])
                drive[i] += reached * weight
                free[i] += weight * (1.0 if reached == demand else 0.0)
        if firmware:  # its integral alone commands no more than the effort limit
            for i in range(LANES):
                summed[i] = clip(summed[i] + p[21, i] * mean_error[i], most_summed[i])
        if plain:
            for i in range(LANES):
                step = clipped[i] + (braked[i] - clipped[i]) * free[i]
                middle = y[i] + v[i] * half
                v[i] = _slowed(v[i], drive[i] - p[3, i] * v[i], p[5, i], step)
                y[i] = middle + v[i] * half
                track[k + 1, i] = y[i]
        else:
            if supply:
                _delayed(held, 1, k, shift, part, on)
                volt = held[2, k + pad]
                for i in range(LANES):
                    supplied = volt * on[i]
                    back = p[3, i] * (p[15, i] + (1.0 - p[15, i]) * on[i])
                    acting[i] = _acting(h * (p[1, i] * supplied * free[i] + back), h)
                    drive[i] = drive[i] * supplied - back * v[i]
            else:
                for i in range(LANES):
                    acting[i] = clipped[i] + (braked[i] - clipped[i]) * free[i]
                    drive[i] -= p[3, i] * v[i]
            for i in range(LANES):
                motor = clip(drive[i], p[14, i])
                acting[i] = h + (acting[i] - h) * (1.0 if motor == drive[i] else 0.0)
                drive[i], pull[i], limit[i] = motor, 0.0, p[5, i]
            if gravity:
                for i in range(LANES):
                    pull[i] = -p[18, i] * _sin(y[i] + v[i] * half - p[19, i])
            if friction:
                for i in range(LANES):
                    motor = drive[i]
                    standing = 1.0 / (1.0 + v[i] * v[i] * p[9, i])
                    of_load = p[10, i] * abs(motor) + p[11, i] * abs(pull[i])
                    limit[i] += p[8, i] * standing + (1.0 + p[13, i] * standing) * of_load
                    limit[i] += p[12, i] * motor * motor
            if flexible:  # the link pulls back at the motor with what accelerates it
                for i in range(LANES):
                    bent = y[i] + v[i] * half - (link[i] + link_speed[i] * half)
                    faster = (link_speed[i] + p[23, i] * bent + p[24, i] * v[i]) / (1.0 + p[24, i])
                    pull[i] -= p[22, i] * (faster - link_speed[i])
                    link[i] += (link_speed[i] + faster) * half
                    link_speed[i] = faster
            for i in range(LANES):
                middle = y[i] + v[i] * half
                v[i] = _slowed(v[i], drive[i] + pull[i], limit[i], acting[i])
                y[i] = middle + v[i] * half
                track[k + 1, i] = y[i]
        if backlash:
            for i in range(LANES):
                low, high = y[i] - p[20, i], y[i] + p[20, i]
                x = play[i] if play[i] > low else low
                play[i] = high if x > high else x
                track[k + 1, i] = play[i]


@njit(fastmath=SAFE, error_model="numpy")
def _linear(kind, values, ids, held, start, steps, h, shift, part, track):
    """As `_servo`, for the linear models: parameters, then the offset in the last column."""
    last = values.shape[1] - 1
    c, y, v, rest = _lanes(), _lanes(), _lanes(), _lanes()
    p = _table()
    for i in range(LANES):
        w = values[ids[i]]
        rest[i] = start - w[last]
        track[0, i] = rest[i]
        p[0, i] = w[0]
        p[1, i], p[2, i], y[i], v[i] = 0.0, 0.0, 0.0, 0.0
        if kind == 2:
            p[1, i] = np.exp(-h / w[1])
        elif kind == 3:
            p[1, i] = h * w[1] * w[1]
            p[2, i] = 1.0 / (1.0 + 2 * h * w[2] * w[1] + (h * w[1]) ** 2)
    for k in range(steps):
        _delayed(held, 0, k, shift, part, c)
        for i in range(LANES):
            moved = c[i] - rest[i]
            if kind == 1:
                y[i] = moved
            elif kind == 2:
                y[i] = p[1, i] * y[i] + (1 - p[1, i]) * moved
            else:  # backward Euler: stable for any frequency
                v[i] = (v[i] + p[1, i] * (moved - y[i])) * p[2, i]
                y[i] += h * v[i]
            track[k + 1, i] = rest[i] + y[i] * p[0, i]


@njit(fastmath=SAFE, error_model="numpy")
def _sparse(values, ids, held, start, steps, h, shift, part, track):
    """As `_servo`, for the equation of motion of `servo_models.sparse_equation`."""
    last = values.shape[1] - 1
    c, y, v = _lanes(), _lanes(), _lanes()
    p = _table()
    for i in range(LANES):
        w = values[ids[i]]
        y[i], v[i] = start - w[last], 0.0
        track[0, i] = y[i]
        p[0, i], p[1, i], p[2, i] = w[0] * h, w[1] * h, w[2]
        p[3, i], p[4, i], p[5, i] = 0.5 * h * w[3], 0.5 * h * w[4], w[5] * h
    for k in range(steps):
        _delayed(held, 0, k, shift, part, c)
        for i in range(LANES):
            error = c[i] - y[i]
            loss = p[3, i] + abs(v[i]) * p[4, i]
            x = v[i] - v[i] * loss
            x += p[0, i] * error
            x += clip(error, p[2, i]) * p[1, i]
            x -= clip(x, p[5, i])
            v[i] = x / (loss + 1.0)
            y[i] += v[i] * h
            track[k + 1, i] = y[i]


@njit(fastmath=SAFE, error_model="numpy")
def _simulate(
    kind, values, dead_time, ids, held, edges, until, gain, load, start, steps, pad, h, track
):  # fmt: skip
    part, shift = _lanes(), np.zeros(LANES, np.int64)
    for i in range(LANES):
        whole_steps = int(np.floor(dead_time[ids[i]]))
        shift[i], part[i] = pad - whole_steps, dead_time[ids[i]] - whole_steps
    if kind == SERVO:
        _servo(
            values, ids, held, edges, until, gain, load, start, steps, pad, h, shift, part, track
        )
    elif kind == SPARSE:
        _sparse(values, ids, held, start, steps, h, shift, part, track)
    else:
        _linear(kind, values, ids, held, start, steps, h, shift, part, track)


@njit(inline="always")
def _fill_lanes(first, order, ids):
    """Fill `ids` with candidates from `first` on, the first repeated where there are too few."""
    used = min(LANES, len(order) - first)
    for i in range(LANES):
        ids[i] = order[first + (i if i < used else 0)]
    return used


@njit(fastmath=SAFE, error_model="numpy", inline="always")
def _positions_at(track, moment, steps, out):
    """Positions within a step, on the parabola of the accelerations before and after it."""
    row = min(int(moment), steps - 1)
    part = moment - row
    before, after = max(row - 1, 0), min(row + 2, steps)
    bent = 0.25 * part * (1.0 - part)
    of_low, of_high = 1.0 - part + bent, part + bent
    for i in range(LANES):
        near = of_low * track[row, i] + of_high * track[row + 1, i]
        out[i] = near - bent * (track[before, i] + track[after, i])


_POSITIONS, _RESIDUALS, _COSTS, _MOMENTS = range(4)
_NONE, _NO_TABLE = np.empty(0), np.empty((0, 0))


@njit(cache=True, nogil=True, fastmath=SAFE, error_model="numpy")
def _evaluate(
    task, order, kind, values, dead_time, held, edges, gain, load, start, pad, h, step, reading,
    noise, later, out, total,
):  # fmt: skip
    """Simulate each candidate and do one of four tasks: one function, compiled once."""
    count, last, samples = len(values), values.shape[1] - 1, len(step)
    steps = held.shape[1] - pad
    if task == _RESIDUALS or task == _COSTS:
        last_step = -1.0
        for n in range(samples):
            last_step = max(last_step, step[n])
        steps = min(int(np.ceil(last_step)) + 2, steps)
    ids, track = np.zeros(LANES, np.int64), np.empty((steps + 1, LANES))
    offset, cost, error_sum, position = _lanes(), _lanes(), _lanes(), _lanes()
    per_noise = 1.0 / noise
    until = np.full(edges.shape[1], edges.shape[1] - 1)
    for k in range(edges.shape[1] - 2, -1, -1):
        until[k] = until[k + 1] if edges[0, k] == edges[0, k + 1] else k
    for first in range(0, count, LANES):
        used = _fill_lanes(first, order, ids)
        _simulate(
            kind,
            values,
            dead_time,
            ids,
            held,
            edges,
            until,
            gain,
            load,
            start,
            steps,
            pad,
            h,
            track,
        )
        for i in range(LANES):
            offset[i], cost[i] = values[ids[i], last], 0.0
        if task == _POSITIONS:
            for k in range(steps + 1):
                for i in range(used):
                    out[k, ids[i]] = track[k, i] + offset[i]
        elif task == _RESIDUALS:
            for n in range(samples):
                _positions_at(track, step[n], steps, position)
                for i in range(used):
                    out[ids[i], n] = position[i] + offset[i] - reading[n]
        elif task == _COSTS:
            for n in range(samples):
                _positions_at(track, step[n], steps, position)
                read = reading[n]
                for i in range(LANES):
                    r = (position[i] + offset[i] - read) * per_noise
                    cost[i] += np.sqrt(1.0 + r * r) - 1.0
            for i in range(used):
                out[0, ids[i]] = cost[i]
        else:
            for m in range(len(later)):
                for i in range(LANES):
                    error_sum[i], cost[i] = 0.0, 0.0
                for n in range(samples):
                    _positions_at(track, max(step[n] - later[m], 0.0), steps, position)
                    read = reading[n]
                    for i in range(LANES):
                        error = position[i] + offset[i] - read
                        error_sum[i] += error
                        cost[i] += error * error
                for i in range(used):
                    out[m, ids[i]], total[m, ids[i]] = error_sum[i], cost[i]


Simulated = tuple[int, NDArray, NDArray, NDArray, NDArray, float, NDArray, float, int, float]
"""What every task takes: candidates on one run.

kind : int
    `SERVO`, `SPARSE`, or a number of `LINEAR`.
values : ndarray, shape (candidates, columns)
    Of a servo: `COLUMNS`.
dead_time : ndarray, shape (candidates,)
    In steps.
held : ndarray, shape (1 or 3, pad + steps)
    Mean command of each step [rad], after `pad` steps of rest; then, where they are not always 1,
    the share of the step for which the torque is on, and the supply voltage over the reference.
edges : ndarray, shape (2, pad + steps)
    Command at the end of each step [rad], and the share of the step before it came (`edges_of`).
gain : float
    P gain over the one that `stiffness` is for.
load : ndarray, shape (3,)
    Inertia [kg·m²], gravity [N·m], hanging position [rad].
start : float
    Where the joint rests [rad].
pad : int
h : float
    Duration of a step [s].
"""


def edges_of(
    mean: NDArray[np.float64], end: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """When within each step a held command changed, shape (2, steps): see `Simulated`.

    `mean` of shape (steps,): command of each step [rad]. `end` of shape (steps,): command at the
    end of each step [rad]; by default commands change on steps.
    """
    if end is None:
        return np.stack([mean, np.zeros_like(mean)])
    before = np.concatenate([end[:1], end[:-1]])
    apart = before - end
    share = (mean - end) / np.where(apart == 0, 1.0, apart)
    return np.stack([end, np.clip(share, 0.0, 1.0)])


def compiled() -> bool:
    """Whether the simulation has been compiled on this machine; else its first call does it."""
    folder = _evaluate.stats.cache_path
    return folder is None or any(Path(folder).glob(f"{Path(__file__).stem}._evaluate-*.nbi"))


def _order(simulated: Simulated) -> NDArray[np.int64]:
    """Candidates in order of their dead time: those abreast meet a command in about one step."""
    return np.argsort(simulated[2])


def positions(*simulated: *Simulated) -> NDArray[np.float64]:
    """Readings at the edges of the steps, shape (steps + 1, candidates) [rad]."""
    values, held, pad = simulated[1], simulated[3], simulated[8]
    out = np.empty((held.shape[1] - pad + 1, len(values)))
    _evaluate(_POSITIONS, _order(simulated), *simulated, _NONE, _NONE, 1.0, _NONE, out, _NO_TABLE)
    return out


def residuals(
    *simulated: *Simulated, step: NDArray[np.float64], reading: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Model minus reading, shape (candidates, samples) [rad].

    `*simulated`: see `Simulated`. `step`, `reading` of shape (samples,): when the readings were
    measured, in steps, and their values [rad].
    """
    out = np.empty((len(simulated[1]), len(step)))
    _evaluate(_RESIDUALS, _order(simulated), *simulated, step, reading, 1.0, _NONE, out, _NO_TABLE)
    return out


def costs(
    *simulated: *Simulated, step: NDArray[np.float64], reading: NDArray[np.float64],
    noise: float,
) -> NDArray[np.float64]:  # fmt: skip
    """Soft-L1 cost, Σ sqrt(1 + r²) − 1 with r a residual over `noise` [rad]: shape (candidates,).

    Parameters as for `residuals`.
    """
    out = np.empty((1, len(simulated[1])))
    _evaluate(_COSTS, _order(simulated), *simulated, step, reading, noise, _NONE, out, _NO_TABLE)
    return out[0]


def moments_if_later(
    *simulated: *Simulated, step: NDArray[np.float64], reading: NDArray[np.float64],
    later: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Sums of the residuals and of their squares if every candidate had moved later.

    `*simulated`: see `Simulated`. `step`, `reading` of shape (samples,): when the readings were
    measured, in steps, and their values [rad]. `later` of shape (delays,): in steps. Returns
    both of shape (delays, candidates), in rad and rad².
    """
    total, square = np.zeros((2, len(later), len(simulated[1])))
    _evaluate(_MOMENTS, _order(simulated), *simulated, step, reading, 1.0, later, total, square)
    return total, square
