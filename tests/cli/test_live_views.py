"""Rerun and MCAP while joints move: files equal to the recording, finished however it ends."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pupper_sysid.cli import live_views as module
from pupper_sysid.cli.live_views import Wanted, live_views
from pupper_sysid.cli.programs import pupper_deploy, pupper_sysid
from pupper_sysid.common.errors import InputError, SafetyStop
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.policies.deploy.walk_log import read_walk
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sim.walking.observation import OBSERVATION_PARTS
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.view.channels import channels
from support.command_line import run, run_program
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


def test_a_sweep_writes_both_files_as_it_records(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, _, err = run(capsys, *SWEEP, "--mcap", "a.mcap", "--rerun", "a.rrd")
    assert code == 0 and "Wrote a.rrd." in err and "Wrote a.mcap." in err
    assert "dropped" not in err
    recording = load(Path("a.csv"))
    topics, texts = topics_of(tmp_path / "a.mcap")
    same_as_recording(topics, recording, lambda c: (c.joint, c.name))
    entities = entities_of(tmp_path / "a.rrd")
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
    with live_views(bus, Wanted(None, tmp_path / "a.mcap")) as views:
        os.kill(views._process.process.pid, signal.SIGSTOP)
        little_room(views)
        bus.torque(True)
        assert hold(bus, views, 300) < 0.01
        assert views.dropped > 0
        process, began = views._process.process, time.monotonic()
    assert time.monotonic() - began < 15 and process.returncode is not None
    assert "was still behind" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_ticks_that_were_dropped_are_counted_and_the_others_are_whole(tmp_path, capsys):
    bus = emulated()
    with live_views(bus, Wanted(None, tmp_path / "a.mcap")) as views:
        bus.torque(True)
        os.kill(views._process.process.pid, signal.SIGSTOP)
        little_room(views)
        hold(bus, views, 300)
        os.kill(views._process.process.pid, signal.SIGCONT)
        assert (dropped := views.dropped) > 0
        time.sleep(0.5)
        hold(bus, views, 2)
    topics, _ = topics_of(tmp_path / "a.mcap")
    time_s, _ = topics["LF_hip", "position_rad"]
    assert len(time_s) == 302 - dropped
    assert f"{dropped} ticks were dropped" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_a_bus_in_virtual_time_waits_for_the_writer(tmp_path):
    bus = emulated()
    with live_views(bus, Wanted(None, tmp_path / "a.mcap"), waits=True) as views:
        little_room(views)
        bus.torque(True)
        hold(bus, views, 300)
        assert views.dropped == 0
    assert len(topics_of(tmp_path / "a.mcap")[0]["LF_hip", "position_rad"][0]) == 300


def test_what_the_guard_changed_and_why_it_stopped_is_shown(tmp_path):
    bus = emulated()
    far = bus.limits.clip(np.full(12, 9.0)) + 1.0
    wanted = Wanted(None, tmp_path / "a.mcap")
    with pytest.raises(SafetyStop), live_views(bus, wanted, waits=True) as views:
        bus.torque(True)
        hold(bus, views, 3)
        views.tick(0, bus.write(far), bus.read())
        raise SafetyStop("LF_hip: it burns.")
    _, texts = topics_of(tmp_path / "a.mcap")
    assert texts[0] == "Guard: a command held at the limits."
    assert "Guard: 1 commands held at the limits." in texts and texts[-1] == "LF_hip: it burns."


@pytest.mark.slow
def test_unknown_commands_and_silent_servos_are_left_out(tmp_path):
    bus = emulated()
    with live_views(bus, Wanted(None, tmp_path / "a.mcap"), waits=True) as views:
        bus.torque(True)
        sent, reading = bus.write(bus.read().position_rad), bus.read()
        limp = replace(sent, position_rad=np.full(12, np.nan))
        silent = replace(reading, position_rad=np.where(np.arange(12), 0.1, np.nan))
        views.tick(0, limp, silent)
    topics, _ = topics_of(tmp_path / "a.mcap")
    assert not any(name == "command_rad" for _, name in topics)
    assert np.isnan(topics["LF_hip", "position_rad"][1]).all()
    assert topics["LF_thigh", "position_rad"][1] == [0.1]


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGKILL,
        *(pytest.param(n, marks=pytest.mark.slow) for n in (signal.SIGINT, signal.SIGTERM)),
    ],
)
def test_the_files_are_whole_however_the_sweep_ends(tmp_path, number):
    words = (*SWEEP, "--duration", "30", "--real-time", "--mcap", "a.mcap", "--rerun", "a.rrd")
    process = subprocess.Popen(
        [sys.executable, "-m", pupper_sysid.__name__, *words], cwd=tmp_path,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    table = tmp_path / "a.csv"
    until = time.monotonic() + 60
    while time.monotonic() < until and not (table.exists() and table.stat().st_size > 8000):
        time.sleep(0.1)
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


def test_what_is_there_is_not_replaced_and_what_is_missing_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("mine.mcap").write_text("mine")
    for options, sentence in [
        (("--mcap", "mine.mcap"), "mine.mcap exists already"),
        (("--mcap", "b.csv"), "must end in .mcap"),
        (("--rerun", "b.csv"), "ends in .rrd, the word viewer, or"),
        (("--mcap", "b.mcap", "--until", "dead_time:2ms"), "--until makes several recordings"),
    ]:
        code, _, err = run(capsys, *SWEEP, *options)
        assert code == 2 and sentence in err
    assert [p.name for p in tmp_path.iterdir()] == ["mine.mcap"]
    assert Path("mine.mcap").read_text() == "mine"


@pytest.mark.slow
def test_a_file_is_replaced_by_force_and_a_viewer_that_does_not_answer_is_named(tmp_path, capsys):
    path = tmp_path / "mine.mcap"
    path.write_text("mine")
    bus = emulated()
    with live_views(bus, Wanted(None, path, force=True), waits=True) as views:
        bus.torque(True)
        hold(bus, views, 1)
    assert topics_of(path)[0]
    code, _, err = run(capsys, *SWEEP, "--rerun", "rerun+http://127.0.0.1:1/proxy")
    assert code == 2 and "No Rerun viewer answers" in err


@pytest.mark.parametrize("missing", ["mcap_ros2", pytest.param("rerun", marks=pytest.mark.slow)])
def test_the_extra_is_named_where_its_libraries_are_missing(tmp_path, monkeypatch, missing):
    """The writer's process imports an empty package in the library's place."""
    (tmp_path / missing).mkdir()
    (tmp_path / missing / "__init__.py").write_text("raise ImportError\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    wanted = Wanted(str(tmp_path / "a.rrd"), tmp_path / "a.mcap")
    with pytest.raises(InputError, match=r"pip install 'pupper-sysid\[live\]'"):
        module.LiveViews(emulated(), wanted, False)
    assert [p.name for p in tmp_path.iterdir()] == [missing]


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
        until = time.monotonic() + 30
        while time.monotonic() < until:
            with socket.socket() as asks:
                if asks.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        bus = emulated()
        with live_views(bus, Wanted(address, None), waits=True) as views:
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
def test_monitor_writes_what_it_reads_and_sends_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ("monitor", "--bus", "emulated", "--seconds", "1", "--mcap", "m.mcap")
    code, _, err = run(capsys, *words)
    assert code == 0 and "Wrote m.mcap." in err and "dropped" not in err
    topics, _ = topics_of(tmp_path / "m.mcap")
    assert {joint for joint, name in topics if name == "position_rad"} == set(JOINT_NAMES)
    assert not any(name == "command_rad" for _, name in topics)  # its goals are not known
    assert 5 <= len(topics["RB_calf", "position_rad"][0]) <= 21
    code, _, err = run(capsys, *words, "--force", "--once")
    assert code == 2 and "Give one of the two" in err


@pytest.mark.slow
def test_a_walk_is_written_as_it_is_recorded_with_the_trunk_as_the_imu_has_it(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    policy = str(Path(__file__).parents[2] / "data/samples/policies/mlp")
    words = (policy, "--seconds", "1", "--name", "w", "--mcap", "w.mcap", "--rerun", "w.rrd")
    code, _, err = run_program(capsys, pupper_deploy, *words)
    assert code == 0 and "Wrote w.mcap." in err and "dropped" not in err
    topics, texts = topics_of(tmp_path / "w.mcap")
    same_as_recording(topics, load(Path("walks/w/recording.csv")), lambda c: (c.joint, c.name))
    assert "Walk: time is up" in texts
    walk = read_walk(Path("walks/w/walk.csv"))
    down = walk.observation[:, OBSERVATION_PARTS["projected_gravity"]]
    entities = entities_of(tmp_path / "w.rrd")
    trunk = np.squeeze(entities["/robot/trunk|quaternion"][1])
    seen = Rotation.from_quat(trunk).inv().apply([0.0, 0.0, -1.0])
    # every pose is of a tick: the nearest direction of gravity is that of the controller
    apart = np.linalg.norm(seen[:, None] - down / np.linalg.norm(down, axis=1)[:, None], axis=2)
    assert apart.min(axis=1).max() < 1e-5 and np.ptp(seen[:, :2], axis=0).min() > 0.01
    words = (policy, "--replay", "walks/w/walk.csv", "--mcap", "again.mcap")
    code, _, err = run_program(capsys, pupper_deploy, *words)
    assert code == 2 and "moves nothing" in err
