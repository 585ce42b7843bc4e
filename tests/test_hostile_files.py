"""Damage of any kind to any file or frame: read, or refused in a sentence, within budgets.

One good file of every kind that a command reads is damaged byte by byte: bits flipped, pieces cut,
moved or repeated, numbers and names replaced. Every reader must answer with what it reads or with
one printable sentence that ends, and in bounded processor time and memory. `pytest
--hypothesis-profile search` tries ten times as many.
"""

import bz2
import gzip
import json
import lzma
import re
import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from pupper_sysid.data import SAMPLES
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.policies.deploy.deployment import COLUMNS as SCRIPT_COLUMNS
from pupper_sysid.policies.deploy.deployment import script
from pupper_sysid.policies.deploy.walk_log import COLUMNS as WALK_COLUMNS
from pupper_sysid.policies.deploy.walk_log import TITLE as WALK_TITLE
from pupper_sysid.policies.deploy.walk_log import read_walk
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.policies.train.run_file import load_run
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.servo_models.servo_file import load_servo_model
from pupper_sysid.sysid.plan.plan_file import load_plan, save_plan
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.importers.options import LogOptions, read_mapping
from pupper_sysid.sysid.sweep.recorder import playback
from support.limited import limited
from support.planned_servos import small_plan
from support.saved_servo_models import saved

