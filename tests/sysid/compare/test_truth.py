"""Calibrations beside the truth of an emulated robot."""

import math

import numpy as np
import pytest
import yaml

from pupper_sysid.data import SAMPLES
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.calibration.parts import ARMATURES, OperatingPoint
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import EmulatedRobot, RobotSpec, draw_robot
from pupper_sysid.sysid.compare import truth as module
from pupper_sysid.sysid.compare.truth import (
    read_truth,
    true_lag_s,
    truth_table,
)
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.sweep.excitation import plan
from pupper_sysid.sysid.sweep.recorder import record
from support.command_line import json_of, ran
from support.json_keys import key_line
from support.package import ROOT
from support.refusals import assert_each_refused

JOINT = "LF_hip"
SAMPLE = SAMPLES / "calibrated.yaml"


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> tuple[EmulatedRobot, EmulatedBus, Recording]:
    """A robot without reading errors, its sweep and what its bus remembers of it."""
    rng = np.random.default_rng(5)
    robot = draw_robot(rng, RobotSpec(reading_noise_rad=0.0, offset_sd_rad=0.0))
    bus = EmulatedBus(robot, rng)
    path = tmp_path_factory.mktemp("truth") / "sweep.csv"
    record(bus, plan("sine", [JOINT], (2.0, 4.0), duration_s=2.0), path)
    bus.write_truth(path.with_suffix(""))
    return robot, bus, load(path)


def with_numbers(**numbers: Quantity):
    """The sample calibration, one joint, with other quantities of its ratios and feedback."""
    made = load_calibration(SAMPLE)
    own = made.joint(JOINT)
    ratios = own.actuator.ratios_to_armature
    parts = {
        "ratios": {k: v for k, v in numbers.items() if k in type(ratios).model_fields},
        "feedback": {k: v for k, v in numbers.items() if k in type(own.feedback).model_fields},
        "actuator": {k: v for k, v in numbers.items() if k in type(own.actuator).model_fields},
    }
    ratios = ratios.model_copy(update=parts["ratios"])
    actuator = own.actuator.model_copy(update={"ratios_to_armature": ratios} | parts["actuator"])
    feedback = own.feedback.model_copy(update=parts["feedback"])
    joint = own.model_copy(update={"actuator": actuator, "feedback": feedback})
    return made.model_copy(update={"joints": {JOINT: joint}})


def truth_of(step_s: float = TIME_STEP_S, **changes: float) -> dict:
    """Truth of one joint in steps of the calibration's: stiffness 12,000, loss 0.4, …"""
    actuator = {
        "stiffness": 12.0, "damping": 0.1, "friction_loss": 0.2, "armature": 1e-3,
        "effort_limit": 0.4, "velocity_limit": 7.5, "dead_time_s": 0.025,
    }  # fmt: skip
    feedback = {
        "poll_period_s": 0.027, "loss": 0.4, "mean_age_s": 0.0315, "quantum_rad": math.pi / 550,
        "offset_rad": 0.003,
    }  # fmt: skip
    parts: dict = {"actuator": actuator, "feedback": feedback}
    for part in (actuator, feedback):
        part |= {k: v for k, v in changes.items() if k in part}
    if "back_emf" in changes:
        actuator["back_emf"] = changes["back_emf"]
    return {"joints": {JOINT: parts | {"physics_step_s": step_s}}}


def quantity(value, low=None, high=None, identified="yes") -> Quantity:
    return Quantity(value=value, low=low, high=high, identified=identified, why="a test")


def test_an_interval_holds_the_truth_or_it_does_not_and_without_one_nothing_is_said():
    made = with_numbers(
        stiffness=quantity(12500.0, 11500.0, 13500.0),  # 12 / 0.001
        damping=quantity(90.0, 80.0, 99.0),  # 0.1 / 0.001 = 100
        loss=quantity(0.5, identified="no"),
        quantum_rad=quantity(0.0057119866, 0.0057119866, 0.0057119866),  # rounded by a file
    )
    rows = {row.quantity: row for row in truth_table(made, truth_of())}
    assert rows["stiffness"].truth == pytest.approx(12000.0) and rows["stiffness"].held is True
    assert rows["damping"].truth == pytest.approx(100.0) and rows["damping"].held is False
    assert rows["loss"].held is None and rows["loss"].identified == "no"
    assert math.isnan(rows["loss"].found.low)
    assert rows["quantum_rad"].held is True
    assert set(rows) == {  # neither has a back-EMF or a jitter
        "dead_time_s", "stiffness", "damping", "friction_loss", "effort_limit",
        "velocity_limit_rad_s", "poll_period_s", "loss", "mean_age_s", "quantum_rad", "offset_rad",
    }  # fmt: skip


def test_a_servo_with_back_emf_instead_of_a_speed_limit_is_compared_by_that():
    truth = truth_of(back_emf=0.05, velocity_limit=math.inf)
    made = with_numbers(back_emf=quantity(48.0, 40.0, 56.0))
    rows = {row.quantity: row for row in truth_table(made, truth)}
    assert rows["back_emf"].truth == pytest.approx(50.0) and rows["back_emf"].held is True
    assert "velocity_limit_rad_s" not in rows


def test_the_true_dead_time_is_that_of_the_calibrations_physics_steps():
    truth = truth_of(step_s=0.001)
    (row,) = [r for r in truth_table(with_numbers(), truth) if r.quantity == "dead_time_s"]
    # the emulator steps 1 ms, the calibration 2 ms: about half of the difference earlier
    assert 0.0 < row.truth - 0.025 < 0.002


