"""The twin test on readings of the simulated robot itself, in the air and on the ground."""

from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.data import SAMPLES
from pupper_sysid.policies.twin.drawing import actuator_of, robot_for, spread_over, stronger
from pupper_sysid.policies.twin.playing import _load_share
from pupper_sysid.policies.twin.twin import read_imu, spectrum, twin, twin_figure
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sim.robot.replay import mini_pupper_robot, replay, robot_of
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sysid.recordings.recording import Recording
from support.refusals import assert_each_refused

CALIBRATION = str(SAMPLES / "calibrated.yaml")
LOOP_STEPS = 20  # a command every 40 ms
ROWS = 75
FOUR_LEGS = """
<mujoco><worldbody>
  <body name="trunk" pos="0 0 0.2">{root}
    <geom type="box" size="0.08 0.05 0.02" mass="0.4"/>
    {legs}
  </body>
</worldbody></mujoco>
"""
LEG = """<body pos="{x} {y} 0"><joint name="{name}" axis="0 1 0" range="-1 1"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.08" size="0.008" mass="0.03"/></body>"""


def trot(rows: int = ROWS) -> np.ndarray:
    """Commands of a trot on the spot, calves as their servos have them."""
    phase = 2 * np.pi * 2.0 * LOOP_STEPS * TIME_STEP_S * np.arange(rows)
    angles = Trot(frequency_hz=2.0, lift_m=0.015).joints(phase, np.tile([0.1, 0, 0], (rows, 1)))
    angles[:, 2::3] += angles[:, 1::3] - mini_pupper_robot().rest_rad[1]
    return angles


@pytest.fixture(scope="module")
def played() -> dict[str, Recording]:
    """Recordings of the simulated robot with the sample's servos, live readings, zeros of 0."""
    robot, commands = mini_pupper_robot(), trot()
    blank = recording(commands, commands)
    values = actuator_of(CALIBRATION, robot, blank).values
    servos = {name: value[None] for name, value in values.items()}
    held = np.repeat(commands, LOOP_STEPS, axis=0)
    every = np.concatenate([commands[:1], held])[None]
    one = np.ones(1)
    made = {}
    for place in ("air", "ground"):
        moved = replay(robot, place == "air", servos, every, np.zeros(1, int), commands,
                       0.8 * one, 0.05 * one, threads=1)  # fmt: skip
        assert not np.isfinite(moved.fell_s).any()
        # read just before the next command
        made[place] = recording(commands, moved.servo_rad[0, LOOP_STEPS - 1 :: LOOP_STEPS])
    return made


def recording(command: np.ndarray, position: np.ndarray) -> Recording:
    send = LOOP_STEPS * TIME_STEP_S * np.arange(len(command))
    return Recording.from_arrays(
        send, dict(zip(JOINT_NAMES, command.T, strict=True)),
        dict(zip(JOINT_NAMES, position[: len(command)].T, strict=True)),
        read_time_s=send + (LOOP_STEPS - 1) * TIME_STEP_S,
        metadata={"start_pose_rad": dict(zip(JOINT_NAMES, command[0].tolist(), strict=True))},
        name="played",
    )  # fmt: skip


def compared(walk: Recording, *names: str, **options):
    robot = robot_for(walk)
    actuators = {name: actuator_of(name, robot, walk) for name in names}
    return twin(walk, actuators, robot, copies=2, threads=1, **options)


@pytest.mark.slow
def test_a_robot_in_the_air_is_predicted_exactly_there_and_found_there(played):
    found = compared(played["air"], CALIBRATION)
    model = found.models[CALIBRATION]
    assert model.air.rmse_rad.value < 5e-4  # between physics steps positions are interpolated
    assert model.ground is not None and model.ground.rmse_rad.value > 10 * model.air.rmse_rad.value
    assert found.verdict == "air" and found.judge == CALIBRATION
    assert "in the air" in found.verdict_in_words


