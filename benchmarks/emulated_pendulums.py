"""A servo under load at a P gain that was not fitted: emulated pendulums with bad reads and drops.

    .venv/bin/python benchmarks/emulated_pendulums.py --count 3 --seed 1

Each servo is stepped by MuJoCo at 1 kHz, with its position loop in counts, a dead zone, a least
force and the D gain of its firmware. At P 8, 32 (and 16, unseen) it follows a chirp and random
steps, and is lifted and dropped limp. One reading in a hundred of the fitted runs is bad: away by
0.02 to 1.5 rad, and back at the next. The unseen runs are predicted from the calibration as it is
written; *the servo itself* is the emulated servo without noise and counts.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace

from shared import mrad, print_rows  # isort: skip

import numpy as np
import pandas as pd
import tyro
from numpy.typing import NDArray

from pupper_sysid.sim.emulator.pendulum import (
    BenchSpec,
    Pendulum,
    PendulumServo,
    PendulumServoParameters,
    draw_bench,
)
from pupper_sysid.sysid.compare.compare import compare
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.recordings.recording import Recording

LOOP_S, READ_AFTER_S, DURATION_S, RELEASE_S = 0.01, 0.002, 6.0, 2.5
GAINS, UNSEEN = (8, 32), 16
MOTIONS = ("chirp", "steps", "drop")
BAD = 0.01
JOINT = "bench"
SERVOS = {
    "STS3215": (BenchSpec(), Pendulum(0.25, 0.12)),
    "STS3215, acceleration 254": (
        BenchSpec(registers=(("acceleration", 254),)), Pendulum(0.25, 0.12)),
    # 4.9 N·m and 7.9 rad/s at 12 V by its data sheet
    "STS3250": (
        BenchSpec(torque_nm=4.9, back_emf_nm_s_rad=0.62, friction_nm=0.12, armature_kg_m2=0.03,
                  model="STS3250", supply_v=12.0), Pendulum(0.6, 0.15)),
}  # fmt: skip


def commands(motion: str, rng: np.random.Generator) -> NDArray:
    """Commands of a run [rad]."""
    time_s = LOOP_S * np.arange(round(DURATION_S / LOOP_S))
    if motion == "chirp":
        return 0.9 * np.sin(1.2 * time_s**2)
    if motion == "steps":
        return rng.uniform(-1.0, 1.0, 20)[(time_s / 0.4).astype(int)]
    return -1.4 * np.clip(time_s / 2.0, 0, 1)


def recorded(
    spec: BenchSpec,
    servo: PendulumServoParameters,
    gain: int,
    motion: str,
    bad: bool,
    rng: np.random.Generator,
) -> tuple[Recording, NDArray[np.float64]]:
    """One run, and the true positions at its readings."""
    count = servo.count_rad
    registers = dict(spec.registers) | {"p": gain}
    emulated = PendulumServo(servo, 0.0, registers, spec.factory, spec.loop)
    sent = 0.05 + LOOP_S * np.arange(round(DURATION_S / LOOP_S))
    sent = sent + 2e-4 * np.abs(rng.standard_normal(len(sent)))
    command = np.round(commands(motion, rng) / count) * count
    on = np.ones(len(sent))
    if motion == "drop":
        on[sent >= 0.05 + RELEASE_S] = 0.0
    true = np.empty(len(sent))
    for k, at in enumerate(sent):
        if on[k]:
            emulated.command(at, command[k])
        elif on[k - 1]:
            emulated.torque(at, False)
        true[k] = emulated.position_at(at + READ_AFTER_S)
    noisy = true + spec.reading_noise_rad * rng.standard_normal(len(true))
    reading = np.round(noisy / count) * count
    if bad:
        wrong = 1 + np.flatnonzero(rng.random(len(reading) - 2) < BAD)
        size = np.exp(rng.uniform(np.log(0.02), np.log(1.5), len(wrong)))
        reading[wrong] += np.round(size * rng.choice([-1, 1], len(wrong)) / count) * count
    table = pd.DataFrame({
        "send_time_s": sent, "read_time_s": sent + READ_AFTER_S, "command_rad": command,
        "position_rad": reading, "torque_enabled": on, "joint": JOINT, "trial": 0,
        "frequency_hz": np.nan,
    })  # fmt: skip
    setup = {
        "model": spec.model, "p_gain": gain, "d_gain": 32, "i_gain": 0,
        "supply_voltage_v": spec.supply_v,
        "registers": {k: v for k, v in (spec.factory | dict(spec.registers)).items()
                      if k not in ("p", "i", "d")},
    }  # fmt: skip
    header = {
        "readings": "live", "joints": [JOINT], "start_pose_rad": {JOINT: 0.0},
        "servos": {JOINT: setup},
        "loads": {JOINT: {"mass_kg": servo.mass_kg, "length_m": servo.length_m}},
    }  # fmt: skip
    return Recording.from_frame(table, metadata=header, name=f"{motion}_p{gain}"), true


def main(count: int = 3, seed: int = 0) -> None:
    """Print the table."""

    def rows() -> Iterable[list[object]]:
        for name, (spec, load) in SERVOS.items():
            for number in range(count):
                rng = np.random.default_rng([seed, number, sum(map(ord, name))])
                (servo,) = draw_bench(rng, load, spec).loaded
                servo = replace(servo, hanging_rad=0.0)
                fitted = [
                    recorded(spec, servo, gain, motion, True, rng)[0]
                    for gain in GAINS for motion in MOTIONS
                ]  # fmt: skip
                unseen = [recorded(spec, servo, UNSEEN, m, False, rng) for m in MOTIONS]
                begun = time.process_time()
                result = calibrate(fitted)
                spent = time.process_time() - begun
                found = compare([r for r, _ in unseen], [result.calibration], JOINT)
                scored = next(s for n, s in found.models.items() if "linear" not in n.lower())
                own = np.concatenate([
                    r.table["position_rad"].to_numpy() - true for r, true in unseen
                ])  # fmt: skip
                floor, error = float(np.sqrt(np.mean(own**2))), scored.joints[JOINT].rmse_held_rad
                block = result.calibration.joint(JOINT).servo
                yield [
                    name, number, mrad(error), mrad(floor), f"{error / floor:.2f}",
                    "–" if block is None else block.structure,
                    f"{result[JOINT].delayed_pd.scores.rmse_fresh_rad * 1e3:.1f}", f"{spent:.0f}",
                ]  # fmt: skip

    print_rows(
        ("servo", "number", "unseen P 16, mrad", "the servo itself", "ratio", "structure",
         "fitted, mrad", "processor s"), rows(),
    )  # fmt: skip


if __name__ == "__main__":
    tyro.cli(main)
