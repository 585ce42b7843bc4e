"""Fit the servo of one joint, and say what its numbers are, and which of them are known.

`fit_joint` prepares the trials (`sysid.fit.preparation`), fits structures and chooses among them
(`sysid.fit.choice`), and states the result: intervals, why a number is not identified, how well the
model describes the servo, and warnings in sentences.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models import kernel
from pupper_sysid.servo_models.calibration.quantity import words_of
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPDParameters
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters
from pupper_sysid.servo_models.step_size import CONTINUOUS_S, at_step
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice
from pupper_sysid.sysid.fit.choice import (
    Choice,
    Fitted,
    fit_structures,
    goodness_of,
    intervals,
    joined,
    less_age,
    settled,
    stages,
    undescribed,
)
from pupper_sysid.sysid.fit.goodness import DESCRIBED, command_jitter, overall
from pupper_sysid.sysid.fit.posterior import (
    EFFECTIVE,
    HARDLY_CONVERGED,
    R_HAT,
    interval_of,
)
from pupper_sysid.sysid.fit.preparation import PreparedJoint, prepare_joint
from pupper_sysid.sysid.fit.repeats import by_number
from pupper_sysid.sysid.fit.results import (
    RATIO_SOURCES,
    UNTOLD,
    CandidateFit,
    JointCalibrationResult,
    LoadedFit,
    StructureFit,
)
from pupper_sysid.sysid.fit.run import Run, free_run, fresh_residuals
from pupper_sysid.sysid.fit.scores import Scores, held_out_residuals, score
from pupper_sysid.sysid.fit.search import (
    curvature,
    fit_folds,
    folds_of,
    from_about,
    price_of_a_number,
    refine,
    search,
    temperature_at,
    without_limit,
)
from pupper_sysid.sysid.fit.servo_prior import ServoPrior
from pupper_sysid.sysid.fit.structure import (
    AT_BOUND,
    CANDIDATES,
    LIMITS,
    PREFERRED,
    SIMULATED,
    Parameter,
    Structure,
    candidate,
)
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.recordings.recording import Trial

Presets = Mapping[str, Mapping[str, DelayedPDParameters]]
"""Published settings by name, then by joint."""
_NEAR = 64  # starts about a fit without draws, for its fits without a part
_REPORTED_PREFERENCE = 1.05
_WIDE = 4.0
_REACHED = 1.25
"""Ends of the effort limit's interval, up to which a motion at that limit tells back-EMF from
damping. Wider ones gave wrong parts of a right sum on twins (`benchmarks/wide_twins.py`)."""
_ONLY_THE_SUM = "only the sum of damping and back-EMF can be known (`damping_and_back_emf`)"
_FOREIGN = 3.0
"""Standard deviations of a prior from another unit, beyond which it is of another servo."""
_SHARP_DEAD_TIME_S = 0.015
_POLL_SD_S = 1e-3
"""Standard deviation of a poll's instant about its lattice: jitter of the bus and drift."""
_CUT_SHARE = 0.1
"""The same as a share of a 90 % interval: a bound within two standard deviations cuts the draws."""
_COMMAND_WINDOW_S = 0.05
_COVARIANCE_STEP = 0.03  # the slope over a likely error, not of one kink


def fit_joint(
    joint: str,
    trials: Sequence[Trial],
    seed: int = 0,
    presets: Presets | None = None,
    free_air: bool | None = None,
    prior: ServoPrior | None = None,
) -> JointCalibrationResult:
    """Fit the structures to one joint and choose.

    `trials`: all of this joint. `seed`: results depend on the seed and the joint's name. `presets`:
    published settings to score beside the fits. `free_air`: whether the joint carried no load; by
    default what its trials tell. `prior`: numbers of another unit of the servo. Raises InputError
    if there is too little motion.
    """
    ready = prepare_joint(joint, trials, seed, free_air, prior=prior)
    fitted = {stage: fit_structures(ready, stage) for stage in stages(ready)}
    return conclude(ready, fitted, presets)


def joint_lag(joint: str, trials: Sequence[Trial], seed: int = 0) -> LagBudget:
    """Lag budget of one joint, its dead time that of `fit_joint`."""
    ready = prepare_joint(joint, trials, seed)
    fitted = {stage: fit_structures(ready, stage) for stage in stages(ready)}
    ready, _, choice = settled(ready, joined(fitted))
    return _lag(ready, choice, goodness_of(ready, choice.exported))


# ------------------------------------------------------------------------------- results


def conclude(
    ready: PreparedJoint,
    fitted: Mapping[str, Sequence[Fitted]],
    presets: Presets | None = None,
) -> JointCalibrationResult:
    """Choose among the fits of a joint, and say what they tell.

    `fitted`: by stage (`stages`), from `fit_structures`. `presets`: as for `fit_joint`.
    """
    ready, every, choice = settled(ready, joined(fitted))
    if not ready.scales.free_air:
        return _under_load(ready, every, choice)
    return _in_free_air(ready, every, choice, presets)


