"""Fit the candidate models to one joint, choose one, and find what the data do not identify.

The models of `sysid.identify.candidates` are fitted to fresh readings by output error, from seeded
global starts, and scored by leaving one frequency out. Simulators run DelayedPD with one of two
limits on its speed, the set-point's slew or the motor's back-EMF; of these the one with the smaller
error on unseen frequencies is carried. The intervals of its numbers are quantiles of their
posterior (`sysid.identify.posterior`), over both where the data do not tell them apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPDParameters
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice
from pupper_sysid.sysid.identify.candidates.models import (
    CANDIDATE_MODELS,
    CandidateModel,
    Parameter,
    candidate_model,
)
from pupper_sysid.sysid.identify.candidates.simulation import TrialData, free_run
from pupper_sysid.sysid.identify.noise import command_jitter
from pupper_sysid.sysid.identify.output_error import Fit
from pupper_sysid.sysid.identify.posterior import Posterior, posterior
from pupper_sysid.sysid.identify.preparation import PreparedJoint, prepare_joint, refit
from pupper_sysid.sysid.identify.results import (
    UNTOLD,
    CandidateFit,
    JointCalibrationResult,
    plausible,
)
from pupper_sysid.sysid.identify.scores import Scores, rms, score
from pupper_sysid.sysid.identify.search import (
    PREFERRED,
    SIMULATED,
    fit_with_folds,
    fresh_residuals,
    held_out_residuals,
    integrated_autocorrelation_time,
    leave_one_out_folds,
)
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.recordings.recording import Trial

Presets = Mapping[str, Mapping[str, DelayedPDParameters]]
"""Published settings by name, then by joint."""

_PREFERENCE = 1.05
_WIDE = 4.0
_POLL_SD_S = 1e-3
"""Standard deviation of a poll's instant about its lattice: jitter of the bus and drift."""
_AT_BOUND = 0.03
"""Distance from a bound, in fitted coordinates, that counts as on it."""


def joint_lag(joint: str, trials: tuple[Trial, ...], seed: int = 0) -> LagBudget:
    """Lag budget of one joint, its dead time that of `fit_joint`."""
    ready = prepare_joint(joint, trials, seed)
    return _compared({name: fit_structure(ready, name) for name in SIMULATED}, ready).lag


def fit_joint(
    joint: str, trials: tuple[Trial, ...], seed: int = 0, presets: Presets | None = None
) -> JointCalibrationResult:
    """Fit every candidate model to one joint and choose.

    `prepare_joint`, `fit_structure` of each of `SIMULATED`, and `conclude` are its stages: the
    structures can be fitted side by side.

    Parameters
    ----------
    joint : str
    trials : tuple of Trial
        All of this joint.
    seed : int
        Results depend on the seed and the joint's name.
    presets : dict of str to (dict of joint to DelayedPDParameters), optional
        Published settings to score beside the fits.

    Raises
    ------
    InputError
        If there is too little motion.
    """
    ready = prepare_joint(joint, trials, seed)
    structures = {name: fit_structure(ready, name) for name in SIMULATED}
    return conclude(joint, ready, structures, presets)


@dataclass(frozen=True)
class StructureFit:
    """One model that simulators run, fitted to one joint.

    Attributes
    ----------
    fits : list of Fit
        To all trials, then without each fold's.
    drawn : Posterior
    fitted : CandidateFit
    """

    fits: list[Fit]
    drawn: Posterior
    fitted: CandidateFit


def fit_structure(ready: PreparedJoint, name: str) -> StructureFit:
    """Fit the model `name`, one of `SIMULATED`, and draw its posterior."""
    data, noise, folds = ready.data, ready.noise_rad, leave_one_out_folds(ready.data)
    model = candidate_model(name)
    fits = fit_with_folds(model, data, folds, noise, ready.fit_rng(), {})
    fits[0] = min(fits[0], ready.first[name], key=lambda f: f.cost)
    drawn = posterior(model, data, noise, fits[0], ready.fit_rng())
    again = refit(name, data, noise, replace(fits[0], values=drawn.best))
    fits[0] = min(fits[0], again, key=lambda f: f.cost)
    return StructureFit(fits, drawn, _candidate_fit(model, fits, ready, folds, drawn))


