"""What is known of a joint's servo before a plan: from a recording, a calibration, or the prior."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.servo_models.calibration.parts import Actuator, JointCalibration, Quantity
from pupper_sysid.sysid.identify.joint_fit import CandidateFit, JointCalibrationResult
from pupper_sysid.sysid.identify.models import CANDIDATE_MODELS, CandidateModel, candidate_model
from pupper_sysid.sysid.identify.simulation import TrialData, residuals
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.plan.candidates import Setup
from pupper_sysid.sysid.plan.information import (
    Hypothesis,
    Noise,
    fitted_noise,
    prior_information,
    respond,
    without_shift,
)
from pupper_sysid.sysid.plan.planner import CLEAR_NATS, Servo, now

STRUCTURES = ("delayed_pd", "delayed_pd_back_emf")
"""Candidate models that a simulator can run and that differ in what limits the speed."""

_LEAST_NOISE_RAD = 1e-4
_MOST_INFLATION = 400.0
_Z = float(ndtri((1 + LEVEL) / 2))

_DRAWS = 6
_DEAD_TIMES_S = (0.008, 0.06)
_USUAL_NOISE = Noise(0.004, 0.001)


def fitted_servo(result: JointCalibrationResult) -> Servo:
    """The servo that the fits of a recording's joint describe.

    Parameters
    ----------
    result : JointCalibrationResult
        Of `sysid.identify.joint_fit.fit_joint`.
    """
    fits = [result.candidate_models[n] for n in STRUCTURES if n in result.candidate_models]
    trials, least = result.trials, max(result.lag.quantum_rad / math.sqrt(12), _LEAST_NOISE_RAD)
    costs, hypotheses = [], []
    noise = _noise(fits[0], trials, least)
    for fit in fits:
        hypothesis = _hypothesis(fit)
        seen = sum(without_shift(respond(hypothesis, t, noise).information) for t in trials)
        hypotheses.append(replace(hypothesis, known=hypothesis.known + seen))
        costs.append(_cost(hypothesis, trials, noise))
    order = np.argsort(costs, kind="stable")
    nats = tuple(float(costs[k] - costs[order[0]]) for k in order)
    servo = Servo(tuple(hypotheses[k] for k in order), noise, nats)
    return _agreeing(servo, result.dead_time_s)


def calibrated_servo(joint: JointCalibration) -> Servo:
    """The servo that a calibration file describes, with intervals for want of readings.

    Parameters
    ----------
    joint : JointCalibration
    """
    named = {c.model: c.parameters for c in joint.selection.candidate_models}
    floor = max(joint.feedback.quantum_rad.value / math.sqrt(12), _LEAST_NOISE_RAD)
    noise = replace(_USUAL_NOISE, floor_rad=max(joint.scores.rmse_free_run_fresh_rad or 0, floor))
    found = []
    for name in STRUCTURES:
        model = next((m for m in CANDIDATE_MODELS if m.name == name), None)
        values = named.get(name) or (_preset(joint.actuator) if name == STRUCTURES[0] else None)
        if model is not None and values is not None and set(values) == set(model.names):
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
        for model in map(candidate_model, _known_structures()):
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
        return replace(known, poll_period_s=lattice.poll_period_s, loss=lattice.loss)
    fresh = 1.0 if lattice.kind == "every read" else lattice.fresh_fraction
    return replace(known, poll_period_s=0.0, loss=min(max(1 - fresh, 0.0), 0.95))


def calibrated_setup(joint: JointCalibration, setup: Setup) -> Setup:
    """`setup` with a calibration's poll, loss and quantisation step."""
    f = joint.feedback
    return replace(
        setup, poll_period_s=f.poll_period_s.value, loss=f.loss.value,
        quantum_rad=f.quantum_rad.value,
    )  # fmt: skip


def _known_structures() -> list[str]:
    names = {m.name for m in CANDIDATE_MODELS}
    return [n for n in STRUCTURES if n in names]


def _hypothesis(fit: CandidateFit) -> Hypothesis:
    model = candidate_model(fit.model)
    values = np.array([fit.values[n] for n in model.names])
    return Hypothesis(model, values, prior_information(model))


def _noise(fit: CandidateFit, trials: tuple[TrialData, ...], least_rad: float) -> Noise:
    hypothesis = _hypothesis(fit)
    return fitted_noise(hypothesis.model, hypothesis.values, trials, least_rad)


def _cost(hypothesis: Hypothesis, trials: tuple[TrialData, ...], noise: Noise) -> float:
    """Robust misfit of the readings in nats, each against its own noise."""
    total = 0.0
    for trial in trials:
        response = respond(hypothesis, trial, noise)
        off = residuals(hypothesis.model, hypothesis.values[None], [trial])[0]
        total += float(np.sum(np.sqrt(1 + response.weights * off**2) - 1))
    return total


def _agreeing(servo: Servo, reported: Interval) -> Servo:
    """`servo` with the inflation that makes its present interval as wide as the reported one."""
    wanted = reported.high - reported.low

    def width(log_inflation: float) -> float:
        interval = now(replace(servo, inflation=math.exp(log_inflation)))
        return interval.high - interval.low

    low, high = 0.0, math.log(_MOST_INFLATION)
    if width(low) >= wanted:
        return servo
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if width(middle) < wanted else (low, middle)
    return replace(servo, inflation=math.exp(high))


def _preset(actuator: Actuator) -> dict[str, float]:
    """Values of DelayedPD from a calibration without fits, such as a preset."""
    one = actuator.parameters.per_inertia()
    numbers = (one.dead_time_s, one.stiffness, one.damping, one.friction_loss, one.effort_limit,
               one.velocity_limit, 0.0)  # fmt: skip
    model = candidate_model(STRUCTURES[0])
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


def _interval_information(model: CandidateModel, actuator: Actuator) -> np.ndarray:
    """What a calibration's intervals say about each parameter on its own."""
    precision = np.zeros(len(model.parameters))
    for k, p in enumerate(model.parameters):
        if p.name in _QUANTITIES:
            quantity: Quantity = _QUANTITIES[p.name](actuator)
            low, high = quantity.low, quantity.high
            if quantity.identified != "no" and low and high and high > low > 0:
                precision[k] = (2 * _Z / math.log(high / low)) ** 2
    return np.diag(precision)