def _in_free_air(
    ready: PreparedJoint, every: Sequence[Fitted], choice: Choice, presets: Presets | None
) -> JointCalibrationResult:
    runs, folds = ready.runs, folds_of(ready.runs)
    by_name = {f.structure.name: f for f in (*every, *choice.likely)}
    results = {name: _candidate_fit(ready, f, folds) for name, f in by_name.items()}
    least = [f.scores.rmse_unseen_rad for n, f in results.items() if n in SIMULATED]
    for structure in (candidate(name, ready.scales) for name in CANDIDATES):
        if structure.name in SIMULATED:
            continue
        rng, problem = ready.fit_rng(), ready.problem(structure)
        parents = [f for f in by_name.values() if structure.contains(f.structure)]
        more = [structure.adopt(f.structure, f.fit.point) for f in parents]
        if structure.name in by_name:
            fitted = by_name[structure.name]
        else:
            fits = search(problem, rng, np.array(more) if more else None)
            fitted = Fitted(structure, fits[0])
        # a model that errs more on what it was fitted to cannot be better on unseen tones
        residuals = fresh_residuals(structure, fitted.values, runs)
        if rms(*residuals) <= min(least):
            near = fitted.fit.point + _spread(ready, fitted) * rng.standard_normal(
                (_NEAR, len(structure.parameters))
            )
            near = np.clip(np.concatenate([fitted.fit.point[None], near]), *structure.box)
            of_parents = [(f.structure, f.folds) for f in parents if f.folds]
            fitted = replace(fitted, folds=fit_folds(problem, folds, rng, near, of_parents))
        by_name[structure.name] = fitted
        results[structure.name] = _candidate_fit(ready, fitted, folds)
    results = {name: results[name] for name in CANDIDATES}
    exported = choice.exported.structure
    goodness = goodness_of(ready, choice.exported)
    lag = choice.lag
    slight = _slight_limits(ready, choice.exported, goodness)
    if "effort_rad_s2" in slight:
        slight |= _inseparable(results[exported.name].parameters)
    fit = results[exported.name]
    results[exported.name] = replace(fit, undecided=slight | fit.undecided)
    if why := _doubt(choice, goodness):
        kept = _kept(choice)
        results = {name: _doubted(fit, why, kept) for name, fit in results.items()}
        lag = _lag(ready, choice, goodness)
        parameters = results[exported.name].parameters
        hidden = _hidden_rad(ready, choice, goodness)
        offset = _as_wide_as_misfit(parameters["offset_rad"], goodness, hidden)
        results[exported.name] = replace(
            results[exported.name], parameters={**parameters, "offset_rad": offset}
        )
        if _hardly_known(lag, choice):
            fit = results[exported.name]
            undecided = {"dead_time_s": why} | fit.undecided
            results[exported.name] = replace(fit, undecided=undecided)
    elif why := _unconverged(choice.exported):
        fit = _doubted(results[exported.name], why, ("offset_rad",))
        results[exported.name] = fit
    # where the exported one errs no more than the noise, differences between models are chance
    chosen = _best(results, exported.name) if _doubt(choice, goodness) else exported.name
    jitter = command_jitter(
        exported, choice.exported.values, ready.recorded, runs, ready.noise_rad,
        _date_sd_s(ready.lag.feedback), ready.fit_rng(),
    )  # fmt: skip
    return JointCalibrationResult(
        joint=ready.joint,
        model=chosen,
        simulated_model=exported.name,
        structure_nats=choice.nats,
        command_jitter_s=jitter,
        candidate_models=results,
        lag=lag,
        goodness=goodness,
        r_hat=choice.exported.r_hat,
        effective_draws=choice.exported.effective,
        between_recordings=by_number(choice.repeats),
        differences=_differences(ready.joint, choice),
        presets={
            name: score_preset(by_joint[ready.joint], runs)
            for name, by_joint in (presets or {}).items()
            if ready.joint in by_joint
        },
        warnings=(
            *lag.warnings, *ready.warnings(), *_fit_warnings(ready.joint, goodness, choice),
            *_free_warnings(ready, results, chosen, choice),
        ),
        runs=runs,
    )  # fmt: skip


def _slight_limits(
    ready: PreparedJoint, exported: Fitted, goodness: Mapping[str, float]
) -> dict[str, str]:
    """Why limits are not known that explain less than a number must, or the model leaves over.

    A torque that is cut for an instant looks like a link that bends, or play.
    """
    problem, structure, best = ready.problem(exported.structure), exported.structure, exported.fit
    unexplained = 0.5 * problem.samples * (1.0 - max(overall(goodness), 1.0) ** -2)
    slight = {}
    for name in (name for name in LIMITS if name in structure.names):
        without = without_limit(problem, best, structure.names.index(name))
        points = np.array([best.point, without.point])
        with_it, without_it = problem.costs(points) - problem.prior(points)
        gained = without_it - with_it
        if gained < unexplained:
            slight[name] = "it explains less than the model leaves unexplained"
        elif gained < price_of_a_number(problem, best):
            slight[name] = "a servo without it moves the same, as far as readings show"
    return slight


