"""ROS 2 logs: MCAP written by a ROS 2 library, rosbag2 folders, clocks, and torn files."""

import sqlite3
import struct
import sys
import time

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from pupper_sysid.sysid.recordings.importers.ros import decode
from support.refusals import assert_each_refused

writer = pytest.importorskip("mcap_ros2.writer")

HEADER = """std_msgs/Header header
{fields}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
DEFINITIONS = {
    "sensor_msgs/msg/JointState": HEADER.format(
        fields="string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort"
    ),
    "trajectory_msgs/msg/JointTrajectory": HEADER.format(
        fields="string[] joint_names\ntrajectory_msgs/JointTrajectoryPoint[] points"
    )
    + """================================================================================
MSG: trajectory_msgs/JointTrajectoryPoint
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Duration time_from_start
================================================================================
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
""",
    "std_msgs/msg/Float64MultiArray": """std_msgs/MultiArrayLayout layout
float64[] data
================================================================================
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
================================================================================
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
""",
}
JOINTS = ["pan", "tilt"]
START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
READ_LATE_NS = 1_250_000  # a reading's header after the command's
LOGGED_LATE_NS = 300_000  # the recorder receives a message after its header's time
COUNT = 100
COMMANDS = np.array([[0.5 * np.sin(0.1 * k), 0.3 * np.cos(0.07 * k) / 3] for k in range(COUNT)])
POSITIONS = np.roll(COMMANDS, 4, axis=0) + 1e-7 / 3


def header(time_ns):
    return {"stamp": {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}, "frame_id": "base"}


def state(time_ns, values, names=JOINTS):
    return {"header": header(time_ns), "name": names, "position": [float(v) for v in values],
            "velocity": [0.0] * len(names), "effort": []}  # fmt: skip


def trajectory(time_ns, values, points=1):
    point = {"velocities": [], "accelerations": [], "effort": []}
    return {
        "header": header(time_ns), "joint_names": JOINTS,
        "points": [
            point | {"positions": [float(v) + n for v in values],
                     "time_from_start": {"sec": 0, "nanosec": 10_000_000 * n}}
            for n in range(points)
        ],
    }  # fmt: skip


def array(values):
    dim = [{"label": "joints", "size": 2, "stride": 2}]
    return {"layout": {"dim": dim, "data_offset": 0}, "data": [float(v) for v in values]}


def messages(command="trajectory_msgs/msg/JointTrajectory", stamps=True, points=1):
    """Topic, type, log time and content, in turn a command and, a little later, a reading."""
    for k in range(COUNT):
        sent = START_NS + k * STEP_NS
        stamp = sent if stamps else 0
        if command.endswith("JointTrajectory"):
            content = trajectory(stamp, COMMANDS[k], points)
        elif command.endswith("JointState"):
            content = state(stamp, COMMANDS[k][::-1], JOINTS[::-1])
        else:
            content = array(COMMANDS[k])
        yield "/joint_commands", command, sent + LOGGED_LATE_NS, content
        read = sent + READ_LATE_NS
        yield ("/joint_states", "sensor_msgs/msg/JointState", read + LOGGED_LATE_NS,
               state(read, POSITIONS[k]))  # fmt: skip


def written(path, found, compression=None):
    """An MCAP file by the ROS 2 library's writer."""
    from mcap.writer import CompressionType

    with path.open("wb") as file:
        made = writer.Writer(file, chunk_size=4096, compression=compression or CompressionType.ZSTD)
        schemas = {}
        for topic, kind, log_ns, content in found:
            if kind not in schemas:
                schemas[kind] = made.register_msgdef(kind, DEFINITIONS[kind])
            made.write_message(topic, schemas[kind], content, log_ns, log_ns)
        made.finish()
    return path


