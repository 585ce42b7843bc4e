"""Calibrations in other simulators: they read them, and they move as ours does."""

import ast
import json
import re
import sys
import types
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.tones import fit_sine
from pupper_sysid.data import SAMPLES
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.step_size import (
    CONTINUOUS_S,
    CONTROL_S,
    MUJOCO,
    MUJOCO_PID,
    at_step,
    in_loop,
    nearest_in_loop,
)
from pupper_sysid.sim.export.check import check, held, walk_commands
from pupper_sysid.sim.export.export import exported_text
from pupper_sysid.sim.export.mjcf import to_mjcf
from pupper_sysid.sim.export.mjlab import BUILTIN_PD
from pupper_sysid.sim.export.shared import EXPLICIT_PD, ExportedServos
from pupper_sysid.sim.export.targets import TARGETS
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.servo_mjcf import INTEGRATOR, rest_at
from pupper_sysid.sysid.recordings.files import load
from support.command_line import run_program
from support.exported_servos import ISAACLAB, ISAACLAB_3, MJLAB, in_free_air

CALIBRATED = SAMPLES / "calibrated.yaml"


@pytest.fixture(scope="module")
def calibration():
    return load_calibration(CALIBRATED)


def text_of(calibration, to: str, step_s: float = 0.005) -> str:
    return exported_text(calibration, to, step_s)[0]


def test_the_mjcf_export_moves_as_our_own_simulation_does_over_the_whole_sweep(calibration):
    names = calibration.joint_names
    model = in_free_air(text_of(calibration, "mjcf", TIME_STEP_S), names)
    data = mujoco.MjData(model)
    sweep = load(SAMPLES / "sweep.csv")
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
    model = in_free_air(changed(text_of(calibration, "mjcf", step_s)), calibration.joint_names)
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
    stepped = ExportedServos.of(calibration, 0.005).actuators()
    for name, joint in calibration.joints.items():
        later_s = stepped[name].dead_time_s.value - joint.actuator.dead_time_s.value
        assert 0.0015 < later_s < 0.004
    own = ExportedServos.actuators
    for engine in (EXPLICIT_PD, BUILTIN_PD):  # which do not limit the speed of set points

        def as_they_do(text: str, engine=engine) -> str:
            text = re.sub(r' slewmax="[^"]*"', ' slewmax="0"', text)
            return text if engine.implicit else text.replace(INTEGRATOR, "Euler")

        def theirs(servos, _=None, engine=engine):
            return own(servos, engine)

        monkeypatch.setattr(ExportedServos, "actuators", theirs)
        there = lags_s(calibration, 0.005, as_they_do)
        np.testing.assert_allclose(there, expected, atol=1e-3)


def _held(trial, at: np.ndarray) -> np.ndarray:
    """The command in force at times since the trial's first."""
    sent = trial.send_time_s - trial.send_time_s[0]
    return trial.command_rad[np.searchsorted(sent, at, side="right") - 1]


def test_readings_of_the_mjcf_export_are_held_for_a_poll_and_of_the_measured_age(calibration):
    names = calibration.joint_names
    model = in_free_air(text_of(calibration, "mjcf", TIME_STEP_S), names)
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


def modules(monkeypatch, **named: dict[str, Any]) -> None:
    """Stub modules by name, `a__b` for a.b, each with its names."""
    for name, names in named.items():
        parts = name.split("__")
        for k in range(len(parts)):
            whole = ".".join(parts[: k + 1])
            if whole not in named and k + 1 < len(parts):
                monkeypatch.setitem(sys.modules, whole, types.ModuleType(whole))
        module = types.ModuleType(".".join(parts))
        vars(module).update(names)
        monkeypatch.setitem(sys.modules, module.__name__, module)


def executed(text: str) -> dict[str, Any]:
    module = types.ModuleType("exported")
    sys.modules["exported"] = module  # dataclasses look their module up
    try:
        exec(compile(text, "exported.py", "exec"), vars(module))
    finally:
        del sys.modules["exported"]
    return vars(module)


