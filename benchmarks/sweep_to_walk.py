"""From sweep to walk: a calibration made from sweeps alone predicts the readings of a walk.

The sweeps of a real hip and thigh (`tests/support/real_recordings.py`) are calibrated, and the
candidate models predict the same joints of a walking policy's playback at 25 Hz, all rows, in free
run: as positions with the sweep's offset; with the offset of the walk (`sysid.compare.readings`);
and as readings, whose age is that of the sweep's poll. A linear filter fitted to the walk itself
stands beside them.

    .venv/bin/python benchmarks/sweep_to_walk.py
    .venv/bin/python benchmarks/sweep_to_walk.py --robots 40

The second command does the same with random emulated robots (`random_robots.py`), whose walk is a
sum of a gait's harmonics and whose sweep has another zero than the walk. There the true servo, seen
through the same rule, gives the least error that a prediction of readings of unknown age can have.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from random_robots import random_spec

from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.servo_models.calibration.calibration import PRESETS, Calibration, load_calibration
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sysid.compare.compare import compare
from pupper_sysid.sysid.compare.readings import (
    as_rows,
    calibrated_run,
    on_ticks,
    reading_rules,
    run_with_offset,
    with_ages,
)
from pupper_sysid.sysid.identify.calibrate import CalibrationResult, calibrate
from pupper_sysid.sysid.identify.candidates.models import candidate_model
from pupper_sysid.sysid.identify.candidates.simulation import free_run
from pupper_sysid.sysid.identify.results import CandidateFit
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit.data import ServoData, servo_data
from pupper_sysid.sysid.servo_fit.scores import LINEAR, Tracks, errors, predicted, rms, stacked
from pupper_sysid.sysid.servo_fit.windows import Part, everything
from pupper_sysid.sysid.sweep.excitation import LEAD_IN_S, Plan, TrialPlan, parse_frequencies, plan
from pupper_sysid.sysid.sweep.recorder import record

REAL = Path(
    os.environ.get("PUPPER_REAL_DATA") or Path(__file__).resolve().parents[2] / "shared" / "real"
)
SWEEPS = ("real_motor_0_LF_hip_amp0.3.csv", "real_motor_1_LF_thigh_amp0.3.csv")
WALK = "playback_lstm_25hz.csv"

Run = Callable[[NDArray[np.float64]], Tracks]


def structure_run(fits: dict[str, CandidateFit], data: ServoData) -> Run:
    """Free run of a candidate model of each joint."""

    def run(start: NDArray[np.float64]) -> Tracks:
        found: Tracks = {}
        for n, joint in enumerate(data.joints):
            fit = fits[joint]
            model = candidate_model(fit.model)
            values = np.array([fit.values[name] for name in model.names])
            values[-1] = 0.0
            found[joint] = []
            for e, own in enumerate(data.runs[joint]):
                rest = start[e, n]
                trial = own.trial_data(np.ones(len(own.tick), bool))
                command = np.pad(trial.command + trial.rest_rad - rest, (0, 40), mode="edge")
                (moved,) = free_run(model, values, [replace(trial, command=command)])
                found[joint].append(on_ticks(moved + rest, own, data.period_s))
        return found

    return run


def rows_error(tracks: Tracks, data: ServoData, part: Part = everything) -> dict[str, float]:
    """RMS of all rows as logged against the predicted readings, by joint [rad]."""
    return {j: rms(e.raw) for j, e in errors(None, tracks, data, part).items()}


def lines_of(
    name: str, run: Run, data: ServoData, aged: ServoData, carried: dict[str, float]
) -> list[tuple[str, dict[str, float]]]:
    """Errors by today's rule, with the walk's offset, with the age, and without looking ahead."""
    before = run(stacked(data)[1])
    before = {j: [t + carried[j] for t in own] for j, own in before.items()}
    shifted, _ = run_with_offset(run, data)
    read, _ = run_with_offset(run, aged)
    first: Part = lambda number, elapsed, group: number == 0  # noqa: E731
    unseen, _ = run_with_offset(run, aged, first)
    return [
        (f"{name}: position, offset of the sweep", rows_error(before, data)),
        (f"{name}: position, offset of the walk", rows_error(shifted, data)),
        (f"{name}: reading, offset of the walk", rows_error(read, aged)),
        (
            f"{name}: reading, offset of loop 0, scored on the others",
            rows_error(unseen, aged, lambda number, elapsed, group: number > 0),
        ),
    ]


def real_table() -> str:
    """Table of the real joints, as Markdown."""
    walk = load(REAL / WALK)
    made = calibrate([load(REAL / name) for name in SWEEPS])
    joints = list(made.joints)
    data = as_rows(servo_data([walk], joints, "all"), joints)
    rules = reading_rules(data, "the walk", {"the sweeps": made.calibration})
    aged = with_ages(data, rules)
    carried = {j: made.calibration.joint(j).feedback.offset_rad.value for j in joints}
    calibrated = calibrated_run(made.calibration, data)
    lines = lines_of("calibration", calibrated, data, aged, carried)
    for name in next(iter(made.values())).candidate_models:
        fits = {j: made[j].candidate_models[name] for j in joints}
        lines += lines_of(name, structure_run(fits, data), data, aged, carried)[2:3]
    best = {j: made[j].candidate_models[made[j].model] for j in joints}
    lines += lines_of("best on unseen tones", structure_run(best, data), data, aged, carried)[2:3]
    for preset in PRESETS:
        run = calibrated_run(load_calibration(preset), data)
        lines += lines_of(preset, run, data, aged, dict.fromkeys(joints, 0.0))[:3]
    whole = compare(walk, [made.calibration], joints)
    linear = {j: s.rmse_raw_rad for j, s in whole.models[LINEAR].joints.items()}
    lines.append((f"{LINEAR} to the walk's other loops", linear))
    table = [
        f"| mrad | {' | '.join(joints)} | mean |",
        "|---|" + "---|" * (len(joints) + 1),
        *(
            f"| {name} | {' | '.join(f'{1e3 * e:.1f}' for e in found.values())} | "
            f"{1e3 * np.mean(list(found.values())):.1f} |"
            for name, found in lines
        ),
    ]
    return "\n".join(table)


# ------------------------------------------------------------------------------- robots


def walk_plan(rng: np.random.Generator, joint: str) -> Plan:
    """A walk of 15 s at 25 commands a second: a gait of four harmonics, its pace wandering."""
    pace, size = rng.uniform(1.0, 2.0), rng.uniform(0.1, 0.3)
    phase, share = rng.uniform(0, 2 * np.pi, 4), np.array([1.0, 0.5, 0.25, 0.12])
    wander, slow = rng.uniform(0.0, 0.5), rng.uniform(0.1, 0.3)

    def offset(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        t = np.floor(np.maximum(np.asarray(time_s, float) - LEAD_IN_S, 0.0) / 0.04 + 1e-9) * 0.04
        pairs = zip(share, phase, strict=True)
        turn = 2 * np.pi * (pace * t + wander * np.sin(2 * np.pi * slow * t))
        wave = sum(s * np.sin(k * turn + p) for k, (s, p) in enumerate(pairs, 1))
        return (size * np.minimum(t / 0.5, 1.0) * wave)[:, None]

    trial = TrialPlan((joint,), float("nan"), LEAD_IN_S + 15.0, offset)
    return Plan((trial,), dict(DEFAULT_POSE), {"kind": "walk"})


def robot_errors(seed: int) -> dict[str, float] | None:
    """Errors of one robot's joint [rad]; None if its servo cannot be calibrated."""
    from pupper_sysid.common.errors import InputError

    rng = np.random.default_rng([20261122, seed])
    spec = random_spec(rng, poll_period_s=float(rng.uniform(0.015, 0.035)))
    robot = draw_robot(rng, spec)
    joint = JOINT_NAMES[int(rng.integers(len(JOINT_NAMES)))]
    with tempfile.TemporaryDirectory() as folder:
        paths = Path(folder) / "sweep.csv", Path(folder) / "walk.csv"
        record(EmulatedBus(robot, rng), plan("sine", [joint], parse_frequencies("1-4")), paths[0])
        walked = walk_plan(rng, joint)
        record(EmulatedBus(robot, rng), walked, paths[1], loop_period_s=0.04)
        sweep, walk = load(paths[0]), load(paths[1])
    zero = float(rng.uniform(-0.8, 0.8))
    moved = sweep.table.assign(position_rad=sweep.table["position_rad"] + zero)
    try:
        made = calibrate(Recording.from_frame(moved, metadata=sweep.metadata))
    except InputError:
        return None
    return errors_on(walk, joint, made, truth_of(made, robot.truth()["joints"][joint], joint))


