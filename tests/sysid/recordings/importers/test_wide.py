"""Tables with any joint names: CSV, parquet, NumPy archives and frames in memory."""

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import DEFAULT_POSE
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.importers.options import LogOptions, merged, read_mapping
from pupper_sysid.sysid.recordings.importers.recognise import logs_in
from pupper_sysid.sysid.recordings.recording import Recording
from support.package import ROOT
from support.refusals import assert_each_refused

TIME = 0.02 * np.arange(60)
COMMAND = {"knee": 0.3 * np.sin(TIME), "ankle": 0.2 * np.cos(TIME)}
POSITION = {"knee": 0.3 * np.sin(TIME - 0.04), "ankle": 0.2 * np.cos(TIME - 0.04)}


def table(command, position, time="time", scale=1.0):
    """Columns of two joints, named by templates, in rad times `scale`."""
    columns = {time: TIME}
    for joint in COMMAND:
        columns[command.format(joint=joint)] = scale * COMMAND[joint]
        columns[position.format(joint=joint)] = scale * POSITION[joint]
    return pd.DataFrame(columns)


def agrees(recording, joints=("knee", "ankle")):
    """Whether a recording holds the two joints' commands and positions."""
    assert set(recording.joints) == set(joints)
    for theirs, ours in zip(COMMAND, joints, strict=True):
        (trial,) = recording.trials(ours)
        np.testing.assert_allclose(trial.command_rad, COMMAND[theirs], atol=1e-9)
        np.testing.assert_allclose(trial.position_rad, POSITION[theirs], atol=1e-9)
        np.testing.assert_allclose(np.diff(trial.send_time_s), 0.02)


def test_a_joint_is_what_stands_beside_the_words_and_an_ending_names_the_unit():
    for command, position, scale in (
        ("{joint}_command", "{joint}_position", 1.0),
        ("{joint}_command_rad", "{joint}_position_rad", 1.0),
        ("{joint}_command_deg", "{joint}_position_deg", 180 / np.pi),
        ("action.{joint}", "observation.state.{joint}", 1.0),
        ("action.{joint}.pos", "observation.state.{joint}.pos", 1.0),
        ("{joint}.goal", "{joint}.pos", 1.0),
        ("cmd_{joint}", "pos_{joint}", 1.0),
        ("target[{joint}]", "actual[{joint}]", 1.0),
        ("goal_position_{joint}", "present_position_{joint}", 1.0),
        ("{joint} target (rad)", "{joint} measured (rad)", 1.0),
        ("q_des/{joint}", "q/{joint}", 1.0),
    ):
        agrees(Recording.from_frame(table(command, position, scale=scale)))


def test_columns_of_joints_beside_times_named_as_ours_are_read(tmp_path):
    frame = table("{joint}_command_rad", "{joint}_position_rad", time="send_time_s")
    frame.to_csv(path := tmp_path / "one.csv", index=False)
    agrees(load(path))
    frame.insert(1, "read_time_s", TIME + 0.003)
    frame.to_csv(path := tmp_path / "both.csv", index=False)
    agrees(recording := load(path))
    trial = recording.trials("knee")[0]
    np.testing.assert_allclose(trial.read_time_s - trial.send_time_s, 0.003)


def test_times_are_seconds_by_their_ending_or_their_distance():
    for name, scale, guessed in (
        ("time_ms", 1e3, False), ("timestamp_us", 1e6, False), ("t", 1e3, True),
        ("stamp", 1e9, True),
    ):  # fmt: skip
        made = table("{joint}_cmd", "{joint}_pos", name)
        made[name] *= scale
        recording = Recording.from_frame(made)
        agrees(recording)
        assert guessed == any("names no unit" in text for text in recording.warnings), name


def test_a_log_of_one_nameless_joint_is_read_and_trials_are_kept(tmp_path):
    made = pd.DataFrame({"time": np.tile(TIME, 2), "episode": np.repeat([3, 4], 60),
                         "command": np.tile(COMMAND["knee"], 2),
                         "position": np.tile(POSITION["knee"], 2)})  # fmt: skip
    made.to_csv(tmp_path / "log.csv", index=False)
    first, second = load(tmp_path / "log.csv").trials("joint")
    np.testing.assert_allclose(second.position_rad, POSITION["knee"])
    assert second.send_time_s[0] > first.send_time_s[-1]


