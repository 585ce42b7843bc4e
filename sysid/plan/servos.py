"""What is known of a joint's servo before a plan: from a recording, a calibration, or the prior."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.servo_models.calibration.parts import Actuator, JointCalibration
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.sysid.fit.results import CandidateFit, JointCalibrationResult
from pupper_sysid.sysid.fit.run import Run
from pupper_sysid.sysid.fit.structure import SIMULATED, Parameter, Structure, candidate
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.plan.candidates import Setup
from pupper_sysid.sysid.plan.information import (
    Hypothesis,
    Noise,
    fitted_noise,
    pooled,
    prior_information,
    respond,
)
from pupper_sysid.sysid.plan.planner import CLEAR_NATS, DEAD_TIME, LEAST_HALF_WIDTH_S, Servo

_LEAST_NOISE_RAD = 1e-4
_MOST_INFLATION = 100.0
_Z = float(ndtri((1 + LEVEL) / 2))

_DRAWS = 6
_DEAD_TIMES_S = (0.008, 0.06)
_USUAL_NOISE = Noise(0.004, 0.001)


def fitted_servo(result: JointCalibrationResult) -> Servo:
    """The servo that the fits of a recording's joint describe, with their intervals.

    Parameters
    ----------
    result : JointCalibrationResult
        Of `sysid.fit.joint_fit.fit_joint`.
    """
    trials, nats = result.runs, result.structure_nats
    best = result.candidate_models[min(nats, key=lambda name: nats[name])]
    least = max(result.lag.quantum_rad / math.sqrt(12), _LEAST_NOISE_RAD)
    noise = fitted_noise(candidate(best.model), _values(best), trials, least)
    # the carried structure first: its value is the one that is reported
    names = sorted(nats, key=lambda name: name != result.simulated_model)
    hypotheses, inflations = [], []
    for name in names:
        hypothesis, inflation = _fitted(result.candidate_models[name], trials, noise)
        hypotheses.append(hypothesis)
        inflations.append(inflation)
    return Servo(
        tuple(hypotheses), noise, tuple(nats[n] for n in names), max(inflations),
        result.lag.feedback.time_doubt_s,
    )  # fmt: skip


def _fitted(fit: CandidateFit, trials: tuple[Run, ...], noise: Noise) -> tuple[Hypothesis, float]:
    """A fit as a hypothesis as uncertain as its intervals, and the inflation which that takes.

    The information of the trials gives the correlations, the fit's intervals the scales.
    """
    model = candidate(fit.model)
    bare = Hypothesis(model, _values(fit), prior_information(model))
    seen = pooled((round(t.frequency_hz, 2), respond(bare, t, noise).information) for t in trials)
    covariance = np.linalg.inv(bare.known + seen)
    ratio = np.ones(len(model.parameters))
    for k, p in enumerate(model.parameters):
        reported = _sd(p, fit.parameters[p.name])
        if np.isfinite(reported) and reported > 0:
            ratio[k] = reported / math.sqrt(covariance[k, k])
    inflation = float(np.exp(2 * np.mean(np.log(ratio[:-1]))))
    known = np.linalg.inv(covariance) / np.outer(ratio, ratio)
    return replace(bare, known=known), float(np.clip(inflation, 1.0, _MOST_INFLATION))


def _sd(parameter: Parameter, interval: Interval) -> float:
    """Standard deviation of a fitted coordinate, from the interval of its value."""
    if parameter.name == DEAD_TIME:
        half = (interval.high - interval.low) / 2
        own = math.sqrt(max(half**2 - LEAST_HALF_WIDTH_S**2, (0.05 * half) ** 2))
        return own / (_Z * interval.value)
    low, high = (float(parameter.encode(end)) for end in (interval.low, interval.high))
    return (high - low) / (2 * _Z)


def calibrated_servo(joint: JointCalibration) -> Servo:
    """The servo that a calibration file describes, with intervals for want of readings.

    Parameters
    ----------
    joint : JointCalibration
    """
    named = {c.model: c.parameters for c in joint.selection.candidate_models}
    floor = max(joint.feedback.quantum_rad.value / math.sqrt(12), _LEAST_NOISE_RAD)
    jitter = joint.actuator.command_jitter_s
    noise = Noise(
        max(joint.scores.rmse_free_run_fresh_rad or 0.0, floor),
        _USUAL_NOISE.jitter_s if jitter.identified == "no" else jitter.value,
    )
    found = []
    for name in SIMULATED:
        model = candidate(name)
        values = named.get(name) or (_preset(joint.actuator) if name == SIMULATED[0] else None)
        if values is not None and set(model.names) <= set(values):
            known = prior_information(model) + _interval_information(model, joint.actuator)
            found.append(Hypothesis(model, np.array([values[n] for n in model.names]), known))
    chosen = joint.selection.model
    found.sort(key=lambda h: h.model.name != chosen)
    scores = {c.model: c.rmse_fresh_rad for c in joint.selection.candidate_models}
    best = scores.get(found[0].model.name)
    # a calibration tells of its readings no more than the size of the errors: models whose errors
    # differ by less than a tenth count as equally good
    nats = tuple(
        CLEAR_NATS if best and (scores.get(h.model.name) or best) > 1.1 * best else 0.0
        for h in found
    )
    return Servo(tuple(found), noise, nats)


def unknown_servos(seed: int) -> list[Servo]:
    """Servos drawn from the prior, with both structures each.

    Parameters
    ----------
    seed : int
    """
    rng = np.random.default_rng(seed)
    found: list[Servo] = []
    while len(found) < _DRAWS:
        hypotheses = []
        shared: dict[str, float] = {}
        for model in map(candidate, SIMULATED):
            for p in model.parameters:
                centre, sd = float(p.encode(p.nominal)), min(p.prior_sd, 1.0) / 2
                if p.name == "dead_time_s":
                    drawn = float(np.exp(rng.uniform(*np.log(_DEAD_TIMES_S))))
                elif p.name == "offset_rad":
                    drawn = 0.0
                else:
                    drawn = float(p.decode(centre + sd * rng.standard_normal()))
                shared.setdefault(p.name, drawn)
            values = np.array([shared[n] for n in model.names])
            hypotheses.append(Hypothesis(model, values, prior_information(model)))
        if shared["friction_rad_s2"] < 0.7 * shared["effort_rad_s2"]:  # it moves at all
            found.append(Servo(tuple(hypotheses), _USUAL_NOISE, (0.0,) * len(hypotheses)))
    return found


def feedback_setup(lag: LagBudget, setup: Setup) -> Setup:
    """`setup` with the poll, the loss and the quantisation step that a recording shows."""
    lattice = lag.feedback
    known = replace(setup, quantum_rad=lag.quantum_rad)
    if lattice.kind == "lattice":
        return replace(known, poll_period_s=lattice.poll_period_s, loss=lattice.assumed_loss)
    fresh = 1.0 if lattice.kind == "every read" else lattice.fresh_fraction
    return replace(known, poll_period_s=0.0, loss=min(max(1 - fresh, 0.0), 0.95))


def calibrated_setup(joint: JointCalibration, setup: Setup) -> Setup:
    """`setup` with a calibration's poll, loss and quantisation step."""
    f = joint.feedback
    return replace(
        setup, poll_period_s=f.poll_period_s.value, loss=f.loss.value,
        quantum_rad=f.quantum_rad.value,
    )  # fmt: skip


