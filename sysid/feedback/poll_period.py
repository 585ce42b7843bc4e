"""Poll period common to all stretches: which of several explains the readings, and its error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pupper_sysid.sysid.feedback.poll_loss import Sure, count_loss, more_changes_than_polls
from pupper_sysid.sysid.feedback.poll_search import BLUR_S, BLURS_S, DRIFT, Phase, Stretch, refine
from pupper_sysid.sysid.feedback.slips import evidence
from pupper_sysid.sysid.recordings.recording import Trial

LONGEST_S = 0.12
"""Longest poll period that is searched for [s]."""

_RIVAL = 5.0  # nats: a period that explains the readings by less worse is not ruled out
_ALTERNATIVES = 4  # periods of the search that are compared in full
# of the period from stretch to stretch: usual size, and the stretches that this is worth
_USUAL_DRIFT, _USUAL_STRETCHES = 0.002, 3.0
_MEMORY = 3.0  # a wandering period is alike in neighbouring stretches: a third of them count


def likeliest_periods(
    trials: Sequence[Trial],
    stretches: Sequence[Stretch],
    periods: Sequence[float],
    loop: float,
    sure: Sequence[Sure],
) -> tuple[float, ...]:
    """The period that explains best which rows changed and which did not [s], and its rivals.

    Of the best ones of the search and of their aliases, at which the reads meet instants of
    another lattice in the same rows. A lattice with fewer polls than changes is none.
    """
    best = periods[0]
    if not np.isfinite(best):
        return (best,)
    tried = [*periods[:_ALTERNATIVES], 2 * best, best / 2]
    tried += [1 / abs(1 / loop - 1 / p) for p in tried if abs(p / loop - 1) > 0.01]
    found = {}
    for period in tried:
        if not 1.02 * loop < period < LONGEST_S:
            continue
        phases = tuple(refine(s, period, BLUR_S, None) for s in stretches)
        if more_changes_than_polls(trials, phases, sure):
            continue
        loss = count_loss(trials, phases, sure)[0]
        loss = float(np.clip(loss, 0.02, 0.98)) if np.isfinite(loss) else 0.5
        # a period may not win by the width of its instants
        found[period] = max(
            sum(evidence(s, period, blur, loss) for s in stretches) for blur in BLURS_S
        )
    if not found:
        return (best,)
    order = sorted(found, key=lambda p: -found[p])
    close = [p for p in order if found[order[0]] - found[p] < _RIVAL]
    return (order[0], *(p for p in close[1:] if abs(p / order[0] - 1) > 2 * DRIFT))


def common_period(
    parts: Sequence[Stretch], phases: Sequence[Phase], stretch: Sequence[int]
) -> tuple[float, float]:
    """Mean period over the stretches of a lattice, and its standard error [s].

    Parameters
    ----------
    parts : sequence of Stretch
        Segments between slips.
    phases : sequence of Phase
        Lattice of each segment.
    stretch : sequence of int
        Which stretch each segment is of. Segments of one see the same wandering period: they count
        as one measurement of it.
    """
    size, of = np.array([len(s.begin) for s in parts], float), np.array(stretch)
    weights = np.bincount(of, size)
    periods = np.bincount(of, size * [p.period_s for p in phases]) / np.maximum(weights, 1)
    period = float(np.average(periods, weights=weights))
    effective = max(weights.sum() ** 2 / np.sum(weights**2), 1.0)
    # periods of few stretches: their scatter is shrunk towards that of other recordings
    scatter = np.average((periods - period) ** 2, weights=weights) * effective
    usual = _USUAL_STRETCHES * (_USUAL_DRIFT * period) ** 2
    variance = (scatter + usual) / (effective - 1 + _USUAL_STRETCHES)
    return period, float(np.sqrt(_MEMORY * variance / effective))
