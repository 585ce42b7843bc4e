"""`scan`: who is on the bus, and is everyone well."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pupper_sysid.cli import terminal
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.esp32.bus import Esp32Bus
from pupper_sysid.hardware.feetech.scan import ServoReport, scan_line


@dataclass(frozen=True)
class Scan:
    """Ask who is on a bus: id, model, firmware, voltage, temperature, limits, error bits.

    Nothing moves and nothing is written. Example: pupper-sysid scan --bus feetech:/dev/ttyUSB0
    """

    bus: str
    """feetech:DEVICE (with @BAUD if known) or esp32."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Ask, and print a table."""
        address = parse_address(self.bus)
        if address.kind == "esp32":
            self._proxy(Path(address.where))
            return
        with terminal.progress("asking", 0) as advance:
            baud, found = scan_line(address.where, address.baud, advance)
        if self.json:
            terminal.print_json({"baud": baud, "servos": [vars(s) for s in found]})
            return
        table = terminal.table(
            f"{len(found)} servos at {address.where}, {baud} baud",
            "id", "model", "firmware", "volt", "°C", "count", "limits", "P D I", "errors",
        )  # fmt: skip
        for servo in found:
            table.add_row(*_cells(servo))
        terminal.out.print(table)
        slow = [s.id for s in found if s.return_delay_us and s.return_delay_us > 100]
        if slow:
            terminal.err.print(
                f"Servos {', '.join(map(str, slow))} wait {found[0].return_delay_us} µs before "
                "they answer; a return delay of 0 would make reading faster."
            )

    def _proxy(self, path: Path) -> None:
        bus = Esp32Bus(path)
        try:
            sample = bus.read()
        finally:
            bus.close()
        volts = None if sample.voltage_v is None else float(sample.voltage_v[0])
        rows = [
            {"joint": name, "count": int(count), "load": None if load is None else float(load)}
            for name, count, load in zip(
                bus.joint_names, sample.position_count,
                [None] * len(bus.joint_names) if sample.load is None else sample.load, strict=True,
            )
        ]  # fmt: skip
        if self.json:
            terminal.print_json({"voltage_v": volts, "servos": rows})
            return
        table = terminal.table(
            f"the proxy at {path}, {terminal.number(volts, 1)} V", "joint", "count", "load %"
        )
        for row in rows:
            silent = row["count"] < 0
            load = None if row["load"] is None else 100 * row["load"]
            table.add_row(row["joint"], "silent" if silent else str(row["count"]),
                          terminal.number(load, 0))  # fmt: skip
        terminal.out.print(table)
        terminal.err.print(
            "The proxy tells neither model nor temperature; counts are the firmware's calibrated "
            "ones."
        )


def _cells(servo: ServoReport) -> tuple[str, ...]:
    return (
        str(servo.id), servo.model, servo.firmware or "–", terminal.number(servo.voltage_v, 1),
        terminal.number(servo.temperature_c, 0), "–" if servo.count is None else str(servo.count),
        "–" if servo.limits is None else f"{servo.limits[0]}–{servo.limits[1]}",
        "–" if servo.gains is None else " ".join(map(str, servo.gains)),
        servo.errors or "none",
    )  # fmt: skip
