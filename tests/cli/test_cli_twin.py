"""`pupper-analyze twin` as a user meets it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.cli.programs import pupper_analyze
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from support.command_line import run_program
from support.json_keys import DOCUMENTED, key_line
from support.package import ROOT

SAMPLES = ROOT / "data/samples"
WALK, CALIBRATION = SAMPLES / "playback.csv", SAMPLES / "calibrated.yaml"


@pytest.fixture
def imu(tmp_path) -> Path:
    path = tmp_path / "imu.csv"
    rows = (f"{0.02 * k:.2f},{0.1 * (k % 5):.1f},0.2,0.{k % 3}" for k in range(400))
    path.write_text("timestamp,gx,gy,gz\n" + "\n".join(rows) + "\n")
    return path


@pytest.fixture
def walk(tmp_path) -> Path:
    """Eight seconds of all joints, read two rows late."""
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


def test_the_twin_of_a_walk_is_drawn_and_has_the_documented_keys(
    capsys, tmp_path, monkeypatch, walk, imu
):
    monkeypatch.chdir(tmp_path)
    given = ("twin", walk, "--actuator", CALIBRATION, "--robots", 1, "--threads", 1, "--imu", imu)
    code, out, err = run_program(capsys, pupper_analyze, *given, "--json")
    assert code == 0, err
    found = json.loads(out)
    assert key_line(found) == DOCUMENTED["pupper-analyze twin"]
    model = found["models"]["calibrated.yaml"]
    still = sum(found["persistence_rmse_rad"].values()) / 12
    assert 0 < model["air"]["rmse_rad"]["value"] < still
    assert model["ground"]["copies"] == 1 and model["ground"]["gyro"]["peak_hz"][1] > 0
    assert Path(found["picture"]).stat().st_size > 20_000
