"""Relations that hold whatever the servo is: of fits, their intervals, and their scores."""

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.servo_models.kernel import COLUMNS
from pupper_sysid.sysid.compare.compare import compare
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice
from pupper_sysid.sysid.fit.calibrate import CalibrationResult, calibrate
from pupper_sysid.sysid.fit.choice import fit_structures
from pupper_sysid.sysid.fit.preparation import prepare_joint
from pupper_sysid.sysid.fit.run import prepare, simulate
from pupper_sysid.sysid.fit.search import Problem, folds_of
from pupper_sysid.sysid.fit.structure import CANDIDATES, SIMULATED, candidate, servo_structure
from pupper_sysid.sysid.recordings.recording import Recording, Trial
from support import wide_servo
from support.servo_recordings import trial

JOINT, COUNT_RAD = "knee", 2 * np.pi / 4096
# per inertia: an SCS0009, an STS3215 (hardly damped inside of its loop) and an XL330
SERVOS = {
    "SCS0009": (9000.0, 90.0, 450.0, 52.0, 120.0, 0.025),
    "STS3215": (2300.0, 0.8, 700.0, 95.0, 40.0, 0.012),
    "XL330": (1500.0, 4.0, 600.0, 40.0, 50.0, 0.006),
}
"""Stiffness [1/s²], damping [1/s], effort [rad/s²], back-EMF [1/s], friction [rad/s²], and dead
time [s]."""


@cache
def recording(servo: str, motion: str, sign: int = 1) -> Recording:
    """A servo of the table at 100 Hz, read live in counts, moved without code of the package."""
    stiffness, damping, effort, brake, friction, dead_time = SERVOS[servo]
    moving = wide_servo.Servo(dead_time, stiffness, damping, brake, friction, effort)
    rng, parts, start = np.random.default_rng(3), [], 0.0
    tones = (1.0, 2.5, 5.0) if motion == "tones" else (np.nan,)
    for number, tone in enumerate(tones):
        time = 0.01 * np.arange(200 if motion == "tones" else 500)
        if motion == "tones":
            command = 0.25 * np.sin(2 * np.pi * tone * time)
        elif motion == "steps":
            command = np.repeat(rng.uniform(-0.4, 0.4, 10), 50)
            command -= command[0]
        else:
            command = 0.2 * np.sin(2 * np.pi * 1.8 * time) + 0.1 * np.sin(2 * np.pi * 3.7 * time)
        command, read = sign * command, time + 0.001
        path = wide_servo.simulate(moving, time, command, read[-1] + 0.01, np.random.default_rng(0))
        moved = COUNT_RAD * np.round(np.interp(read, path.time_s, path.angle) / COUNT_RAD)
        parts.append(
            trial(number, start, command, moved, joint=JOINT, frequency_hz=tone, period_s=0.01,
                  read_after_s=0.001)
        )  # fmt: skip
        start += float(time[-1]) + 1.0
    header = {"readings": "live", "start_pose_rad": {JOINT: 0.0}}
    return Recording.from_frame(pd.concat(parts, ignore_index=True), metadata=header, name=motion)


@cache
def fitted(servo: str, motion: str) -> CalibrationResult:
    return calibrate(recording(servo, motion), seed=1)


def lattice_of(trials: tuple[Trial, ...]) -> PollLattice:
    return find_poll_lattice(trials, np.random.default_rng(0))


def quantities(part) -> list[Quantity]:
    """All quantities inside of a part of a calibration."""
    values = [getattr(part, name) for name in type(part).model_fields]
    nested = [q for v in values if hasattr(type(v), "model_fields") for q in quantities(v)]
    return [part] if isinstance(part, Quantity) else nested


QUICK = [("STS3215", "tones")]
CASES = [
    *QUICK,
    *(
        pytest.param(servo, motion, marks=pytest.mark.slow)
        for servo in SERVOS
        for motion in ("tones", "steps", "walk")
        if (servo, motion) not in QUICK
    ),
]


