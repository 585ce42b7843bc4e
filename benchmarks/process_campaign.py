"""What happens to a robot when its driver, its watchdog or both are killed, stopped or starved, and
when its line or a servo fails?

    .venv/bin/python benchmarks/process_campaign.py --repeats 3 --seed 0
    .venv/bin/python benchmarks/process_campaign.py --bus xl330-m288      # one of its robots

An emulated robot runs in this process behind each real protocol. A driver in a process of its own,
with its watchdog, swings all joints; at a random moment something happens to one of the two or to
both. Measured is the time until no servo has torque, from then (from the start of `park` where it
is called by hand), and whether any gets it again. Scenarios in which neither of the two can do
anything are those for which `pupper-sysid park` exists; a pause of less than the two tolerate must
not end a drive. Afterwards every register of a servo must hold what it held before, but those of
its state. Exits with 1 if one did not end as it should.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from shared import print_rows  # isort: skip

import numpy as np
import tyro

from pupper_sysid.hardware.address import KINDS as KINDS_OF_BUS
from pupper_sysid.hardware.dynamixel import SERIES
from pupper_sysid.hardware.feetech import STS3215
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.lock import lock_name, runtime_folder
from pupper_sysid.sim.emulator.bench import ServoBench
from pupper_sysid.sim.emulator.dynamixel import DynamixelEmulator
from pupper_sysid.sim.emulator.esp32 import ProxyEmulator, ProxySocket
from pupper_sysid.sim.emulator.feetech import FeetechEmulator
from pupper_sysid.sim.emulator.robot import RobotSpec, draw_robot
from pupper_sysid.sim.emulator.serial_line import LineEmulator, SerialPty
from pupper_sysid.sim.robot.robot_map import joint_map_of_servos
from support.servo_servers import let_go, limp

Server = SerialPty | ProxySocket
PARK = [sys.executable, "-m", "pupper_sysid.cli.programs.pupper_sysid", "park"]
DYNAMIXELS = {"xl330-m288": 1200, "xm430-w350": 1020}
"""Model numbers by name."""
KINDS = ("feetech", "esp32", *DYNAMIXELS)
PATIENCE_S, AFTER_S, SWINGS_S = 12.0, 0.7, (0.3, 1.0)
RESTORED_WITHIN_S = 6.0
STATE = {
    "goal_position", "torque_enable", "moving", "hardware_error_status", "status", "lock",
    "goal_time",
}  # fmt: skip
"""Registers, beside the present ones, that a drive leaves otherwise."""
OVERLOAD = 32
HEADROOM = 2 << 20
"""Memory that a starved process may still take [bytes]."""

PROGRAM = """
import fcntl, os, signal, sys, termios, time
from pathlib import Path
import numpy as np
from pupper_sysid.cli.program import end_politely
from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.safety.guard import open_guarded
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.hardware.safety import watchdog

address, layout, says, tty = sys.argv[1:5]
if tty:
    fcntl.ioctl(os.open(tty, os.O_RDWR), termios.TIOCSCTTY, 0)
chosen = load_joint_map(Path(layout)).per_servo() if layout else None
bus = open_guarded(parse_address(address), chosen)

held = []

def hoard(*_):
    while True:  # what it holds is never given back
        held.append(bytearray(50_000))

def fill(*_):
    for _ in range(3000):
        bus._watchdog.restore({})

def sleep_an_hour(*_):
    awake = watchdog.lasting_s
    watchdog.lasting_s = lambda: awake() + 3600

def talk(*_):
    global talks
    talks = True

talks = False
for number, handler in ((signal.SIGUSR1, hoard), (signal.SIGUSR2, fill),
                        (signal.SIGRTMIN, sleep_an_hour), (signal.SIGRTMIN + 1, talk)):
    signal.signal(number, handler)
