"""Calibrations in other simulators: they read them, and they move as ours does."""

from __future__ import annotations

import ast
import json
import re
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.tones import fit_sine
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.sim.export import mjcf
from pupper_sysid.sim.export.isaaclab import to_isaaclab
from pupper_sysid.sim.export.json_file import to_json
from pupper_sysid.sim.export.mjcf import to_mjcf
from pupper_sysid.sim.export.mjlab import MJLAB_PD, to_mjlab
from pupper_sysid.sim.export.newton import export_newton
from pupper_sysid.sim.export.shared import EXPLICIT_PD, delays_at_step
from pupper_sysid.sim.export.targets import SIMULATORS
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.servo_mjcf import INTEGRATOR, rest_at
from pupper_sysid.sysid.recordings.files import load
from support.command_line import refused, run_program
from support.exported_servos import ISAACLAB, ISAACLAB_3, MJLAB, in_free_air

ROOT = Path(__file__).resolve().parents[3]
CALIBRATED = ROOT / "data/samples/calibrated.yaml"


@pytest.fixture(scope="module")
def calibration():
    return load_calibration(CALIBRATED)


def test_the_mjcf_export_moves_as_our_own_simulation_does_over_the_whole_sweep(calibration):
    names = calibration.joint_names
    model = in_free_air(to_mjcf(calibration, TIME_STEP_S), names)
    data = mujoco.MjData(model)
    sweep = load(ROOT / "data/samples/sweep.csv")
    trials = [sweep.trials(n) for n in names]
    assert len(trials[0]) >= 4
    for together in zip(*trials, strict=True):
        first = np.array([t.command_rad[0] for t in together])
        steps = min(int((t.send_time_s[-1] - t.send_time_s[0]) / TIME_STEP_S) for t in together)
        at = TIME_STEP_S * np.arange(steps)
        commands = np.stack([_held(t, at) for t in together], axis=1)
        servo = calibration.delayed_pd(time_step_s=TIME_STEP_S)
        servo.reset(first)
        rest_at(model, data, list(first))
        ours, theirs = servo.rollout(commands), []
        for command in commands:
            data.ctrl[:] = command
            mujoco.mj_step(model, data)
            theirs.append(data.qpos.copy())
        assert np.ptp(ours, axis=0).min() > 0.1
        np.testing.assert_allclose(theirs, ours, atol=1e-6)


def lags_s(calibration, step_s: float, changed: Callable[[str], str] = str) -> np.ndarray:
    """Lag of every exported servo behind a tone of 3 Hz that a loop of 50 Hz commands."""
    model = in_free_air(changed(to_mjcf(calibration, step_s)), calibration.joint_names)
    data = mujoco.MjData(model)
    rest_at(model, data, [0.0] * model.nu)
    at = step_s * np.arange(round(3.0 / step_s))
    turn, moved = 2 * np.pi * 3.0, []
    for now in at:
        data.ctrl[:] = 0.15 * np.sin(turn * 0.02 * np.floor(now / 0.02 + 1e-9))
        mujoco.mj_step(model, data)
        moved.append(data.qpos.copy())
    late = at > 1.0
    phasor = fit_sine(turn * (at[late] + step_s), np.array(moved)[late]).phasor
    return np.arctan2(-phasor.real, -phasor.imag) / turn


def test_an_export_lags_as_long_as_the_calibration_says_in_any_steps_and_engine(
    calibration, monkeypatch
):
    expected = lags_s(calibration, TIME_STEP_S)
    for step_s in (0.005, 0.001):
        np.testing.assert_allclose(lags_s(calibration, step_s), expected, atol=6e-4)
    # what the step of 5 ms alone would have done
    more = delays_at_step(calibration, 0.005)
    for name, joint in calibration.joints.items():
        assert 0.0015 < more[name].value - joint.actuator.dead_time_s.value < 0.004
    for engine in (EXPLICIT_PD, MJLAB_PD):  # which do not limit the speed of set points

        def as_they_do(text: str, engine=engine) -> str:
            text = re.sub(r' slewmax="[^"]*"', "", text)
            return text if engine.implicit else text.replace(INTEGRATOR, "Euler")

        def their_delays(*of, engine=engine):
            return delays_at_step(*of, engine)

        monkeypatch.setattr(mjcf, "delays_at_step", their_delays)
        there = lags_s(calibration, 0.005, as_they_do)
        np.testing.assert_allclose(there, expected, atol=1e-3)


def _held(trial, at: np.ndarray) -> np.ndarray:
    """The command in force at times since the trial's first."""
    sent = trial.send_time_s - trial.send_time_s[0]
    return trial.command_rad[np.searchsorted(sent, at, side="right") - 1]