def test_an_mcap_of_a_ros_2_library_comes_back_to_1e_9_whatever_its_compression(tmp_path):
    from mcap.writer import CompressionType

    for compression in ("NONE", "LZ4", "ZSTD"):
        path = tmp_path / f"{compression}.mcap"
        recording = load(written(path, messages(), CompressionType[compression]))
        recording.save(tmp_path / "a.csv", force=True)
        for found in (recording, load(tmp_path / "a.csv")):
            for j, joint in enumerate(JOINTS):
                (trial,) = found.trials(joint)
                read = 1e-9 * np.arange(COUNT) * STEP_NS
                for ours, theirs in (
                    (trial.command_rad, COMMANDS[:, j]), (trial.position_rad, POSITIONS[:, j]),
                    (trial.read_time_s, read),
                    (trial.read_time_s - trial.send_time_s, 1e-9 * READ_LATE_NS),
                ):  # fmt: skip
                    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)
        assert recording.metadata["times"] == ["/joint_commands: header", "/joint_states: header"]


def test_a_command_without_a_header_is_dated_by_the_log(tmp_path):
    path = written(tmp_path / "a.mcap", messages("std_msgs/msg/Float64MultiArray"))
    recording = load(path)
    (trial,) = recording.trials("tilt")
    np.testing.assert_allclose(
        trial.read_time_s - trial.send_time_s, 1e-9 * (READ_LATE_NS - LOGGED_LATE_NS), atol=1e-9
    )
    assert trial.read_time_doubt_s == 0.003
    assert any("does not name its joints" in text for text in recording.warnings)
    assert any("when the recorder received it" in text for text in recording.warnings)
    swapped = load(path, LogOptions(joints={"tilt": "tilt", "pan": "pan"}))
    np.testing.assert_allclose(swapped.trials("tilt")[0].command_rad, COMMANDS[:, 0])


def test_commands_as_joint_states_are_told_by_their_topic_and_matched_by_name(tmp_path):
    path = written(tmp_path / "a.mcap", messages("sensor_msgs/msg/JointState"))
    (trial,) = load(path).trials("pan")
    np.testing.assert_allclose(trial.command_rad, COMMANDS[:, 0])
    named = LogOptions(command="/joint_commands", position="/joint_states")
    np.testing.assert_allclose(load(path, named).trials("pan")[0].command_rad, COMMANDS[:, 0])
    with pytest.raises(InputError, match="not one of its topics. It has /joint_commands"):
        load(path, LogOptions(command="/cmd", position="/joint_states"))


def simulated(found):
    """The same messages with headers of a clock that starts at 0."""
    for topic, kind, log_ns, content in found:
        if "header" in content:
            stamp = content["header"]["stamp"]
            time_ns = stamp["sec"] * 10**9 + stamp["nanosec"] - START_NS
            content = content | {"header": header(max(time_ns, 0))}
        yield topic, kind, log_ns, content


def test_headers_of_another_clock_are_believed_if_all_topics_have_them(tmp_path):
    (trial,) = load(written(tmp_path / "a.mcap", simulated(messages()))).trials("pan")
    apart = 1e-9 * READ_LATE_NS
    np.testing.assert_allclose(trial.read_time_s - trial.send_time_s, apart, atol=1e-9)
    arrays = simulated(messages("std_msgs/msg/Float64MultiArray"))
    recording = load(written(tmp_path / "b.mcap", arrays))
    assert recording.metadata["times"] == ["/joint_commands: log", "/joint_states: log"]
    (trial,) = recording.trials("pan")
    np.testing.assert_allclose(trial.read_time_s - trial.send_time_s, apart, atol=1e-9)
    # a header of zero is none
    recording = load(written(tmp_path / "c.mcap", messages(stamps=False)))
    assert recording.metadata["times"] == ["/joint_commands: log", "/joint_states: header"]


def test_each_reading_gets_the_command_in_force_and_none_is_interpolated(tmp_path):
    """Two readings per command: the second one holds the same command."""
    found = []
    for topic, kind, log_ns, content in messages():
        found.append((topic, kind, log_ns, content))
        if topic == "/joint_states":
            later = content["header"]["stamp"]
            time_ns = later["sec"] * 10**9 + later["nanosec"] + 5_000_000
            found.append((topic, kind, log_ns + 5_000_000, state(time_ns, content["position"])))
    (trial,) = load(written(tmp_path / "a.mcap", found)).trials("pan")
    np.testing.assert_array_equal(trial.command_rad[::2], trial.command_rad[1::2])
    np.testing.assert_allclose(trial.command_rad[::2], COMMANDS[:, 0])
    assert (np.diff(trial.send_time_s) > 0).all()


