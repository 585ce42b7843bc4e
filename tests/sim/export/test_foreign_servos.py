"""Servos as other projects' files state them, beside a calibration."""

import json

import numpy as np
import pytest

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.errors import InputError
from pupper_sysid.data import SAMPLES
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.cards.compare import differences, implausible, servo_of
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.sim.export.export import exported_text
from pupper_sysid.sim.export.foreign import foreign_servo
from pupper_sysid.sim.export.mjlab import BUILTIN_PD
from pupper_sysid.sim.export.shared import EXPLICIT_PD, ExportedServos
from support.command_line import refused, run_program

pytestmark = pytest.mark.usefixtures("read_here")

CALIBRATED = SAMPLES / "calibrated.yaml"
ROBOT = """<mujoco><compiler angle="radian"/><default><joint damping="0.3" frictionloss="0.02"/>
<position kp="20" dampratio="1"/><default class="knee"><joint armature="0.01" axis="0 1 0"/>
<position forcerange="-2 2"/></default></default><worldbody><body><joint name="hip" class="knee"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.005 0.005 0.005"/></body></worldbody>
<actuator><position joint="hip" class="knee"/></actuator></mujoco>"""
CONFIG = '''
"""Servos of a robot."""
raise SystemExit("this file is never run")
KP = 17.8
LEGS = DelayedPDActuatorCfg(
    joint_names_expr=[".*_hip", ".*_knee"], stiffness=KP, damping={".*_hip": 0.6, ".*": 0.7},
    armature=0.028, friction=0.05, min_delay=1, max_delay=4, **_limits(effort_limit=3.35),
)
HEAD = ImplicitActuatorCfg(joint_names_expr=["neck"], stiffness=2.0, damping=1.0)
'''


def test_class_defaults_and_damping_ratios_of_an_mjcf_are_resolved(tmp_path):
    (tmp_path / "robot.xml").write_text(ROBOT)
    servo = foreign_servo(tmp_path / "robot.xml")
    pd = servo.pd.parameters
    assert servo.part == "hip" and servo.link_kg_m2 == pytest.approx(0.005)
    assert (pd.stiffness, pd.effort_limit, pd.armature) == (20, 2, 0.01)
    assert (pd.friction_loss, pd.back_emf) == (0.02, 0.3)
    # a damping ratio of 1 for all that moves: 2 sqrt(kp (armature + link))
    assert pd.damping == pytest.approx(2 * np.sqrt(20 * 0.015))
    assert servo.parameters.armature == pytest.approx(0.015)


def test_a_velocity_actuator_is_no_servo_and_one_of_several_is_named(tmp_path):
    speed = '<velocity joint="hip" kv="3"/>'
    several = ROBOT.replace("<actuator>", f"<actuator>{speed}")
    (tmp_path / "robot.xml").write_text(several)
    servo = foreign_servo(tmp_path / "robot.xml")
    assert servo.pd.parameters.stiffness == 20
    assert any("by 2 actuators; one" in note for note in servo.notes)
    (tmp_path / "robot.xml").write_text(several.replace('<position joint="hip" class="knee"/>', ""))
    with pytest.raises(InputError, match="no position actuator drives a joint"):
        foreign_servo(tmp_path / "robot.xml")


def test_a_configuration_is_read_and_not_run(tmp_path):
    (tmp_path / "cfg.py").write_text(CONFIG)
    servo = foreign_servo(tmp_path / "cfg.py", "left_knee")
    pd = servo.pd.parameters
    assert (pd.stiffness, pd.damping, pd.armature) == (17.8, 0.7, 0.028)
    assert (pd.effort_limit, pd.friction_loss) == (3.35, 0.05)
    assert any("4 physics steps" in note for note in servo.notes)
    head = foreign_servo(tmp_path / "cfg.py", "neck")
    assert head.pd.parameters.stiffness == 2.0
    assert any("states no armature" in note for note in head.notes)