def test_readings_of_the_mjcf_export_are_held_for_a_poll_and_of_the_measured_age(calibration):
    names = calibration.joint_names
    model = in_free_air(to_mjcf(calibration, TIME_STEP_S), names)
    data = mujoco.MjData(model)
    rest_at(model, data, [0.0] * len(names))
    times, read = [], []
    for k in range(3000):
        # nothing else moves it: on a ramp of 1 rad/s a reading's age is its error
        data.qpos[:], data.qvel[:] = k * TIME_STEP_S, 0.0
        mujoco.mj_forward(model, data)
        mujoco.mj_step(model, data)
        times.append(k * TIME_STEP_S)
        read.append(data.sensordata.copy())
    ages = np.array(times)[500:, None] - np.array(read)[500:]
    held = [joint.feedback for joint in calibration.joints.values()]
    np.testing.assert_allclose(ages.mean(axis=0), [f.mean_age_s.value for f in held], atol=2e-3)
    for column, feedback in zip(np.array(read).T, held, strict=True):
        runs = np.diff(np.flatnonzero(np.diff(column)))
        assert np.mean(runs) * TIME_STEP_S == pytest.approx(feedback.poll_period_s.value, rel=0.02)


class _Recorder:
    """Stands in for a configuration class: takes its released field names and no others."""

    def __init__(self, fields: set[str]):
        self.fields = self.__dataclass_fields__ = fields
        self.made = []

    def __call__(self, **given: Any) -> dict[str, Any]:
        assert set(given) <= self.fields, set(given) - self.fields
        self.made.append(given)
        return given


def executed(text: str, package: str, name: str, recorder: _Recorder, monkeypatch) -> dict:
    parts = package.split(".")
    for k in range(len(parts)):
        monkeypatch.setitem(sys.modules, ".".join(parts[: k + 1]), types.ModuleType(parts[k]))
    setattr(sys.modules[package], name, recorder)
    space: dict[str, Any] = {}
    exec(compile(text, "exported.py", "exec"), space)
    return space


@pytest.fixture(scope="module")
def braking(calibration):
    """The calibration with servos whose speed back-EMF limits."""
    joints = {}
    for name, joint in calibration.joints.items():
        emf = joint.actuator.back_emf_nm_s_per_rad.model_copy(update={"value": 0.0321})
        actuator = joint.actuator.model_copy(update={"back_emf_nm_s_per_rad": emf})
        joints[name] = joint.model_copy(update={"actuator": actuator})
    return calibration.model_copy(update={"joints": joints})


def test_back_emf_brakes_in_every_simulator(braking, monkeypatch, tmp_path):
    text = to_isaaclab(braking, 0.005)
    recorder = _Recorder(ISAACLAB)
    space = executed(text, "isaaclab.actuators", "DelayedPDActuatorCfg", recorder, monkeypatch)
    assert all(made["viscous_friction"] == 0.0321 for made in space["ACTUATORS"].values())
    text, recorder = to_mjlab(braking, 0.005), _Recorder(MJLAB)
    executed(text, "mjlab.actuator", "BuiltinPositionActuatorCfg", recorder, monkeypatch)
    assert [made["viscous_damping"] for made in recorder.made] == [0.0321] * 3
    export_newton(braking, 0.005, tmp_path)
    module = (tmp_path / "newton_actuators.py").read_text()
    assert (
        module.count('"back_emf": 0.0321') == 3
        and 'joint_damping[dof] = servo["back_emf"]' in module
    )
    assert to_mjcf(braking, 0.002).count('damping="0.0321"') == 3
    joints = json.loads(to_json(braking, 0.005))["joints"]
    assert all(j["actuator"]["back_emf_nm_s_per_rad"]["value"] == 0.0321 for j in joints.values())