def test_commands_that_no_reading_saw_are_said(tmp_path):
    whole = list(messages())
    every_second = [m for k, m in enumerate(whole) if m[0] != "/joint_states" or k % 4 == 1]
    recording = load(written(tmp_path / "a.mcap", every_second))
    assert any("% of the commands were replaced" in text for text in recording.warnings)
    recording = load(written(tmp_path / "b.mcap", whole))
    assert not any("replaced" in text for text in recording.warnings)
    recording = load(written(tmp_path / "c.mcap", messages(points=3)))
    assert any("several points" in text for text in recording.warnings)


def bag(folder, found):
    """A rosbag2 folder with a SQLite database, its messages encoded by the ROS 2 library."""
    from mcap_ros2._dynamic import serialize_dynamic

    encoders = {k: serialize_dynamic(k, text)[k] for k, text in DEFINITIONS.items()}
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 5}\n")
    with sqlite3.connect(folder / "bag_0.db3") as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT)")
        database.execute("CREATE TABLE messages(topic_id INTEGER, timestamp INTEGER, data BLOB)")
        topics = {}
        for topic, kind, log_ns, content in found:
            if topic not in topics:
                topics[topic] = len(topics) + 1
                database.execute("INSERT INTO topics VALUES (?,?,?)", (topics[topic], topic, kind))
            data = bytes(encoders[kind](content))
            database.execute("INSERT INTO messages VALUES (?,?,?)", (topics[topic], log_ns, data))
    return folder


def test_a_bag_in_sqlite_is_read_like_mcap(tmp_path):
    for kind in ("JointTrajectory", "Float64MultiArray"):
        name = next(k for k in DEFINITIONS if k.endswith(kind))
        found = list(messages(name))
        folder, file = bag(tmp_path / kind, found), written(tmp_path / f"{kind}.mcap", found)
        for path in (folder, folder / "bag_0.db3"):
            for joint in JOINTS:
                (ours,), (wanted,) = load(path).trials(joint), load(file).trials(joint)
                np.testing.assert_array_equal(ours.command_rad, wanted.command_rad)
                np.testing.assert_array_equal(ours.read_time_s, wanted.read_time_s)


def test_a_bag_of_mcap_files_is_one_log_and_a_file_cut_short_is_read_up_to_there(tmp_path):
    found, folder = list(messages()), tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 9}\n")
    written(folder / "bag_0.mcap", found[:100])
    written(folder / "bag_1.mcap", found[100:])
    (trial,) = load(folder).trials("pan")
    np.testing.assert_allclose(trial.command_rad, COMMANDS[:, 0])
    path = written(tmp_path / "a.mcap", found)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    recording = load(path)
    assert 20 < len(recording.trials("pan")[0].send_time_s) < COUNT
    assert any("cut short" in text for text in recording.warnings)


def test_logs_that_are_damaged_too_large_or_without_joints_are_refused(tmp_path, monkeypatch):
    def only(name, topic):
        return written(tmp_path / name, [m for m in messages() if m[0] == topic])

    with sqlite3.connect(tmp_path / "bag.db3") as database:
        database.execute("CREATE TABLE photographs(id INTEGER)")
    (tmp_path / "d.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\x01" * 500)
    changing = [
        (topic, kind, log_ns, content | {"name": [f"j{k}", f"k{k}"]})
        for k, (topic, kind, log_ns, content) in enumerate(messages("sensor_msgs/msg/JointState"))
    ]
    whole, many = written(tmp_path / "w.mcap", messages()), written(tmp_path / "j.mcap", changing)
    cases = [
        (only("a.mcap", "/joint_commands"), "no topic has positions. It has /joint_commands"),
        (only("b.mcap", "/joint_states"), "no joint of /joint_states has a command"),
        (tmp_path / "bag.db3", "no readable rosbag2 database"), (tmp_path / "d.mcap", "MCAP"),
        (many, "has 200 joints; at most 50 joints are read"),
    ]  # fmt: skip
    monkeypatch.setattr("pupper_sysid.sysid.recordings.importers.ros.MOST_JOINTS", 50)
    assert_each_refused(cases, load)
    monkeypatch.setattr("pupper_sysid.sysid.recordings.importers.ros.LARGEST_BYTES", 2e4)
    assert_each_refused([(whole, "unpacked, has more than 20,000 bytes")], load)
    monkeypatch.setitem(sys.modules, "mcap.stream_reader", None)
    assert_each_refused([(whole, "Install pupper-sysid[logs]")], load)