end_politely()
try:
    pose = bus.read().position_rad
    while not np.isfinite(pose).all():
        pose = bus.read().position_rad
    for _ in range(20):  # servos that share a busy machine with their driver answer too late
        try:
            bus.torque(True)
            break
        except BusError:
            pass
    with real_time_priority():
        start = bus.now()
        os.write(int(says), b"%d\\n" % bus._watchdog._process.pid)
        while True:
            bus.write(pose + 0.2 * np.sin(2 * np.pi * 0.5 * (bus.now() - start)))
            bus.read()
            if talks:
                print("x" * 4000, flush=True)
            bus.sleep_until(bus.now() + 0.02)
finally:
    bus.close()
"""


@dataclass
class Drive:
    """A driven robot."""

    server: Server
    where: str
    driver: subprocess.Popen
    watchdog: int
    master: int
    """The terminal's other end, for a driver that has one."""
    held: ExitStack
    """Processes and files to end afterwards."""
    injected_s: float = 0.0

    @property
    def both(self) -> tuple[int, int]:
        """Process ids, the watchdog first: the driver notices its end later than the reverse."""
        return self.watchdog, self.driver.pid


Fault = Callable[[Drive], object]
KILL, STOP, GO_ON = signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT
HOARD, FILL, HOUR, TALK = (
    signal.SIGUSR1, signal.SIGUSR2, signal.SIGRTMIN, signal.SIGRTMIN + 1,
)  # fmt: skip
LIMP, GOES_ON = "limp", "goes on"


@dataclass(frozen=True)
class Scenario:
    """A fault of one process or both, and what should follow."""

    process: str
    what: str
    inject: Fault
    expected: str = LIMP
    supervised: bool = False
    terminal: bool = False
    serial: bool = False
    """Whether it is a fault of a serial line's emulator."""


def send(drive: Drive, number: int, *processes: int) -> None:
    """Send a signal; both get it before either can notice."""
    drive.injected_s = time.monotonic()
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, number)


def to_driver(number: int) -> Fault:
    return lambda drive: send(drive, number, drive.driver.pid)


def to_watchdog(number: int) -> Fault:
    return lambda drive: send(drive, number, drive.watchdog)


def to_both(number: int) -> Fault:
    """A signal to both, stopped before so that neither notices the other's end."""
    return lambda drive: [send(drive, n, *drive.both) for n in (STOP, number)]


def in_turn(first: Fault, seconds: float, second: Fault) -> Fault:
    """One fault, and another some time later; time counts from the first."""

    def inject(drive: Drive) -> None:
        first(drive)
        injected_s = drive.injected_s
        time.sleep(seconds)
        second(drive)
        drive.injected_s = injected_s

    return inject


def lock_wanted(then: Fault) -> Fault:
    """Another process waits for the robot's lock, and gets it when the driver ends."""

    def inject(drive: Drive) -> None:
        kind, _, where = drive.where.partition(":")
        serial = KINDS_OF_BUS[kind].is_serial
        lock = where if serial else str(runtime_folder() / lock_name(Path(where)))
        waiting = subprocess.Popen(["flock", "-x", lock, "sleep", "30"], start_new_session=True)
        drive.held.callback(lambda: os.killpg(waiting.pid, signal.SIGKILL))
        time.sleep(0.2)
        then(drive)

    return inject


def starved(then: Fault, driver: bool, watchdog: bool) -> Fault:
    """Without memory beyond what they have (`ulimit -v`)."""

    def inject(drive: Drive) -> None:
        for wanted, process in ((driver, drive.driver.pid), (watchdog, drive.watchdog)):
            if wanted:
                pages = int(Path(f"/proc/{process}/statm").read_text().split()[0])
                most = pages * resource.getpagesize() + HEADROOM
                resource.prlimit(process, resource.RLIMIT_AS, (most, most))
        then(drive)

    return inject


def hang_up(drive: Drive) -> None:
    """The terminal is closed."""
    drive.injected_s = time.monotonic()
    os.close(drive.master)
    drive.master = -1


def parked_by_hand(drive: Drive) -> None:
    """Both are killed, and `park` is called."""
    to_both(signal.SIGKILL)(drive)
    time.sleep(1.0)
    drive.injected_s = time.monotonic()
    drive.held.enter_context(subprocess.Popen(PARK, stderr=subprocess.DEVNULL))


