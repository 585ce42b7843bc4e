"""Times of other people's logs: units, restarts, and the place of a time stamp within a turn."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.budget import refuse_more
from pupper_sysid.sysid.recordings.importers.shared.log import MOST_TRIALS
from pupper_sysid.sysid.recordings.importers.shared.options import LogOptions

READ_AFTER_SEND_S = 0.0005
"""Time between sending a command and reading the position where a log does not say."""

PAUSE_S = 0.5
"""Between trials whose times start again."""

_LONGEST_DOUBT_S = 1.0
_KNOWN_ORDER_DOUBT_S = 0.001
_SCALES = {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "sec": 1.0, "seconds": 1.0}
_UNIT = re.compile(rf"[_\s(\[]({'|'.join(_SCALES)})[)\]]?$", re.IGNORECASE)
_LOOP_S = (2e-5, 0.5)  # fastest and slowest loop of a servo
_GUESSED = (("s", 1.0), ("milliseconds", 1e-3), ("microseconds", 1e-6), ("nanoseconds", 1e-9))


def seconds(name: str, values: NDArray[np.float64]) -> tuple[NDArray[np.float64], list[str]]:
    """Times of the column `name` in seconds, by its ending, else by their distance.

    Raises
    ------
    InputError
        If they are no times of a servo's log in any unit.
    """
    if found := _UNIT.search(name):
        return values * _SCALES[found[1].lower()], []
    steps = np.diff(values)
    steps = steps[steps > 0]
    if not len(steps):
        raise InputError(f"column {name}: its values do not increase, so they are no times.")
    loop = float(np.median(steps))
    for unit, scale in _GUESSED:
        if _LOOP_S[0] < loop * scale <= _LOOP_S[1]:
            if unit == "s":
                return values, []
            return (values - values[0]) * scale, [
                f"column {name} names no unit; its values were taken as {unit}, since they are "
                f"{loop:.4g} apart. Call it {name}_s, _ms, _us or _ns if that is wrong."
            ]
    return values, []


def loop_period_s(stamp: NDArray[np.float64]) -> float:
    """Median time between rows that follow one another."""
    steps = np.diff(stamp)
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 0.0


def doubt_of_a_turn(stamp: NDArray[np.float64]) -> tuple[float, str]:
    """Half a turn, and the sentence that says why lag and dead time are in doubt by it."""
    doubt = min(loop_period_s(stamp) / 2, _LONGEST_DOUBT_S)
    return doubt, (
        "each row has one time stamp, and the log does not say when in a turn the command was sent "
        f"and the position read: lag and dead time are in doubt by half a turn ({1e3 * doubt:.1f} "
        "ms). If you know, say so: `pupper-sysid import` with --stamp and --read-before-send."
    )


def turns(
    stamp: NDArray[np.float64], options: LogOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, list[str]]:
    """Send times, read times, their doubt and its reason, of rows with one time stamp.

    Without `stamp` and `read_before_send` the order is unknown and the doubt half a turn.
    """
    known = options.stamp is not None or options.read_before_send is not None
    before = bool(options.read_before_send)
    early = {"start": 0.0, "middle": 0.5, "end": 1.0}[options.stamp or "start"]
    first = stamp - early * READ_AFTER_SEND_S
    second = first + READ_AFTER_SEND_S
    send, read = (second, first) if before else (first, second)
    if known:
        return send, read, _KNOWN_ORDER_DOUBT_S, []
    doubt, text = doubt_of_a_turn(stamp)
    return send, read, doubt, [text]


def one_after_another(
    stamp: NDArray[np.float64], trial: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Trial number of each row, and times with trials that start again put after one another.

    A trial is a run of rows of one number in `trial`; a step back in time starts one, too.

    Raises
    ------
    InputError
        If there are too many trials.
    """
    number = np.zeros(len(stamp)) if trial is None else trial
    with np.errstate(invalid="ignore"):
        new = np.concatenate([[False], (np.diff(number) != 0) | (np.diff(stamp) < 0)])
    runs = np.cumsum(new)
    shifted, last = stamp.astype(float).copy(), -np.inf
    starts = np.flatnonzero(np.concatenate([[True], new[1:]]))
    refuse_more("The log", len(starts), MOST_TRIALS, "trials", "Check its times, or split it.")
    for start, end in zip(starts, [*starts[1:], len(stamp)], strict=True):
        own = shifted[start:end]
        if not np.isfinite(own).any():
            continue
        first = float(np.nanmin(own))
        if first <= last:
            own += last + PAUSE_S - first
        last = float(np.nanmax(own))
    return runs.astype(float), shifted
