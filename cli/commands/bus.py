"""The servos on a bus: `scan` and `monitor` read them, `park` switches a robot's torque off."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group
from rich.text import Text

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import chosen_map, say_remarks
from pupper_sysid.cli.live_views import LiveViews, ViewTargets
from pupper_sysid.cli.terminal import Json, Replace, number
from pupper_sysid.common.errors import BusError, InputError, PupperError, refuse_outside
from pupper_sysid.hardware.address import (
    EMULATED,
    KINDS,
    SOCKET,
    BusAddress,
    bus_name,
    parse_address,
)
from pupper_sysid.hardware.bus import BusSample, Sent, ServoBus, error_words
from pupper_sysid.hardware.esp32 import Esp32Bus
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.lock import Note, announced_devices, notes
from pupper_sysid.hardware.safety.guard import open_bus
from pupper_sysid.hardware.safety.watchdog import HANG_S
from pupper_sysid.hardware.safety.watchdog_process import (
    can_come_back,
    is_there,
    may_be_on,
    restore,
    switch_off,
)
from pupper_sysid.hardware.serial_servos.scan import LineReport
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import draw_robot

if TYPE_CHECKING:
    from pupper_sysid.cli.oscilloscope import Oscilloscope

_SERVO_PORTS = ("ttyUSB", "ttyACM", "ttyAMA", "ttySC", "cu.usb", "COM")


@dataclass(frozen=True)
class Scan:
    """List the servos on a bus: id, model, firmware, voltage, temperature, limits, error bits.

    Without --bus it lists the serial ports and the lines of `emulate`, tries every protocol and
    rate on each, and says what answers where. Nothing moves and nothing is written.
    Example: pupper-sysid scan --bus feetech:/dev/ttyUSB0
    """

    bus: str | None = None
    """feetech:DEVICE, dynamixel:DEVICE (with @BAUD if known) or esp32; by default every serial port
    is tried."""
    json: Json = False

    def run(self) -> None:
        """Scan, and print a table."""
        if self.bus is None:
            self._everywhere()
            return
        address = parse_address(self.bus)
        kind = KINDS[address.kind]
        if not kind.is_serial:
            self._proxy(Path(address.where))
            return
        with terminal.progress("scanning", 0) as advance:
            report = kind.bus_class().scan_address(address, advance)
        if self.json:
            return terminal.print_json(_as_data(report))
        self._show(report)

    def _show(self, report: LineReport) -> None:
        servos, n = report.servos, number
        terminal.print_table(
            f"{len(servos)} servo{'' if len(servos) == 1 else 's'} at {report.family}:"
            f"{report.device}, {report.baud} baud",
            "id", "model", "firmware", "volt", "°C", "count", "limits", "P D I", "errors",
            rows=(
                (
                    s.id, s.model, s.firmware or "–", n(s.voltage_v, 1), n(s.temperature_c, 0),
                    n(s.count, 0), "–" if s.limits is None else f"{s.limits[0]}–{s.limits[1]}",
                    "–" if s.gains is None else " ".join(map(str, s.gains)), s.errors or "none",
                )
                for s in servos
            ),
        )  # fmt: skip
        terminal.warn(*(fault for servo in servos for fault in servo.faults))
        for remark in report.remarks:
            terminal.err.print(remark)

    def _everywhere(self) -> None:
        """Try all serial ports, and the proxy's socket."""
        ports = serial_ports()
        with terminal.progress("scanning", 0) as advance:
            answers = {device: _scanned(device, advance) for device in ports}
        reports = [a for a in answers.values() if isinstance(a, LineReport)]
        silent = {device: a for device, a in answers.items() if isinstance(a, str)}
        proxies = [path for path in (SOCKET, *announced_devices()) if path.is_socket()]
        proxy = next(iter(proxies), None)
        if self.json:
            lines = [_as_data(report) for report in reports]
            scanned = {"ports": ports, "lines": lines, "silent": silent}
            return terminal.print_json(scanned | {"proxy": proxy})
        for report in reports:
            self._show(report)
            terminal.out.print(f"Use it with --bus {report.family}:{report.device}")
        for device, why in silent.items():
            terminal.err.print(f"{device}: {why}")
        if proxy:
            name = "esp32" if proxy == SOCKET else f"esp32:{proxy}"
            terminal.out.print(f"A Mini Pupper 2's proxy is here: --bus {name}")
        if not reports and not proxy:
            listed = ", ".join(ports) or "none"
            raise BusError(
                f"no servo answers at any serial port (ports: {listed}). Connect the servos' USB "
                "adapter and their power, and look again; without a robot, start `pupper-sysid "
                "emulate feetech`."
            )

    def _proxy(self, path: Path) -> None:
        bus = Esp32Bus(path)
        try:
            sample = bus.read()
        finally:
            bus.close()
        assert sample.voltage_v is not None and sample.load is not None
        volts = float(sample.voltage_v[0])
        rows = [
            {"joint": name, "count": int(count), "load": float(load)}
            for name, count, load in zip(
                bus.joint_names, sample.position_count, sample.load, strict=True
            )
        ]
        if self.json:
            return terminal.print_json({"voltage_v": volts, "servos": rows})
        terminal.print_table(
            f"the proxy at {path}, {number(volts, 1)} V", "joint", "count", "load %",
            rows=(
                (row["joint"], "silent" if row["count"] < 0 else row["count"],
                 number(100 * row["load"], 0))
                for row in rows
            ),
        )  # fmt: skip
        terminal.err.print(
            "The proxy reports neither model nor temperature; counts are the firmware's calibrated "
            "ones."
        )