CARDS = Path(__file__).parents[1] / "servo_models" / "cards" / "data"
EXAMPLES = max(settings.default.max_examples // 12, 1)
SOME = settings(
    max_examples=EXAMPLES,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
TIME = 0.02 * np.arange(60)
WAVE, LATE = 0.4 * np.sin(6 * TIME), 0.4 * np.sin(6 * (TIME - 0.05))


# ------------------------------------------------------------------------------------- good files


@dataclass(frozen=True)
class Kind:
    """How to write a good file, the member that is damaged, and what reads the file."""

    write: Callable[[Path], None]
    member: str
    read: Callable[[Path], Any]
    needs: str = ""
    """A library without which files of this kind are refused."""


def text(name: str, content: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(content) and None


def copied(path: Path, lines: int | None = None) -> Callable[[Path], None]:
    """A shipped file, or its first lines."""

    def write(folder: Path) -> None:
        every = path.read_text().splitlines(keepends=True)
        (folder / path.name).write_text("".join(every[:lines]))

    return write


def rows(head: str, line: Callable[[float, float, float], str]) -> str:
    triples = zip(TIME.tolist(), WAVE.tolist(), LATE.tolist(), strict=True)
    return head + "\n" + "".join(line(t, c, p) + "\n" for t, c, p in triples)


def bam(folder: Path) -> None:
    entries = [
        {"timestamp": t, "position": p, "goal_position": c, "torque_enable": True}
        for t, c, p in zip(TIME.tolist(), WAVE.tolist(), LATE.tolist(), strict=True)
    ]
    about = {"motor": "xl330", "mass": 0.1, "length": 0.1, "kp": 100, "vin": 5.0}
    (folder / "bam.json").write_text(json.dumps(about | {"entries": entries}))


def ktune(folder: Path) -> None:
    data = [
        {"time_since_start": t, "position": 57 * p, "commanded_position": 57 * c}
        for t, c, p in zip(TIME.tolist(), WAVE.tolist(), LATE.tolist(), strict=True)
    ]
    about = {"config": {"actuator_id": 3, "kp": 1.0}, "data": data}
    (folder / "ktune.json").write_text(json.dumps(about))


def npz(folder: Path) -> None:
    np.savez_compressed(folder / "log.npz", time=TIME, command=WAVE, position=LATE)


def matlab(folder: Path) -> None:
    savemat(folder / "log.mat", {"t": TIME, "cmd": WAVE, "pos": WAVE}, do_compression=True)


def npy(folder: Path) -> None:
    np.save(folder / "log.npy", np.column_stack([TIME, WAVE, LATE, np.zeros(60)]))


def tensors(folder: Path) -> None:
    import torch

    run = {"time": torch.tensor(TIME), "des_dof_pos": torch.tensor(WAVE[:, None]),
           "dof_pos": torch.tensor(LATE[:, None]), "joint_names": ["knee"]}  # fmt: skip
    torch.save(run, folder / "run.pt")


def packed(name: str, pack: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(pack(WIDE.encode())) and None


def parquet(folder: Path) -> None:
    import pyarrow
    from pyarrow import parquet as files

    columns = {"time": TIME, "knee_command": WAVE, "knee_position": LATE}
    files.write_table(pyarrow.table(columns), folder / "log.parquet")


def sage(folder: Path) -> None:
    for name, values in (("control", WAVE), ("state_motor", LATE)):
        lines = [f'X,{1e6 * t:.0f},"[{v:.6f}]"' for t, v in zip(TIME, values, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["type,timestamp,positions", *lines, ""]))
    (folder / "joint_list.txt").write_text("knee\n")


def lerobot(folder: Path) -> None:
    import pyarrow
    from pyarrow import parquet as files

    (folder / "meta").mkdir()
    (folder / "data").mkdir()
    names = {"names": ["knee.pos"], "shape": [1], "dtype": "float32"}
    info = {"codebase_version": "v3.0", "robot_type": "so101", "fps": 50,
            "features": {"action": names, "observation.state": names}}  # fmt: skip
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    columns = {"action": [[c] for c in 100 * WAVE], "observation.state": [[p] for p in 100 * LATE],
               "episode_index": np.zeros(60, int), "frame_index": np.arange(60)}  # fmt: skip
    files.write_table(pyarrow.table(columns), folder / "data" / "episode.parquet")


JOINT_STATE = "sensor_msgs/msg/JointState"


def joint_state(time_ns: int, value: float) -> bytes:
    """A `sensor_msgs/JointState` of one joint in CDR."""
    head = struct.pack("<iII", time_ns // 10**9, time_ns % 10**9, 1) + b"\0" + bytes(3)
    body = head + struct.pack("<II", 1, 5) + b"knee\0" + bytes(3) + struct.pack("<I", 1)
    body += bytes(-len(body) % 8) + struct.pack("<d", value) + bytes(8)
    return b"\x00\x01\x00\x00" + body


def messages() -> list[tuple[str, int, bytes]]:
    """Topic, log time and content of a motion."""
    found = []
    for t, c, p in zip(TIME, WAVE, LATE, strict=True):
        now = 1_700_000_000_000_000_000 + int(1e9 * t)
        found.append(("/joint_commands", now, joint_state(now, c)))
        found.append(("/joint_states", now + 10**6, joint_state(now + 10**6, p)))
    return found


def mcap(folder: Path) -> None:
    from mcap.writer import Writer

    with (folder / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(JOINT_STATE, "ros2msg", b"")
        channels = {t: writer.register_channel(t, "cdr", schema) for t, _, _ in messages()[:2]}
        for topic, time_ns, data in messages():
            writer.add_message(channels[topic], time_ns, data, time_ns)
        writer.finish()


def bag(folder: Path) -> None:
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    with sqlite3.connect(folder / "bag.db3") as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT)")
        database.execute("CREATE TABLE messages(topic_id INTEGER, timestamp INTEGER, data BLOB)")
        names = ("/joint_states", "/joint_commands")
        for n, name in enumerate(names):
            database.execute("INSERT INTO topics VALUES (?, ?, ?)", (n, name, JOINT_STATE))
        every = [(names.index(name), t, d) for name, t, d in messages()]
        database.executemany("INSERT INTO messages VALUES (?, ?, ?)", every)


def walk(folder: Path) -> None:
    header = {"schema_version": 1, "start_rad": [0.0] * 12,
              "rest": {"gravity": [0.0, 0.0, -1.0], "bias_rad_s": [0.0, 0.0, 0.0]}}  # fmt: skip
    lines = [WALK_TITLE, *(f"# {k}: {json.dumps(v)}" for k, v in header.items())]
    lines += [",".join(WALK_COLUMNS)]
    lines += [",".join([repr(t), *["0.25"] * (len(WALK_COLUMNS) - 1)]) for t in TIME[:8].tolist()]
    (folder / "walk.csv").write_text("\n".join([*lines, "# ended: time is up", ""]))


def policy(folder: Path) -> None:
    shutil.copytree(SAMPLES / "policies/mlp", folder, dirs_exist_ok=True)


WIDE = rows("time_s,knee_command,knee_position", lambda t, c, p: f"{t:.3f},{c:.6f},{p:.6f}")
GERMAN = WIDE.replace(",", ";").replace(".", ",")
SAVED = "# bench 3\n# " + WIDE.replace(",", " ")
LABELLED = rows("start", lambda t, c, p: f"time:{t:.3f},cmd:{c:.6f},pos:{p:.6f}")
DAYTIME = rows("date,cmd,pos", lambda t, c, p: f"2026-05-04T12:00:{t:06.3f},{c:.6f},{p:.6f}")
MELTED = rows("time,name,value", lambda t, c, p: f"{t:.3f},k_cmd,{c:.6f}\n{t:.3f},k_pos,{p:.6f}")
LISTS = rows("time,action,state", lambda t, c, p: f'{t:.3f},"[{c:.6f}, {p:.6f}]",[{p:.6f} {c:.6f}]')
JSON_LINES = rows("", lambda t, c, p: json.dumps({"t": t, "cmd": {"k": c}, "pos": {"k": p}}))
TABLE_JSON = json.dumps({"t": TIME.tolist(), "cmd": WAVE.tolist(), "pos": LATE.tolist()})
BY_NUMBER = LogOptions("0", "1", "2", trial="3")
LONG = rows("time,joint,goal,present_position", lambda t, c, p: f"{t:.3f},knee,{c:.6f},{p:.6f}")
MAPPING = (
    "time: time_s\ncommand: '{joint}_command'\nposition: '{joint}_position'\n"
    "joints: {knee: my_knee}\nunit: rad\nstamp: start\n"
)
KINDS = {
    "recording": Kind(copied(SAMPLES / "sweep.csv", 120), "sweep.csv", load),
    "wide table": Kind(text("log.csv", WIDE), "log.csv", load),
    "long table": Kind(text("log.csv", LONG), "log.csv", load),
    "decimal commas": Kind(text("log.csv", GERMAN), "log.csv", load),
    "names in a comment": Kind(text("log.txt", SAVED), "log.txt", load),
    "pairs of name and number": Kind(text("log.txt", LABELLED), "log.txt", load),
    "times of day": Kind(text("log.csv", DAYTIME), "log.csv", load),
    "one value a row": Kind(text("log.csv", MELTED), "log.csv", load),
    "lists in cells": Kind(text("log.csv", LISTS), "log.csv", load),
    "JSON table": Kind(text("log.json", TABLE_JSON), "log.json", load),
    "JSON Lines": Kind(text("log.jsonl", JSON_LINES), "log.jsonl", load),
    "gzip": Kind(packed("log.gz", gzip.compress), "log.gz", load),
    "bzip2": Kind(packed("log.bz2", bz2.compress), "log.bz2", load),
    "xz": Kind(packed("log.xz", lzma.compress), "log.xz", load),
    "npy": Kind(npy, "log.npy", lambda path: load(path, BY_NUMBER)),
    "torch": Kind(tensors, "run.pt", load),
    "BAM": Kind(bam, "bam.json", load),
    "ktune": Kind(ktune, "ktune.json", load),
    "npz": Kind(npz, "log.npz", load),
    "MATLAB": Kind(matlab, "log.mat", load),
    "parquet": Kind(parquet, "log.parquet", load, "pyarrow"),
    "SAGE": Kind(sage, "control.csv", lambda path: load(path.parent)),
    "LeRobot": Kind(lerobot, "meta/info.json", lambda path: load(path.parents[1]), "pyarrow"),
    "LeRobot, rows": Kind(
        lerobot, "data/episode.parquet", lambda path: load(path.parents[1]), "pyarrow"
    ),
    "MCAP": Kind(mcap, "log.mcap", load, "mcap"),
    "rosbag2": Kind(bag, "bag.db3", lambda path: load(path.parent)),
    "mapping": Kind(text("mapping.yaml", MAPPING), "mapping.yaml", read_mapping),
    "calibration": Kind(copied(SAMPLES / "calibrated.yaml"), "calibrated.yaml", load_calibration),
    "joint map": Kind(
        lambda folder: load_joint_map("mini_pupper_2").save(folder / "joints.yaml"),
        "joints.yaml", load_joint_map,
    ),
    "plan": Kind(
        lambda folder: save_plan(small_plan(), folder / "plan.yaml"), "plan.yaml", load_plan
    ),
    "servo card": Kind(
        copied(CARDS / "sts3215-bam-m6.yaml"), "sts3215-bam-m6.yaml", load_card
    ),
    "servo model": Kind(
        lambda folder: saved(folder / "servo", "fir") and None, "servo/contract.json",
        lambda path: load_servo_model(path.parent),
    ),
    "policy": Kind(policy, "contract.json", lambda path: load_policy(path.parent)),
    "weights": Kind(policy, "weights.safetensors", lambda path: load_policy(path.parent)),
    "run": Kind(policy, "run.yaml", lambda path: load_run(path.parent)),
    "walk": Kind(walk, "walk.csv", read_walk),
    "commands": Kind(copied(SAMPLES / "walk_commands.csv", 40), "walk_commands.csv", playback),
    "script": Kind(
        text("script.csv", ",".join(SCRIPT_COLUMNS) + "\n1,0.1,0,0\n2,0,0.05,0.1\n"),
        "script.csv", script,
    ),
}  # fmt: skip


# ------------------------------------------------------------------------------------------ damage

TOKENS = [
    b"nan", b".nan", b"inf", b"1e400", b"-1e308", b"1e-320", b"9" * 400, b"9" * 5000, b"4_1",
    "٤١".encode(), b"0x7f", b'"x"', b"", b"null", b"[1, 2]", b'{"a": 1}', b"true", b"NaN",
    b"-Infinity", str(2**63).encode(), b"0", b"-1", b"\x1b]0;x\x07\x1b[2J", "\u202egnp".encode(),
    b"../../../x", b"x" * 100_000, b"\0", b"\xff\xfe", b"[red]<b>", b"=cmd|' /C calc'!A0",
    b"[" * 5000, b'{"a":' * 500, b"&a [*a]", b"!!python/object/apply:os.system [x]", b"\n", b",",
    b"# a: 1\n", b"\xef\xbb\xbf", b"\r",
]  # fmt: skip
NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.])")
NAME = re.compile(rb"[A-Za-z][A-Za-z_]{2,}")


def replaced(data: bytes, pattern: re.Pattern[bytes], at: int, token: bytes) -> bytes:
    """The data with one match of a pattern replaced; unchanged where nothing matches."""
    matches = list(pattern.finditer(data))
    if not matches:
        return data
    match = matches[at % len(matches)]
    return data[: match.start()] + token + data[match.end() :]


@st.composite
def damages(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """One to three changes, which depend on no file."""
    places, tokens = st.integers(0, 2**20), st.sampled_from(TOKENS)
    way = st.tuples(
        st.sampled_from(["bit", "cut", "short", "double", "move", "insert", "number", "name"]),
        places, places, st.integers(0, 7), tokens,
    )  # fmt: skip
    changes = draw(st.lists(way, min_size=1, max_size=3))

    def apply(data: bytes) -> bytes:
        for kind, a, b, bit, token in changes:
            if not data:
                return data
            first, last = sorted((a % len(data), b % len(data)))
            if kind == "bit":
                data = data[:first] + bytes([data[first] ^ 1 << bit]) + data[first + 1 :]
            elif kind == "cut":
                data = data[:first] + data[last:]
            elif kind == "short":
                data = data[:first]
            elif kind == "double":
                data = data[:last] + data[first:]
            elif kind == "move":
                data = data[last:] + data[first:last] + data[:first]
            elif kind == "insert":
                data = data[:first] + token + data[first:]
            else:
                data = replaced(data, NUMBER if kind == "number" else NAME, a, token)
        return data

    return apply


@pytest.fixture(scope="module")
def good_files(tmp_path_factory) -> Callable[[str], Path]:
    """The damaged member of a good file of a kind, written once."""
    written: dict[str, Path] = {}

    def good(name: str) -> Path:
        if name not in written:
            folder = tmp_path_factory.mktemp("good")
            KINDS[name].write(folder)
            written[name] = folder / KINDS[name].member
            KINDS[name].read(written[name])  # raises if the good file is refused
        return written[name]

    return good


@contextmanager
def lent(good_files, name: str) -> Iterator[tuple[Path, bytes]]:
    """Path and content of a good file, which may be damaged in the block."""
    if KINDS[name].needs:
        pytest.importorskip(KINDS[name].needs)
    path = good_files(name)
    whole = path.read_bytes()
    try:
        yield path, whole
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize("name", KINDS)
@SOME
@given(damage=damages())
def test_a_damaged_file_is_read_or_refused_in_a_sentence(good_files, name, damage):
    with lent(good_files, name) as (path, whole):
        path.write_bytes(damage(whole))
        limited(lambda: KINDS[name].read(path))


@pytest.mark.parametrize("name", KINDS)
def test_what_is_no_file_of_the_kind_at_all_is_refused(good_files, name):
    with lent(good_files, name) as (path, _):
        for content in (b"", b"\n \n\t\n", bytes(range(256)) * 20, b"[" * 100_000):
            path.write_bytes(content)
            assert limited(lambda: KINDS[name].read(path))


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("SAGE", b"timestamp", b"\x1b[2Jtimestamp"),
        ("LeRobot", b"knee.pos", b"\\u001b[2J"),
        ("recording", b"send_time_s", b"\x1b[2Jsend_time_s"),
    ],
)
def test_control_characters_of_names_are_not_in_the_refusal(good_files, name, good, bad):
    with lent(good_files, name) as (path, whole):
        path.write_bytes(whole.replace(good, bad, 1))
        assert limited(lambda: KINDS[name].read(path))


# ------------------------------------------------------------------------------------------ frames