def _doubt(choice: Choice, goodness: Mapping[str, float]) -> str | None:
    """Why the gains mean little: errors above the noise, or an explanation that is better."""
    if why := undescribed(goodness):
        return why
    if choice.misfit is None:
        return None
    return choice.misfit.claim


def _kept(choice: Choice) -> tuple[str, ...]:
    """Numbers that are known, though the model is in doubt: what was fitted without a weight or an
    integral term has another offset.
    """
    return ("dead_time_s",) if choice.misfit is not None else ("offset_rad", "dead_time_s")


def _doubted(fit: CandidateFit, why: str, kept: Sequence[str]) -> CandidateFit:
    return replace(fit, undecided={n: why for n in fit.parameters if n not in kept} | fit.undecided)


def _lag(ready: PreparedJoint, choice: Choice, goodness: Mapping[str, float]) -> LagBudget:
    """The lag budget with the dead time of the choice, as wide as its misfit makes it."""
    dead, lag_s = choice.lag.dead_time_s, choice.lag.lag_s
    if dead is None:
        return choice.lag
    tracks = free_run(choice.exported.structure, choice.exported.values, ready.runs)
    speed = rms(*(np.gradient(t) / r.step_s for t, r in zip(tracks, ready.runs, strict=True)))
    hidden = _hidden_rad(ready, choice, goodness) / max(speed, 1e-9)
    wide = _as_wide_as_misfit(dead, goodness, hidden)
    if np.isfinite(lag_s.high):  # the dynamics lag, too
        wide = replace(wide, high=max(min(wide.high, lag_s.high), dead.high))
    if choice.misfit is not None:
        shortest, longest = choice.misfit.delays_s
        wide = _with_other(wide, dead, choice.misfit.dead_time_s)
        wide = replace(wide, low=min(wide.low, shortest), high=max(wide.high, longest))
    return replace(choice.lag, dead_time_s=replace(wide, low=max(wide.low, 0.0)))


def _hidden_rad(ready: PreparedJoint, choice: Choice, goodness: Mapping[str, float]) -> float:
    """RMS error that is not noise [rad]: a motion in a wrong shape can hide as much."""
    if not undescribed(goodness):
        return 0.0
    error = rms(*fresh_residuals(choice.exported.structure, choice.exported.values, ready.alike))
    return float(error * np.sqrt(1.0 - overall(goodness) ** -2))


def _as_wide_as_misfit(
    interval: Interval, goodness: Mapping[str, float], hidden: float
) -> Interval:
    """An interval wider by what is hidden; errors of numbers grow with those of readings."""
    ratio = overall(goodness) if undescribed(goodness) else 1.0
    value = interval.value
    low = value - ratio * (value - interval.low) - hidden
    return Interval(value, low, value + ratio * (interval.high - value) + hidden)


def _with_other(wide: Interval, interval: Interval, other: float) -> Interval:
    """An interval that holds another value, as uncertain as its own."""
    below, above = interval.value - interval.low, interval.high - interval.value
    return Interval(wide.value, min(wide.low, other - below), max(wide.high, other + above))


def _unconverged(exported: Fitted) -> str | None:
    """Why intervals mean little though the model describes the servo; None if they can be used."""
    most, least = HARDLY_CONVERGED
    if exported.r_hat <= most and exported.effective >= least:
        return None
    return "its draws have not converged"


def _hardly_known(lag: LagBudget, choice: Choice) -> bool:
    """Whether a dead time that was widened is not identified any more: see `_why_unidentified`.

    A model that is in doubt and would have no dead time, or less, makes up for something else.
    """
    assert lag.dead_time_s is not None and choice.lag.dead_time_s is not None
    low, high = lag.dead_time_s.low, lag.dead_time_s.high
    wide = high - low >= _SHARP_DEAD_TIME_S and high > _WIDE * max(low, 0.0)
    return wide or choice.lag.dead_time_s.low <= 0


def _foreign(joint: str, exported: Fitted) -> Iterator[str]:
    """Numbers that are far from those of the unit which was taken as the prior."""
    for p, value in zip(exported.structure.parameters, exported.values, strict=True):
        apart = float(p.encode(value) - p.encode(p.nominal))
        if p.prior_source and abs(apart) > _FOREIGN * p.marginal_sd:
            yield (
                f"{joint}: {_words(_shown(p.name))} is {np.exp(apart):.2g} times that of "
                f"{p.prior_source}, "
                "which units of one servo do not differ by. Is it the same servo at the same gain? "
                "Calibrate without that prior if not."
            )


