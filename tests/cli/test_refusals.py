"""What no command can use is refused before any work: one sentence, exit code 2, nothing written.

A row is a command and words of its refusal; `[a b]` stands for each of these words.
"""

import itertools
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.cli.programs import (
    pupper_analyze,
    pupper_deploy,
    pupper_eval,
    pupper_play,
    pupper_sysid,
    pupper_train,
)
from pupper_sysid.common.errors import refuse_outside
from pupper_sysid.common.joints import STALL_TORQUES_NM
from pupper_sysid.data import SAMPLES
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.policies.deploy.deployment import checked_command
from pupper_sysid.policies.deploy.stacks import Stack
from pupper_sysid.policies.train.run_file import Run, preset, resume_run, save_run
from pupper_sysid.servo_models.calibration.parts import Actuator
from pupper_sysid.servo_models.calibration.quantity import PlausibleRange
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.fleet import Calibrations
from pupper_sysid.sysid.plan.plan_file import save_plan
from pupper_sysid.sysid.plan.proposal import plan_from_recordings
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.report.report import write_report
from pupper_sysid.sysid.servo_fit.fit import Split
from pupper_sysid.sysid.sweep.bench import BENCH, BENCH_KINDS, bench_plan, parse_load
from pupper_sysid.sysid.sweep.excitation import KINDS, LARGEST_AMPLITUDE_RAD, plan
from support.command_line import refused
from support.planned_servos import small_plan
from support.refusals import assert_each_refused

NUMBERS = "4_1 ٤١ １０ 0x10 1e 4,1"
"""Which Python's `float` or `int` takes, or nearly."""

