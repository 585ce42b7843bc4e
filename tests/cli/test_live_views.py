"""Views while joints move: Rerun and MCAP files equal to the recording, traces in a terminal."""

import json
import os
import pty
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from fcntl import ioctl
from pathlib import Path
from termios import TIOCSWINSZ

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pupper_sysid.cli import live_views as module
from pupper_sysid.cli.live_views import LiveViews, ViewTargets
from pupper_sysid.cli.oscilloscope import Oscilloscope, Screen, lag_s
from pupper_sysid.cli.programs import pupper_deploy, pupper_sysid
from pupper_sysid.common.errors import InputError, SafetyStop
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.data import SAMPLES
from pupper_sysid.hardware.bus import BusSample
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.policies.deploy.walk_log import read_walk
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sim.walking.step import OBSERVATION_PARTS
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.view import channels
from support.command_line import ran, refused
from support.stopwatch import wait_until
from support.viewer_files import entities_of, topics_of

SWEEP = ("sweep", "--joints", "LF_hip,RB_calf", "--freqs", "2", "--duration", "2", "--out", "a.csv")
ROUNDED = 2e-6  # a recording's digits


def emulated() -> GuardedBus:
    rng = np.random.default_rng(3)
    return GuardedBus(EmulatedBus(draw_robot(rng), rng))


def hold(bus: GuardedBus, views, ticks: int) -> float:
    """Hold the pose for some ticks of 20 ms; returns the longest processor time of one tick [s]."""
    took = [0.0]
    pose = np.array([bus.metadata["rest_pose_rad"][j] for j in bus.joint_names])
    for _ in range(ticks):
        sent, reading = bus.write(pose), bus.read()
        began = time.thread_time()
        views.tick(0, sent, reading)
        took.append(time.thread_time() - began)
        bus.sleep_until(bus.now() + 0.02)
    return max(took)


def little_room(views) -> None:
    """Leave space for a few ticks only between the loop and its writer."""
    views._process.here.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)


def same_as_recording(found, recording, name) -> None:
    """Every channel of the recording is in what was found, at its times."""
    for channel in channels(recording):
        time_s, values = found[name(channel)]
        at = np.searchsorted(time_s, channel.time_s - 2 * ROUNDED)
        np.testing.assert_allclose(time_s[at], channel.time_s, rtol=0, atol=ROUNDED)
        known = np.isfinite(channel.values)
        np.testing.assert_allclose(
            np.ravel(values)[at][known], channel.values[known], rtol=0, atol=ROUNDED
        )


def test_a_sweep_writes_both_files_as_it_records(here, capsys):
    _, err = ran(capsys, *SWEEP, "--mcap", "a.mcap", "--rerun", "a.rrd")
    assert "Wrote a.rrd." in err and "Wrote a.mcap." in err
    assert "dropped" not in err
    recording = load(Path("a.csv"))
    topics, texts = topics_of(here / "a.mcap")
    same_as_recording(topics, recording, lambda c: (c.joint, c.name))
    entities = entities_of(here / "a.rrd")
    same_as_recording(
        {k: (t, [np.ravel(v) for v in values]) for k, (t, values) in entities.items()},
        recording, lambda c: f"/joints/{c.joint}/{c.name}|scalars",
    )  # fmt: skip
    counts = recording.metadata["completed"]["guard"]
    assert bool(texts) == any(counts[k] for k in ("clipped", "slowed", "unsent"))
    shown = entities.get("/guard|text", ([], []))[1]
    assert np.ravel(shown).tolist() == texts
    # joints that stand still are shown, too
    assert len(topics["RF_thigh", "position_rad"][0]) == 2 * len(recording.table) / 2
    # the calf that was swept turns by its amplitude, the trunk stays
    turns = {}
    for key, (times, values) in entities.items():
        if key.startswith("/robot/") and key.endswith("|quaternion"):
            assert 100 < len(times) <= 30 * np.ptp(times) + 1
            scalar = np.abs(np.squeeze(values) @ np.squeeze(values)[0])
            turns[key] = 2 * np.arccos(np.clip(scalar.min(), 0, 1))
    assert 0.2 < max(v for k, v in turns.items() if "/RB_" in k) < 0.7
    assert min(turns.values()) < 1e-3


