"""A sparse equation of motion per joint, that a person can read (SINDy).

1. *Delay first.* `DelayedPD` is fitted to the fresh readings; its dead time tells which command
   acts when, so that the rest is an ordinary differential equation.
2. *Structure by regression.* A smoothing spline through the re-timed fresh readings gives speed
   and acceleration; pysindy's sequentially thresholded least squares (S. Brunton, J. Proctor,
   J. Kutz, "Discovering governing equations from data by sparse identification of nonlinear
   dynamical systems", 2016) proposes which physical terms matter, at many thresholds, delays and
   saturation errors. Its *numbers* are not used: derivatives of sparse readings bias stiffness
   and delay.
3. *Numbers by output error.* Each proposed structure, delay included, is fitted so that its free
   run from rest ends up where the readings are (`sysid.identify.output_error`).
4. *Sparsity by free-run cross-validation.* The structure that predicts frequencies it has not
   seen is chosen; among those within 5 % the one with the fewest numbers. Structures one term
   away from it are tried too: a term is there only if the error on unseen frequencies needs it.

`identify` does this for recordings, `fit_equations` for readings that a caller has prepared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.sparse_equation import (
    COEFFICIENTS,
    SparseEquation,
    digits,
    equation,
    explain,
    integrate,
)
from pupper_sysid.sysid.identify.calibrate import joint_rng, prepare_joints
from pupper_sysid.sysid.identify.models import Parameter, Rung, rung
from pupper_sysid.sysid.identify.output_error import Fit, Problem, TrialData, positions
from pupper_sysid.sysid.identify.scores import Scores, score
from pupper_sysid.sysid.identify.search import (
    PREFERRED,
    best_of,
    fit_with_folds,
    fresh_residuals,
    leave_one_out_folds,
)
from pupper_sysid.sysid.identify.sparse_structure import PULLS, Support, ordered, propose
from pupper_sysid.sysid.recordings.recording import Recording

_WITHIN = 1.05  # cross-validation errors this close are a tie: the sparser one wins

_SATURATION = {PULLS[1], "saturation_error_rad"}
_SHARED = {p.name: p for p in rung(PREFERRED).parameters}
_PARAMETERS = {
    "stiffness_per_s2": _SHARED["stiffness_per_s2"],
    "saturated_stiffness_per_s2": replace(
        _SHARED["stiffness_per_s2"], name="saturated_stiffness_per_s2"
    ),
    # hobby servos give full voltage at errors of one to ten degrees
    "saturation_error_rad": Parameter("saturation_error_rad", 0.05, 0.002, 0.6, 1.0),
    "damping_per_s": _SHARED["damping_per_s"],
    # as strong as the usual damping at the usual top speed
    "drag_per_rad": Parameter("drag_per_rad", 10.0, 0.05, 300.0, 1.5),
    "friction_rad_s2": _SHARED["friction_rad_s2"],
}


@dataclass(frozen=True)
class Candidate:
    """One structure that was tried.

    Attributes
    ----------
    terms : tuple of str
        Its coefficients.
    fresh, leave_one_out : float
        Free-run RMS on fresh readings, of the fit to all, and on frequencies not fitted [rad];
        the latter is NaN with one frequency only.
    bic : float
        Bayesian information criterion of the fit to all: decides where there is one frequency.
    """

    terms: Support
    fresh: float
    leave_one_out: float
    bic: float

    def error(self) -> float:
        """What decides: the error on unseen frequencies, or without them the criterion."""
        return self.leave_one_out if np.isfinite(self.leave_one_out) else self.bic


@dataclass(frozen=True)
class EquationResult:
    """The equation of one joint and how well it does.

    Attributes
    ----------
    coefficients : dict of str to float
        Those present, by their names in `COEFFICIENTS`.
    dead_time_s, offset_rad : float
    ranges : dict of str to (float, float)
        Least and greatest value of each number (`dead_time_s` too) when each frequency is left out
        in turn; empty with one frequency only. Shows what the data do not settle.
    scores : Scores
    delayed_pd : Scores
        `DelayedPD`, fitted and scored on the same readings.
    candidates : tuple of Candidate
        Every structure that was tried, best first.
    """

    joint: str
    coefficients: dict[str, float]
    dead_time_s: float
    offset_rad: float
    ranges: dict[str, tuple[float, float]]
    scores: Scores
    delayed_pd: Scores
    candidates: tuple[Candidate, ...]
    warnings: tuple[str, ...]

    @property
    def equation(self) -> str:
        """The equation with numbers and units."""
        return equation(self.coefficients, self.dead_time_s)

    def model(self, time_step_s: float = TIME_STEP_S) -> SparseEquation:
        """The servo model, whose positions include the readings' offset."""
        return SparseEquation(self.coefficients, self.dead_time_s, self.offset_rad, time_step_s)

    def explanation(self) -> list[str]:
        """One line per number: value, unit, meaning, and what it becomes on part of the data."""
        return explain(self.coefficients, self.dead_time_s, self.ranges)


