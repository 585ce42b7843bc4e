"""ktune logs: degrees, one time stamp per row."""

import json

import numpy as np
import pytest

from pupper_sysid.sysid.recordings.files import load
from support.real_recordings import real_folder
from support.refusals import assert_each_refused


def log(tmp_path, **config):
    rows = [
        {"time_since_start": 0.01 * k, "position": 0.5 * k - 1, "commanded_position": 0.5 * k,
         "torque": 0.1, "freq": 0.2 + 0.01 * k}
        for k in range(40)
    ]  # fmt: skip
    path = tmp_path / "real_41.json"
    path.write_text(json.dumps({"config": {"actuator_id": 41, "kp": 150.0} | config, "data": rows}))
    return path


def test_degrees_become_radians_and_gains_are_kept(tmp_path):
    (trial,) = load(log(tmp_path, kd=8.0)).trials("actuator_41")
    np.testing.assert_allclose(trial.command_rad, np.deg2rad(0.5 * np.arange(40)))
    np.testing.assert_allclose(trial.position_rad, trial.command_rad - np.deg2rad(1))
    assert trial.p_gain == 150 and trial.servo.d_gain == 8
    assert trial.read_time_doubt_s == pytest.approx(0.005)


def test_what_is_no_ktune_log_is_refused(tmp_path):
    (tmp_path / "other.json").write_text('{"samples": []}')
    cases = [("other.json", "has samples. BAM or K-Scale: entries missing; ktune")]
    for name, text, says in (
        ("torn.json", log(tmp_path).read_text()[:-50], "is not JSON"),
        ("high.json", log(tmp_path, kp="high").read_text(), "config.kp is high"),
    ):
        (tmp_path / name).write_text(text)
        cases.append((name, says))
    assert_each_refused(cases, lambda name: load(tmp_path / name))


def test_five_joints_of_a_leg_are_read():
    found = {load(path).joints[0] for path in real_folder("ktune_robstride").glob("*.json")}
    assert found == {f"actuator_{k}" for k in range(41, 46)}