def isaac_lab(text: str, monkeypatch, fields: set[str] = ISAACLAB) -> dict[str, Any]:
    """An export's names, in a stub of Isaac Lab."""

    class IdealPDActuatorCfg:
        def __init__(self, **given):
            _Recorder(fields)(**given)
            self.__dict__.update(given)

    class IdealPDActuator:
        def __init__(self, cfg, joint_names, joint_ids, num_envs, device, **_):
            self.cfg, self._num_envs, self._device = cfg, num_envs, device

        def reset(self, env_ids):
            pass

    def configclass(cls):
        return cls

    modules(
        monkeypatch,
        isaaclab__actuators={
            "DelayedPDActuatorCfg": _Recorder(fields), "IdealPDActuator": IdealPDActuator,
            "IdealPDActuatorCfg": IdealPDActuatorCfg,
        },
        isaaclab__utils={"configclass": configclass},
    )  # fmt: skip
    return executed(text)


def mjlab(text: str, monkeypatch) -> dict[str, Any]:
    """An export's names, in a stub of mjlab."""

    @dataclass(kw_only=True)
    class ActuatorCfg:
        target_names_expr: tuple[str, ...]

    class Actuator:
        def __init__(self, cfg, entity, target_ids, target_names):
            self.cfg, self.target_names, self._mjs_actuators = cfg, target_names, []

        def initialize(self, mj_model, model, data, device):
            pass

        def reset(self, env_ids=None):
            pass

    modules(
        monkeypatch,
        mjlab__actuator={
            "Actuator": Actuator, "ActuatorCfg": ActuatorCfg,
            "BuiltinPositionActuatorCfg": _Recorder(MJLAB),
        },
    )  # fmt: skip
    return executed(text)


@pytest.fixture(scope="module")
def braking(calibration):
    """The calibration with servos whose speed back-EMF limits."""
    joints = {}
    for name, joint in calibration.joints.items():
        emf = joint.actuator.back_emf_nm_s_per_rad.model_copy(update={"value": 0.0321})
        actuator = joint.actuator.model_copy(update={"back_emf_nm_s_per_rad": emf})
        joints[name] = joint.model_copy(update={"actuator": actuator})
    return calibration.model_copy(update={"joints": joints})


def test_back_emf_brakes_in_every_simulator(braking, monkeypatch):
    servos = ExportedServos.of(braking, 0.005)
    explicit, implicit = ([a.back_emf_nm_s_per_rad.value for a in servos.actuators(e).values()]
                          for e in (EXPLICIT_PD, MUJOCO))  # fmt: skip
    space = isaac_lab(text_of(braking, "isaaclab"), monkeypatch)
    assert space["ACTUATORS"]["servos"].viscous_friction == 0  # it is in the class's torques
    whole = space["WHOLE_STEP_ACTUATORS"].values()
    assert [made["viscous_friction"] for made in whole] == explicit
    space = mjlab(text_of(braking, "mjlab"), monkeypatch)
    assert [made["viscous_damping"] for made in space["WHOLE_STEP_ACTUATORS"]] == implicit
    for to in ("isaaclab", "mjlab", "newton"):
        assert text_of(braking, to).count('"back_emf": 0.0321,') == 3
    assert text_of(braking, "mjcf", 0.002).count('damping="0.0321 0 0"') == 3
    joints = json.loads(text_of(braking, "json"))["joints"]
    assert [j["actuator"]["back_emf_nm_s_per_rad"]["value"] for j in joints.values()] == implicit


