"""MJCF of a calibration inside of models whose own settings would change the servos."""

from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.errors import InputError
from pupper_sysid.data import SAMPLES
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPD, DelayedPDParameters
from pupper_sysid.servo_models.step_size import CONTROL_S
from pupper_sysid.sim.export.check import compiled, held, moved_by
from pupper_sysid.sim.export.mjcf import compiled_numbers, link_inertias, to_model
from pupper_sysid.sim.export.shared import ExportedServos
from pupper_sysid.sim.robot.engine import mujoco
from support.command_line import ran, refused
from support.real_recordings import real_recording

pytestmark = pytest.mark.usefixtures("read_here")

CALIBRATED = SAMPLES / "calibrated.yaml"
STEP_RAD = np.append(np.zeros(20), np.full(40, 0.3))  # a step after 0.4 s of a loop of 20 ms

HOSTILE = {
    "damping": '<joint damping="0.6 0.2 0.1"/>',
    "friction": '<joint frictionloss="0.5" solreffriction=".5 .5" solimpfriction=".1 .2 .3 .5 2"/>',
    "spring": '<joint stiffness="9 2 1" springref="40" springyield="0.1"/>',
    "spring and damper": '<joint springdamper="0.1 1"/>',
    "armature": '<joint armature="0.3"/>',
    "limit of the joint": '<joint actuatorfrcrange="-0.01 0.01"/>',
    "gravity compensation": '<joint actuatorgravcomp="true"/>',
    "position actuator": '<position kp="20" kv="3" forcerange="-1 1" ctrlrange="-0.1 0.1"/>',
    "inherited range": '<position kp="20" inheritrange="1"/>',
    "gear": '<general gear="7 1 1 1 1 1" cranklength="0.4" group="3"/>',
    "limits": '<general ctrlrange="-0.01 0.01" forcerange="-0.01 0.01" actrange="-0.01 0.01"/>',
    "inertia of the actuator": '<general armature="0.2" damping="0.7 0.1"/>',
    "delay": '<general nsample="90" delay="0.15" interp="cubic"/>',
    "integral": '<pid kp="99" ki="5" imax="0.1" kv="9" slewmax="0.01" posrange="-0.1 0.1"/>',
    "motor": '<motor gear="3" ctrlrange="-1 1"/>',
}  # fmt: skip
"""Default classes, each of which reaches everything that does not say otherwise."""


@pytest.fixture(scope="module")
def calibration():
    return load_calibration(CALIBRATED)


@pytest.fixture(scope="module")
def servos(calibration):
    return ExportedServos.of(calibration, TIME_STEP_S)


@pytest.fixture(scope="module")
def unlimited(calibration):
    """Servos whose set-points and torques have no limit, and which have a back-EMF."""
    joint = calibration.joint("LF_hip")
    emf = joint.actuator.back_emf_nm_s_per_rad.model_copy(update={"value": 0.03})
    actuator = joint.actuator.model_copy(update={"back_emf_nm_s_per_rad": emf})
    return ExportedServos.of(
        calibration.model_copy(
            update={"joints": {"LF_hip": joint.model_copy(update={"actuator": actuator})}}
        ),
        TIME_STEP_S,
    )


def rise_s(positions: np.ndarray, step_s: float) -> np.ndarray:
    """Time from the step's edge to 63 % of it, between steps."""
    at = step_s * np.arange(1, len(positions) + 1) - 20 * CONTROL_S
    wanted = 0.3 * (1 - np.exp(-1))
    return np.array([np.interp(wanted, np.maximum.accumulate(p), at) for p in positions.T])


def own_step(calibration, names) -> np.ndarray:
    servo = calibration.delayed_pd(names)
    servo.reset(np.zeros(len(names)))
    return servo.rollout(np.repeat(held(STEP_RAD, TIME_STEP_S)[:, None], len(names), axis=1))


