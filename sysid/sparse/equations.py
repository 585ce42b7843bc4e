"""Sparse equation of motion per joint (SINDy): `sparse_equations`.

1. *Delay first.* `DelayedPD` is fitted to the fresh readings; shifted by its dead time, commands
   and readings satisfy an ordinary differential equation.
2. *Structure by regression.* pysindy proposes which physical terms matter
   (`sysid.sparse.structure`). Its numbers are not used: derivatives of sparse readings
   bias stiffness and delay.
3. *Numbers by output error.* Each proposed structure, dead time included, is fitted in free run
   (`sysid.fit.search`).
4. *Sparsity by free-run cross-validation.* The structure that predicts left-out frequencies best is
   chosen; among those within 5 % the one with the fewest numbers. Structures one term away from it
   are tried too: a term stays only if the error on unseen frequencies needs it.

`fit_equations` does the same for trials that a caller has prepared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import JointResults, Result, derived
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.sparse_equation import (
    COEFFICIENTS,
    SparseEquation,
    digits,
    equation,
    explain,
)
from pupper_sysid.sysid.fit.kernel import SPARSE
from pupper_sysid.sysid.fit.preparation import prepare_joint
from pupper_sysid.sysid.fit.run import Run, free_run
from pupper_sysid.sysid.fit.scores import Scores, held_out_residuals, score
from pupper_sysid.sysid.fit.search import Fit, Problem, fit_folds, folds_of, refined, search
from pupper_sysid.sysid.fit.structure import PREFERRED, Parameter, Structure
from pupper_sysid.sysid.fit.structure import candidate as structure_called
from pupper_sysid.sysid.recordings.joints import (
    Joints,
    Recordings,
    each_joint,
    joint_rng,
    map_joints,
)
from pupper_sysid.sysid.sparse.structure import PULLS, Support, ordered, propose

_WITHIN = 1.05  # cross-validation errors this close are a tie: the sparser one wins

_SATURATION = {PULLS[1], "saturation_error_rad"}
_SHARED = {p.name: p for p in structure_called(PREFERRED).parameters}
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


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One candidate structure.

    Attributes
    ----------
    terms : tuple of str
        Its coefficients.
    rmse_fresh_rad, rmse_leave_one_frequency_out_rad : float
        Free run on fresh readings, of the fit to all, and on frequencies not fitted; the latter is
        NaN with one frequency only.
    bic : float
        Bayesian information criterion of the fit to all: decides where there is one frequency.
    """

    terms: Support
    rmse_fresh_rad: float
    rmse_leave_one_frequency_out_rad: float
    bic: float

    def error(self) -> float:
        """The error on unseen frequencies, or without them the criterion."""
        unseen = self.rmse_leave_one_frequency_out_rad
        return unseen if np.isfinite(unseen) else self.bic


@dataclass(frozen=True, kw_only=True)
class EquationResult(Result):
    """The equation of one joint, with its errors.

    Attributes
    ----------
    coefficients : dict of str to float
        Those present, by their names in `COEFFICIENTS`.
    dead_time_s, offset_rad : float
    leave_one_out_ranges : dict of str to (float, float)
        Least and greatest value of each number (`dead_time_s` too) when each frequency is left out
        in turn; empty with one frequency only. Wide where the data do not identify it.
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
    leave_one_out_ranges: dict[str, tuple[float, float]]
    scores: Scores
    delayed_pd: Scores
    candidates: tuple[Candidate, ...]
    warnings: tuple[str, ...]

    @derived
    def equation(self) -> str:
        """The equation with numbers and units."""
        return equation(self.coefficients, self.dead_time_s)

    def model(self, time_step_s: float = TIME_STEP_S) -> SparseEquation:
        """The servo model, whose positions include the readings' offset."""
        return SparseEquation(self.coefficients, self.dead_time_s, self.offset_rad, time_step_s)

    def __str__(self) -> str:
        return self.equation

    def explanation(self) -> list[str]:
        """One line per number: value, unit, meaning, and its range on part of the data."""
        return explain(self.coefficients, self.dead_time_s, self.leave_one_out_ranges)


@dataclass(frozen=True, kw_only=True, eq=False)
class Equations(JointResults[EquationResult]):
    """Equations of motion by joint."""