def test_the_isaac_lab_export_runs_with_its_field_names_and_bounds_the_delay(
    calibration, monkeypatch
):
    text = text_of(calibration, "isaaclab")
    space = isaac_lab(text, monkeypatch)
    assert list(space["WHOLE_STEP_ACTUATORS"]) == list(calibration.joint_names)
    actuators = ExportedServos.of(calibration, 0.005).actuators(EXPLICIT_PD)
    servos = space["ACTUATORS"]["servos"]
    for name, made in space["WHOLE_STEP_ACTUATORS"].items():
        whole, own = actuators[name], calibration.joint(name).actuator
        assert made["joint_names_expr"] == [name]
        assert made["stiffness"] == whole.stiffness_nm_per_rad.value
        assert servos.stiffness[name] == own.stiffness_nm_per_rad.value
        assert made["armature"] == servos.armature[name] == own.armature_kg_m2.value
        low_s, high_s = whole.dead_time_interval_s
        assert made["min_delay"] * 0.005 <= low_s and high_s <= made["max_delay"] * 0.005
        assert made["max_delay"] - made["min_delay"] <= 2
    feedback = calibration.joint("LF_hip").feedback
    assert feedback.offset_rad.value  # of the recording's zero: not exported
    for key in ("loss", "poll_period_s", "quantum_rad", "offset_rad"):
        known = 0.0 if key == "offset_rad" else getattr(feedback, key).value
        assert space["FEEDBACK"]["LF_hip"][key] == known
    # the name of the torque limit is that of the release that is installed
    limits = [joint.actuator.effort_limit_nm.value for joint in calibration.joints.values()]
    assert list(servos.effort_limit.values()) == limits
    newer = isaac_lab(text, monkeypatch, ISAACLAB_3)["ACTUATORS"]["servos"]
    assert list(newer.actuator_effort_limit.values()) == limits


def test_the_mjlab_export_avoids_delays_that_are_redrawn_or_begin_at_zero(calibration, monkeypatch):
    space = mjlab(text_of(calibration, "mjlab"), monkeypatch)
    servos = ExportedServos.of(calibration, 0.005)
    for made, (name, actuator) in zip(
        space["WHOLE_STEP_ACTUATORS"], servos.actuators(BUILTIN_PD).items(), strict=True
    ):
        steps = round(actuator.dead_time_s.value / 0.005)
        assert made["delay_min_lag"] == made["delay_max_lag"] == steps
        assert made["delay_update_period"] == 0 and made["delay_hold_prob"] == 0.0
        assert made["frictionloss"] == actuator.friction_loss_nm.value
        low, high = space["DELAY_STEPS"][name]
        assert low <= made["delay_min_lag"] <= high


def walked_by_isaac_lab(space, calibration, commands: np.ndarray, step_s: float) -> np.ndarray:
    """Positions under the class's torques, which act as PhysX applies them: over each step."""
    names = calibration.joint_names
    cfg = space["ACTUATORS"]["servos"]
    actuator = space["CalibratedServo"](cfg, list(names), slice(None), 1, "cpu")
    actuator.reset(None)
    text = exported_text(calibration, "mjcf", step_s)[0]
    model = in_free_air(re.sub("<actuator>.*</actuator>", "", text, flags=re.DOTALL), names)
    data, moved = mujoco.MjData(model), []
    for command in commands:
        action = types.SimpleNamespace(joint_positions=torch.full((1, 3), command))
        state = (torch.tensor(x, dtype=torch.float32)[None] for x in (data.qpos, data.qvel))
        data.qfrc_applied[:] = actuator.compute(action, *state).joint_efforts[0].numpy()
        mujoco.mj_step(model, data)
        moved.append(data.qpos.copy())
    return np.array(moved)


def test_the_class_for_isaac_lab_moves_its_joints_as_the_calibration_does(calibration, monkeypatch):
    step_s = 0.001
    space = isaac_lab(text_of(calibration, "isaaclab", step_s), monkeypatch)
    commands = held(walk_commands()[:75], step_s)
    there = walked_by_isaac_lab(space, calibration, commands, step_s)
    servo = calibration.delayed_pd(time_step_s=TIME_STEP_S)
    servo.reset(np.zeros(3))
    own = servo.rollout(np.repeat(held(walk_commands()[:75], TIME_STEP_S)[:, None], 3, axis=1))
    apart = there[1::2] - own
    assert np.sqrt(np.mean(apart**2)) < 1.5e-3  # the set-points of a fit in steps run in steps


