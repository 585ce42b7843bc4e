"""Open a serial line at the right rate, and find out which servos are on it.

Refusals name the servo, its model, the rates that were tried, and what to check.
"""

from __future__ import annotations

from collections.abc import Sequence

from pupper_sysid.common.data_sheet import data_sheet
from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.hardware.serial_servos.line import SerialLine
from pupper_sysid.hardware.serial_servos.series import Family, Series

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
    """Open a line at the first of the baud rates at which a servo answers.

    Returns
    -------
    (SerialLine, dict of int to int)
        The line; those of `ids` that answer, and their model numbers.
    """
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


def known_series(
    family: Family, models: dict[int, int], device: str, named: str | None = None
) -> dict[int, Series]:
    """Series of the servos that answered; `named` is the servo of the joint map."""
    profile = family.profiles.get(named or "")
    for servo, model in models.items():
        if model not in family.series and profile is None:
            known = ", ".join(f"{s.name} ({s.model})" for s in family.series.values())
            raise BusError(
                f"{device}: servo {servo} has the model number {model}, which is not known; known "
                f"are {known}. Registers differ between series, so nothing is sent to it."
            )
    return {
        servo: series
        for servo, model in models.items()
        if (series := family.series.get(model, profile)) is not None
    }


def answering_joints(
    family: Family,
    wanted: JointMap,
    series: dict[int, Series],
    all_of_them: bool,
    line: SerialLine,
) -> list[str]:
    """Joints of `wanted` whose servos answer."""
    servos = dict(zip(wanted.joint_names, wanted.ids, strict=True))
    answering = [j for j, i in servos.items() if i in series]
    silent = [f"{j} (id {i})" for j, i in servos.items() if i not in series]
    if (silent and all_of_them) or not answering:
        raise BusError(
            f"{line.device}: {', '.join(silent)} does not answer at {line.baud} baud. Check power "
            "and wiring, choose the joints that are there, and list the servos with "
            f"`pupper-sysid scan --bus {family.name}:{line.device}`."
        )
    return answering


def one_series(series: dict[int, Series], device: str) -> Series:
    """The series of all servos."""
    kinds = {s.name: s for s in series.values()}
    if (
        len({s.counts for s in kinds.values()}) != 1
        or len({s.big_endian for s in kinds.values()}) != 1
    ):
        raise BusError(
            f"{device}: servos of different series ({', '.join(sorted(kinds))}) share the line, "
            "and their counts differ. Use one series per line."
        )
    return next(iter(kinds.values()))


def default_map(family: Family, line: SerialLine, series: dict[int, Series]) -> JointMap:
    """Joint map of a line without one: the Mini Pupper layout, if its servos are there."""
    one = one_series(series, line.device)
    preset = family.presets.get(one.name)
    silent = [i for i in MINI_PUPPER_IDS if i not in series]
    if preset is not None and len(silent) <= _NEARLY_ALL:
        series |= known_series(family, line.find(silent), line.device)
    others = [] if preset is None else sorted(line.roll_call(_OTHER_IDS))
    if preset is not None and sorted(series) == list(MINI_PUPPER_IDS) and not others:
        return load_joint_map(preset).per_servo()
    ids = ids_in_words([*series, *others])
    raise InputError(
        f"{line.device}: no joint map says which joint each servo moves, and these ({one.name}, "
        f"{'ids' if len(series) + len(others) > 1 else 'id'} {ids}) are not the Mini Pupper's "
        "twelve. Make a map from your robot's URDF or MJCF with `pupper-sysid init-robot "
        f"ROBOT.urdf --servo {one.name.lower()}`, or without such a file with `pupper-sysid "
        f"init-robot --servo {one.name.lower()}` and `joints` as `pan={min(series)}`, and give it "
        f"as `joint_map`; `pupper-sysid scan --bus {family.name}:{line.device}` lists the servos."
        + (f" A part of a Mini Pupper needs its joint map ({preset}) named, too." if preset else "")
    )


def refuse_other_servos(joint_map: JointMap, family: Family, one: Series, device: str) -> None:
    """Refuse a joint map that is not of these servos."""
    name = joint_map.file.name
    if joint_map.frame != "raw":
        raise InputError(
            f"the joint map {name} holds counts of the robot's proxy, and a direct "
            "bus uses raw ones. Make a map with "
            f"`pupper-sysid calibrate-joints --bus {family.name}:{device}`."
        )
    if joint_map.file.counts != one.counts:
        raise InputError(
            f"the joint map {name} is for servos of {joint_map.file.counts} "
            f"counts; these {one.name} have {one.counts}. Choose another map."
        )
    named = data_sheet(joint_map.file.servo) if joint_map.file.servo else None
    if named and named.model_number != one.model:
        raise InputError(
            f"the joint map {name} is for {named.name} servos; these are "
            f"{one.name}. Choose another map."
        )


def ids_in_words(ids: Sequence[int]) -> str:
    """Ids for a message: 1 to 12, or 4, 5, 9."""
    ids = sorted(ids)
    if len(ids) > 2 and ids == list(range(ids[0], ids[-1] + 1)):
        return f"{ids[0]} to {ids[-1]}"
    return ", ".join(map(str, ids))
