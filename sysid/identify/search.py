"""Fit one candidate model to one joint: global starts, left-out frequencies.

A servo's cost has many local optima (delay trades against damping, friction against effort), so
every fit is the same search, `fit_problems`: many seeded starts are simulated once, the best are
improved a little, and the best of those are fitted to convergence. `fit_with_folds` runs it for all
trials and for each left-out frequency, to score a model on unseen motion; the fit of DelayedPD to
all trials, whose numbers are exported, evolves a population besides.

`sysid.identify.joint_fit`, `sysid.sparse.equations` and `sysid.servo_fit.physics` fit
their models with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.identify.candidates.models import CandidateModel
from pupper_sysid.sysid.identify.candidates.simulation import TrialData, free_run, look_up
from pupper_sysid.sysid.identify.output_error import (
    DIFFERENCE,
    Fit,
    Problem,
    evolve,
    fit,
    global_starts,
)

PREFERRED = "delayed_pd"
"""DelayedPD with a set-point of limited rate: what a simulator runs unless the data say more."""

SIMULATED = (PREFERRED, "delayed_pd_back_emf")
"""Candidate models that simulators and training can run: DelayedPD with one limit on its speed."""

_MOST_FOLDS = 6
_CANDIDATES = 512
_SHORT, _FINAL = 8, 20  # iterations: enough to rank the starts, enough to converge
_SEARCH_DIFFERENCE = 0.05
_POPULATION, _GENERATIONS = 48, 50


def leave_one_out_folds(data: Sequence[TrialData]) -> dict[float, tuple[bool, ...]]:
    """Which trials remain when each frequency is left out; by trial where there are no tones.

    Returns
    -------
    dict of float to tuple of bool
        By frequency [Hz] (a trial without a tone by -1 minus its number): which trials remain. Of
        many frequencies some are picked, evenly; empty if there is only one.
    """
    labels = [
        round(d.frequency_hz, 2) if d.frequency_hz > 0 else -1.0 - n for n, d in enumerate(data)
    ]
    names = sorted(set(labels))
    if len(names) < 2:
        return {}
    picked = names
    if len(names) > _MOST_FOLDS:  # a fine sweep: every n-th frequency says as much
        index = np.unique(np.round(np.linspace(0, len(names) - 1, _MOST_FOLDS)).astype(int))
        picked = [names[i] for i in index]
    return {name: tuple(label != name for label in labels) for name in picked}


def fit_with_folds(
    model: CandidateModel,
    data: tuple[TrialData, ...],
    folds: dict[float, tuple[bool, ...]],
    noise: float | tuple[float, ...],
    rng: np.random.Generator,
    lower: dict[str, list[Fit]],
    more_starts: NDArray | None = None,
) -> list[Fit]:
    """Best fit to all trials, then to each fold, each from starts of its own.

    A fold never starts from the fit to all trials: that would leave the optimum of the held-out
    frequency within reach.

    Parameters
    ----------
    model : CandidateModel
    data : tuple of TrialData
    folds : dict of float to tuple of bool
        From `leave_one_out_folds`; may be empty.
    noise : float or tuple of float
        Size of ordinary residuals, of all trials or of each [rad].
    rng : numpy.random.Generator
    lower : dict of str to list of Fit
        Fits of simpler models, by name; a model that contains `PREFERRED` starts from its fits.
    more_starts : ndarray, shape (1 + folds, starts, parameters), optional
        Join the global starts.

    Returns
    -------
    list of Fit, 1 + folds of them

    Raises
    ------
    KeyError
        If the model contains `PREFERRED` and `lower` lacks it.
    """
    everything = Problem(data, (True,) * len(data), noise, {})
    problems = [everything, *(replace(everything, use=use) for use in folds.values())]
    if model.name == f"{PREFERRED}_backlash":  # contains DelayedPD: start from its solutions
        starts = [
            [np.insert(f.values, -1, gap) for gap in (0.002, 0.008, 0.025)]
            for f in lower[PREFERRED][: len(problems)]
        ]
        return best_of(model, problems, np.array(starts), 15)
    # Few tones leave many local optima: start from more places. Counted in the data, not in
    # `folds`, so that a fit without folds finds what the same fit with folds finds.
    keep, final = (24, 4) if len(leave_one_out_folds(data)) <= 4 else (8, 3)
    fits = fit_problems(model, problems, rng, keep, final, more_starts)
    if model.name in SIMULATED:  # its numbers are exported: no local optimum will do
        crowd = global_starts(model, [everything], rng, _CANDIDATES, _POPULATION)[0]
        crowd[-1] = fits[0].values
        fits[0] = min(
            fits[0], evolve(model, everything, crowd, rng, _GENERATIONS)[0], key=lambda f: f.cost
        )
    return fits


def fit_problems(
    model: CandidateModel,
    problems: Sequence[Problem],
    rng: np.random.Generator,
    keep: int,
    final: int,
    more_starts: NDArray | None = None,
) -> list[Fit]:
    """Best fit to each problem, searched for globally: simulate many, improve some, fit a few.

    Parameters
    ----------
    model : CandidateModel
    problems : sequence of Problem
    rng : numpy.random.Generator
        Draws the candidates, the same for every problem.
    keep : int
        How many of a problem's candidates are improved a little.
    final : int
        How many of those are fitted to the end.
    more_starts : ndarray, shape (problems, starts, parameters), optional
        Improved together with the kept candidates.

    Returns
    -------
    list of Fit, one per problem
    """
    starts = global_starts(model, problems, rng, _CANDIDATES, keep)
    if more_starts is not None:
        starts = np.concatenate([starts, more_starts], axis=1)
    top = [
        [f.values for f in sorted(early, key=lambda f: f.cost)[:final]]
        for early in _fit_all(model, problems, starts, _SHORT, _SEARCH_DIFFERENCE)
    ]
    return best_of(model, problems, np.array(top), _FINAL)


def best_of(
    model: CandidateModel, problems: Sequence[Problem], starts: NDArray, iterations: int
) -> list[Fit]:
    """The best fit to each problem from starts of its own.

    Parameters
    ----------
    model : CandidateModel
    problems : sequence of Problem
    starts : ndarray, shape (problems, starts, parameters)
    iterations : int

    Returns
    -------
    list of Fit, one per problem
    """
    return [
        min(fits, key=lambda f: f.cost)
        for fits in _fit_all(model, problems, starts, iterations, DIFFERENCE)
    ]


def _fit_all(
    model: CandidateModel,
    problems: Sequence[Problem],
    starts: NDArray,
    iterations: int,
    difference: float,
) -> list[list[Fit]]:
    """A fit from every start of every problem, all in one call."""
    count = starts.shape[1]
    flat = [p for p in problems for _ in range(count)]
    fits = fit(model, flat, starts.reshape(-1, starts.shape[-1]), iterations, difference)
    return [fits[i : i + count] for i in range(0, len(fits), count)]


def fresh_residuals(
    model: CandidateModel, values: NDArray, data: Sequence[TrialData]
) -> list[NDArray]:
    """Free run minus fresh readings of each trial, each of shape (samples,) [rad].

    Parameters
    ----------
    model : CandidateModel
    values : ndarray, shape (parameters,)
    data : sequence of TrialData
    """
    track = free_run(model, values, data)
    return [look_up(p, t.sample_step) - t.sample_rad for p, t in zip(track, data, strict=True)]


def held_out_residuals(
    model: CandidateModel,
    fits: Sequence[Fit],
    folds: dict[float, tuple[bool, ...]],
    data: Sequence[TrialData],
) -> dict[float, NDArray]:
    """Residuals on each left-out frequency [rad], from the fit that has not seen it.

    Parameters
    ----------
    model : CandidateModel
    fits : sequence of Fit
        One per fold.
    folds : dict of float to tuple of bool
        From `leave_one_out_folds`.
    data : sequence of TrialData
    """
    found = {}
    for (name, use), fold in zip(folds.items(), fits, strict=True):
        left = [d for d, used in zip(data, use, strict=True) if not used]
        found[name] = np.concatenate(fresh_residuals(model, fold.values, left))
    return found


def integrated_autocorrelation_time(residuals: Sequence[NDArray]) -> float:
    """Nominal samples per independent one, from their autocorrelation.

    1 + 2 Σ ρ(k) over the lags k at which the autocorrelation ρ stands out of its own noise.

    Parameters
    ----------
    residuals : sequence of ndarray, each of shape (samples,)
        Per trial; correlations do not reach from one to the next.

    Returns
    -------
    float
        In samples, at least 1.
    """
    total, correlation = 0.0, np.zeros(8)
    for r in residuals:
        r = r - r.mean()
        total += float(r @ r)
        for lag in range(1, 9):
            correlation[lag - 1] += float(r[lag:] @ r[:-lag])
    correlation /= max(total, 1e-18)
    positive = np.cumprod(correlation > 0.1)  # up to where it fades into its own noise
    return float(max(1.0, 1.0 + 2.0 * np.sum(correlation * positive)))
