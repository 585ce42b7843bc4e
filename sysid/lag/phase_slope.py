"""Lags from phases: whole periods settled, tones weighted, one lag for a joint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.lag.step_response import LONGEST_S
from pupper_sysid.sysid.lag.tone import ToneResponse

_ONE_TONE_HZ = 0.05  # closer than that is one tone, twice
_FOLLOWS = 0.5  # of the largest gain: below, a tone says nothing about the delay


def slope(tones: Sequence[ToneResponse], pair: str, near_s: float | None = None) -> Interval:
    """Lag common to all tones: the slope of the phase through the origin, with its interval.

    Parameters
    ----------
    tones : sequence of ToneResponse
    pair : {"raw_rows", "fresh_rows", "fresh_held"}
        All rows or fresh readings against the rows' commands; fresh readings without the
        staircase's ripple against the held command.
    near_s : float, optional
        As in `tone_lags`.
    """
    frequency = np.array([t.frequency_hz for t in tones])
    response, draws = responses(tones, pair)
    weight = tone_weights(tones)
    lags = tone_lags(response, frequency, near_s)
    drawn = lag_near(draws, frequency[:, None], lags[:, None])
    return Interval.of_draws(float(weight @ lags), weight @ drawn)


def responses(
    tones: Sequence[ToneResponse], pair: str
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Responses of all tones and their draws, shapes (tones,) and (tones, draws)."""
    if pair == "fresh_held":
        value, drawn = [t.response for t in tones], [t.response_draws for t in tones]
    elif pair == "fresh_rows":
        value = [t.fresh / t.command_rows for t in tones]
        drawn = [t.fresh_draws / t.command_rows for t in tones]
    else:
        value = [t.raw / t.command_rows for t in tones]
        drawn = [t.raw_draws / t.command_rows for t in tones]
    return np.array(value), np.array(drawn)


def tone_weights(tones: Sequence[ToneResponse]) -> NDArray[np.float64]:
    """Weight of each tone in the joint's lag: inverse variance, 0 where the servo cannot follow.

    Below half of the largest gain the torque or speed limit clips the motion, and its phase is no
    delay.
    """
    gain = np.array([abs(t.response) for t in tones])
    weight = 1.0 / np.array([t.lag_variance_s2 for t in tones])
    weight = np.where(gain >= _FOLLOWS * gain.max(), weight, 0.0)
    return weight / weight.sum()


def tone_lags(
    response: NDArray, frequency_hz: NDArray, near_s: float | None = None
) -> NDArray[np.float64]:
    """Lag of every tone [s], the right whole period of each included.

    A phase leaves the lag open to whole periods. The lowest tone has the longest period and
    settles itself below 2 Hz; above, the lag on which all tones agree best settles it. From there
    each tone takes the period nearest to the lag of the tone below it, for a servo's lag changes
    by far less than half a period from one tone to the next.

    Parameters
    ----------
    response : ndarray of complex, shape (tones,)
    frequency_hz : ndarray, shape (tones,)
    near_s : float, optional
        The lag as other than phases show it, the start of the motion for one: it settles the
        period of a lowest tone above 2 Hz, and of a lag that is longer than the lowest tone allows.
    """
    order = np.argsort(frequency_hz, kind="stable")
    lowest = frequency_hz[order[0]]
    if lowest > 2.0:
        near = _common_lag(response, frequency_hz, near_s)
    elif near_s is not None and near_s > 0.8 / lowest:
        near = near_s
    else:
        near = 0.4 / lowest  # from a tenth of a period early to nine tenths late
    lags = np.empty(len(order))
    for i in order:
        near = lags[i] = lag_near(response[i], frequency_hz[i], near)
    return lags


def _common_lag(response: NDArray, frequency: NDArray, near_s: float | None) -> float:
    """The lag on which all phases agree best."""
    spacing = np.diff(np.unique(frequency))
    # two trials of one tone differ by the error of their fits only
    spacing = spacing[spacing > _ONE_TONE_HZ]
    # tones repeat their common phase pattern after 1 / (smallest spacing); one tone, after 1 / f
    repeat = 0.95 / (spacing.min() if len(spacing) else frequency[0])
    first, last = 0.0, min(LONGEST_S, repeat)
    if near_s is not None and near_s > 0.8 * repeat:
        first, last = near_s - repeat / 2, near_s + repeat / 2
    lags = np.arange(first, last, 2e-4)
    turned = np.angle(response)[:, None] + 2 * np.pi * frequency[:, None] * lags
    return float(lags[int(np.argmax(np.cos(turned).sum(axis=0)))])


def lag_near(response, frequency, centre):
    """Lag of a phase, in the period around `centre` [s]; arrays broadcast."""
    turned = np.angle(response * np.exp(2j * np.pi * frequency * centre))
    return centre - turned / (2 * np.pi * frequency)
