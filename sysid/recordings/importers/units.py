"""Units of angles in other people's logs, as factors to radians.

Some logs hold shares of a joint's range (LeRobot's −100 … 100) whose range is not in the log. The
readings give it away: they are whole counts of an encoder apart, and hobby servos with a magnetic
encoder have 4,096 a turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.dialect import decimal
from pupper_sysid.common.strict_yaml import printable

COUNT_RAD = 2 * np.pi / 4096
"""One count of an encoder with 4,096 a turn."""

_SCALES = {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "turns": 2 * np.pi}
_NARROWEST_RAD, _WIDEST_RAD = 0.2, 2 * np.pi  # range of a joint


def scale_by_step(positions: ArrayLike, nominal: float, span: float = 1.0) -> tuple[float, str]:
    """Radians per unit of readings whose smallest step is one count of 4,096 a turn.

    Parameters
    ----------
    positions : array_like
    nominal : float
        Range in rad to assume where the readings show no step.
    span : float
        Range in the log's unit: 1 for shares, 200 for −100 … 100.

    Returns
    -------
    scale : float
    text : str
        What was assumed, for a warning.
    """
    step = smallest_step(np.asarray(positions, float))
    found = span * COUNT_RAD / step if step > 0 else 0.0
    if _NARROWEST_RAD <= found <= _WIDEST_RAD:
        return found / span, (
            f"its range was taken as {found:.3f} rad, since its readings are steps of 1/"
            f"{span / step:.0f} of it apart and a step was taken for one count of 4096 a turn"
        )
    return nominal / span, f"its range was assumed to be {nominal:.3f} rad"


def smallest_step(values: NDArray[np.float64]) -> float:
    """Step of which all but a few differences of `values` are multiples; 0 if there is none.

    Examples
    --------
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
    found = (_refined(steps, least / divisor) for divisor in range(1, 7))
    return next((step for step in found if step > 0), 0.0)


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


def unit(text: str, name: str = "`unit`") -> Unit:
    """The unit that `text` names.

    Parameters
    ----------
    text : str
        `rad`, `mrad`, `deg` or `turns`; `counts:4096` with the counts of a turn, half of which is
        0 rad; `percent:RANGE_RAD` of −100 … 100 over a range; `scale:RAD_PER_UNIT`.
    name : str
        Where it was given, for messages.

    Examples
    --------
    >>> unit("deg").scale * 180 == np.pi, unit("counts:4096").zero, unit("percent:4").scale
    (True, 2048.0, 0.02)
    """
    word, _, value = text.strip().partition(":")
    if word in _SCALES and not value:
        return Unit(_SCALES[word])
    try:
        size = decimal(value)
    except ValueError:
        size = 0.0
    if word == "counts" and 2 <= size <= 2**31:
        return Unit(2 * np.pi / size, size / 2, counts=True)
    if word in ("percent", "scale") and 1e-9 <= abs(size) <= 1e3:
        return Unit(size / 200 if word == "percent" else size)
    raise InputError(
        f"{name} is {printable(text)[:40]}. Write rad, deg, turns, counts:4096 (counts of a turn), "
        "percent:3.5 (rad that −100 … 100 span) or scale:0.01 (rad per unit of the log)."
    )