def test_the_mjlab_class_builds_motors_and_gives_them_the_servos_torques(calibration, monkeypatch):
    space = mjlab(text_of(calibration, "mjlab", TIME_STEP_S), monkeypatch)
    spec = mujoco.MjSpec.from_string(
        '<mujoco><default><joint damping="0.6" stiffness="3"/></default><worldbody>'
        + "".join(
            f'<body><joint name="robot/{n}"/><geom size="0.01"/></body>'
            for n in calibration.joint_names
        )
        + "</worldbody></mujoco>"
    )
    (cfg,) = space["ACTUATORS"]
    names = [f"robot/{n}" for n in calibration.joint_names]
    assert all(re.fullmatch(e, n) for e, n in zip(cfg.target_names_expr, names, strict=True))
    actuator = cfg.build(None, [0, 1, 2], names)
    actuator.edit_spec(spec, names)
    model = spec.compile()
    own = [joint.actuator for joint in calibration.joints.values()]
    pairs = {"dof_armature": "armature_kg_m2", "dof_frictionloss": "friction_loss_nm"}
    for field, key in pairs.items():
        np.testing.assert_allclose(getattr(model, field), [getattr(a, key).value for a in own])
    for field in ("dof_damping", "jnt_stiffness", "actuator_biasprm", "actuator_forcelimited"):
        np.testing.assert_array_equal(getattr(model, field), 0)
    np.testing.assert_array_equal(model.actuator_gainprm[:, 0], 1)
    np.testing.assert_array_equal(model.actuator_gear, [[1, 0, 0, 0, 0, 0]] * 3)
    actuator.initialize(model, None, types.SimpleNamespace(nworld=2), "cpu")
    rest = torch.full((2, 3), 0.3)
    cmd = types.SimpleNamespace(
        position_target=torch.full((2, 3), 0.5), pos=rest, vel=torch.zeros(2, 3)
    )
    assert not actuator.compute(cmd).any()  # the command is on its way
    for _ in range(40):
        torques = actuator.compute(cmd)
    held_fast = [min(0.2 * a.stiffness_nm_per_rad.value, a.effort_limit_nm.value) for a in own]
    torch.testing.assert_close(torques, torch.tensor([held_fast] * 2))


def test_the_json_export_holds_every_number_with_its_interval(calibration):
    found = json.loads(text_of(calibration, "json"))
    assert found["schema"] == "pupper-actuators" and found["physics_step_s"] == 0.005
    own = calibration.joint("LF_calf")
    stepped = ExportedServos.of(calibration, 0.005).actuators()["LF_calf"]
    there, stiffness = found["joints"]["LF_calf"], stepped.stiffness_nm_per_rad
    dead_time = own.actuator.dead_time_s.model_dump(mode="json")
    assert there["actuator"]["dead_time_s"] == dead_time
    assert there["actuator"]["stiffness_nm_per_rad"] == stiffness.model_dump(mode="json")
    assert there["feedback"]["loss"]["value"] == own.feedback.loss.value
    assert found["inputs"][0]["sha256"] == calibration.inputs[0].sha256


def test_every_export_says_where_its_numbers_come_from_and_a_wild_name_cannot_break_it(calibration):
    for to in sorted(set(TARGETS) - {"isaaclab-bam"}):
        wild = calibration.model_copy(update={"robot": 'a"""b-->c & <d>\\'})
        text, servos = exported_text(wild, to, 0.004)
        assert servos.sha256 in text
        assert calibration.inputs[0].sha256[:12] in text and "data sheet" in text
        if to == "mjcf":
            in_free_air(text, calibration.joint_names)
        elif to == "json":
            json.loads(text)
        else:
            assert ast.get_docstring(ast.parse(text))