def _fit_warnings(joint: str, goodness: Mapping[str, float], choice: Choice) -> Iterator[str]:
    if why := undescribed(goodness):
        worst = max((r, name) for name, r in goodness.items() if np.isfinite(r))
        at = f" ({worst[0]:.1f} at {worst[1]})" if overall(goodness) > DESCRIBED else ""
        yield f"{joint}: {why}{at}. The lag holds; gains do not."
    elif not np.isfinite(overall(goodness)):
        yield f"{joint}: too few readings to say how well the model describes this servo."
    if choice.misfit is not None:
        yield choice.misfit.sentence(joint)
    exported = choice.exported
    yield from _foreign(joint, exported)
    yield from _differences(joint, choice)
    if not (exported.r_hat <= R_HAT and exported.effective >= EFFECTIVE):
        yield (
            f"{joint}: the draws have not converged (R̂ {exported.r_hat:.2f}, "
            f"{exported.effective:.0f} effective); intervals may be too narrow."
        )


def _differences(joint: str, choice: Choice) -> tuple[str, ...]:
    if choice.repeats is None:
        return ()
    return tuple(each.sentence(joint) for each in choice.repeats.differences)


def _candidate_fit(
    ready: PreparedJoint, fitted: Fitted, folds: Mapping[str, NDArray[np.bool_]]
) -> CandidateFit:
    structure, values = fitted.structure, fitted.values
    if fitted.draws is None:
        sd = _spread(ready, fitted)
        parameters = {
            p.name: _curved(p, float(v), float(s))
            for p, v, s in zip(structure.parameters, values, sd, strict=True)
        }
    else:
        parameters, sd = intervals(fitted), fitted.draws.std(axis=0)
    fitted_s = parameters["dead_time_s"]
    parameters["dead_time_s"] = less_age(fitted_s, ready)
    speed = max(_command_speed(r) for r in ready.runs)
    undecided = {
        p.name: why
        for p, v, s in zip(structure.parameters, values, sd, strict=True)
        if (why := _why_unidentified(p, float(v), float(s), parameters[p.name], speed))
    }
    if "braking_per_s" in parameters:
        undecided |= _vague("braking_per_s", parameters["braking_per_s"])
    vague = "no_load_speed_rad_s" in undecided or _ratio_of(parameters, "effort_rad_s2") > _REACHED
    if vague:
        undecided |= _inseparable(parameters)
    if "dead_time_s" in undecided and (why := _undated(ready.lag.feedback)):
        undecided["dead_time_s"] = why  # it is what makes the interval wide
    doubt_s = max(t.read_time_doubt_s for t in ready.recorded)
    if fitted_s.value < doubt_s and _wants_less_than_none(ready, fitted, doubt_s):
        why = (
            "the servo answers before its commands, and readings are dated to "
            f"{1e3 * doubt_s:.0f} ms only: gains make up for what the dates are off"
        )
        undecided |= {name: why for name in parameters if name not in ("dead_time_s", "offset_rad")}
    left_out = (
        held_out_residuals(structure, fitted.folds, folds, ready.runs) if (fitted.folds) else {}
    )
    return CandidateFit(
        model=structure.name,
        parameters=parameters,
        undecided=undecided,
        scores=score(free_run(structure, values, ready.runs), ready.runs, left_out),
    )


def _wants_less_than_none(ready: PreparedJoint, fitted: Fitted, doubt_s: float) -> bool:
    """Whether readings dated later by their doubt leave the servo less dead time than the doubt."""
    structure, problem = fitted.structure, ready.problem(fitted.structure)
    later = tuple(replace(r, sample_step=r.sample_step + doubt_s / r.step_s) for r in problem.runs)
    values = fitted.values
    values[0] += doubt_s
    start = np.clip(structure.encode(values), *structure.box)
    problem = replace(problem, runs=later)
    best = from_about(problem, refine(problem, start[None]), ready.fit_rng())
    return float(structure.decode(best.point)[0]) - doubt_s < structure.parameters[0].low


def _ratio_of(parameters: Mapping[str, Interval], name: str) -> float:
    """Upper over lower end of an interval; 1 without one."""
    interval = parameters.get(name)
    return 1.0 if interval is None else interval.high / max(interval.low, 1e-12)


def _vague(name: str, interval: Interval) -> dict[str, str]:
    """Why a number that several fitted ones make is not known; empty if it is."""
    if interval.low <= 0:
        return {name: "it cannot be distinguished from none"}
    wide = interval.high > _WIDE * interval.low
    return {name: f"its interval is wider than a factor of {_WIDE:g}"} if wide else {}


def _inseparable(parameters: Mapping[str, Interval]) -> dict[str, str]:
    """Why damping and back-EMF are not known, of a fit in free air.

    Inside of the effort limit the two brake alike, whether the structure has both or not.
    """
    if "braking_per_s" not in parameters:
        return {}
    return {n: _ONLY_THE_SUM for n in ("back_emf_per_s", "damping_per_s") if n in parameters}


