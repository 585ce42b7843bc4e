"""Who is on a Feetech line: every id is asked once, and those who answer are read out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.feetech.bus import AUTO_BAUDS, VOLT_SCALE, memory_of
from pupper_sysid.hardware.feetech.line import FeetechLine
from pupper_sysid.hardware.feetech.registers import HIGHEST_ID, Series, error_words


@dataclass(frozen=True)
class ServoReport:
    """What one servo says of itself; None where it is of an unknown model or did not say.

    Attributes
    ----------
    id : int
    model : str
        Name, or "unknown (number)".
    firmware : str or None
    voltage_v, temperature_c : float or None
    count : int or None
        Present position.
    limits : tuple of int or None
        Angle limits in its EEPROM, counts.
    gains : tuple of int or None
        P, D, I.
    return_delay_us : int or None
    errors : str
        Error bits in words.
    """

    id: int
    model: str
    errors: str
    firmware: str | None = None
    voltage_v: float | None = None
    temperature_c: float | None = None
    count: int | None = None
    limits: tuple[int, int] | None = None
    gains: tuple[int, int, int] | None = None
    return_delay_us: int | None = None


def scan_line(
    device: str, baud: int | None, advance: Callable[[str], None] = lambda what: None
) -> tuple[int, list[ServoReport]]:
    """The baud rate at which servos answer, and what they say.

    Raises
    ------
    BusError
        If the port cannot be opened or nobody answers.
    """
    for rate in (baud,) if baud else AUTO_BAUDS:
        advance(f"at {rate} baud")
        line = FeetechLine(device, rate)
        try:
            line.detect_echo()
            answering = [i for i in range(HIGHEST_ID + 1) if line.ping(i) or _again(line, i)]
            if answering:
                return rate, [_report(line, i) for i in answering]
        finally:
            line.close()
    rates = str(baud) if baud else ", ".join(map(str, AUTO_BAUDS))
    raise BusError(
        f"{device}: nobody answers at {rates} baud. Check that the servos have power and the data "
        "line is connected."
    )


def _again(line: FeetechLine, servo: int) -> bool:
    """A second question for the ids that robots use: a first frame can be lost."""
    return servo <= 12 and line.ping(servo) is not None


def _report(line: FeetechLine, servo: int) -> ServoReport:
    status = line.ping(servo)
    errors = error_words(status.code) if status else ""
    series = line.model(servo)
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
        round(value("voltage") * VOLT_SCALE, 1),
        float(value("temperature")),
        value("position"),
        (value("min_angle"), value("max_angle")),
        (value("p"), value("d"), value("i")),
        2 * value("return_delay"),
    )
