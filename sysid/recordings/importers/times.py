"""Times of other people's logs: units, restarts, and the place of a time stamp within a turn."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.dialect import is_clock
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.columns import SECONDS, UNITS
from pupper_sysid.sysid.recordings.importers.log import MOST_TRIALS
from pupper_sysid.sysid.recordings.importers.options import LogOptions

READ_AFTER_SEND_S = 0.0005
"""Time between sending a command and reading the position where a log does not say."""

PAUSE_S = 0.5
"""Between trials whose times start again."""

_LONGEST_DOUBT_S = 1.0
_KNOWN_ORDER_DOUBT_S = 0.001
_UNIT = re.compile(rf"(?:^|[_\s.(\[])({'|'.join(SECONDS)})[)\]]*$", re.IGNORECASE)
_TICKS_OF = re.compile(
    rf"(?:^|[_(\[]| in )(\d+(?:\.\d+)?) ?({'|'.join(SECONDS)})[)\]]*$", re.IGNORECASE
)
_OF_100_NS = ((6.2e17, 6.8e17), (1.25e17, 1.5e17))  # .NET's from year 1, Windows' from 1601
_LOOP_S = (2e-5, 0.5)  # fastest and slowest loop of a servo
_GUESSED = (("s", 1.0), ("milliseconds", 1e-3), ("microseconds", 1e-6), ("nanoseconds", 1e-9),
            ("days", 86_400.0))  # fmt: skip
_DAY_S = 86_400.0
_NEAR_STEPS = 3  # by which the step over a counter's end may differ from the others
_SCRAMBLED = 0.25  # share of steps back in time
_SLOW_S = 2.0  # no loop of a servo is slower
_CLOCK_SET_S = 3600.0  # a step forward between two trials
_OTHER_DATE = re.compile(r"^(?!\d{4}-\d)\d{1,4}([-/.])(?:\d{1,2}|[A-Z][a-z]{2})\1\d{1,4} ")
_COMPACT = re.compile(r"^(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(?=\d\d)")  # of ISO 8601
_HALF_DAY = re.compile(r" ?([AP])M$")
_PERIODS = ("dt", "ts", "timestep", "time_step", "sample_time", "sampling_time", "sample_period",
            "sampling_period", "period", "control_dt", "loop_time", "cycle_time", "delta_x",
            "delta_t", "wf_increment")  # fmt: skip
_RATES = ("fs", "fps", "rate", "rate_hz", "hz", "frequency_hz", "sample_rate", "sample_rate_hz",
          "sampling_rate", "sampling_rate_hz", "sampling_frequency", "samplerate", "samplingrate",
          "control_rate", "control_frequency", "control_hz", "loop_rate", "loop_frequency",
          "loop_hz", "update_rate", "publish_rate", "sample_frequency")  # fmt: skip
_EVERY = re.compile(
    r"(?<![\w.])(?:every|alle) +([\d.]+) *(ms|us|µs|s)\b|(?<![\w.])([\d.]+) *(fps|hz|khz)\b",
    re.IGNORECASE,
)
_STATED = re.compile(
    r"(?<![\w-])([a-z]\w*(?:[ _]\w+)?)\s*[\s:=,;]\s*[\"']?(\d[\d.]*(?:e[-+]?\d+)?)"
    r"\s*(khz|hz|s|ms|us|µs)?(?![\w.])", re.IGNORECASE,
)  # fmt: skip
_STATED_IN = SECONDS | {"khz": 1e3, "hz": 1.0, "fps": 1.0, "": 1.0}
_UNIT_WORD = rf"({'|'.join(sorted(map(re.escape, UNITS), key=len, reverse=True))})(?!\w)"
_SAYS = r"[\"']? *(?:(?:are |is )?in|are|is|[:=(\[<]) *[\[(<\"']? *"
_ANGLES_IN = re.compile(
    rf"\b(?:angles?|positions|values|(?:angle[ _])?units?|winkel){_SAYS}{_UNIT_WORD}",
    re.IGNORECASE,
)
DRIVES = {"ODrive": "turns", "moteus": "turns", "VESC": "deg"}
"""Drives that do not count radians, and what they count."""
_DRIVE = re.compile(rf"(?<![\w.])({'|'.join(DRIVES)})(?![\w.])", re.IGNORECASE)
_ANGLE = re.compile(r"(?<![^\W_])(rad|radians?|deg|degrees?|°)(?![a-z])", re.IGNORECASE)
_TICK = re.compile(
    r"(?:(?<![\w-])(?:\w*ticks?|timer(?: clock)?|clock|time units?)\b *(?:=|:|is|are|of)|"
    r"\btime in (?:units of)?) *([\d.]+) *(ns|us|µs|ms|khz|mhz)\b", re.IGNORECASE,
)  # fmt: skip
_PERIOD_S = {"khz": 1e-3, "mhz": 1e-6}
_NUMBER = re.compile(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?")


@dataclass(frozen=True)
class Clock:
    """How a column of times becomes seconds."""

    scale: float = 1.0
    zero: float = 0.0
    notes: list[str] = field(default_factory=list)

    def seconds(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The values in seconds."""
        return (values - self.zero) * self.scale


