"""BAM and K-Scale logs: a servo with a pendulum, its gain and voltage, and when it was read."""

import json

import numpy as np
import pytest

from pupper_sysid.sysid.recordings.files import load
from support.real_recordings import real_folder
from support.refusals import assert_each_refused


def log(motor="sts3215", count=50, **changes):
    """A BAM log of a servo that follows a ramp, a row every 5 ms."""
    entries = [
        {"position": 0.01 * k, "speed": 2.0, "load": 3, "input_volts": 7.3, "temp": 28,
         "timestamp": 0.005 * k, "goal_position": 0.01 * k + 0.05, "torque_enable": k < 40}
        for k in range(count)
    ]  # fmt: skip
    return {"mass": 0.2, "length": 0.15, "arm_mass": 0.03, "kp": 32, "vin": 7.4, "motor": motor,
            "trajectory": "sin_sin", "entries": entries} | changes  # fmt: skip


def saved(tmp_path, data):
    path = tmp_path / "2026-01-15.json"
    path.write_text(json.dumps(data))
    return path


def test_the_stamp_is_the_middle_of_the_reads_and_the_goal_is_older(tmp_path):
    """A turn of 5 ms: write w, sleep 1.06 ms, read w, so w = 1.97 ms; a block read is one read.

    An XL330 is read five times, the position first: w = 0.6567 ms, the first 2 w before the middle.
    """
    for motor, reads in (("sts3215", 1), ("xl330", 5)):
        (trial,) = load(saved(tmp_path, log(motor))).trials(motor)
        each = (0.005 - 0.00106) / (1 + reads)
        middle = 0.005 * np.arange(50)
        early = (reads - 1) / 2 * each
        np.testing.assert_allclose(trial.read_time_s, middle - early, atol=1e-12)
        apart = trial.read_time_s - trial.send_time_s
        np.testing.assert_allclose(apart, 0.00106 + each, atol=1e-12)
        assert trial.read_time_doubt_s == pytest.approx(each)


def test_mass_length_gain_and_voltages_come_from_the_file_if_it_has_them(tmp_path):
    (trial,) = load(saved(tmp_path, log())).trials("sts3215")
    assert (trial.load.mass_kg, trial.load.length_m, trial.load.arm_mass_kg) == (0.2, 0.15, 0.03)
    assert trial.load.hanging_rad == 0 and trial.p_gain == 32
    assert trial.servo.model == "sts3215" and trial.servo.supply_voltage_v == 7.4
    assert (trial.voltage_v == 7.3).all()
    assert trial.torque_enabled.sum() == 40 and not trial.torque_enabled[40:].any()
    np.testing.assert_allclose(trial.command_rad - trial.position_rad, 0.05)
    data = log()
    for key in ("mass", "length", "kp", "vin"):
        del data[key]
    for entry in data["entries"]:
        del entry["input_volts"], entry["torque_enable"]
    (trial,) = load(saved(tmp_path, data)).trials("sts3215")
    assert trial.load is None and np.isnan(trial.p_gain) and trial.voltage_v is None
    assert trial.torque_enabled is None


def test_a_log_that_cannot_be_used_is_refused_by_its_place(tmp_path):
    def row(key, value):
        data = log()
        data["entries"][7][key] = value
        return data

    cases = [
        (row("timestamp", None), "entries[7].timestamp is missing"),
        (row("goal_position", "up"), "entries[7].goal_position is up"),
        (row("position", float("inf")), "entries[7].position is inf"),
        (row("goal_position", 10**400), "entries[7].goal_position is 1000"),
        (log(count=0), "entries is empty"), (log(mass="heavy"), "mass is heavy"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda data: load(saved(tmp_path, data)))


def test_the_xl330s_sixteen_logs_are_read_as_they_are():
    gains, dropped = set(), 0
    for path in sorted(real_folder("bam_xl330").glob("*.json")):
        (trial,) = load(path).trials("xl330")
        gains.add(trial.p_gain)
        assert (trial.load.mass_kg, trial.load.length_m) == (0.49, 0.1)
        assert (np.diff(trial.send_time_s) > 0).all()
        dropped += trial.torque_enabled is not None
        # five reads of one register make up a turn whose torque is off: the model of a turn holds
        if trial.torque_enabled is not None:
            loop = np.median(np.diff(trial.read_time_s)[~trial.torque_enabled[1:]])
            first = np.median(trial.read_time_s - trial.send_time_s) - 0.00106
            assert loop == pytest.approx(5 * first, rel=0.03)
    assert gains == {100, 200, 400, 800} and dropped == 4
