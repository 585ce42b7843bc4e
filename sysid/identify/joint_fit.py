"""Fit the candidate models to one joint, choose one, and find what the data do not identify.

The candidates of `sysid.identify.models` are fitted to fresh readings by output error, from seeded
global starts, and scored by leaving one frequency out. The model with the smallest error on unseen
frequencies is chosen; `DelayedPD` where it is within 5 % of the best, because training runs it.
Residuals of a real servo are not white: intervals count effective samples, not nominal ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.results import Result, derived, flat, internal
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPDParameters, whole_steps
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice, quantum, readings
from pupper_sysid.sysid.identify.models import (
    CANDIDATE_MODELS,
    CandidateModel,
    Parameter,
    candidate_model,
)
from pupper_sysid.sysid.identify.output_error import Fit
from pupper_sysid.sysid.identify.scores import Scores, rms, score
from pupper_sysid.sysid.identify.search import (
    PREFERRED,
    dead_time_profile,
    fit_with_folds,
    fresh_residuals,
    held_out_residuals,
    integrated_autocorrelation_time,
    leave_one_out_folds,
)
from pupper_sysid.sysid.identify.simulation import TrialData, free_run, prepare
from pupper_sysid.sysid.lag.lag_budget import LagBudget, lag_budget
from pupper_sysid.sysid.recordings.joints import joint_rng
from pupper_sysid.sysid.recordings.recording import Trial

Presets = Mapping[str, Mapping[str, DelayedPDParameters]]
"""Published settings by name, then by joint."""

_PREFERENCE = 1.05


@dataclass(frozen=True, kw_only=True)
class CandidateFit(Result):
    """One candidate model, fitted to one joint.

    Attributes
    ----------
    model : str
        Its name in `sysid.identify.models`.
    parameters : dict of str to Interval
        By name, which ends in the unit.
    undecided : dict of str to str
        Parameters that the data do not identify, each with the reason.
    scores : Scores
    """

    model: str
    parameters: dict[str, Interval]
    undecided: dict[str, str]
    scores: Scores

    @property
    def values(self) -> dict[str, float]:
        """The parameters without their intervals."""
        return {name: p.value for name, p in self.parameters.items()}


@dataclass(frozen=True, kw_only=True)
class JointCalibrationResult(Result):
    """Calibration of one joint.

    Attributes
    ----------
    model : str
        The candidate with the smallest error on unseen frequencies.
    candidate_models : dict of str to CandidateFit
        Simplest first.
    lag : LagBudget
        With the dead time of DelayedPD.
    presets : dict of str to Scores
        Published settings, scored in the same way.
    warnings : tuple of str
    trials : tuple of TrialData
        The readings of the fit.
    """

    joint: str
    model: str
    candidate_models: dict[str, CandidateFit]
    lag: LagBudget
    presets: dict[str, Scores]
    warnings: tuple[str, ...]
    trials: tuple[TrialData, ...] = internal()

    @property
    def delayed_pd(self) -> CandidateFit:
        """The fit that simulators run."""
        return self.candidate_models[PREFERRED]

    @property
    def dead_time_s(self) -> Interval:
        """Dead time with its profile-likelihood interval [s]."""
        assert self.lag.dead_time_s is not None
        return self.lag.dead_time_s

    @derived
    def delay_steps(self) -> tuple[int, int]:
        """Dead-time interval in whole physics steps, rounded outward."""
        return whole_steps(self.dead_time_s.low, self.dead_time_s.high, TIME_STEP_S)

    def __str__(self) -> str:
        scores = self.delayed_pd.scores
        return (
            f"DelayedPD with {1e3 * self.dead_time_s.value:.1f} ms dead time, free-run error "
            f"{1e3 * scores.rmse_fresh_rad:.1f} mrad on fresh readings, "
            f"{1e3 * scores.rmse_leave_one_frequency_out_rad:.1f} mrad on unseen frequencies"
        )

    def rows(self) -> list[dict[str, Any]]:
        """One row per candidate model."""
        return [
            {"chosen": name == self.model} | flat(fit.to_dict())
            for name, fit in self.candidate_models.items()
        ]


@dataclass(frozen=True)
class PreparedJoint:
    """One joint's trials on the physics clock, with the noise of its readings."""

    rng: np.random.Generator
    lag: LagBudget
    data: tuple[TrialData, ...]
    noise_rad: float

    def fit_rng(self) -> np.random.Generator:
        """The same generator for every fit, so that a fit does not depend on those before it."""
        return deepcopy(self.rng)


def prepare_joint(joint: str, trials: tuple[Trial, ...], seed: int) -> PreparedJoint:
    """Measure the lag of a joint and put its trials on the physics clock; nothing is fitted.

    Raises
    ------
    InputError
        If there is too little motion.
    """
    rng = joint_rng(seed, joint)
    lattice = find_poll_lattice(trials, rng.spawn(1)[0])
    lag = lag_budget(joint, trials, rng, lattice)
    data = tuple(prepare(t, readings(t, lattice)) for t in trials)
    data = tuple(d for d in data if len(d.sample_step))
    # fits of a noise-free servo still meet rounding: a third of a quantisation step
    noise = max(lag.noise_rad, quantum(trials) / 3, 1e-4) if np.isfinite(lag.noise_rad) else 0.012
    return PreparedJoint(rng, lag, data, noise)