def clock(name: str, values: NDArray[np.float64], tick_s: float | None = None) -> Clock:
    """Unit of the times in the column `name`, by its ending, else by their distance.

    `tick_s` is that of a tick by a remark of the log.
    """
    printed = printable(name)[:60]
    steps = np.diff(np.sort(values) if scrambled(values) else values)
    steps = steps[steps > 0]
    unit_match = _UNIT.search(name)
    stated = SECONDS[unit_match[1].lower()] if unit_match else 0.0
    loop = float(np.median(steps)) if len(steps) else 0.0
    if (several := _TICKS_OF.search(name)) is not None:  # t_100us
        stated = float(several[1]) * SECONDS[several[2].lower()]
        if _LOOP_S[0] < loop * stated <= _LOOP_S[1]:
            return Clock(stated, float(values[0]))
    if not unit_match and tick_s is not None and _LOOP_S[0] < loop * tick_s <= _LOOP_S[1]:
        text = f"ticks of {tick_s:.4g} s were taken for the times in {printed}, as a remark says."
        return Clock(tick_s, float(values[0]), [text])
    if len(values) and any(low < values[0] < high for low, high in _OF_100_NS):
        return Clock(
            1e-7, float(values[0]), [f"{printed} counts steps of 100 ns, as Windows does."]
        )
    usual = [float(of(steps)) * stated for of in (np.median, np.mean)] if len(steps) else [1.0]
    if unit_match and any(_LOOP_S[0] <= step < _SLOW_S for step in usual):
        return Clock(stated)
    if not len(steps):
        raise InputError(
            f"column {printed}: its values do not increase, so they are no times. Give the rows a "
            "second with `rate`, or another column with `time`."
        )
    for unit, scale in _GUESSED[: 4 if unit_match else None]:
        if unit_match and _LOOP_S[0] < loop * scale <= _LOOP_S[1]:
            return Clock(scale, float(values[0]), [
                f"the values of column {printed} are {loop:.4g} apart, which in {unit_match[1]} is "
                f"no servo's loop; they were taken as {unit}. Rename it if that is wrong."
            ])  # fmt: skip
        if _LOOP_S[0] < loop * scale <= _LOOP_S[1]:
            if unit == "s":
                break
            return Clock(scale, float(values[0]), [
                f"column {printed} names no unit; its values were taken as {unit}, since they are "
                f"{loop:.4g} apart. Call it {printed}_s, _ms, _us or _ns if that is wrong."
            ])  # fmt: skip
    return Clock(stated or 1.0)