def truth_of(made: CalibrationResult, truth: dict, joint: str) -> Calibration:
    """The calibration with the true servo and the true feedback in it."""
    from pupper_sysid.servo_models.calibration.parts import PARAMETER_KEYS

    known = made.calibration.joint(joint)
    exact = {
        key: getattr(known.actuator, key).model_copy(update={"value": truth["actuator"][name]})
        for name, key in PARAMETER_KEYS.items()
        if name in truth["actuator"]
    }
    feedback = {
        name: getattr(known.feedback, name).model_copy(update={"value": truth["feedback"][name]})
        for name in ("poll_period_s", "loss", "offset_rad")
    }
    own = known.model_copy(
        update={
            "actuator": known.actuator.model_copy(update=exact),
            "feedback": known.feedback.model_copy(update=feedback),
        }
    )
    return made.calibration.model_copy(update={"joints": {joint: own}})


def errors_on(
    walk: Recording, joint: str, made: CalibrationResult, truth: Calibration
) -> dict[str, float]:
    """Errors on the walk by rule, of the calibration and of the true servo."""
    data = as_rows(servo_data([walk], [joint], "all"), [joint])
    hidden = {joint: replace(data.lattices[joint], kind="unresolved")}
    aged = {
        name: with_ages(data, reading_rules(replace(data, lattices=hidden), "walk", {name: known}))
        for name, known in (("found", made.calibration), ("true", truth))
    }
    carried = {joint: made.calibration.joint(joint).feedback.offset_rad.value}
    lines = lines_of(
        "calibration", calibrated_run(made.calibration, data), data, aged["found"], carried
    )
    exact, _ = run_with_offset(calibrated_run(truth, data), aged["true"])
    run = aged["true"].runs[joint][0]
    spread = exact[joint][0]
    variance = predicted(spread**2, run, run.reading_tick) - (
        predicted(spread, run, run.reading_tick) ** 2
    )
    return {name.partition(": ")[2]: found[joint] for name, found in lines[:3]} | {
        "true servo and true feedback: reading, offset of the walk": rows_error(
            exact, aged["true"]
        )[joint],
        "of it the unknown age alone": float(np.sqrt(np.mean(variance))),
    }


def robots_table(count: int) -> str:
    """Table of the emulated robots, as Markdown."""
    found = [f for f in map(robot_errors, range(count)) if f]
    lines = ["| mrad | median | 90 % of robots below |", "|---|---|---|"]
    for name in found[0]:
        every = 1e3 * np.array([f[name] for f in found])
        lines.append(f"| {name} | {np.median(every):.1f} | {np.quantile(every, 0.9):.1f} |")
    best = list(found[0])[3]
    more = np.array([f["reading, offset of the walk"] / f[best] for f in found])
    lines += [
        "",
        f"{len(found)} robots ({count - len(found)} could not be calibrated). Calibration over "
        f"true servo, readings: median {np.median(more):.3f}, nine in ten below "
        f"{np.quantile(more, 0.9):.3f}.",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", type=int, default=0)
    given = parser.parse_args()
    print(robots_table(given.robots) if given.robots else real_table())
