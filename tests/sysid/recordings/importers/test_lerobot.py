"""LeRobot datasets: episodes, nominal times, and scales from the step of the readings."""

import json

import numpy as np
import pytest

from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from support.real_recordings import real_folder
from support.refusals import assert_each_refused

parquet = pytest.importorskip("pyarrow.parquet")
pyarrow = pytest.importorskip("pyarrow")

NAMES = ["shoulder_pan.pos", "gripper.pos"]
COUNTS = (2000, 1200)  # of each joint's calibrated range


def dataset(tmp_path, version="v3.0", episodes=2, count=60, names=NAMES, **info):
    """Joints that follow the action by 3 frames; values are whole counts of the range."""
    parts = []
    for episode in range(episodes):
        wave = 0.4 * np.sin(0.2 * np.arange(count + 3))
        frames = np.arange(count)
        shares = [
            200 * (np.round((w + 0.5) * c) / c) - 100
            if j == 0
            else 100 * np.round((w + 0.5) * c) / c
            for j, (w, c) in enumerate(zip((wave, wave), COUNTS, strict=True))
        ]
        parts.append(
            pyarrow.table(
                {
                    "action": [list(row) for row in np.array(shares, np.float32)[:, 3:].T],
                    "observation.state": [
                        list(row) for row in np.array(shares, np.float32)[:, :count].T
                    ],
                    "timestamp": (frames / 30).astype(np.float32),
                    "frame_index": frames,
                    "episode_index": np.full(count, episode),
                }
            )
        )
    features = {
        key: {"dtype": "float32", "names": names, "shape": [2]}
        for key in ("action", "observation.state")
    }
    (tmp_path / "meta").mkdir()
    text = {"codebase_version": version, "robot_type": "so101_follower", "fps": 30,
            "features": features} | info  # fmt: skip
    (tmp_path / "meta" / "info.json").write_text(json.dumps(text))
    folder = tmp_path / "data" / "chunk-000"
    folder.mkdir(parents=True)
    if version == "v3.0":
        parquet.write_table(pyarrow.concat_tables(parts), folder / "file-000.parquet")
    else:
        for k, part in enumerate(parts):
            parquet.write_table(part, folder / f"episode_{k:06d}.parquet")
    return tmp_path


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_an_episode_is_a_trial_and_names_come_from_info_json(tmp_path, version):
    names = {"motors": NAMES} if version == "v2.1" else NAMES
    recording = load(dataset(tmp_path, version, names=names))
    assert set(recording.joints) == {"shoulder_pan", "gripper"}
    assert [len(t.send_time_s) for t in recording.trials("gripper")] == [60, 60]
    assert recording.metadata["robot_type"] == "so101_follower"


def test_a_step_of_the_readings_is_one_count_of_4096_a_turn(tmp_path):
    recording = load(dataset(tmp_path))
    for joint, counts, span in (("shoulder_pan", 2000, 200), ("gripper", 1200, 100)):
        trial = recording.trials(joint)[0]
        widest = 2 * np.pi * counts / 4096  # rad, of the calibrated range
        amplitude = np.ptp(trial.position_rad) / (0.8 * widest)
        assert amplitude == pytest.approx(1, abs=2e-3), span


def test_times_are_nominal_and_the_lag_is_in_doubt_by_half_a_frame(tmp_path):
    recording = load(dataset(tmp_path))
    first, second = recording.trials("shoulder_pan")
    np.testing.assert_allclose(first.read_time_s, np.arange(60) / 30)
    np.testing.assert_allclose(first.send_time_s - first.read_time_s, 1 / 60)
    assert first.read_time_doubt_s == pytest.approx(1 / 60)
    assert second.read_time_s[0] > first.read_time_s[-1]
    assert any("frame numbers over 30 Hz" in text for text in recording.warnings)


def test_a_given_unit_overrides_the_scale(tmp_path):
    log = dataset(tmp_path)
    trial = load(log, LogOptions(unit="deg")).trials("gripper")[0]
    assert np.ptp(trial.position_rad) == pytest.approx(np.deg2rad(80), rel=2e-3)


def test_a_dataset_that_is_not_as_described_or_without_its_data_is_refused(tmp_path):
    cases = [
        ({"fps": 0}, "fps is 0"), ({"features": {}}, "action is missing"),
        ({"features": None}, "features is missing"),
        ({"names": ["a.pos"]}, "action has 2 values and its list of names in meta/info.json has 1"),
    ]  # fmt: skip
    folders = (tmp_path / str(k) for k in range(len(cases)))

    def read(changes):
        log = next(folders)
        log.mkdir()
        load(dataset(log, **changes))

    assert_each_refused(cases, read)
    (tmp_path / "torn").mkdir()
    log = dataset(tmp_path / "torn")
    file = log / "data/chunk-000/file-000.parquet"
    file.write_bytes(b"PAR1 nothing")
    assert_each_refused([(log, "is not a parquet file, or is cut off")], load)
    file.unlink()
    assert_each_refused([(log, "without data")], load)


def test_the_so101s_four_episodes_are_read():
    recording = load(real_folder("lerobot_so101"))
    assert len(recording.joints) == 6 and len(recording.table) == 6 * 1492
    for joint in recording.joints:
        trials = recording.trials(joint)
        assert len(trials) == 4 and trials[0].servo.model == "STS3215"
        counts = np.diff(trials[0].position_rad) * 4096 / (2 * np.pi)
        np.testing.assert_allclose(counts, np.round(counts), atol=0.05)
