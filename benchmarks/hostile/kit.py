"""A good file of every kind that a command reads, and the command that reads it."""

from __future__ import annotations

import json
import shutil
import sqlite3
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pupper_sysid.cli.programs import pupper_deploy, pupper_sysid, pupper_train
from pupper_sysid.hardware.joint_map import load_joint_map

SAMPLES = Path(__file__).parents[2] / "data" / "samples"
COUNT = 120
TIME = 0.02 * np.arange(COUNT)
WAVE = 0.4 * np.sin(6 * TIME)
LATE = 0.4 * np.sin(6 * (TIME - 0.05))


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes
    ----------
    name : str
    source : str
        File or folder in the kit.
    hit : str
        The file that is spoiled; within the source if that is a folder.
    argv : tuple of tuple of str
        Commands that read it, with the program first; `{}` is the source.
    """

    name: str
    source: str
    hit: str
    argv: tuple[tuple[str, ...], ...]


def _sysid(*words: str) -> tuple[str, ...]:
    return ("pupper_sysid", *words)


_WALK = ("--actuator", "calibrated.yaml", "--seconds", "0.2", "--name", "w")
_DEPLOY = ("pupper_deploy", "{}", *_WALK)
KINDS = (
    Kind("recording", "sweep.csv", "sweep.csv",
         (_sysid("doctor", "{}"), _sysid("export", "{}", "--to", "csv"), _sysid("bode", "{}"))),
    Kind("unfinished recording", "cut.csv", "cut.csv", (_sysid("sweep", "--resume", "{}"),)),
    Kind("table of any columns", "wide.csv", "wide.csv", (_sysid("import", "{}"),)),
    Kind("rows by joint", "long.csv", "long.csv", (_sysid("import", "{}"),)),
    Kind("sweep of the published script", "theirs.csv", "theirs.csv", (_sysid("doctor", "{}"),)),
    Kind("commands to play", "commands.csv", "commands.csv",
         (_sysid("sweep", "--playback", "{}", "--joints", "LF_hip"),)),
    Kind("script of a walk", "script.csv", "script.csv",
         (("pupper_deploy", "policy", *_WALK, "--script", "{}"),)),
    Kind("log of a walk", "walk.csv", "walk.csv",
         (("pupper_deploy", "policy", "--replay", "{}"),)),
    Kind("SAGE", "sage", "control.csv", (_sysid("import", "{}"),)),
    Kind("LeRobot, JSON", "lerobot", "meta/info.json", (_sysid("import", "{}"),)),
    Kind("LeRobot, parquet", "lerobot", "data/episode.parquet", (_sysid("import", "{}"),)),
    Kind("BAM", "bam.json", "bam.json", (_sysid("import", "{}"),)),
    Kind("ktune", "ktune.json", "ktune.json", (_sysid("import", "{}"),)),
    Kind("NumPy archive", "log.npz", "log.npz", (_sysid("import", "{}"),)),
    Kind("parquet", "log.parquet", "log.parquet", (_sysid("import", "{}"),)),
    Kind("MCAP", "log.mcap", "log.mcap", (_sysid("import", "{}"),)),
    Kind("rosbag2, SQLite", "bag", "bag.db3", (_sysid("import", "{}"),)),
    Kind("mapping", "mapping.yaml", "mapping.yaml",
         (_sysid("import", "wide.csv", "--mapping", "{}"),)),
    Kind("calibration", "calibrated.yaml", "calibrated.yaml",
         (_sysid("export", "{}", "--to", "csv"), _sysid("export", "{}", "--to", "mjcf"),
          _sysid("plan", "{}", "--joints", "LF_hip", "--seconds", "10"),
          ("pupper_play", "policy", "--seconds", "0.1", "--actuator", "{}"))),
    Kind("joint map", "joints.yaml", "joints.yaml",
         (_sysid("sweep", "--joints", "LF_hip", "--freqs", "5", "--duration", "1",
                 "--joint-map", "{}"),)),
    Kind("plan", "plan.yaml", "plan.yaml", (_sysid("sweep", "--plan", "{}"),)),
    Kind("servo card", "card.yaml", "card.yaml",
         (_sysid("servo", "show", "{}"), _sysid("servo", "diff", "{}", "sts3215-bam-m1"),
          _sysid("export", "{}", "--to", "mjcf"))),
    Kind("BAM parameters", "bam_model.json", "bam_model.json", (_sysid("servo", "show", "{}"),)),
    Kind("servo model, contract", "servo", "contract.json",
         (_sysid("compare", "sweep.csv", "--models", "{}"), _sysid("export", "{}", "--to", "csv"))),
    Kind("servo model, weights", "servo", "weights.safetensors",
         (_sysid("export", "{}", "--to", "torchscript"),)),
    Kind("policy, contract", "policy", "contract.json", (_DEPLOY,)),
    Kind("policy, weights", "policy", "weights.safetensors", (_DEPLOY,)),
    Kind("policy, run", "policy", "run.yaml", (_DEPLOY,)),
    Kind("run, settings", "run", "run.yaml",
         (("pupper_train", "--resume", "{}", "--minutes", "0.001"),)),
    Kind("run, checkpoint", "run", "last.pt",
         (("pupper_train", "--resume", "{}", "--minutes", "0.001"),)),
    Kind("run, curves", "run", "progress.csv",
         (("pupper_train", "--resume", "{}", "--minutes", "0.001"),)),
    Kind("MJCF", "robot.xml", "robot.xml", (_sysid("init-robot", "{}"),)),
    Kind("URDF", "robot.urdf", "robot.urdf", (_sysid("init-robot", "{}"),)),
)  # fmt: skip


def make_kit(folder: Path) -> None:
    """Write the good files into `folder`, which is the working directory."""
    shutil.copy(SAMPLES / "calibrated.yaml", folder)
    shutil.copy(SAMPLES / "walk_commands.csv", folder / "commands.csv")
    shutil.copytree(SAMPLES / "policies" / "mlp", folder / "policy")
    for words in (
        ("sweep", "--joints", "LF_hip", "--freqs", "1,2", "--duration", "3", "--out", "sweep.csv"),
        ("plan", "--joints", "LF_hip", "--seconds", "10", "--out", "plan.yaml"),
        ("fit-servo", "sweep.csv", "--arch", "fir", "--out", "servo"),
        ("export", "sts3215-bam-m6", "--to", "bam", "--out", "bam_model.json"),
    ):
        pupper_sysid.main(list(words))
    lines = (folder / "sweep.csv").read_text().splitlines(keepends=True)
    (folder / "cut.csv").write_text("".join(lines[:150]))
    load_joint_map("mini_pupper_2").save(folder / "joints.yaml")
    pupper_deploy.main(["policy", *_WALK])
    shutil.copy(folder / "walks" / "w" / "walk.csv", folder)
    pupper_train.main(
        [
            *"--actuator calibrated.yaml --environments 4 --iterations 2 --minutes 1".split(),
            *"--name r --threads 1 --imitation.iterations 1 --architecture.hidden 16".split(),
            *"--architecture.critic-hidden 16 --task.episode-s 0.2".split(),
            *"--learner.steps-per-environment 6 --learner.minibatches 1".split(),
        ]
    )
    shutil.move(folder / "runs" / "r", folder / "run")
    shutil.rmtree(folder / "runs")
    shutil.rmtree(folder / "walks")
    (folder / "card.yaml").write_text(_card())
    _tables(folder)
    _logs(folder)
    (folder / "robot.xml").write_text(MJCF)
    (folder / "robot.urdf").write_text(URDF)


def _card() -> str:
    from importlib import resources

    return (resources.files("pupper_sysid.servo_models.cards") / "data" / "sts3215-bam-m6.yaml"
            ).read_text()  # fmt: skip


def _tables(folder: Path) -> None:
    columns = np.stack([TIME, WAVE, LATE], axis=1)
    text = "".join(f"{t:.3f},{c:.6f},{p:.6f}\n" for t, c, p in columns)
    (folder / "wide.csv").write_text("time_s,knee_command,knee_position\n" + text)
    (folder / "long.csv").write_text(
        "time,joint,goal,present_position\n"
        + "".join(f"{t:.3f},{j},{c:.6f},{p:.6f}\n" for j in ("knee", "hip") for t, c, p in columns)
    )
    (folder / "theirs.csv").write_text(
        "time_s,phase,freq_hz,motor_idx,signal,command_rad,actual_rad\n"
        + "".join(f"{t:.3f},0,1,1,sine,{c:.6f},{p:.6f}\n" for t, c, p in columns)
    )
    (folder / "script.csv").write_text("seconds,forward_m_s,left_m_s,turn_rad_s\n1,0.1,0,0\n")
    (folder / "mapping.yaml").write_text(
        "time: time_s\ncommand: '{joint}_command'\nposition: '{joint}_position'\n"
        "joints: {knee: my_knee}\nunit: rad\nstamp: start\n"
    )
    sage = folder / "sage"
    sage.mkdir()
    for name, values in (("control", WAVE), ("state_motor", LATE)):
        rows = [f'X,{1e6 * t:.0f},"[{v:.6f}]"' for t, v in zip(TIME, values, strict=True)]
        (sage / f"{name}.csv").write_text("\n".join(["type,timestamp,positions", *rows, ""]))
    (sage / "joint_list.txt").write_text("knee\n")


def _logs(folder: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    entries = [
        {"timestamp": t, "position": p, "goal_position": c, "torque_enable": True}
        for t, c, p in zip(TIME.tolist(), WAVE.tolist(), LATE.tolist(), strict=True)
    ]
    about = {"motor": "xl330", "mass": 0.1, "length": 0.1, "kp": 100, "vin": 5.0}
    (folder / "bam.json").write_text(json.dumps(about | {"entries": entries}))
    rows = [
        {"time_since_start": t, "position": 57 * p, "commanded_position": 57 * c}
        for t, c, p in zip(TIME.tolist(), WAVE.tolist(), LATE.tolist(), strict=True)
    ]
    (folder / "ktune.json").write_text(
        json.dumps({"config": {"actuator_id": 3, "kp": 1.0}, "data": rows})
    )
    np.savez_compressed(folder / "log.npz", time=TIME, command=WAVE, position=LATE)
    columns = {"time": TIME, "knee_command": WAVE, "knee_position": LATE}
    parquet.write_table(pyarrow.table(columns), folder / "log.parquet")
    data = folder / "lerobot" / "data"
    data.mkdir(parents=True)
    (folder / "lerobot" / "meta").mkdir()
    names = {"names": ["knee.pos"], "shape": [1], "dtype": "float32"}
    (folder / "lerobot" / "meta" / "info.json").write_text(
        json.dumps({"codebase_version": "v3.0", "robot_type": "so101", "fps": 50,
                    "features": {"action": names, "observation.state": names}})
    )  # fmt: skip
    parquet.write_table(
        pyarrow.table(
            {"action": [[c] for c in 100 * WAVE], "observation.state": [[p] for p in 100 * LATE],
             "episode_index": np.zeros(COUNT, int), "frame_index": np.arange(COUNT)}
        ),
        data / "episode.parquet",
    )  # fmt: skip
    with (folder / "log.mcap").open("wb") as file:
        write_mcap(file, ros_messages())
    bag = folder / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    with sqlite3.connect(bag / "bag.db3") as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT)")
        database.execute("CREATE TABLE messages(topic_id INTEGER, timestamp INTEGER, data BLOB)")
        for n, name in enumerate(("/joint_states", "/joint_commands")):
            database.execute("INSERT INTO topics VALUES (?, ?, ?)", (n, name, JOINT_STATE))
        database.executemany(
            "INSERT INTO messages VALUES (?, ?, ?)",
            [(int(name == "/joint_commands"), t, d) for name, t, d in ros_messages()],
        )


JOINT_STATE = "sensor_msgs/msg/JointState"


def joint_state(time_ns: int, value: float) -> bytes:
    """A `sensor_msgs/JointState` of one joint in CDR."""
    head = struct.pack("<iII", time_ns // 10**9, time_ns % 10**9, 1) + b"\0" + bytes(3)
    name = struct.pack("<I", 1) + struct.pack("<I", 5) + b"knee\0" + bytes(3)
    body = head + name + struct.pack("<I", 1)
    body += bytes(-len(body) % 8) + struct.pack("<d", value) + bytes(8)
    return b"\x00\x01\x00\x00" + body


def ros_messages() -> list[tuple[str, int, bytes]]:
    """Topic, log time and content of a motion."""
    found = []
    for t, c, p in zip(TIME, WAVE, LATE, strict=True):
        now = 1_700_000_000_000_000_000 + int(1e9 * t)
        found.append(("/joint_commands", now, joint_state(now, c)))
        found.append(("/joint_states", now + 10**6, joint_state(now + 10**6, p)))
    return found


def write_mcap(file, messages: list[tuple[str, int, bytes]], chunk: int = 4096) -> None:
    """An MCAP file of messages."""
    from mcap.writer import Writer

    made = Writer(file, chunk_size=chunk)
    made.start()
    schema = made.register_schema(JOINT_STATE, "ros2msg", b"")
    channels = {
        topic: made.register_channel(topic, "cdr", schema) for topic in {m[0] for m in messages}
    }
    for topic, time_ns, data in messages:
        made.add_message(channels[topic], time_ns, data, time_ns)
    made.finish()


MJCF = """<mujoco><worldbody><body name="b"><joint name="knee" type="hinge" range="-60 60"
 limited="true"/><geom size="0.1"/></body></worldbody>
 <actuator><position joint="knee"/></actuator></mujoco>
"""
URDF = """<robot name="r"><link name="a"/><link name="b"><inertial><mass value="1"/>
 <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
 <joint name="knee" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
 <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>
"""
