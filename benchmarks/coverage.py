"""Do 90 % intervals hold the truth? Emulated robots and servos in four worlds, one table each.

    .venv/bin/python benchmarks/coverage.py --world sweep --robots 240
    .venv/bin/python benchmarks/coverage.py --world motion --robots 120
    .venv/bin/python benchmarks/coverage.py --world pendulum --robots 40
    .venv/bin/python benchmarks/coverage.py --world strokes --robots 60

`sweep`: robots on a polled, lossy bus, one joint swept at four tones, through `calibrate`.
`motion`: the same robots under chirps, multisines, steps and pseudo-random binary commands, half
polled and half live; the recording does not state which, and the lag is that of the motion.
`pendulum`: servos with a pendulum at three P gains, stepped by MuJoCo at 1 kHz, with counts, a dead
zone and a minimum start force, through `sysid.fit`.
`strokes`: servos with play of 0 to 2° and dead zones of 0 to 5 counts, through `sysid.backlash`.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from random_robots import SweptRobot, sweep_random_robot

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.sim.emulator.pendulum import PendulumServo, PendulumServoParameters
from pupper_sysid.sysid.backlash import backlash
from pupper_sysid.sysid.compare.truth import truth_table
from pupper_sysid.sysid.feedback.staleness import staleness
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.fit.joint_fit import fit_joint
from pupper_sysid.sysid.lag.lag_budget import lag_budget
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.sweep.excitation import parse_frequencies, plan

MOTIONS = ("chirp", "multisine", "steps", "prbs")
RATIOS = ("stiffness", "damping", "friction_loss", "effort_limit", "velocity_limit_rad_s",
          "torque at full duty", "armature", "friction", "back-EMF")  # fmt: skip
"""Quantities whose width is printed as the ratio of the interval's ends."""


@dataclass(frozen=True)
class Row:
    """One quantity of one robot; a verdict instead of an interval where `verdict` is not empty."""

    quantity: str
    truth: float = float("nan")
    low: float = float("nan")
    value: float = float("nan")
    high: float = float("nan")
    identified: bool = True
    verdict: str = ""


def row(quantity: str, interval: Interval, truth: float, identified: bool = True) -> Row:
    """A row of an interval."""
    return Row(quantity, truth, interval.low, interval.value, interval.high, identified)


# ------------------------------------------------------------------------------ robots in free air


def swept(seed: int) -> Iterator[Row]:
    """Calibrate one joint of a robot from four tones."""
    rng = np.random.default_rng([20261122, 7, seed])
    loss, noise = float(rng.uniform(0.0, 0.5)), float(rng.uniform(0.002, 0.008))
    robot = sweep_random_robot(rng, "1,2,4,8", loss=loss, reading_noise_rad=noise)
    result = calibrate(robot.recording, [robot.joint])
    for quantity in truth_table(result, robot.bus.truth(), robot.recording).quantities:
        found = quantity.found
        if found is not None and np.isfinite([found.low, found.high]).all():
            yield row(quantity.quantity, found, quantity.truth, quantity.identified != "no")


