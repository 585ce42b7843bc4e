"""Shares of the load, and spectra of gyros, worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.policies.twin.gyro import read_imu, spectrum
from pupper_sysid.policies.twin.playing import _load_share
from support.refusals import assert_each_refused

SAG = 1e-3 * np.array([3.0, 5, -12, -2, 7, -18, 9, 10, -8, -4, 4, -6])


def offsets(in_air: np.ndarray) -> dict[str, tuple[float, float]]:
    return dict(zip(JOINT_NAMES, zip(in_air, in_air - SAG, strict=True), strict=True))


def test_zeros_common_to_a_kind_of_joints_are_no_load():
    common = np.sign(SAG) * np.tile([0.02, 0.01, 0.03], 4)
    share = _load_share(offsets(common))
    assert share is not None and share.value == pytest.approx(0.0, abs=1e-9)
    share = _load_share(offsets(common + 0.7 * SAG))
    assert share is not None and share.value == pytest.approx(0.7)


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


def test_few_joints_tell_nothing_of_a_load():
    assert _load_share({"LF_hip": (0.01, 0.0), "LF_thigh": (0.02, 0.0)}) is None


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
