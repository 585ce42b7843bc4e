"""`scan`: the servos on a bus and their state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from pupper_sysid.cli import terminal
from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware.address import KINDS, SOCKET, BusAddress, parse_address
from pupper_sysid.hardware.esp32 import Esp32Bus
from pupper_sysid.hardware.serial_servos.scan import LineReport

_USB_PORTS = ("ttyUSB", "ttyACM", "ttyAMA", "ttySC", "cu.usb", "COM")


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
            answers = {device: _tried(device, advance) for device in ports}
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

    devices = sorted(port.device for port in comports())
    return [device for device in devices if Path(device).name.startswith(_USB_PORTS)]


def _tried(device: str, advance: Callable[[str], None]) -> LineReport | str:
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
