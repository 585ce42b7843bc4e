"""Recordings of slow strokes of emulated servos with play in their gears, without a bus."""

from functools import cache

import numpy as np
import pandas as pd

from pupper_sysid.sim.emulator.pendulum import (
    BenchSpec,
    Pendulum,
    PendulumServo,
    PendulumServoParameters,
    draw_bench,
)
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.sweep.bench import STROKE_RAD, STROKE_SPEEDS_RAD_S
from pupper_sysid.sysid.sweep.excitation import LEAD_IN_S, after, strokes

PERIOD_S = 0.02


@cache
def stroked(
    seed: int,
    backlash_deg: float,
    dead_zone: int,
    gains: tuple[int, ...] = (8, 32),
    mass_kg: float = 0.1,
    count: int = 1,
) -> tuple[Recording, PendulumServoParameters]:
    """Strokes at several gains of a servo that is drawn, `count` per speed; its true numbers."""
    rng = np.random.default_rng(seed)
    registers = {"dead_zone_cw": dead_zone, "dead_zone_ccw": dead_zone}
    spec = BenchSpec(backlash_rad=float(np.radians(backlash_deg)))
    true = draw_bench(rng, Pendulum(mass_kg, 0.1) if mass_kg else None, spec).loaded[0]
    offset, duration = strokes(STROKE_RAD, STROKE_SPEEDS_RAD_S, count)
    moved = after(LEAD_IN_S, offset)
    zero, tables, quantum = rng.normal(0, 0.002), [], true.count_rad
    for number, gain in enumerate(gains):
        servo = PendulumServo(true, 0.0, registers | {"p": gain})
        time = np.arange(0.0, LEAD_IN_S + duration, PERIOD_S) + rng.uniform(0, 2e-4)
        command, position = moved(time), np.empty(len(time))
        for k, (at, goal) in enumerate(zip(time, command, strict=True)):
            servo.command(at, float(np.round(goal / quantum) * quantum))
            # the reading follows the command by what a serial line takes
            position[k] = servo.position_at(at + 0.001)
        position += zero + rng.normal(0, 0.0004, len(time))
        tables.append(
            pd.DataFrame(
                {
                    "send_time_s": time, "read_time_s": time + 0.001, "trial": number,
                    "joint": "bench", "frequency_hz": np.nan, "command_rad": command,
                    "position_rad": np.round(position / quantum) * quantum, "p_gain": float(gain),
                }
            )
        )  # fmt: skip
    load = {"loads": {"bench": {"mass_kg": mass_kg, "length_m": 0.1}}} if mass_kg else {}
    header = load | {
        "bus": {"command_quantum_rad": quantum},
        "servos": {"bench": {"d_gain": 32}},
        "readings": "live",
    }
    return Recording.from_frame(pd.concat(tables, ignore_index=True), metadata=header), true
