"""`scan`: the servos on a bus and their state."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pupper_sysid.cli import terminal
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.esp32.bus import Esp32Bus
from pupper_sysid.hardware.feetech.scan import ServoReport, scan_line


@dataclass(frozen=True)
class Scan:
    """List the servos on a bus: id, model, firmware, voltage, temperature, limits, error bits.

    Nothing moves and nothing is written. Example: pupper-sysid scan --bus feetech:/dev/ttyUSB0
    """

    bus: str
    """feetech:DEVICE (with @BAUD if known) or esp32."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Scan, and print a table."""
        address = parse_address(self.bus)
        if address.kind == "esp32":
            self._proxy(Path(address.where))
            return
        with terminal.progress("scanning", 0) as advance:
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
        delay_us = {s.id: s.return_delay_us or 0 for s in found}
        slow = [servo for servo, delay in delay_us.items() if delay > 100]
        if slow:
            terminal.err.print(
                f"Servos {', '.join(map(str, slow))} have a return delay (servo {slow[0]}: "
                f"{delay_us[slow[0]]} µs); 0 would make reading faster."
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


def _cells(servo: ServoReport) -> tuple[str, ...]:
    return (
        str(servo.id), servo.model, servo.firmware or "–", terminal.number(servo.voltage_v, 1),
        terminal.number(servo.temperature_c, 0), "–" if servo.count is None else str(servo.count),
        "–" if servo.limits is None else f"{servo.limits[0]}–{servo.limits[1]}",
        "–" if servo.gains is None else " ".join(map(str, servo.gains)),
        servo.errors or "none",
    )  # fmt: skip
