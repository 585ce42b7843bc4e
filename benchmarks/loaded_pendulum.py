"""How well a servo under load is found: random emulated servos with a pendulum at three gains.

    .venv/bin/python benchmarks/loaded_pendulum.py --servos 40 --seed 0

Each servo is stepped by MuJoCo at 1 kHz, with counts, a dead zone, a minimum start force and a
derivative gain in its firmware, which the fit's base does not have. Per gain it follows a chirp and
random steps, and is lifted and dropped limp. Printed: median error of what the fit finds, and how
often its 90 % intervals hold the truth.
"""

from __future__ import annotations

import argparse
import os
import time
from concurrent.futures import ProcessPoolExecutor

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.sim.emulator.servos.pendulum import PendulumServo, PendulumServoParameters
from pupper_sysid.sysid.loaded.joint_fit import LoadedFit, fit_loaded_joint
from pupper_sysid.sysid.recordings.recording import Recording

LOOP_S, READ_AFTER_S, DURATION_S = 0.01, 0.002, 6.0
COUNT_RAD = 2 * np.pi / 4096
GAINS = (8, 16, 32)
QUANTITIES = {
    "torque at full duty": ("stall_torque", "torque_nm"),
    "armature": ("armature", "armature_kg_m2"),
    "friction": ("friction_loss", "friction_nm"),
    "back-EMF": ("back_emf", "back_emf_nm_s_rad"),
    "dead time": ("dead_time_s", "dead_time_s"),
}


def random_servo(rng: np.random.Generator) -> PendulumServoParameters:
    """A servo from 0.4 to 4 N·m, and a mass that it can lift."""
    torque = float(np.exp(rng.uniform(np.log(0.4), np.log(4.0))))
    length = float(rng.uniform(0.08, 0.15))
    gravity = torque * rng.uniform(0.15, 0.4)
    inertia = gravity / 9.81 * length
    return PendulumServoParameters(
        torque_nm=torque,
        duty_per_rad=float(rng.uniform(0.03, 0.12)),
        back_emf_nm_s_rad=float(torque / rng.uniform(4.0, 12.0)),
        friction_nm=float(torque * rng.uniform(0.02, 0.1)),
        armature_kg_m2=float(inertia * np.exp(rng.uniform(np.log(0.15), np.log(2.0)))),
        dead_time_s=float(rng.uniform(0.004, 0.03)),
        mass_kg=float(gravity / 9.81 / length),
        length_m=length,
        count_rad=COUNT_RAD,
    )


def motion(kind: str, time_s: NDArray, rng: np.random.Generator) -> NDArray:
    """Commands of a run [rad]."""
    if kind == "chirp":
        return 0.9 * np.sin(1.2 * time_s**2)
    if kind == "steps":
        return rng.uniform(-1.0, 1.0, 20)[(time_s / 0.4).astype(int)]
    return -1.4 * np.clip(time_s / 2.0, 0, 1)


def record(servo: PendulumServoParameters, gain: int, kind: str, rng: np.random.Generator):
    """Rows of one run."""
    registers = {"p": gain, "d": 0, "min_start_force": int(rng.integers(0, 16)),
                 "dead_zone_cw": 1, "dead_zone_ccw": 1}  # fmt: skip
    emulated = PendulumServo(servo, 0.0, registers)
    sent = LOOP_S * np.arange(int(DURATION_S / LOOP_S)) + 0.05
    commands = motion(kind, sent - 0.05, rng)
    on = np.ones(len(sent))
    rows = []
    for k, at in enumerate(sent):
        if kind == "drop" and at >= 2.5:
            if on[k - 1]:
                emulated.torque(at, False)
            on[k] = 0.0
        else:
            emulated.command(at, round(commands[k] / COUNT_RAD) * COUNT_RAD)
        position = emulated.position_at(at + READ_AFTER_S)
        rows.append((at, at + READ_AFTER_S, round(commands[k] / COUNT_RAD) * COUNT_RAD,
                     round(position / COUNT_RAD) * COUNT_RAD, on[k]))  # fmt: skip
    return rows


def recordings(servo: PendulumServoParameters, rng: np.random.Generator) -> list[Recording]:
    """A chirp, steps and a drop at every gain."""
    found = []
    for gain in GAINS:
        for kind in ("chirp", "steps", "drop"):
            columns = [
                "send_time_s",
                "read_time_s",
                "command_rad",
                "position_rad",
                "torque_enabled",
            ]
            table = pd.DataFrame(record(servo, gain, kind, rng), columns=columns)
            table["joint"], table["trial"], table["frequency_hz"] = "servo", 0, np.nan
            load = {"mass_kg": servo.mass_kg, "length_m": servo.length_m}
            header = {"readings": "live", "servos": {"servo": {"p_gain": gain}},
                      "loads": {"servo": load}, "joints": ["servo"]}  # fmt: skip
            found.append(Recording.from_frame(table, metadata=header, name=f"{kind} P {gain}"))
    return found


def one(seed: tuple[int, int]) -> tuple[PendulumServoParameters, LoadedFit, float]:
    """Draw, record and fit one servo."""
    rng = np.random.default_rng(seed)
    servo = random_servo(rng)
    trials = [t for r in recordings(servo, rng) for t in r.trials("servo")]
    began = time.perf_counter()
    return servo, fit_loaded_joint("servo", trials, 0), time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--servos", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    seeds = [(asked.seed, n) for n in range(asked.servos)]
    with ProcessPoolExecutor(asked.workers) as pool:
        every = []
        for servo, fit, seconds in pool.map(one, seeds):
            every.append((servo, fit))
            said = ", ".join(
                f"{name} {fit.numbers[own].value / getattr(servo, true) - 1:+.0%}"
                for name, (own, true) in QUANTITIES.items()
            )
            print(f"{len(every):3d} {seconds:5.0f} s {fit.structure:40s} {said}", flush=True)
    print(f"\n{'':22s}{'median error':>14s}{'90 % hold':>12s}")
    held_all = []
    for name, (own, true) in QUANTITIES.items():
        found = [fit.numbers[own] for _, fit in every]
        truth = np.array([getattr(servo, true) for servo, _ in every])
        value = np.array([f.value for f in found])
        held = [f.low <= t <= f.high for f, t in zip(found, truth, strict=True)]
        held_all += held
        error = (
            f"{1e3 * np.median(np.abs(value - truth)):.1f} ms"
            if name == "dead time"
            else f"{np.median(np.abs(value / truth - 1)):.1%}"
        )
        print(f"{name:22s}{error:>14s}{np.mean(held):>12.0%}")
    print(f"{'all':22s}{'':>14s}{np.mean(held_all):>12.0%}")


if __name__ == "__main__":
    main()
