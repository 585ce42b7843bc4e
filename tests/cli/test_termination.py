"""Ctrl-C, SIGTERM and SIGHUP: one line, the exit code, nothing left, at any moment.

`benchmarks/stop_anywhere.py` does the same at random moments of real commands.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pupper_sysid.data import SAMPLES
from support.stopwatch import wait_until

SWEEP = SAMPLES / "sweep.csv"
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")

PROGRAM = """
from pupper_sysid.common.processes.stop import finishing, stop_process
stop_process()
import hashlib, os, time, weakref
from pathlib import Path
from pupper_sysid.cli.program import begin_work, end_politely, user_errors
from pupper_sysid.common.files import hold_output, replacing
from pupper_sysid.common.processes.workers import Workers

def begin():
    print("begun", flush=True)

def wait(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass

def pool():
    with Workers(2) as workers:
        workers.submit("", time.sleep, 60)
        workers.submit("", time.sleep, 60)
        begin()
        list(workers.results())

def swallowed():
    class Thing: pass
    begin()
    while True:
        thing = Thing()
        reference = weakref.ref(thing, lambda _: wait(0.3))
        del thing

def caught():
    begin()
    while True:
        try:
            time.sleep(60)
        except BaseException:
            pass

def compiled():
    begin()
    hashlib.pbkdf2_hmac("sha256", b"a", b"b", 10**9)

def passed_on():
    begin()
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        raise RuntimeError("cannot join thread before it is started")

def writing():
    with replacing(Path("result.txt")) as file:
        file.write_text("half")
        begin()
        time.sleep(60)

def training():
    with finishing(lambda text: os.write(2, f"{text}\\n".encode())) as stop_requested:
        begin()
        while not stop_requested():
            time.sleep(0.1)
        Path("saved").touch()

def long_training():
    with finishing(lambda text: os.write(2, f"{text}\\n".encode())):
        begin()
        time.sleep(60)

def robot():
    end_politely()
    try:
        begin()
        time.sleep(60)
    finally:
        time.sleep(1.2)  # longer than a program may take without a robot
        Path("parked").touch()

with user_errors([], "pupper-sysid"):
    begin_work()
    hold_output(Path("runs/run"))
    WORK()
"""


@contextmanager
def started(folder: Path, *command: str) -> Iterator[subprocess.Popen[bytes]]:
    """A program in a session of its own, in which nothing is left afterwards."""
    process = subprocess.Popen(
        [sys.executable, *command], cwd=folder, start_new_session=True, preexec_fn=not_ignored,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        with process:
            yield process
    finally:
        for left in session(process.pid):
            os.kill(left, signal.SIGKILL)


def not_ignored() -> None:
    """Have Ctrl-C act, though the tests may run in the background, where a shell ignores it."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL)


def ignored() -> None:
    """As a script starts a program with `&`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def session(leader: int) -> list[int]:
    """Processes of a session that have not ended."""
    processes = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[3]) == leader and fields[0] != "Z":
            processes.append(int(path.parent.name))
    return processes


@contextmanager
def begun(folder: Path, work: str) -> Iterator[subprocess.Popen[bytes]]:
    """`PROGRAM` at its work."""
    with started(folder, "-c", PROGRAM.replace("WORK", work)) as process:
        assert process.stdout is not None and process.stdout.readline() == b"begun\n"
        yield process


def ended(process: subprocess.Popen[bytes]) -> tuple[int, str]:
    """Exit code and stderr of a program that has ended with all its processes."""
    _, err = process.communicate(timeout=60)
    assert wait_until(lambda: session(process.pid) == [], 30.0)
    return process.returncode, err.decode()


@pytest.mark.parametrize("number", SIGNALS)
def test_a_stop_is_one_line_and_its_exit_code_and_leaves_no_process(tmp_path, number):
    with begun(tmp_path, "pool") as process:
        time.sleep(0.05 * number % 0.3)  # while the workers start, and after
        os.killpg(process.pid, number)
        assert ended(process) == (128 + number, "Stopped.\n")


@pytest.mark.parametrize(
    ("work", "number", "left"),
    [
        ("swallowed", signal.SIGINT, []),
        ("caught", signal.SIGINT, []),
        ("compiled", signal.SIGINT, []),
        ("passed_on", signal.SIGINT, []),
        ("writing", signal.SIGINT, []),
        ("long_training", signal.SIGTERM, []),  # whose iteration outlasts it
        ("robot", signal.SIGTERM, ["parked"]),  # however long that takes
    ],
)
def test_no_code_keeps_a_stop_from_ending_a_program(tmp_path, work, number, left):
    with begun(tmp_path, work) as process:
        time.sleep(0.05)
        process.send_signal(number)
        assert ended(process) == (128 + number, "Stopped.\n")
    assert [path.name for path in tmp_path.iterdir()] == left


def test_training_saves_after_the_first_ctrl_c_and_ends_at_once_after_the_second(tmp_path):
    first = "finishing this iteration; again ends at once\n"
    with begun(tmp_path, "training") as process:
        os.killpg(process.pid, signal.SIGINT)
        process.send_signal(signal.SIGINT)  # as torchrun passes on what its group has received
        assert ended(process) == (130, first)
    with begun(tmp_path, "long_training") as process:
        process.send_signal(signal.SIGINT)
        assert process.stderr is not None and process.stderr.readline() == first.encode()
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        assert ended(process) == (130, "Stopped.\n")
    assert [path.name for path in tmp_path.iterdir()] == ["saved"]  # nor the lock file of the run


def test_ctrl_c_acts_while_the_libraries_are_imported(tmp_path):
    program = "pupper_sysid.cli.programs.pupper_sysid"
    with started(tmp_path, "-X", "importtime", "-m", program, "delay", str(SWEEP)) as process:
        assert process.stderr is not None
        while b"tyro._strings" not in process.stderr.readline():
            pass
        os.killpg(process.pid, signal.SIGINT)
        code, err = ended(process)
        assert code == 130 and err.endswith("Stopped.\n") and "Traceback" not in err


def test_ctrl_c_at_the_terminal_stops_a_calibration_whose_processes_start(tmp_path):
    program = "pupper_sysid.cli.programs.pupper_sysid"
    with started(tmp_path, "-m", program, "calibrate", str(SWEEP)) as process:
        assert wait_until(lambda: len(session(process.pid)) >= 2, 60.0)
        os.killpg(process.pid, signal.SIGINT)
        assert ended(process) == (130, "Stopped.\n")
    assert list(tmp_path.iterdir()) == []


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
        process.communicate(timeout=60)
        assert process.returncode == 130
    finally:
        process.kill()
        process.wait()