def identify(
    recordings: Sequence[Recording],
    joints: Sequence[str] | None = None,
    seed: int = 0,
    workers: int = 2,
    progress: Callable[[str], None] | None = None,
) -> dict[str, EquationResult]:
    """An equation of motion for every joint of the recordings.

    Parameters and errors as for `sysid.identify.calibrate.calibrate`.
    """
    ready = prepare_joints(recordings, joints, seed, workers)
    found = fit_equations(
        {joint: r.data for joint, r in ready.items()},
        {joint: r.noise_rad for joint, r in ready.items()},
        seed,
        workers,
        progress,
    )
    return {
        joint: replace(result, warnings=(*ready[joint].budget.warnings, *result.warnings))
        for joint, result in found.items()
    }


def fit_equations(
    trial_data: Mapping[str, tuple[TrialData, ...]],
    noise_rad: Mapping[str, float],
    seed: int = 0,
    workers: int = 2,
    progress: Callable[[str], None] | None = None,
) -> dict[str, EquationResult]:
    """An equation of motion for every joint.

    Parameters
    ----------
    trial_data : mapping of str to tuple of TrialData
        Per joint; only the fresh samples in it are fitted, so a caller may leave some out.
    noise_rad : mapping of str to float
        Per joint, the size of residuals beyond which one counts as an outlier [rad].
    seed : int
        A joint's result depends on the seed and its name alone.
    workers : int
        Processes; joints are independent.
    progress : callable, optional
        Called with a joint's name when it is done.
    """
    tasks = [(joint, tuple(data), noise_rad[joint], seed) for joint, data in trial_data.items()]
    found: dict[str, EquationResult] = {}
    if workers <= 1 or len(tasks) <= 1:
        for task in tasks:
            found[task[0]] = _fit_joint(*task)
            if progress:
                progress(task[0])
    else:
        with ProcessPoolExecutor(min(workers, len(tasks))) as pool:
            futures = {pool.submit(_fit_joint, *task): task[0] for task in tasks}
            for future in as_completed(futures):
                found[futures[future]] = future.result()
                if progress:
                    progress(futures[future])
    return {joint: found[joint] for joint in trial_data}