STYLES = {
    "isaaclab": (
        "STIFF = 25.0\nROBOT = ArticulationCfg(actuators={'legs': DCMotorCfg(joint_names_expr="
        "['.*_hip', '.*_thigh'], effort_limit=23.5, stiffness=STIFF, damping=0.5)})\n",
        (25.0, 0.5, 23.5),
    ),
    "mjlab": (
        "import math\nA: float = 0.001\nW = 10 * 2.0 * math.pi\nACT = BuiltinPositionActuatorCfg("
        "target_names_expr=('.*_thigh',), stiffness=A * W**2, damping=2.0 * 2.0 * A * W, "
        "effort_limit=0.35, armature=A)\n",
        (0.001 * (20 * np.pi) ** 2, 0.004 * 20 * np.pi, 0.35),
    ),
    "legged_gym": (
        "class Mine(LeggedRobotCfg):\n  class control(LeggedRobotCfg.control):\n"
        "    stiffness = {'hip': 7.0, 'thigh': 9.0}\n    damping = {'hip': 0.2, 'thigh': 0.1}\n"
        "  class asset:\n    armature = 0.001\n    effort_limit = 1.5\n",
        (9.0, 0.1, 1.5),
    ),
    "legged_gym of a base, beside the ground's friction": (
        "class Base:\n  class control:\n    stiffness = {'hip': 7.0, 'LF': 9.0}\n"
        "    damping = {'LF': 0.2}\n  class terrain:\n    friction = 1.0\n    damping = 3.0\n"
        "class Mine(Base):\n  class control(Base.control):\n    damping = {'LF': 0.3}\n",
        (9.0, 0.3, 100.0),
    ),
    "one pattern as text, and an effort beyond any hobby servo's": (
        "A = Cfg(joint_names_expr='.*_hip', stiffness=1.0, damping=1.0)\n"
        "B = Cfg(joint_names_expr='.*_thigh', stiffness=9.0, damping=0.1, effort_limit=300)\n",
        (9.0, 0.1, 100.0),
    ),
    "mjlab's actuator as an object": (
        "HIP = ElectricActuator(reflected_inertia=reflected_inertia(1e-4, 6), effort_limit=23.7)\n"
        "K = HIP.reflected_inertia * 62.8**2\nA = BuiltinPositionActuatorCfg(target_names_expr="
        "('.*_thigh',), stiffness=K, damping=0.5, effort_limit=HIP.effort_limit)\n",
        (3.6e-3 * 62.8**2, 0.5, 23.7),
    ),
    "playground, with a byte order mark": (
        "\ufeffdef config():\n  return create(sim_dt=0.004, Kp=35.0, Kd=0.5)\n",
        (35.0, 0.5, 100.0),
    ),
    "lists in the order of names": (
        "class C:\n  joint_names = ['a', 'LF_thigh']\n  stiffness = [1.0, 2.0]\n"
        "  damping = [0.1, 0.2]\n  armature = 0\n",
        (2.0, 0.2, 100.0),
    ),
    "dataclass": (
        "@dataclass\nclass C:\n  stiffness: dict = field(default_factory=lambda: {'LF': 4.0})\n"
        "  damping: float = 0.4\n  effort_limit: float = 2.0\n",
        (4.0, 0.4, 2.0),
    ),
}


@pytest.mark.parametrize("style", STYLES)
def test_the_common_styles_of_configurations_are_read(style, tmp_path):
    text, wanted = STYLES[style]
    (tmp_path / "cfg.py").write_text(text, encoding="utf-8")
    pd = foreign_servo(tmp_path / "cfg.py", "LF_thigh").pd.parameters
    assert (pd.stiffness, pd.damping, pd.effort_limit) == pytest.approx(wanted)
    assert pd.friction_loss == 0.0 and pd.armature >= 1e-4


LEG = "stiffness=20.0, damping=0.5, armature=0.001"
DELAYED = {
    "simulation settings": (
        f"A = Cfg({LEG}, min_delay=2, max_delay=6)\nS = Sim(dt=1 / 200)\n",
        0.02,
    ),
    "legged_gym": (
        "class C:\n  class control:\n    stiffness = {'hip': 9.0}\n    delay_steps = 3\n"
        "  class sim:\n    dt = 0.004\n",
        0.012,
    ),
    "a wrapper of a named actuator": (
        f"SIM_DT = 0.002\nB = Cfg({LEG})\nA = Late(base_cfg=B, delay_min_lag=4, delay_max_lag=5)\n",
        0.009,
    ),
    "two steps": (f"A = Cfg({LEG}, max_delay=6)\nS = Sim(dt=0.005)\nT = Sim(dt=0.002)\n", None),
}


@pytest.mark.parametrize("style", DELAYED)
def test_a_delay_in_steps_is_their_mean_times_the_step_that_the_file_states(style, tmp_path):
    text, seconds = DELAYED[style]
    (tmp_path / "cfg.py").write_text(text)
    servo = foreign_servo(tmp_path / "cfg.py", "LF_hip")
    dead_time = servo.pd.dead_time_s
    assert (dead_time and dead_time.value) == (seconds and pytest.approx(seconds))
    assert seconds or any("ambiguous" in note for note in servo.notes)


def test_what_stands_for_a_missing_number_is_no_difference(tmp_path):
    (tmp_path / "cfg.py").write_text("A = Cfg(stiffness=20.0)\n")
    (tmp_path / "robot.xml").write_text(ROBOT.replace('forcerange="-2 2"', ""))
    known = servo_of(str(CALIBRATED), "LF_hip")
    for name, joint in (("cfg.py", "LF_hip"), ("robot.xml", "hip")):
        rows = differences(known, foreign_servo(tmp_path / name, joint))
        effort = next(row for row in rows if row.quantity == "effort limit")
        assert effort.first is not None and effort.second is None and effort.ratio is None
        assert next(row for row in rows if row.quantity == "top speed").second is None


