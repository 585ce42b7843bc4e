"""Which servos are on a serial line: open it at the right rate, or scan every id at every rate.

Refusals name the servo, its model, the rates that were tried, and what to check.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from pupper_sysid.common.data_sheet import data_sheet
from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.hardware.serial_servos.line import SerialLine, line_remarks
from pupper_sysid.hardware.serial_servos.series import Family, Series, bits_in_words
from pupper_sysid.hardware.serial_servos.settings import (
    memory_of,
    register_faults,
    registers_of,
    return_delay_s,
    setup_of,
)

_USUAL_IDS = tuple(range(31))
_SLOW_RETURN_S = 1e-4
_TRIES = 3  # a servo that answered a ping has registers: a reply was late or damaged


@dataclass(frozen=True)
class ServoReport:
    """State and settings of one servo; None where its model is unknown or a read failed."""

    id: int
    model: str
    """Name, "unknown (number)", or what else it is."""
    errors: str
    """Error bits in words."""
    baud: int = 0
    firmware: str | None = None
    voltage_v: float | None = None
    temperature_c: float | None = None
    count: int | None = None
    """Present position."""
    limits: tuple[int, int] | None = None
    """Angle limits in its EEPROM [counts]."""
    gains: tuple[int, ...] | None = None
    """P, D, I."""
    return_delay_us: int | None = None
    faults: tuple[str, ...] = ()
    """Registers with which it would not be driven, and others that shape its motion."""


@dataclass(frozen=True)
class LineReport:
    """What answers on one line."""

    family: str
    device: str
    baud: int
    """Rate of the first servo."""
    servos: list[ServoReport]
    remarks: list[str] = field(default_factory=list)
    """About the line."""


def scan_line(
    family: Family,
    device: str,
    baud: int | None,
    advance: Callable[[str], None] = lambda what: None,
) -> LineReport:
    """Servos of a line, at all rates; `advance` is called with each rate tried, in words.

    Every id is pinged until a rate with servos is found; at the remaining rates the ids that robots
    use. Silent ids are pinged again where servos answer, and gaps between ids a third time.
    """
    servos: list[ServoReport] = []
    remarks: list[str] = []
    first = 0
    for rate in family.rates if baud is None else (baud,):
        advance(f"{family.name} at {rate} baud")
        line = family.open_line(device, rate, True)
        try:
            line.detect_echo()
            ids = _USUAL_IDS if servos else range(family.highest_id + 1)
            answering = _answering(line, ids)
            if not answering:
                continue
            first = first or rate
            servos += [_report(family, line, servo, model) for servo, model in answering.items()]
            candidates = (series_of(family, line, servo, m) for servo, m in answering.items())
            known = next((series for series in candidates if series), None)
            if known is not None:
                where, size = known.register(family.present).address, family.reading_bytes[0]
                doubled = line.doubled(list({*answering, *line.garbled}), where, size)
                remarks += [two_of_one_id(line, servo) for servo in doubled]
            remarks += line_remarks(line)
        finally:
            line.close()
    if not servos:
        raise BusError(
            f"{device}: no servo answers at {rates_in_words(family, baud)} baud. Check that the "
            "servos have power and the data line is connected; `pupper-sysid scan` alone tries "
            "the other protocols, too."
        )
    rates = sorted({servo.baud for servo in servos})
    if len(rates) > 1:
        remarks.append(
            f"{device}: servos of different rates ({', '.join(map(str, rates))} baud) share the "
            f"line, and one program uses one rate. Set one rate with {family.tool}."
        )
    elif baud is None:
        tried = ", ".join(str(rate) for rate in family.rates if rate not in rates)
        remarks.append(
            f"At the other rates ({tried} baud) none of the ids {ids_in_words(_USUAL_IDS)} answers."
        )
    delay_us = {s.id: s.return_delay_us for s in servos if s.return_delay_us is not None}
    if slow := [servo for servo, us in delay_us.items() if us > 1e6 * _SLOW_RETURN_S]:
        subject, have = ("Servos", "have") if len(slow) > 1 else ("Servo", "has")
        delays = " or ".join(map(str, sorted({delay_us[servo] for servo in slow})))
        remarks.append(
            f"{subject} {ids_in_words(slow)} {have} a return delay of {delays} µs; 0 would make "
            "reading faster."
        )
    return LineReport(family.name, device, first, servos, remarks)


def _answering(line: SerialLine, ids: range | tuple[int, ...]) -> dict[int, int]:
    """Ids that answer, and their model numbers."""
    models = {servo: model for servo, (model, _) in line.roll_call(ids).items()}
    if not models:
        return {}
    silent = [servo for servo in ids if servo not in models]
    models |= {servo: model for servo, (model, _) in line.roll_call(silent).items()}
    gaps = [i for i in range(1, max(models) + 2) if i not in models]
    models |= line.find([*models, *gaps[:30]])
    return dict(sorted(models.items()))


def _report(family: Family, line: SerialLine, servo: int, model: int) -> ServoReport:
    series = series_of(family, line, servo, model)
    if series is None:
        old = is_protocol_1(line, servo, model)
        name = "Dynamixel, protocol 1" if old else f"unknown ({model})"
        return ServoReport(servo, name, "", line.baud)
    name = series.name if model in family.series else f"{series.name} ({model})"
    reply = line.read(servo, series.register(family.present).address, family.reading_bytes[0])
    errors = bits_in_words(reply.frame.code, family.error_bits) if reply else ""
    tries = (memory_of(line, servo, family.memory_pieces) for _ in range(_TRIES))
    memory = next((content for content in tries if content is not None), None)
    if memory is None:
        return ServoReport(servo, name, errors, line.baud)
    registers = registers_of(series, memory)

    def value(name: str) -> int:
        return registers[series.name_of(name)]

    setup = setup_of(servo, family, series, registers)
    # without a joint map any limits fit
    low, high = value("min_angle"), value("max_angle")
    inside = (low, high) if 0 <= low < high else (0, series.counts - 1)
    faults = register_faults(family, series, registers, inside)
    # a range that wraps with its homing offset is a joint map's matter, and here is none
    faults = [fault for fault in faults if fault.refused or fault.register != "homing_offset"]
    return ServoReport(
        servo,
        name,
        errors,
        line.baud,
        setup["firmware"],
        round(value("present_voltage") * family.volt_scale, 1),
        float(value("present_temperature")),
        value("present_position"),
        (low, high),
        tuple(setup[key] for key in ("p_gain", "d_gain", "i_gain")),
        round(1e6 * return_delay_s(family, setup)),
        tuple(fault.sentence(f"id {servo}", series) for fault in faults),
    )


def two_of_one_id(line: SerialLine, servo: int) -> str:
    """Sentence about an id that two servos have."""
    total = line.garbled[servo] + line.answered[servo]
    return (
        f"{line.device}: two servos probably have the id {servo} (register id): "
        f"{line.garbled[servo]} of {total} replies there were garbled, and those of other ids were "
        "not. Connect one of them alone and give it another id."
    )


MINI_PUPPER_IDS = tuple(range(1, 13))
_NEARLY_ALL = 3
_OTHER_IDS = (0, *range(13, 25))  # which a line of the Mini Pupper's servos does not have


def open_line(
    family: Family,
    device: str,
    baud: int | None,
    ids: Sequence[int],
    exclusive: bool = True,
    patiently: bool = True,
) -> tuple[SerialLine, dict[int, int]]:
    """Open a line at the first rate at which one of `ids` answers; and models of all that do."""
    for rate in family.rates if baud is None else (baud,):
        line = family.open_line(device, rate, exclusive)
        line.detect_echo()
        models = line.find(ids, patiently)
        if models:
            return line, models
        line.close()
    raise BusError(
        f"{device}: no servo answers at {rates_in_words(family, baud)} baud (tried ids "
        f"{ids_in_words(ids)}, each again with ten times the patience). Check that the servos have "
        "power, the data line is connected, and their ids, with "
        f"`pupper-sysid scan --bus {family.name}:{device}`."
    )


def rates_in_words(family: Family, baud: int | None) -> str:
    """Baud rates that are tried, for a message."""
    return ", ".join(map(str, family.rates)) if baud is None else str(baud)


def series_of(family: Family, line: SerialLine, servo: int, model: int) -> Series | None:
    """Series of a servo by its model number, or by its firmware; None if neither is known."""
    return family.series.get(model) or family.by_firmware(line, servo, model)


def is_protocol_1(line: SerialLine, servo: int, model: int) -> bool:
    """Whether a "model number" is a Dynamixel's id and rate, which protocol 1 has at its place."""
    return model == servo | (round(2e6 / line.baud) - 1) << 8