READING = """
nonsense | nonsense
calibarte | Did you mean `pupper-sysid calibrate`
delay [nowhere.csv missing.npz] | does not exist
delay | No recording was named
delay log.csv --joints LF_hipp | Did you mean LF_hip
delay log.csv LF_hip | choose it with `--joints LF_hip`
compare log.csv --models paper,nowhere.yaml | error: nowhere.yaml does not exist
sweep --freqs 1 2 4 8 | with commas, without spaces: --freqs 1,2,4,8
sweep --amplitude 5deg | --amplitude is '5deg'. Write a number in rad, without its unit
sweep --amplitude 0.1 0.2 | --amplitude takes one number, not 2: --amplitude 0.1
sweep --joint LF_hip | Did you mean --joints
sweep --port /dev/ttyUSB0 | Did you mean --bus
calibrate log.csv --output c.yaml | Did you mean --out?
export calibrated.yaml --to isaac-lab | Did you mean --to isaaclab?
export calibrated.yaml isaaclab | needs the name of its option: --to isaaclab
servo lst | Did you mean list
doctor log.csv --read-limit [0 0.5 1001 nan inf x 4_1 ٣ ""] | --read-limit
doctor log.csv [--read-limit=0 --read-limit] | --read-limit
[import doctor calibrate fit-servo] loop.csv | loop.csv
[import doctor delay calibrate report] cal.yaml | cal.yaml is a calibration, not a recording
doctor other.yaml | is YAML
doctor sweep.truth.yaml | the truth of an emulated recording
doctor robot.xml | is XML
import log.csv --command "u {joint}" | belong together
import log.csv --unit furlong | Write rad, deg
import wide.csv | raise the limits of reading with --read-limit 2.
calibrate nowhere.csv --stall-torque [0 1e308 -1 1e-9 nan inf] | --stall-torque is
calibrate log.csv --out [cal.csv calibrated] | a calibration is a .yaml file
calibrate nowhere.csv --jobs [0 -2 999999999999999999999] | --jobs is
[calibrate fit-servo report] nowhere.csv --seed 999999999999999999999 | --seed is
calibrate nowhere.csv --seed -1 | --seed is
fit-servo nowhere.csv --jobs 0 | --jobs is
fit-servo nowhere.csv --test-after 1 --train-before [nan -1 1e308] | --train-before is
fit-servo nowhere.csv --train-before 1 --test-after inf | --test-after is
fit-servo walk.csv --train-loops 0,1 | go together
fit-servo walk.csv --train-loops 0,1 --test-loops 1 | Loop 1 is in
fit-servo walk.csv --train-loops zero --test-loops 1 | 'zero'
fit-servo walk.csv --joints LF_calf --train-loops 0 --test-loops 7 | nothing to test on
fit-servo walk.csv --train-before 2 --test-after 1 | before testing begins
fit-servo walk.csv --train-before 1 --test-after 1 --leave-one-frequency-out | one way
fit-servo walk.csv --train-before 0.2 --test-after 1 --train-loops 0 | one way
fit-servo walk.csv --preset paper --arch fir | no published fir
sindy none.csv | none.csv
compare walk.csv | --models
compare walk.csv --models log.csv | log.csv is a recording, not a calibration
compare walk.csv --models sts3215-bam | Did you mean sts3215-bam-m
compare nowhere.csv --models paper --seed 999999999999999999999 | --seed is
export x.docx | neither
export missing.yaml | missing.yaml
export loop.csv --to json | loop.csv
export nowhere.csv --gain [0 -16 nan 1e308] | --gain is
export nowhere.csv --physics-step [0 nan 1 1e308] | --physics-step is
servo diff paper release --gain 1e308 | --gain is
export log.csv --to mjcf | pupper-sysid calibrate
export policy --to mjlab | --to onnx
export cal.yaml --to isaaclab-bam | not fitted under load
export cal.yaml --to [mjcf isaaclab mjlab newton] --out x --physics-step 0.05 | steps of 50 ms; take
export cal.yaml --to mjcf --link-inertia LF_hip=0.01 | cannot be taken off
export cal.yaml --to mjcf --link-inertia LF_hip | LF_thigh=0.0012
export cal.yaml --to mjcf --link-inertia arm=0.1 | the calibration has LF_hip
export sts3215-bam-m1 --to mjcf --out a.xml --link-inertia servo=0.001 | no link to take off
init-robot | needs the robot's MJCF or URDF
init-robot robot.xml --joints pan=1 | needs the robot's MJCF or URDF
init-robot --joints pan | 'pan' is not NAME=ID
init-robot --joints pan=1,tilt=1 | have the same id 1
init-robot --joints pan=1,pan=2 | pan is there twice
init-robot robot.xml | no hinge joint
plan --seconds [-1 0 nan 1e6 1e308] | --seconds is
plan --rate [0 inf] | --rate is
plan --joints LF_knee | LF_knee
plan --out taken.yaml | --force
plan missing.csv | does not exist
"""
MOVING = f"""
sweep --freqs [10-1 abc] | --freqs
sweep --freqs 0.001 | at least 0.01 Hz
sweep --amplitude [0 -0.1 nan 20] | --amplitude is
sweep --amplitude 20 | 20 degrees are 0.35
sweep --amplitude 0 --load pendulum:0.1kg@0.10m | at most 3.14 rad
sweep --amplitude 20 --load pendulum:0.1kg@0.10m --kind drop | at most 3.14 rad
sweep --out x.txt | .csv
sweep --duration [0 1e12 nan] | --duration is
sweep --rate [0 1e12 1e-12] | --rate is
sweep [--rate --seed] [{NUMBERS}] | is not a
sweep --loops 0 | --loops is
sweep --playback commands.csv --loops 1000000000000 | from 1 to 1000
sweep --duration 86400 --rate 1000 | rows; at most 5,000,000
sweep --until "" | --until is empty
sweep --until dead_time:1us | --until
sweep --until dead_time:3ms --most-seconds 0 | --most-seconds is
sweep --joints "" | --joints is empty
sweep --playback /dev/zero | /dev/zero is not a file
sweep --bus usb | write emulated, esp32
sweep --bus feetech:/dev/ttyUSB0@fast | 'fast' is no baud rate
sweep --out a.csv --bus feetech:/dev/no-such-port | there is no such device
sweep --out a.csv --bus [esp32:/tmp/no-folder/socket esp32:no.socket] | no answer. On the robot
sweep --bus esp32 --out a.csv --truth | only a new recording of the emulated robot
sweep --bus esp32 --real-time | always runs in real time
sweep --bus feetech:nowhere --registers p=16 | A real one's are recorded
sweep --registers p=16 | have none that act
sweep --joint-map bench_sts3215 --registers q=16 | 'q=16' sets no register
sweep --load none --registers p=16 | on a bench --gains
sweep --joint-map nowhere.yaml | does not exist
sweep --resume nothing.csv | does not exist
sweep --gains 8,16 | one servo on a bench
sweep --kind drop | one servo on a bench
sweep --load bucket | is no load
sweep --load pendulum:0.1kg@0.10m --joint-map sts3215 | name it with --joints
sweep --load pendulum:0.1kg@0.10m --playback x.csv | give one of the two
sweep --load pendulum:0.1kg@0.10m --gains 0 | are no P gains
sweep --load pendulum:0.1kg@0.10m,hanging=20rad | 20 degrees are
sweep --load pendulum:0.1kg@0.10m,hanging=-4rad | half a turn
sweep --plan missing.yaml | does not exist
sweep --plan other.yaml | is not a plan
sweep --plan plan.yaml --joints RF_hip | RF_hip
sweep --plan plan.yaml --playback x.csv | one of the two
sweep --mcap mine.mcap --joints LF_hip | mine.mcap exists already
sweep --mcap b.csv | must end in .mcap
sweep --rerun b.csv | ends in .rrd, the word viewer, or
sweep --mcap b.mcap --until dead_time:2ms | --until makes several recordings
monitor --bus emulated --seconds [0 -1] | --seconds is
monitor --bus emulated --rate [0 1e9] | --rate is
monitor --bus emulated --joint-map sts3215 | has its own
monitor --bus emulated --seconds 1 --mcap m.mcap --once | Give one of the two
monitor --bus usb | write emulated, esp32
emulate feetech --ids [1-999999999999 5-1 ٣ "" 1, 0 1-20] | --ids
emulate feetech --baud [0 7] | --baud
emulate feetech --joint-map sts3215 --walking | only the Mini Pupper
emulate feetech --model scs0009 --registers p=16 | do not act
emulate feetech --load none --backlash [1e9 -1] | --backlash is
emulate esp32 --walking --by-hand | leave out --walking
emulate esp32 --faults gremlins=1 | 'gremlins' is not known
emulate esp32 --faults lost=2 | is not a probability
emulate esp32 --faults lost | is not kind=probability
calibrate-joints --bus feetech:/dev/x --out taken.yaml | exists already
calibrate-joints --bus feetech:/dev/x --out map.csv | a joint map is a .yaml file
calibrate-joints --bus feetech:/dev/x --scale-deg 1 | 5 to 300
calibrate-joints --bus emulated | it cannot be moved by hand
calibrate-joints --bus feetech:/dev/x --joints LF --scale-joint RF_hip | not among the joints
"""
TRAINING = r"""
--actuator missing.yaml | pupper-sysid calibrate
--actuator wing.yaml --environments 2 | LF_wing
--actuator paper --start scratch --imitation.teacher runs/t | runs/t holds no run
--actuator paper --start teacher --policy lstm | A teacher is an MLP, not a policy of kind lstm
--policy [perceptron ""] | policy
--policy=perceptron | perceptron
--policy | policy
--preset quick | quick
--environment-count 3 | --environment-count
--environments x | x
--actuator paper --environments [0 999999999999999999999] | environments is
--actuator paper --first-gait keep --policy lstm --environments 1 | 1 environments cannot be split
--actuator paper --minutes nan | minutes is
--actuator paper --seed -1 | seed is -1; it must be 0 or more
--actuator paper --architecture.hidden --seed 1 | architecture.hidden is empty
--actuator paper --task.randomisation.friction 1 0.3 | randomisation.friction is 1 to 0.3
--actuator paper --task.randomisation.friction -1 0.3 | from 0 on
--actuator paper --task.commands.yaw-rad-s 0.5 -0.5 | commands.yaw_rad_s is 0.5 to -0.5
--actuator paper --name [../../x a/b "" .x 'a\x1bc' 'x\n' LONG] | --name
--resume empty | empty holds no run: there is no run.yaml in it
--resume nowhere | does not exist
"""
POLICY = """
nowhere | neither a run nor a policy
empty | neither a run nor a policy
begun | has no policy yet
teacher | is a teacher, which sees what no robot can
policy --actuator missing.yaml | no such file
policy --seconds 0 | --seconds is 0.0; it must be a positive number
"""
EVALUATION = """
policy --episodes 0 | --episodes is 0; it must be at least 1
policy --extra-delay-ms 0 [-40 nan] | --extra-delay-ms is
"""
PLAYING = """
policy --seconds nan | must be a positive number
policy --video walk.gif | ends in .mp4
policy --video there.mp4 | exists already
"""
DEPLOYMENT = r"""
| No policy was named
nowhere | neither a run nor a policy
policy --actuator nowhere.yaml | no such file
policy --actuator cal.yaml --bus [feetech:/dev/none dynamixel:/dev/none] | no IMU
policy --actuator cal.yaml --bus serial | bus serial
policy --actuator cal.yaml --stack lstm-servo | --servo
policy --actuator cal.yaml --command 9 0 0 | --command
policy --actuator cal.yaml --lowpass-hz 40 | half the rate
policy --actuator cal.yaml --keyboard | terminal
policy --replay nowhere.csv | does not exist
policy [--playback --replay] /dev/zero | is not a file
policy --seconds -1 | --seconds
policy --seed -1 | --seed is -1
policy --name [../../x a/b "" .x 'a\x1bc' 'x\n' LONG] | --name
--playback commands.csv --rate 0 | --rate is 0
--rate 0 | --rate is 0
--lowpass-hz -1 | --lowpass-hz is -1
--fade-in-s -1 | --fade-in-s is -1
--scale-rad 0 | --scale-rad is 0
--scale-rad 20 | 20 degrees are 0.35
--seconds 0 | --seconds is 0
"""
ANALYSIS = """
gait nowhere | nowhere
gait both/policy_best both/policy_last --actuator cal.yaml | Two policies are called lstm
servo policy policy --actuator cal.yaml | one recording or policy
gait policy --robots 1 --seconds 1 | No robot walked for 7 s
attractor policy --robots 1 --seconds 1 | there is no orbit
twin walk.csv | No actuator was named
twin walk.csv --actuator papr | papr
twin walk.csv --actuator paper --test-loops a | write loop numbers with commas
twin walk.csv --actuator paper --robots 0 | 0 robots
twin walk.csv walk.csv --actuator paper | One recording at a time
twin walk.csv --actuator paper --imu cal.yaml | cal.yaml
"""
TABLES = {
    "reading": (pupper_sysid, READING),
    "moving": (pupper_sysid, MOVING),
    "training": (pupper_train, TRAINING),
    "evaluation": (pupper_eval, POLICY + EVALUATION),
    "playing": (pupper_play, POLICY + PLAYING),
    "deployment": (pupper_deploy, DEPLOYMENT),
    "analysis": (pupper_analyze, ANALYSIS),
}


