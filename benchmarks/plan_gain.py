"""Does a planned second sweep narrow the dead time more than the first one repeated?

    .venv/bin/python benchmarks/plan_gain.py --robots 20

Random emulated robots, every other one with back-EMF instead of set-point slew, are swept at 1 to
4 Hz (the tones of a short standard sweep). `plan` proposes a second sweep of the same seconds from
that recording. Both second sweeps, the first repeated and the planned one, are recorded; each is
pooled with the first, and `delay` gives the 90 % interval of the dead time. The truth is the
servo's dead time as a simulation in the fit's steps has to have it.

`--twins` takes servos of `benchmarks/twins.py` instead: Stribeck friction, backlash and commands
that arrive late at random, recorded through a bus of their own.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import twins
from random_robots import random_spec

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.servo_models.calibration.parts import NO_SPEED_LIMIT_RAD_S
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.step_size import delay_at_step
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import EmulatedRobot, draw_robot
from pupper_sysid.sim.emulator.servos.free_air import PHYSICS_STEP_S
from pupper_sysid.sysid.identify.joint_fit import fit_joint, joint_lag
from pupper_sysid.sysid.plan.proposal import SweepPlan, plan_from_fits
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.joints import joint_trials
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.sweep.excitation import Plan, TrialPlan, plan
from pupper_sysid.sysid.sweep.recorder import record

TONES_HZ = (1.0, 2.0, 3.0, 4.0)
JOINT = "LF_thigh"


@dataclass(frozen=True)
class Result:
    """One robot; times in s."""

    structure: str
    truth: float
    first: Interval
    repeated: Interval
    planned: Interval
    expected: Interval
    """What `plan` predicted of the planned sweep."""


def back_emf_instead(robot: EmulatedRobot) -> EmulatedRobot:
    """The robot with motors whose voltage runs out at the speed where the set-point slewed."""
    servos = []
    for servo in robot.servos:
        a = servo.actuator
        drag = np.asarray(a.effort_limit) / np.asarray(a.velocity_limit)
        changed = replace(a, velocity_limit=NO_SPEED_LIMIT_RAD_S, back_emf=float(drag))
        servos.append(replace(servo, actuator=changed))
    return replace(robot, servos=tuple(servos))


Recorder = Callable[[Plan], Recording]


def emulated(seed: int) -> tuple[str, float, Recorder]:
    """Structure, true dead time [s], and recorder of a random emulated robot."""
    rng = np.random.default_rng([20261130, seed])
    while True:
        robot = draw_robot(rng, random_spec(rng))
        own = robot.servos[JOINT_NAMES.index(JOINT)].actuator
        if np.asarray(own.friction_loss) < 0.6 * np.asarray(own.effort_limit):
            break  # others stand still, or nearly
    structure = "back-EMF" if seed % 2 else "slew"
    robot = back_emf_instead(robot) if seed % 2 else robot
    own = robot.servos[JOINT_NAMES.index(JOINT)].actuator

    def recorder(trials: Plan) -> Recording:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "sweep.csv"
            bus = EmulatedBus(robot, rng.spawn(1)[0], keep_log=False)
            record(bus, trials, path)
            return load(path)

    return structure, float(delay_at_step(own, TIME_STEP_S, PHYSICS_STEP_S)[0]), recorder


def twin(seed: int) -> tuple[str, float, Recorder]:
    """The same of a servo of `benchmarks/twins.py`."""
    rng = np.random.default_rng([20261131, seed])
    structure = "back-EMF" if seed % 2 else "slew"
    own = twins.servo(rng, structure, polled=seed % 4 < 2)

    def recorder(trials: Plan) -> Recording:
        commands = [sent(trial, 0.019, rng) for trial in trials.trials]
        return twins.record(own, commands, rng)

    return structure, own.truth()["dead_time_s"], recorder


def sent(
    trial: TrialPlan, period_s: float, rng: np.random.Generator
) -> tuple[float, np.ndarray, np.ndarray]:
    """Frequency, send times and commands of a trial as recorder and guard send it."""
    time = np.arange(0.0, trial.duration_s, period_s)
    time = time + 1e-4 * rng.exponential(1.0, len(time))
    wanted, last, command = trial.offset(time), 0.0, []
    for goal in wanted:
        last += float(
            np.clip(goal - last, *(np.array([-1, 1]) * GuardLimits().speed_rad_s * period_s))
        )
        command.append(last)
    return trial.frequency_hz, time, np.array(command)


def executable(proposal: SweepPlan) -> Plan:
    """A proposal as the recorder takes it."""
    parts = [
        plan(
            t.kind, [JOINT], [t.frequency_hz], t.amplitude_rad, t.duration_s,
            poll_rate_hz=proposal.poll_rate_hz,
        )
        for t in proposal.trials
    ]  # fmt: skip
    return replace(parts[0], trials=tuple(t for p in parts for t in p.trials))


def measure(seed: int, twin_world: bool, tones: tuple[float, ...]) -> Result:
    """Sweep one robot thrice and fit it."""
    structure, truth, recorder = (twin if twin_world else emulated)(seed)
    standard = plan("sine", [JOINT], tones)
    first = recorder(standard)
    fit = fit_joint(JOINT, joint_trials(first, JOINT))
    proposal = plan_from_fits([first], {JOINT: fit})
    second = {"repeated": recorder(standard), "planned": recorder(executable(proposal))}

    def dead_time(*recordings: Recording) -> Interval:
        found = joint_lag(JOINT, joint_trials(recordings, JOINT)).dead_time_s
        assert found is not None
        return found

    return Result(
        structure, truth, fit.dead_time_s, dead_time(first, second["repeated"]),
        dead_time(first, second["planned"]), proposal.predictions[0].after,
    )  # fmt: skip


def width_ms(interval: Interval) -> float:
    """Width of an interval [ms]."""
    return 1e3 * (interval.high - interval.low)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--tones", default=",".join(f"{f:g}" for f in TONES_HZ))
    parser.add_argument("--twins", action="store_true")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    tones = tuple(float(f) for f in options.tones.split(","))
    print(
        "| robot | speed limit | true ms | first | repeated | planned | expected | width ms, "
        "first | repeated | planned |"
    )
    print("|" + "---|" * 10)
    found: list[Result] = []
    work = partial(measure, twin_world=options.twins, tones=tones)
    seeds = range(options.first, options.first + options.robots)
    with ProcessPoolExecutor(options.workers) as pool:
        for number, r in zip(seeds, pool.map(work, seeds), strict=True):
            found.append(r)
            intervals = (r.first, r.repeated, r.planned, r.expected)
            cells = [f"{1e3 * i.low:.1f}–{1e3 * i.high:.1f}" for i in intervals]
            widths = [f"{width_ms(i):.1f}" for i in intervals[:3]]
            print(
                f"| {number} | {r.structure} | {1e3 * r.truth:.1f} | {' | '.join(cells)} | "
                f"{' | '.join(widths)} |",
                flush=True,
            )
    first, repeated, planned = (
        np.array([width_ms(getattr(r, name)) for r in found])
        for name in ("first", "repeated", "planned")
    )
    gain = (first - planned).mean() / (first - repeated).mean()
    more = np.sum(first - planned > 2 * (first - repeated))
    variance = (1 - (planned / first) ** 2).mean() / (1 - (repeated / first) ** 2).mean()
    held = {
        name: sum(getattr(r, name).low <= r.truth <= getattr(r, name).high for r in found)
        for name in ("first", "repeated", "planned")
    }
    off = {
        name: np.median([1e3 * abs(getattr(r, name).value - r.truth) for r in found])
        for name in ("first", "repeated", "planned")
    }
    print(
        f"\n{len(found)} robots, mean width: first {first.mean():.1f}, repeated "
        f"{repeated.mean():.1f}, planned {planned.mean():.1f} ms. Narrowed by "
        f"{(first - repeated).mean():.1f} and {(first - planned).mean():.1f} ms: {gain:.1f} times "
        f"as much ({more} of {len(found)} robots more than twice); in squared width, each against "
        f"the first, {variance:.1f} times. Truth held: first {held['first']}, repeated "
        f"{held['repeated']}, planned {held['planned']}. Off by (median): {off['first']:.2f}, "
        f"{off['repeated']:.2f}, {off['planned']:.2f} ms."
    )


if __name__ == "__main__":
    main()
