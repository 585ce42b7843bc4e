"""The lock of a robot: in a folder of the user's own, never through a link, never waiting."""

import fcntl
import os
import socket
import stat
import subprocess
import sys

import pytest

from pupper_sysid.cli.commands import bus as scan_command
from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.lock import (
    acquire,
    announced,
    announced_devices,
    open_here,
    runtime_folder,
)
from support.command_line import json_of
from support.servo_servers import on_a_port, still_servos


@pytest.fixture(autouse=True)
def runtime(tmp_path, monkeypatch):
    folder = tmp_path / "runtime"
    folder.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder / "pupper-sysid"


def test_the_folder_is_the_users_own_and_no_link(runtime, tmp_path, monkeypatch):
    assert runtime_folder() == runtime
    assert stat.S_IMODE(runtime.stat().st_mode) == 0o700
    runtime.chmod(0o777)
    with pytest.raises(BusError, match="only you can write to"):
        runtime_folder()
    runtime.rmdir()
    (tmp_path / "elsewhere").mkdir()
    runtime.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BusError, match="is not a folder that only you"):
        runtime_folder()
    monkeypatch.setenv("XDG_RUNTIME_DIR", "relative")  # as good as none
    assert runtime_folder().name == f"pupper-sysid-{os.getuid()}"


def test_a_fifo_or_a_dangling_link_in_the_locks_place_is_answered_at_once(runtime, tmp_path):
    runtime_folder()
    os.mkfifo(runtime / "fifo")
    (runtime / "link").symlink_to(tmp_path / "made")
    for name in ("fifo", "link"):
        with pytest.raises(BusError, match="Remove it"):
            open_here(name, os.O_RDWR)
    assert not (tmp_path / "made").exists()


def test_one_owner_at_a_time_whatever_the_path_is_called(tmp_path):
    robot = tmp_path / "robot.sock"
    robot.touch()
    (tmp_path / "alias").symlink_to(robot)
    held = acquire(robot)
    with pytest.raises(BusError, match="another pupper-sysid is driving"):
        acquire(tmp_path / "alias")
    os.close(held)
    os.close(acquire(tmp_path / "alias"))


def test_a_child_that_inherits_the_lock_keeps_it(tmp_path):
    """As flock does: so nothing that must not wait may need it."""
    robot = tmp_path / "robot.sock"
    held = acquire(robot)
    os.set_inheritable(held, True)
    child = subprocess.Popen(["cat"], close_fds=False, stdin=subprocess.PIPE)
    os.close(held)
    try:
        with pytest.raises(BusError):
            acquire(robot)
    finally:
        child.communicate()
    again = acquire(robot)
    fcntl.flock(again, fcntl.LOCK_UN)
    os.close(again)


def test_an_emulated_line_is_a_port_for_as_long_as_its_program_runs(tmp_path):
    announce = f"""
import sys
from {announced.__module__} import announced
with announced(sys.argv[1]):
    print(flush=True)
    sys.stdin.read()
"""
    with on_a_port(still_servos(ids=[1])) as server:
        for end in ("communicate", "kill"):  # a killed one cannot remove its file
            process = subprocess.Popen(
                [sys.executable, "-c", announce, server.device],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
            assert process.stdout and process.stdout.readline()
            assert server.device in scan_command.serial_ports()
            getattr(process, end)()
            process.communicate()
            assert announced_devices() == []
    assert not list(runtime_folder().glob("*.emulated"))


def test_scan_names_the_socket_of_an_emulated_proxy(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("serial.tools.list_ports.comports", list)
    monkeypatch.setattr(scan_command, "SOCKET", tmp_path / "none")
    with socket.socket(socket.AF_UNIX) as proxy, announced(tmp_path / "proxy"):
        proxy.bind(str(tmp_path / "proxy"))
        assert json_of(capsys, "scan")["proxy"] == str(tmp_path / "proxy")
