"""Open a serial line at the right rate, and find out which servos are on it.

Refusals name the servo, its model, the rates that were tried, and what to check.
"""

from __future__ import annotations

from collections.abc import Sequence

from pupper_sysid.common.data_sheet import data_sheet
from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware.feetech.line import FeetechLine, known_models
from pupper_sysid.hardware.feetech.registers import SCS0009, STS3215, Series
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map

AUTO_BAUDS = (1_000_000, 500_000, 115_200, 250_000, 57_600, 38_400)
"""Baud rates tried, in this order, where none is given."""


def open_line(
    device: str, baud: int | None, ids: Sequence[int], exclusive: bool = True
) -> tuple[FeetechLine, dict[int, int | Series]]:
    """Open a line at the first of the baud rates at which a servo answers.

    Returns
    -------
    (FeetechLine, dict of int to Series or int)
        The line; those of `ids` that answer, and their series or unknown model number.

    Raises
    ------
    BusError
        If the port cannot be opened, or no servo answers.
    """
    for rate in AUTO_BAUDS if baud is None else (baud,):
        line = FeetechLine(device, rate, exclusive)
        line.detect_echo()
        found = line.find(ids)
        if found:
            return line, found
        line.close()
    raise BusError(
        f"{device}: no servo answers at {rates_in_words(baud)} baud (tried ids {_span(ids)}). "
        "Check that the servos have power, the data line is connected, and their ids, with "
        f"`pupper-sysid scan --bus feetech:{device}`."
    )


def rates_in_words(baud: int | None) -> str:
    """Baud rates that are tried, for a message."""
    return ", ".join(map(str, AUTO_BAUDS)) if baud is None else str(baud)


def known_series(found: dict[int, int | Series], device: str) -> dict[int, Series]:
    """Series of the servos found.

    Raises
    ------
    BusError
        If a model is unknown.
    """
    for servo, model in found.items():
        if not isinstance(model, Series):
            raise BusError(
                f"{device}: servo {servo} has the model number {model}, which is not known; known "
                f"are {known_models()}. Registers differ between series, so nothing is sent to it."
            )
    return {i: s for i, s in found.items() if isinstance(s, Series)}


def answering_joints(
    wanted: JointMap, series: dict[int, Series], all_of_them: bool, line: FeetechLine
) -> list[str]:
    """Joints of `wanted` whose servos answer.

    Raises
    ------
    BusError
        If none does, or not `all_of_them`.
    """
    servos = dict(zip(wanted.joint_names, wanted.ids, strict=True))
    answering = [j for j, i in servos.items() if i in series]
    silent = [f"{j} (id {i})" for j, i in servos.items() if i not in series]
    if (silent and all_of_them) or not answering:
        raise BusError(
            f"{line.device}: {', '.join(silent)} does not answer at {line.baud} baud. Check power "
            "and wiring, choose the joints that are there, and list the servos with "
            f"`pupper-sysid scan --bus feetech:{line.device}`."
        )
    return answering


def fitting_map(joint_map: JointMap | None, series: dict[int, Series], device: str) -> JointMap:
    """The given map, or the preset for the servos found.

    Raises
    ------
    BusError
        If servos of different series share the line.
    InputError
        If the map does not fit the servos.
    """
    names = {s.name for s in series.values()}
    if len(names) != 1:
        raise BusError(
            f"{device}: servos of different series ({', '.join(sorted(names))}) share the line, "
            "and their counts differ. Use one series per line."
        )
    one = next(iter(series.values()))
    if joint_map is None:
        preset = {SCS0009.name: "mini_pupper_2_direct", STS3215.name: "sts3215"}[one.name]
        return load_joint_map(preset).per_servo()
    if joint_map.frame != "raw":
        raise InputError(
            f"the joint map {joint_map.file.name} holds counts of the robot's proxy, and a direct "
            "bus uses raw ones. Make a map with "
            f"`pupper-sysid calibrate-joints --bus feetech:{device}`."
        )
    if joint_map.file.counts != one.counts:
        raise InputError(
            f"the joint map {joint_map.file.name} is for servos of {joint_map.file.counts} "
            f"counts; these {one.name} have {one.counts}. Choose another map."
        )
    named = data_sheet(joint_map.file.servo) if joint_map.file.servo else None
    if named and named.model_number != one.model:
        raise InputError(
            f"the joint map {joint_map.file.name} is for {named.name} servos; these are "
            f"{one.name}. Choose another map."
        )
    return joint_map


def _span(ids: Sequence[int]) -> str:
    ids = sorted(ids)
    if ids == list(range(ids[0], ids[-1] + 1)) and len(ids) > 2:
        return f"{ids[0]} to {ids[-1]}"
    return ", ".join(map(str, ids))
