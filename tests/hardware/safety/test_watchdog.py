"""A robot whose driver dies or hangs is parked by the watchdog; one that is left well is let be."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import SafetyStop
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.hardware.address import BusAddress
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.lock import LOG
from pupper_sysid.hardware.safety import watchdog_process
from pupper_sysid.hardware.safety.watchdog import Watchdog
from pupper_sysid.hardware.serial_servos import line as serial_line
from pupper_sysid.sim.emulator.bench import BusFaults
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sysid.recordings.files import load
from support.command_line import fresh_python, ran
from support.package import ROOT
from support.served_driver import PATIENT, drive
from support.servo_servers import (
    bench_of,
    driver_orders,
    limp,
    moving_servos,
    on_a_port,
    robot_behind,
    spare_this_process,
    still_servos,
    switched_on,
)
from support.stopwatch import Stopwatch

pytestmark = pytest.mark.wall_clock  # what the watchdog does within a second


@pytest.fixture(autouse=True)
def runtime(monkeypatch, tmp_path):
    """A runtime folder of the test: what the watchdogs say of vanished robots stays there."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.1)
    spare_this_process(monkeypatch)


@pytest.fixture(params=["feetech", "esp32"])
def robot(request):
    """A served emulated robot: server and address."""
    with tempfile.TemporaryDirectory(prefix="w") as name:
        with robot_behind(request.param, Path(name)) as served:
            yield served


def on_bus(*kinds: str):
    """What does not depend on the bus is tested on one of them."""
    return pytest.mark.parametrize("robot", kinds, indirect=True)


def orders_for(kind: str = "esp32", where: str = "", preset: str = "mini_pupper_2"):
    """Orders of a driver that has switched all servos on."""
    orders = watchdog_process.first_orders(driver_orders(kind, where, preset))
    orders.pose_rad = dict(DEFAULT_POSE)
    return orders


def angles(server) -> np.ndarray:
    bench, now = server.emulator.bench, server.now()
    return np.array([bench.angle(k, now) for k in range(len(JOINT_NAMES))])


def wait_for(condition, *processes: int) -> float:
    """Seconds these processes and this one took until `condition()` held; a minute at most."""
    watch, end = Stopwatch(*processes), time.monotonic() + 60.0
    took = 0.0
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.005)
        took = watch.seconds()
    return took


def test_a_killed_driver_s_robot_is_back_where_it_was_found_and_limp_within_a_second(robot):
    server, address = robot
    apart_rad = []
    while len(apart_rad) < 3 and not any(apart < 0.06 for apart in apart_rad):
        # on a busy machine the half second ends in which the watchdog may park
        found = angles(server)
        process, watchdog = drive(address)
        time.sleep(0.5)  # a quarter of its swing: farthest out
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert wait_for(lambda: limp(server), watchdog) < 1.5
        apart_rad.append(np.abs(angles(server) - found).max())
    assert min(apart_rad) < 0.06


@on_bus("esp32")
def test_a_robot_that_was_unplugged_when_it_should_go_limp_does_so_once_it_is_back(robot):
    server, address = robot
    bus = switched_on(address)
    server.emulator.unplug_for_s = 1.0
    time.sleep(0.1)
    bus.limp()
    bus.close()
    wait_for(lambda: limp(server))


@on_bus("esp32")
def test_a_hung_driver_is_ended_and_its_robot_parked(robot):
    server, address = robot
    process, watchdog = drive(address)
    time.sleep(0.5)  # a quarter of its swing: farthest out
    os.kill(process.pid, signal.SIGSTOP)
    assert wait_for(lambda: limp(server), watchdog) < 3.5
    assert process.wait(20.0) == -signal.SIGKILL
    # by the servos' clock: a busy machine may have held the driver up before it was stopped
    hip = np.array([goal for goal in server.emulator.bench.commands if goal[1] == 0])
    moved_s = hip[1:, 0][np.diff(hip[:, 2]) != 0]
    assert np.diff(moved_s).max() > 0.9, "nothing moves while the driver may still go on"


@on_bus("feetech")
def test_a_driver_that_hangs_after_a_stop_for_safety_leaves_its_robot_limp_where_it_is(robot):
    server, address = robot
    found = angles(server)
    process, _ = drive(address, "hang")
    wait_for(lambda: limp(server))
    assert np.abs(angles(server) - found).max() > 0.15
    assert process.wait(20.0) == -signal.SIGKILL