def test_the_isaac_lab_export_runs_with_its_field_names_and_bounds_the_delay(
    calibration, monkeypatch
):
    recorder = _Recorder(ISAACLAB)
    text = to_isaaclab(calibration, 0.005)
    space = executed(text, "isaaclab.actuators", "DelayedPDActuatorCfg", recorder, monkeypatch)
    assert list(space["ACTUATORS"]) == list(calibration.joint_names)
    delays = delays_at_step(calibration, 0.005, EXPLICIT_PD)
    for name, made in space["ACTUATORS"].items():
        own = calibration.joint(name).actuator
        assert made["joint_names_expr"] == [name]
        assert made["stiffness"] == own.stiffness_nm_per_rad.value
        assert made["armature"] == own.armature_kg_m2.value
        assert made["min_delay"] * 0.005 <= delays[name].low
        assert delays[name].high <= made["max_delay"] * 0.005
        assert made["max_delay"] - made["min_delay"] <= 2
    assert space["FEEDBACK"]["LF_hip"]["loss"] == calibration.joint("LF_hip").feedback.loss.value
    # the name of the torque limit is that of the release that is installed
    limits = [j.actuator.effort_limit_nm.value for j in calibration.joints.values()]
    assert [made["effort_limit"] for made in recorder.made] == limits
    newer = _Recorder(ISAACLAB_3)
    executed(text, "isaaclab.actuators", "DelayedPDActuatorCfg", newer, monkeypatch)
    assert [made["actuator_effort_limit"] for made in newer.made] == limits


def test_the_mjlab_export_avoids_delays_that_are_redrawn_or_begin_at_zero(calibration, monkeypatch):
    recorder = _Recorder(MJLAB)
    text = to_mjlab(calibration, 0.005)
    space = executed(text, "mjlab.actuator", "BuiltinPositionActuatorCfg", recorder, monkeypatch)
    assert len(space["ACTUATORS"]) == 3
    delays = delays_at_step(calibration, 0.005, MJLAB_PD)
    for made, (name, joint) in zip(space["ACTUATORS"], calibration.joints.items(), strict=True):
        assert made["delay_min_lag"] == made["delay_max_lag"] == round(delays[name].value / 0.005)
        assert made["delay_update_period"] == 0 and made["delay_hold_prob"] == 0.0
        assert made["frictionloss"] == joint.actuator.friction_loss_nm.value
        low, high = space["DELAY_STEPS"][name]
        assert low <= made["delay_min_lag"] <= high


def test_the_feedback_in_an_export_is_as_old_and_as_coarse_as_the_servos_say(
    calibration, monkeypatch
):
    text = to_isaaclab(calibration, 0.005)
    recorder = _Recorder(ISAACLAB)
    space = executed(text, "isaaclab.actuators", "DelayedPDActuatorCfg", recorder, monkeypatch)
    names, robots, step = ["LF_hip", "LF_calf"], 200, 0.002
    generator = torch.Generator().manual_seed(0)
    feedback = space["HeldFeedback"](space["FEEDBACK"], names, robots, step, generator=generator)
    feedback.reset(torch.zeros(robots, 2))
    ages = []
    for k in range(1, 1500):
        reading = feedback.step(torch.full((robots, 2), k * step))
        ages.append(k * step - reading.numpy())
    held = [calibration.joint(n).feedback for n in names]
    assert np.any([f.offset_rad.value for f in held])  # of the recording's zero: not exported
    mean = np.mean(ages[500:], axis=(0, 1))
    expected = [HeldFeedback(f.poll_period_s.value, f.loss.value).mean_age_s for f in held]
    np.testing.assert_allclose(mean, expected, atol=2e-3)
    counts = reading[:, 0].numpy() / held[0].quantum_rad.value
    np.testing.assert_allclose(counts, np.round(counts), atol=0.01)
    before = feedback.reading.clone()
    feedback.reset(torch.full((robots, 2), 9.0), torch.tensor([3]))
    assert (feedback.reading[3] > 8.9).all() and (feedback.reading[4] == before[4]).all()


def test_the_json_export_holds_every_number_with_its_interval(calibration):
    found = json.loads(to_json(calibration, 0.005))
    assert found["schema"] == "pupper-actuators" and found["physics_step_s"] == 0.005
    own = calibration.joint("LF_calf")
    there, stiffness = found["joints"]["LF_calf"], own.actuator.stiffness_nm_per_rad
    assert there["actuator"]["stiffness_nm_per_rad"] == stiffness.model_dump(mode="json")
    assert there["feedback"]["loss"]["value"] == own.feedback.loss.value
    assert found["inputs"][0]["sha256"] == calibration.inputs[0].sha256


def test_every_export_says_where_its_numbers_come_from_and_a_wild_name_cannot_break_it(calibration):
    for to in sorted(SIMULATORS):
        wild = calibration.model_copy(update={"robot": 'a"""b-->c & <d>\\'})
        text = SIMULATORS[to](wild, 0.004)
        assert calibration.inputs[0].sha256[:12] in text and "data sheet" in text
        if to == "mjcf":
            in_free_air(text, calibration.joint_names)
        elif to == "json":
            json.loads(text)
        else:
            assert ast.get_docstring(ast.parse(text))


