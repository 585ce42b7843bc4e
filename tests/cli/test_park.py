"""`park` switches a robot off whoever holds its lock, and one that nobody drives any more."""

import ast
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest

from pupper_sysid.cli.commands import bus as scan
from pupper_sysid.cli.commands.bus import Park
from pupper_sysid.cli.programs.pupper_sysid import COMMANDS
from pupper_sysid.common.errors import SafetyStop
from pupper_sysid.hardware import loop as clock
from pupper_sysid.hardware.lock import notes, remove_note, runtime_folder, write_note
from pupper_sysid.hardware.safety import watchdog
from pupper_sysid.hardware.serial_servos import line as serial_line
from support.package import ROOT
from support.served_driver import PATIENT, drive
from support.servo_servers import driver_orders, limp, robot_behind, switched_on
from support.stopwatch import wait_until

PROGRAM = f"{PATIENT}from pupper_sysid.cli.programs.pupper_sysid import main; main()"
PARK = [sys.executable, "-c", PROGRAM, "park"]


@pytest.fixture(params=["feetech", "esp32"])
def robot(request, tmp_path, monkeypatch):
    """A served emulated robot and its address."""
    monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.1)
    with robot_behind(request.param, tmp_path) as served:
        yield served


on_esp32 = pytest.mark.parametrize(
    "robot", ["esp32", pytest.param("feetech", marks=pytest.mark.slow)], indirect=True
)


def driven(address: str) -> tuple[int, int]:
    """Process ids of a driver and its watchdog."""
    process, watchdog_id = drive(address, "hold")
    return process.pid, watchdog_id


def end(processes: tuple[int, int]) -> None:
    """Kill those that are left, before one notices that the other is gone."""
    for signalled in (signal.SIGSTOP, signal.SIGKILL):
        for number in processes[::-1]:
            with suppress(ProcessLookupError):
                os.kill(number, signalled)


def park(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*PARK, *words], cwd=ROOT, capture_output=True, text=True, timeout=60)


@on_esp32
@pytest.mark.wall_clock
def test_park_switches_off_and_names_the_program_that_drives_the_robot(robot):
    server, address = robot
    processes = driven(address)
    try:
        done = park("--bus", address)
        assert f"process {processes[0]} drives this robot" in done.stderr
        assert done.returncode == 1
        end(processes)
        again = park("--bus", address)
        assert again.returncode == 0, again.stderr
        assert limp(server) and notes() == []
    finally:
        end(processes)


@pytest.mark.slow
@on_esp32
@pytest.mark.wall_clock
def test_park_without_a_bus_switches_off_what_was_left_on_and_nothing_else(robot):
    server, address = robot
    processes = driven(address)
    try:
        for left_on in (False, True):
            if left_on:
                end(processes)
            done = park()
            assert done.returncode == 0, done.stderr
            assert ("No driver that is gone" in done.stderr) is not left_on
            assert limp(server) is left_on
        assert notes() == []
    finally:
        end(processes)


@pytest.mark.wall_clock
@pytest.mark.parametrize(
    ("robot", "number"),
    [("feetech", signal.SIGSTOP), pytest.param("esp32", signal.SIGKILL, marks=pytest.mark.slow)],
    indirect=["robot"],
)
def test_a_supervisor_switches_off_what_driver_and_watchdog_have_left_on(robot, number):
    server, address = robot
    supervisor = subprocess.Popen([*PARK, "--supervise"], cwd=ROOT, stderr=subprocess.PIPE)
    processes = driven(address)
    try:
        assert not limp(server) and len(notes()) == 1
        time.sleep(0.5)
        assert not limp(server), "it leaves a robot that is driven alone"
        for each in (signal.SIGSTOP, number):  # neither has time to notice that the other is gone
            for one in processes[::-1]:
                os.kill(one, each)
        assert wait_until(lambda: limp(server))
        assert wait_until(lambda: notes() == [])
    finally:
        end(processes)
        supervisor.send_signal(signal.SIGTERM)
        said = supervisor.communicate(timeout=60)[1].decode()
    assert "its driver was gone" in said and supervisor.returncode == 143


