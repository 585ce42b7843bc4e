"""A servo under load at a P gain that was not fitted: emulated pendulums with bad reads and drops.

    .venv/bin/python benchmarks/emulated_pendulums.py --count 3 --seed 1

Each servo is stepped by MuJoCo at 1 kHz, with its position loop in counts, a dead zone, a least
force and the D gain of its firmware. At P 8, 32 (and 16, unseen) it follows a chirp and random
steps, and is lifted and dropped limp. One reading in a hundred of the fitted runs is bad: away by
0.02 to 1.5 rad, and back at the next. The unseen runs are predicted from the calibration as it is
written; *true numbers* is the same model with the servo's own, *readings* their noise and counts.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace

from shared import free_run_error_rad, mrad, print_rows  # isort: skip

import numpy as np
import pandas as pd
import tyro
from numpy.typing import NDArray

from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.loaded_servo import Load, LoadedServo, LoadedServoParameters
from pupper_sysid.sim.emulator.pendulum import (
    BenchSpec,
    Pendulum,
    PendulumServo,
    PendulumServoParameters,
    draw_bench,
)
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.recordings.recording import Recording

LOOP_S, READ_AFTER_S, DURATION_S, RELEASE_S = 0.01, 0.002, 6.0, 2.5
GAINS, UNSEEN = (8, 32), 16
STEP_S = 2e-4
MOTIONS = ("chirp", "steps", "drop")
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
    bad: float,
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
    wrong = 1 + np.flatnonzero(rng.random(len(reading) - 2) < bad)
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


def modelled(
    spec: BenchSpec, servo: PendulumServoParameters, run: Recording
) -> NDArray[np.float64]:
    """Positions at the readings of an unseen run, by the model with the servo's numbers [rad]."""
    loop = spec.loop(dict(spec.factory) | dict(spec.registers) | {"p": UNSEEN}, servo)
    numbers = LoadedServoParameters(
        duty_per_rad=servo.duty_per_rad, duty_s_per_rad=loop.d, stall_torque=servo.torque_nm,
        back_emf=servo.back_emf_nm_s_rad, armature=servo.armature_kg_m2,
        friction_loss=servo.friction_nm, dead_time_s=servo.dead_time_s,
        acceleration_limit=loop.top_acceleration_rad_s2,
    )  # fmt: skip
    load = Load(servo.load_inertia_kg_m2, servo.gravity_nm, 0.0)
    model = LoadedServo(numbers, UNSEEN, load, STEP_S)
    model.reset(0.0)
    columns = ("send_time_s", "read_time_s", "command_rad", "torque_enabled")
    sent, read, command, on = (run.table[name].to_numpy() for name in columns)
    edges = sent[0] + STEP_S * np.arange(1 + round((read[-1] - sent[0]) / STEP_S))
    row = np.searchsorted(sent, edges[:-1] + 0.5 * STEP_S, "right") - 1
    return np.interp(read, edges, [0.0, *model.rollout(command[row], on[row])])


def main(
    count: int = 3, seed: int = 0, bad: float = 0.01, servos: tuple[str, ...] = tuple(SERVOS)
) -> None:
    """Print the table; `bad` is the share of bad readings."""

    def rows() -> Iterable[list[object]]:
        for name in servos:
            spec, load = SERVOS[name]
            for number in range(count):
                rng = np.random.default_rng([seed, number, sum(map(ord, name))])
                (servo,) = draw_bench(rng, load, spec).loaded
                servo = replace(servo, hanging_rad=0.0)
                fitted = [
                    recorded(spec, servo, gain, motion, bad, rng)[0]
                    for gain in GAINS for motion in MOTIONS
                ]  # fmt: skip
                unseen = [recorded(spec, servo, UNSEEN, m, 0.0, rng) for m in MOTIONS]
                begun = time.process_time()
                result = calibrate(fitted)
                spent = time.process_time() - begun
                errors = [
                    (
                        free_run_error_rad(run, result.calibration, JOINT),
                        rms(run.table["position_rad"].to_numpy() - modelled(spec, servo, run)),
                        rms(run.table["position_rad"].to_numpy() - true),
                    )
                    for run, true in unseen
                ]  # fmt: skip
                error, of_true_numbers, noise = np.sqrt(np.mean(np.square(errors), axis=0))
                block = result.calibration.joint(JOINT).servo
                yield [
                    name, number, mrad(error), mrad(of_true_numbers), mrad(noise),
                    f"{error / of_true_numbers:.2f}",
                    ", ".join(mrad(one) for one, *_ in errors),
                    "–" if block is None else block.structure, f"{spent:.0f}",
                ]  # fmt: skip

    print_rows(
        ("servo", "number", "unseen P 16, mrad", "true numbers", "readings", "ratio",
         ", ".join(MOTIONS), "structure", "processor s"), rows(),
    )  # fmt: skip


if __name__ == "__main__":
    tyro.cli(main)