def short(to: Callable[[int], Fault], seconds: float) -> Fault:
    """Stopped for some time."""
    return in_turn(to(STOP), seconds, to(GO_ON))


def on_the_line(fault: Callable[[LineEmulator, float], object]) -> Fault:
    """A fault of the line or of its servos, from now on."""

    def inject(drive: Drive) -> None:
        drive.injected_s = time.monotonic()
        emulator = drive.server.emulator
        assert isinstance(emulator, LineEmulator)
        fault(emulator, drive.server.now())

    return inject


UNPLUGGED = on_the_line(lambda line, now: setattr(line, "unplug_for_s", 1.5))
BROWN_OUT = on_the_line(lambda line, now: line.brown_out(now, 1.0))
OVERLOADED = on_the_line(lambda line, now: line.fail(min(line.servos), now, OVERLOAD, 60.0))

DRIVER, WATCHDOG, BOTH = "driver", "watchdog", "both"
SCENARIOS = (
    Scenario(DRIVER, "SIGINT (Ctrl-C)", to_driver(signal.SIGINT)),
    Scenario(DRIVER, "SIGTERM", to_driver(signal.SIGTERM)),
    Scenario(DRIVER, "SIGKILL", to_driver(KILL)),
    Scenario(DRIVER, "SIGSTOP", to_driver(STOP)),
    Scenario(DRIVER, "SIGSTOP, SIGCONT after 0.2 s", short(to_driver, 0.2), GOES_ON),
    Scenario(DRIVER, "SIGSTOP, SIGCONT after 2 s", short(to_driver, 2.0)),
    Scenario(DRIVER, "SIGKILL, lock taken", lock_wanted(to_driver(KILL))),
    Scenario(DRIVER, "SIGSTOP, lock taken", lock_wanted(to_driver(STOP))),
    Scenario(DRIVER, "standard output full", to_driver(TALK)),
    Scenario(DRIVER, "out of memory", starved(to_driver(HOARD), True, False)),
    Scenario(DRIVER, "terminal closed", hang_up, terminal=True),
    Scenario(DRIVER, "its machine was suspended: clock + 1 h", to_driver(HOUR)),
    Scenario(WATCHDOG, "SIGKILL", to_watchdog(KILL)),
    Scenario(WATCHDOG, "SIGSTOP", to_watchdog(STOP)),
    Scenario(WATCHDOG, "SIGSTOP, SIGCONT after 0.2 s", short(to_watchdog, 0.2), GOES_ON),
    Scenario(WATCHDOG, "SIGSTOP, SIGCONT after 2 s", short(to_watchdog, 2.0)),
    Scenario(WATCHDOG, "SIGKILL, lock taken", lock_wanted(to_watchdog(KILL))),
    Scenario(WATCHDOG, "SIGSTOP, pipe full", in_turn(to_watchdog(STOP), 0.0, to_driver(FILL))),
    Scenario(WATCHDOG, "out of memory, driver SIGKILL", starved(to_driver(KILL), False, True)),
    Scenario(WATCHDOG, "SIGSTOP for 2 s, driver SIGKILL",
             in_turn(to_driver(KILL), 0.05, short(to_watchdog, 2.0))),
    Scenario(BOTH, "SIGSTOP for 3 s (machine suspended)", short(to_both, 3.0)),
    Scenario(BOTH, "out of memory", starved(to_driver(HOARD), True, True)),
    Scenario(BOTH, "SIGKILL, supervised", to_both(KILL), supervised=True),
    Scenario(BOTH, "SIGSTOP, supervised", to_both(STOP), supervised=True),
    Scenario(BOTH, "SIGKILL, lock taken, supervised", lock_wanted(to_both(KILL)), supervised=True),
    Scenario(BOTH, "SIGKILL, then `park`", parked_by_hand),
    Scenario("line", "cable pulled for 1.5 s", UNPLUGGED, serial=True),
    Scenario("line", "brown-out of 1 s", BROWN_OUT, serial=True),
    Scenario("servo", "overload, reported by one", OVERLOADED, serial=True),
)  # fmt: skip