def score_preset(parameters: DelayedPDParameters, runs: Sequence[Run]) -> Scores:
    """Scores of published settings on one joint.

    The offset is that of these readings: their median about it, as in `sysid.fit.predict`.

    `parameters`: of the joint.
    """
    # published for steps of MuJoCo, as those of older calibrations
    one = at_step(parameters.per_inertia(), CONTINUOUS_S, TIME_STEP_S)
    parts = (one.dead_time_s, one.stiffness, one.damping, one.friction_loss, one.effort_limit,
             one.velocity_limit, 0.0)  # fmt: skip
    structure = candidate(PREFERRED)
    values = np.array([float(np.squeeze(part)) for part in parts])
    for _ in range(3):  # the offset moves the start, and with it a little itself
        values[-1] -= np.median(np.concatenate(fresh_residuals(structure, values, runs)))
    return score(free_run(structure, values, runs), runs)


def _date_sd_s(lattice: PollLattice) -> float:
    """Standard deviation of the date of one reading [s]."""
    if lattice.kind != "lattice":
        return 0.0
    return max(float(lattice.blur_s / np.sqrt(12)), _POLL_SD_S)


def _spread(ready: PreparedJoint, fitted: Fitted) -> NDArray[np.float64]:
    """Standard deviations from the curvature of the cost, for models without a posterior."""
    problem = ready.problem(fitted.structure)
    bent = curvature(problem, fitted.fit.point, _COVARIANCE_STEP)
    covariance = np.linalg.pinv(bent + 1e-9 * np.eye(len(bent)))
    scaled = problem.scaled(fitted.fit.point[None])[0]
    # soft-L1 works in units of the noise; its covariance is for residuals of that size
    inflation = temperature_at(problem, fitted.fit) * max(1.0, float(np.mean(scaled**2)))
    return np.sqrt(np.maximum(np.diag(covariance) * inflation, 0.0))


def _curved(parameter: Parameter, value: float, sd: float) -> Interval:
    """Value with its 90 % interval from the standard deviation of the fitted coordinate."""
    z, centre = ndtri((1 + LEVEL) / 2), float(parameter.encode(value))
    box = parameter.encode(parameter.low), parameter.encode(parameter.high)
    low, high = (
        float(parameter.decode(c)) for c in np.clip([centre - z * sd, centre + z * sd], *box)
    )
    return Interval(value, min(low, value), max(high, value))


def _why_unidentified(
    p: Parameter, value: float, sd: float, interval: Interval, speed: float
) -> str | None:
    """Why the data do not identify a number; None if they do.

    `value`, `sd`: its value, and the standard deviation of the fitted coordinate. `speed`: fastest
    command [rad/s].
    """
    if p.name in ("offset_rad", "hanging_rad") or p.name.startswith("gravity"):
        return None
    limit = p.name in ("velocity_limit_rad_s", "no_load_speed_rad_s")
    if limit and speed < 0.8 * value:
        return f"commands reach {speed:.1f} rad/s only, so the limit was never reached"
    delay = p.name == "dead_time_s"
    if delay and interval.high - interval.low < _SHARP_DEAD_TIME_S:
        return None  # a short one may well be close to none
    for bound, end in ((p.low, min(value, interval.low)), (p.high, max(value, interval.high))):
        near = AT_BOUND
        if p.logarithmic and not delay and interval.low > 0:
            near = max(near, _CUT_SHARE * float(np.log(interval.high / interval.low)))
        if p.near(end, bound, near) and (p.logarithmic or abs(value - bound) < AT_BOUND):
            if delay and bound == p.low:
                return f"the recording says only that it is at most {1e3 * interval.high:.0f} ms"
            return f"on its bound, {bound:g}: the recording does not limit it on that side"
    if sd > 0.7 * p.marginal_sd:
        whose = f"that of {p.prior_source}" if p.prior_source else "the prior's"
        return f"these recordings do not excite it; the value is {whose}"
    if interval.low <= 0 and p.logarithmic:
        return "it cannot be distinguished from none"
    if p.logarithmic and interval.high > _WIDE * interval.low:
        return f"its interval is wider than a factor of {_WIDE:g}"
    return None


def _undated(lattice: PollLattice) -> str | None:
    """What in the dates of readings widens the interval of the dead time; None if nothing does."""
    if lattice.time_doubt_s <= 0:
        return None
    if lattice.readings == "polled":
        return "readings are held, their poll is unknown"
    return "it is not known whether readings are live"


def _best(results: Mapping[str, CandidateFit], exported: str) -> str:
    """The model with the smallest error on unseen motion; the one exported where it is as good."""
    errors = {n: f.scores.rmse_unseen_rad for n, f in results.items()}
    errors = {n: e for n, e in errors.items() if np.isfinite(e)}
    if exported not in errors:
        return exported  # one frequency: nothing to choose by
    best = min(errors, key=lambda name: errors[name])
    return exported if errors[exported] <= _REPORTED_PREFERENCE * errors[best] else best