def commands(row: str) -> list[list[str]]:
    """Words of the commands that a row stands for."""
    parts = re.findall(r"\[([^]]*)\]|(\"[^\"]*\"|\S+)", row)
    choices = [shlex.split(many or one) for many, one in parts]
    escapes = {r"\x1b": "\x1b", r"\n": "\n", "LONG": "a" * 300}
    spelled = [[re.sub(r"\\(x1b|n)|LONG", lambda m: escapes[m[0]], w) for w in c] for c in choices]
    return [list(words) for words in itertools.product(*spelled)]


@pytest.fixture
def stocked(here) -> Path:
    """A folder with files that some of the commands name."""
    for name, path in (
        ("log.csv", "sweep.csv"), ("walk.csv", "playback.csv"), ("cal.yaml", "calibrated.yaml"),
        ("commands.csv", "walk_commands.csv"), ("policy", "policies/lstm"),
        ("sweep.truth.yaml", "sweep.truth.yaml"),
    ):  # fmt: skip
        (here / name).symlink_to(SAMPLES / path)
    (here / "loop.csv").symlink_to("loop.csv")
    for name in ("policy_best", "policy_last"):
        (here / "both").mkdir(exist_ok=True)
        (here / "both" / name).symlink_to(SAMPLES / "policies/lstm")
    for name in ("taken.yaml", "there.mp4", "mine.mcap"):
        (here / name).write_text("mine")
    (here / "other.yaml").write_text("schema: other\n")
    (here / "robot.xml").write_text("<mujoco>\n  <worldbody/>\n</mujoco>\n")
    row = ",".join(map(str, range(3000)))
    (here / "wide.csv").write_text(f"{row}\n{row}\n")
    text = (SAMPLES / "calibrated.yaml").read_text()
    (here / "wing.yaml").write_text(text.replace("LF_hip:", "LF_wing:"))
    (here / "empty").mkdir()
    save_run(here / "begun", preset("fast", "mlp"))
    save_run(here / "teacher", preset("fast", "mlp", "teacher"))
    save_plan(small_plan(), here / "plan.yaml")
    return here


