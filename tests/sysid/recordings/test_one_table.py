"""One table, one check: a log with a name twice, or one too few, is refused at every door alike."""

import io
import json
import re
import zipfile

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.csv_table import distinct
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from pupper_sysid.sysid.recordings.importers.ros import (
    JOINT_STATE,
    MULTI_ARRAY,
    TRAJECTORY,
    Message,
    _by_joint,
    _log,
    _Topic,
)
from pupper_sysid.sysid.recordings.recording import Recording

ROWS = 60
TIME = 0.02 * np.arange(ROWS)
COMMAND = np.stack([0.3 * np.sin(TIME), 0.2 * np.cos(TIME)], axis=1)
POSITION = np.roll(COMMAND, 2, axis=0)
TWICE = r"two (columns|arrays|joints) would be called .*Rename one of them"
EQUAL = r"has \d+ values.* and .* has \d+; each joint has one of each"


def npz(path, **arrays):
    np.savez(path, **({"time": TIME, "command": COMMAND, "position": POSITION} | arrays))
    return path


def parquet(path, columns):
    """A parquet file of columns by name, which may stand twice."""
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet as writer

    names, values = zip(*columns, strict=True)
    made = [v.tolist() for v in values]
    writer.write_table(pa.Table.from_arrays([pa.array(v) for v in made], names=list(names)), path)
    return path


def lerobot(folder, action, state, width=2):
    (folder / "meta").mkdir()
    (folder / "data").mkdir()
    features = {
        "action": {"names": action, "shape": [2]},
        "observation.state": {"names": state, "shape": [2]},
    }
    (folder / "meta/info.json").write_text(json.dumps({"fps": 50, "features": features}))
    parquet(folder / "data/0.parquet", [
        ("action", COMMAND[:, :width]), ("observation.state", POSITION[:, :width]),
        ("episode_index", np.zeros(ROWS)), ("frame_index", np.arange(ROWS, dtype=float)),
    ])  # fmt: skip
    return folder


def sage(folder, joints):
    for name, values in (("control.csv", COMMAND), ("state_motor.csv", POSITION)):
        lines = [f'x,{20_000 * k},"{row.tolist()}"' for k, row in enumerate(values)]
        (folder / name).write_text("\n".join(["type,timestamp,positions", *lines]) + "\n")
    (folder / "joint_list.txt").write_text("\n".join(joints))
    return folder


def ros(path, names, command_names=None, kind=TRAJECTORY, more=()):
    """Rows of a bag of two topics, without its bytes."""
    from pupper_sysid.sysid.recordings.importers import ros as door

    states = _Topic(JOINT_STATE, [20_000_000 * k + 1 for k in range(ROWS)],
                    [Message(0, names, tuple(p)) for p in POSITION])  # fmt: skip
    commands = _Topic(kind, [20_000_000 * k for k in range(ROWS)],
                      [Message(0, command_names or (), tuple(c)) for c in COMMAND])  # fmt: skip
    topics = {"/joint_states": states, "/commands": commands} | dict(more)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(door, "_topics", lambda path, raw: topics)
        return _log(path, [], LogOptions())


TWO_COMMANDS = ["time", "knee_command", "knee_command", "knee_position", "ankle_position"]
TWO_SPELLINGS = ["time", "action.knee", "action.knee.pos", "state.knee", "state.knee.pos"]


def frame(names):
    return pd.DataFrame(np.column_stack([TIME, COMMAND, POSITION]), columns=names)


def csv(folder, names):
    frame(names).to_csv(folder / "log.csv", index=False)
    return folder / "log.csv"


def zip_twice(folder):
    path = folder / "log.npz"
    with zipfile.ZipFile(path, "w") as archive, pytest.warns(UserWarning, match="Duplicate"):
        for name, values in (("time", TIME), ("q", POSITION), ("cmd", COMMAND), ("cmd", POSITION)):
            data = io.BytesIO()
            np.save(data, values)
            archive.writestr(f"{name}.npy", data.getvalue())
    return path