def known_series(
    family: Family, line: SerialLine, models: dict[int, int], named: str | None = None
) -> dict[int, Series]:
    """Series of the servos that answered; `named` is the servo of the joint map."""
    profile, series_of_servo = family.profiles.get(named or ""), {}
    for servo, model in models.items():
        series = family.series.get(model) or profile or family.by_firmware(line, servo, model)
        if series is None:
            if is_protocol_1(line, servo, model):
                raise BusError(
                    f"{line.device}: servo {servo} answers as a Dynamixel with protocol 1 (AX, RX, "
                    "or MX with their first firmware), for which there is no bus here. MX-28, -64 "
                    "and -106 take the firmware for protocol 2.0 from DYNAMIXEL Wizard."
                )
            raise BusError(
                f"{line.device}: servo {servo} has the model number {model}, which is not among "
                f"the {len(family.series)} that are known of {family.name} servos, nor does its "
                "firmware tell its series. Registers differ between series, so nothing is sent to "
                "it."
            )
        series_of_servo[servo] = series
    return series_of_servo


def answering_joints(
    family: Family, chosen: JointMap, series: dict[int, Series], must_answer: bool, line: SerialLine
) -> list[str]:
    """Joints of `chosen` whose servos answer; `BusError` if `must_answer` and one is silent."""
    servos = dict(zip(chosen.joint_names, chosen.ids, strict=True))
    answering = [j for j, i in servos.items() if i in series]
    silent = [f"{j} (id {i})" for j, i in servos.items() if i not in series]
    if silent and (known := next(iter(series.values()), None)):  # two of one id may hide each other
        where, size = known.register(family.present).address, family.reading_bytes[0]
        if doubled := line.doubled(list(servos.values()), where, size):
            raise BusError(" ".join(two_of_one_id(line, servo) for servo in doubled))
    if (silent and must_answer) or not answering:
        elsewhere = _at_other_rates(family, line, [i for i in servos.values() if i not in series])
        raise BusError(
            f"{line.device}: {', '.join(silent)} does not answer at {line.baud} baud. "
            f"{elsewhere}Check power and wiring, choose the joints that are there, and list the "
            f"servos with `pupper-sysid scan --bus {family.name}:{line.device}`."
        )
    return answering