@pytest.mark.parametrize("table", TABLES)
def test_what_cannot_be_used_is_refused_before_any_work(capsys, stocked, table):
    program, rows = TABLES[table]
    before = {p: p.stat().st_mtime_ns for p in stocked.rglob("*") if not p.is_symlink()}
    problems = []
    for row in rows.strip().splitlines():
        command, _, expected = row.rpartition("|")
        for words in commands(command):
            try:
                said = refused(capsys, program, *words)
            except AssertionError as error:
                said = f"not refused: {error}"
            if expected.strip() not in said or "\x1b" in said:
                problems.append(f"{words}: no {expected.strip()!r} in {said:.300}")
    assert not problems, "\n".join(problems)
    assert before == {p: p.stat().st_mtime_ns for p in stocked.rglob("*") if not p.is_symlink()}


def test_every_stall_torque_that_is_taken_is_one_that_a_calibration_file_holds():
    (check,) = Actuator.model_fields["effort_limit_nm"].metadata
    assert isinstance(check.func, PlausibleRange)
    assert not any(check.func.problem(torque) for torque in STALL_TORQUES_NM)


def test_a_misspelt_command_that_is_near_none_is_answered_without_a_proposal(capsys):
    assert "Did you mean" not in refused(capsys, pupper_sysid, "xyz")