@on_esp32
@pytest.mark.wall_clock
def test_a_driver_that_was_stopped_with_its_watchdog_does_not_go_on(robot):
    bus = switched_on(robot[1])
    assert bus._watchdog is not None
    watchdog = bus._watchdog._process.pid
    os.kill(watchdog, signal.SIGSTOP)
    time.sleep(1.2)  # as if this process had been stopped, too
    with pytest.raises(SafetyStop, match="this process stood still for"):
        bus.write(bus.sent)
    os.kill(watchdog, signal.SIGCONT)
    bus.close()


@pytest.mark.parametrize(
    "robot", ["feetech", pytest.param("esp32", marks=pytest.mark.slow)], indirect=True
)
@pytest.mark.wall_clock
def test_a_machine_that_was_suspended_during_a_walk_does_not_go_on(robot, monkeypatch):
    bus = switched_on(robot[1])
    # an hour passes at once, and monotonic clocks stood still
    monkeypatch.setattr(watchdog, "lasting_s", lambda: clock.lasting_s() + 3600)
    with pytest.raises(SafetyStop, match="this process stood still for 3[56]"):
        bus.write(bus.sent)
    bus.close()


@pytest.fixture
def gone_for_good():
    """The note of a driver whose serial line is no more."""
    write_note(driver_orders("feetech", "/dev/pts/99999", "sts3215", 0), ["LF_hip"], 0)


def test_the_clock_of_the_watchdog_counts_while_the_machine_is_suspended(monkeypatch):
    asked = []
    monkeypatch.setattr(clock.time, "clock_gettime", lambda which: asked.append(which) or 1.0)
    assert clock.lasting_s() == 1.0 and asked == [clock.time.CLOCK_BOOTTIME]


def test_a_robot_that_is_gone_for_good_is_settled(gone_for_good, capsys):
    Park(seconds=0.1).run()
    assert notes() == [] and "gone for good; the torque of LF_hip" in capsys.readouterr().err


def test_a_supervisor_that_is_ended_has_said_what_it_switched_off(gone_for_good, monkeypatch):
    def ended(text, **_):
        assert "the torque of LF_hip" in text
        raise KeyboardInterrupt

    monkeypatch.setattr(scan.terminal.err, "print", ended)
    with pytest.raises(KeyboardInterrupt):
        Park(seconds=0.1).run()
    assert len(notes()) == 1, "it is settled only once it was said"


def test_a_note_is_removed_after_its_device_was_unplugged(tmp_path):
    link, device = tmp_path / "by-id", tmp_path / "ttyUSB0"
    link.symlink_to(device)
    write_note(driver_orders("feetech", str(link), "sts3215", os.getpid()), ["LF_hip"], os.getpid())
    (note,) = notes()
    assert note.in_control() and note.robot == str(device)
    link.unlink()
    remove_note(str(link))
    assert notes() == []


def test_a_note_that_cannot_be_read_is_left_out():
    for k, text in enumerate(("", "{", "[]", '{"map": 3}', '{"map": {}, "joints": 1}')):
        (runtime_folder() / f"{k}.on").write_text(text)
    os.mkfifo(runtime_folder() / "fifo.on")
    assert notes() == []


def test_every_command_that_opens_a_bus_is_stopped_as_by_ctrl_c():
    """`end_politely` installs the handlers; a script's `&` has SIGINT ignored."""
    openers = {
        "open_bus", "open_bus_of", "open_guarded", "connect", "Esp32Bus", "scan_line",
        "switch_off",
    }  # fmt: skip
    servers = {"SerialPty", "ProxySocket"}
    for word, command in COMMANDS.items():
        module, name = command.where.split(":")
        tree = ast.parse((ROOT / f"cli/commands/{module}.py").read_text())
        # what the class uses, and what of the module it uses, and so on
        parts = {n.name: n for n in tree.body if isinstance(n, ast.ClassDef | ast.FunctionDef)}
        parts |= {
            ast.unparse(n.targets[0]): n for n in tree.body if isinstance(n, ast.Assign)
        }  # unions
        named, waiting = set(), [name]
        while waiting:
            for node in ast.walk(parts.pop(waiting.pop(), ast.Pass())):
                if isinstance(node, ast.Name) and node.id not in named:
                    named.add(node.id)
                    waiting.append(node.id)
        assert command.holds_bus == bool(named & (openers | servers)), word
    assert "end_politely()" in (ROOT / "cli/programs/pupper_deploy.py").read_text()


@pytest.fixture(autouse=True)
def own_notes(tmp_path, monkeypatch):
    """Notes of robots that are on are those of the test."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