def conclude(
    joint: str,
    ready: PreparedJoint,
    structures: Mapping[str, StructureFit],
    presets: Presets | None = None,
) -> JointCalibrationResult:
    """Fit the other candidate models, compare all and choose.

    Parameters
    ----------
    joint : str
    ready : PreparedJoint
    structures : dict of str to StructureFit
        Of all of `SIMULATED`.
    presets : dict, optional
        As for `fit_joint`.
    """
    structures = {name: structures[name] for name in SIMULATED}
    data, noise, folds = ready.data, ready.noise_rad, leave_one_out_folds(ready.data)
    pd = _compared(structures, ready)
    best = {name: s.fits for name, s in structures.items()}
    fitted = {name: s.fitted for name, s in structures.items()}
    unseen = [f.scores.rmse_leave_one_frequency_out_rad for f in fitted.values()]
    for model in CANDIDATE_MODELS:
        if model.name in best:
            continue
        fits = fit_with_folds(model, data, {}, noise, ready.fit_rng(), best)
        made = _candidate_fit(model, fits, ready, {})
        # a model that errs more on what it was fitted to cannot be better on unseen tones
        if made.scores.rmse_fresh_rad <= min(unseen):
            fits = fit_with_folds(model, data, folds, noise, ready.fit_rng(), best)
            made = _candidate_fit(model, fits, ready, folds)
        best[model.name], fitted[model.name] = fits, made
    fitted = {model.name: fitted[model.name] for model in CANDIDATE_MODELS}
    chosen = _choose(fitted, pd.carried)
    jitter = command_jitter(
        candidate_model(pd.carried), best[pd.carried][0].values, ready.recorded, data, noise,
        _date_sd_s(ready.lag.feedback), ready.fit_rng(),
    )  # fmt: skip
    return JointCalibrationResult(
        joint=joint,
        model=chosen,
        simulated_model=pd.carried,
        structure_nats=pd.nats,
        command_jitter_s=jitter,
        candidate_models=fitted,
        lag=pd.lag,
        presets={
            name: score_preset(by_joint[joint], data)
            for name, by_joint in (presets or {}).items()
            if joint in by_joint
        },
        warnings=(
            *pd.lag.warnings,
            *ready.warnings(joint),
            *_warnings(joint, fitted, chosen, pd),
        ),
        trials=data,
    )


def _date_sd_s(lattice: PollLattice) -> float:
    """Standard deviation of the date of one reading [s]."""
    if lattice.kind != "lattice":
        return 0.0
    return max(float(lattice.blur_s / np.sqrt(12)), _POLL_SD_S)


@dataclass(frozen=True)
class _Compared:
    """Comparison of the models that simulators run.

    Attributes
    ----------
    nats : dict of str to float
        By how much the log-likelihood of each is below that of the best.
    carried : str
    lag : LagBudget
        With dead time and offset.
    """

    nats: dict[str, float]
    carried: str
    lag: LagBudget