def test_the_true_lag_is_the_dead_time_and_the_dynamics(swept):
    robot, bus, recording = swept
    truth = robot.truth()["joints"][JOINT]
    lag = true_lag_s(recording.trials(JOINT), truth)
    later = {**truth, "actuator": truth["actuator"] | {
        "dead_time_s": truth["actuator"]["dead_time_s"] + 0.01
    }}  # fmt: skip
    assert true_lag_s(recording.trials(JOINT), later) - lag == pytest.approx(0.01, abs=5e-4)
    assert truth["actuator"]["dead_time_s"] + 0.008 < lag < 0.07
    # the motion behind it is that of the emulated servo, which the bus remembers
    time, position = np.array(
        [(t, true) for t, joint, true, _ in bus.truth_rows() if joint == JOINT]
    ).T
    for trial in recording.trials(JOINT):
        moved = module._true_motion(trial, truth)
        # friction lets a servo rest beside its command; the first swing takes it along
        inside = (time > trial.send_time_s[0] + 0.5) & (time < moved.read_time_s[-1])
        motion = np.interp(time[inside], moved.read_time_s, moved.position_rad)
        assert np.ptp(motion) > 0.3
        np.testing.assert_allclose(motion, position[inside], atol=1e-5)


def test_the_lag_is_compared_on_the_calibrations_own_recording_only(swept):
    robot, _, recording = swept
    sample = load_calibration(SAMPLE)
    compared = truth_table(sample, robot.truth(), recording)
    assert not any(row.quantity == "lag_s" for row in compared)
    assert "was made from" in compared.notes[0]
    own = sample.inputs[0].model_copy(update={"sha256": recording.sha256})
    made_from_it = sample.model_copy(update={"inputs": (own,)})
    rows = truth_table(made_from_it, robot.truth(), recording, joints=[JOINT])
    assert next(iter(rows)).quantity == "lag_s" and not rows.notes


def test_the_truth_is_read_beside_its_recording_and_refused_in_a_sentence(swept, tmp_path):
    robot, _, recording = swept
    assert recording.path is not None
    assert read_truth(recording.path)["joints"].keys() == robot.truth()["joints"].keys()
    for name, truth in (("b", {"actuator": 3}), ("bench", BENCH)):
        (tmp_path / f"{name}.truth.yaml").write_text(yaml.safe_dump({"joints": {JOINT: truth}}))
    read = read_truth(tmp_path / "bench.truth.yaml")["joints"][JOINT]
    assert read["registers"]["p"] == 32 and read["loaded_servo"]["armature_kg_m2"] == 0.011
    elsewhere = tmp_path / "of_the_emulator.yaml"
    (tmp_path / "bench.truth.yaml").rename(elsewhere)
    assert read_truth(recording.path, elsewhere) == {"joints": {JOINT: read}}
    cases = [
        ("a.csv", "a.truth.yaml does not exist"), ("a.csv", "sweep --truth"),
        ("b.csv", "b.truth.yaml"), ("b.csv", "actuator"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda name: read_truth(tmp_path / name))
    other = ({"joints": {"RB_calf": {}}}, "no joint in common")
    assert_each_refused([other], lambda truth: truth_table(with_numbers(), truth))


def test_compare_truth_prints_a_table_and_its_keys_are_the_documented_ones(swept, capsys, tmp_path):
    recording = swept[2].path
    made = tmp_path / "calibrated.yaml"
    with_numbers().save(made)
    out, err = ran(capsys, "compare-truth", recording, made)
    assert "dead time, ms" in out and "hold the truth" in out and "not compared" in err
    keys = key_line(json_of(capsys, "compare-truth", recording, made))
    assert f"| `compare-truth` | `{keys}` |" in (ROOT / "docs/formats.md").read_text()


BENCH = {
    "actuator": {
        "stiffness": 8.0, "damping": 0.01, "friction_loss": 0.05, "armature": 0.013,
        "effort_limit": 1.6, "velocity_limit": math.inf, "dead_time_s": 0.012, "back_emf": 0.3,
    },
    "feedback": {"quantum_rad": 0.0015},
    "loaded_servo": {"armature_kg_m2": 0.011, "load_inertia_kg_m2": 0.002},
    "registers": {"p": 32},
    "physics_step_s": TIME_STEP_S,
}  # fmt: skip


@pytest.mark.parametrize(
    ("p_gain", "armature", "stiffness"),
    [(32.0, "servo", 8.0 / 0.011), (16.0, "servo", 4.0 / 0.011),
     (16.0, "servo and load", 4.0 / 0.013), (None, "servo and load", 8.0 / 0.013)],
)  # fmt: skip
def test_both_sides_have_the_calibrations_gain_and_armature(p_gain, armature, stiffness):
    point = OperatingPoint(p_gain=p_gain, armature=armature)
    made = with_numbers()
    joint = made.joint(JOINT).model_copy(update={"operating_point": point})
    found = truth_table(
        made.model_copy(update={"joints": {JOINT: joint}}), {"joints": {JOINT: BENCH}}
    )
    rows = {row.quantity: row for row in found}
    assert rows["stiffness"].truth == pytest.approx(stiffness)
    at_p_32 = stiffness * 32 / (p_gain or 32)
    assert rows["effort_limit"].truth == pytest.approx(1.6 / 8.0 * at_p_32)
    (definition,) = found.definitions
    assert point.gain_text in definition and ARMATURES[armature] in definition