def to_json(results: Mapping[str, EquationResult]) -> dict[str, Any]:
    """What `pupper-sysid sindy --json` prints."""
    joints = {}
    for joint, r in results.items():
        terms = {
            name: {"value": value, "unit": COEFFICIENTS[name].unit}
            | ({"leave_one_out_range": list(r.ranges[name])} if name in r.ranges else {})
            for name, value in r.coefficients.items()
        }
        joints[joint] = {
            "equation": r.equation,
            "terms": terms,
            "dead_time_s": r.dead_time_s,
            "offset_rad": r.offset_rad,
            "rmse_fresh_rad": r.scores.fresh,
            "rmse_held_rad": r.scores.held,
            "rmse_leave_one_frequency_out_rad": r.scores.leave_one_out,
            "candidates": [
                {
                    "terms": list(c.terms),
                    "rmse_fresh_rad": c.fresh,
                    "rmse_leave_one_frequency_out_rad": c.leave_one_out,
                }
                for c in r.candidates
            ],
            "delayed_pd": {
                "rmse_fresh_rad": r.delayed_pd.fresh,
                "rmse_leave_one_frequency_out_rad": r.delayed_pd.leave_one_out,
            },
            "warnings": list(r.warnings),
        }
    return {"joints": joints}


# ------------------------------------------------------------------------------- one joint


def _fit_joint(joint: str, data: tuple[TrialData, ...], noise: float, seed: int) -> EquationResult:
    folds = leave_one_out_folds(data)
    pd = rung(PREFERRED)
    pd_fits = fit_with_folds(pd, data, folds, noise, joint_rng(seed, joint), {})
    tried: dict[Support, tuple[Candidate, list[Fit]]] = {}
    candidates: list[Candidate] = []
    chosen: Support = ()
    wanted = propose(data, dict(zip(pd.names, pd_fits[0].values, strict=True)))
    while wanted:
        for support in wanted:
            model = equation_rung(support)
            near = np.array([_starts(model, f.values) for f in pd_fits])
            fits = fit_with_folds(model, data, folds, noise, joint_rng(seed, joint), {}, near)
            scores = _scores(model, fits, folds, data)
            samples = sum(len(d.sample_step) for d in data)
            bic = 2 * samples * np.log(max(scores.fresh, 1e-9))
            bic += len(model.parameters) * np.log(samples)
            candidate = Candidate(support, scores.fresh, scores.leave_one_out, float(bic))
            tried[support] = candidate, fits
        candidates = sorted((c for c, _ in tried.values()), key=Candidate.error)
        chosen = _choose(candidates).terms
        around = _neighbours(chosen) + _neighbours(candidates[0].terms)
        wanted = [s for s in dict.fromkeys(around) if s not in tried]
    model, fits = equation_rung(chosen), tried[chosen][1]
    everything = Problem(data, (True,) * len(data), noise, {})
    # the fit to all readings may learn from the folds' fits, though never the other way round
    polished = best_of(model, [everything], np.array([[f.values for f in fits]]), 25)
    scores = _scores(model, [*polished, *fits[1:]], folds, data)
    candidates = [replace(c, fresh=scores.fresh) if c.terms == chosen else c for c in candidates]
    values = dict(zip(model.names, map(float, polished[0].values), strict=True))
    every = np.array([f.values for f in [*polished, *fits[1:]]])
    ranges = {
        name: (float(column.min()), float(column.max()))
        for name, column in zip(model.names, every.T, strict=True)
        if folds
    }
    delay, offset = values.pop("dead_time_s"), values.pop("offset_rad")
    ranges.pop("offset_rad", None)
    delayed_pd = _scores(pd, pd_fits, folds, data)
    result = EquationResult(
        joint, values, delay, offset, ranges, scores, delayed_pd, tuple(candidates), ()
    )
    return replace(result, warnings=tuple(_warnings(result)))


def equation_rung(support: Support) -> Rung:
    """The structure as a model that `sysid.identify.output_error` can fit."""

    def simulate(values: NDArray, track: NDArray) -> None:
        rest = np.zeros(track.shape[1])
        integrate(
            track, (rest, rest), dict(zip(support, values, strict=True)), TIME_STEP_S, out=track
        )

    parameters = (
        _SHARED["dead_time_s"], *(_PARAMETERS[name] for name in support), _SHARED["offset_rad"]
    )  # fmt: skip
    return Rung("sparse_equation", parameters, simulate)