def moved(seed: int) -> Iterator[Row]:
    """Measure the lag of one joint in motion without single tones."""
    rng = np.random.default_rng([20261122, 77, seed])
    kind, live = MOTIONS[seed % len(MOTIONS)], bool(seed // len(MOTIONS) % 2)
    excitation = partial(plan, kind, frequencies_hz=parse_frequencies("1-5"), duration_s=20.0)
    chosen = {"loss": 0.0, "poll_period_s": 0.0} if live else {}
    robot = sweep_random_robot(rng, excitation, **chosen)
    # the motion has to decide whether readings are live
    header = {k: v for k, v in robot.recording.metadata.items() if k != "readings"}
    recording = Recording.from_frame(robot.recording.table, metadata=header)
    trials = recording.trials(robot.joint)
    truth = "live" if live else "polled"
    verdict = staleness(trials).kind
    yield Row(f"readings that are {truth}", verdict=verdict)
    lag = lag_budget(robot.joint, trials, np.random.default_rng(seed)).lag_s
    yield row(f"lag, {kind}, {truth} [s]", lag, true_lag(robot))
    yield row("lag, all [s]", lag, true_lag(robot))


def true_lag(robot: SweptRobot, longest_s: float = 1.0, earliest_s: float = 0.05) -> float:
    """Time shift at which true motion and held command correlate best, as defined for `lag` [s]."""
    (trial,) = robot.recording.trials(robot.joint)
    motion = robot.bus.motion(trial)
    sent = np.searchsorted(trial.send_time_s, motion.time_s, side="right") - 1
    command, position = trial.command_rad[sent], motion.position_rad
    count, step_s = len(command), 0.001
    first, last = round(longest_s / step_s), count - round(earliest_s / step_s)
    # one window of the motion against each shifted window of the command
    window = position[first:last] - position[first:last].mean()
    shifts = np.arange(-round(earliest_s / step_s) + 1, first)
    scores = np.empty(len(shifts))
    for n, shift in enumerate(shifts):
        earlier = command[first - shift : last - shift]
        scores[n] = window @ (earlier - earlier.mean()) / np.std(earlier)
    top = int(np.clip(np.argmax(scores), 1, len(scores) - 2))
    left, middle, right = scores[top - 1 : top + 2]
    return float(step_s * (shifts[top] + 0.5 * (left - right) / (left - 2 * middle + right)))


# ----------------------------------------------------------------------------- servos with a load

COUNT_RAD = 2 * np.pi / 4096
LOOP_S, READ_AFTER_S, RUN_S, DROP_S = 0.01, 0.002, 6.0, 2.5
LOADED = {
    "torque at full duty": ("stall_torque", "torque_nm"),
    "armature": ("armature", "armature_kg_m2"),
    "friction": ("friction_loss", "friction_nm"),
    "back-EMF": ("back_emf", "back_emf_nm_s_rad"),
    "dead time [s]": ("dead_time_s", "dead_time_s"),
}
"""Quantity: its names in the fit and in the emulated servo."""


def loaded(seed: int) -> Iterator[Row]:
    """Fit a servo that swings, follows steps and drops a pendulum at three P gains."""
    rng = np.random.default_rng([20261123, seed])
    servo = random_pendulum_servo(rng)
    load = {"mass_kg": servo.mass_kg, "length_m": servo.length_m}
    trials = []
    for gain in (8, 16, 32):
        for kind in ("chirp", "steps", "drop"):
            header = {"readings": "live", "servos": {"servo": {"p_gain": gain}},
                      "loads": {"servo": load}, "joints": ["servo"]}  # fmt: skip
            table = pendulum_run(servo, gain, kind, rng)
            trials += Recording.from_frame(table, metadata=header).trials("servo")
    fit = fit_joint("servo", trials, 0)
    for quantity, (name, true_name) in LOADED.items():
        yield row(quantity, fit.numbers[name], getattr(servo, true_name))


def random_pendulum_servo(rng: np.random.Generator) -> PendulumServoParameters:
    """Draw a servo of 0.4 to 4 N·m and a mass that it can lift."""
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


def pendulum_run(
    servo: PendulumServoParameters, gain: int, kind: str, rng: np.random.Generator
) -> pd.DataFrame:
    """Rows of one run; in a drop the torque is off from `DROP_S` on."""
    registers = {"p": gain, "d": 0, "min_start_force": int(rng.integers(0, 16)),
                 "dead_zone_cw": 1, "dead_zone_ccw": 1}  # fmt: skip
    emulated = PendulumServo(servo, 0.0, registers)
    time_s = LOOP_S * np.arange(int(RUN_S / LOOP_S))
    commands = {
        "chirp": lambda: 0.9 * np.sin(1.2 * time_s**2),
        "steps": lambda: rng.uniform(-1.0, 1.0, 20)[(time_s / 0.4).astype(int)],
        "drop": lambda: -1.4 * np.clip(time_s / 2.0, 0, 1),
    }[kind]()
    send_s, on = time_s + 0.05, np.ones(len(time_s))
    if kind == "drop":
        on[send_s >= DROP_S] = 0.0
    goals, positions = COUNT_RAD * np.round(commands / COUNT_RAD), np.empty(len(time_s))
    for k, at_s in enumerate(send_s):
        if on[k]:
            emulated.command(at_s, goals[k])
        elif on[k - 1]:
            emulated.torque(at_s, False)
        positions[k] = emulated.position_at(at_s + READ_AFTER_S)
    return pd.DataFrame(
        {"send_time_s": send_s, "read_time_s": send_s + READ_AFTER_S, "command_rad": goals,
         "position_rad": COUNT_RAD * np.round(positions / COUNT_RAD), "torque_enabled": on,
         "joint": "servo", "trial": 0, "frequency_hz": np.nan}
    )  # fmt: skip


def stroked(seed: int) -> Iterator[Row]:
    """Measure play, dead zone and hysteresis from slow strokes at P 8 and P 32."""
    from support.strokes import stroked as strokes

    rng = np.random.default_rng(1000 + seed)
    degrees, zone = float(rng.uniform(0, 2)), int(rng.integers(0, 6))
    recording, servo = strokes(seed, degrees, zone)
    result = backlash(recording)["bench"]
    dead_zone = result.dead_zone_rad
    assert dead_zone is not None
    if result.backlash_rad is not None:
        yield row("backlash [rad]", result.backlash_rad, servo.backlash_rad)
    bounded = "" if dead_zone.value > 0 else ", bounded from above"
    yield row(f"dead zone{bounded} [rad]", dead_zone, zone * servo.count_rad)
    for gain in result.gains:
        if gain.p_gain == 8 or dead_zone.value == 0:  # else the dead zone sets it
            stiffness = servo.torque_nm * servo.duty_per_rad * gain.p_gain
            width = 2 * servo.friction_nm / stiffness
            yield row(f"hysteresis at P {gain.p_gain:g} [rad]", gain.hysteresis_rad, width)


# ------------------------------------------------------------------------------------------- table

WORLDS = {"sweep": swept, "motion": moved, "pendulum": loaded, "strokes": stroked}


def rows_of(world: str, seed: int) -> list[Row] | None:
    """Rows of one robot; None where it is refused, such as one that cannot move."""
    warnings.simplefilter("ignore")
    try:
        return list(WORLDS[world](seed))
    except InputError:
        return None


def held(rows: list[Row]) -> str:
    """How many intervals hold the truth."""
    if not rows:
        return "–"
    # a quantisation step has no width, but that of its last digits
    inside = sum(r.low - 1e-6 * abs(r.truth) <= r.truth <= r.high + 1e-6 * abs(r.truth)
                 for r in rows)  # fmt: skip
    return f"{inside} ({100 * inside / len(rows):.0f} %)"


def line(quantity: str, rows: list[Row]) -> str:
    """A row of the table: coverage, width, error, and coverage where not identified."""
    known, others = ([r for r in rows if r.identified is yes] for yes in (True, False))
    if not known:
        return f"| {quantity} | 0 of {len(rows)} | – | – | – | {held(others)} |"
    ends: NDArray[np.float64] = np.array([(r.low, r.high) for r in known])
    error = np.abs([r.value - r.truth for r in known])
    if quantity in RATIOS:
        width = f"× {np.median(ends[:, 1] / np.maximum(ends[:, 0], 1e-12)):.2f}"
        shown = f"{np.median(error / np.abs([r.truth for r in known])):.1%}"
    else:
        width, shown = f"{np.median(ends[:, 1] - ends[:, 0]):.2g}", f"{np.median(error):.2g}"
    return (
        f"| {quantity} | {len(known)} of {len(rows)} | {held(known)} | {width} | {shown} "
        f"| {held(others)} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--world", choices=WORLDS, default="sweep")
    parser.add_argument("--robots", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="seed of the first robot")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    by_quantity: dict[str, list[Row]] = defaultdict(list)
    verdicts: dict[str, Counter[str]] = defaultdict(Counter)
    seeds = range(options.first, options.first + options.robots)
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        done = refused = 0
        with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C: the table of what is done
            for rows in pool.map(partial(rows_of, options.world), seeds):
                done, refused = done + 1, refused + (rows is None)
                for one in rows or ():
                    if one.verdict:
                        verdicts[one.quantity][one.verdict] += 1
                    else:
                        by_quantity[one.quantity].append(one)
        pool.shutdown(wait=False, cancel_futures=True)
    print(f"{done} robots, {options.world}, {refused} refused\n")
    for quantity, counts in verdicts.items():
        print(f"{quantity}: " + ", ".join(f"{n} called {word}" for word, n in counts.items()))
    print("| quantity | identified | holds the truth | median width | median error "
          "| not identified: holds |")  # fmt: skip
    print("|" + "---|" * 6)
    for quantity, rows in sorted(by_quantity.items()):
        print(line(quantity, rows))


if __name__ == "__main__":
    main()
