"""`scan` and `park`: the servos on a bus and their state; switch a robot's torque off."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import chosen_map
from pupper_sysid.common.errors import BusError, InputError, PupperError
from pupper_sysid.hardware.address import KINDS, SOCKET, BusAddress, parse_address
from pupper_sysid.hardware.esp32 import Esp32Bus
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.safety.limp import can_come_back, is_there, may_be_on, switch_off
from pupper_sysid.hardware.safety.notes import Note, notes
from pupper_sysid.hardware.safety.watchdog import HANG_S
from pupper_sysid.hardware.safety.watchdog_process import restore
from pupper_sysid.hardware.serial_servos.scan import LineReport

_SERVO_PORTS = ("ttyUSB", "ttyACM", "ttyAMA", "ttySC", "cu.usb", "COM")


@dataclass(frozen=True)
class Scan:
    """List the servos on a bus: id, model, firmware, voltage, temperature, limits, error bits.

    Without --bus it lists the serial ports, tries every protocol and rate on each, and says what
    answers where. Nothing moves and nothing is written.
    Example: pupper-sysid scan --bus feetech:/dev/ttyUSB0
    """

    bus: str | None = None
    """feetech:DEVICE, dynamixel:DEVICE (with @BAUD if known) or esp32; by default every serial port
    is tried."""
    json: bool = False
    """Print one JSON object and nothing else."""

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
            terminal.print_json(_as_data(report))
            return
        self._show(report)

    def _show(self, report: LineReport) -> None:
        servos = report.servos
        number = f"{len(servos)} servo{'' if len(servos) == 1 else 's'}"
        table = terminal.table(
            f"{number} at {report.family}:{report.device}, {report.baud} baud",
            "id", "model", "firmware", "volt", "°C", "count", "limits", "P D I", "errors",
        )  # fmt: skip
        n = terminal.number
        for servo in servos:
            table.add_row(
                str(servo.id), servo.model, servo.firmware or "–", n(servo.voltage_v, 1),
                n(servo.temperature_c, 0), n(servo.count, 0),
                "–" if servo.limits is None else f"{servo.limits[0]}–{servo.limits[1]}",
                "–" if servo.gains is None else " ".join(map(str, servo.gains)),
                servo.errors or "none",
            )  # fmt: skip
        terminal.out.print(table)
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
        proxy = SOCKET.exists()
        if self.json:
            lines = [_as_data(report) for report in reports]
            terminal.print_json(
                {
                    "ports": ports,
                    "lines": lines,
                    "silent": silent,
                    "proxy": SOCKET if proxy else None,
                }
            )
            return
        for report in reports:
            self._show(report)
            terminal.out.print(f"Use it with --bus {report.family}:{report.device}")
        for device, why in silent.items():
            terminal.err.print(f"{device}: {why}")
        if proxy:
            terminal.out.print("A Mini Pupper 2's proxy is here: --bus esp32")
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
            terminal.print_json({"voltage_v": volts, "servos": rows})
            return
        table = terminal.table(
            f"the proxy at {path}, {terminal.number(volts, 1)} V", "joint", "count", "load %"
        )
        for row in rows:
            count = "silent" if row["count"] < 0 else str(row["count"])
            table.add_row(row["joint"], count, terminal.number(100 * row["load"], 0))
        terminal.out.print(table)
        terminal.err.print(
            "The proxy reports neither model nor temperature; counts are the firmware's calibrated "
            "ones."
        )


def serial_ports() -> list[str]:
    """Serial ports to which a servo adapter may be connected."""
    from serial.tools.list_ports import comports

    paths = [Path(port.device) for port in comports()]
    return sorted(
        str(path) for path in paths
        if path.name.startswith(_SERVO_PORTS) and (os.name == "nt" or path.is_char_device())
    )  # fmt: skip


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
        "bus": f"{report.family}:{report.device}",
        "baud": report.baud,
        "servos": [asdict(servo) for servo in report.servos],
        "remarks": report.remarks,
    }


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
