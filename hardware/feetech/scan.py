"""Scan of a Feetech line: ping every id and read the servos that answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.feetech.line import FeetechLine
from pupper_sysid.hardware.feetech.opening import AUTO_BAUDS, rates_in_words
from pupper_sysid.hardware.feetech.registers import HIGHEST_ID, Series, error_words
from pupper_sysid.hardware.feetech.settings import VOLT_SCALE, memory_of


@dataclass(frozen=True)
class ServoReport:
    """State and settings of one servo; None where its model is unknown or a read failed."""

    id: int
    model: str
    """Name, or "unknown (number)"."""
    errors: str
    """Error bits in words."""
    firmware: str | None = None
    voltage_v: float | None = None
    temperature_c: float | None = None
    count: int | None = None
    """Present position."""
    limits: tuple[int, int] | None = None
    """Angle limits in its EEPROM [counts]."""
    gains: tuple[int, int, int] | None = None
    """P, D, I."""
    return_delay_us: int | None = None


def scan_line(
    device: str, baud: int | None, advance: Callable[[str], None] = lambda what: None
) -> tuple[int, list[ServoReport]]:
    """Baud rate and servos of a line; `advance` is called with each rate tried, in words.

    Raises
    ------
    BusError
        If the port cannot be opened or no servo answers.
    """
    for rate in AUTO_BAUDS if baud is None else (baud,):
        advance(f"at {rate} baud")
        line = FeetechLine(device, rate)
        try:
            line.detect_echo()
            # a first frame can be lost: the ids that robots use are tried twice
            answering = [
                i for i in range(HIGHEST_ID + 1) if line.ping(i) or (i <= 12 and line.ping(i))
            ]
            if answering:
                return rate, [_report(line, i) for i in answering]
        finally:
            line.close()
    raise BusError(
        f"{device}: no servo answers at {rates_in_words(baud)} baud. Check that the servos have "
        "power and the data line is connected."
    )


def _report(line: FeetechLine, servo: int) -> ServoReport:
    status = line.ping(servo)
    errors = error_words(status.code) if status else ""
    series = line.find([servo]).get(servo)
    if not isinstance(series, Series):
        number = "no answer" if series is None else str(series)
        return ServoReport(servo, f"unknown ({number})", errors)
    memory = memory_of(line, servo)
    if memory is None:
        return ServoReport(servo, series.name, errors)

    def value(name: str) -> int:
        return series.decode(name, memory)

    return ServoReport(
        servo,
        series.name,
        errors,
        f"{value('firmware_major')}.{value('firmware_minor')}",
        round(value("present_voltage") * VOLT_SCALE, 1),
        float(value("present_temperature")),
        value("present_position"),
        (value("min_angle"), value("max_angle")),
        (value("p"), value("d"), value("i")),
        2 * value("return_delay"),
    )
