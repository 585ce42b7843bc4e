"""A log of another project, an SO-101 arm with STS3215 servos, becomes a recording."""

from __future__ import annotations

import ast

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from support.real_recordings import real_recording

JOINTS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll")  # the sixth, Jaw, is no angle


@pytest.fixture(scope="module")
def arm() -> Recording:
    """The arm's frequency sweep: one time stamp [µs] per turn, a list of six angles per cell."""
    times, angles = {}, {}
    for name in ("control", "state_motor"):
        table = pd.read_csv(real_recording(f"sage_so101/frequency_sweep/{name}.csv"))
        times[name] = 1e-6 * table["timestamp"].to_numpy()
        cells = np.array([ast.literal_eval(cell) for cell in table["positions"]])
        angles[name] = dict(zip(JOINTS, cells.T, strict=False))
    return Recording.from_arrays(
        times["control"], angles["control"], angles["state_motor"],
        read_time_s=times["state_motor"], name="so101",
    )  # fmt: skip


def test_every_turn_of_an_arms_log_is_kept_at_its_rate(arm):
    assert set(arm.joints) == set(JOINTS)
    assert {len(trial.send_time_s) for joint in JOINTS for trial in arm.trials(joint)} == {6000}
    assert 1 / arm.loop_period_s == pytest.approx(49.85, abs=0.01)


def test_an_arms_readings_are_whole_counts_apart_4096_per_turn(arm):
    for joint in JOINTS:
        (trial,) = arm.trials(joint)
        counts = (trial.position_rad - trial.position_rad[0]) * 4096 / (2 * np.pi)
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-3)


def test_an_arms_recording_is_saved_and_read_back(arm, tmp_path):
    arm.save(tmp_path / "arm.csv")
    again = load(tmp_path / "arm.csv")
    for joint in JOINTS:
        (wanted,), (found,) = arm.trials(joint), again.trials(joint)
        np.testing.assert_allclose(found.position_rad, wanted.position_rad, rtol=1e-12)
