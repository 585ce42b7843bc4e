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

Units of angles are factors to radians. Some logs hold shares of a joint's range (LeRobot's −100 …
100) whose range is not in the log. The readings give it away: they are whole counts of an encoder
apart, and hobby servos with a magnetic encoder have 4,096 a turn.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ConfigDict, create_model

from pupper_sysid.common.border import read_yaml, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.dialect import decimal, is_decimal
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.columns import SECONDS, UNITS

COUNT_RAD = 2 * np.pi / 4096
"""One count of an encoder with 4,096 a turn."""

LARGEST_RAD = 2 * np.pi + 0.5
"""Largest angle: no joint of a legged robot turns further."""
_COUNTS, _FEWEST_COUNTS = (1024, 4096, 16384, 65536), 100  # a turn
_OF_PART = {1024: "scale:0.005113", 1001: "scale:0.0041888"}
"""Of 1,024 counts in 300 degrees (AX-12 and SCS servos), of 1,000 in 240 (LX-16A)."""
_MOST_DEGREES = 360.0  # of whole numbers that may be degrees
_FARTHEST_DEGREES = 180.0  # from 0, of the same
MOVES_ALIKE = 2.5
"""Factor by which a position may move more or less than its command."""
_ASKEW = 0.3
_STILL = 1e-100
_ANGLE_SCALES = {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "turns": 2 * np.pi}
_NARROWEST_RAD, _WIDEST_RAD = 0.2, 2 * np.pi  # range of a joint


def scale_by_step(positions: ArrayLike, nominal: float) -> tuple[float, str]:
    """Radians per unit of shares of a range, whose smallest step is one count of 4,096 a turn.

    `nominal`: range in rad to assume where the readings show no step. Returns the scale and what
    was assumed, for a warning.
    """
    step = smallest_step(np.asarray(positions, float))
    scale = COUNT_RAD / step if step > 0 else 0.0
    if _NARROWEST_RAD <= scale <= _WIDEST_RAD:
        return scale, (
            f"its range was taken as {scale:.3f} rad, since its readings are steps of 1/"
            f"{1 / step:.0f} of it apart and a step was taken for one count of 4096 a turn"
        )
    return nominal, f"its range was assumed to be {nominal:.3f} rad"