def test_nothing_of_the_mini_pupper_is_added_to_another_robots_log(tmp_path):
    """The sweep script's columns without its own `signal` and `phase` are any robot's."""
    made = pd.DataFrame({"time_s": TIME, "freq_hz": 1.0, "motor_idx": 1,
                         "command_rad": COMMAND["knee"],
                         "actual_rad": POSITION["knee"]})  # fmt: skip
    made.to_csv(tmp_path / "log.csv", index=False)
    recording = load(tmp_path / "log.csv")
    (trial,) = recording.trials("motor_1")
    np.testing.assert_allclose(trial.command_rad, COMMAND["knee"])
    assert trial.frequency_hz == 1.0 and trial.truncation.quantum_rad == 0
    assert "start_pose_rad" not in recording.metadata
    assert set(recording.metadata["bus"]) == {"read_time_doubt_s"}
    made.assign(signal=0.0).to_csv(tmp_path / "mini.csv", index=False)
    (trial,) = load(tmp_path / "mini.csv").trials("LF_thigh")
    np.testing.assert_allclose(trial.command_rad, COMMAND["knee"] + DEFAULT_POSE["LF_thigh"])
    with pytest.raises(InputError, match="Mini Pupper sweep, which says itself what `unit`"):
        load(tmp_path / "mini.csv", LogOptions(unit="deg"))


def test_a_folder_of_logs_is_no_recording(tmp_path):
    for name in "ab":
        table("{joint}_cmd", "{joint}_pos").to_csv(tmp_path / f"{name}.csv", index=False)
    with pytest.raises(InputError, match="holds 2 logs"):
        load(tmp_path)
    assert [path.name for path in logs_in(tmp_path)] == ["a.csv", "b.csv"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="an empty folder"):
        logs_in(tmp_path / "empty")


def test_one_time_stamp_is_in_doubt_by_half_a_turn_unless_its_place_is_given(tmp_path):
    table("{joint}_command", "{joint}_position").to_csv(tmp_path / "log.csv", index=False)
    (trial,) = load(tmp_path / "log.csv").trials("knee")
    assert trial.read_time_doubt_s == pytest.approx(0.01)
    (trial,) = load(tmp_path / "log.csv", LogOptions(read_before_send=True)).trials("knee")
    np.testing.assert_allclose(trial.read_time_s, TIME, atol=1e-12)
    assert (trial.send_time_s > trial.read_time_s).all() and trial.read_time_doubt_s <= 0.001
    (trial,) = load(tmp_path / "log.csv", LogOptions(stamp="end")).trials("knee")
    np.testing.assert_allclose(trial.read_time_s, TIME, atol=1e-12)
    assert (trial.send_time_s < trial.read_time_s).all()


def test_columns_units_and_names_come_from_options(tmp_path):
    made = table("u_{joint}", "y_{joint}", "when", 2048 / np.pi)
    for name in made.columns[1:]:
        made[name] += 2048
    made.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(InputError, match="belong to no known layout"):
        load(tmp_path / "log.csv")
    options = LogOptions("when", "u_{joint}", "y_{joint}", joints={"knee": "a", "ankle": "b"},
                         unit="counts:4096")  # fmt: skip
    recording = load(tmp_path / "log.csv", options)
    agrees(recording, ("a", "b"))
    assert recording.trials("a")[0].position_count is not None
    with pytest.raises(InputError, match="`joints` names hip"):
        load(
            tmp_path / "log.csv", LogOptions("when", "u_{joint}", "y_{joint}", joints={"hip": "h"})
        )
    with pytest.raises(InputError, match="no such column"):
        load(tmp_path / "log.csv", LogOptions("then", "u_{joint}", "y_{joint}"))