def _at_other_rates(family: Family, line: SerialLine, ids: Sequence[int]) -> str:
    """Sentence about those of `ids` that answer at another rate, or nothing; closes the line."""
    line.close()
    for rate in family.rates:
        if rate == line.baud:
            continue
        other = family.open_line(line.device, rate, True)
        answering = sorted(other.roll_call(ids))
        other.close()
        if answering:
            return (
                f"At {rate} baud id {ids_in_words(answering)} answers: one program uses one rate, "
                f"so set one rate with {family.tool}. "
            )
    return ""


def one_series(series: dict[int, Series], device: str) -> Series:
    """The series of all servos."""
    if len({(s.counts, s.big_endian) for s in series.values()}) != 1:
        names = sorted({s.name for s in series.values()})
        raise BusError(
            f"{device}: servos of different series ({', '.join(names)}) share the line, and their "
            "counts differ. Use one series per line."
        )
    return next(iter(series.values()))


def default_map(family: Family, line: SerialLine, series: dict[int, Series]) -> JointMap:
    """Joint map of a line without one: the Mini Pupper layout, if its servos are there."""
    kind = one_series(series, line.device)
    preset = family.presets.get(kind.name)
    silent = [i for i in MINI_PUPPER_IDS if i not in series]
    if preset is not None and len(silent) <= _NEARLY_ALL:
        series |= known_series(family, line, line.find(silent))
    others = [] if preset is None else sorted(line.roll_call(_OTHER_IDS))
    if preset is not None and sorted(series) == list(MINI_PUPPER_IDS) and not others:
        return load_joint_map(preset).per_servo()
    ids = ids_in_words([*series, *others])
    raise InputError(
        f"{line.device}: no joint map says which joint each servo moves, and these ({kind.name}, "
        f"{'ids' if len(series) + len(others) > 1 else 'id'} {ids}) are not the Mini Pupper's "
        "twelve. Make a map from your robot's URDF or MJCF with `pupper-sysid init-robot "
        f"ROBOT.urdf --servo {kind.name.lower()}`, or without such a file with `pupper-sysid "
        f"init-robot --servo {kind.name.lower()} --joints pan={min(series)}`, and give it as "
        f"`joint_map`; `pupper-sysid scan --bus {family.name}:{line.device}` lists the servos."
        + (f" A part of a Mini Pupper needs its joint map ({preset}) named, too." if preset else "")
    )


def refuse_other_servos(joint_map: JointMap, family: Family, kind: Series, device: str) -> None:
    """Refuse a joint map that is not of these servos."""
    name, counts = joint_map.file.name, joint_map.file.counts
    if joint_map.frame != "raw":
        raise InputError(
            f"the joint map {name} holds counts of the robot's proxy, and a direct bus uses raw "
            f"ones. Make a map with `pupper-sysid calibrate-joints --bus {family.name}:{device}`."
        )
    if counts != kind.counts:
        raise InputError(
            f"the joint map {name} is for servos of {counts} counts; these {kind.name} have "
            f"{kind.counts}. Choose another map."
        )
    servo = joint_map.file.servo or kind.name
    sheet = data_sheet(servo)
    names = {series.name for series in (*family.series.values(), *family.profiles.values())}
    if kind.name != servo and (sheet.model_number != kind.model if sheet else servo in names):
        raise InputError(
            f"the joint map {name} is for {servo} servos; these are {kind.name}. Choose another "
            "map."
        )


def ids_in_words(ids: Sequence[int]) -> str:
    """Ids for a message: 1 to 12, or 4, 5, 9."""
    ids = sorted(ids)
    if len(ids) > 2 and ids == list(range(ids[0], ids[-1] + 1)):
        return f"{ids[0]} to {ids[-1]}"
    return ", ".join(map(str, ids))
