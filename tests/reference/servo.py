"""The servo's equations in NumPy, one step a line: what `sysid.fit.kernel` compiles.

Slow and readable. The compiled form is compared with it term by term; DelayedPD and MuJoCo are
compared with the compiled form elsewhere, so an error here shows, too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.delayed_pd import FRICTION_IMPEDANCE
from pupper_sysid.servo_models.loaded_servo import START_ERROR_RAD
from pupper_sysid.sysid.fit.kernel import ABSENT, COLUMNS


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


def servo(
    row: NDArray[np.float64],
    dead_time: float,
    held: NDArray[np.float64],
    gain: float,
    load: NDArray[np.float64],
    start: float,
    pad: int,
    h: float,
) -> NDArray[np.float64]:
    """Readings at the edges of the steps, shape (steps + 1,); parameters as for the kernel."""
    w = dict(zip(COLUMNS, row, strict=True))
    inertia = w["armature"] + load[0]
    command = delayed(held[0], dead_time, pad)
    on = delayed(held[1], dead_time, pad) if len(held) > 1 else np.ones(len(command))
    volts = held[2, pad:] if len(held) > 1 else np.ones(len(command))
    y = setpoint = shown = start - w["offset_rad"]
    v = rate = 0.0
    out = [shown]
    for k in range(len(command)):
        way = command[k] - setpoint
        if np.isfinite(w["acceleration_limit"]):
            fastest = min(np.sqrt(2 * w["acceleration_limit"] * abs(way)), w["velocity_limit"])
            wanted_rate = np.clip(way / h, -fastest, fastest)
            change = w["acceleration_limit"] * h
            rate += np.clip(wanted_rate - rate, -change, change)
            setpoint += rate * h
        else:
            setpoint += np.clip(way, -w["velocity_limit"] * h, w["velocity_limit"] * h)
        error = setpoint - y
        error -= np.clip(error, -w["dead_zone_rad"], w["dead_zone_rad"])
        begin = (
            w["start_duty"] * np.clip(error / START_ERROR_RAD, -1, 1) if w["start_duty"] else 0.0
        )
        effort = w["effort_limit"]
        wanted = w["stiffness"] * gain * error - w["damping"] * v + begin * effort
        drive = np.clip(wanted, -effort, effort)
        share = volts[k] * on[k]
        back = w["back_emf"] * (w["off_brake"] + (1 - w["off_brake"]) * on[k])
        drawn = drive * share - back * v
        motor = np.clip(drawn, -w["torque_limit"], w["torque_limit"])
        damping = back + (w["damping"] * share if drive == wanted else 0.0)
        if motor != drawn:
            damping = 0.0
        weight = -(load[1] + w["gravity_nm"]) * np.sin(y - load[2] - w["hanging_rad"])
        standing = 1 / (1 + (v / w["stribeck_speed"]) ** 2)
        friction = w["friction_loss"] + w["stribeck_friction"] * standing
        friction += (1 + w["load_friction_static"] * standing) * (
            w["load_friction_motor"] * abs(motor) + w["load_friction_load"] * abs(weight)
        )
        friction += w["load_friction_quadratic"] * motor**2
        force = motor + weight
        stop = -FRICTION_IMPEDANCE * (inertia * v / h + force)
        force += np.clip(stop, -friction, friction)
        v += force * h / (inertia + h * damping)
        y += v * h
        half = w["backlash_rad"] / 2
        shown = min(max(shown, y - half), y + half)
        out.append(shown)
    return np.array(out) + w["offset_rad"]