def _free_warnings(
    ready: PreparedJoint, results: Mapping[str, CandidateFit], chosen: str, choice: Choice
) -> Iterator[str]:
    joint, exported = ready.joint, choice.exported.structure.name
    pd = results[exported]
    if why := pd.undecided.get("dead_time_s"):
        yield f"{joint}: the dead time is not identified: {why}."
    limits = {"velocity_limit_rad_s", "no_load_speed_rad_s"} & pd.undecided.keys()
    for limit in limits:
        yield (
            f"{joint}: the speed limit was not excited: {pd.undecided[limit]}. Record a faster "
            "tone or a step."
        )
    if len(choice.likely) > 1 and not limits:
        yield (
            f"{joint}: {UNTOLD} (log Bayes factor {max(choice.nats.values()):.1f}); dead "
            "time and gains cover both. Faster tones at a smaller amplitude separate them "
            "(`pupper-sysid plan`)."
        )
    gains = ("effort_rad_s2", "friction_rad_s2", "stiffness_per_s2", "damping_per_s")
    yield from unidentified(joint, {n: pd.undecided[n] for n in gains if n in pd.undecided})
    unseen_rad = pd.scores.rmse_unseen_rad
    if chosen != exported:
        best = results[chosen].scores.rmse_unseen_rad
        yield (
            f"{joint}: {chosen} predicts unseen motion better ({1e3 * best:.1f} against "
            f"{1e3 * unseen_rad:.1f} mrad); simulators still get DelayedPD, the model they can run."
        )
    if not np.isfinite(unseen_rad):
        only = "frequency" if any(run.tone > 0 for run in ready.runs) else "motion"
        yield f"{joint}: one {only} only, so no model was tested on unseen motion."


def _command_speed(run: Run) -> float:
    """Peak rate of the command [rad/s], over windows longer than a control loop."""
    window = round(_COMMAND_WINDOW_S / run.step_s)
    command = run.command
    if len(command) <= window:
        return 0.0
    moved = command[window:] - command[:-window]
    return float(np.max(np.abs(moved)) / (window * run.step_s))


# ------------------------------------------------------------------------------- under load


def _under_load(
    ready: PreparedJoint, every: Sequence[Fitted], choice: Choice
) -> JointCalibrationResult:
    loaded = _loaded_fit(ready, every, choice)
    structure, values = choice.exported.structure, choice.exported.values
    folds = folds_of(ready.runs)
    left_out = held_out_residuals(structure, choice.exported.folds or [], folds, ready.runs)
    scores = score(free_run(structure, values, ready.runs), ready.runs, left_out)
    goodness, lag = goodness_of(ready, choice.exported), choice.lag
    if why := _doubt(choice, goodness):
        kept = _kept(choice)
        doubted = {n: why for n in loaded.numbers if n not in kept}
        lag = _lag(ready, choice, goodness)
        assert lag.dead_time_s is not None
        doubted |= {"dead_time_s": why} if _hardly_known(lag, choice) else {}
        hidden = _hidden_rad(ready, choice, goodness)
        offset = _as_wide_as_misfit(loaded.numbers["offset_rad"], goodness, hidden)
        loaded = replace(
            loaded, undecided=doubted | loaded.undecided,
            numbers=loaded.numbers | {"dead_time_s": lag.dead_time_s, "offset_rad": offset},
        )  # fmt: skip
    elif why := _unconverged(choice.exported):
        doubted = {n: why for n in loaded.numbers if n != "offset_rad"}
        loaded = replace(loaded, undecided=doubted | loaded.undecided)
    pd = loaded.servo.delayed_pd(loaded.p_gain, 0.0, loaded.motor_torque_nm).arrays()
    inertia = float(np.asarray(loaded.servo.armature))
    inertia += max(i for i, _ in loaded.loads) if loaded.known_load else 0.0
    parameters = {"dead_time_s": loaded.numbers["dead_time_s"]}
    for name, (source, field) in RATIO_SOURCES.items():
        parameters[name] = loaded.relative(source, float(pd[field]) / inertia)
    for name in ("no_load_speed_rad_s", "offset_rad"):
        parameters[name] = loaded.numbers[name]
    braking = loaded.numbers["braking"]
    parameters["braking_per_s"] = loaded.relative("braking", braking.value / inertia)
    undecided = {
        name: loaded.undecided[source]
        for name, (source, _) in RATIO_SOURCES.items()
        if source in loaded.undecided
    }
    undecided |= {k: v for k, v in loaded.undecided.items() if k == "dead_time_s"}
    if "braking" in loaded.undecided:
        undecided["braking_per_s"] = loaded.undecided["braking"]
    nan = float("nan")
    return JointCalibrationResult(
        joint=ready.joint,
        model=loaded.structure,
        simulated_model=SIMULATED[1],
        structure_nats={SIMULATED[1]: 0.0},
        command_jitter_s=Interval(nan, nan, nan),
        candidate_models={SIMULATED[1]: CandidateFit(
            model=SIMULATED[1], parameters=parameters, undecided=undecided, scores=scores
        )},
        lag=lag,
        goodness=goodness,
        r_hat=choice.exported.r_hat,
        effective_draws=choice.exported.effective,
        between_recordings=by_number(choice.repeats),
        differences=_differences(ready.joint, choice),
        presets={},
        warnings=(
            *lag.warnings, *ready.warnings(), *_fit_warnings(ready.joint, goodness, choice),
            *_load_warnings(ready.joint, loaded),
        ),
        loaded=loaded,
        runs=ready.runs,
    )  # fmt: skip