def serial_ports() -> list[str]:
    """Serial ports to which a servo adapter may be connected, and lines of emulators."""
    from serial.tools.list_ports import comports

    ports = (Path(port.device) for port in comports())
    paths = [path for path in ports if path.name.startswith(_SERVO_PORTS)] + announced_devices()
    return sorted(str(path) for path in paths if os.name == "nt" or path.is_char_device())


def _scanned(device: str, advance: Callable[[str], None]) -> LineReport | str:
    """What answers at a port, by any protocol; or why nothing does, in words."""
    serial = [kind for kind in KINDS.values() if kind.is_serial]
    for kind in serial:
        try:
            return kind.bus_class().scan_address(
                BusAddress(kind.name, device), lambda what: advance(f"{device}, {what}")
            )
        except (BusError, InputError) as error:
            if "cannot be opened" in str(error):
                return str(error)
    names = " and ".join(kind.servos for kind in serial)
    return f"nothing answers as {names} servos do, at any of their rates."


def _as_data(report: LineReport) -> dict[str, object]:
    return {
        "bus": f"{report.family}:{report.device}", "baud": report.baud,
        "servos": [asdict(servo) for servo in report.servos], "remarks": report.remarks,
    }  # fmt: skip


_AGAIN_S, _LOOK_S = 0.1, 0.2
_OTHERS_WAIT_S = 1.0


@dataclass(frozen=True)
class Park:
    """Switch the torque of all servos off; nothing else is sent, and the legs go limp at once.

    It needs no lock. Without --bus: every robot that a driver of this user has left on, and whose
    driver and watchdog have both ended or are stopped. With --supervise it waits for such robots.
    Example: pupper-sysid park --bus esp32
    """

    bus: str | None = None
    """esp32 (on the robot), feetech:DEVICE or dynamixel:DEVICE; by default every robot that was
    left on."""
    joint_map: str | None = None
    """Joint map: a file or a preset; by default joints.yaml if it is here, else every servo of a
    serial line is switched off."""
    seconds: float = 10.0
    """Try for so long until every servo has confirmed."""
    supervise: bool = False
    """Go on until Ctrl-C: switch off every robot that is left on, from now on."""

    def run(self) -> None:
        """Switch off, or wait for robots that are to be."""
        terminal.need_positive("--seconds", self.seconds)
        if self.bus is not None:
            if self.supervise:
                raise InputError("--supervise finds the robots itself; leave --bus out.")
            self._named(parse_address(self.bus))
            return
        if self.joint_map:
            raise InputError("--joint-map is of one robot: add its --bus.")
        if not os.path.exists("/proc/self/stat"):
            raise InputError("`park` without --bus needs Linux, whose /proc says what runs.")
        if self.supervise:
            self._supervise()
            return
        abandoned = [note for note in notes() if not note.in_control()]
        if not all([_take(note, self.seconds) for note in abandoned]):
            raise BusError("Not every robot that was left on could be switched off.")
        if not abandoned:
            terminal.err.print("No driver that is gone left a robot on; --bus names another.")

    def _named(self, address: BusAddress) -> None:
        unconfirmed = _until_limp(address, chosen_map(self.joint_map), None, self.seconds)
        if unconfirmed:
            raise BusError(f"{address.where}: {may_be_on(unconfirmed)}")
        terminal.err.print("Every servo confirmed that its torque is off.")
        for note in notes():
            if note.robot != os.path.realpath(address.where):
                continue
            if note.in_control():
                raise BusError(
                    f"process {note.driver} drives this robot and may switch the torque on again. "
                    f"Stop it: `kill {note.driver}`."
                )
            restore(note.address, note.joint_map, note.registers)
            note.remove()

    def _supervise(self) -> None:
        terminal.err.print("Watching over the robots of this user.")
        since_s: dict[tuple[tuple[int, int], ...], float] = {}
        tried: set[tuple[tuple[int, int], ...]] = set()
        while True:
            abandoned = {note.processes: note for note in notes() if not note.in_control()}
            now = time.monotonic()
            since_s = {driver: since_s.get(driver, now) for driver in abandoned}
            for driver, note in abandoned.items():
                # a driver that was stopped for a shorter time resumes, and would switch on again
                if now - since_s[driver] > HANG_S:
                    _take(note, min(self.seconds, _OTHERS_WAIT_S), say=driver not in tried)
                    tried.add(driver)
            time.sleep(_LOOK_S)


