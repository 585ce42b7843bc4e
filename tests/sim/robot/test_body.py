"""Bodies: the Mini Pupper's, and those made from a MJCF and a few lines of YAML."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.walks.together import evaluation_task
from pupper_sysid.sim.robot.body import Body, body_of, mini_pupper
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import robot_xml
from pupper_sysid.sim.robot.terrain import make_ground
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import PRESETS, for_robot
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.legged import legged

PLACES = {
    "front_left": (1, 1), "front_right": (1, -1), "rear_left": (-1, 1), "rear_right": (-1, -1)
}  # fmt: skip
POSE = 'pose: {"*_pitch": 0.7, "*_left_knee": -1.4, "*_right_knee": 1.4}\n'


def body(folder: Path, xml: str | None = None, config: str = POSE) -> Body:
    robot, own = folder / "robot.xml", folder / "robot.yaml"
    robot.write_text(xml or legged(PLACES))
    own.write_text(config)
    body_of.cache_clear()
    return body_of(str(robot), str(own))


def test_a_quadruped_gets_its_feet_gait_and_mirror_image_from_geometry(tmp_path):
    own = body(tmp_path)
    assert own.feet == tuple(f"foot_{n}_shank" for n in PLACES)
    np.testing.assert_array_equal(own.offsets, [0.0, 0.5, 0.5, 0.0])
    # 2 · 0.1 m · cos 0.7, and the foot's radius
    assert own.standing_height_m == pytest.approx(0.2 * np.cos(0.7) + 0.01)
    assert own.mirror_joints is not None and own.mirror_signs is not None
    names = [
        n.replace("left", "X").replace("right", "left").replace("X", "right") for n in own.joints
    ]
    assert [own.joints[i] for i in own.mirror_joints] == names
    # rolls turn about the forward axis, and right knees about the opposite one
    signs = [1.0 if n.endswith("pitch") else -1.0 for n in own.joints]
    np.testing.assert_array_equal(own.mirror_signs, signs)


def test_joints_that_put_feet_somewhere_are_the_inverse_of_where_feet_are(tmp_path):
    for own in (body(tmp_path), mini_pupper()):
        moved = np.random.default_rng(0).uniform(-0.05, 0.05, (20, len(own.feet), 3))
        feet = own.feet_at + own.standing_height_m * moved
        np.testing.assert_allclose(
            own.feet_in_trunk(own.joints_at(feet, np.zeros(feet.shape[:2]))), feet, atol=1e-6
        )


@pytest.mark.slow
def test_a_clocked_trot_carries_a_robot_that_no_one_has_seen_before(tmp_path):
    body(tmp_path)
    task = for_robot(PRESETS["fast"], tmp_path / "robot.xml", tmp_path / "robot.yaml")
    task = evaluation_task(task)
    assert task.body.commands == {} and task.commands.forward_m_s[1] > 0.2
    env = PupperEnv(task, servo_ranges("ideal", "ideal", task.body), 6, seed=0, threads=1)
    env.set_command(np.array([0.2, 0.0, 0.0]))
    speed = []
    for k in range(60):
        phase = np.full(6, 2 * np.pi * task.trot.frequency_hz * k * task.control_step_s)
        joints = task.trot.joints(phase, env.command, env.body)
        found = env.step((joints - env.default) / task.action_scale)
        assert not found.done.any()
        speed.append(found.facts.stride_velocity[:, 0])
    assert np.median(speed[30:]) == pytest.approx(0.2, rel=0.25)


def test_the_mini_puppers_own_file_makes_the_same_body(tmp_path):
    own = mini_pupper("serial")
    xml = robot_xml(servo_ranges("paper").nominal(), 0.002, "serial")
    pose = ", ".join(f"{n}: {a}" for n, a in zip(own.joints, own.pose, strict=True))
    read = body(tmp_path, xml, f"pose: {{{pose}}}\nfeet: [LF_foot, RF_foot, LB_foot, RB_foot]\n")
    assert read.joints == own.joints
    for name in ("pose", "low", "high", "offsets", "mirror_joints", "mirror_signs", "mirror_feet",
                 "leg_of"):  # fmt: skip
        np.testing.assert_array_equal(getattr(read, name), getattr(own, name), err_msg=name)
    np.testing.assert_allclose(read.feet_at, own.feet_at, atol=1e-9)
    assert read.mass_kg == pytest.approx(own.mass_kg)
    joints = np.random.default_rng(1).uniform(own.low, own.high, (9, 12))
    np.testing.assert_allclose(read.feet_in_trunk(joints), own.feet_in_trunk(joints), atol=1e-9)
    phase = np.linspace(0, 6, 9)
    command = np.tile([0.1, 0.02, 0.1], (9, 1))
    trot = Trot(lift_m=0.008)  # within the calves' range, at whose end a file's legs stop
    np.testing.assert_allclose(
        trot.joints(phase, command, read), trot.joints(phase, command, own), atol=1e-6
    )


@pytest.mark.parametrize(
    ("xml", "config", "words"),
    [
        (legged(PLACES, base=""), POSE, "no floating base: its first body (torso)"),
        ("<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>", POSE,
         "no hinge"),
        (None, "feet: [paw]\n" + POSE, "no site, geom or body 'paw'"),
        (None, "joints: [tail]\n" + POSE, "joints names 'tail'"),
        (None, "pose: home\n", "no keyframe 'home'; it has none"),
        (None, 'pose: {"*_roll": 2.0}\n', "beyond the limits of front_left_roll"),
        (None, "gait: gallop\n" + POSE, "gait 'gallop' is not known"),
        (None, "wheels: 4\n", "wheels"),
        (legged(PLACES).replace('size="0.01"', 'size="0.01" contype="0" conaffinity="0"'), POSE,
         "lowest geoms are of torso, on which joints hang"),
    ],
)  # fmt: skip
def test_what_a_robot_lacks_is_said_in_a_sentence(tmp_path, xml, config, words):
    with pytest.raises(InputError) as refused:
        body(tmp_path, xml, config)
    assert words in str(refused.value) and str(refused.value).endswith(".")


def test_a_servo_that_the_calibration_lacks_is_named(tmp_path):
    own = body(tmp_path, config=POSE + "servos: LF_elbow\n")
    with pytest.raises(InputError, match="servo of 'LF_elbow'"):
        servo_ranges("paper", "held", own)


def compiled(own: Body) -> Any:
    ranges = servo_ranges("paper", "held", own)
    return mujoco.MjModel.from_xml_string(
        own.xml(ranges.nominal(), 0.002, make_ground("flat", 0), "evaluation")
    )


CUBE = "".join(
    f"v {x} {y} {z}\n" for x in (-0.01, 0.01) for y in (-0.01, 0.01) for z in (-0.01, 0.01)
) + "f 1 2 3\nf 2 3 4\nf 5 6 7\nf 6 7 8\nf 1 2 5\nf 3 4 7\n"  # fmt: skip
BALL = '<geom type="sphere" size="0.01" pos="0 0 -0.1"/>'


def test_feet_may_be_meshes_beside_the_file_and_names_of_the_walk_may_be_taken(
    tmp_path, monkeypatch
):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "paw.obj").write_text(CUBE)
    assets = """<asset><mesh name="paw" file="paw.obj"/><texture name="grid" type="2d"
        builtin="flat" width="8" height="8"/><texture name="skin" type="2d" file="absent.png"/>
        <material name="grid" texture="grid"/><material name="skin" texture="skin"/></asset>"""
    mesh = '<geom type="mesh" mesh="paw" pos="0 0 -0.1" material="skin"/>'
    xml = legged(PLACES, more=assets).replace(BALL, mesh)
    xml = xml.replace('<body name="torso"', '<site name="foot_rear_left_shank"/><body name="torso"')
    xml = xml.replace("<compiler", '<compiler meshdir="parts"')
    monkeypatch.chdir("/")
    model = compiled(body(tmp_path, xml))
    assert model.nmesh == 1 and (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH).sum() == 4
    (tmp_path / "parts" / "paw.obj").unlink()
    with pytest.raises(
        InputError, match=r"are not there, or not STL or OBJ \(paw\).* belong into .*parts"
    ):
        body(tmp_path, xml.replace('<geom type="box"', '<geom contype="0" conaffinity="0"'))


def test_a_mesh_that_is_only_shown_counts_where_it_is_all_of_a_bodys_mass(tmp_path):
    shown = '<geom type="mesh" mesh="block" contype="0" conaffinity="0" density="1e6"/>'
    corners = [f"{x} {y} {z}" for x in (0, 0.02) for y in (0, 0.02) for z in (0, 0.02)]
    asset = f'<asset><mesh name="block" vertex="{" ".join(corners)}"/></asset>'
    trunk = '<inertial mass="1" pos="0 0 0"\n        diaginertia="0.01 0.01 0.01"/>'
    xml = legged(PLACES, more=asset).replace(trunk, shown)
    own = body(tmp_path, xml)
    assert own.mass_kg == pytest.approx(4 * 0.13 + 8.0 + 0.96, rel=0.01)  # density times volume


def test_feet_of_several_geoms_stand_in_their_middle_and_feel_all_of_them(tmp_path):
    corners = "".join(
        f'<geom size="0.01" pos="{x} {y} -0.1"/>' for x in (0.02, -0.02) for y in (0.01, -0.01)
    )
    two = {n: (0, side) for n, (_, side) in list(PLACES.items())[:2]}
    own = body(tmp_path, legged(two).replace(BALL, corners), "gait: biped\n")
    np.testing.assert_allclose(own.feet_at, [[0, 0.09, -0.2], [0, -0.09, -0.2]], atol=1e-12)
    assert own.mirror_feet is not None
    assert compiled(own).site_size[0, 0] > np.hypot(0.02, 0.01) + 0.01


TWO = {n: (0, side) for n, (_, side) in list(PLACES.items())[:2]}
ANKLE = """<body pos="0 0 -0.1"><joint name="{}_ankle" axis="0 1 0" range="-2 2"/><inertial
    mass="0.02" pos="0 0 0" diaginertia="1e-5 1e-5 1e-5"/><geom type="box" size="0.03 0.02 0.005"
    pos="0.01 0 -0.01"/></body>"""


def biped(folder: Path, more: Callable[[str, str], str] = lambda xml, name: xml) -> Body:
    xml = legged(TWO)
    for name in TWO:
        xml = more(xml.replace(BALL, ANKLE.format(name), 1), name)
    return body(folder, xml, POSE.replace("}", ', "*_left_ankle": 0.7, "*_right_ankle": 0.7}'))


def test_soles_of_legs_with_an_ankle_stay_level_and_feet_where_they_are_to_be(tmp_path):
    own = biped(tmp_path)
    moved = np.random.default_rng(0).uniform(-1, 1, (20, 2, 3)) * [0.02, 0.0, 0.02]
    joints = own.joints_at(own.feet_at + moved, np.zeros((20, 2)))
    np.testing.assert_allclose(own.feet_in_trunk(joints), own.feet_at + moved, atol=2e-4)
    signs = [1.0 if n.endswith(("pitch", "ankle", "left_knee")) else -1.0 for n in own.joints]
    pitch = joints * np.where([n.endswith("roll") for n in own.joints], 0.0, signs)
    np.testing.assert_allclose(pitch.reshape(20, 2, 4).sum(axis=2), 0.0, atol=0.01)


def test_soles_turn_under_the_trunk_while_they_stand(tmp_path):
    yaw = '<joint name="{}_yaw" axis="0 0 1" range="-1 1"/>'
    before = '<body name="{}_thigh"'
    own = biped(
        tmp_path, lambda xml, n: xml.replace(before.format(n), yaw.format(n) + before.format(n))
    )
    assert own.sways and not mini_pupper().sways
    heading = np.tile([0.2, -0.1], (3, 1))
    joints = own.joints_at(np.repeat(own.feet_at[None], 3, axis=0), heading)
    turned = joints[:, [own.joints.index(f"{n}_yaw") for n in TWO]]
    np.testing.assert_allclose(turned, heading, atol=0.01)
    # by the rate of the turn times the time that a foot stands
    trot, command = Trot(frequency_hz=2.0, turn_gain=1.0, turn_dead_band_rad_s=0.0), [[0, 0, 0.4]]
    ends = [
        trot.joints(np.array([2 * np.pi * at]), np.array(command), own)[0] for at in (0, trot.duty)
    ]
    left = own.joints.index("front_left_yaw")
    assert ends[0][left] - ends[1][left] == pytest.approx(0.4 * trot.duty / 2.0, rel=0.1)


def test_a_robot_that_faces_along_y_is_said_to_and_turned(tmp_path):
    tensor = 'fullinertia="0.01 0.02 0.025 0.001 0 0"'
    xml = legged(PLACES).replace('diaginertia="0.01 0.01 0.01"', tensor)
    usual = body(tmp_path, xml)
    # the same robot, but the trunk's y is forward
    head, inside, tail = (
        xml[: (a := xml.index("<inertial"))], xml[a : (b := xml.index("</body>\n      </world"))],
        xml[b:],
    )  # fmt: skip
    rest = inside[inside.index("/>") + 2 :]
    inertial = '<inertial mass="1" pos="0 0 0" fullinertia="0.02 0.01 0.025 -0.001 0 0"/>'
    turned = f'{head}{inertial}<frame euler="0 0 {np.pi / 2}">{rest}</frame>{tail}'
    seen = body(tmp_path, turned)
    assert seen.mirror_joints is None and any("`forward: y`" in note for note in seen.notes)
    own = body(tmp_path, turned, POSE + "forward: y\n")
    np.testing.assert_allclose(own.feet_at, usual.feet_at, atol=1e-9)
    np.testing.assert_array_equal(own.mirror_signs, usual.mirror_signs)
    tensors = []
    for one in (usual, own):
        model = compiled(one)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body("torso").iquat)
        turn = turn.reshape(3, 3)
        tensors.append(turn @ np.diag(model.body("torso").inertia) @ turn.T)
    np.testing.assert_allclose(*tensors, atol=1e-9)


def test_geoms_that_only_touch_in_pairs_can_be_feet(tmp_path):
    foot = '<geom name="{name}" size="0.01" pos="0 0 -0.1" contype="0" conaffinity="0"/>'
    xml = legged(PLACES)
    for n in PLACES:
        xml = xml.replace(BALL, foot.format(name=n), 1)
    ground = '<worldbody><geom name="floor" type="plane" size="1 1 1"/></worldbody>'
    pairs = "".join(f'<pair geom1="{n}" geom2="floor"/>' for n in PLACES)
    own = body(tmp_path, xml.replace("</mujoco>", f"{ground}<contact>{pairs}</contact></mujoco>"))
    assert own.foot_geoms == tuple(PLACES)


ARM = """<body name="neck" pos="0.1 0 0.05"><joint name="neck" axis="0 1 0" range="-2 2"/>
  <geom size="0.01" pos="0 0 0.1" mass="0.05"/><body name="head" pos="0 0 0.1"><joint name="head"
    axis="1 0 0"/><geom size="0.01" pos="0.05 0 0" mass="0.05"/><body name="jaw"><joint name="jaw"
    axis="1 0 0"/><geom size="0.01" pos="0.05 0 0" mass="0.05"/></body></body></body>"""


def test_joints_that_are_fixed_stay_as_they_are_in_the_pose(tmp_path):
    xml = legged(PLACES, base="<freejoint/>" + ARM)
    legs = "joints: ['*_roll', '*_pitch', '*_knee']\n"
    pose = POSE.replace("}", ", neck: -1.5707963}")
    model = compiled(body(tmp_path, xml, legs + pose))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    head = data.body("head").xpos - data.body("torso").xpos
    np.testing.assert_allclose(head, [0, 0, 0.05], atol=1e-6)


def test_linkages_are_taken_out_and_said_and_joints_of_tendons_have_servos(tmp_path):
    spare = '<body name="rod"><joint type="ball"/><geom size="0.005" mass="0.01"/></body>'
    joints = [f"{n}_{k}" for n in PLACES for k in ("roll", "pitch")]
    motors = "".join(f'<motor joint="{j}"/>' for j in joints)
    knees = "".join(f'<joint joint="{n}_knee" coef="1"/>' for n in PLACES)
    more = f"""<tendon><fixed name="knees">{knees}</fixed></tendon>
        <actuator>{motors}<motor tendon="knees"/></actuator>
        <equality><connect body1="rod" body2="rear_left_shank" anchor="0 0 0"/></equality>"""
    own = body(tmp_path, legged(PLACES, base="<freejoint/>" + spare, more=more))
    assert len(own.joints) == 12
    assert any("couples bodies or joints" in note for note in own.notes)
    assert compiled(own).nq == 7 + 12


def test_gravity_and_friction_are_those_of_a_walk_whatever_the_file_has(tmp_path):
    more = '<option gravity="0 0 0" impratio="100"><flag contact="disable"/></option>'
    xml = legged(PLACES, more=more).replace(BALL, BALL.replace("/>", ' condim="1"/>'))
    model = compiled(body(tmp_path, xml.replace('name="torso"', 'name="torso" gravcomp="1"')))
    assert (model.opt.gravity[2], model.opt.impratio, model.opt.disableflags) == (-9.81, 1, 0)
    assert not model.body_gravcomp.any() and model.geom("geom 1").condim == 3


def test_two_legs_walk_by_turns_and_joints_without_a_servo_are_fixed(tmp_path):
    two = {n: (0, side) for n, (_, side) in list(PLACES.items())[:2]}
    own = body(tmp_path, legged(two), "joints: ['*_pitch', '*_knee']\n" + POSE)
    assert len(own.joints) == 4 and any("fixed: front_left_roll" in n for n in own.notes)
    np.testing.assert_array_equal(own.offsets, [0.0, 0.5])
    assert own.together == () and own.apart == ((0, 1),)


SHANK = '<geom type="{0}" size="{1}" pos="0 0 -0.05"/>'


@pytest.mark.parametrize(
    ("geom", "radius"),
    [
        (SHANK.format("capsule", "0.01 0.05"), 0.01),
        (SHANK.format("box", "0.01 0.01 0.05"), 0.0),
        (SHANK.format("cylinder", "0.01 0.05"), 0.0),
    ],
)
def test_a_leg_stands_on_the_end_of_its_last_limb_not_on_the_middle_of_it(tmp_path, geom, radius):
    own = body(tmp_path, legged(PLACES).replace(BALL, geom), "{}")
    # two limbs of 0.1 m straight down; a capsule's round end is beyond that
    np.testing.assert_allclose(own.feet_at[:, 2], -0.2)
    np.testing.assert_allclose(own.sole_m, radius, atol=1e-12)
    bent = body(tmp_path, legged(PLACES).replace(BALL, geom))
    ends = body(tmp_path, legged(PLACES))  # with a ball at that end
    near = np.hypot(0.01, 0.01) if radius == 0.0 else 1e-9
    assert np.linalg.norm(bent.feet_at - ends.feet_at, axis=1).max() <= near


URDF = """<robot name="dog"><link name="base"/><joint name="f" type="fixed"><parent link="base"/>
<child link="torso"/></joint><link name="torso"><inertial><mass value="1"/><inertia ixx=".01"
iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>{}</robot>"""
LIMB = """<link name="{0}"><inertial><mass value=".05"/><inertia ixx="{i}" iyy="{i}" izz="{i}"
ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="{0}_{axis}" type="revolute"><parent
link="{1}"/><child link="{0}"/><origin xyz="{at}"/><axis xyz="{turns}"/><limit lower="-1.5"
upper="1.5" effort="0.01" velocity="1"/></joint>"""
PAW = """<link name="{0}_paw"><inertial><mass value=".001"/><inertia ixx="1e-7" iyy="1e-7"
izz="1e-7" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry>
<mesh filename="package://dog/meshes/paw.obj"/></geometry></collision></link>
<joint name="{0}_tip" type="fixed"><parent link="{0}_shank"/><child link="{0}_paw"/>
<origin xyz="0 0 -.1"/></joint>"""


def urdf(inertia: float = 1e-5) -> str:
    """A quadruped whose knees bend, from a base without a mass, with paws that are meshes."""
    limbs = ""
    for n, (fore, side) in PLACES.items():
        at = f"{0.12 * fore} {0.09 * side} 0"
        for name, above, place, axis, turns in (
            (f"{n}_hip", "torso", at, "roll", "1 0 0"), (f"{n}_thigh", f"{n}_hip", "0 0 0", "pitch",
            "0 1 0"), (f"{n}_shank", f"{n}_thigh", "0 0 -.1", "knee", "0 1 0"),
        ):  # fmt: skip
            limbs += LIMB.format(name, above, at=place, axis=axis, turns=turns, i=inertia)
        limbs += PAW.format(n)
    return URDF.format(limbs)


def of_urdf(folder: Path, text: str) -> Body:
    (folder / "dog" / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "dog" / "meshes" / "paw.obj").write_text(CUBE)
    robot, config = folder / "dog" / "dog.urdf", folder / "dog.yaml"
    robot.write_text(text)
    paws = ", ".join(f"{n}_paw" for n in PLACES)
    config.write_text(f'pose: {{"*_pitch": 0.7, "*_knee": -1.4}}\nfeet: [{paws}]\n')
    body_of.cache_clear()
    return body_of(str(robot), str(config))


def test_a_urdf_is_a_robot_whose_base_is_free_with_the_torque_of_its_servos(tmp_path):
    own = of_urdf(tmp_path, urdf())
    assert len(own.joints) == 12 and own.mirror_joints is not None
    assert own.mass_kg == pytest.approx(1 + 12 * 0.05 + 4 * 0.001, abs=1e-4)
    model = compiled(own)
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and model.nmesh == 1
    assert not model.jnt_actfrclimited.any()  # its efforts of 0.01 N·m are not the servos'


def test_inertias_that_are_placeholders_are_replaced_and_said(tmp_path):
    own = of_urdf(tmp_path, urdf(inertia=1.0))  # of a link of 50 g: 4.5 m in radius
    assert any("Inertias of front_left_hip" in note for note in own.notes)
    assert compiled(own).body_inertia.max() <= 0.05
    assert not any("Inertias" in note for note in of_urdf(tmp_path, urdf()).notes)


def test_a_ball_and_stairs_beside_the_robot_are_taken_out(tmp_path):
    ball = """<worldbody><camera mode="targetbody" target="ball"/><geom size="1"/>
        <body name="ball"><freejoint/>{}</body>"""
    key = '<keyframe><key name="up" qpos="{} 0 0 0.2 1 0 0 0 {}"/></keyframe>'
    bent = [x for n in PLACES for x in ("0", "0.7", "-1.4" if "left" in n else "1.4")]
    xml = legged(PLACES, more=key.format("1 0 0 1 0 0 0", " ".join(bent)))
    xml = xml.replace("<worldbody>", ball.format('<geom size="0.05"/>'))
    own, alone = body(tmp_path, xml, "{}"), body(tmp_path)
    assert own.joints == alone.joints and own.mass_kg == pytest.approx(alone.mass_kg)
    np.testing.assert_allclose(own.pose, alone.pose)
    assert compiled(own).ngeom == compiled(alone).ngeom


def test_actuators_in_a_files_default_class_are_not_the_servos(tmp_path):
    default = """<default><general gear="150" ctrllimited="true" ctrlrange="-0.4 0.4" actdim="1"
        forcelimited="true" forcerange="-1 1" dyntype="filter" dynprm="0.1"/></default>"""
    plain = compiled(body(tmp_path))
    model = compiled(body(tmp_path, legged(PLACES).replace("<worldbody>", default + "<worldbody>")))
    for name in ("gear", "ctrllimited", "forcelimited", "forcerange", "dyntype", "dynprm",
                 "gainprm", "biasprm", "delay"):  # fmt: skip
        field = f"actuator_{name}"
        np.testing.assert_array_equal(getattr(model, field), getattr(plain, field), name)


@pytest.mark.parametrize(
    ("xml", "config", "words"),
    [
        (legged(PLACES).replace("-0.1", "-100"), POSE, "Lengths are in metres"),
        # thighs up: the lowest geoms are of the hips
        (legged(PLACES).replace('diaginertia="1e-5 1e-5 1e-5"/><joint name="', 'diaginertia="1e-5 '
         '1e-5 1e-5"/><geom size="0.04"/><joint name="', 4), 'pose: {"*_pitch": 2.0}\n',
         "front_left_hip, front_right_hip, rear_left_hip, rear_right_hip, on which joints hang"),
    ],
)  # fmt: skip
def test_poses_and_lengths_with_which_nothing_walks_are_refused(tmp_path, xml, config, words):
    with pytest.raises(InputError) as refused:
        body(tmp_path, xml, config)
    assert words in str(refused.value)


def test_what_the_names_of_legs_say_about_the_front_is_compared_with_the_axis(tmp_path):
    def noted(**turned: tuple[int, int]) -> list[str]:
        own = body(tmp_path, legged(turned, mirrored=False), "{}")
        return [note for note in own.notes if "By the names" in note]

    assert not noted(FL=(1, 1), FR=(1, -1), RL=(-1, 1), RR=(-1, -1))
    assert not noted(a=(1, 1), b=(1, -1), c=(-1, 1), d=(-1, -1))
    (note,) = noted(FL=(-1, -1), FR=(-1, 1), RL=(1, -1), RR=(1, 1))
    assert "`forward: -x`" in note
    (note,) = noted(left_hind=(-1, -1), right_hind=(1, -1), left_fore=(-1, 1), right_fore=(1, 1))
    assert "`forward: y`" in note


def test_legs_that_only_swing_get_no_commands_sideways(tmp_path):
    fixed = "joints: ['*_pitch', '*_knee']\n" + POSE
    own = body(tmp_path, config=fixed)
    assert own.commands == {"sideways_m_s": (0.0, 0.0)}
    assert any("cannot step sideways" in note for note in own.notes)
    stated = body(tmp_path, config=fixed + "commands: {sideways_m_s: [-0.1, 0.1]}\n")
    assert stated.commands == {"sideways_m_s": (-0.1, 0.1)}
    assert body(tmp_path).commands == {}


def test_a_joint_that_turns_on_and_on_has_a_servos_turn_about_its_pose(tmp_path):
    own = body(tmp_path, legged(PLACES).replace('range="-1 2"', 'range="-10 30"'))
    pitch = own.joints.index("front_left_pitch")
    assert (own.low[pitch], own.high[pitch]) == pytest.approx((0.7 - np.pi, 0.7 + np.pi))


def test_of_several_keyframes_that_to_stand_in_is_the_pose(tmp_path):
    keys = "".join(
        f'<key name="{name}" qpos="0 0 0.2 1 0 0 0 {" ".join([f"0 {angle} 0"] * 4)}"/>'
        for name, angle in (("folded", 1.5), ("home", 0.25))
    )
    own = body(tmp_path, legged(PLACES, more=f"<keyframe>{keys}</keyframe>"), "{}")
    assert own.pose[1] == 0.25 and any("it has folded, too" in note for note in own.notes)