def test_numbers_that_cannot_be_are_refused_in_python_before_they_are_used(tmp_path):
    """As on the command line: 0 is a value, and never stands for the default."""
    load_ = parse_load("pendulum:0.1kg@0.10m")
    save_run(tmp_path / "run", Run(actuator="paper"))

    def on_a_bench(kind: str, **changes):
        return bench_plan("knee", load_, kind=kind, loop_period_s=0.01, start_rad=0.0,
                          margin_rad=1.0, **changes)  # fmt: skip

    nan, inf, nothing = float("nan"), float("inf"), object()  # `nothing` is not touched
    beyond = np.nextafter(LARGEST_AMPLITUDE_RAD, 4.0)
    cases = [
        *((lambda a=a, k=k: plan(k, ["LF_hip"], amplitude_rad=a), "`amplitude_rad`")
          for k in KINDS for a in (0.0, beyond, nan)),
        *((lambda a=a, k=k: on_a_bench(k, amplitude_rad=a), "`amplitude_rad`")
          for k in BENCH_KINDS for a in (0.0, beyond, nan)),
        *((lambda k=k: on_a_bench(k, duration_s=0.0), "duration_s is 0") for k in [*KINDS, BENCH]),
        *((lambda t=t: calibrate(nothing, stall_torque_nm=t), "stall_torque_nm")
          for t in (0.0, 1e308, nan, 101.0)),
        *((lambda t=t: Calibrations(stall_torque_nm=t), "stall_torque_nm") for t in (0.0, 101.0)),
        (lambda: plan_from_recordings([nothing], ["knee"], seconds=1e9), "seconds"),
        *((lambda g=g: load_card("sts3215-bam-m1").pd(p_gain=g), "p_gain")
          for g in (0.0, -1.0, nan, inf, 1e308)),
        *((lambda n=n: Split.by_trials([0], [n]), "loops") for n in (10**30, -(10**30))),
        (lambda: Split.by_time(1.0, inf), "test_after"),
        (lambda: write_report(load(SAMPLES / "sweep.csv"), tmp_path / "page", models=["none"]),
         "`servo` is none"),
        (lambda: parse_address("feetech:/dev/ttyUSB0@0"), "'0' is no baud rate"),
        (lambda: resume_run(tmp_path / "run", 0, None), "iterations"),
        (lambda: resume_run(tmp_path / "run", None, 0.0), "minutes"),
        (lambda: Stack(lowpass_hz=0.0), "lowpass_hz"),
        *((lambda c=c: checked_command(c), "m/s, m/s, rad/s")
          for c in ((20.0, 0.0, 0.0), (0.0, 0.0, 45.0), (nan, 0.0, 0.0))),
        *((lambda x=x: refuse_outside("x", x, 1.0, 2.0), "it must be from 1 to 2.")
          for x in (nan, 0.999, inf)),
    ]  # fmt: skip
    assert_each_refused(cases, lambda call: call())
    assert not (tmp_path / "page").exists()
    for end in (1.0, 2.0):
        refuse_outside("x", end, 1.0, 2.0)
