"""Poll period common to all stretches: which of several explains the readings, and its error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pupper_sysid.sysid.feedback.poll_search import BLUR_S, DRIFT, Phase, Stretch
from pupper_sysid.sysid.feedback.rows import fresh_rows, moving_rows
from pupper_sysid.sysid.feedback.slips import evidence
from pupper_sysid.sysid.recordings.recording import Trial

LONGEST_S = 0.12
"""Longest poll period that is searched for [s]."""

_RIVAL = 5.0  # nats: a period that explains the readings by less worse is not ruled out
_ALTERNATIVES = 4  # periods of the search that are compared in full
# of the period from segment to segment: usual size, and the segments that this is worth
_USUAL_DRIFT, _USUAL_SEGMENTS = 0.002, 3.0
_MEMORY = 3.0  # a wandering period is alike in neighbouring trials: a third of them count


def likeliest_periods(
    trials: Sequence[Trial],
    stretches: Sequence[Stretch],
    periods: Sequence[float],
    loop: float,
    step: float,
) -> tuple[float, ...]:
    """The period that explains best which rows changed and which did not [s], and its rivals.

    Of the best ones of the search and of their aliases, at which the reads meet instants of
    another lattice in the same rows.
    """
    best = periods[0]
    if not np.isfinite(best):
        return (best,)
    tried = [*periods[:_ALTERNATIVES], 2 * best, best / 2]
    tried += [1 / abs(1 / loop - 1 / p) for p in tried if abs(p / loop - 1) > 0.01]
    moving = [moving_rows(t, step) for t in trials]
    changed = sum(int(np.sum(m[fresh_rows(t)])) for t, m in zip(trials, moving, strict=True))
    rows = max(sum(int(m.sum()) for m in moving), 1)
    found = {}
    for period in tried:
        if not 1.02 * loop < period < LONGEST_S:
            continue
        loss = 1.0 - changed / rows * period / loop
        if changed and loss < -0.1:
            continue  # more changes than polls
        loss = float(np.clip(loss, 0.02, 0.98)) if changed else 0.5
        found[period] = sum(evidence(s, period, BLUR_S, loss) for s in stretches)
    if not found:
        return (best,)
    order = sorted(found, key=lambda p: -found[p])
    close = [p for p in order if found[order[0]] - found[p] < _RIVAL]
    return (order[0], *(p for p in close[1:] if abs(p / order[0] - 1) > 2 * DRIFT))


def common_period(parts: Sequence[Stretch], phases: Sequence[Phase]) -> tuple[float, float]:
    """Mean period over the segments of a lattice, and its standard error [s]."""
    weights = np.array([len(s.begin) for s in parts], float)
    periods = np.array([p.period_s for p in phases])
    period = float(np.average(periods, weights=weights))
    effective = max(weights.sum() ** 2 / np.sum(weights**2), 1.0)
    # periods of few segments: their scatter is shrunk towards that of other recordings
    scatter = np.average((periods - period) ** 2, weights=weights) * effective
    usual = _USUAL_SEGMENTS * (_USUAL_DRIFT * period) ** 2
    variance = (scatter + usual) / (effective - 1 + _USUAL_SEGMENTS)
    return period, float(np.sqrt(_MEMORY * variance / effective))