def times_of_day(path: object, name: str, cells: Sequence[str]) -> NDArray[np.float64]:
    """Seconds of cells such as `2026-05-04T12:30:01.25` or `12:30:01.25`; an empty one is NaN.

    A date in another order is left out: midnights are found in the times of day.
    """
    others = [cell for cell in cells if cell and not is_clock(cell)]
    others = [cell for cell in others if not _NUMBER.fullmatch(cell)] or others
    bare = [cell.strip() for cell in cells]
    for pattern, usual in (
        (_OTHER_DATE, ""),
        (_COMPACT, r"\1-\2-\3T\4:\5:"),
        (re.compile(r"^[^:]*:[^:]*$"), r"00:\g<0>"),  # minutes and seconds
        (re.compile(r"^([^:]*:[^:]*:[^:]*):(?=...$)"), r"\1."),  # milliseconds
    ):
        bare = [pattern.sub(usual, cell) for cell in bare]
    halves = [_HALF_DAY.search(cell) for cell in bare]
    bare = [_HALF_DAY.sub("", cell).replace(",", ".") for cell in bare]
    texts = pd.Series([cell or None for cell in bare], dtype=object)
    try:
        if others:
            raise ValueError
        if texts.str.contains("-", regex=False).any():
            parsed = pd.to_datetime(texts, format="ISO8601", utc=True)
            return (parsed - parsed.min()).dt.total_seconds().to_numpy()
        seconds = pd.to_timedelta(texts).dt.total_seconds().to_numpy()
        if any(halves):  # 12 AM is 0
            afternoon = np.array([m is not None and m[1] == "P" for m in halves])
            seconds = seconds % (_DAY_S / 2) + _DAY_S / 2 * afternoon
    except (ValueError, TypeError, OverflowError):
        printed = printable(others[0])[:40] if others else "a cell"
        raise InputError(
            f"{path}, column {printable(name)[:60]}: '{printed}' is no time. Write seconds, or "
            "2026-05-04T12:30:01.25."
        ) from None
    midnights = np.cumsum(np.concatenate([[0], np.diff(seconds) < -_DAY_S / 2]))
    return seconds + _DAY_S * midnights


def stated_rate(values: Mapping[str, float]) -> float | None:
    """Rows a second by an entry beside a log without times, such as `dt` or `sample rate`."""
    lower = {name.lower().replace(" ", "_"): value for name, value in values.items() if value > 0}
    rates = [1 / lower[name] for name in _PERIODS if name in lower]
    rates += [lower[name] for name in _RATES if name in lower]
    return next((rate for rate in rates if 1 <= rate <= 1 / _LOOP_S[0]), None)


def rate_in(lines: Iterable[str]) -> float | None:
    """Rows a second by the remarks above a table: `# fs = 100 Hz`, `dt: 10 ms`, `Rate,100`."""
    heads = [line[:200] for line in lines]
    matches = (m for line in heads for m in _STATED.finditer(line))
    stated = {m[1]: float(m[2]) * _STATED_IN[(m[3] or "").lower()]
              for m in matches if m[2].count(".") < 2}  # fmt: skip
    for m in (m for line in heads if line[:1] in "#%/!;" for m in _EVERY.finditer(line)):
        name, value, word = ("period", m[1], m[2]) if m[1] else ("fps", m[3], m[4])
        if value.strip(".") and value.count(".") < 2:
            stated.setdefault(name, float(value) * _STATED_IN[word.lower()])
    return stated_rate(stated)


