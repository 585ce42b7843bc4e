"""Files made to hurt the reader of one format: each writes itself and names the command."""

from __future__ import annotations

import io
import json
import pickle
import sqlite3
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hostile.kit import JOINT_STATE, joint_state, ros_messages, write_mcap

Argv = tuple[str, ...]
GB = 1_000_000_000
HEADER = "send_time_s,read_time_s,trial,joint,frequency_hz,command_rad,position_rad"

BOMBS: dict[str, tuple[Callable[[Path], Argv], bool]] = {}
"""How to write a bomb into a folder (it returns the command), and whether it must be refused."""


def _bomb(name: str, refused: bool = True) -> Callable:
    def register(make: Callable[[Path], Argv]) -> Callable[[Path], Argv]:
        BOMBS[name] = make, refused
        return make

    return register


def _doctor(path: Path) -> Argv:
    return ("pupper_sysid", "doctor", path.name)


def _import(path: Path) -> Argv:
    return ("pupper_sysid", "import", path.name, "--out", "out.csv")


# ------------------------------------------------------------------------------------ recordings


def _recording(name: str, lines: list[str], refused: bool = True, end: str = "") -> None:
    def make(folder: Path) -> Argv:
        path = folder / "r.csv"
        path.write_text("\n".join(["# pupper-sysid recording", *lines, ""]) + end)
        return _doctor(path)

    BOMBS[f"recording, {name}"] = make, refused


def _said(name: str, lines: list[str]) -> None:
    """A recording of which the doctor says that it is of no use, with exit code 0."""
    _recording(name, lines, refused=False)


def _rows(count: int, row: Callable[[int], str]) -> list[str]:
    return [HEADER, *map(row, range(count))]


def _row(k: int, **cells: object) -> str:
    own = {
        "send_time_s": 0.02 * k,
        "read_time_s": 0.02 * k + 0.001,
        "trial": 0,
        "joint": "LF_hip",
        "frequency_hz": 1,
        "command_rad": np.sin(0.1 * k),
        "position_rad": np.sin(0.1 * k - 0.3),
    }
    return ",".join(str(v) for v in (own | cells).values())


GOOD = _rows(300, _row)
for _entry in ('{"trial": Infinity}', '{"trial": 1e400}', "[]", '{"trial": -1}'):
    _recording(f"resumed: {_entry}", [*GOOD, f"# resumed: {_entry}"], _entry != '{"trial": -1}')
_recording("trials 0.25 and 0.75", _rows(300, lambda k: _row(k, trial=0.25 + 0.5 * (k > 150))))
_recording("a trial per row", _rows(200_000, lambda k: _row(k, trial=k)))
_recording("a joint per row", _rows(200_000, lambda k: _row(k, joint=f"j{k}")))
_recording("a tone per row", _rows(100_000, lambda k: _row(k, frequency_hz=k + 1)))
_recording("10,000 resumptions", [*_rows(100_000, _row), *['# resumed: {"trial": 0}'] * 10_000])
_recording("a header line of a million keys",
           ["# x: {" + ",".join(f'"{k}":{k}' for k in range(100_000)) + "}", *GOOD])  # fmt: skip
_recording("a cell of 200,000 characters", [HEADER, _row(0, position_rad="1" * 200_000), *GOOD[2:]])
_recording("a column of 200,000 characters", ["x" * 200_000 + "," + HEADER, *GOOD[1:]])
_recording("counts of 1e300", [HEADER + ",position_count", *(f"{r},1e300" for r in GOOD[1:])])
_recording("times of 1e300", _rows(300, lambda k: _row(k, send_time_s=f"{k}e300")))
_said("times a nanosecond apart",
           _rows(300, lambda k: _row(k, send_time_s=k * 1e-9, read_time_s=k * 1e-9)))  # fmt: skip
_said("times a year apart",
           _rows(300, lambda k: _row(k, send_time_s=3e7 * k, read_time_s=3e7 * k)))  # fmt: skip
_said("tones of 1e-300 Hz", _rows(300, lambda k: _row(k, frequency_hz=1e-300)))
_said("tones of 1e300 Hz", _rows(300, lambda k: _row(k, frequency_hz=1e300)))
_recording("quotes in each cell", _rows(100_000, lambda k: '"' + _row(k).replace(",", '","') + '"'),
           False)  # fmt: skip
_recording("a quantum of 1e-7 rad", ['# bus: {"command_quantum_rad": 1e-7}', *GOOD], False)
_recording("a speed limit of 1e308", ['# bus: {"speed_limit_rad_s": 1e308}', *GOOD])
_recording("a servo of 1e308", ['# servos: {"LF_hip": {"p_gain": 1e308}}', *GOOD])
_recording("a load of 1e308 kg",
           ['# loads: {"LF_hip": {"mass_kg": 1e308, "length_m": 1e308}}', *GOOD])  # fmt: skip