@pytest.mark.parametrize("defaults", HOSTILE.values(), ids=HOSTILE)
def test_a_models_default_class_changes_nothing_of_the_servos(defaults, servos, unlimited):
    for exported in (servos, unlimited):
        model = compiled(exported, defaults)
        for name, (found, wanted) in compiled_numbers(model, exported).items():
            np.testing.assert_array_equal(found, wanted, err_msg=name)
    names = servos.calibration.joint_names
    there = moved_by(compiled(servos, defaults), names, STEP_RAD, TIME_STEP_S)
    wanted = rise_s(own_step(servos.calibration, names), TIME_STEP_S)
    np.testing.assert_allclose(rise_s(there, TIME_STEP_S), wanted, atol=1e-4)


def robot(links: dict[str, float], settings: str = "", joint: str = "", actuators: str = "") -> str:
    """MJCF of free joints of known link inertia, on a trunk that floats."""
    bodies = "".join(
        f'<body pos="0 0 {0.1 * n}"><joint name="{name}" axis="0 1 0" range="-60 60" {joint}/>'
        f'<inertial pos="0 0 0" mass="1e-9" diaginertia="{inertia} {inertia} {inertia}"/></body>'
        for n, (name, inertia) in enumerate(links.items())
    )
    return (
        f'<mujoco>{settings}<option gravity="0 0 0"/><worldbody><body name="trunk">'
        '<inertial pos="0 0 0" mass="100" diaginertia="100 100 100"/><freejoint/>'
        f"{bodies}</body></worldbody>{actuators}</mujoco>"
    )


def put_into(tmp_path, text: str, calibration, **options):
    """The whole model with the servos, compiled, and the servos."""
    (tmp_path / "robot.xml").write_text(text)
    text, servos = to_model(calibration, tmp_path / "robot.xml", tmp_path / "out.xml", **options)
    (tmp_path / "out.xml").write_text(text)
    return mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml")), servos


LINKS = {"LF_hip": 3e-4, "LF_thigh": 2e-4, "LF_calf": 4e-4}
OWN = (
    '<actuator><position name="first" joint="LF_hip" kp="20"/><motor joint="LF_calf"/>'
    '<velocity name="second" joint="LF_hip"/><motor name="thigh" joint="LF_thigh"/></actuator>'
)


# the others make a model with actuators of its own one that MuJoCo refuses, or are much the same
IN_A_ROBOT = [n for n in HOSTILE if n not in ("limits", "motor", "delay", "inherited range")]


@pytest.mark.parametrize("hostile", IN_A_ROBOT)
def test_a_whole_model_moves_as_the_recording_with_its_links_inertia_counted_once(
    hostile, calibration, tmp_path
):
    text = robot(LINKS, f"<default>{HOSTILE[hostile]}</default>", actuators=OWN)
    model, servos = put_into(tmp_path, text, calibration, physics_step_s=TIME_STEP_S)
    assert servos.links == pytest.approx(LINKS, rel=1e-5)
    names = calibration.joint_names
    there = moved_by(model, names, STEP_RAD, TIME_STEP_S)
    np.testing.assert_allclose(there, own_step(calibration, names), atol=1e-3)
    for name, joint in calibration.joints.items():
        exported = servos.calibration.joint(name)
        left = joint.actuator.armature_kg_m2.value - LINKS[name]
        assert exported.actuator.armature_kg_m2.value == pytest.approx(left, rel=1e-5)
        assert exported.holds_at.armature == "servo"