def unwrapped(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Times of a counter of 16 or 32 bits that began again at 0, as those of a longer one."""
    steps = np.diff(values)
    back = steps < 0
    if not back.any() or not (steps > 0).any() or (values % 1 != 0).any():
        return values
    step = float(np.median(steps[steps > 0]))
    for turn in (2.0**16, 2.0**32):
        if (np.abs(steps[back] + turn - step) <= _NEAR_STEPS * step).all():
            return values + turn * np.concatenate([[0], np.cumsum(back)])
    return values


def scrambled(stamp: NDArray[np.float64]) -> bool:
    """Whether rows are in no order of time, or the newest first, rather than in runs."""
    steps = np.diff(stamp)
    return bool((steps < 0).sum() > _SCRAMBLED * max((steps != 0).sum(), 1))


def units_in(text: str, names: Iterable[str]) -> dict[str, str]:
    """Units of angles that remarks such as `angles in degrees` or `cmd: deg` say.

    By the column's name, or by "" for all; without those of which there are several.
    """
    units_of: dict[str, set[str]] = {"": {UNITS[w.lower()] for w in _ANGLES_IN.findall(text)}}
    for name in names:
        if len(name) > 1 and name in text:
            pattern = rf"(?<![\w.]){re.escape(name)}{_SAYS}{_UNIT_WORD}"
            said = re.findall(pattern, text, re.IGNORECASE)
            units_of[name] = {UNITS[word.lower()] for word in said}
    return {name: units.pop() for name, units in units_of.items() if len(units) == 1}


def drive_in(text: str) -> tuple[str, str]:
    """The drive that remarks such as `moteus r4.11` name, and its unit of angles.

    Empty where they name none, several, or a unit beside.
    """
    named = {match.lower() for match in _DRIVE.findall(text)}
    if len(named) != 1 or _ANGLE.search(text):
        return "", ""
    return next((name, unit) for name, unit in DRIVES.items() if name.lower() in named)


def tick_in(text: str) -> float | None:
    """Seconds of a tick by remarks such as `tick = 0.5 us` or `timer clock: 2 MHz`."""
    for number, word in _TICK.findall(text):
        if number.count(".") < 2 and float(f"0{number}") > 0:
            unit, count = word.lower(), float(f"0{number}")
            return _PERIOD_S[unit] / count if unit in _PERIOD_S else SECONDS[unit] * count
    return None


def doubt_of_a_turn(stamp: NDArray[np.float64]) -> tuple[float, str]:
    """Half a turn, and the sentence that says why lag and dead time are in doubt by it."""
    steps = np.diff(stamp)
    steps = steps[steps > 0]
    doubt = min(float(np.median(steps)) / 2 if len(steps) else 0.0, _LONGEST_DOUBT_S)
    return doubt, (
        "each row has one time stamp, and the log does not say when in a turn the command was sent "
        f"and the position read: lag and dead time are in doubt by half a turn ({1e3 * doubt:.1f} "
        "ms). If you know, say so: `pupper-sysid import` with --command-time, --send-after, or "
        "--stamp and --read-before-send."
    )


def turns(
    stamp: NDArray[np.float64], options: LogOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, list[str]]:
    """Send times, read times, their doubt and its reason, of rows with one time stamp.

    Without `stamp`, `read_before_send` and `send_after` the order is unknown and the doubt half a
    turn.
    """
    after = options.send_after_s
    known = options.stamp is not None or options.read_before_send is not None
    before = bool(options.read_before_send)
    apart = after if after is not None else READ_AFTER_SEND_S if before else -READ_AFTER_SEND_S
    early = {"start": 0.0, "middle": 0.5, "end": 1.0}[options.stamp or "start"]
    first = stamp - early * abs(apart)
    read = first if apart >= 0 else first - apart
    send = read + apart
    if after is not None:
        return send, read, 0.0, []
    if known:
        things = ["position was taken as read", "command was taken as sent"]
        one, other = things if before else things[::-1]
        text = (
            f"the {one} first and the {other.replace(' was taken', '')} "
            f"{1e3 * READ_AFTER_SEND_S:g} ms later, in doubt by {1e3 * _KNOWN_ORDER_DOUBT_S:g} ms. "
            f"If more lies between them, give it: `send_after='{'' if before else '-'}3ms'`."
        )
        return send, read, _KNOWN_ORDER_DOUBT_S, [text]
    doubt, text = doubt_of_a_turn(stamp)
    return send, read, doubt, [text]


def sent_at(command_s: NDArray[np.float64], read_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """When the command of each row was sent.

    A row that repeats the time of the one before it holds the same command once more: it counts as
    sent at its reading, but not after the next command.
    """
    again = np.concatenate([[False], np.diff(command_s) == 0])
    following = np.append(command_s, np.inf)[np.searchsorted(command_s, command_s, side="right")]
    return np.where(again, np.clip(read_s, command_s, following), command_s)


def one_after_another(
    stamp: NDArray[np.float64], trial: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Trial number of each row, and times with trials that start again put after one another.

    A trial is a run of rows of one number in `trial`; a step back in time starts one, too, and so
    does one of more than an hour, when a clock was set.
    """
    number = np.zeros(len(stamp)) if trial is None else trial
    with np.errstate(invalid="ignore"):
        steps = np.diff(stamp)
        new = (np.diff(number) != 0) | (steps < 0) | (steps > _CLOCK_SET_S)
    runs = np.cumsum(np.concatenate([[False], new]))
    shifted, last = stamp.astype(float).copy(), -np.inf
    starts = [0, *(1 + np.flatnonzero(new)).tolist()]
    refuse_more("The log", len(starts), MOST_TRIALS, "trials", "Check its times, or split it.")
    for start, end in pairwise([*starts, len(stamp)]):
        part = shifted[start:end]
        if not np.isfinite(part).any():
            continue
        first = float(np.nanmin(part))
        if first <= last:
            part += last + PAUSE_S - first
        last = float(np.nanmax(part))
    return runs.astype(float), shifted