def test_arithmetic_that_grows_without_end_is_no_number(tmp_path):
    (tmp_path / "cfg.py").write_text("A = 9 ** 9 ** 9 ** 9\nB = make(stiffness=A / 0)\n")
    with pytest.raises(InputError, match="no stiffness"):
        foreign_servo(tmp_path / "cfg.py")
    (tmp_path / "cfg.py").write_text("B = make(stiffness=stiffness_of(rotor=2.0))\n")
    with pytest.raises(InputError, match="no stiffness"):  # a call's keyword is no joint's number
        foreign_servo(tmp_path / "cfg.py")


@pytest.mark.parametrize("pattern", ["(a+)+b", "(a|aa)*b", "a?" * 30 + "a" * 30, ".*" * 12 + "b"])
def test_a_joint_pattern_that_could_be_matched_for_ever_is_refused(pattern, tmp_path):
    config = f'LEG = IdealPDActuatorCfg(joint_names_expr=["{pattern}"], stiffness=20.0)'
    (tmp_path / "cfg.py").write_text(config)
    with pytest.raises(InputError, match="may take forever to match"):
        foreign_servo(tmp_path / "cfg.py", "a" * 30)


@pytest.mark.parametrize(
    "pattern", [r"(?:.*/)?(left|right)_(hip|knee)[0-9]+\.*", ".*_hip.*|.*_toe.*|.*_knee.*"]
)
def test_usual_joint_patterns_are_matched(pattern, tmp_path):
    config = f'LEG = IdealPDActuatorCfg(joint_names_expr=[r"{pattern}"], stiffness=20.0)'
    (tmp_path / "cfg.py").write_text(config)
    assert foreign_servo(tmp_path / "cfg.py", "left_knee2").pd.parameters.stiffness == 20.0


@pytest.mark.parametrize(("target", "engine"), [("isaaclab", EXPLICIT_PD), ("mjlab", BUILTIN_PD)])
def test_our_own_exports_are_read_back_as_they_were_written(target, engine, tmp_path):
    calibration = load_calibration(CALIBRATED)
    path = tmp_path / "exported.py"
    path.write_text(exported_text(calibration, target, 0.002)[0])
    servo = foreign_servo(path, "LF_thigh")
    own = ExportedServos.of(calibration, 0.002).actuators(engine)["LF_thigh"]
    assert servo.pd.stiffness_nm_per_rad.value == own.stiffness_nm_per_rad.value
    assert servo.pd.armature_kg_m2.value == own.armature_kg_m2.value
    assert servo.armature == "servo and load"
    path.write_text(exported_text(calibration, target, 0.002, link_inertia={"LF_thigh": 1e-4})[0])
    parts = {foreign_servo(path, name).armature for name in ("LF_thigh", "LF_hip")}
    assert parts == {"servo", "servo and load"}


def test_a_difference_says_what_differs_in_lag_and_motion(tmp_path, capsys):
    (tmp_path / "robot.xml").write_text(ROBOT.replace("hip", "LF_hip"))
    words = ("servo", "diff", CALIBRATED, tmp_path / "robot.xml", "--joint", "LF_hip")
    code, out, err = run_program(capsys, pupper_sysid, *words)
    said = " ".join(out.split())
    assert code == 0, err
    assert "compared as it stands" in said and "mrad apart" in said
    code, out, _ = run_program(capsys, pupper_sysid, *words, "--json")
    found = json.loads(out)
    assert found["differences"][0]["ratio"] == pytest.approx(20 / 8.4, rel=1e-3)
    moved = {d["quantity"]: d for d in found["differences"]}["armature and link"]
    assert moved["second"]["value"] == pytest.approx(0.015)


def test_files_without_a_servo_are_refused_with_the_way_out(tmp_path, capsys):
    (tmp_path / "robot.xml").write_text(ROBOT)
    (tmp_path / "cfg.py").write_text("A = make(stiffness=compute())\n")
    (tmp_path / "broken.py").write_text("def (\n")
    (tmp_path / "negative.py").write_text("A = Cfg(stiffness=-3.0)\n")
    for name, cure in (
        ("robot.xml", "they drive hip"), ("cfg.py", "keyword arguments"),
        ("broken.py", "no Python"), ("negative.py", "stiffness_nm_per_rad is not usable: -3"),
    ):  # fmt: skip
        words = ("servo", "diff", CALIBRATED, tmp_path / name, "--joint", "LF_hip")
        assert cure in refused(capsys, pupper_sysid, *words)


def test_an_arm_with_less_inertia_than_its_servo_is_named(capsys):
    sentences = implausible(load_card("sts3215-12v"))
    assert len(sentences) == 1 and "an arm cannot have less inertia than its servo" in sentences[0]
    assert implausible(load_card("sts3215-bam-m1")) == ()
    # a card of the same servo whose torques are twelve times as large is plausible
    card = load_card("sts3215-12v")
    heavy = {
        name: loop.model_copy(update={"armature_kg_m2": loop.armature_kg_m2.scaled(20.0)})
        for name, loop in card.specimens.items()
    }
    assert implausible(card.model_copy(update={"specimens": heavy})) == ()
    _, out, _ = run_program(capsys, pupper_sysid, "servo", "show", "sts3215-12v")
    assert "less inertia than its servo" in " ".join(out.split())