def test_what_joints_and_options_state_themselves_is_overruled(calibration, tmp_path):
    own = (
        'damping="0.6" stiffness="3" springref="20" armature="0.1" frictionloss="1" '
        'actuatorfrcrange="-.01 .01" class="mine"'
    )
    settings = (
        '<compiler angle="degree"/><default><default class="mine"><joint axis="1 0 0" damping="2"/>'
        '</default></default><option timestep="0.004" integrator="Euler" actuatorgroupdisable="0">'
        '<flag frictionloss="disable" actuation="disable" damper="disable"/></option>'
    )
    model, servos = put_into(tmp_path, robot(LINKS, settings, own), calibration)
    assert model.opt.timestep == 0.004 == servos.physics_step_s
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert model.opt.disableflags == 0
    names = calibration.joint_names
    there = moved_by(model, names, STEP_RAD, 0.004)
    exported = [servos.actuators()[name].parameters.arrays() for name in names]
    numbers = {key: np.array([servo[key] for servo in exported]) for key in exported[0]}
    numbers["armature"] = calibration.delayed_pd(names).parameters.armature
    own_servo = DelayedPD(DelayedPDParameters(**numbers), 0.004)
    own_servo.reset(np.zeros(3))
    wanted = own_servo.rollout(np.repeat(held(STEP_RAD, 0.004)[:, None], 3, axis=1))
    np.testing.assert_allclose(there, wanted, atol=1e-3)
    text = " ".join((tmp_path / "out.xml").read_text().split())
    assert "The integrator was EULER" in text and "Flags were disabled" in text


def test_own_actuators_are_replaced_under_their_names_and_keyframes_hold_the_pose(
    calibration, tmp_path
):
    key = (
        '<keyframe><key name="home" qpos="0 0 0 1 0 0 0 0.1 0.2 0.3" ctrl="0.15 0 0 0"/></keyframe>'
    )
    integrated = '<actuator><intvelocity joint="LF_thigh" actrange="-1 1" kp="3"/></actuator>'
    own = OWN.replace('<motor name="thigh" joint="LF_thigh"/></actuator>', "</actuator>")
    velocity = robot(LINKS, actuators=own + integrated + key.replace('ctrl="', 'act="0.2" ctrl="'))
    model, _ = put_into(tmp_path, velocity, calibration, physics_step_s=TIME_STEP_S)
    assert model.key_ctrl[0].tolist() == [0.15, 0.3, 0.2]  # a speed is no set-point
    text = robot(LINKS, actuators=OWN + key + "<sensor><actuatorfrc actuator='second'/></sensor>")
    model, _ = put_into(tmp_path, text, calibration, physics_step_s=TIME_STEP_S)
    assert [model.actuator(i).name for i in range(model.nu)] == ["first", "LF_calf", "thigh"]
    np.testing.assert_allclose(model.key_ctrl[0], [0.15, 0.3, 0.2])
    np.testing.assert_allclose(model.key_act[0], [0.15, 0.3, 0.2])
    text = " ".join((tmp_path / "out.xml").read_text().split())
    assert "LF_hip (2)" in text
    assert model.sensor_objid[0] == 0  # of an actuator that was removed: the joint's servo


def test_a_servo_without_a_name_to_take_over_gets_one_that_is_free(calibration, tmp_path):
    taken = OWN.replace('name="thigh"', 'name="LF_calf"')
    model, _ = put_into(tmp_path, robot(LINKS, actuators=taken), calibration)
    assert [model.actuator(i).name for i in range(model.nu)] == ["first", "LF_calf_", "LF_calf"]


GRIPPER = (
    '<mujoco><worldbody><body name="g"><joint name="finger"/><geom size=".01"/></body></worldbody>'
    '<actuator><position joint="finger" kp="2"/></actuator></mujoco>'
)
ATTACHED = (
    '<asset><model name="g" file="parts/g.xml"/></asset><worldbody><body><geom size=".1"/>'
    '<attach model="g" body="g" prefix="r/"/></body></worldbody>'
)
PLUGIN = (
    '<extension><plugin plugin="mujoco.pid"><instance name="p"/></plugin></extension>'
    '<actuator><plugin joint="LF_hip" plugin="mujoco.pid" instance="p"/></actuator>'
)
TWO_COMMANDS = (  # position and velocity, and so two columns of a keyframe
    '<tendon><fixed name="t"><joint joint="LF_calf" coef="1"/></fixed></tendon>'
    '<actuator><pid tendon="t" kp="3"/><pid joint="LF_thigh" kp="2"/></actuator>'
)
NESTED = '<include file="parts/arm.xml"/>'
PARTS = {
    "g.xml": GRIPPER, "arm.xml": f'<mujocoinclude>{NESTED.replace("parts/arm", "own")}'
    '</mujocoinclude>', "own.xml": f"<mujocoinclude>{OWN}</mujocoinclude>",
}  # fmt: skip