def test_the_newton_module_finds_joints_by_name_behind_a_free_base(calibration, monkeypatch):
    modules(monkeypatch, warp={"to_torch": lambda a: a, "device_to_torch": lambda d: "cpu"})
    space = executed(text_of(calibration, "newton"))
    labels = ["robot/base_freejoint", *(f"robot/base/{n}" for n in calibration.joint_names)]
    attribute = types.SimpleNamespace(values=None)
    builder = types.SimpleNamespace(
        joint_label=labels, joint_qd_start=[0, 6, 7, 8], joint_q_start=[0, 7, 8, 9],
        custom_attributes={"mujoco:solreffriction": attribute},
        **{
            f"joint_{name}": [0.0] * 9
            for name in (
                "armature", "friction", "damping", "target_ke", "target_kd", "target_mode",
            )
        },
    )  # fmt: skip
    space["add_servos"](builder)
    own = calibration.joint("LF_hip").actuator
    assert builder.joint_armature[6] == own.armature_kg_m2.value
    assert sorted(attribute.values) == [6, 7, 8]
    servos = space["Servos"](builder, types.SimpleNamespace(device=None), num_worlds=2)
    state = types.SimpleNamespace(joint_q=torch.full((20,), 0.3), joint_qd=torch.ones(18))
    control = types.SimpleNamespace(joint_f=torch.zeros(18))
    for _ in range(20):
        servos.command(torch.full((2, 3), 0.33), state, control)
    efforts = control.joint_f.view(2, 9)
    wanted = own.stiffness_nm_per_rad.value * 0.03 - own.damping_nm_s_per_rad.value
    assert torch.allclose(efforts[:, 6], torch.tensor(wanted), rtol=1e-4)
    assert not efforts[:, :6].any()
    builder.joint_label = labels[:2]
    with pytest.raises(ValueError, match="joints are called"):
        space["add_servos"](builder)


def test_what_a_target_cannot_carry_of_a_servo_under_load_is_said_in_it(capsys, here):
    for to in ("mjcf", "isaaclab", "mjlab", "newton"):
        run_program(capsys, pupper_sysid, "export", "xl330-m288", "--to", to, "--out", to)
        said = " ".join((here / to).read_text().split())
        assert "not represented: friction that grows with the motor's torque" in said, to


def test_an_export_in_the_steps_of_its_fit_moves_as_the_calibration_does(calibration):
    checked = check(ExportedServos.of(calibration, TIME_STEP_S))
    for row in checked.joints.values():
        assert row.tones_rad < 3e-5 and row.walk_rad < 3e-5 and row.reading_counts < 0.1
    links = {name: 1e-4 for name in calibration.joint_names}
    checked = check(ExportedServos.of(calibration, TIME_STEP_S, link_inertia=links))
    assert max(row.walk_rad for row in checked.joints.values()) < 3e-5


def test_a_check_says_what_the_step_costs_apart_from_what_the_target_does(calibration):
    checked = check(ExportedServos.of(calibration, 0.005))
    for name, row in checked.joints.items():
        assert row.same_steps_rad < 3e-5, name
        assert row.not_carried_rad == 0.0, name
        # all of the distance is the step's, and less than the largest torque moves in one
        assert row.step_rad["whole servo"] == pytest.approx(row.tones_rad, abs=3e-5)
        assert row.tones_rad < row.step_of_full_torque_rad
    assert any("Steps of 2.5 ms would leave" in note for note in checked.notes)
    loaded = check(ExportedServos.of(load_calibration("sts3215-bam-m6"), 0.005))
    (row,) = loaded.joints.values()
    assert row.not_carried_rad > 1e-4
    # a card's limit on the set-point's speed is no friction: its simplest model is an actuator
    (row,) = check(ExportedServos.of(load_calibration("sts3215-bam-m1"), 0.005)).joints.values()
    assert row.not_carried_rad < 2e-4