def test_big_endian_messages_are_read_and_no_length_is_believed_beyond_the_bytes():
    data = b"\x00\x00\x00\x00" + struct.pack(">II", 0, 0) + struct.pack(">I", 2)
    data += b"\0" * (-(len(data) - 4) % 8) + struct.pack(">dd", 1.5, -2.5)
    assert decode("std_msgs/Float64MultiArray", data).positions == (1.5, -2.5)
    start = b"\x00\x01\x00\x00" + struct.pack("<iII", 1, 2, 1) + b"\0" + b"\0" * 3
    for count in (5, 2**31, 2**32 - 1):
        with pytest.raises(ValueError, match="larger than the message|cut short"):
            decode("sensor_msgs/JointState", start + struct.pack("<I", count))
    with pytest.raises(ValueError, match="header"):
        decode("sensor_msgs/JointState", b"\x07")


TOPICS = """CREATE TABLE topics(id INTEGER, name TEXT, type TEXT);
INSERT INTO topics VALUES (0, '/joint_states', 'sensor_msgs/msg/JointState');
"""
ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c)"


@pytest.mark.parametrize(
    ("script", "says"),
    [
        (f"{TOPICS}CREATE VIEW messages AS {ENDLESS} SELECT 0 AS topic_id, x AS timestamp, x AS "
         "data FROM c WHERE x < 0", "messages is no plain table"),
        (f"{TOPICS}CREATE TABLE messages(topic_id, timestamp, data AS (zeroblob(1000000000)))",
         "messages is no plain table"),
        (f"{TOPICS}CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
         "messages is no plain table"),
        (f"CREATE VIEW topics AS {ENDLESS} SELECT x AS id, 'a' AS name, 'b' AS type FROM c; "
         "CREATE TABLE messages(topic_id, timestamp, data)", "topics is no plain table"),
        (f"{TOPICS}CREATE TABLE messages(topic_id, timestamp, data); "
         "INSERT INTO messages VALUES (0, 1, 100000000000)", "no bytes with a time"),
        (f"{TOPICS}CREATE TABLE messages(topic_id, timestamp, data); "
         "INSERT INTO messages VALUES (0, 1.5, x'00')", "no bytes with a time"),
    ],
)  # fmt: skip
def test_a_database_is_read_but_computes_nothing(tmp_path, script, says):
    with sqlite3.connect(tmp_path / "bag.db3") as database:
        try:
            database.executescript(script)
        except sqlite3.OperationalError:
            pytest.skip("this SQLite has no such tables")
    started = time.process_time()
    with pytest.raises(InputError, match=says):
        load(tmp_path / "bag.db3")
    assert time.process_time() - started < 1


def test_a_database_that_takes_too_many_steps_is_given_up(tmp_path, monkeypatch):
    with sqlite3.connect(tmp_path / "bag.db3") as database:
        database.executescript(f"{TOPICS}CREATE TABLE messages(topic_id, timestamp, data);")
        database.executemany(
            "INSERT INTO messages VALUES (7, ?, x'00')", ((k,) for k in range(9999))
        )
    where = "pupper_sysid.sysid.recordings.importers.ros."
    monkeypatch.setattr(f"{where}_MOST_STEPS", 1000)
    monkeypatch.setattr(f"{where}_STEPS", 100)
    with pytest.raises(InputError, match="interrupted"):
        load(tmp_path / "bag.db3")