@pytest.mark.parametrize(("servo", "motion"), CASES)
def test_a_value_lies_in_its_interval_and_one_without_width_is_not_called_identified(servo, motion):
    joint = fitted(servo, motion).calibration.joint(JOINT)
    every = quantities(joint.actuator)
    assert len(every) > 10
    for q in every:
        if q.low is not None and q.high is not None:
            assert q.low <= q.value <= q.high
        if q.identified == "yes":
            assert q.low is not None and q.high is not None and q.low < q.high, q


@pytest.mark.parametrize(("servo", "motion"), CASES)
def test_the_dead_time_holds_its_truth(servo, motion):
    found = fitted(servo, motion)[JOINT].dead_time_s
    # in steps of 2 ms instead of 1 the same motion takes half a step more or less
    assert found.low - 0.001 <= SERVOS[servo][-1] <= found.high + 0.001


def test_a_structure_that_contains_another_never_costs_more_with_and_without_left_out_runs():
    trials = tuple(recording("STS3215", "tones").trials(JOINT))
    ready = prepare_joint(JOINT, trials, 0)
    every = {f.structure.name: f for f in fit_structures(ready, SIMULATED[1])}
    inner, outer = every["dc_servo"], every[SIMULATED[1]]
    assert outer.structure.contains(inner.structure)
    # but for the prior of what it has besides, and the least damping of its box
    more = 0.5 * np.log(90.0 / 0.05) ** 2
    assert outer.fit.cost <= inner.fit.cost + more
    folds = folds_of(ready.runs)
    assert len(outer.folds) == len(folds) == 3
    for out, fold in zip(folds.values(), outer.folds, strict=True):
        part = ready.problem(outer.structure).only(~out)
        adopted = outer.structure.adopt(inner.structure, inner.fit.point[None])
        assert fold.cost <= part.costs(adopted)[0] + 1e-6


def test_unseen_tones_err_no_more_than_the_fit_explains_on_a_servo_that_the_model_has():
    """A fold in a wrong optimum would say that the servo is not understood, and advise another."""
    result = fitted("STS3215", "tones")[JOINT]
    scores = result.delayed_pd.scores
    assert scores.rmse_unseen_rad < 1.5 * scores.rmse_fresh_rad
    assert not any("predicts unseen" in text for text in result.warnings)


def test_negated_motion_is_the_same_servo():
    trials = [tuple(recording("SCS0009", "tones", sign).trials(JOINT)) for sign in (1, -1)]
    structure = candidate("delayed_pd")
    values = np.array([0.024, 9000.0, 90.0, 120.0, 450.0, 8.0, 0.0])
    runs = [tuple(prepare(t, lattice_of(own)) for t in own) for own in trials]
    costs = [
        Problem(structure, r, (0.003,) * len(r)).costs(structure.encode(values)[None])[0]
        for r in runs
    ]
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)


def test_a_slower_clock_scales_dead_time_and_gains():
    """Time scaled by 2 scales the dead time by 2, stiffness by 1/4, damping by 1/2."""
    (trial,) = recording("XL330", "steps").trials(JOINT)
    lattice = lattice_of((trial,))
    run = prepare(trial, lattice)
    slow = replace(run, step_s=2 * run.step_s)
    structure = candidate("delayed_pd_back_emf")
    values = np.array([0.006, 1500.0, 4.0, 50.0, 600.0, 15.0, 0.0])
    scaled = values * [2.0, 0.25, 0.5, 0.25, 0.25, 0.5, 1.0]
    for own, v in ((run, values), (slow, scaled)):
        cost = Problem(structure, (own,), (0.003,))
        one = cost.costs(structure.encode(v)[None]) - cost.prior(structure.encode(v)[None])
        if own is run:
            expected = one
    np.testing.assert_allclose(one, expected, rtol=1e-9)


