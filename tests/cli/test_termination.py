"""A termination signal ends any command within a second, its worker processes with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from support.package import ROOT

SWEEP = ROOT / "data/samples/sweep.csv"
POLICY = ROOT / "data/samples/policies/mlp"
COMMANDS = {
    "delay": ("pupper_sysid", "delay", SWEEP),
    "calibrate": ("pupper_sysid", "calibrate", SWEEP, "--out", "c.yaml"),
    "analyze": ("pupper_analyze", "gait", POLICY, "--seconds", "60", "--robots", "64"),
}
WITH_WORKERS = ("delay", "calibrate")


def children(parent: int) -> list[int]:
    """Processes whose parent this is."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[1]) == parent and fields[0] != "Z":
            found.append(int(path.parent.name))
    return found


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until(true, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if true():
            return True
        time.sleep(0.02)
    return False


def cpu_s(process: int) -> float:
    """Processor time of a process [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_a_termination_signal_ends_commands_and_their_workers_within_a_second(tmp_path):
    running = {}
    try:
        for name, (program, *arguments) in COMMANDS.items():
            running[name] = subprocess.Popen(
                [sys.executable, "-m", f"pupper_sysid.cli.programs.{program}",
                 *map(str, arguments)],
                cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            )  # fmt: skip
        for name, process in running.items():
            # in the midst of it: workers are there, or torch is imported
            busy = (lambda p=process: len(children(p.pid)) >= 2) if name in WITH_WORKERS else (
                lambda p=process: p.poll() is not None or cpu_s(p.pid) > 1.5)  # fmt: skip
            assert wait_until(busy, 60), name
        time.sleep(0.3)
        for name, process in running.items():
            assert process.poll() is None, (name, process.stderr.read())
            workers = children(process.pid)
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=1.0) == -signal.SIGTERM, name  # 143 in a shell
            assert wait_until(lambda w=workers: not any(map(alive, w)), 1.0), name
            assert b"Traceback" not in process.stderr.read()
        assert list(tmp_path.iterdir()) == []  # and nothing is half written
    finally:
        for process in running.values():
            process.kill()
            process.wait()
            process.stderr.close()


def not_ignored() -> None:
    """Have Ctrl-C act, though the tests may run in the background, where a shell ignores it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def ignored() -> None:
    """As a script starts a program with `&`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@pytest.mark.wall_clock
def test_ctrl_c_stops_a_robot_that_a_script_started_in_the_background(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "pupper_sysid.cli.programs.pupper_sysid", "monitor",
         "--bus", "emulated"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=ignored,
    )  # fmt: skip
    try:
        assert process.stdout is not None and process.stdout.readline()  # it reads servos
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=10)
    finally:
        process.kill()
        process.wait()


def test_an_interrupted_calculation_does_not_wait_for_its_workers(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "pupper_sysid.cli.programs.pupper_sysid", "calibrate",
         str(SWEEP)],
        cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        preexec_fn=not_ignored,
    )  # fmt: skip
    try:
        assert wait_until(lambda: len(children(process.pid)) >= 2, 60)
        process.send_signal(signal.SIGINT)  # to it alone, as no terminal does
        _, err = process.communicate(timeout=10)
        assert process.returncode == 1 and err.strip().endswith(b"Stopped.")
    finally:
        process.kill()
        process.wait()