@contextmanager
def driven(server: Server, where: str, layout: str, scenario: Scenario) -> Iterator[Drive | None]:
    """A driver and its watchdog, in the midst of a swing; None if it did not begin."""
    reads, writes = os.pipe()
    master, tty = os.openpty() if scenario.terminal else (-1, -1)
    with ExitStack() as held:
        if scenario.supervised:
            supervisor = subprocess.Popen([*PARK, "--supervise"], stderr=subprocess.PIPE)
            assert supervisor.stderr is not None
            supervisor.stderr.readline()  # it watches
            held.callback(supervisor.wait)
            held.callback(supervisor.kill)
        driver = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, where, layout, str(writes),
             os.ttyname(tty) if tty >= 0 else ""],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, pass_fds=[writes],
            start_new_session=True,
        )  # fmt: skip
        os.close(writes)
        if tty >= 0:
            os.close(tty)
        with os.fdopen(reads, "rb") as pipe:
            line = pipe.readline()
        drive = Drive(server, where, driver, int(line or 0), master, held)
        try:
            yield drive if line else None
        finally:
            for one in drive.both[line == b"" :]:
                for number in (STOP, KILL):
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(one, number)
            if drive.master >= 0:
                os.close(drive.master)
            driver.communicate()


@contextmanager
def served(kind: str, seed: int) -> Iterator[tuple[Server, str, str]]:
    """A running server of one emulated robot, the address of its bus, and its joint map's file.

    The file is empty where the map needs no name.
    """
    rng = np.random.default_rng(seed)
    # read directly, a servo answers for the very moment: no polls in between, none lost
    direct = RobotSpec(
        poll_period_s=0.0, loss=0.0, quantum_rad=0.0, reading_noise_rad=float(np.pi / 4096)
    )
    model = DYNAMIXELS.get(kind)
    if model:
        ids = {f"joint_{k}": k for k in range(1, 7)}
        layout = joint_map_of_servos(ids, kind).joint_map
    else:
        layout = load_joint_map("mini_pupper_2" if kind == "esp32" else "sts3215")
    robot = draw_robot(rng, RobotSpec() if kind == "esp32" else direct, layout if model else None)
    bench = ServoBench(robot, layout, rng.spawn(1)[0])
    with tempfile.TemporaryDirectory(prefix="robot") as name:
        path, named = Path(name) / "bus", Path(name) / "map.yaml"
        if kind == "esp32":
            server = ProxySocket(ProxyEmulator(bench, rng), path)
        elif model:
            layout.save(named)
            bench.supply_v = 5.0 if kind.startswith("xl330") else 12.0
            server = SerialPty(DynamixelEmulator(bench, SERIES[model], rng), path)
        else:
            server = SerialPty(FeetechEmulator(bench, STS3215, rng), path)
        thread = threading.Thread(target=server.serve, daemon=True)
        thread.start()
        if thread.native_id:
            with contextlib.suppress(OSError, AttributeError):  # servos are no program
                how = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
                os.sched_setscheduler(thread.native_id, how, os.sched_param(10))
        try:
            bus = "dynamixel" if model else kind
            yield server, f"{bus}:{path}", str(named) if model else ""
        finally:
            server.stop()
            thread.join(5.0)
            server.close()


def registers(server) -> dict[tuple[int, str], int]:
    """Registers of all servos that a drive must leave as they were; none behind the proxy."""
    emulator = server.emulator
    if not isinstance(emulator, LineEmulator):
        return {}
    names = [n for n in emulator.series.registers if not n.startswith("present") and n not in STATE]
    return {
        (servo, name): emulator.series.decode(name, bytes(memory.memory))
        for servo, memory in emulator.servos.items()
        for name in names
    }


def repaired(server, found: dict[tuple[int, str], int]) -> None:
    """Servos that are limp, without errors, and have these registers."""
    emulator = server.emulator
    let_go(server)
    if isinstance(emulator, LineEmulator):
        for (servo, name), value in found.items():
            emulator._set(servo, name, value)
        for servo, memory in emulator.servos.items():
            memory.faulty_until, memory.overloaded, memory.stopped = -np.inf, False, False
            emulator._set(servo, "torque_enable", 0)
            if emulator.series.has("hardware_error_status"):
                emulator._set(servo, "hardware_error_status", 0)