def _compared(structures: Mapping[str, StructureFit], ready: PreparedJoint) -> _Compared:
    drawn = {name: s.drawn for name, s in structures.items()}
    fitted = {name: s.fitted for name, s in structures.items()}
    # both are counted at the temperature of the better one, or the worse fit would excuse itself
    best = min(drawn, key=lambda name: drawn[name].lowest_cost)
    nats = {
        name: (d.lowest_cost - drawn[best].lowest_cost) / drawn[best].temperature
        for name, d in drawn.items()
    }
    errors = {n: f.scores.rmse_leave_one_frequency_out_rad for n, f in fitted.items()}
    known = np.isfinite(list(errors.values())).all()
    # within a hundredth an error on unseen frequencies says less than the likelihood
    close = [n for n in errors if not known or errors[n] <= 1.01 * min(errors.values())]
    carried = min(close, key=lambda name: nats[name])
    intervals = [fitted[n].parameters["dead_time_s"] for n in {carried, *plausible(nats)}]
    # readings that were taken later than dated lengthen the dead time, as they do the lag
    doubt = ready.lag.feedback.time_doubt_s + max(t.read_time_doubt_s for t in ready.recorded)
    dead_time = Interval(
        fitted[carried].parameters["dead_time_s"].value,
        min(i.low for i in intervals),
        max(i.high for i in intervals),
    ).widened(doubt)
    dead_time = replace(dead_time, low=max(dead_time.low, 0.0))
    offset = fitted[carried].parameters["offset_rad"].value
    lag = ready.lag.with_dead_time(dead_time, offset)
    return _Compared(nats, carried, lag)


def score_preset(parameters: DelayedPDParameters, data: tuple[TrialData, ...]) -> Scores:
    """Scores of published settings on one joint.

    The offset is that of these readings: their median about it, as in `sysid.compare`.

    Parameters
    ----------
    parameters : DelayedPDParameters
        Of the joint.
    data : tuple of TrialData
    """
    one = parameters.per_inertia()
    parts = (one.dead_time_s, one.stiffness, one.damping, one.friction_loss, one.effort_limit,
             one.velocity_limit, 0.0)  # fmt: skip
    values = np.array([np.asarray(part, float).item() for part in parts])
    model = candidate_model(PREFERRED)
    values[-1] = -np.median(np.concatenate(fresh_residuals(model, values, data)))
    return score(free_run(model, values, data), data, {})


def _candidate_fit(
    model: CandidateModel,
    fits: list[Fit],
    ready: PreparedJoint,
    folds: dict[float, tuple[bool, ...]],
    drawn: Posterior | None = None,
) -> CandidateFit:
    data, best = ready.data, fits[0]
    speed = max(_command_speed(d) for d in data)
    if drawn is None:
        sd = _spread(model, best, ready)
        parameters = {
            p.name: _interval(p, float(v), float(s))
            for p, v, s in zip(model.parameters, best.values, sd, strict=True)
        }
    else:
        parameters, sd = drawn.intervals(best.values), drawn.spread
    undecided = {
        p.name: why
        for p, v, s in zip(model.parameters, best.values, sd, strict=True)
        if (why := _why_unidentified(p, float(v), float(s), parameters[p.name], speed))
    }
    if "back_emf_per_s" in parameters and "no_load_speed_rad_s" in undecided:
        undecided["back_emf_per_s"] = undecided["no_load_speed_rad_s"]
    if ready.lag.feedback.time_doubt_s > 0:
        undecided["dead_time_s"] = (
            "readings are held, their poll is unknown"
            if ready.lag.feedback.readings == "polled"
            else "it is not known whether readings are live"
        )
    return CandidateFit(
        model=model.name,
        parameters=parameters,
        undecided=undecided,
        scores=score(
            free_run(model, best.values, data),
            data,
            held_out_residuals(model, fits[1:], folds, data),
        ),
    )


def _spread(model: CandidateModel, best: Fit, ready: PreparedJoint) -> NDArray[np.float64]:
    """Standard deviations from the curvature of the cost, for models without a posterior."""
    residual = [
        r / n for r, n in zip(
            fresh_residuals(model, best.values, ready.data), ready.noise_rad, strict=True
        )
    ]  # fmt: skip
    # soft-L1 works in units of the noise; its covariance is for residuals of that size
    inflation = integrated_autocorrelation_time(residual) * max(1.0, rms(residual) ** 2)
    return np.sqrt(np.maximum(np.diag(best.covariance) * inflation, 0.0))