def test_a_writer_that_stands_still_delays_no_tick_and_what_it_missed_is_counted(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(module, "_END_S", 0.5)
    monkeypatch.setattr(module, "_WAIT_S", 0.5)
    bus = emulated()
    with LiveViews(bus, ViewTargets(None, tmp_path / "a.mcap")) as views:
        os.kill(views._process.process.pid, signal.SIGSTOP)
        little_room(views)
        bus.torque(True)
        assert hold(bus, views, 300) < 0.02
        assert views.dropped > 0
        process, began = views._process.process, time.monotonic()
    assert time.monotonic() - began < 60 and process.returncode is not None
    assert "was still behind" in " ".join(capsys.readouterr().err.split())


def test_what_the_guard_changed_and_why_it_stopped_is_shown(tmp_path):
    bus = emulated()
    far = bus.limits.clip(np.full(12, 9.0)) + 1.0
    targets = ViewTargets(None, tmp_path / "a.mcap")
    with pytest.raises(SafetyStop), LiveViews(bus, targets, waits=True) as views:
        bus.torque(True)
        hold(bus, views, 3)
        views.tick(0, bus.write(far), bus.read())
        raise SafetyStop("LF_hip: it burns.")
    _, texts = topics_of(tmp_path / "a.mcap")
    assert texts[0] == "Guard: a command held at the limits."
    assert "Guard: 1 commands held at the limits." in texts and texts[-1] == "LF_hip: it burns."


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_the_files_are_whole_however_the_sweep_ends(tmp_path, number):
    words = (*SWEEP, "--duration", "30", "--real-time", "--mcap", "a.mcap", "--rerun", "a.rrd")
    process = subprocess.Popen(
        [sys.executable, "-m", pupper_sysid.__name__, *words], cwd=tmp_path,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    table = tmp_path / "a.csv"
    assert wait_until(lambda: table.exists() and table.stat().st_size > 8000, 60.0)
    if number == signal.SIGKILL:
        process.kill()
    else:
        os.killpg(process.pid, number)  # also the writer's process gets it, as at a terminal
    _, err = process.communicate(timeout=60)
    if number != signal.SIGKILL:
        assert "Wrote a.mcap." in err and process.returncode == 128 + number
    for _ in range(100):  # after SIGKILL the writer ends by itself
        try:
            topics, _ = topics_of(tmp_path / "a.mcap")
            entities = entities_of(tmp_path / "a.rrd")
            break
        except Exception:
            time.sleep(0.1)
    rows = table.read_text().count(",LF_hip,")
    assert rows > 50
    for time_s, _ in (
        topics["LF_hip", "position_rad"],
        entities["/joints/LF_hip/position_rad|scalars"],
    ):
        assert len(time_s) == pytest.approx(rows, abs=2)


@pytest.mark.slow
@pytest.mark.parametrize("missing", ["mcap_ros2", "rerun"])
def test_the_extra_is_named_where_its_libraries_are_missing(tmp_path, monkeypatch, missing):
    """The writer's process imports an empty package in the library's place."""
    (tmp_path / missing).mkdir()
    (tmp_path / missing / "__init__.py").write_text("raise ImportError\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    targets = ViewTargets(str(tmp_path / "a.rrd"), tmp_path / "a.mcap")
    with pytest.raises(InputError, match=r"pip install 'pupper-sysid\[live\]'"):
        LiveViews(emulated(), targets)
    assert [p.name for p in tmp_path.iterdir()] == [missing]


def answers(port: int) -> bool:
    with socket.socket() as asks:
        return asks.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.slow
def test_a_viewer_gets_what_a_file_would_hold(tmp_path):
    """The stored stream of Rerun's own server, in place of a window."""
    pytest.importorskip("rerun")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"rerun+http://127.0.0.1:{port}/proxy"
    server = subprocess.Popen(
        [sys.executable, "-m", "rerun", "--port", str(port), "--bind", "127.0.0.1",
         "--save", str(tmp_path / "seen.rrd")],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert wait_until(lambda: answers(port), 30.0)
        bus = emulated()
        with LiveViews(bus, ViewTargets(address, None), waits=True) as views:
            bus.torque(True)
            hold(bus, views, 100)
        time.sleep(1.0)
        server.send_signal(signal.SIGINT)
        server.wait(20)
    finally:
        server.kill()
        server.wait()
    time_s, values = entities_of(tmp_path / "seen.rrd")["/joints/RB_calf/position_rad|scalars"]
    assert len(time_s) == 100 and np.isfinite(np.ravel(values)).any()


@pytest.mark.slow
def test_monitor_writes_what_it_reads_and_sends_nothing(here, capsys):
    words = ("monitor", "--bus", "emulated", "--seconds", "1", "--mcap", "m.mcap")
    _, err = ran(capsys, *words)
    assert "Wrote m.mcap." in err and "dropped" not in err
    topics, _ = topics_of(here / "m.mcap")
    assert {joint for joint, name in topics if name == "position_rad"} == set(JOINT_NAMES)
    assert not any(name == "command_rad" for _, name in topics)  # its goals are not known
    assert 5 <= len(topics["RB_calf", "position_rad"][0]) <= 21


@pytest.mark.slow
def test_a_walk_is_written_as_it_is_recorded_with_the_trunk_as_the_imu_has_it(here, capsys):
    policy = str(SAMPLES / "policies/mlp")
    words = (policy, "--seconds", "1", "--name", "w", "--mcap", "w.mcap", "--rerun", "w.rrd")
    _, err = ran(capsys, *words, program=pupper_deploy)
    assert "Wrote w.mcap." in err and "dropped" not in err
    topics, texts = topics_of(here / "w.mcap")
    same_as_recording(topics, load(Path("walks/w/recording.csv")), lambda c: (c.joint, c.name))
    assert "Walk: time is up" in texts
    walk = read_walk(Path("walks/w/walk.csv"))
    down = walk.observation[:, OBSERVATION_PARTS["projected_gravity"]]
    entities = entities_of(here / "w.rrd")
    trunk = np.squeeze(entities["/robot/trunk|quaternion"][1])
    seen = Rotation.from_quat(trunk).inv().apply([0.0, 0.0, -1.0])
    # every pose is of a tick: the nearest direction of gravity is that of the controller
    apart = np.linalg.norm(seen[:, None] - down / np.linalg.norm(down, axis=1)[:, None], axis=2)
    assert apart.min(axis=1).max() < 1e-5 and np.ptp(seen[:, :2], axis=0).min() > 0.01
    words = (policy, "--replay", "walks/w/walk.csv", "--mcap", "again.mcap")
    assert "moves nothing" in refused(capsys, pupper_deploy, *words)


# ----- the oscilloscope: what fits the terminal, the lag it shows, and that it delays nothing


def sample(position: np.ndarray) -> BusSample:
    return BusSample(np.zeros(len(position)), position, np.zeros(len(position), int))


def screen(joints: int, moving: int, ticks: int = 300) -> Screen:
    """What a screen knows after some ticks of 20 ms."""
    made = Screen(JOINT_NAMES[:joints], "a bus with a long name", "LF_hip at 3 Hz, 9 of 80 s")
    moves = np.arange(joints) < moving
    phase = np.arange(joints)
    for time_s in 0.02 * np.arange(ticks):
        command, position = (
            np.where(moves, 0.3 * np.sin(6 * time_s - late + phase), 0.0) for late in (0.0, 0.4)
        )
        more = [np.full(joints, x) for x in (0.2, 7.4, 31.0)]
        made.take(b"S" + np.concatenate([[time_s, 2.0], command, position, *more]).tobytes())
    made.take(b"T" + json.dumps({"notes": ["overload age 12 ms count 2048"] * joints}).encode())
    return made


@pytest.mark.parametrize("joints,moving", [(1, 1), (3, 1), (12, 0), (12, 1), (12, 12)])
def test_a_frame_fits_the_terminal(joints, moving):
    drawn = screen(joints, moving)
    for width, height in ((20, 4), (40, 10), (79, 23), (119, 39), (200, 60)):
        lines = drawn.frame(width, height).plain.split("\n")
        assert len(lines) <= height
        assert max(map(len, lines)) <= width
    # those of a walking robot all fit the smallest usual terminal
    assert moving < 12 or all(j in drawn.frame(79, 23).plain for j in JOINT_NAMES)


def test_still_joints_are_a_line_each_beside_one_that_moves():
    lines = screen(12, 1).frame(79, 23).plain.split("\n")
    (first,) = [k for k, line in enumerate(lines) if line.startswith("LF_hip")]
    (second,) = [k for k, line in enumerate(lines) if "LF_thigh" in line]
    assert second - first > 10
    assert "lag 67 ms overload" in lines[first]  # 0.4 rad at 6 rad/s


@pytest.mark.parametrize("late_s", [0.02, 0.075, 0.21])
def test_the_lag_of_noisy_and_missing_readings_and_none_of_a_joint_at_rest(late_s):
    rng = np.random.default_rng(1)
    time_s = np.sort(rng.uniform(0, 10, 500))

    def wave(at: np.ndarray) -> np.ndarray:
        return 0.3 * np.sin(4 * at) + 0.1 * np.sin(9.1 * at)

    position = 0.9 * wave(time_s - late_s) + rng.normal(0, 0.005, 500)
    position[::7] = np.nan
    assert lag_s(time_s, wave(time_s), position) == pytest.approx(late_s, abs=0.004)
    at_rest = rng.normal(0, 0.002, 500)
    for rows in (500, 3):
        assert np.isnan(lag_s(time_s[:rows], np.zeros(rows), at_rest[:rows]))


def test_a_drawing_process_that_stands_still_delays_no_tick_and_one_that_died_ends_nothing():
    with Oscilloscope("bus", JOINT_NAMES) as scope:
        assert scope._process is not None
        os.kill(scope._process.process.pid, signal.SIGSTOP)
        took = []
        for k in range(5000):
            began = time.thread_time()
            scope.tick(0.02 * k, np.zeros(12), sample(np.zeros(12)))
            took.append(time.thread_time() - began)
        assert np.median(took) < 2e-4 and max(took) < 0.02
        process, began = scope._process.process, time.monotonic()
    assert time.monotonic() - began < 60 and process.returncode is not None
    with Oscilloscope("bus", JOINT_NAMES) as scope:
        assert scope._process is not None
        scope._process.process.kill()
        scope._process.process.wait()
        for k in range(50):
            scope.tick(0.02 * k, np.zeros(12), sample(np.zeros(12)))
            scope.stage(1.0, 2.0, "LF_hip")


SWEEP_OSCILLOSCOPE = (
    "sweep", "--joints", "LF_hip", "--freqs", "2", "--duration", "3", "--out", "a.csv",
)  # fmt: skip


def in_a_terminal(folder, *words: str) -> tuple[int, str]:
    """Exit code of a command in a terminal of 80 × 24, and all that it wrote to it."""
    leader, follower = pty.openpty()
    ioctl(follower, TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-m", pupper_sysid.__name__, *words], cwd=folder, stdin=follower,
        stdout=follower, stderr=follower, env=os.environ | {"TERM": "xterm-256color"},
        start_new_session=True,
    )  # fmt: skip
    os.close(follower)
    shown = b""
    while select.select([leader], [], [], 60)[0]:
        try:
            shown += os.read(leader, 65536)
        except OSError:  # the other end is closed
            break
    os.close(leader)
    return process.wait(30), shown.decode(errors="replace")


@pytest.mark.parametrize(
    "words,last",
    [((*SWEEP_OSCILLOSCOPE, "--live"), "--out calibrated.yaml"),
     pytest.param(("monitor", "--bus", "emulated", "--seconds", "2"), "", marks=pytest.mark.slow)],
    ids=["sweep", "monitor"],
)  # fmt: skip
def test_traces_are_drawn_and_the_terminal_is_left_clean(tmp_path, words, last):
    code, text = in_a_terminal(tmp_path, *words)
    assert code == 0, text
    drawn = [k for k, letter in enumerate(text) if "\u2801" <= letter <= "\u28ff"]
    assert drawn and "LF_hip" in text
    assert "\x1b[?25h" in text[drawn[-1] :]  # the cursor is shown again
    assert "\x1b[2K" in text[drawn[-1] :]  # and the traces are erased
    assert text.rstrip().endswith(last)


def test_without_a_terminal_a_live_sweep_is_a_plain_one(capsys, here):
    out, err = ran(capsys, *SWEEP_OSCILLOSCOPE, "--live")
    assert "Recorded 1" in out and "needs a terminal" in err