def test_newton_networks_give_the_effort_of_the_pd(calibration, tmp_path, capsys):
    onnx = pytest.importorskip("onnx")
    from onnx.reference import ReferenceEvaluator

    folder = tmp_path / "newton"
    arguments = ("export", CALIBRATED, "--to", "newton", "--out", folder)
    code, _, err = run_program(capsys, pupper_sysid, *arguments)
    assert code == 0, err
    own = calibration.joint("LF_thigh").actuator
    model = onnx.load(folder / "LF_thigh.onnx")
    error, velocity = 0.02, -1.5
    (effort,) = ReferenceEvaluator(model).run(
        None, {"input": np.array([[error, velocity]], np.float32)}
    )
    expected = own.stiffness_nm_per_rad.value * error - own.damping_nm_s_per_rad.value * velocity
    assert effort.shape == (1, 1) and effort[0, 0] == pytest.approx(expected, rel=1e-6)
    contract = json.loads({p.key: p.value for p in model.metadata_props}["metadata"])
    assert contract["input_order"] == "pos_vel" and contract["sample_dt_s"] == 0.005


def test_the_newton_module_finds_joints_by_name_behind_a_free_base(
    calibration, tmp_path, monkeypatch
):
    pytest.importorskip("onnx")
    export_newton(calibration, 0.005, tmp_path)
    names = types.ModuleType("newton.actuators")
    names.ClampingMaxEffort, names.DriveNeuralMLP = "clamp", "mlp"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "newton", types.ModuleType("newton"))
    monkeypatch.setitem(sys.modules, "newton.actuators", names)
    space = {"__file__": str(tmp_path / "newton_actuators.py")}
    exec((tmp_path / "newton_actuators.py").read_text(), space)
    labels = ["robot/base_freejoint", *(f"robot/base/{n}" for n in calibration.joint_names)]
    added: list[dict[str, Any]] = []
    builder = types.SimpleNamespace(
        joint_label=labels, joint_qd_start=[0, 6, 7, 8], joint_q_start=[0, 7, 8, 9],
        joint_armature=[0.0] * 9, joint_friction=[0.0] * 9, joint_damping=[0.0] * 9,
        joint_target_ke=[1.0] * 9, joint_target_kd=[1.0] * 9,
        add_actuator=lambda drive, **given: added.append(given),
    )  # fmt: skip
    space["add_actuators"](builder)  # type: ignore[operator]
    assert [(a["index"], a["pos_index"]) for a in added] == [(6, 7), (7, 8), (8, 9)]
    own = calibration.joint("LF_hip").actuator
    assert builder.joint_armature[6] == own.armature_kg_m2.value
    builder.joint_label = labels[:2]
    with pytest.raises(ValueError, match="joints are called"):
        space["add_actuators"](builder)  # type: ignore[operator]


def test_exports_are_written_by_name_and_never_over_something(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ("export", CALIBRATED, "--to", "isaaclab")
    code, _, err = run_program(capsys, pupper_sysid, *arguments)
    assert code == 0 and "5 ms" in err
    assert (tmp_path / "calibrated_isaaclab.py").exists()
    assert "exists already" in refused(capsys, pupper_sysid, *arguments)


def test_what_cannot_become_an_actuator_is_refused_with_the_way_out(capsys):
    samples = ROOT / "data/samples"
    for words, cure in (
        ((samples / "sweep.csv", "--to", "mjcf"), "pupper-sysid calibrate"),
        ((samples / "policies/lstm", "--to", "mjlab"), "--to onnx"),
        ((CALIBRATED, "--to", "mjlab", "--physics-step", "5"), "--physics-step"),
    ):
        assert cure in refused(capsys, pupper_sysid, "export", *words)


def test_steps_in_which_a_servo_only_rattles_are_refused(capsys, tmp_path):
    for to in ("mjcf", "isaaclab", "mjlab", "newton"):
        # its torque is limited, so it does not fly away: it swings between the limits
        said = refused(
            capsys, pupper_sysid, "export", CALIBRATED, "--to", to, "--physics-step", "0.05",
            "--out", tmp_path / "x",
        )  # fmt: skip
        assert "not stable in physics steps of 50 ms; take shorter ones" in said


def test_what_a_target_cannot_carry_of_a_servo_under_load_is_said_in_it(
    capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for to in ("mjcf", "isaaclab", "mjlab", "newton"):
        run_program(capsys, pupper_sysid, "export", "xl330-m288", "--to", to, "--out", to)
        made = tmp_path / to
        files = made.rglob("*.py") if made.is_dir() else [made]
        said = " ".join(" ".join(p.read_text().split()) for p in files)
        assert "not carried over: friction that grows with the motor's torque" in said, to
