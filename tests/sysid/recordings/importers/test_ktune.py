"""ktune logs: degrees, one time stamp per row."""

import json

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.recordings.files import load
from support.real_recordings import real_folder


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


def test_a_gain_in_words_and_a_torn_row_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"config.kp is high"):
        load(log(tmp_path, kp="high"))
    path = log(tmp_path)
    path.write_text(path.read_text()[:-50])
    with pytest.raises(InputError, match="is not JSON"):
        load(path)


def test_json_of_another_layout_names_what_is_missing(tmp_path):
    path = tmp_path / "other.json"
    path.write_text('{"samples": []}')
    with pytest.raises(InputError, match=r"has samples. BAM or K-Scale: entries missing; ktune"):
        load(path)


def test_five_joints_of_a_leg_are_read():
    found = {load(path).joints[0] for path in real_folder("ktune_robstride").glob("*.json")}
    assert found == {f"actuator_{k}" for k in range(41, 46)}
