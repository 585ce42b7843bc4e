"""Sparse equation of motion per joint (SINDy): `sparse_equations`.

1. *Delay first.* `DelayedPD` is fitted to the fresh readings; shifted by its dead time, commands
   and readings satisfy an ordinary differential equation.
2. *Structure by regression.* A smoothing spline through the re-timed fresh readings gives speed and
   acceleration, and pysindy's sequentially thresholded least squares (S. Brunton, J. Proctor,
   J. Kutz, "Discovering governing equations from data by sparse identification of nonlinear
   dynamical systems", 2016) says which physical terms carry the acceleration, at many thresholds,
   delays and saturation errors. Its numbers are not used: derivatives of sparse readings bias
   stiffness and delay.
3. *Numbers by output error.* Each proposed structure, dead time included, is fitted in free run
   (`sysid.fit.search`).
4. *Sparsity by free-run cross-validation.* The structure that predicts left-out frequencies best is
   chosen; among those within 5 % the one with the fewest numbers. Structures one term away from it
   are tried too: a term stays only if the error on unseen frequencies needs it.

`fit_equations` does the same for trials that a caller has prepared.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline

from pupper_sysid.common.results import JointResults, Result, derived
from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.kernel import SPARSE
from pupper_sysid.servo_models.sparse_equation import (
    COEFFICIENTS,
    SparseEquation,
    digits,
    equation,
    explain,
)
from pupper_sysid.sysid.doctor import checks
from pupper_sysid.sysid.doctor.checks import Joints, Recordings
from pupper_sysid.sysid.fit.preparation import prepare_joint
from pupper_sysid.sysid.fit.run import Run, free_run
from pupper_sysid.sysid.fit.scores import Scores, held_out_residuals, score
from pupper_sysid.sysid.fit.search import Fit, Problem, fit_folds, folds_of, refined, search
from pupper_sysid.sysid.fit.structure import PREFERRED, Parameter, Structure
from pupper_sysid.sysid.fit.structure import candidate as structure_called

PULLS = ("stiffness_per_s2", "saturated_stiffness_per_s2")
"""Terms that pull toward the command: without one of them it is no servo."""

LINEAR: Support = ("stiffness_per_s2", "damping_per_s")

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
    """One candidate structure."""

    terms: Support
    """Its coefficients."""
    rmse_fresh_rad: float
    rmse_leave_one_frequency_out_rad: float
    """`rmse_fresh_rad` and `rmse_leave_one_frequency_out_rad`: free run on fresh readings, of the
    fit to all, and on frequencies not fitted; the latter is NaN with one frequency only."""
    bic: float
    """Bayesian information criterion of the fit to all: decides where there is one frequency."""

    def error(self) -> float:
        """The error on unseen frequencies, or without them the criterion."""
        unseen = self.rmse_leave_one_frequency_out_rad
        return unseen if np.isfinite(unseen) else self.bic


@dataclass(frozen=True, kw_only=True)
class EquationResult(Result):
    """The equation of one joint, with its errors."""

    joint: str
    coefficients: dict[str, float]
    """Those present, by their names in `COEFFICIENTS`."""
    dead_time_s: float
    offset_rad: float
    leave_one_out_ranges: dict[str, tuple[float, float]]
    """Least and greatest value of each number (`dead_time_s` too) when each frequency is left out
    in turn; empty with one frequency only. Wide where the data do not identify it."""
    scores: Scores
    delayed_pd: Scores
    """`DelayedPD`, fitted and scored on the same readings."""
    candidates: tuple[Candidate, ...]
    """Every structure that was tried, best first."""
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
    ready = checks.each_joint(partial(prepare_joint, seed=seed), recordings, joints, workers)
    runs = {joint: r.alike for joint, r in ready.items()}
    noise_rad = {joint: r.noise_rad for joint, r in ready.items()}
    equations = fit_equations(runs, noise_rad, seed, workers, progress)
    equations = {
        joint: replace(result, warnings=(*ready[joint].lag.warnings, *result.warnings))
        for joint, result in equations.items()
    }
    return Equations(joints=equations)


def fit_equations(
    runs: Mapping[str, tuple[Run, ...]],
    noise_rad: Mapping[str, float | tuple[float, ...]],
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> dict[str, EquationResult]:
    """An equation of motion for every joint of runs that a caller has prepared.

    Only the fresh samples in `runs` are fitted, so a caller may leave some out. `noise_rad` is the
    size of ordinary residuals [rad], of all trials or of each. A joint's result depends on the seed
    and its name alone; `progress` is called with its name when it is done.
    """
    tasks = {joint: (data, noise_rad[joint]) for joint, data in runs.items()}
    return checks.map_joints(partial(_fit_joint, seed=seed), tasks, workers, progress)


def _fit_joint(
    joint: str, task: tuple[tuple[Run, ...], float | tuple[float, ...]], seed: int
) -> EquationResult:
    runs, noise = task
    noise = noise if isinstance(noise, tuple) else (noise,) * len(runs)
    folds = folds_of(runs)
    pd = structure_called(PREFERRED)
    pd_fits = _with_folds(Problem(pd, runs, noise), folds, checks.joint_rng(seed, joint))
    tried: dict[Support, tuple[Candidate, list[Fit]]] = {}
    candidates: list[Candidate] = []
    chosen: Support = ()
    best = dict(zip(pd.names, pd.decode(pd_fits[0].point), strict=True))
    supports = propose(runs, best)
    while supports:
        for support in supports:
            model = equation_model(support)
            near = [model.encode(np.array(_starts(model, pd.decode(f.point)))) for f in pd_fits]
            problem = Problem(model, runs, noise)
            fits = _with_folds(problem, folds, checks.joint_rng(seed, joint), near)
            scores = _scores(model, fits, folds, runs)
            samples = problem.samples
            bic = 2 * samples * np.log(max(scores.rmse_fresh_rad, 1e-9))
            bic += len(model.parameters) * np.log(samples)
            unseen = scores.rmse_unseen_rad
            candidate = Candidate(
                terms=support, rmse_fresh_rad=scores.rmse_fresh_rad,
                rmse_leave_one_frequency_out_rad=unseen, bic=float(bic),
            )  # fmt: skip
            tried[support] = candidate, fits
        candidates = sorted((c for c, _ in tried.values()), key=Candidate.error)
        # the sparsest within 5 % of the best on unseen frequencies; with one frequency, by BIC
        close = [c for c in candidates if c.error() <= _WITHIN * candidates[0].error()]
        chosen = candidates[0].terms
        if np.isfinite(candidates[0].rmse_leave_one_frequency_out_rad):
            chosen = min(close, key=lambda c: (len(c.terms), c.error())).terms
        around = _neighbours(chosen) + _neighbours(candidates[0].terms)
        supports = [s for s in dict.fromkeys(around) if s not in tried]
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
        joint=joint, dead_time_s=values.pop("dead_time_s"), offset_rad=values.pop("offset_rad"),
        coefficients=values, leave_one_out_ranges=ranges, scores=scores,
        delayed_pd=_scores(pd, pd_fits, folds, runs), candidates=tuple(candidates), warnings=(),
    )  # fmt: skip
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
    to_all = search(problem, rng, None if near is None else near[0])[0]
    if near is None:
        return [to_all, *fit_folds(problem, folds, rng)]
    fits = [to_all]
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


def _neighbours(support: Support) -> list[Support]:
    """Structures with one term less or more; a saturating term goes with its threshold."""
    terms = [{name} for name in COEFFICIENTS if name not in _SATURATION] + [_SATURATION]
    changed = [set(support) ^ term for term in terms]
    if _SATURATION <= set(support):  # or its saturation made linear
        changed.append(set(support) - _SATURATION | {PULLS[0]})
    return [ordered(names) for names in changed if names & set(PULLS)]


def _warnings(r: EquationResult) -> list[str]:
    warnings = []
    if not r.leave_one_out_ranges:
        warnings.append(
            f"{r.joint}: one frequency only, so the terms were chosen on the data they were "
            "fitted to (BIC); record more tones to test them on unseen motion."
        )
    for name, (low, high) in r.leave_one_out_ranges.items():
        if high > 2 * max(low, 1e-12):
            warnings.append(
                f"{r.joint}: {name} is not identified: {digits(low)} to {digits(high)} depending "
                "on which frequency is left out."
            )
    for name, value in r.coefficients.items():
        p = _PARAMETERS[name]
        if value <= p.low * 1.01 or value >= p.high / 1.01:
            warnings.append(f"{r.joint}: {name} is at the bound of its search, {digits(value)}.")
    unseen_rad, pd = (s.rmse_unseen_rad for s in (r.scores, r.delayed_pd))
    if unseen_rad > _WITHIN * pd:
        warnings.append(
            f"{r.joint}: DelayedPD predicts unseen frequencies better ({1e3 * pd:.1f} against "
            f"{1e3 * unseen_rad:.1f} mrad). Its set-point has a speed limit, a state that an "
            "equation of error and speed cannot have."
        )
    return warnings


Support = tuple[str, ...]
"""Names of the coefficients of one structure, in the order of `COEFFICIENTS`."""

_MOST_SUPPORTS = 8
_THRESHOLDS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.45, 0.65)  # shares of the acceleration's RMS
_GRID_STEPS = 4  # 8 ms between regression points
_LONGEST_GAP_S = 0.15  # no spline across a stretch without readings
_LEAST_PER_PERIOD = 4.0  # fresh readings per period, below which a spline invents the motion


def propose(data: Sequence[Run], delayed_pd: Mapping[str, float]) -> list[Support]:
    """Structures that pysindy finds in the derivatives, those found most often first.

    `delayed_pd` has the values of the fitted `DelayedPD`: its delay, offset, and the error at which
    it saturates. At most `_MOST_SUPPORTS`, and among them the linear one, to compare with.
    """
    usable = [d for d in data if _dense(d)] or data
    splines = [s for d in usable for s in _motion(d, delayed_pd["offset_rad"])]
    votes: Counter[Support] = Counter()
    for shift in (-0.005, 0.0, 0.005):  # what is delay and what dynamics is known to a few ms
        delay = max(delayed_pd["dead_time_s"] + shift, 0.0) / TIME_STEP_S
        trials = []
        for trial, step, position, speed, acceleration in splines:
            middle = np.arange(len(trial.command)) + 0.5
            late = np.interp(step - delay, middle, trial.command, left=trial.rest_rad)
            trials.append((late - position, speed, acceleration))
        if not trials:
            break
        size = np.abs(np.concatenate([e for e, _, _ in trials]))
        saturation = delayed_pd["effort_rad_s2"] / delayed_pd["stiffness_per_s2"]
        for limit in (saturation, *np.quantile(size, (0.4, 0.7))):
            votes.update(_regress(trials, float(limit)))
    ranked = [support for support, _ in votes.most_common() if support != LINEAR]
    return [LINEAR, *ranked[: _MOST_SUPPORTS - 1]]


def ordered(names: set[str]) -> Support:
    """The coefficients in the order of `COEFFICIENTS`."""
    return tuple(name for name in COEFFICIENTS if name in names)


def _dense(trial: Run) -> bool:
    """Whether a spline through the readings can follow the trial's tone."""
    if not trial.frequency_hz > 0 or len(trial.sample_step) < 8:
        return not trial.frequency_hz > 0
    seconds = (trial.sample_step[-1] - trial.sample_step[0]) * TIME_STEP_S
    return len(trial.sample_step) >= _LEAST_PER_PERIOD * trial.frequency_hz * seconds