def key(qpos: str, ctrl: str) -> str:
    return f'<keyframe><key qpos="0 0 0 1 0 0 0 {qpos}" ctrl="{ctrl}"/></keyframe>'


@pytest.mark.parametrize(
    ("extra", "commands"),
    [
        (ATTACHED + OWN + key(".1 .2 .3 .9", ".15 0 0 0 .7"), [0.15, 0.3, 0.2, 0.7]),
        (PLUGIN + key(".1 .2 .3", ".5"), [0.1, 0.2, 0.3]),
        (TWO_COMMANDS + key(".1 .2 .3", ".4 .5 .6 .7"), [0.4, 0.5, 0.6, 0.1, 0.3]),
        (NESTED + key(".1 .2 .3", ".15 0 0 0"), [0.15, 0.3, 0.2]),
    ],
    ids=["attached gripper", "plugin", "two commands", "include beside an include"],
)
def test_models_of_several_parts_keep_what_is_not_the_servos(
    extra, commands, calibration, tmp_path
):
    (tmp_path / "parts").mkdir()
    for name, text in PARTS.items():
        (tmp_path / "parts" / name).write_text(text)
    (tmp_path / "robot.xml").write_text(robot(LINKS, actuators=extra))
    out = tmp_path / "elsewhere" / "out.xml"
    text, servos = to_model(calibration, tmp_path / "robot.xml", out)
    out.write_text(text)
    model = mujoco.MjModel.from_xml_path(str(out))
    assert model.key_ctrl[0].tolist() == pytest.approx(commands)
    for name, (compiled_number, written) in compiled_numbers(model, servos).items():
        np.testing.assert_array_equal(compiled_number, written, err_msg=name)


def test_actuators_on_tendons_are_no_servos_whatever_their_ids(calibration, tmp_path):
    tendon = (
        '<tendon><fixed name="first"><joint joint="LF_hip" coef="1"/></fixed></tendon><actuator>'
        '<position name="pull" tendon="first" kp="1000"/></actuator>'
    )
    model, servos = put_into(tmp_path, robot(LINKS, actuators=OWN + tendon), calibration)
    assert model.actuator("pull").id == model.nu - 1  # behind the servos, on tendon 0
    for name, (found, wanted) in compiled_numbers(model, servos).items():
        np.testing.assert_array_equal(found, wanted, err_msg=name)
    assert "and were left: pull" in " ".join((tmp_path / "out.xml").read_text().split())


def test_dry_friction_acts_in_a_model_without_constraints_and_the_others_stay_off(
    calibration, tmp_path
):
    settings = '<option><flag constraint="disable"/></option>'
    model, _ = put_into(
        tmp_path, robot(LINKS, settings, actuators=OWN), calibration, physics_step_s=TIME_STEP_S
    )
    bits = mujoco.mjtDisableBit
    kept = bits.mjDSBL_CONTACT | bits.mjDSBL_LIMIT | bits.mjDSBL_EQUALITY
    assert model.opt.disableflags == int(kept)
    names = calibration.joint_names
    there = moved_by(model, names, STEP_RAD, TIME_STEP_S)
    np.testing.assert_allclose(there, own_step(calibration, names), atol=1e-3)


def test_a_card_is_refused_where_no_hinge_is_driven(tmp_path):
    (tmp_path / "cart.xml").write_text(
        '<mujoco><worldbody><body><joint name="slider" type="slide"/><geom size="0.1"/><body>'
        '<joint name="pole"/><geom size="0.1"/></body></body></worldbody><actuator>'
        '<motor joint="slider"/></actuator></mujoco>'
    )
    with pytest.raises(InputError, match=r"drives none of its hinges \(pole\)"):
        to_model(load_calibration("sts3215-bam-m1"), tmp_path / "cart.xml", tmp_path / "out.xml")