def _starts(model: Rung, pd_values: NDArray) -> list[list[float]]:
    """Where to start a structure from: what a fit of `DelayedPD` to the same trials says.

    It saw no more than the trials of its own fold, so nothing of the others reaches the structure.
    """
    pd = dict(zip(_SHARED, pd_values, strict=True))
    kp, effort, speed = (
        pd[name] for name in ("stiffness_per_s2", "effort_rad_s2", "velocity_limit_rad_s")
    )
    starts = []
    # a limited voltage feels like an effort limit, or like a speed limit with more effort behind it
    for scale, later, damping in (
        (1.0, 0.0, pd["damping_per_s"]),
        (1.0, 0.0, effort / speed),
        (2.5, 0.008, 2.0 * effort / speed),
    ):
        guess = {
            "dead_time_s": pd["dead_time_s"] + later,
            "stiffness_per_s2": scale * kp,
            "saturated_stiffness_per_s2": scale * kp,
            "saturation_error_rad": effort / kp,
            "damping_per_s": damping,
            "drag_per_rad": damping / speed,
            "friction_rad_s2": scale * pd["friction_rad_s2"],
            "offset_rad": pd["offset_rad"],
        }
        starts.append([np.clip(guess[p.name], p.low, p.high) for p in model.parameters])
    return starts


def _scores(
    model: Rung,
    fits: Sequence[Fit],
    folds: dict[float, tuple[bool, ...]],
    data: Sequence[TrialData],
) -> Scores:
    held_out = {}
    for (name, use), fold in zip(folds.items(), fits[1:], strict=True):
        left = [d for d, used in zip(data, use, strict=True) if not used]
        held_out[name] = np.concatenate(fresh_residuals(model, fold.values, left))
    return score(positions(model, [(fits[0].values[None], data)])[0][:, 0], data, held_out)


def _choose(ranked: Sequence[Candidate]) -> Candidate:
    """The sparsest within 5 % of the best on unseen frequencies; with one frequency, by BIC."""
    if not np.isfinite(ranked[0].leave_one_out):
        return ranked[0]
    near = [c for c in ranked if c.leave_one_out <= _WITHIN * ranked[0].leave_one_out]
    return min(near, key=lambda c: (len(c.terms), c.leave_one_out))


def _neighbours(support: Support) -> list[Support]:
    """Structures with one term less or more; a saturating term goes with its threshold."""
    terms = [{name} for name in COEFFICIENTS if name not in _SATURATION] + [_SATURATION]
    changed = [set(support) ^ term for term in terms]
    if _SATURATION <= set(support):  # or its saturation made linear
        changed.append(set(support) - _SATURATION | {PULLS[0]})
    return [ordered(names) for names in changed if names & set(PULLS)]


def _warnings(r: EquationResult) -> list[str]:
    said = []
    if not r.ranges:
        said.append(
            f"{r.joint}: one frequency only, so the terms were chosen on the data they were "
            "fitted to (BIC); record more tones to test them on motion they have not seen."
        )
    for name, (low, high) in r.ranges.items():
        if high > 2 * max(low, 1e-12):
            said.append(
                f"{r.joint}: {name} is not settled: {digits(low)} to {digits(high)} depending on "
                "which frequency is left out."
            )
    for name, value in r.coefficients.items():
        p = _PARAMETERS[name]
        if value <= p.low * 1.01 or value >= p.high / 1.01:
            said.append(f"{r.joint}: {name} sits on the bound of its search, {digits(value)}.")
    ours, theirs = r.scores.leave_one_out, r.delayed_pd.leave_one_out
    if ours > _WITHIN * theirs:
        said.append(
            f"{r.joint}: DelayedPD predicts unseen frequencies better ({1e3 * theirs:.1f} against "
            f"{1e3 * ours:.1f} mrad). Its set-point has a speed limit, a state that an equation of "
            "error and speed cannot have."
        )
    return said