def test_a_run_starts_where_the_joint_rested():
    """Friction holds a joint where it rests, and with it the error of one noisy reading."""
    (trial,) = recording("XL330", "steps").trials(JOINT)
    count = np.arange(len(trial.command_rad))
    command = np.where(count < 40, 0.1, trial.command_rad)
    noisy = 0.1 + 2e-3 * np.random.default_rng(0).standard_normal(len(count))
    lattice = lattice_of((trial,))

    def start_rad(position_rad) -> float:
        rested = replace(
            trial, command_rad=command, position_rad=position_rad, initial_command_rad=0.1
        )
        return prepare(rested, lattice).start_rad

    assert start_rad(noisy) == pytest.approx(0.1, abs=4 * 2e-3 / np.sqrt(40))
    spiked = np.where(count == 20, 1.5, noisy)
    assert start_rad(spiked) == pytest.approx(start_rad(noisy), abs=1e-3)
    for rows in (1.5, 10.0):
        settling = noisy - 0.4 * np.exp(-count / rows)
        assert start_rad(settling) == settling[0]


def test_free_air_is_a_load_of_nothing():
    """The servo per inertia and the one in N·m with the same armature move alike."""
    (trial,) = recording("XL330", "steps").trials(JOINT)
    run = prepare(trial, lattice_of((trial,)))
    free = candidate("dc_servo")
    values = np.array([0.006, 1500.0, 50.0, 600.0, 15.0, 0.0])
    row = free.columns(values[None])
    loaded = row.copy()
    inertia = 0.003
    for name in ("stiffness", "effort_limit", "back_emf", "friction_loss", "armature"):
        loaded[:, COLUMNS.index(name)] *= inertia
    dead_time = np.array([0.006])
    np.testing.assert_allclose(
        simulate(row, dead_time, run), simulate(loaded, dead_time, run), atol=1e-12
    )


def test_the_calibration_scores_itself_as_the_comparison_does():
    """One start, one offset, one meaning of held: fit and comparison give one number."""
    for servo, motion in QUICK:
        made = fitted(servo, motion)
        (model,) = (
            m for n, m in compare(recording(servo, motion), [made.calibration]).models.items()
            if n == "DelayedPD"
        )  # fmt: skip
        own, there = made[JOINT].delayed_pd.scores, model.joints[JOINT]
        assert there.rmse_free_run_rad == pytest.approx(own.rmse_fresh_rad, rel=0.02)
        assert there.rmse_held_rad == pytest.approx(own.rmse_held_rad, rel=0.02)


def test_scores_depend_neither_on_neighbours_nor_on_the_order_of_files():
    one, other = recording("STS3215", "steps"), recording("STS3215", "walk")
    own = fitted("STS3215", "tones").calibration
    alone = compare([one, other], [own]).models["DelayedPD"].joints[JOINT]
    beside = compare([other, one], [own, "sts3215-bam-m1", "sts3215-bam-m6"]).models["DelayedPD"]
    for name in ("rmse_free_run_rad", "rmse_held_rad", "rmse_raw_rad", "mae_held_rad"):
        assert getattr(beside.joints[JOINT], name) == pytest.approx(getattr(alone, name)), name


def test_every_number_of_a_structure_is_a_row_of_the_table():
    for structure in (
        *map(candidate, CANDIDATES[3:]),
        servo_structure(("back-EMF", "load friction", "static")),
    ):
        low, high = structure.box
        assert (low < high).all()
        columns = structure.columns(np.array([[p.nominal for p in structure.parameters]]))
        assert np.isfinite(columns[:, :4]).all() and (columns[:, 0] > 0).all()


@pytest.mark.slow
def test_a_motion_at_its_torque_limit_is_described_though_the_first_fits_missed_it():
    """Noise is what the first fits leave: here half as much again as the readings have."""
    twin, path, *_ = wide_servo.draw_twin("no_limit", "chirp", 0, 4301)
    rows = wide_servo.readings(twin, path)
    log = Recording.from_arrays(
        rows.sent_s, {JOINT: rows.command}, {JOINT: rows.position}, read_time_s=rows.read_s,
        trial=rows.trial, name="chirp",
    )  # fmt: skip
    ratios = calibrate([log]).calibration.joints[JOINT].actuator.ratios_to_armature
    for name in ("stiffness", "friction_loss", "effort_limit"):
        quantity = getattr(ratios, name)
        (low, high) = wide_servo.truths(twin, path)[name]
        assert quantity.identified == "yes" and quantity.low <= high and low <= quantity.high
