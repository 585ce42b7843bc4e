"""Upsets: a few commands that never reached the servo.

A line that loses a frame, or a host that stalls, leaves the servo with the command before. Readings
behind it then disagree with any model of the servo for as long as it takes to catch up.
`find_upsets` looks for readings far outside of their tone's noise, one after the other, and asks
whether 1 to 3 lost commands shortly before explain them. A fit leaves out the readings that an
upset touches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import Result, internal
from pupper_sysid.sysid.recordings.recording import Trial

Simulate = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Model minus fresh readings [rad] of a trial, had its rows carried these commands [rad]."""

NATS = 10.0
"""Gain in log-likelihood that lost commands need."""

_FAR = 5.0  # standard deviations
_IN_A_ROW = 2
_EXPLAINED = 0.5  # share of the cost of the readings far off that lost commands must explain
_MOST_LOST = 3
_LONGEST_S = 0.3  # from a lost command to the first reading far off
_LEAST_BULK = 0.3  # of the tone's noise
_TOUCHED = 0.5  # standard deviations by which lost commands move a reading
_MOST_UPSETS = 3  # of a trial: more are no upsets but a wrong model


@dataclass(frozen=True, kw_only=True)
class Upset(Result):
    """Commands that never reached the servo."""

    trial: int
    """Number of the trial."""
    time_s: float
    """When the first of them was sent, from the trial's first command."""
    commands: int
    """How many were lost."""
    nats: float
    """Log-likelihood that this gains."""
    readings: tuple[int, ...] = internal(default=())
    """Fresh readings of the trial that it touches, counted from 0: to be left out of a fit."""


def without_commands(trial: Trial, first: int, rows: int) -> NDArray[np.float64]:
    """Commands in force [rad] had `rows` of them from row `first` on never arrived."""
    command = trial.command_rad.copy()
    command[first : first + rows] = command[first - 1] if first else trial.initial_command_rad
    return command


def find_upsets(
    trial: Trial, time_s: NDArray[np.float64], scale_rad: float, simulate: Simulate
) -> list[Upset]:
    """Find commands of a trial that never reached the servo.

    Parameters
    ----------
    trial : Trial
    time_s : ndarray, shape (fresh,)
        When each fresh reading was measured, on the recording's clock.
    scale_rad : float
        Noise of the trial's tone; where the bulk of the residuals is smaller, that counts.
    simulate : callable
        See `Simulate`; its residuals are those of `time_s`.

    Returns
    -------
    list of Upset
        In time order; empty for most trials.
    """
    found: list[Upset] = []
    given = trial.command_rad
    rest = simulate(given)
    # an upset is part of the tone's noise, unless that is taken from the bulk
    bulk = 1.4826 * float(np.median(np.abs(rest))) if len(rest) else 0.0
    scale_rad = float(np.clip(bulk, _LEAST_BULK * scale_rad, scale_rad))
    rest = rest / scale_rad
    left = np.ones(len(rest), bool)
    for _ in range(_MOST_UPSETS):
        first = _first_far(np.abs(rest), left)
        if first is None:
            break
        best: tuple[float, int, int, NDArray[np.float64]] | None = None
        sent = trial.send_time_s
        for row in np.flatnonzero((sent < time_s[first]) & (sent > time_s[first] - _LONGEST_S)):
            for rows in range(1, _MOST_LOST + 1):
                without = simulate(without_commands(trial, int(row), rows)) / scale_rad
                gain = float(np.sum((_cost(rest) - _cost(without))[left]))
                if best is None or gain > best[0]:
                    best = gain, int(row), rows, without
        run = [first]
        while run[-1] + 1 < len(rest) and abs(rest[run[-1] + 1]) > _FAR:
            run.append(run[-1] + 1)
        if best is None or best[0] < max(NATS, _EXPLAINED * float(np.sum(_cost(rest[run])))):
            left[run] = False  # something else: look on behind it
            continue
        gain, row, rows, without = best
        touched = left & (np.abs(without - rest) > _TOUCHED)
        left &= ~touched
        found.append(
            Upset(
                trial=trial.number, time_s=float(sent[row] - sent[0]), commands=rows, nats=gain,
                readings=tuple(int(k) for k in np.flatnonzero(touched)),
            )
        )  # fmt: skip
    return sorted(found, key=lambda u: u.time_s)


def _cost(residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Soft-L1 cost of residuals in standard deviations."""
    return np.sqrt(1.0 + residual**2) - 1.0


def _first_far(size: NDArray[np.float64], left: NDArray[np.bool_]) -> int | None:
    """The first of several readings in a row that are far off; None without."""
    far = (size > _FAR) & left
    runs = np.lib.stride_tricks.sliding_window_view(far, _IN_A_ROW).all(axis=1)
    return int(np.argmax(runs)) if runs.any() else None