def test_the_dead_time_for_a_step_is_that_of_the_nearest_motion_on_other_commands(calibration):
    time = np.arange(0.0, 1.0, CONTROL_S)
    turn, amplitude, phase = np.random.default_rng(3).uniform((4, 0.1, 0), (25, 0.3, 6), (24, 3)).T
    unseen = (amplitude * np.sin(turn * time[:, None] + phase)).T.ravel()
    servos = calibration.delayed_pd().parameters
    at, here = in_loop(servos, CONTINUOUS_S, unseen)

    def apart(stepped):
        times, there = in_loop(stepped, 0.005, unseen)
        wanted = np.stack([np.interp(times, at, track) for track in here.T], axis=1)
        return np.sqrt(np.mean((there - wanted) ** 2, axis=0))

    nearest = nearest_in_loop(servos, 0.005)
    by_lag = at_step(servos, 0.005)
    np.testing.assert_array_equal(nearest.stiffness, by_lag.stiffness)  # a stance sags as much
    assert np.mean(apart(nearest)) < 0.9 * np.mean(apart(by_lag))
    for later_s in (-0.0015, 0.0015):
        other = replace(nearest, dead_time_s=nearest.dead_time_s + later_s)
        assert (apart(nearest) < apart(other)).all()


@pytest.mark.parametrize(
    ("card", "step_s"), [("sts3215-open-duck", 0.005), ("sts3215-bam-m1", 0.002)]
)
def test_a_dead_time_below_one_step_is_written_as_mujoco_takes_it(card, step_s):
    servos = ExportedServos.of(load_calibration(card), step_s)
    (row,) = check(servos).joints.values()
    assert row.same_steps_rad < 3e-5
    (wanted,), (written,) = (servos.actuators(e).values() for e in (MUJOCO, MUJOCO_PID))
    assert 0 < wanted.dead_time_s.value < step_s
    assert written.dead_time_s.value in (0.0, step_s)
    assert "no delay between 0 and one step" in " ".join(to_mjcf(servos).split())


def test_whole_steps_cost_what_a_shift_of_the_tone_costs(calibration):
    # half a step of 5 ms at most: 2.5 ms at 4 Hz are 63 mrad of phase of at most 0.3 rad
    costs = ExportedServos.of(calibration, 0.005).whole_step_costs()
    assert 0 < max(costs.values()) < 2 * np.pi * 4 * 0.0025 * 0.3 / np.sqrt(2)


def test_servos_under_load_become_isaac_labs_bam_models(monkeypatch):
    card = load_calibration("sts3215-bam-m5")
    cfg = _Recorder(
        {"motor", "joint_names_expr", "kp_fw", "vin", "armature", "min_delay", "max_delay"}
    )
    modules(monkeypatch, isaaclab__actuators={"BamActuatorCfg": cfg, "BamMotorCfg": lambda **m: m})
    space = executed(text_of(card, "isaaclab-bam"))
    (servo,) = space["ACTUATORS"].values()
    motor, published = servo["motor"], load_card("sts3215-bam-m5").as_published
    assert motor["model"] == "m5" and servo["kp_fw"] == 32
    # BAM limits the duty to 0.97; with a largest duty of 1 the supply is that much lower
    stall = 0.97 * published["kt"] / published["R"] * 7.4
    assert motor["kt"] / motor["resistance"] * servo["vin"] == pytest.approx(stall)
    emf = published["kt"] ** 2 / published["R"]
    assert motor["kt"] ** 2 / motor["resistance"] == pytest.approx(emf)
    same = ("friction_base", "friction_viscous", "friction_stribeck", "load_friction_external")
    assert [motor[n] for n in same] == pytest.approx([published[n] for n in same])