def _take(note: Note, seconds: float, say: bool = True) -> bool:
    """Switch a robot off that was left on; whether that is settled."""
    where, on = note.address.where, list(note.joints)
    try:
        on = _until_limp(note.address, note.joint_map, note.joints, seconds)
        outcome = may_be_on(on) if on else "its driver was gone; its torque was switched off."
        settled = not on
    except PupperError as error:
        outcome, settled = str(error), False
    if not settled and not is_there(note.address) and not can_come_back(note.address):
        outcome, settled = f"gone for good; {may_be_on(note.joints)}", True
    if settled or say:
        terminal.err.print(f"{where}: {outcome}")
    if not on:
        restore(note.address, note.joint_map, note.registers)
    if settled:  # last: an interrupt before it repeats the message and loses nothing
        note.remove()
    return settled


def _until_limp(
    address: BusAddress, joint_map: JointMap | None, joints: tuple[str, ...] | None, seconds: float
) -> list[str]:
    """Try for some seconds; joints that did not confirm.

    An error of the bus is raised if nothing was reached and the joints are not known.
    """
    until, unconfirmed = time.monotonic() + seconds, list(joints or ())
    while True:
        failed: PupperError | None = None
        try:
            unconfirmed = switch_off(address, joint_map, unconfirmed or None)
            if not unconfirmed:
                return []
        except PupperError as error:
            failed = error
        if time.monotonic() > until:
            if failed and not unconfirmed:
                raise failed
            return unconfirmed
        time.sleep(_AGAIN_S)


_RATES_HZ = (0.1, 1000.0)
_ONCE_S = 0.3  # voltage and temperature are not in every reply
_GOALS_EVERY_S = 1.0  # one request per servo, and only another program could change them
_PLAIN_EVERY_S = 1.0