def _values(fit: CandidateFit) -> NDArray[np.float64]:
    return np.array([fit.values[name] for name in candidate(fit.model).names])


def _preset(actuator: Actuator) -> dict[str, float]:
    """Values of DelayedPD from a calibration without fits, such as a preset."""
    one = actuator.parameters.per_inertia()
    numbers = (one.dead_time_s, one.stiffness, one.damping, one.friction_loss, one.effort_limit,
               one.velocity_limit, 0.0)  # fmt: skip
    model = candidate(SIMULATED[0])
    boxed = []
    for p, number in zip(model.parameters, numbers, strict=True):
        boxed.append(float(np.clip(np.asarray(number, float), p.low, p.high)))
    return dict(zip(model.names, boxed, strict=True))


_QUANTITIES = {
    "dead_time_s": lambda a: a.dead_time_s,
    "stiffness_per_s2": lambda a: a.ratios_to_armature.stiffness,
    "damping_per_s": lambda a: a.ratios_to_armature.damping,
    "friction_rad_s2": lambda a: a.ratios_to_armature.friction_loss,
    "effort_rad_s2": lambda a: a.ratios_to_armature.effort_limit,
    "velocity_limit_rad_s": lambda a: a.velocity_limit_rad_s,
}


def _interval_information(model: Structure, actuator: Actuator) -> NDArray[np.float64]:
    """What a calibration's intervals say about each parameter on its own."""
    precision = np.zeros(len(model.parameters))
    for k, p in enumerate(model.parameters):
        if p.name in _QUANTITIES:
            quantity: Quantity = _QUANTITIES[p.name](actuator)
            low, high = quantity.low, quantity.high
            if quantity.identified != "no" and low and high and high > low > 0:
                precision[k] = _sd(p, Interval(quantity.value, low, high)) ** -2
    return np.diag(precision)
