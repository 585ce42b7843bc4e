"""The servo's equations in NumPy, one step a line: what `servo_models.kernel` compiles.

Slow and readable. The compiled form is compared with it term by term; DelayedPD and MuJoCo are
compared with the compiled form elsewhere, so an error here shows, too.
"""

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.kernel import ABSENT, COLUMNS
from pupper_sysid.servo_models.loaded_servo import START_ERROR_RAD


def columns(**numbers: float) -> NDArray[np.float64]:
    """One candidate's columns; terms that are not named are absent."""
    row = ABSENT.copy()
    for name, value in numbers.items():
        row[COLUMNS.index(name)] = value
    return row


def delayed(held: NDArray[np.float64], dead_time: float, pad: int) -> NDArray[np.float64]:
    """A held signal later by a dead time in steps, linear between steps; shape (steps,)."""
    whole = int(np.floor(dead_time))
    part = dead_time - whole
    k = np.arange(len(held) - pad) + pad - whole
    return held[k] + part * (held[k - 1] - held[k])


def window(edges: NDArray[np.float64], at: float) -> list[tuple[float, float]]:
    """Values of a held command and for how long, from `at` to `at + 1` steps."""
    changes = {0.0: edges[0, 0]}  # time of a change: the value from there on
    for m in range(max(int(at) - 2, 0), int(at) + 3):
        if m < edges.shape[1]:
            changes[m + edges[1, m]] = edges[0, m]
    times = sorted(changes)
    parts = []
    for start, stop in zip(times, [*times[1:], np.inf], strict=True):
        long = min(stop, at + 1) - max(start, at)
        if long > 0:
            parts.append((changes[start], long))
    return parts


def servo(
    row: NDArray[np.float64],
    dead_time: float,
    held: NDArray[np.float64],
    edges: NDArray[np.float64],
    gain: float,
    load: NDArray[np.float64],
    start: float,
    pad: int,
    h: float,
) -> NDArray[np.float64]:
    """Readings at the edges of the steps, shape (steps + 1,); parameters as for the kernel."""
    w = dict(zip(COLUMNS, row, strict=True))
    inertia = (w["armature"] + load[0]) * (1 - w["link_share"])
    turn = 2 * np.pi * w["link_hz"]
    link_inertia = (w["armature"] + load[0]) * w["link_share"]
    on = delayed(held[1], dead_time, pad) if len(held) > 1 else np.ones(held.shape[1] - pad)
    volts = held[2, pad:] if len(held) > 1 else np.ones(len(on))
    y = setpoint = shown = start - w["offset_rad"]
    v = rate = summed = link_speed = 0.0
    link = y
    out = [shown]
    for k in range(len(on)):
        commands = window(edges, pad + k - dead_time)
        first, last = commands[0][0], commands[-1][0]
        mean = sum(c * long for c, long in commands)
        share = (
            np.clip((mean - last) / (first - last), 0, 1)
            if abs(first - last) > 1e-12
            else (np.clip(mean - last, 0, 1))
        )
        targets, moved = [], 0.0
        for command, part in ((first, share), (last, 1 - share)):
            way = command - setpoint
            if np.isfinite(limit := w["acceleration_limit"]):
                long = h * max(part, 1e-6)
                brake = limit * long / 2  # half of what the rate may change by
                toward = rate if way > 0 else -rate
                room = max(brake**2 + 2 * (limit * abs(way) - brake * toward), brake**2)
                fastest = min(np.sqrt(room) - brake, w["velocity_limit"])
                wanted_rate = np.clip(way / long, -fastest, fastest)
                change = np.clip(wanted_rate - rate, -limit * long, limit * long)
                rate += change
                move, moving = (rate - change / 2) * long, part
            else:
                most = w["velocity_limit"] * h * part if part > 0 else 0.0
                move = np.clip(way, -most, most)
                moving = abs(move) / (w["velocity_limit"] * h)
            setpoint += move
            moved += part * setpoint - moving * move / 2
        limited = np.isfinite(w["velocity_limit"]) or np.isfinite(w["acceleration_limit"])
        targets = [moved, moved] if limited else [first, last]
        middle = y + v * h / 2
        effort = w["effort_limit"]
        drive = free = mean_error = 0.0
        for target, part in zip(targets, (share, 1 - share), strict=True):
            error = target - middle
            error -= np.clip(error, -w["dead_zone_rad"], w["dead_zone_rad"])
            begin = w["start_duty"] * np.clip(error / START_ERROR_RAD, -1, 1) * effort
            mean_error += part * error
            wanted = w["stiffness"] * gain * (error + summed) - w["damping"] * v + begin
            drive += part * np.clip(wanted, -effort, effort)
            free += part * (abs(wanted) <= effort)
        most = effort / (w["stiffness"] * gain)
        summed = np.clip(summed + h * w["integral_per_s"] * mean_error, -most, most)
        back = w["back_emf"] * (w["off_brake"] + (1 - w["off_brake"]) * on[k])
        supply = volts[k] * on[k]
        drawn = drive * supply - back * v
        motor = np.clip(drawn, -w["torque_limit"], w["torque_limit"])
        if len(held) > 1:
            acting = over(h * (w["damping"] * supply * free + back) / inertia, h)
        else:
            braked = over(h * (w["damping"] + back) / inertia, h)
            acting = over(h * back / inertia, h) * (1 - free) + braked * free
        if motor != drawn:
            acting = h
        weight = -(load[1] + w["gravity_nm"]) * np.sin(middle - load[2] - w["hanging_rad"])
        if link_inertia > 0:
            bent, damping = middle - (link + link_speed * h / 2), 2 * w["link_damping_ratio"] * turn
            faster = (link_speed + h * (turn**2 * bent + damping * v)) / (1 + h * damping)
            pulled = link_inertia * (faster - link_speed) / h
            link, link_speed = link + h * (link_speed + faster) / 2, faster
        else:
            pulled = 0.0
        standing = 1 / (1 + (v / w["stribeck_speed"]) ** 2)
        friction = w["friction_loss"] + w["stribeck_friction"] * standing
        friction += (1 + w["load_friction_static"] * standing) * (
            w["load_friction_motor"] * abs(motor) + w["load_friction_load"] * abs(weight)
        )
        friction += w["load_friction_quadratic"] * motor**2
        force = motor + weight - pulled
        way = np.sign(v) if v else np.sign(force)
        slowed = v + (force - way * friction) / inertia * acting
        if v == 0 and abs(force) <= friction:
            new = 0.0
        elif slowed * way > 0:
            new = slowed
        else:  # friction turns where the velocity does
            rest = slowed / (slowed - v)
            new = (force - np.clip(force, -friction, friction)) / inertia * acting * rest
        v, y = new, middle + new * h / 2
        half = w["backlash_rad"] / 2
        shown = min(max(shown, y - half), y + half)
        out.append(shown)
    return np.array(out) + w["offset_rad"]


def over(x: float, h: float) -> float:
    """(1 - exp(-x)) / x of a step h, by the same approximation."""
    return h / (1 + x / 2 + x * x / 12)