def test_a_robot_on_the_ground_is_predicted_best_there_and_found_there(played):
    found = compared(played["ground"], CALIBRATION, "release")
    model = found.models[CALIBRATION]
    assert model.ground is not None and model.evidence is not None
    # its friction and payload are not those of the copies
    assert model.ground.rmse_rad.value < 0.6 * model.air.rmse_rad.value
    assert found.verdict == "ground"
    motion = model.evidence.motion[0]
    assert motion is not None and motion.share.low > 0.5
    assert model.ground.joints["LF_hip"].mae_rad <= model.ground.joints["LF_hip"].rmse_rad
    assert len(twin_figure(found).axes) == 13
    # published servos are not those that moved it
    assert found.best == CALIBRATION
    assert found.models["release"].best_rad > 2 * model.best_rad
    assert any("ideal feedback" in note for note in found.notes)


def test_a_calibration_of_the_recording_itself_does_not_judge_it(played, tmp_path):
    walk = played["ground"]
    own = load_calibration(CALIBRATION)
    own = own.model_copy(
        update={"inputs": (own.inputs[0].model_copy(update={"sha256": walk.sha256}),)}
    )
    path = tmp_path / "own.yaml"
    own.save(path)
    found = compared(walk, str(path))
    assert found.judge is None and found.verdict == "cannot tell"
    assert "Nothing here says" in found.verdict_in_words


def test_loops_that_cannot_be_scored_and_walks_beyond_the_memory_are_refused(played, monkeypatch):
    cases = [
        ({"test_loops": [3]}, "has no loop 3: its loops are 0"),
        ({"test_loops": [0]}, "one must be"),
    ]
    assert_each_refused(cases, lambda options: compared(played["air"], "ideal", **options))
    monkeypatch.setattr("pupper_sysid.policies.twin.playing._MOST_BYTES", 1000)
    with pytest.raises(InputError, match="1 robots over 3 s do not fit the memory"):
        compared(played["air"], "ideal")


def test_joints_that_were_not_calibrated_get_the_nearest_ones_numbers():
    one = load_calibration(CALIBRATION)
    first = one.model_copy(update={"joints": {"LF_thigh": one.joint("LF_thigh")}})
    spread, fallbacks = spread_over(first, ("LF_thigh", "RB_thigh"))
    assert fallbacks == {"RB_thigh": "LF_thigh"}
    assert spread.joint("RB_thigh") == one.joint("LF_thigh")
    # servos of four times the torque move alike in free air
    values = actuator_of("paper", mini_pupper_robot(), recording(trot(9), trot(9))).values
    strong = stronger(values, 4.0)
    for name in ("stiffness", "damping", "friction_loss", "armature", "effort_limit"):
        assert strong[name] == pytest.approx(4 * values[name])
    assert strong["dead_time_s"] == pytest.approx(values["dead_time_s"])