def joint_lag(joint: str, trials: tuple[Trial, ...], seed: int = 0) -> LagBudget:
    """Lag budget of one joint, its dead time from a fit of DelayedPD alone."""
    ready, model = prepare_joint(joint, trials, seed), candidate_model(PREFERRED)
    (best,) = fit_with_folds(model, ready.data, {}, ready.noise_rad, ready.fit_rng(), {})
    dead_time, best = dead_time_profile(model, ready.data, ready.noise_rad, best)
    return replace(ready.lag, dead_time_s=dead_time, offset_rad=float(best.values[-1]))


def fit_joint(
    joint: str, trials: tuple[Trial, ...], seed: int = 0, presets: Presets | None = None
) -> JointCalibrationResult:
    """Fit every candidate model to one joint and choose.

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
    data, noise, folds = ready.data, ready.noise_rad, leave_one_out_folds(ready.data)
    fitted: dict[str, CandidateFit] = {}
    best: dict[str, list[Fit]] = {}
    lag = ready.lag
    for model in CANDIDATE_MODELS:
        best[model.name] = fit_with_folds(model, data, folds, noise, ready.fit_rng(), best)
        if model.name == PREFERRED:
            dead_time, fit = dead_time_profile(model, data, noise, best[PREFERRED][0])
            best[PREFERRED][0] = fit
            lag = replace(lag, dead_time_s=dead_time, offset_rad=float(fit.values[-1]))
        fitted[model.name] = _candidate_fit(model, best[model.name], data, folds, noise)
    chosen = _choose(fitted)
    return JointCalibrationResult(
        joint=joint,
        model=chosen,
        candidate_models=fitted,
        lag=lag,
        presets={
            name: _score_preset(by_joint[joint], data)
            for name, by_joint in (presets or {}).items()
            if joint in by_joint
        },
        warnings=(*lag.warnings, *_warnings(joint, fitted, chosen)),
        trials=data,
    )


def _score_preset(parameters: DelayedPDParameters, data: tuple[TrialData, ...]) -> Scores:
    """Scores with the offset of these readings: their median about it, as in `sysid.compare`."""
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
    data: tuple[TrialData, ...],
    folds: dict[float, tuple[bool, ...]],
    noise: float,
) -> CandidateFit:
    best = fits[0]
    residual = fresh_residuals(model, best.values, data)
    # soft-L1 works in units of the noise; its covariance is for residuals of that size
    inflation = integrated_autocorrelation_time(residual) * max(1.0, rms(residual) ** 2 / noise**2)
    sd = np.sqrt(np.maximum(np.diag(best.covariance) * inflation, 0.0))
    speed = max(_command_speed(d) for d in data)
    parameters, undecided = {}, {}
    for j, p in enumerate(model.parameters):
        parameters[p.name] = _interval(p, float(best.values[j]), float(sd[j]))
        nominal_sd = float(np.sqrt(best.covariance[j, j]))
        if why := _why_unidentified(p, float(best.values[j]), float(sd[j]), nominal_sd, speed):
            undecided[p.name] = why
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


def _interval(parameter: Parameter, value: float, sd: float) -> Interval:
    """Value with its 90 % interval from the standard deviation of the fitted coordinate."""
    z, centre = ndtri((1 + LEVEL) / 2), float(parameter.encode(value))
    box = parameter.encode(parameter.low), parameter.encode(parameter.high)
    low, high = (
        float(parameter.decode(c)) for c in np.clip([centre - z * sd, centre + z * sd], *box)
    )
    return Interval(value, low, high)


def _why_unidentified(
    p: Parameter, value: float, sd: float, nominal_sd: float, speed: float
) -> str | None:
    """Why the data do not identify a parameter; None if they do."""
    limit = p.name.endswith("_rad_s") and p.name != "natural_frequency_rad_s"
    if limit and speed < 0.8 * value:
        return f"commands reach {speed:.1f} rad/s only, so the limit was never reached"
    if p.logarithmic and (value <= p.low * 1.01 or value >= p.high / 1.01):
        return f"the value is at its bound {p.low if value <= p.low * 1.01 else p.high:g}"
    if nominal_sd > 0.7 * p.prior_sd:
        return "these recordings do not excite it; the value is the prior's"
    if p.logarithmic and sd > 0.5:
        return "its interval is wider than a factor of two"
    return None


def _choose(fitted: dict[str, CandidateFit]) -> str:
    """The model with the smallest leave-one-out error; DelayedPD where it is as good."""
    errors = {n: f.scores.rmse_leave_one_frequency_out_rad for n, f in fitted.items()}
    if not np.isfinite(list(errors.values())).all():
        return PREFERRED  # one frequency: nothing to choose by
    best = min(errors, key=lambda name: errors[name])
    return PREFERRED if errors[PREFERRED] <= _PREFERENCE * errors[best] else best


def _warnings(joint: str, fitted: dict[str, CandidateFit], chosen: str) -> list[str]:
    pd = fitted[PREFERRED]
    found = []
    if "velocity_limit_rad_s" in pd.undecided:
        found.append(
            f"{joint}: the speed limit was not excited: "
            f"{pd.undecided['velocity_limit_rad_s']}. Record a faster tone or a step."
        )
    for name in ("effort_rad_s2", "friction_rad_s2", "stiffness_per_s2", "damping_per_s"):
        if name in pd.undecided:
            quantity = name.split("_")[0]
            found.append(f"{joint}: {quantity} is not identified: {pd.undecided[name]}.")
    own = pd.scores.rmse_leave_one_frequency_out_rad
    if chosen != PREFERRED:
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
