"""The oscilloscope: what fits the terminal, the lag it shows, and that it delays nothing."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import struct
import subprocess
import sys
import time
from fcntl import ioctl
from termios import TIOCSWINSZ

import numpy as np
import pytest

from pupper_sysid.cli.oscilloscope import Oscilloscope, Screen, braille, lag_s
from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.hardware.bus import BusSample
from support.command_line import run


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


def test_all_twelve_joints_of_a_walking_robot_fit_the_smallest_usual_terminal():
    shown = screen(12, 12).frame(79, 23).plain
    assert all(joint in shown for joint in JOINT_NAMES)


def test_still_joints_are_a_line_each_beside_one_that_moves():
    lines = screen(12, 1).frame(79, 23).plain.split("\n")
    (first,) = [k for k, line in enumerate(lines) if line.startswith("LF_hip")]
    (second,) = [k for k, line in enumerate(lines) if "LF_thigh" in line]
    assert second - first > 10
    assert "lag 67 ms overload" in lines[first]  # 0.4 rad at 6 rad/s


def test_before_the_first_reading_the_screen_says_what_it_waits_for():
    assert "waiting for the servos" in Screen(("a",)).frame(60, 10).plain


@pytest.mark.parametrize("late_s", [0.02, 0.075, 0.21])
def test_the_lag_of_noisy_and_missing_readings(late_s):
    rng = np.random.default_rng(1)
    time_s = np.sort(rng.uniform(0, 10, 500))

    def wave(at: np.ndarray) -> np.ndarray:
        return 0.3 * np.sin(4 * at) + 0.1 * np.sin(9.1 * at)

    position = 0.9 * wave(time_s - late_s) + rng.normal(0, 0.005, 500)
    position[::7] = np.nan
    assert lag_s(time_s, wave(time_s), position) == pytest.approx(late_s, abs=0.004)


def test_a_joint_at_rest_has_no_lag():
    time_s = 0.02 * np.arange(300)
    noise = np.random.default_rng(0).normal(0, 0.002, 300)
    assert np.isnan(lag_s(time_s, np.zeros(300), noise))
    assert np.isnan(lag_s(time_s[:3], np.zeros(3), noise[:3]))


def test_dots_are_where_the_points_are():
    cells = braille(np.array([0.0, 1.0, 2.0, np.nan]), np.array([0.0, 1.0, 0.5, 0.5]), 4, 2)
    assert cells[1, 0] == 0x40 and cells[0, 3] == 0x08 and np.count_nonzero(cells) == 2


def test_a_drawing_process_that_stands_still_delays_no_tick():
    with Oscilloscope("bus", JOINT_NAMES) as scope:
        assert scope._process is not None
        os.kill(scope._process.process.pid, signal.SIGSTOP)
        took = []
        for k in range(5000):
            began = time.thread_time()
            scope.tick(0.02 * k, np.zeros(12), sample(np.zeros(12)))
            took.append(time.thread_time() - began)
        assert np.median(took) < 2e-4 and max(took) < 0.01
        process, began = scope._process.process, time.monotonic()
    assert time.monotonic() - began < 10 and process.returncode is not None


def test_a_drawing_process_that_died_ends_nothing():
    with Oscilloscope("bus", JOINT_NAMES) as scope:
        assert scope._process is not None
        scope._process.process.kill()
        scope._process.process.wait()
        for k in range(50):
            scope.tick(0.02 * k, np.zeros(12), sample(np.zeros(12)))
            scope.stage(1.0, 2.0, "LF_hip")


SWEEP = ("sweep", "--joints", "LF_hip", "--freqs", "2", "--duration", "1.5", "--out", "a.csv")


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
    [((*SWEEP, "--live"), "--out calibrated.yaml"),
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


def test_without_a_terminal_a_live_sweep_is_a_plain_one(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *SWEEP, "--live")
    assert code == 0 and "Recorded 1" in out and "needs a terminal" in err