def sparse_equations(
    recordings: Recordings,
    joints: Joints = None,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> Equations:
    """Find an equation of motion for every joint.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Trials of one joint are pooled.
    joints : str or sequence of str, optional
        Which joints; by default all that were recorded.
    seed : int
        Results of a joint depend on the seed and its name alone.
    workers : int
        Processes.
    progress : callable, optional
        Called with a joint's name when it is done.

    Returns
    -------
    Equations
        Equation by joint.

    Raises
    ------
    InputError
        If a joint has too little motion.
    """
    ready = each_joint(partial(prepare_joint, seed=seed), recordings, joints, workers)
    found = fit_equations(
        {joint: r.runs for joint, r in ready.items()},
        {joint: r.noise_rad for joint, r in ready.items()},
        seed,
        workers,
        progress,
    )
    return Equations(
        joints={
            joint: replace(result, warnings=(*ready[joint].lag.warnings, *result.warnings))
            for joint, result in found.items()
        }
    )


def fit_equations(
    runs: Mapping[str, tuple[Run, ...]],
    noise_rad: Mapping[str, float | tuple[float, ...]],
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> dict[str, EquationResult]:
    """An equation of motion for every joint.

    Parameters
    ----------
    runs : mapping of str to tuple of Run
        Per joint; only the fresh samples in it are fitted, so a caller may leave some out.
    noise_rad : mapping of str to (float or tuple of float)
        Per joint, the size of ordinary residuals [rad], of all trials or of each.
    seed : int
        A joint's result depends on the seed and its name alone.
    workers : int
        Processes; joints are independent.
    progress : callable, optional
        Called with a joint's name when it is done.
    """
    tasks = {joint: (data, noise_rad[joint]) for joint, data in runs.items()}
    return map_joints(partial(_fit_joint, seed=seed), tasks, workers, progress)


# ------------------------------------------------------------------------------- one joint


def _fit_joint(
    joint: str, task: tuple[tuple[Run, ...], float | tuple[float, ...]], seed: int
) -> EquationResult:
    runs, noise = task
    noise = noise if isinstance(noise, tuple) else (noise,) * len(runs)
    folds = folds_of(runs)
    pd = structure_called(PREFERRED)
    pd_fits = _with_folds(Problem(pd, runs, noise), folds, joint_rng(seed, joint))
    tried: dict[Support, tuple[Candidate, list[Fit]]] = {}
    candidates: list[Candidate] = []
    chosen: Support = ()
    best = dict(zip(pd.names, pd.decode(pd_fits[0].point), strict=True))
    wanted = propose(runs, best)
    while wanted:
        for support in wanted:
            model = equation_model(support)
            near = [model.encode(np.array(_starts(model, pd.decode(f.point)))) for f in pd_fits]
            problem = Problem(model, runs, noise)
            fits = _with_folds(problem, folds, joint_rng(seed, joint), near)
            scores = _scores(model, fits, folds, runs)
            samples = problem.samples
            bic = 2 * samples * np.log(max(scores.rmse_fresh_rad, 1e-9))
            bic += len(model.parameters) * np.log(samples)
            candidate = Candidate(
                terms=support,
                rmse_fresh_rad=scores.rmse_fresh_rad,
                rmse_leave_one_frequency_out_rad=scores.rmse_unseen_rad,
                bic=float(bic),
            )
            tried[support] = candidate, fits
        candidates = sorted((c for c, _ in tried.values()), key=Candidate.error)
        chosen = _choose(candidates).terms
        around = _neighbours(chosen) + _neighbours(candidates[0].terms)
        wanted = [s for s in dict.fromkeys(around) if s not in tried]
    model, fits = equation_model(chosen), tried[chosen][1]
    # the fit to all readings may start from the folds' fits, never the other way round
    ends = np.array([f.point for f in fits])
    polished = refined(Problem(model, runs, noise), ends, len(ends))[0]
    scores = _scores(model, [polished, *fits[1:]], folds, runs)
    candidates = [
        replace(c, rmse_fresh_rad=scores.rmse_fresh_rad) if c.terms == chosen else c
        for c in candidates
    ]
    values = dict(zip(model.names, map(float, model.decode(polished.point)), strict=True))
    every = model.decode(np.array([f.point for f in [polished, *fits[1:]]]))
    ranges = {
        name: (float(column.min()), float(column.max()))
        for name, column in zip(model.names, every.T, strict=True)
        if folds
    }
    ranges.pop("offset_rad", None)
    result = EquationResult(
        joint=joint,
        dead_time_s=values.pop("dead_time_s"),
        offset_rad=values.pop("offset_rad"),
        coefficients=values,
        leave_one_out_ranges=ranges,
        scores=scores,
        delayed_pd=_scores(pd, pd_fits, folds, runs),
        candidates=tuple(candidates),
        warnings=(),
    )
    return replace(result, warnings=tuple(_warnings(result)))


def equation_model(support: Support) -> Structure:
    """The structure as a model that `sysid.fit.search` can fit."""
    parameters = (
        _SHARED["dead_time_s"], *(_PARAMETERS[name] for name in support), _SHARED["offset_rad"]
    )  # fmt: skip

    def columns(values: NDArray) -> NDArray:
        every = np.zeros((len(values), len(COEFFICIENTS) + 1))
        every[:, list(COEFFICIENTS).index("saturation_error_rad")] = np.inf
        every[:, [list(COEFFICIENTS).index(name) for name in support]] = values[:, 1:-1]
        every[:, -1] = values[:, -1]
        return every

    return Structure("sparse_equation", parameters, SPARSE, columns_of=columns)


def _starts(model: Structure, pd_values: NDArray) -> list[list[float]]:
    """Starts of a structure from a fit of `DelayedPD` to the trials of the same fold."""
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


def _with_folds(
    problem: Problem,
    folds: Mapping[str, NDArray[np.bool_]],
    rng: np.random.Generator,
    near: Sequence[NDArray[np.float64]] | None = None,
) -> list[Fit]:
    """The best fit to all runs, then without each fold's, each from starts of its own.

    `near` has further starts of each, in fitted coordinates. A fold does not start from the fit to
    all runs.
    """
    whole = search(problem, rng, None if near is None else near[0])[0]
    if near is None:
        return [whole, *fit_folds(problem, folds, rng)]
    fits = [whole]
    for out, starts in zip(folds.values(), near[1:], strict=True):
        fits.append(search(problem.only(~out), rng, starts)[0])
    return fits


def _scores(
    model: Structure,
    fits: Sequence[Fit],
    folds: Mapping[str, NDArray[np.bool_]],
    runs: Sequence[Run],
) -> Scores:
    track = free_run(model, model.decode(fits[0].point), runs)
    return score(track, runs, held_out_residuals(model, fits[1:], folds, runs))


def _choose(ranked: Sequence[Candidate]) -> Candidate:
    """The sparsest within 5 % of the best on unseen frequencies; with one frequency, by BIC."""
    if not np.isfinite(ranked[0].rmse_leave_one_frequency_out_rad):
        return ranked[0]
    near = [c for c in ranked if c.error() <= _WITHIN * ranked[0].error()]
    return min(near, key=lambda c: (len(c.terms), c.error()))


def _neighbours(support: Support) -> list[Support]:
    """Structures with one term less or more; a saturating term goes with its threshold."""
    terms = [{name} for name in COEFFICIENTS if name not in _SATURATION] + [_SATURATION]
    changed = [set(support) ^ term for term in terms]
    if _SATURATION <= set(support):  # or its saturation made linear
        changed.append(set(support) - _SATURATION | {PULLS[0]})
    return [ordered(names) for names in changed if names & set(PULLS)]


def _warnings(r: EquationResult) -> list[str]:
    found = []
    if not r.leave_one_out_ranges:
        found.append(
            f"{r.joint}: one frequency only, so the terms were chosen on the data they were "
            "fitted to (BIC); record more tones to test them on unseen motion."
        )
    for name, (low, high) in r.leave_one_out_ranges.items():
        if high > 2 * max(low, 1e-12):
            found.append(
                f"{r.joint}: {name} is not identified: {digits(low)} to {digits(high)} depending "
                "on which frequency is left out."
            )
    for name, value in r.coefficients.items():
        p = _PARAMETERS[name]
        if value <= p.low * 1.01 or value >= p.high / 1.01:
            found.append(f"{r.joint}: {name} is at the bound of its search, {digits(value)}.")
    own, pd = (s.rmse_unseen_rad for s in (r.scores, r.delayed_pd))
    if own > _WITHIN * pd:
        found.append(
            f"{r.joint}: DelayedPD predicts unseen frequencies better ({1e3 * pd:.1f} against "
            f"{1e3 * own:.1f} mrad). Its set-point has a speed limit, a state that an equation of "
            "error and speed cannot have."
        )
    return found