def test_the_links_inertia_is_that_of_the_bodies_whatever_else_the_model_adds():
    text = robot(LINKS, joint='armature="0.7"', actuators=OWN)
    model = mujoco.MjModel.from_xml_string(text)
    assert link_inertias(model, list(LINKS)) == pytest.approx(LINKS, rel=1e-5)
    assert model.dof_armature[-1] == 0.7  # as before
    # a rod of mass m and length l about its end: m l² / 3, whoever carries it
    text = (
        '<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom type="box" pos="0 0 -0.15" '
        'size="0.0005 0.0005 0.15" mass="0.2"/></body></worldbody></mujoco>'
    )
    rod = link_inertias(mujoco.MjModel.from_xml_string(text), ["a"])
    assert rod["a"] == pytest.approx(0.2 * 0.3**2 / 3, rel=1e-4)


def test_a_free_air_armature_is_exported_with_a_warning_or_without_its_link(capsys, here):
    words = ("export", CALIBRATED, "--to", "mjcf", "--force")
    _, err = ran(capsys, *words)
    assert "counts their inertia twice" in err and "--link-inertia" in err
    links = ("--link-inertia", "LF_hip=2e-4", "LF_thigh=1e-4", "LF_calf=1e-5")
    _, err = ran(capsys, *words, *links)
    assert "twice" not in err and "taken off" in err
    text = (here / "calibrated.xml").read_text()
    own = load_calibration(CALIBRATED).joint("LF_hip").actuator.armature_kg_m2.value
    assert f'armature="{own - 2e-4!r}"' in text and "LF_hip 0.0002" in text


def test_a_model_that_cannot_take_the_servos_is_refused_with_the_way_out(calibration, here, capsys):
    (here / "other.xml").write_text(robot({"knee": 1e-4}))
    (here / "heavy.xml").write_text(robot({"LF_hip": 0.02}))
    (here / "a.urdf").write_text(
        '<robot name="a"><link name="b"/><link name="c"><inertial><mass value="1"/><inertia '
        'ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="LF_hip" '
        'type="revolute"><parent link="b"/><child link="c"/><limit lower="-1" upper="1" '
        'effort="1" velocity="1"/></joint></robot>'
    )
    for model, cure in (
        ("other.xml", "it has knee"), ("heavy.xml", "cannot be taken off"), ("a.urdf", "URDF"),
    ):  # fmt: skip
        words = ("export", CALIBRATED, "--to", "mjcf", "--model", model)
        assert cure in refused(capsys, pupper_sysid, *words)
    with pytest.raises(InputError, match="model is of"):
        calibration.export("mjlab", here, model="other.xml")


def test_joints_that_a_model_lacks_are_named(here, capsys):
    (here / "my.xml").write_text(robot({"LF_hip": 1e-4}, actuators=""))
    words = ("export", CALIBRATED, "--to", "mjcf", "--model", "my.xml", "--out", "out.xml")
    _, err = ran(capsys, *words)
    assert "my.xml has no joint LF_thigh, LF_calf" in " ".join(err.split())
    assert "left out: LF_thigh, LF_calf" in " ".join((here / "out.xml").read_text().split())
    said = refused(capsys, pupper_sysid, *words, "--force", "--link-inertia", "LF_calf=1e-4")
    assert "servos go into LF_hip" in said


def test_a_card_goes_into_every_driven_joint_of_a_published_robot(tmp_path):
    robots = Path(str(real_recording("playback_lstm_25hz.csv"))).parents[1] / "robots"
    source = robots / "open_duck_mini_v2.xml"
    if not source.exists():
        pytest.skip("the published robots are not at hand")
    card = load_calibration("sts3215-bam-m1")
    text, servos = to_model(card, source, tmp_path / "duck.xml")
    assert len(servos.calibration.joints) == 14 and servos.links == {}
    (tmp_path / "duck.xml").write_text(text)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "duck.xml"))
    theirs = mujoco.MjModel.from_xml_path(str(source))
    assert model.nu == theirs.nu and model.nbody == theirs.nbody
    np.testing.assert_array_equal(model.body_inertia, theirs.body_inertia)
    np.testing.assert_array_equal(model.jnt_range, theirs.jnt_range)
