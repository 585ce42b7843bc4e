"""Sweep all twelve joints over each protocol emulator; compare what is found with the truth.

The recorder runs here and talks through the pseudo-terminal or the socket, in real time. The truth
of a joint's lag is that of a servo with the true parameters which gets the goals at the very times
at which the emulator's servo got them, without noise and every millisecond, as in
`lag_accuracy.py`. Beside it stands what the same robot gives without a protocol, in process and in
virtual time. The true dead time is what a model with steps of 2 ms has to have to lag as the
emulator's servos do in steps of 1 ms, and the time that commands take to the servo.

    .venv/bin/python benchmarks/protocol_sweep.py
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from emulators import KINDS, in_process, served

from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.connect import open_bus
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.step_size import delay_at_step
from pupper_sysid.sim.emulator.servos.free_air import PHYSICS_STEP_S, FreeAirServo
from pupper_sysid.sysid.feedback.poll_lattice import Readings, find_poll_lattice, readings
from pupper_sysid.sysid.identify.calibrate import calibrate
from pupper_sysid.sysid.lag.phase_slope import tone_lags, tone_weights
from pupper_sysid.sysid.lag.tone import tone_response
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.sweep.excitation import plan
from pupper_sysid.sysid.sweep.recorder import record

_STAMP_S = 0.005  # a stamp may be later than what it stamps; commands are 19 ms apart


def sweep(kind: str, seed: int, joints: list[str], frequencies: list[float], seconds: float):
    """Recordings with and without the protocol, the server, and bus time minus emulator time."""
    with served(kind, seed) as (server, where, folder):
        bus = GuardedBus(open_bus(parse_address(where)))
        shift = bus.now() - server.now()
        speed = bus.metadata["speed_limit_rad_s"]
        rate = bus.metadata.get("poll_rate_hz", 1 / 0.02685)
        made = plan("sine", joints, frequencies, 0.3, seconds, 0.019, speed, rate)
        recording = load(record(bus, made, folder / "sweep.csv"))
        plain = load(record(in_process(kind, seed), made, folder / "plain.csv"))
    return recording, plain, server, shift


def true_motion(server, joint: str, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the joint truly was, every millisecond on the bus's clock."""
    bench, k = server.emulator.bench, JOINT_NAMES.index(joint)
    servo = FreeAirServo(bench.robot.servos[k].actuator, DEFAULT_POSE[joint])
    goals = [(at, count) for at, index, count in bench.commands if index == k]
    scale, zero = bench.map.sign() * bench.map.counts_per_rad(), bench.map.to_counts(np.zeros(12))
    times = np.arange(0.0, goals[-1][0] + 0.2, 1e-3)
    position, upcoming = np.empty(len(times)), 0
    for n, now in enumerate(times):
        while upcoming < len(goals) and goals[upcoming][0] <= now:
            at, count = goals[upcoming]
            servo.command(at, (count - zero[k]) / scale[k])
            upcoming += 1
        position[n] = servo.position_at(float(now))
    return times + shift, position


def on_the_way(recording: Recording, server, joint: str, shift: float) -> float:
    """How long commands take from their stamp to the servo, median [s]."""
    k = JOINT_NAMES.index(joint)
    arrived = shift + np.array([at for at, i, _ in server.emulator.bench.commands if i == k])
    sent = np.concatenate([trial.send_time_s for trial in recording.trials(joint)])
    upcoming = np.searchsorted(arrived, sent - _STAMP_S)
    inside = upcoming < len(arrived)
    return float(np.median(arrived[upcoming[inside]] - sent[inside]))


def true_lag(recording: Recording, server, joint: str, shift: float) -> float:
    """The lag of the true motion, averaged as the estimator averages [s]."""
    time, position = true_motion(server, joint, shift)
    trials = recording.trials(joint)
    lattice = find_poll_lattice(trials, np.random.default_rng(0))
    tones, clean = [], []
    for trial in trials:
        tone = tone_response(trial, readings(trial, lattice), np.random.default_rng(0), draws=2)
        inside = (time >= trial.send_time_s[0]) & (time <= trial.send_time_s[-1])
        t, x = time[inside], position[inside]
        moved = Readings(np.arange(len(t)), t, x, t, 0.0)
        if tone is not None:
            tones.append(tone)
            clean.append(tone_response(trial, moved, np.random.default_rng(0), draws=2))
    lags = tone_lags(
        np.array([c.response for c in clean]), np.array([t.frequency_hz for t in tones])
    )
    return float(np.average(lags, weights=tone_weights(tones)))


def main() -> None:
    """Run it, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--joints", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bus", choices=KINDS, help="only this one")
    options = parser.parse_args()
    frequencies = [1.0, 2.0, 3.0, 5.0, 7.0, 10.0]
    joints = list(JOINT_NAMES[: options.joints])
    print("| bus | joint | lag ms | 90 % interval | true lag | in process | dead time ms "
          "| in process | true | held RMSE mrad | in process | missing % |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for kind in (options.bus,) if options.bus else KINDS:
        recording, plain, server, shift = sweep(
            kind, options.seed, joints, frequencies, options.seconds
        )
        missing = recording.table.groupby("joint")["position_rad"].apply(lambda x: x.isna().mean())
        found, without = calibrate([recording], seed=0), calibrate([plain], seed=0)
        errors, off, apart, inside, held = [], [], [], 0, 0
        for joint in joints:
            result, other = found[joint], without[joint]
            lag, delay = result.lag.lag_s, result.dead_time_s
            truth = true_lag(recording, server, joint, shift)
            servo = server.emulator.bench.robot.servos[JOINT_NAMES.index(joint)].actuator
            own = float(delay_at_step(servo, TIME_STEP_S, PHYSICS_STEP_S)[0])
            own += on_the_way(recording, server, joint, shift)
            errors.append(lag.value - truth)
            inside += lag.low <= truth <= lag.high
            held += delay.low <= own <= delay.high
            off.append(delay.value - own)
            apart.append(delay.value - other.dead_time_s.value)
            print(
                f"| {kind} | {joint} | {1e3 * lag.value:.1f} "
                f"| {1e3 * lag.low:.1f} … {1e3 * lag.high:.1f} | {1e3 * truth:.1f} "
                f"| {1e3 * other.lag.lag_s.value:.1f} | {1e3 * delay.value:.1f} "
                f"| {1e3 * other.dead_time_s.value:.1f} | {1e3 * own:.1f} "
                f"| {1e3 * result.candidate_models['delayed_pd'].scores.rmse_held_rad:.1f} "
                f"| {1e3 * other.candidate_models['delayed_pd'].scores.rmse_held_rad:.1f} "
                f"| {100 * missing[joint]:.1f} |",
                flush=True,
            )
        print(
            f"\n{kind}: lag bias {1e3 * np.mean(errors):+.2f} ms, worst "
            f"{1e3 * np.abs(errors).max():.2f} ms; {inside} of {len(joints)} lag intervals hold "
            f"the truth. Dead time: bias {1e3 * np.mean(off):+.2f} ms, worst "
            f"{1e3 * np.abs(off).max():.2f} ms; {held} intervals hold it; against in "
            f"process {1e3 * np.mean(apart):+.2f} ms on average, "
            f"{1e3 * np.abs(apart).max():.2f} ms at most.\n",
            flush=True,
        )


if __name__ == "__main__":
    with real_time_priority():
        main()