def _interval(parameter: Parameter, value: float, sd: float) -> Interval:
    """Value with its 90 % interval from the standard deviation of the fitted coordinate."""
    z, centre = ndtri((1 + LEVEL) / 2), float(parameter.encode(value))
    box = parameter.encode(parameter.low), parameter.encode(parameter.high)
    low, high = (
        float(parameter.decode(c)) for c in np.clip([centre - z * sd, centre + z * sd], *box)
    )
    return Interval(value, low, high)


def _why_unidentified(
    p: Parameter, value: float, sd: float, interval: Interval, speed: float
) -> str | None:
    """Why the data do not identify a parameter; None if they do."""
    limit = p.name.endswith("_rad_s") and p.name != "natural_frequency_rad_s"
    if limit and speed < 0.8 * value:
        return f"commands reach {speed:.1f} rad/s only, so the limit was never reached"
    for bound, end in ((p.low, min(value, interval.low)), (p.high, max(value, interval.high))):
        end = max(end, p.low)
        on = float(abs(p.encode(end) - p.encode(bound))) < _AT_BOUND
        if on and (p.logarithmic or abs(value - bound) < _AT_BOUND):
            return f"on its bound, {bound:g}: the recording does not limit it on that side"
    if sd > 0.7 * p.prior_sd:
        return "these recordings do not excite it; the value is the prior's"
    if p.logarithmic and interval.high > _WIDE * interval.low:
        return f"its interval is wider than a factor of {_WIDE:g}"
    return None


def _choose(fitted: dict[str, CandidateFit], carried: str) -> str:
    """The model with the smallest leave-one-out error; the one carried where it is as good."""
    errors = {n: f.scores.rmse_leave_one_frequency_out_rad for n, f in fitted.items()}
    errors = {n: e for n, e in errors.items() if np.isfinite(e)}
    if not errors:
        return carried  # one frequency: nothing to choose by
    best = min(errors, key=lambda name: errors[name])
    return carried if errors[carried] <= _PREFERENCE * errors[best] else best


def _warnings(
    joint: str, fitted: dict[str, CandidateFit], chosen: str, simulated: _Compared
) -> list[str]:
    pd = fitted[simulated.carried]
    found = []
    if why := pd.undecided.get("dead_time_s"):
        found.append(f"{joint}: the dead time is not identified: {why}.")
    limits = {"velocity_limit_rad_s", "no_load_speed_rad_s"} & pd.undecided.keys()
    for limit in limits:
        found.append(
            f"{joint}: the speed limit was not excited: {pd.undecided[limit]}. Record a faster "
            "tone or a step."
        )
    if len(plausible(simulated.nats)) > 1 and not limits:
        found.append(
            f"{joint}: {UNTOLD} ({max(simulated.nats.values()):.1f} nats); dead time and gains "
            "cover both. Faster tones at a smaller amplitude would tell (`pupper-sysid plan`)."
        )
    for name in ("effort_rad_s2", "friction_rad_s2", "stiffness_per_s2", "damping_per_s"):
        if name in pd.undecided:
            quantity = name.split("_")[0]
            found.append(f"{joint}: {quantity} is not identified: {pd.undecided[name]}.")
    own = pd.scores.rmse_leave_one_frequency_out_rad
    if chosen != simulated.carried:
        best = fitted[chosen].scores.rmse_leave_one_frequency_out_rad
        found.append(
            f"{joint}: {chosen} predicts unseen frequencies better ({1e3 * best:.1f} against "
            f"{1e3 * own:.1f} mrad); simulators still get DelayedPD, the model they can run."
        )
    if not np.isfinite(own):
        found.append(f"{joint}: one frequency only, so no model was tested on unseen motion.")
    return found


def _command_speed(trial: TrialData) -> float:
    """Peak rate of the command [rad/s], over windows longer than a control loop."""
    window = 25
    if len(trial.command) <= window:
        return 0.0
    moved = trial.command[window:] - trial.command[:-window]
    return float(np.max(np.abs(moved)) / (window * TIME_STEP_S))