DOORS_TWICE = {
    "csv": lambda f: load(csv(f, TWO_COMMANDS)),
    "csv, two spellings": lambda f: load(csv(f, TWO_SPELLINGS)),
    "npz, joints": lambda f: load(npz(f / "log.npz", joint_names=["knee", "knee"])),
    "npz, spellings": lambda f: load(npz(f / "log.npz", joint_names=["knee", "knee.pos"])),
    "npz, arrays": lambda f: load(zip_twice(f)),
    "parquet": lambda f: load(
        parquet(
            f / "log.parquet",
            [
                ("time", TIME),
                ("knee_command", COMMAND[:, 0]),
                ("knee_command", COMMAND[:, 1]),
                ("knee_position", POSITION[:, 0]),
            ],
        )
    ),
    "LeRobot": lambda f: load(lerobot(f, ["knee.pos", "knee.pos"], ["knee.pos", "knee.pos"])),
    "SAGE": lambda f: load(sage(f, ["knee", "knee"])),
    "ROS, positions": lambda f: ros(f, ("knee", "knee"), ("knee", "ankle")),
    "ROS, commands": lambda f: ros(f, ("knee", "ankle"), ("ankle", "ankle")),
    "from_frame": lambda f: Recording.from_frame(frame(TWO_COMMANDS)),
    "from_arrays": lambda f: Recording.from_arrays(
        TIME, {1: COMMAND[:, 0], "1": COMMAND[:, 1]}, {1: POSITION[:, 0], "1": POSITION[:, 1]}
    ),
}
DOORS_UNEQUAL = {
    "npz, too many names": lambda f: load(npz(f / "l.npz", joint_names=["knee", "ankle", "hip"])),
    "npz, too few names": lambda f: load(npz(f / "log.npz", joint_names=["knee"])),
    "npz, positions": lambda f: load(npz(f / "log.npz", position=POSITION[:, :1])),
    "npz, named positions": lambda f: load(
        npz(f / "log.npz", position=POSITION[:, :1], joint_names=["knee", "ankle"])
    ),
    "parquet": lambda f: load(
        parquet(
            f / "log.parquet", [("time", TIME), ("action", COMMAND), ("state", POSITION[:, :1])]
        )
    ),
    "LeRobot": lambda f: load(lerobot(f, ["knee", "ankle"], ["knee", "ankle"], width=1)),
    "ROS, positions": lambda f: ros(f, ("knee", "ankle", "hip"), ("knee", "ankle")),
    "ROS, unnamed commands": lambda f: ros(
        f, ("knee", "ankle"), kind=MULTI_ARRAY,
        more=[("/commands", _Topic(MULTI_ARRAY, [0], [Message(0, (), (0.1,))]))],
    ),
}  # fmt: skip


def test_names_that_stand_twice_or_without_a_value_each_are_refused_at_every_door(tmp_path):
    problems = []
    for doors, words in ((DOORS_TWICE, TWICE), (DOORS_UNEQUAL, EQUAL)):
        for number, (name, door) in enumerate(doors.items()):
            folder = tmp_path / f"{len(doors)} {number}"
            folder.mkdir()
            try:
                door(folder)
            except InputError as refused:
                if not re.search(words, str(refused)):
                    problems.append(f"{name}: {refused}")
            else:
                problems.append(f"{name}: accepted")
    assert not problems, "\n".join(problems)


def test_rows_of_two_lengths_are_no_log(tmp_path):
    path = npz(tmp_path / "log.npz", position=POSITION[:-1], gains=np.ones(3), velocity=COMMAND)
    with pytest.raises(InputError, match="position has 59 rows where others have 60"):
        load(path)


def test_arrays_that_are_no_angles_may_have_any_width(tmp_path):
    imu, seen = np.ones((ROWS, 6)), np.ones((ROWS, 40))
    names = np.array([b"knee", b"ankle"])  # names in bytes are names
    path = npz(tmp_path / "log.npz", joint_names=names, imu=imu, obs=seen)
    recording = load(path)
    assert set(recording.joints) == {"knee", "ankle"}
    (trial,) = recording.trials("ankle")
    np.testing.assert_allclose(trial.position_rad, POSITION[:, 1])


def test_an_angle_in_two_units_is_one_joint():
    command, position = COMMAND[:, 0], POSITION[:, 0]
    table = pd.DataFrame({
        "time": TIME, "knee_command_rad": command, "knee_command_deg": np.degrees(command),
        "knee_position_deg": np.degrees(position), "knee_position_rad": position,
    })  # fmt: skip
    (trial,) = Recording.from_frame(table).trials("knee")
    np.testing.assert_allclose(trial.command_rad, command)
    np.testing.assert_allclose(trial.position_rad, position)


def test_a_topic_of_other_numbers_is_left_out_with_a_warning_where_another_commands(tmp_path):
    debug = _Topic(MULTI_ARRAY, [0], [Message(0, (), (1.0, 2.0, 3.0))])
    log = ros(tmp_path, ("knee", "ankle"), ("knee", "ankle"), more=[("/debug", debug)])
    assert log.metadata["joints"] == ["knee", "ankle"]
    assert any("/debug has 3 values for 2 joints and was left out" in w for w in log.warnings)


def test_messages_may_name_different_joints():
    topic = _Topic(JOINT_STATE, [0, 1], [Message(0, ("a",), (1.0,)), Message(0, ("b",), (2.0,))])
    found = _by_joint("log, topic /q", topic, ())
    np.testing.assert_array_equal(found["a"], [1.0, np.nan])
    np.testing.assert_array_equal(found["b"], [np.nan, 2.0])


def test_columns_of_a_frame_may_be_numbers_but_not_without_a_name():
    table = frame(TWO_COMMANDS).iloc[:, [0, 1, 3, 4]]
    table.columns = ["time", "knee_command", "knee_position", 7]
    assert Recording.from_frame(table).joints == ["knee"]
    distinct("log", ["a", "b", "A"])
    with pytest.raises(InputError, match="two columns have no name"):
        distinct("log", ["a", "", ""])
