"""What the columns of a log do not say: `LogOptions`, or a mapping file.

# so101.yaml, given as `--mapping so101.yaml`
time: t_ms
command: goal.{joint}
position: present.{joint}
joints: {shoulder pan: shoulder_pan, "6": gripper}     # the log's name: yours
unit: deg
units: {gripper: "percent:1.9"}
read_before_send: true
stamp: start
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_type_hints

from pydantic import ConfigDict, create_model

from pupper_sysid.common.border import read_yaml, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.dialect import decimal
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.units import Unit, unit

Stamp = Literal["start", "middle", "end"]
Readings = Literal["live", "polled"]

_DURATION = re.compile(r"([+-]?[0-9.]+(?:e[+-]?[0-9]+)?)\s*(s|ms|us|µs)")
_SCALES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
_LONGEST_S = 1.0
_RATES_HZ = (0.1, 100_000.0)


@dataclass(frozen=True)
class LogOptions:
    """Columns, units, names and order of a log. What is left out is found from the log.

    Attributes
    ----------
    time : str, optional
        Column of the time; of the reading's, where `command_time` is another.
    command, position : str, optional
        Columns, with `{joint}` where the joint's name stands: `action.{joint}`; or several, with
        commas. A column of a file without names has its number, from 0. Of a ROS log the topics.
    trial : str, optional
        Column that numbers or names trials, episodes or loops.
    joints : mapping of str to str
        Joints to read, by the log's name, and what to call them; empty for all.
    unit : str, optional
        See `units.unit`.
    units : mapping of str to str
        The same for single joints, by the log's name or the new one.
    read_before_send : bool, optional
        Whether a turn reads the position before it sends the command.
    stamp : {"start", "middle", "end"}, optional
        Where in a turn its time stamp was taken.
    command_time : str, optional
        Column of the times at which the commands were sent.
    send_after : str, optional
        Time from the reading to the command, such as `3ms`; negative for a command before it.
    rate : float, optional
        Rows a second [Hz], instead of the log's times or in want of them.
    readings : {"live", "polled"}, optional
        Whether a reading is the present position or the bus's last poll.
    """

    time: str | None = None
    command: str | None = None
    position: str | None = None
    trial: str | None = None
    joints: Mapping[str, str] = field(default_factory=dict)
    unit: str | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    read_before_send: bool | None = None
    stamp: Stamp | None = None
    command_time: str | None = None
    send_after: str | None = None
    rate: float | None = None
    readings: Readings | None = None

    def __post_init__(self) -> None:
        for text in [self.unit, *self.units.values()]:
            if text is not None:
                unit(text)
        if self.stamp not in (None, "start", "middle", "end"):
            raise InputError(f"`stamp` is {self.stamp}; it must be start, middle or end.")
        if bool(self.command) != bool(self.position):
            raise InputError("`command` and `position` belong together: give both or none.")
        if self.command_time and (self.send_after or self.read_before_send or self.rate):
            raise InputError(
                "`command_time` says when the commands were sent: leave `send_after`, "
                "`read_before_send` and `rate` out."
            )
        if self.rate is not None and not _RATES_HZ[0] <= self.rate <= _RATES_HZ[1]:
            raise InputError(
                f"`rate` is {self.rate:g}; it must be from {_RATES_HZ[0]:g} to {_RATES_HZ[1]:g} Hz."
            )
        if self.readings not in (None, "live", "polled"):
            raise InputError(f"`readings` is {self.readings}; it must be live or polled.")
        self.send_after_s  # noqa: B018
        for name in ("command", "position"):
            if (text := getattr(self, name)) and text.count("{joint}") > 1:
                raise InputError(f"`{name}` has {{joint}} twice; write it once.")

    def unit_of(self, *names: str) -> Unit | None:
        """Unit of a joint under any of its names, if one was given."""
        text = next((self.units[n] for n in names if n in self.units), self.unit)
        return None if text is None else unit(text)

    @property
    def send_after_s(self) -> float | None:
        """Time from the reading to the command [s]; None where it is not known."""
        if self.send_after is None:
            return None
        match = _DURATION.fullmatch(self.send_after.strip())
        try:
            seconds = decimal(match[1]) * _SCALES[match[2]] if match else float("inf")
        except ValueError:
            seconds = float("inf")
        if abs(seconds) > _LONGEST_S:
            raise InputError(
                f"`send_after` is {printable(self.send_after)[:40]}. Write a time of at most 1 s "
                "with its unit, such as 3ms or 250us."
            )
        return seconds

    def refuse(self, layout: str, allowed: tuple[str, ...] = ("joints",)) -> None:
        """Refuse options that a layout has no use for."""
        given = [f.name for f in fields(self) if getattr(self, f.name) not in (None, {})]
        useless = [name for name in given if name not in allowed]
        if useless:
            raise InputError(
                f"This is a {layout}, which says itself what `{useless[0]}` would say. Leave it "
                "out."
            )


_MappingFile = create_model(
    "_MappingFile",
    __config__=ConfigDict(extra="forbid", strict=True),
    joints=(list[str] | dict[str, str], []),
    units=(dict[str, str], {}),
    **{
        name: (kind, None)
        for name, kind in get_type_hints(LogOptions).items()
        if name not in ("joints", "units")
    },
)
"""A mapping file holds what `LogOptions` does; see the module."""


def read_mapping(path: Path) -> LogOptions:
    """Options from a mapping file."""
    data, lines = read_yaml(path)
    found = validated(_MappingFile, data, path, lines).model_dump()
    if isinstance(found["joints"], list):
        found["joints"] = {name: name for name in found["joints"]}
    return LogOptions(**found)


def merged(first: LogOptions, second: LogOptions) -> LogOptions:
    """Options of `first`, and of `second` where `first` has none."""
    values: dict[str, Any] = {}
    for f in fields(LogOptions):
        own = getattr(first, f.name)
        values[f.name] = getattr(second, f.name) if own in (None, {}) else own
    return LogOptions(**values)