def _sag_rad(structure: Structure, values: NDArray[np.float64], runs: Sequence[Run]) -> float:
    """Mean deflection under a weight that was fitted [rad]: without one it would be an offset."""
    servo = dict(zip(kernel.COLUMNS, structure.columns(values[None])[0], strict=True))
    angles = [r.sample_rad - servo["offset_rad"] - servo["hanging_rad"] for r in runs]
    pulls = [np.mean(np.sin(a)) / r.p_gain for a, r in zip(angles, runs, strict=True) if len(a)]
    return float(-servo["gravity_nm"] / servo["stiffness"] * np.mean(pulls))


def _loaded_fit(ready: PreparedJoint, every: Sequence[Fitted], choice: Choice) -> LoadedFit:
    exported, runs = choice.exported, ready.runs
    structure, scales = exported.structure, ready.scales
    numbers = {name: x[0] for name, x in numbers_of(structure, exported.values[None]).items()}
    ends: dict[str, list[Interval]] = {name: [] for name in numbers}
    spread: dict[str, NDArray] = {}
    for f in choice.likely:
        assert f.draws is not None
        draws = f.structure.decode(f.draws)
        drawn = numbers_of(f.structure, draws)
        for name in numbers.keys() & drawn.keys():
            ends[name].append(interval_of(name, float(numbers[name]), drawn[name]))
        if f.structure.name == structure.name:
            spread = {n: f.draws[:, j] for j, n in enumerate(f.structure.names)}
    numbers = {
        name: Interval(float(numbers[name]), min(e.low for e in x), max(e.high for e in x))
        for name, x in ends.items()
    }
    assert choice.lag.dead_time_s is not None
    numbers["dead_time_s"] = choice.lag.dead_time_s
    if "gravity_sin" in structure.names:
        offset, sag = numbers["offset_rad"], _sag_rad(structure, exported.values, runs)
        numbers["offset_rad"] = _with_other(offset, offset, offset.value + sag)
    speed, undecided = max(_command_speed(r) for r in runs), {}
    named = {_shown(p.name): p for p in structure.parameters}
    for name, interval in numbers.items():
        p = named.get(name)
        if p is not None:
            fitted = float(exported.values[structure.names.index(p.name)])
            scale = interval.value / fitted if fitted else 1.0
            scaled = Interval(fitted, *(x / scale for x in (interval.low, interval.high)))
            why = _why_unidentified(p, fitted, float(np.std(spread[p.name])), scaled, speed)
        elif name in ("hanging_rad", "offset_rad", "gravity_nm") or interval.low > 0:
            wide = name not in ("hanging_rad", "offset_rad", "gravity_nm")
            wide = wide and interval.high > _WIDE * interval.low
            why = f"its interval is wider than a factor of {_WIDE:g}" if wide else None
        else:
            why = "it cannot be distinguished from none"
        if why:
            undecided[name] = why
    if not scales.known_load:
        slight = _slight_limits(ready, exported, goodness_of(ready, exported))
        undecided = {_shown(name): why for name, why in slight.items()} | undecided
    if why := undecided.get("no_load_speed_rad_s"):
        undecided["back_emf"] = why  # a speed on its bound stands for none
    limited = numbers["effort_limit"].value < numbers["stall_torque"].value
    if why := undecided.get("torque_limit" if limited else "stall_torque"):
        undecided["effort_limit"] = why
    if "stall_torque" in undecided and "damping" not in structure.features:
        # back-EMF stands for both: what tells them apart is a motor at its limit
        undecided |= {"back_emf": _ONLY_THE_SUM, "no_load_speed_rad_s": _ONLY_THE_SUM}
    if "dead_time_s" in undecided and (why := _undated(ready.lag.feedback)):
        undecided["dead_time_s"] = why  # it is what makes the interval wide
    labels = [r.label for r in runs]
    per_run = [float(np.mean(np.abs(r))) for r in fresh_residuals(structure, exported.values, runs)]
    return LoadedFit(
        joint=ready.joint,
        structure=structure.name,
        known_load=scales.known_load,
        p_gain=scales.p_gain,
        p_gains=tuple(sorted({r.p_gain for r in runs})),
        loads=tuple(sorted({(float(r.load[0]), float(r.load[1])) for r in runs})),
        reference_voltage_v=ready.reference_voltage_v,
        numbers=numbers,
        undecided=undecided,
        structures=tuple(_summary(f, runs, choice) for f in every),
        folds=tuple(folds_of(runs)),
        mae_by_run_rad={
            label: float(np.mean([e for e, x in zip(per_run, labels, strict=True) if x == label]))
            for label in dict.fromkeys(labels)
        },
        motor_torque_nm=typical_torque(structure, exported.values, runs),
        temperature=exported.temperature,
        lattice=ready.lag.feedback,
        servo=structure.servo(exported.values),
        runs=runs,
    )