_recording("its footer is a list", GOOD, False, "# completed: [1, 2]\n")
_recording("a name that is a formula", ['# robot: "=cmd|calc"', *GOOD], False)


@_bomb("playback of positions only")
def _positions_only(folder: Path) -> Argv:
    path = folder / "p.csv"
    path.write_text("time_s,loop,LF_hip_position_rad\n" + "0.1,0,0.1\n" * 60)
    return _doctor(path)


@_bomb("commands of a century")
def _century(folder: Path) -> Argv:
    (folder / "c.csv").write_text("time_s,LF_hip\n0,0\n1,0.1\n3e9,0\n")
    return ("pupper_sysid", "sweep", "--playback", "c.csv")


@_bomb("commands a nanosecond apart", refused=False)
def _nanosecond(folder: Path) -> Argv:
    (folder / "c.csv").write_text("time_s,LF_hip\n0,0\n1e-9,6\n2e-9,-6\n")
    return ("pupper_sysid", "sweep", "--playback", "c.csv")


# ------------------------------------------------------------------------------------- archives


def _zip(folder: Path, members: dict[str, bytes], name: str = "log.npz") -> Path:
    with zipfile.ZipFile(folder / name, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, data in members.items():
            archive.writestr(member, data)
    return folder / name


def _npy(shape: str, dtype: str = "<f8", data: bytes = b"") -> bytes:
    head = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    head += " " * (-(len(head) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + data


for _name, _made in {
    "an array that says 8 TB": {"time.npy": _npy("(1000000000000,)")},
    "an array that says 2**63 rows": {"time.npy": _npy(f"({2**63},)")},
    "an array of pickles": {"time.npy": _npy("(3,)", "|O", pickle.dumps([print] * 3))},
    "an array of 60 dimensions": {"time.npy": _npy("(" + "1," * 60 + ")", data=bytes(8))},
    "an array of texts of 1 GB": {"time.npy": _npy("(3,)", "<U300000000")},
    "a header that is code": {"time.npy": _npy("__import__('os').system('touch executed')")},
    "no array": {"x.txt": b"hello"},
    "a path": {"../../evil.npy": _npy("(3,)", data=bytes(24))},
    "100,000 arrays": {f"a{k}.npy": b"" for k in range(100_000)},
}.items():
    BOMBS[f"npz, {_name}"] = lambda f, made=_made: _import(_zip(f, made)), True


@_bomb("npz, 2 GB in 2 MB")
def _zip_bomb(folder: Path) -> Argv:
    zeros = _npy("(62500000,)", data=bytes(GB // 2))
    return _import(_zip(folder, {f"{n}.npy": zeros for n in ("time", "command", "position", "x")}))


@_bomb("npz, sizes that are lies")
def _lying_zip(folder: Path) -> Argv:
    data = bytearray(_zip(folder, {"time.npy": _npy("(12500000,)", data=bytes(GB // 10))})
                     .read_bytes())  # fmt: skip
    for signature, at in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        place = data.find(signature) + at
        data[place : place + 4] = struct.pack("<I", 100)
    (folder / "log.npz").write_bytes(bytes(data))
    return _import(folder / "log.npz")


# -------------------------------------------------------------------------------------- parquet


def _parquet(folder: Path, table: object, **options: object) -> Argv:
    from pyarrow import parquet

    parquet.write_table(table, folder / "log.parquet", **options)
    return _import(folder / "log.parquet")


@_bomb("parquet, 10**8 rows of one value")
def _parquet_rows(folder: Path) -> Argv:
    import pyarrow as pa

    column = pa.DictionaryArray.from_arrays(np.zeros(10**8, np.int8), [1.5]).cast(pa.float64())
    return _parquet(folder, pa.table({"time": column}))


@_bomb("parquet, a million joints of a megabyte each", refused=False)
def _parquet_texts(folder: Path) -> Argv:
    import pyarrow as pa

    count = 10**6
    joint = pa.DictionaryArray.from_arrays(np.zeros(count, np.int8), ["x" * 10**6])
    numbers = {"time": np.arange(count), "goal": np.zeros(count), "position": np.zeros(count)}
    return _parquet(folder, pa.table(numbers | {"joint": joint}))


@_bomb("parquet, 5,000 columns")
def _parquet_columns(folder: Path) -> Argv:
    import pyarrow as pa

    return _parquet(folder, pa.table({f"c{k}": [1.0] for k in range(5000)}))


@_bomb("parquet, lists of a million numbers")
def _parquet_lists(folder: Path) -> Argv:
    import pyarrow as pa

    ends = np.arange(0, 41 * 10**6, 10**6, np.int32)
    lists = pa.ListArray.from_arrays(ends, np.zeros(40 * 10**6))
    columns = {"time": np.arange(40), "action": lists, "observation.state": lists}
    return _parquet(folder, pa.table(columns))


@_bomb("parquet, nested a hundred levels")
def _parquet_nested(folder: Path) -> Argv:
    import pyarrow as pa

    column = pa.array([1.0])
    for _ in range(100):
        column = pa.StructArray.from_arrays([column], ["a"])
    return _parquet(folder, pa.table({"time": column}))


@_bomb("parquet, its schema says another type", refused=False)
def _parquet_types(folder: Path) -> Argv:
    import pyarrow as pa

    kinds = {"time": pa.array([1, 2], pa.timestamp("ns")), "command": pa.array(["1", "2"]),
             "position": pa.array([b"1", b"2"])}  # fmt: skip
    return _parquet(folder, pa.table(kinds))


# ------------------------------------------------------------------------------------------ ROS


def _mcap(folder: Path, messages: list[tuple[str, int, bytes]], chunk: int = 4096) -> Argv:
    with (folder / "log.mcap").open("wb") as file:
        write_mcap(file, messages, chunk)
    return _import(folder / "log.mcap")


@_bomb("MCAP, a chunk of 600 MB")
def _mcap_chunk(folder: Path) -> Argv:
    return _mcap(folder, [("/joint_states", k, bytes(GB // 100)) for k in range(60)], 2 * GB)


@_bomb("MCAP, 4,000,000 messages")
def _mcap_messages(folder: Path) -> Argv:
    return _mcap(folder, [("/x", k, b"") for k in range(4_000_000)], 10**6)


@_bomb("MCAP, joints without number", refused=False)
def _mcap_joints(folder: Path) -> Argv:
    names = struct.pack("<I", 10**6) + b"".join(
        struct.pack("<I", 8) + b"%07d\0" % k for k in range(10**6)
    )
    body = struct.pack("<iIII", 1, 1, 1, 0) + names + struct.pack("<I", 0)
    return _mcap(folder, [("/joint_states", 1, b"\x00\x01\x00\x00" + body)] * 5)


@_bomb("MCAP, another joint in each message")
def _mcap_many_joints(folder: Path) -> Argv:
    found = []
    for k in range(20_000):
        data = joint_state(10**9 + k, 0.1).replace(b"knee", b"%04x" % k)
        found += [("/joint_states", 10**9 + k, data), ("/joint_commands", 10**9 + k, data)]
    return _mcap(folder, found)


@_bomb("MCAP, times at the ends of the scale", refused=False)
def _mcap_times(folder: Path) -> Argv:
    own = ros_messages()
    ends = [("/joint_states", time_ns, own[0][2]) for time_ns in (2**63, 0)]
    return _mcap(folder, [*own, *ends])


def _sqlite(folder: Path, *statements: str) -> Argv:
    with sqlite3.connect(folder / "bag.db3") as database:
        for statement in statements:
            database.execute(statement)
    return _import(folder / "bag.db3")


TOPICS = (
    "CREATE TABLE topics(id INTEGER, name TEXT, type TEXT)",
    f"INSERT INTO topics VALUES (0, '/joint_states', '{JOINT_STATE}')",
)
_ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c)"
for _name, _sql in {
    "rows without end": f"CREATE VIEW messages AS {_ENDLESS} SELECT 0 AS topic_id, x AS timestamp, "
    "zeroblob(10) AS data FROM c",
    "work without end": f"CREATE VIEW messages AS {_ENDLESS} SELECT 0 AS topic_id, x AS timestamp, "
    "zeroblob(10) AS data FROM c WHERE x < 0",
    "blobs of a gigabyte": "CREATE VIEW messages AS SELECT 0 AS topic_id, 1 AS timestamp, "
    "zeroblob(1000000000) AS data",
    "a computed column": "CREATE TABLE messages(topic_id INTEGER, timestamp INTEGER, data BLOB AS "
    "(zeroblob(1000000000)))",
}.items():
    BOMBS[f"SQLite, {_name}"] = lambda f, sql=_sql: _sqlite(f, *TOPICS, sql), True


@_bomb("SQLite, topics without end")
def _sqlite_topics(folder: Path) -> Argv:
    return _sqlite(
        folder, f"CREATE VIEW topics AS {_ENDLESS} SELECT x AS id, 'a' AS name, 'b' AS type FROM c",
        "CREATE TABLE messages(topic_id INTEGER, timestamp INTEGER, data BLOB)",
    )  # fmt: skip


@_bomb("SQLite, texts where numbers belong")
def _sqlite_types(folder: Path) -> Argv:
    return _sqlite(
        folder, *TOPICS, "CREATE TABLE messages(topic_id, timestamp, data)",
        "INSERT INTO messages VALUES (0, 'x', 3.5)",
    )  # fmt: skip


@_bomb("SQLite, data that are a number")
def _sqlite_number(folder: Path) -> Argv:
    return _sqlite(
        folder, *TOPICS, "CREATE TABLE messages(topic_id, timestamp, data)",
        "INSERT INTO messages VALUES (0, 1, 100000000000)",
    )  # fmt: skip


# -------------------------------------------------------------------------- weights, checkpoints


def _spoil_json(path: Path, **changes: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


_DEPLOY = ("pupper_deploy", "policy", "--actuator", "calibrated.yaml", "--seconds", "0.2",
           "--name", "b")  # fmt: skip
for _name, _changes in {
    "layers of 8192 units, 16 of them": {"hidden": [8192] * 16},
    "a memory of 8192 units": {"kind": "lstm", "memory": 8192},
    "a transformer of 8192 units": {"kind": "transformer", "memory": 8192},
    "a history of 1000 actions": {"action_history": 1000},
    "velocity_steps of 10**9": {"velocity_steps": 10**9},
    "a control step of 1e-9 s": {"control_step_s": 1e-9},
    "a control step of 1 s": {"control_step_s": 1.0},
    "a physics step of 1e-5 s": {"physics_step_s": 1e-5},
    "a pose of 50 rad": {"default_pose_rad": {"LF_hip": 50.0}},
    "a scale of 1e-300 rad": {"action_scale_rad": 1e-300},
    "an actuator elsewhere": {"actuator": "/proc/kmsg"},
    "32 parts of 10,000 numbers": {
        "observation": [{"name": f"p{k}", "size": 10_000, "unit": "rad"} for k in range(32)]
    },
    "dead times of 10 s": {"dead_time_s": [10.0, 10.0]},
}.items():

    def _contract(folder: Path, changes: dict = _changes) -> Argv:
        path = folder / "policy" / "contract.json"
        if "default_pose_rad" in changes:
            pose = json.loads(path.read_text())["default_pose_rad"]
            changes = {"default_pose_rad": pose | changes["default_pose_rad"]}
        _spoil_json(path, **changes)
        return _DEPLOY

    _fine = {"a physics step of 1e-5 s", "an actuator elsewhere", "dead times of 10 s",
             "a control step of 1 s", "a scale of 1e-300 rad"}  # fmt: skip
    BOMBS[f"policy, {_name}"] = _contract, _name not in _fine


def _weights(folder: Path, header: bytes, length: int | None = None, data: bytes = b"") -> Argv:
    import hashlib

    path = folder / "policy" / "weights.safetensors"
    path.write_bytes(struct.pack("<Q", len(header) if length is None else length) + header + data)
    _spoil_json(folder / "policy" / "contract.json",
                weights_sha256=hashlib.sha256(path.read_bytes()).hexdigest())  # fmt: skip
    return _DEPLOY


for _name, _header, _length in (
    ("a header of 2**63 bytes", b"{}", 2**63),
    ("a header of nothing", b"", None),
    ("brackets in brackets", b'{"a":' * 100_000, None),
    ("a tensor of 8 TB", b'{"a":{"dtype":"F64","shape":[1000000000000],'
                         b'"data_offsets":[0,8000000000000]}}', None),
    ("a shape of 2**64", b'{"a":{"dtype":"F64","shape":[4294967296,4294967296],'
                         b'"data_offsets":[0,0]}}', None),
    ("a million tensors", b"{" + b",".join(
        b'"%d":{"dtype":"F32","shape":[0],"data_offsets":[0,0]}' % k for k in range(10**6)) + b"}",
     None),
):  # fmt: skip
    BOMBS[f"weights, {_name}"] = (
        lambda f, header=_header, length=_length: _weights(f, header, length), True
    )  # fmt: skip


class _Evil:
    def __reduce__(self) -> tuple:
        import os

        return os.system, ("touch executed",)


def _resume(folder: Path, data: bytes) -> Argv:
    (folder / "run" / "last.pt").write_bytes(data)
    return ("pupper_train", "--resume", "run", "--minutes", "0.001")


def _torch(content: object, **options: object) -> bytes:
    import torch

    file = io.BytesIO()
    torch.save(content, file, **options)
    return file.getvalue()


def _rezipped(data: bytes) -> bytes:
    """A checkpoint with a tensor of 4 GB of zeros, compressed."""
    packed = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(data)) as source,
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as target,
    ):
        for member in source.namelist():
            content = source.read(member)
            if member.endswith("data/0"):
                with target.open(member, "w", force_zip64=True) as out:
                    for _ in range(400):
                        out.write(bytes(10_000_000))
            else:
                target.writestr(member, content)
    return packed.getvalue()


def _large_tensor() -> bytes:
    import torch

    return _rezipped(_torch({"schema": "x", "x": torch.zeros(10)}))


def _stretched() -> bytes:
    """A tensor that is one number, seen 10**12 times."""
    import torch

    return _torch({"schema": "x", "x": torch.zeros(1).expand(10**12)})


for _name, _data in {
    "a pickle that runs a program": lambda: pickle.dumps(_Evil()),
    "an old pickle that runs a program": lambda: pickle.dumps(_Evil(), protocol=2),
    "a torch file that runs a program": lambda: _torch(_Evil()),
    "a torch file of the old kind": lambda: _torch({"a": 1}, _use_new_zipfile_serialization=False),
    "4 GB of zeros in 4 MB": _large_tensor,
    "a number seen 10**12 times": _stretched,
    "a list": lambda: _torch([1, 2, 3]),
    "no parts": lambda: _torch({"schema": "pupper-checkpoint", "schema_version": 1}),
    "lists in lists": lambda: _torch(_deep()),
}.items():
    BOMBS[f"checkpoint, {_name}"] = lambda f, data=_data: _resume(f, data()), True


def _deep() -> list:
    found: list = []
    for _ in range(200):
        found = [found]
    return found


# ------------------------------------------------------------------------------------- robots


def _robot(name: str, text: str, refused: bool = True, ending: str = "xml") -> None:
    def make(folder: Path) -> Argv:
        (folder / f"bomb.{ending}").write_text(text)
        return ("pupper_sysid", "init-robot", f"bomb.{ending}")

    BOMBS[f"MJCF, {name}"] = make, refused


_ROBOT = """<mujoco><asset>{}</asset><worldbody><body><joint name="knee" range="{}" limited="true"/>
<geom size="0.1"/>{}</body></worldbody></mujoco>"""
_robot(
    "a height field of 10**9 cells",
    _ROBOT.format('<hfield name="h" nrow="31623" ncol="31623" size="1 1 1 1"/>', "-60 60", ""),
)
_robot(
    "a texture of 100,000 pixels",
    _ROBOT.format(
        '<texture name="t" type="2d" builtin="flat" width="100000" height="100000"/>', "-60 60", ""
    ),
)
_robot(
    "a billion bodies",
    _ROBOT.format(
        "",
        "-60 60",
        "<replicate count='1000'><replicate count='1000'><replicate "
        "count='1000'><body><geom size='1'/></body></replicate></replicate></replicate>",
    ),
)
_robot("an include of a pipe", '<mujoco><include file="fifo.xml"/></mujoco>')
_robot("an include of itself", '<mujoco><include file="bomb.xml"/></mujoco>')
_robot("a mesh that is a device", _ROBOT.format('<mesh name="m" file="/dev/zero"/>', "-60 60", ""))
_robot(
    "entities of entities",
    "<!DOCTYPE r [<!ENTITY a 'x'>"
    + "".join(f"<!ENTITY a{k} '{f'&a{k - 1};' * 10}'>" for k in range(1, 12))
    + "]><mujoco>&a11;</mujoco>",
)
_robot(
    "an entity that is a file",
    "<!DOCTYPE r [<!ENTITY a SYSTEM 'file:///etc/passwd'>]><mujoco model='&a;'/>",
)
_robot("elements in elements", "<mujoco>" + "<body>" * 100_000 + "</body>" * 100_000 + "</mujoco>")
for _range in ("nan nan", "60 -60", "10 10", "inf inf", "-1e9 1e9", "0 4000", "1e-9 2e-9"):
    _robot(f"a range of {_range}", _ROBOT.format("", _range, ""))
_robot(
    "a joint name of control characters",
    _ROBOT.format("", "-60 60", "").replace('"knee"', '"k&#10;&#27;[31m"'),
)
_robot("300 joints", "<mujoco><worldbody>" + "".join(
    f"<body><joint name='j{k}' range='-60 60' limited='true'/><geom size='1'/></body>"
    for k in range(300)) + "</worldbody></mujoco>")  # fmt: skip