@on_bus("feetech")
def test_a_driver_that_leaves_properly_is_not_followed_by_its_watchdog(robot):
    server, address = robot
    bus = switched_on(address)
    bus.close()
    assert limp(server)
    commands = len(server.emulator.bench.commands)
    time.sleep(0.3)
    assert len(server.emulator.bench.commands) == commands


def test_a_dead_thigh_servo_does_not_keep_the_others_of_a_walking_robot_on(monkeypatch, tmp_path):
    monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.05)
    monkeypatch.setattr(watchdog_process, "_SOON_S", 2.0)
    monkeypatch.setattr(watchdog_process, "_GONE_S", 0.5)
    layout = load_joint_map("sts3215")
    there = [i for i in layout.ids if i != 5]  # LF_thigh, on which LF_calf hangs
    servos = still_servos(ids=there)
    with on_a_port(servos) as server:
        orders = orders_for("feetech", server.device, "sts3215")
        parking = threading.Thread(target=watchdog_process.park, args=(orders,))
        parking.start()
        wait_for(lambda: (tmp_path / "pupper-sysid" / LOG).exists())
    assert dict(bench_of(servos).torques) == dict.fromkeys(there, False)
    assert bench_of(servos).goals == []
    parking.join(60.0)
    assert not parking.is_alive(), "its folder is gone: it cannot come back"
    said = (tmp_path / "pupper-sysid" / LOG).read_text()
    assert "the torque of LF_thigh could not be switched off and may be on" in said
    assert "is gone for good" in said.splitlines()[-1]


def test_servos_that_hear_but_do_not_answer_go_limp():
    servos = moving_servos()
    with on_a_port(servos) as server:
        servos.faults = BusFaults({"lost": 1.0}, np.random.default_rng(0))
        orders = orders_for("feetech", server.device, "sts3215")
        parking = threading.Thread(target=watchdog_process.park, args=(orders,), daemon=True)
        parking.start()
        wait_for(lambda: limp(server))


def test_a_program_that_waits_for_the_lock_does_not_keep_the_robot_on(robot):
    server, address = robot
    process, watchdog = drive(address)
    waiting = subprocess.Popen(
        [sys.executable, "-c", WAITS_FOR_LOCK, address.split(":", 1)[1]],
        cwd=ROOT, stdout=subprocess.PIPE,
    )  # fmt: skip
    time.sleep(1.0)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    try:
        assert wait_for(lambda: limp(server), watchdog) < 4.0
        assert waiting.stdout is not None and waiting.stdout.readline() == b"held\n"
    finally:
        waiting.kill()
        waiting.wait()


WAITS_FOR_LOCK = """
import fcntl, os, sys, time
from pathlib import Path
from pupper_sysid.hardware.lock import lock_name, open_here
robot = Path(sys.argv[1])
port = robot.is_char_device()
lock = os.open(robot, os.O_RDWR | os.O_NOCTTY) if port else open_here(lock_name(robot), os.O_RDWR)
fcntl.flock(lock, fcntl.LOCK_EX)
print("held", flush=True)
time.sleep(60)
"""


@on_bus("esp32")
def test_a_watchdog_that_was_stopped_is_noticed_within_a_second(robot):
    server, address = robot
    bus = switched_on(address)
    assert bus._watchdog is not None
    stopped = bus._watchdog._process.pid
    os.kill(stopped, signal.SIGSTOP)
    watch = Stopwatch()
    try:
        pose = bus.read().position_rad
        with pytest.raises(SafetyStop, match="has not answered for 0.5 s"):
            while watch.seconds() < 5.0:
                bus.write(np.where(np.isfinite(pose), pose, bus.sent))
                bus.sleep_until(bus.now() + 0.02)
        assert watch.seconds() < 3.0
        bus.close()
        assert limp(server)
    finally:
        os.kill(stopped, signal.SIGCONT)


