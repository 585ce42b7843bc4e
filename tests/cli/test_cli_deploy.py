"""pupper-deploy and pupper-analyze as a user meets them, with the shipped policy."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from pupper_sysid.cli.programs import pupper_analyze, pupper_deploy
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.data import SAMPLES
from pupper_sysid.policies.deploy.walk_log import read_walk
from pupper_sysid.sysid.recordings.files import load
from support.command_line import json_of, ran, refused, run_program
from support.json_keys import DOCUMENTED, key_line
from support.undrawn import stand_soon

POLICY = SAMPLES / "policies/lstm"
CALIBRATION = SAMPLES / "calibrated.yaml"


@pytest.fixture(autouse=True)
def standing(monkeypatch):
    stand_soon(monkeypatch)


def deploy(capsys, *arguments) -> dict:
    found = json_of(capsys, POLICY, "--actuator", CALIBRATION, *arguments, program=pupper_deploy)
    return found


def test_the_shipped_policy_walks_on_the_emulated_robot_and_its_log_repeats(capsys, here):
    found = deploy(capsys, "--seconds", 4, "--name", "walk", "--command", 0.15, 0, 0)
    assert found["stop_reason"] == "time is up" and found["fell"] is False
    assert found["rate_hz"] == pytest.approx(50, rel=0.01) and found["deadline_misses"] == 0
    assert found["mae_vx_m_s"] < 0.06 and found["mae_vy_m_s"] < 0.035
    assert found["mae_yaw_rad_s"] < 0.15 and set(found["step_ms"]) == {"p50", "p99", "max"}
    log = Path(found["log"])
    out, _ = ran(capsys, POLICY, "--replay", log, "--actuator", CALIBRATION, program=pupper_deploy)
    assert "200 ticks repeated" in out
    assert len(read_walk(log).senses) == 200
    # the servos' side of it is a recording like any other
    recording = load(log.with_name("recording.csv"))
    assert len(recording.joints) == 12 and recording.loop_period_s == pytest.approx(0.02, abs=1e-3)


def test_the_emulated_robot_has_the_servos_of_the_calibration_and_commands_are_clipped(
    capsys, here
):
    moved = {}
    for actuator in (CALIBRATION, "ideal"):
        out, err = ran(
            capsys, POLICY, "--actuator", actuator, "--seconds", 0.4, "--name",
            Path(actuator).stem, "--json", "--command", 0.4, 0, 0, program=pupper_deploy
        )  # fmt: skip
        assert f"has the servos of {actuator}" in " ".join(err.split())
        assert "0.4 0 0 was clipped to 0.2 0 0" in " ".join(err.split())
        found = json.loads(out)
        assert found["commands"]["forward_m_s"] == [-0.2, 0.2]
        moved[actuator] = found["mean_motion"]
        senses = read_walk(Path(found["log"])).senses
        np.testing.assert_array_equal(senses[-1].command, [0.2, 0, 0])
    assert moved[CALIBRATION] != moved["ideal"]


def test_a_script_is_followed(capsys, here):
    Path("s.csv").write_text("seconds,forward_m_s,left_m_s,turn_rad_s\n0.4,0.1,0,0\n0.2,0,0,0\n")
    found = deploy(capsys, "--script", "s.csv", "--name", "walk")
    assert found["stop_reason"] == "end of commands"
    assert found["seconds"] == pytest.approx(0.6, abs=0.05)


def test_another_rate_is_said_to_change_the_policys_time(capsys, here):
    _, err = ran(
        capsys, POLICY, "--actuator", CALIBRATION, "--rate", 25, "--seconds", 0.1,
        "--name", "slow", program=pupper_deploy
    )  # fmt: skip
    assert "0.50 times as fast" in err


@pytest.mark.slow
def test_the_published_observer_is_said_to_swing_otherwise_than_the_actuator(capsys, here):
    _, err = ran(
        capsys, POLICY, "--actuator", CALIBRATION, "--observer",
        "published-pd", "--seconds", 0.1, "--name", "paper", program=pupper_deploy
    )  # fmt: skip
    assert "warning" in err and "Hz" in err
    # a row per kind of joint and whole hertz, rounded; the published resonance is in it
    assert "hip 3.00 2.80 0.98 -276.31" in err and err.count("thigh ") == 6


@pytest.fixture
def late(here) -> Path:
    """The calibration of a robot whose servos answer 60 ms later."""
    found = yaml.safe_load(CALIBRATION.read_text())
    for joint in found["joints"].values():
        for end in ("value", "low", "high"):
            joint["actuator"]["delay_s"][end] += 0.06
        for end in ("delay_steps_min", "delay_steps_max"):
            joint["actuator"][end] += 30
    Path("late.yaml").write_text(yaml.safe_dump(found))
    return Path("late.yaml")


@pytest.mark.slow
def test_the_servos_at_hand_are_compared_with_those_of_the_training(capsys, here, late):
    arguments = (POLICY, "--seconds", 0.1, "--name", "walk", "--force", "--json")
    code, out, err = run_program(capsys, pupper_deploy, *arguments, "--actuator", CALIBRATION)
    found = json.loads(out)
    assert code == 0 and found["servo_match"]["outside"] == []
    assert "within the ranges that the policy was trained for" in err
    out, err = ran(capsys, *arguments, "--actuator", late, program=pupper_deploy)
    assert "60 ms later than the trained actuator" in err
    assert "late.yaml is not what the policy was trained for" in err
    assert re.search(
        r"Dead time \(\w+\): [\d.]+ ms, [5-6]\d(\.\d)? ms more than in the training", err
    )
    found = json.loads(out)
    worst = found["servo_match"]["outside"]
    assert {one["quantity"] for one in worst} == {"dead time"} and len(worst) == 12
    assert all(50 < one["beyond"] <= 61 and one["unit"] == "ms" for one in worst)
    assert read_walk(Path(found["log"])).header["servo_match"] == found["servo_match"]
    out, err = ran(capsys, *arguments, program=pupper_deploy)
    assert json.loads(out)["servo_match"] is None
    assert "warning" not in err and "the servos' own readings" in err


def test_a_calibration_that_only_has_the_name_of_the_trained_one_is_told(capsys, late):
    alone = Path("alone")
    shutil.copytree(POLICY, alone)
    late.rename("calibrated.yaml")
    run_file = alone / "run.yaml"
    run_file.write_text(run_file.read_text().replace("data/samples/calibrated", "calibrated"))
    _, err = ran(
        capsys, alone, "--stack", "mlp-observer", "--seconds", 0.1,
        "--name", "swapped", program=pupper_deploy
    )  # fmt: skip
    assert "calibrated.yaml is not the file with which alone was trained" in err
    assert "was not compared with it" in err and "moves like the trained" not in err


# ------------------------------------------------------------------------------ pupper-analyze


def analyze(capsys, what, *arguments) -> dict:
    found = json_of(
        capsys, what, POLICY, "--actuator", CALIBRATION,
        "--robots", 2, "--seconds", 8, *arguments, program=pupper_analyze
    )  # fmt: skip
    assert Path(found["picture"]).stat().st_size > 5_000
    return found


def test_the_gait_of_the_shipped_policy_is_a_trot_and_its_picture_is_not_written_over(capsys, here):
    gait = analyze(capsys, "gait", "--robots", 1)["gaits"]["lstm"]
    assert gait["frequency_hz"]["value"] == pytest.approx(3.0, abs=0.15)
    assert gait["diagonal"]["value"] > 0.6 and gait["rhythmic"] == 1.0
    again = refused(capsys, pupper_analyze, "gait", POLICY, "--actuator", CALIBRATION)
    assert "exists already" in again


@pytest.mark.slow
def test_frozen_senses_leave_the_rhythm_and_a_frozen_last_action_stops_it(
    capsys, here, monkeypatch
):
    monkeypatch.setattr("pupper_sysid.policies.analysis.autonomy._PUSHES", 1)
    monkeypatch.setattr("pupper_sysid.policies.analysis.autonomy.RATES_HZ", (50.0,))
    found = analyze(capsys, "autonomy")["autonomy"]["lstm"]
    rows = {r["test"]: r for r in found["frozen"]}
    assert rows["nothing frozen"]["share"] == pytest.approx(1.0, abs=0.1)
    assert rows["senses frozen, its own last action"]["share"] > 0.5
    assert rows["senses and last action frozen"]["share"] < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("what", "count"), [("terrain", 7), ("compliance", 6)])
def test_where_it_walks_is_said_per_ground_and_direction(capsys, here, what, count):
    rows = analyze(capsys, what, "--seconds", 3, "--robots", 1)[what]["lstm"]
    assert len(rows) == count and all(0 <= r["survival"] <= 1 for r in rows)


# ----- `pupper-analyze twin` as a user meets it

WALK, CALIBRATION_TWIN = SAMPLES / "playback.csv", SAMPLES / "calibrated.yaml"


@pytest.fixture
def imu(tmp_path) -> Path:
    path = tmp_path / "imu.csv"
    rows = (f"{0.02 * k:.2f},{0.1 * (k % 5):.1f},0.2,0.{k % 3}" for k in range(400))
    path.write_text("timestamp,gx,gy,gz\n" + "\n".join(rows) + "\n")
    return path


@pytest.fixture
def walk(tmp_path) -> Path:
    """Eight seconds of all joints, read two rows late: a rhythm needs seven."""
    rows = np.arange(200)
    swing = 0.15 * np.sin(0.5 * rows)[:, None] * np.tile([0.3, 1, -1], 4)
    command = swing + [DEFAULT_POSE[joint] for joint in JOINT_NAMES]
    columns: dict = {"time_s": 0.04 * rows, "loop": 0}
    for n, joint in enumerate(JOINT_NAMES):
        columns[f"{joint}_command_rad"] = command[:, n]
        columns[f"{joint}_position_rad"] = command[np.maximum(rows - 2, 0), n]
    path = tmp_path / "walk.csv"
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def test_the_twin_of_a_walk_is_drawn_and_has_the_documented_keys(capsys, walk, imu, here):
    given = (
        "twin", walk, "--actuator", CALIBRATION_TWIN, "--robots", 1, "--threads", 1, "--imu", imu,
    )  # fmt: skip
    found = json_of(capsys, *given, program=pupper_analyze)
    assert key_line(found) == DOCUMENTED["pupper-analyze twin"]
    model = found["models"]["calibrated.yaml"]
    still = sum(found["persistence_rmse_rad"].values()) / 12
    assert 0 < model["air"]["rmse_rad"]["value"] < still
    assert model["ground"]["copies"] == 1 and model["ground"]["gyro"]["peak_hz"][1] > 0
    assert Path(found["picture"]).stat().st_size > 20_000