@dataclass(frozen=True)
class Monitor:
    """Show every servo: goal position, position, load, voltage, temperature, errors.

    It only reads: no command is sent and no torque is switched. Ctrl-C ends it. In a terminal
    positions and goals are traces, else a table is printed each second. Angles are each
    servo's own, as in a sweep: a calf's is given as if its thigh were at its neutral.
    Example: pupper-sysid monitor --bus feetech:/dev/ttyUSB0
    """

    bus: str
    """esp32 (on the robot), feetech:DEVICE, dynamixel:DEVICE, or emulated."""
    joint_map: str | None = None
    """Joint map: a file or a preset; by default joints.yaml if it is here, else the preset that
    fits the bus."""
    rate: float = 20.0
    """Readings per second."""
    seconds: float | None = None
    """End after this long [s]; by default only with Ctrl-C."""
    rerun: str | None = None
    """Show all joints and the robot in Rerun, too: a .rrd file to write, `viewer` (of this
    machine), or a viewer's address, rerun+http://HOST:9876/proxy."""
    mcap: Path | None = None
    """Write all joints in ROS 2's messages for Foxglove, too, .mcap."""
    force: Replace = False
    once: bool = False
    """Print one table and end."""
    json: bool = False
    """Print one JSON object and nothing else, and end."""

    def run(self) -> None:
        """Read and show until the end."""
        refuse_outside("--rate", self.rate, *_RATES_HZ, "Hz")
        if self.seconds is not None:
            terminal.need_positive("--seconds", self.seconds)
        targets = ViewTargets(self.rerun, self.mcap, self.force)
        if targets and (self.once or self.json):
            raise InputError(
                "--once and --json print one table, and --rerun and --mcap show what follows. "
                "Give one of the two."
            )
        targets.check()
        bus = _open(self.bus, self.joint_map)
        try:
            watched = Watched(bus)
            if not (self.once or self.json):
                self._show(watched, targets)
                return
            for _ in watched.readings(self.rate, _ONCE_S if self.seconds is None else self.seconds):
                pass
            name = bus_name(self.bus)
            if self.json:
                of_map = {key: bus.metadata.get(key) for key in ("joint_map", "coordinates")}
                terminal.print_json({"bus": name, "joints": watched.rows()} | of_map)
            else:
                terminal.out.print(watched.table(name))
        finally:
            bus.close()

    def _show(self, watched: Watched, targets: ViewTargets) -> None:
        """Traces in a terminal, else tables; and what other viewers show."""
        from pupper_sysid.cli.oscilloscope import Oscilloscope

        name, joints, shown_s = bus_name(self.bus), watched.bus.joint_names, -np.inf
        with ExitStack() as stack:
            views = stack.enter_context(LiveViews(watched.bus, targets)) if targets else None
            scope = None
            if terminal.err.is_terminal:
                scope = stack.enter_context(Oscilloscope(f"{name}, only read", joints, lag=False))
            for _ in watched.readings(self.rate, np.inf if self.seconds is None else self.seconds):
                if views:
                    views.tick(0, *watched.tick())
                if scope:
                    watched.draw(scope)
                elif watched.now_s - shown_s >= _PLAIN_EVERY_S:
                    shown_s = watched.now_s
                    terminal.out.print(watched.table(name))