def smallest_step(values: NDArray[np.float64]) -> float:
    """Step of which all but a few differences of `values` are multiples; 0 if there is none.

    >>> round(smallest_step(0.25 * np.array([0, 2, 4, 7, 7, 9, 12, 15, 13, 11, 9, 6, 3])), 6)
    0.25
    """
    known = values[np.isfinite(values)]
    steps = np.abs(np.diff(known))
    steps = np.sort(steps[steps > 1e-6 * np.ptp(known)]) if len(known) else steps
    if len(steps) < 10:
        return 0.0
    least = float(np.median(steps[: len(steps) // 100 + 1]))
    # the smallest difference may be several steps
    candidates = (_refined(steps, least / divisor) for divisor in range(1, 7))
    return next((step for step in candidates if step > 0), 0.0)


def _refined(steps: NDArray[np.float64], guess: float) -> float:
    """The step near `guess` of which `steps` are multiples; 0 if they are none."""
    for reach in (5, 10, 20):  # small multiples first: the error of a guess grows with them
        near = steps[steps < (reach + 0.5) * guess]
        counts = np.round(near / guess)
        used = (counts > 0) & (np.abs(near / guess - counts) < 0.2)
        if used.any():
            guess = float(np.sum(near[used] * counts[used]) / np.sum(counts[used] ** 2))
    near = steps[steps < 20.5 * guess]
    fits = np.abs(near / guess - np.round(near / guess)) < 0.1
    return guess if len(near) >= 5 and fits.mean() > 0.97 else 0.0


@dataclass(frozen=True)
class Unit:
    """How a log's numbers become radians: `(value - zero) * scale`."""

    scale: float = 1.0
    zero: float = 0.0
    counts: bool = False

    def radians(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The values in radians."""
        return (values - self.zero) * self.scale


def unit(text: str, name: str = "`unit`") -> Unit:
    """The unit that `text` names; `name` says where it was given, for messages.

    `rad`, `mrad`, `deg` or `turns`, or other words for them (`degrees`); `counts:4096` with the
    counts of a turn, half of which is 0 rad, or `counts:4096:0` with the count that is;
    `percent:RANGE_RAD` of −100 … 100 over a range; `scale:RAD_PER_UNIT`.

    >>> unit("degrees").scale * 180 == np.pi, unit("counts:4096").zero, unit("percent:4").scale
    (True, 2048.0, 0.02)
    """
    word, _, value = UNITS.get(text.strip().lower(), text.strip()).partition(":")
    if word in _ANGLE_SCALES and not value:
        return Unit(_ANGLE_SCALES[word])
    number, _, middle = value.partition(":")
    try:
        size = decimal(number)
        zero = decimal(middle) if middle else size / 2
    except ValueError:
        size = zero = 0.0
    if word == "counts" and 2 <= size <= 2**31 and abs(zero) <= 2**31:
        return Unit(2 * np.pi / size, zero, counts=True)
    if word in ("percent", "scale") and not middle and 1e-9 <= abs(size) <= 1e3:
        return Unit(size / 200 if word == "percent" else size)
    raise InputError(
        f"{name} is {printable(text)[:40]}. Write rad, deg, turns, counts:4096 (counts of a turn), "
        "counts:4096:0 (0 rad at count 0), percent:3.5 (rad that −100 … 100 span) or scale:0.01 "
        "(rad per unit of the log); deg,rad for commands in deg and positions in rad."
    )


def likely_units(values: NDArray[np.float64]) -> list[str]:
    """What angles beyond a turn may be in, the likeliest unit first."""
    largest = float(np.abs(values).max())
    if (values % 1 != 0).any() or largest <= _FEWEST_COUNTS:
        return ["deg"]
    if (values < 0).any():
        turns = [f"counts:{n}:0" for n in (*_COUNTS[1:], _COUNTS[0]) if largest < n / 2][:2]
        return [*turns, "deg"] if largest > _FARTHEST_DEGREES else ["deg", *turns[:1]]
    turns = [f"counts:{n}" for n in _COUNTS if largest < n][:2]
    units = turns if turns and largest > _MOST_DEGREES else ["deg", *turns[:1]]
    return [*units, *(scale for most, scale in _OF_PART.items() if largest < most)]


def likely_of_pair(
    command: NDArray[np.float64], position: NDArray[np.float64], named: Sequence[str] = ("", "")
) -> list[str]:
    """What a command and its position, one of them beyond a turn, may be in.

    `named`: units that they name. Where one moves many times as far as the other they are in
    different units, which are those by which they move as far.
    """
    spread = float(np.ptp(command)), float(np.ptp(position))
    together = likely_units(np.concatenate([command, position]))
    still = not min(spread) > _STILL
    if still or (not any(named) and 1 / MOVES_ALIKE < spread[0] / spread[1] < MOVES_ALIKE):
        return together
    ranked = []
    turns = [f"counts:{n}:0" for n in _COUNTS]  # also where they were averaged or scaled
    parts = ["scale:0.00174533", "scale:0.000174533"]  # of degrees: 365 for 36.5
    choices = (
        [text] if text else ["rad"] if np.abs(values).max() <= LARGEST_RAD else
        [*likely_units(values), "mrad", *(turns if (values % 1 != 0).any() else parts)]
        for values, text in zip((command, position), named, strict=True)
    )  # fmt: skip
    for texts in product(*choices):
        c, p = map(unit, texts)
        ratio = spread[0] * c.scale / (spread[1] * p.scale)
        apart = (np.mean(command) - c.zero) * c.scale - (np.mean(position) - p.zero) * p.scale
        # a hobby servo's middle is 90°; few logs hold mrad, or counts that are no whole numbers
        apart = min(abs(float(apart)), _ASKEW + abs(abs(float(apart)) - np.pi / 2))
        odd = sum(0.05 if t in parts else t == "mrad" or (t in turns and (v % 1 != 0).any())
                  for t, v in zip(texts, (command, position), strict=True))  # fmt: skip
        if 1 / MOVES_ALIKE < ratio < MOVES_ALIKE:
            ranked.append((abs(np.log(ratio)) + apart + odd, ",".join(texts)))
    return [text for _, text in sorted(ranked)][:2] or together


Stamp = Literal["start", "middle", "end"]
Readings = Literal["live", "polled"]

_DURATION = re.compile(r"([+-]?[0-9.]+(?:e[+-]?[0-9]+)?)\s*(s|ms|us|µs)")
_LONGEST_S = 1.0
_RATES_HZ = (0.1, 100_000.0)


@dataclass(frozen=True)
class LogOptions:
    """Columns, units, names and order of a log. What is left out is found from the log."""

    time: str | None = None
    """Column of the time; of the reading's, where `command_time` is another."""
    command: str | None = None
    position: str | None = None
    """`command` and `position`: columns, with `{joint}` where the joint's name stands:
    `action.{joint}`; or several, with commas. A column of a file without names has its number, from
    0. Of a ROS log the topics."""
    trial: str | None = None
    """Column that numbers or names trials, episodes or loops."""
    joints: Mapping[str, str] = field(default_factory=dict)
    """Joints to read, by the log's name, and what to call them; empty for all."""
    unit: str | None = None
    """See `options.unit`; one of commands and one of positions with a comma: `deg,rad`."""
    units: Mapping[str, str] = field(default_factory=dict)
    """The same for single joints, by the log's name or the new one."""
    read_before_send: bool | None = None
    """Whether a turn reads the position before it sends the command."""
    stamp: Stamp | None = None
    """Where in a turn its time stamp was taken."""
    command_time: str | None = None
    """Column of the times at which the commands were sent."""
    send_after: str | None = None
    """Time from the reading to the command, such as `3ms`; negative for a command before it."""
    rate: float | None = None
    """Rows a second [Hz], instead of the log's times or in want of them."""
    readings: Readings | None = None
    """Whether a reading is the present position or the bus's last poll."""

    def __post_init__(self) -> None:
        stated = {f.name: getattr(self, f.name) for f in fields(self)}
        validated(_MappingFile, {k: v for k, v in stated.items() if v is not None}, "options")
        if isinstance(self.joints, list):
            object.__setattr__(self, "joints", {name: name for name in self.joints})
        for text in [self.unit, *self.units.values()]:
            if text is not None:
                _units(text)
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
        self.send_after_s  # noqa: B018
        for name in ("command", "position"):
            if (text := getattr(self, name)) and text.count("{joint}") > 1:
                raise InputError(f"`{name}` has {{joint}} twice; write it once.")

    def unit_of(self, *names: str) -> tuple[Unit, Unit] | None:
        """Units of a joint's commands and positions under any of its names, if they were given."""
        text = next((self.units[n] for n in names if n in self.units), self.unit)
        return None if text is None else _units(text)

    @property
    def send_after_s(self) -> float | None:
        """Time from the reading to the command [s]; None where it is not known."""
        if self.send_after is None:
            return None
        match = _DURATION.fullmatch(self.send_after.strip())
        known = match is not None and is_decimal(match[1])
        seconds = decimal(match[1]) * SECONDS[match[2]] if match and known else float("inf")
        if abs(seconds) > _LONGEST_S:
            raise InputError(
                f"`send_after` is {printable(self.send_after)[:40]}. Write a time of at most 1 s "
                "with its unit, such as 3ms or 250us."
            )
        return seconds

    @property
    def words(self) -> dict[str, str]:
        """What was stated, as options of a command line take it."""
        known = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "units"}
        known |= {"joints": ",".join(self.joints)}
        return {k: f"{v:g}" if isinstance(v, float) else "" if v is True else str(v)
                for k, v in known.items() if v}  # fmt: skip

    def refuse(self, layout: str, allowed: tuple[str, ...] = ("joints",)) -> None:
        """Refuse options that a layout has no use for."""
        stated = [f.name for f in fields(self) if getattr(self, f.name) not in (None, {})]
        useless = [name for name in stated if name not in allowed]
        if useless:
            raise InputError(
                f"This is a {layout}, which says itself what `{useless[0]}` would say. Leave it "
                "out."
            )


def _units(text: str) -> tuple[Unit, Unit]:
    command, comma, position = text.partition(",")
    return unit(command), unit(position if comma else command)


_KEYS: dict[str, Any] = {name: (kind, None) for name, kind in get_type_hints(LogOptions).items()}
_KEYS |= {"joints": (list[str] | dict[str, str], []), "units": (dict[str, str], {})}
_MappingFile = create_model(
    "_MappingFile", __config__=ConfigDict(extra="forbid", strict=True), **_KEYS
)
"""A mapping file holds what `LogOptions` does; see the module."""


def read_mapping(path: Path) -> LogOptions:
    """Options from a mapping file."""
    data, lines = read_yaml(path)
    return as_options(validated(_MappingFile, data, path, lines).model_dump())


def as_options(options: LogOptions | Mapping[str, Any] | None) -> LogOptions:
    """Options of a log, given as such or as a dictionary with the keys of a mapping file."""
    if isinstance(options, LogOptions):
        return options
    known = validated(_MappingFile, {} if options is None else options, "options")
    return LogOptions(**known.model_dump())


def merged(first: LogOptions, second: LogOptions) -> LogOptions:
    """Options of `first`, and of `second` where `first` has none."""
    names = [f.name for f in fields(LogOptions)]
    return LogOptions(**{n: getattr(first, n) or getattr(second, n) for n in names})