def numbers_of(structure: Structure, values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """What a fit under load says, (draws,) each, under the names of `LoadedServoParameters`."""
    by_column = dict(zip(kernel.COLUMNS, structure.columns(values).T, strict=True))
    stall = by_column["effort_limit"]
    by_column |= {
        "duty_per_rad": by_column["stiffness"] / stall, "stall_torque": stall,
        "duty_s_per_rad": by_column["damping"] / stall,
    }  # fmt: skip
    fitted, scales = {_shown(name) for name in structure.names}, structure.scales
    numbers = {"dead_time_s": values[:, 0]}
    also = {"duty_per_rad", "stall_torque", "back_emf", "friction_loss"}
    also |= {"armature"} if scales.known_load else set()
    also |= {"off_brake"} if scales.torque_off else set()
    for column, name in (("stribeck_speed", "stribeck_speed_rad_s"), ("duty_s_per_rad", "damping"),
                         ("torque_limit", "torque_limit_share")):  # fmt: skip
        also |= {column} if name in fitted else set()
    for name in (f.name for f in fields(LoadedServoParameters) if f.name in by_column):
        if name in also or name in fitted:
            numbers[name] = by_column[name]
    numbers["effort_limit"] = np.minimum(stall, by_column["torque_limit"])
    numbers["stiffness_nm_per_rad"] = scales.p_gain * by_column["stiffness"]
    numbers["no_load_speed_rad_s"] = stall / by_column["back_emf"]
    if scales.gravity:
        numbers["gravity_nm"] = by_column["gravity_nm"]
    numbers["braking"] = by_column["damping"] + by_column["back_emf"]
    numbers["hanging_rad"] = by_column["hanging_rad"]
    numbers["offset_rad"] = by_column["offset_rad"]
    return numbers


def _shown(name: str) -> str:
    """Name of a fitted number in `numbers_of`."""
    return {
        "stiffness": "stiffness_nm_per_rad", "stiffness_per_s2": "stiffness_nm_per_rad",
        "effort_rad_s2": "stall_torque", "friction_rad_s2": "friction_loss",
        "damping": "duty_s_per_rad", "damping_per_s": "duty_s_per_rad",
        "stribeck_speed_rad_s": "stribeck_speed", "torque_limit_share": "torque_limit",
        "velocity_limit_rad_s": "velocity_limit",
    }.get(name, name)  # fmt: skip


def typical_torque(structure: Structure, values: NDArray[np.float64], runs: Sequence[Run]) -> float:
    """Median torque of the motor while its torque is on."""
    servo = structure.servo(values)
    torques = []
    for run, track in zip(runs, free_run(structure, values, runs), strict=True):
        speed = np.gradient(track, run.step_s)[:-1]
        duty = np.asarray(servo.duty_per_rad) * run.p_gain * (run.command - track[:-1])
        torque = np.asarray(servo.stall_torque) * np.clip(duty, -1, 1)
        torque = torque - np.asarray(servo.back_emf) * speed
        torques.append(np.abs(torque)[run.torque_on > 0.5])
    return float(np.median(np.concatenate(torques)))


def _summary(fitted: Fitted, runs: Sequence[Run], choice: Choice) -> StructureFit:
    structure, values = fitted.structure, fitted.values
    parts = fresh_residuals(structure, values, runs)
    left_out = (
        held_out_residuals(structure, fitted.folds or [], folds_of(runs), runs)
        if (fitted.folds)
        else {}
    )
    unseen = [float(np.mean(np.abs(r))) for r in left_out.values()]
    return StructureFit(
        name=structure.name,
        parameters={n: float(v) for n, v in zip(structure.names, values, strict=True)},
        mae_rad=float(np.mean([np.mean(np.abs(r)) for r in parts])),
        rmse_rad=rms(*parts),
        mae_unseen_rad=float(np.mean(unseen)) if unseen else float("nan"),
        nats=choice.nats[structure.name],
    )


def _words(name: str) -> str:
    return "damping" if name == "duty_s_per_rad" else words_of(name)  # as a share of the duty


def unidentified(joint: str, undecided: Mapping[str, str]) -> Iterator[str]:
    """A sentence for each reason why numbers are not identified."""
    by_reason: dict[str, list[str]] = {}
    for name, why in undecided.items():
        by_reason.setdefault(why, []).append(_words(name))
    for why, names in by_reason.items():
        *most, last = names
        listed = f"{', '.join(most)} and {last} are" if most else f"{last} is"
        yield f"{joint}: {listed} not identified: {why}."


def _load_warnings(joint: str, loaded: LoadedFit) -> Iterator[str]:
    yield from unidentified(joint, loaded.undecided)
    if lost := loaded.servo.beyond_delayed_pd():
        yield (
            f"{joint}: simulators' actuators do not carry {', '.join(lost)}; DelayedPD has the "
            f"friction of a motor torque of {loaded.motor_torque_nm:.2g}"
            f"{' N·m' if loaded.known_load else ' rad/s²'}. `servo` has the whole servo."
        )
    if not loaded.folds:
        yield f"{joint}: one run only, so no structure was tested on unseen motion."