def test_another_robot_stands_on_the_ground_if_nothing_fixes_it(tmp_path):
    corners = {f"L{k}_leg": (0.07 * (-1) ** k, 0.05 * (-1) ** (k // 2)) for k in range(4)}
    legs = "".join(LEG.format(name=n, x=x, y=y) for n, (x, y) in corners.items())
    rows = np.arange(80)
    swing = 0.2 * np.sin(0.3 * rows)
    send = LOOP_STEPS * TIME_STEP_S * rows
    walk = Recording.from_arrays(
        send, dict.fromkeys(corners, swing), dict.fromkeys(corners, np.roll(swing, 2)), name="own"
    )
    for root, grounds in (("<freejoint/>", 1), ("", 0)):
        path = tmp_path / f"robot{grounds}.xml"
        path.write_text(FOUR_LEGS.format(root=root, legs=legs))
        robot = robot_of(path, walk.joints)
        assert robot.free == bool(grounds) and robot.joints == tuple(corners)
        actuators = {"ideal": actuator_of("ideal", robot, walk)}
        model = twin(walk, actuators, robot, copies=2, threads=1).models["ideal"]
        assert (model.ground is not None) == bool(grounds)
        assert model.ground is None or model.ground.upright == 2
    with pytest.raises(InputError, match="none of the Mini Pupper's"):
        robot_for(walk)


# ----- shares of the load, and spectra of gyros, worked out by hand

SAG = 1e-3 * np.array([3.0, 5, -12, -2, 7, -18, 9, 10, -8, -4, 4, -6])


def offsets(in_air: np.ndarray) -> dict[str, tuple[float, float]]:
    return dict(zip(JOINT_NAMES, zip(in_air, in_air - SAG, strict=True), strict=True))


def test_zeros_common_to_a_kind_of_joints_are_no_load_and_few_joints_tell_nothing_of_it():
    common = np.sign(SAG) * np.tile([0.02, 0.01, 0.03], 4)
    for of_load in (0.0, 0.7):
        share = _load_share(offsets(common + of_load * SAG))
        assert share is not None and share.value == pytest.approx(of_load, abs=1e-9)
    assert _load_share({"LF_hip": (0.01, 0.0), "LF_thigh": (0.02, 0.0)}) is None


def test_the_interval_of_a_load_is_students():
    noise = np.random.default_rng(1).normal(0, 0.003, 12)
    share = _load_share(offsets(SAG + noise))
    assert share is not None and share.low < 1.0 < share.high
    # 12 joints less a share and three kinds; t of 8 degrees of freedom at 95 %: 1.860
    kinds = [np.where(np.arange(12) % 3 == k, np.sign(SAG), 0.0) for k in range(3)]
    design = np.stack([SAG, *kinds], axis=1)
    left = (SAG + noise) - design @ np.linalg.pinv(design) @ (SAG + noise)
    error = np.sqrt(np.linalg.inv(design.T @ design)[0, 0] * left @ left / 8)
    assert (share.high - share.low) / 2 == pytest.approx(1.860 * error, rel=1e-3)


def test_a_gyros_peak_is_that_of_its_sine_although_rows_are_uneven():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.015, 0.025, 600))
    time -= time[0]
    rate = np.zeros((600, 3))
    rate[:, 2] = 1.2 * np.sin(2 * np.pi * 3.07 * time) + rng.normal(0, 0.6, 600)
    found = spectrum(time, [rate])
    assert found is not None
    assert found.peak_hz[2] == pytest.approx(3.07, abs=0.02) and np.isnan(found.peak_hz[0])
    assert found.peak_share[2] == pytest.approx(0.72 / (0.72 + 0.36), abs=0.04)
    assert found.deviation_rad_s[2] == pytest.approx(np.sqrt(0.72 + 0.36), rel=0.05)
    assert spectrum(time[:300], [rate[:300]]) is None  # less than seven seconds


def log(path: Path, rows: int, head: str = "timestamp,gx,gy,gz", step: float = 0.02) -> Path:
    lines = [f"{step * k:.3f},0.1,{k % 7},0" for k in range(rows)]
    path.write_text("\n".join([head, *lines]) + "\n")
    return path


def test_an_imu_log_is_read_and_held_to_its_columns_length_and_times(tmp_path):
    found = read_imu(log(tmp_path / "a.csv", 400))
    assert found.time_s[-1] == pytest.approx(7.98)
    assert found.rate_rad_s[3].tolist() == [0.1, 3.0, 0.0]
    assert np.isnan(found.acceleration_m_s2).all() and found.acceleration_m_s2.shape == (400, 3)
    cases = [
        ((400, "timestamp,gx,gy,roll", 0.02), "has no column gz"),
        ((300, "timestamp,gx,gy,gz", 0.02), "shorter than 7 s"),
        ((400, "timestamp,gx,gy,gz", -0.02), "do not increase"),
    ]
    path = tmp_path / "b.csv"
    assert_each_refused(cases, lambda case: read_imu(log(path, *case)), names=path)
