"""Units of angles in other people's logs, as factors to radians.

Some logs hold shares of a joint's range (LeRobot's −100 … 100) whose range is not in the log. The
readings give it away: they are whole counts of an encoder apart, and hobby servos with a magnetic
encoder have 4,096 a turn.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

COUNT_RAD = 2 * np.pi / 4096
"""One count of an encoder with 4,096 a turn."""

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


def smallest_step(values: np.ndarray) -> float:
    """Step of which all but a few differences of `values` are multiples; 0 if there is none."""
    steps = np.abs(np.diff(values[np.isfinite(values)]))
    reach = float(np.ptp(values[np.isfinite(values)])) if len(steps) else 0.0
    steps = np.sort(steps[steps > 1e-6 * max(reach, 1e-12)])
    if len(steps) < 10:
        return 0.0
    least = steps[: max(1, len(steps) // 100) + 1]
    guess = float(np.median(least))
    for tolerance in (0.3, 0.2, 0.1):  # small multiples first, then all
        small = steps[steps < guess * (20 if tolerance < 0.3 else 5)]
        counts = np.round(small / guess)
        used = (counts > 0) & (np.abs(small / guess - counts) < tolerance)
        if not used.any():
            return 0.0
        guess = float(np.sum(small[used] * counts[used]) / np.sum(counts[used] ** 2))
    near = steps[steps < 20 * guess]
    fits = np.abs(near / guess - np.round(near / guess)) < 0.1
    return guess if fits.mean() > 0.97 else 0.0