@pytest.mark.parametrize(
    ("robot", "number"), [("esp32", signal.SIGSTOP), ("feetech", signal.SIGKILL)],
    indirect=["robot"],
)  # fmt: skip
def test_a_robot_that_does_not_confirm_is_left_to_a_new_watchdog_if_the_old_one_is_gone(
    robot, number
):
    server, address = robot
    bus = switched_on(address)
    assert bus._watchdog is not None
    gone = bus._watchdog._process.pid
    os.kill(gone, number)
    bus.bus.torque = lambda on: False  # type: ignore[method-assign]  # nothing is confirmed
    with suppress(SafetyStop):
        while True:
            bus.sleep_until(bus.now() + 0.2)
    bus.close()
    try:
        assert bus._watchdog._process.pid != gone
        wait_for(lambda: limp(server))
    finally:
        with suppress(ProcessLookupError):
            os.kill(gone, signal.SIGCONT)


def test_beats_to_a_watchdog_that_reads_nothing_never_wait():
    lost = Watchdog(BusAddress("esp32", "/tmp/none"), load_joint_map("mini_pupper_2"))
    os.kill(lost._process.pid, signal.SIGSTOP)
    try:
        watch = Stopwatch()
        for _ in range(2000):
            lost._send({"registers": {"LF_hip": dict.fromkeys(map(str, range(20)), 1)}})
        assert watch.seconds() < 2.0
    finally:
        lost._process.kill()
        lost._process.wait()


def test_servos_that_do_not_say_that_they_are_limp_are_asked_until_they_do(monkeypatch):
    asked: list[bool] = []

    class Deaf(EmulatedBus):
        def torque(self, on: bool) -> bool:
            asked.append(on)
            return super().torque(on) and (on or len(asked) > 45)

    rng = np.random.default_rng(0)
    servos = draw_robot(rng)
    monkeypatch.setattr(watchdog_process, "open_bus", lambda *of, **how: Deaf(servos, rng))
    orders = orders_for()
    watchdog_process.park(orders)
    assert len(asked) > 45 and not asked[-1]


def test_half_a_message_is_no_reason_to_leave_a_robot():
    orders = orders_for()
    orders.take(b'{"arm": {"LF_hip": 0.1}}')
    orders.take(b'{"regis')
    assert orders.pose_rad == {"LF_hip": 0.1} and orders.only_limp and not orders.done


def test_only_a_line_that_cannot_come_back_is_given_up():
    for where, comes in (("/dev/ttyUSB0", True), ("/dev/pts/7", False), ("/nowhere/at/all", False)):
        assert watchdog_process.can_come_back(BusAddress("feetech", where)) is comes


def test_a_driver_without_its_watchdog_does_not_go_on(here):
    # files in the user's folder do not stand in for the watchdog's modules: it starts
    for name in ("json.py", "common.py"):
        (here / name).write_text("raise SystemExit\n")
    lost = Watchdog(BusAddress("esp32", "/tmp/none"), load_joint_map("mini_pupper_2"))
    lost._process.kill()
    lost._process.wait()
    with pytest.raises(SafetyStop, match="the watchdog process has ended"):
        lost.beat()
    lost.close()


def test_the_watchdog_process_starts_without_the_heavy_libraries():
    heavy = "{'torch', 'matplotlib', 'pandas', 'scipy', 'mujoco', 'control', 'numba'}"
    code = f"import sys, {watchdog_process.__name__}; print({heavy} & set(sys.modules))"
    assert fresh_python(code) == "set()\n"


SWEEP = f"{PATIENT}\nfrom pupper_sysid.cli.programs.pupper_sysid import main\nmain()"


@on_bus("feetech")
def test_a_terminated_sweep_parks_the_robot_itself_and_can_be_resumed(robot, tmp_path, capsys):
    server, address = robot
    path = tmp_path / "a.csv"
    # at 20 Hz a busy machine keeps up
    words = ("sweep", "--joints", "LF_hip", "--freqs", "3", "--duration", "2", "--rate", "20")
    process = subprocess.Popen(
        [sys.executable, "-c", SWEEP, *words, "--bus", address, "--out", str(path)],
        cwd=ROOT, stderr=subprocess.PIPE,
    )  # fmt: skip
    wait_for(lambda: path.exists() and path.read_text().count("LF_hip,") > 25)
    process.terminate()
    said = process.communicate(timeout=60)[1].decode()
    assert process.returncode == 143 and "Stopped." in said and "Traceback" not in said
    # on a serial line only the named joint is driven, and so only it is let go
    assert not server.emulator.bench.is_on(JOINT_NAMES.index("LF_hip"))
    assert "completed" not in load(path).metadata
    ran(capsys, *words, "--resume", path)
    assert "completed" in load(path).metadata