class Outcome(NamedTuple):
    limp_s: float  # from the fault to the last torque; infinite where the drive goes on
    on_again: bool
    restored: bool
    as_expected: bool


def once(
    server: Server, where: str, layout: str, scenario: Scenario, rng: np.random.Generator
) -> Outcome | None:
    """One repeat; None if the busy machine ended the drive before anything happened."""
    found = registers(server)
    repaired(server, found)
    with driven(server, where, layout, scenario) as drive:
        if drive is not None:
            time.sleep(float(rng.uniform(*SWINGS_S)))
        if drive is None or limp(server) or drive.driver.poll() is not None:
            repaired(server, found)
            return None
        at, limp_s = threading.Event(), np.inf

        def watch() -> None:
            nonlocal limp_s
            while not at.is_set() and not limp(server):
                time.sleep(0.002)
            limp_s = time.monotonic() if limp(server) else np.inf

        watcher = threading.Thread(target=watch)
        watcher.start()  # a pause ends after the robot may be limp
        scenario.inject(drive)
        watcher.join(2.0 if scenario.expected == GOES_ON else PATIENCE_S)
        at.set()
        watcher.join()
        time.sleep(AFTER_S)
        ended = bool(np.isfinite(limp_s))
        again, running = ended and not limp(server), drive.driver.poll() is None
        until, restored = time.monotonic() + RESTORED_WITHIN_S, True
        while ended and not (restored := registers(server) == found) and time.monotonic() < until:
            time.sleep(0.05)
        right = ended == (scenario.expected == LIMP) and not again and restored
    repaired(server, found)
    return Outcome(limp_s - drive.injected_s, again, restored, right and (ended or running))


def main(repeats: int = 3, seed: int = 0, bus: Literal["", *KINDS] = "", only: str = "") -> None:
    """Print a table of one robot or all, of the scenarios whose name has `only`."""
    rows = failed = 0
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under `nohup` drivers would ignore it, too

    def table() -> Iterator[list[object]]:
        nonlocal rows, failed
        for kind in [bus] if bus else KINDS:
            with served(kind, seed) as (server, where, layout):
                for number, scenario in enumerate(SCENARIOS):
                    name = f"{scenario.process} {scenario.what}"
                    if only not in name or (scenario.serial and kind == "esp32"):
                        continue
                    rng, done, undriven = np.random.default_rng([seed, number]), [], 0
                    while len(done) < repeats:
                        outcome = once(server, where, layout, scenario, rng)
                        undriven += outcome is None
                        done += [outcome] if outcome else []
                        if undriven > 20:
                            raise SystemExit(f"{kind}: no drive begins on this machine.")
                    times = [o.limp_s for o in done if np.isfinite(o.limp_s)]
                    right = sum(o.as_expected for o in done)
                    rows, failed = rows + 1, failed + repeats - right
                    yield [
                        kind, scenario.process, scenario.what,
                        f"{np.median(times):.2f} ({max(times):.2f})" if times else GOES_ON,
                        sum(o.on_again for o in done), sum(o.restored for o in done),
                        f"{right} of {repeats}", undriven,
                    ]  # fmt: skip

    with tempfile.TemporaryDirectory(prefix="runtime") as runtime:
        os.environ["XDG_RUNTIME_DIR"] = runtime
        print_rows(
            ("bus", "process", "what happens", "limp after s, median (worst)", "on again",
             "registers as before", "as it should", "drives ended before by the load"), table(),
        )  # fmt: skip
    load = " ".join(f"{x:.1f}" for x in os.getloadavg())
    print(
        f"\n{rows} scenarios, {rows * repeats} runs, {failed} did not end as they should. "
        f"Load of the machine: {load}."
    )
    sys.exit(failed > 0)


if __name__ == "__main__":
    tyro.cli(main)