class Watched:
    """A bus that is only read, and the age of each joint's reading.

    A serial servo answers with its present position, so the age of a reading is the time since its
    last reply. The proxy and the emulated robot return stale readings without a time stamp: for
    those it is the time since the value last changed, which is long for a joint at rest.
    """

    def __init__(self, bus: ServoBus):
        self.bus = bus
        self.answers_now = bus.metadata.get("readings") == "live"
        joints = len(bus.joint_names)
        self.now_s = self._start_s = bus.now()
        self._seen_s = np.full(joints, np.nan)
        self._has_changed = np.zeros(joints, bool)
        self._position, self._goal = np.full((2, joints), np.nan)
        self._count = np.full(joints, -1)
        self._here = np.zeros(joints, bool)
        self._goal_s = -np.inf
        self._sample: BusSample | None = None
        self._latest = dict(
            zip(("voltage_v", "temperature_c"), np.full((2, joints), np.nan), strict=True)
        )

    def readings(self, rate_hz: float, seconds: float) -> Iterator[None]:
        """Read at a rate for some seconds, once at least."""
        tick = self.bus.now()
        until = tick + seconds
        while tick <= until:
            self.look()
            yield
            tick = max(tick + 1 / rate_hz, self.bus.now())
            if tick <= until:
                self.bus.sleep_until(tick)

    def look(self) -> None:
        """Read once."""
        sample = self._sample = self.bus.read()
        answered = self._here = np.isfinite(sample.position_rad)
        changed = answered & (sample.position_rad != self._position) & np.isfinite(self._position)
        self._has_changed |= changed
        news = answered if self.answers_now else changed | (answered & np.isnan(self._seen_s))
        self._seen_s = np.where(news, sample.time_s, self._seen_s)
        self._position = np.where(answered, sample.position_rad, self._position)
        self._count = np.where(answered, sample.position_count, self._count)
        for name in ("voltage_v", "temperature_c"):  # not in every reply
            if (now := getattr(sample, name)) is not None:
                self._latest[name] = np.where(np.isfinite(now), now, self._latest[name])
        goals = getattr(self.bus, "goals", None)
        if goals and self.bus.now() - self._goal_s > _GOALS_EVERY_S:
            self._goal, self._goal_s = goals(), self.bus.now()
        self.now_s = self.bus.now()

    def tick(self) -> tuple[Sent, BusSample]:
        """The goals as they were last read, as if sent now, and the last reading."""
        assert self._sample is not None
        return Sent(self.now_s, self._goal), self._sample

    def draw(self, scope: Oscilloscope) -> None:
        """Show the last reading as traces, and what there is no trace for beside them."""
        sample = self._sample
        assert sample is not None
        latest = replace(sample, **self._latest)
        scope.tick(self.now_s, self._goal, latest)
        notes = []
        for k, row in enumerate(self.rows()):
            word = "age" if self.answers_now else "same"
            age = self._age(k, row["age_s" if self.answers_now else "unchanged_s"])
            count = "" if row["count"] is None else f"{row['count']} cts"
            notes.append(" ".join(filter(None, [row["errors"], word, age, count])))
        scope.notes(notes)

    def rows(self) -> list[dict[str, Any]]:
        """One dict per joint; None where the bus has no value."""
        sample = self._sample
        assert sample is not None
        rows = []
        for k, name in enumerate(self.bus.joint_names):
            status = None if sample.status is None or not self._here[k] else int(sample.status[k])
            since = _known(self.now_s - self._seen_s[k])
            rows.append(
                {
                    "joint": name,
                    "answers": bool(self._here[k]),
                    "goal_rad": _known(self._goal[k]),
                    "position_rad": _known(self._position[k]),
                    "count": int(self._count[k]) if np.isfinite(self._position[k]) else None,
                    "age_s": since if self.answers_now else None,
                    "unchanged_s": None if self.answers_now else since,
                    "load": None if sample.load is None else _known(sample.load[k]),
                    **{name: _known(values[k]) for name, values in self._latest.items()},
                    "errors": None if status is None else error_words(self.bus, status),
                }
            )
        return rows

    def table(self, bus_name: str) -> Group:
        """The table and the meaning of its columns."""
        since = "age" if self.answers_now else "unchanged"
        table = terminal.table(
            bus_name, "joint", "goal", "rad", "count", since, "load %", "volt", "°C", "errors",
            rows=(
                (
                    row["joint"], number(row["goal_rad"], 3), number(row["position_rad"], 3),
                    "–" if row["count"] is None else row["count"],
                    self._age(k, row[f"{since}_s"]),
                    number(None if row["load"] is None else 100 * row["load"], 0),
                    number(row["voltage_v"], 1), number(row["temperature_c"], 0),
                    Text("silent", "red") if not row["answers"]
                    else "–" if row["errors"] is None else row["errors"] or "none",
                )
                for k, row in enumerate(self.rows())
            ),
        )  # fmt: skip
        if self.answers_now:
            note = "age: since the last valid reply. goal: the servo's Goal_Position."
        else:
            note = "unchanged: since the value last changed; the feedback age is unknown"
            proxy = self.bus.metadata["kind"] != "emulated"
            note += ", as are goals, temperatures and errors." if proxy else "."
        return Group(table, Text(note, style="dim"))

    def _age(self, joint: int, seconds: float | None) -> str:
        if seconds is None:
            return "–"
        if self.answers_now and seconds < 1:
            return f"{1e3 * seconds:.0f} ms"
        # its age before the first reading is unknown
        since_before = not self.answers_now and not self._has_changed[joint]
        return ("≥" if since_before else "") + f"{seconds:.1f} s"


def _open(bus: str, joint_map: str | None) -> ServoBus:
    """The bus to read, without guard and watchdog: nothing moves."""
    if bus_name(bus) == EMULATED:
        if joint_map:
            raise InputError("--joint-map: the emulated robot has its own; leave it out.")
        rng = np.random.default_rng(0)
        return EmulatedBus(draw_robot(rng), rng, real_time=True, keep_log=False)
    address = parse_address(bus)
    chosen = chosen_map(joint_map)
    opened = open_bus(address, chosen.per_servo() if chosen else None)
    say_remarks(opened)
    return opened


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