def test_a_numpy_archive_is_read_and_pickles_are_not(tmp_path):
    arrays = {
        "command": np.array([*COMMAND.values()]).T,
        "position": np.array([*POSITION.values()]).T,
    }
    np.savez(tmp_path / "log.npz", t=TIME, joint_names=[*COMMAND], **arrays)
    agrees(load(tmp_path / "log.npz"))
    np.savez_compressed(
        tmp_path / "bare.npz", t=TIME, qpos=arrays["position"], ctrl=arrays["command"]
    )
    agrees(load(tmp_path / "bare.npz"), ("joint_0", "joint_1"))
    np.savez(tmp_path / "objects.npz", t=TIME, command=np.array([{}], object))
    with pytest.raises(InputError, match="never loaded"):
        load(tmp_path / "objects.npz")
    (tmp_path / "torn.npz").write_bytes((tmp_path / "log.npz").read_bytes()[:300])
    with pytest.raises(InputError, match="is damaged"):
        load(tmp_path / "torn.npz")


def test_an_unknown_table_names_the_layouts_that_share_columns_and_what_is_missing(tmp_path):
    path = tmp_path / "log.csv"
    pd.DataFrame({"time_s": TIME, "trial": 0, "knee_command": 0.0, "volts": 7.0}).to_csv(
        path, index=False
    )
    with pytest.raises(InputError) as caught:
        load(path)
    text = str(caught.value)
    for words in (
        "any table: no column is a position", "recording of this project: send_time_s",
        "Mini Pupper sweep:", "motor_idx", "Mini Pupper playback: loop", "LeRobot", "SAGE",
        "BAM", "ktune", "MCAP", ".npz", "--command",
    ):  # fmt: skip
        assert words in text


def test_tables_that_are_no_log_are_refused_with_the_way_out(tmp_path):
    def file(name, made):
        made.to_csv(tmp_path / name, index=False)
        return tmp_path / name

    degrees = file("deg.csv", table("{joint}_command", "{joint}_position", scale=180 / np.pi))
    worded = table("{joint}_command", "{joint}_position").astype(object).assign(note="fine")
    worded.loc[7, "knee_command"] = "up"
    imu = pd.DataFrame(dict.fromkeys(["timestamp", "gx", "gy", "gz", "ax", "ay", "az"], TIME))
    alike = pd.DataFrame({"time": TIME, "a-b_command": 0.0, "a-b_position": 0.1,
                          "a b_command": 0.0, "a b_position": 0.1})  # fmt: skip
    cases = [
        (degrees, "deg.csv --unit deg"), (file("imu.csv", imu), "IMU's readings"),
        (file("up.csv", worded), "line 9, column knee_command: 'up' is not a number"),
        (file("alike.csv", alike), "two joints would be called a_b"),
    ]  # fmt: skip
    assert_each_refused(cases, load)
    agrees(load(degrees, LogOptions(unit="deg")))


def test_a_mapping_file_says_the_same_and_an_option_goes_first(tmp_path):
    mapping = tmp_path / "map.yaml"
    mapping.write_text(
        "time: when\ncommand: u_{joint}\nposition: y_{joint}\nunits: {ankle: deg}\n"
        "joints: {knee: a, ankle: b}\nread_before_send: true\n"
    )
    made = table("u_{joint}", "y_{joint}", "when")
    made[["u_ankle", "y_ankle"]] *= 180 / np.pi
    made.to_csv(tmp_path / "log.csv", index=False)
    options = read_mapping(mapping)
    agrees(load(tmp_path / "log.csv", options), ("a", "b"))
    assert merged(LogOptions(unit="deg"), options).unit == "deg"
    page = (ROOT / "docs/formats.md").read_text()
    mapping.write_text(page.split("```yaml\n# arm.yaml\n")[1].split("```")[0])
    options = read_mapping(mapping)
    assert options.joints == {"shoulder pan": "pan", "6": "gripper"}
    assert [u.scale for u in options.unit_of("pan")] == pytest.approx([np.pi / 180] * 2)
    assert options.unit_of("gripper")[0].scale == pytest.approx(1.9 / 200)
    for text, says in (("tme: when\n", "Did you mean time"), ("unit: furlong\n", "Write rad, deg")):
        mapping.write_text(text)
        assert_each_refused([(mapping, says)], read_mapping)