def _motion(trial: Run, offset_rad: float) -> list[tuple[Run, NDArray, NDArray, NDArray, NDArray]]:
    """The trial with steps, position, speed and acceleration of a spline through its readings."""
    step, first = np.unique(trial.sample_step, return_index=True)
    if len(step) < 8:
        return []
    spline = make_smoothing_spline(step * TIME_STEP_S, trial.sample_rad[first] - offset_rad)
    grid = np.arange(step[1], step[-2], _GRID_STEPS)  # the ends of a spline's curvature are guesses
    after = np.searchsorted(step, grid, "right")
    grid = grid[(step[after] - step[after - 1]) * TIME_STEP_S <= _LONGEST_GAP_S]
    time = grid * TIME_STEP_S
    if len(grid) < 16:
        return []
    return [(trial, grid, spline(time), spline(time, 1), spline(time, 2))]


def _regress(trials: Sequence[tuple[NDArray, NDArray, NDArray]], limit: float) -> set[Support]:
    """Structures that thresholded least squares leaves at all thresholds.

    Columns and acceleration are divided by their RMS, so that a threshold is the share of the
    acceleration that a term must carry.
    """
    terms: dict[str, Callable[[NDArray, NDArray], NDArray]] = {
        "stiffness_per_s2": lambda v, e: e,
        "saturated_stiffness_per_s2": lambda v, e: np.clip(e, -limit, limit),
        "damping_per_s": lambda v, e: -v,
        "drag_per_rad": lambda v, e: -v * np.abs(v),
        "friction_rad_s2": lambda v, e: -np.sign(v),
    }

    def divided(function: Callable[[NDArray, NDArray], NDArray], by: float):
        # pysindy counts arguments: a lambda with defaults would be taken for one of four variables
        return lambda v, e: function(v, e) / by

    error, speed, acceleration = (np.concatenate(parts) for parts in zip(*trials, strict=True))
    scale = {n: max(rms(f(speed, error)), 1e-9) for n, f in terms.items()}
    unit = max(rms(acceleration), 1e-9)
    supports = set()
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        import pysindy  # seconds, and scikit-learn with it: only who needs it waits

        for threshold in _THRESHOLDS:
            model = pysindy.SINDy(
                optimizer=pysindy.STLSQ(threshold=threshold, alpha=1e-3),
                feature_library=pysindy.CustomLibrary(
                    [divided(f, scale[n]) for n, f in terms.items()]
                ),
            )
            model.fit(
                [v[:, None] for _, v, _ in trials],
                t=_GRID_STEPS * TIME_STEP_S,
                x_dot=[a[:, None] / unit for _, _, a in trials],
                u=[e[:, None] for e, _, _ in trials],
            )
            share = np.asarray(model.coefficients())[0]
            kept = {name for name, c in zip(terms, share, strict=True) if abs(c) > 0}
            if PULLS[1] in kept:
                kept.add("saturation_error_rad")
            if kept & set(PULLS):  # without a pull toward the command it is no servo
                supports.add(ordered(kept))
    return supports
