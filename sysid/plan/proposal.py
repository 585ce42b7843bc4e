"""Plan the next sweep: from recordings, from a calibration, or for a servo that is unknown.

proposal = plan_from_recordings([load("sweep.csv")])
save_plan(proposal, "plan.yaml")                  # sysid.plan.plan_file
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pupper_sysid.common.border import Part
from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.common.interval import HALF_WIDTH_SD, Interval
from pupper_sysid.servo_models.calibration.calibration import Calibration, InputFile
from pupper_sysid.servo_models.calibration.parts import Actuator, JointCalibration
from pupper_sysid.servo_models.calibration.quantity import Number, Whole
from pupper_sysid.sysid.doctor.checks import each_joint, joint_trials
from pupper_sysid.sysid.fit.goodness import LEAST_NOISE_RAD
from pupper_sysid.sysid.fit.joint_fit import fit_joint
from pupper_sysid.sysid.fit.results import CandidateFit, JointCalibrationResult
from pupper_sysid.sysid.fit.run import Run
from pupper_sysid.sysid.fit.structure import SIMULATED, Parameter, Structure, candidate
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.plan import planner
from pupper_sysid.sysid.plan.planner import (
    Hypothesis,
    PlannedTrial,
    Prediction,
    Servo,
    Setup,
    propose,
)
from pupper_sysid.sysid.recordings.recording import Recording, Trial
from pupper_sysid.sysid.sweep.excitation import LEAST_MARGIN_RAD, LOOP_PERIOD_S, PLANS_S

SECONDS = 20.0  # recorded seconds per joint of a plan without a recording to go by

_SPEED_LIMIT_RAD_S = 7.5
_MOST_TRIALS = 2000

Margins = Mapping[str, float]
"""Largest excursion of each joint to either side of its start pose [rad]."""


class SweepPlan(Part):
    """What to record next, as the plan's file has it."""

    made_from: Annotated[tuple[InputFile, ...], Field(strict=False)] = ()
    """Recordings or calibration it was made from; empty for an unknown servo."""
    seed: Whole = 0
    """Seed of its random numbers."""
    loop_period_s: Annotated[Number, Field(gt=0, le=1)]
    """Time between commands [s]."""
    poll_rate_hz: Annotated[Number, Field(ge=0, le=1e5)]
    """Polls of a servo per second; 0 where readings are live."""
    speed_limit_rad_s: Annotated[Number, Field(gt=0, le=1000)]
    """Speed limit of the servos [rad/s]."""
    trials: Annotated[
        tuple[PlannedTrial, ...], Field(strict=False, min_length=1, max_length=_MOST_TRIALS)
    ]
    """Trials, in the order of their execution."""
    predictions: Annotated[tuple[Prediction, ...], Field(strict=False)] = ()
    """Intervals now and after the sweep; empty for an unknown servo."""
    notes: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """What no trial within the limits can show."""

    @property
    def joints(self) -> list[str]:
        """The joints that move, in order."""
        return list(dict.fromkeys(trial.joint for trial in self.trials))


def plan_from_recordings(
    recordings: Sequence[Recording],
    joints: Sequence[str],
    *,
    seconds: float | None = None,
    margins: Margins | None = None,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> SweepPlan:
    """Fit the joints of recordings, pooled per joint, and plan what narrows their intervals most.

    Defaults are those of `plan_from_fits`. `progress` is called with a joint's name when it is
    done.
    """
    if seconds is not None:  # before the work, not after it
        refuse_outside("`seconds`", seconds, *PLANS_S, "s")
    work = partial(fit_joint, seed=seed)
    fits = each_joint(work, recordings, list(joints), workers, progress)
    return plan_from_fits(recordings, fits, seconds=seconds, margins=margins, seed=seed)


def plan_from_fits(
    recordings: Sequence[Recording],
    fits: Mapping[str, JointCalibrationResult],
    *,
    seconds: float | None = None,
    margins: Margins | None = None,
    seed: int = 0,
) -> SweepPlan:
    """Plan what narrows the intervals of joints fitted to `recordings` most.

    By default as long per joint [s] as the recordings, and within their excursions [rad].
    """
    limits = [(r.metadata.get("bus") or {}).get("speed_limit_rad_s") for r in recordings]
    base = Setup(
        loop_period_s=round(float(np.median([r.loop_period_s for r in recordings])), 6),
        speed_limit_rad_s=float(min(filter(None, limits), default=_SPEED_LIMIT_RAD_S)),
    )
    plans, polls = [], []
    for joint, fit in fits.items():
        trials = joint_trials(recordings, joint)
        moved = (np.max(np.abs(t.command_rad - t.initial_command_rad)) for t in trials)
        setup = feedback_setup(fit.lag, _within(base, joint, margins, float(max(moved))))
        length = min(recorded_s(trials), PLANS_S[1]) if seconds is None else seconds
        plans.append(propose(joint, [fitted_servo(fit)], setup, length))
        polls.append(setup.poll_rate_hz)
    sources = tuple(
        InputFile(name=r.path.name if r.path else r.name, sha256=r.sha256) for r in recordings
    )
    return _pooled(plans, sources, seed, replace(base, poll_period_s=_period(polls)))


def plan_from_calibration(
    calibration: Calibration,
    source: InputFile,
    joints: Sequence[str],
    *,
    seconds: float = SECONDS,
    loop_period_s: float = LOOP_PERIOD_S,
    margins: Margins | None = None,
    seed: int = 0,
) -> SweepPlan:
    """Plan what narrows the intervals of a calibration most.

    A calibration holds no readings: what it knows is taken from its intervals, as if they were
    independent. `source` is its file; `seconds` is recorded time per joint [s].
    """
    base = Setup(loop_period_s=loop_period_s)
    plans, polls = [], []
    for joint in joints:
        fitted = calibration.joint(joint)
        poll = fitted.feedback
        setup = replace(
            _within(base, joint, margins, planner.LARGEST_RAD),
            poll_period_s=poll.poll_period_s.value, loss=poll.loss.value,
            quantum_rad=poll.quantum_rad.value,
        )  # fmt: skip
        plans.append(propose(joint, [calibrated_servo(fitted)], setup, seconds))
        polls.append(setup.poll_rate_hz)
    return _pooled(plans, (source,), seed, replace(base, poll_period_s=_period(polls)))


def plan_first_sweep(
    joints: Sequence[str],
    *,
    setup: Setup,
    seconds: float = SECONDS,
    margins: Margins | None = None,
    seed: int = 0,
) -> SweepPlan:
    """Plan a first sweep of servos of which nothing is known, `seconds` of each joint.

    The trials are the best on average over servos drawn from the prior of `sysid.fit.structure`.
    """
    servos, by_reach, plans = unknown_servos(seed), dict[float, planner.JointPlan](), []
    for joint in joints:
        joint_setup = _within(setup, joint, margins, planner.LARGEST_RAD)
        reach = min(joint_setup.margin_rad, planner.LARGEST_RAD)
        if reach not in by_reach:  # joints with the same margin get the same trials
            by_reach[reach] = propose(joint, servos, joint_setup, seconds)
        trials = tuple(t.model_copy(update={"joint": joint}) for t in by_reach[reach].trials)
        plans.append(replace(by_reach[reach], trials=trials))
    return _pooled(plans, (), seed, setup)


def _pooled(
    plans: Sequence[planner.JointPlan], sources: tuple[InputFile, ...], seed: int, setup: Setup
) -> SweepPlan:
    return SweepPlan(
        made_from=sources,
        seed=seed,
        loop_period_s=setup.loop_period_s,
        poll_rate_hz=round(setup.poll_rate_hz, 3),
        speed_limit_rad_s=setup.speed_limit_rad_s,
        trials=tuple(t for p in plans for t in p.trials),
        predictions=tuple(x for p in plans for x in p.predictions),
        notes=tuple(n for p in plans for n in p.notes),
    )


def _period(rates_hz: Sequence[float]) -> float:
    """Poll period of a bus from those found at its joints [s]; 0 if most are live."""
    middle = float(np.median(rates_hz))
    return 1 / middle if middle > 0 else 0.0


def _within(setup: Setup, joint: str, margins: Margins | None, usual_rad: float) -> Setup:
    """`setup` with the joint's margin."""
    margin = usual_rad if margins is None or joint not in margins else margins[joint]
    if margin < LEAST_MARGIN_RAD:
        raise InputError(
            f"{joint} has a margin of {margin:.3f} rad on either side of its start pose, too "
            "little for a measurement. Check its limits in the joint map."
        )
    return replace(setup, margin_rad=margin)


def recorded_s(trials: Sequence[Trial]) -> float:
    """Recorded time of all trials [s]."""
    return float(sum(t.send_time_s[-1] - t.send_time_s[0] for t in trials))


_MOST_INFLATION = 100.0

_DRAWS = 6
_DEAD_TIMES_S = (0.008, 0.06)
_USUAL_NOISE = planner.Noise(0.004, 0.001)


def fitted_servo(result: JointCalibrationResult) -> Servo:
    """The servo that the fits of a recording's joint describe, with their intervals."""
    trials, nats = result.runs, result.structure_nats
    best = result.candidate_models[min(nats, key=lambda name: nats[name])]
    least = max(result.lag.quantum_rad / math.sqrt(12), LEAST_NOISE_RAD)
    noise = planner.fitted_noise(candidate(best.model), _values(best), trials, least)
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


def _fitted(
    fit: CandidateFit, trials: tuple[Run, ...], noise: planner.Noise
) -> tuple[Hypothesis, float]:
    """A fit as a hypothesis as uncertain as its intervals, and the inflation which that takes.

    The information of the trials gives the correlations, the fit's intervals the scales.
    """
    model = candidate(fit.model)
    bare = Hypothesis(model, _values(fit), planner.prior_information(model))
    seen = planner.pooled(
        (round(t.frequency_hz, 2), planner.respond(bare, t, noise).information) for t in trials
    )
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
    if parameter.name == planner.DEAD_TIME:
        half = (interval.high - interval.low) / 2
        fitted_half = math.sqrt(max(half**2 - planner.LEAST_HALF_WIDTH_S**2, (0.05 * half) ** 2))
        return fitted_half / (HALF_WIDTH_SD * interval.value)
    low, high = (float(parameter.encode(end)) for end in (interval.low, interval.high))
    return (high - low) / (2 * HALF_WIDTH_SD)


def calibrated_servo(joint: JointCalibration) -> Servo:
    """The servo that a calibration file describes, with intervals for want of readings."""
    named = {c.model: c.parameters for c in joint.selection.candidate_models}
    floor = max(joint.feedback.quantum_rad.value / math.sqrt(12), LEAST_NOISE_RAD)
    jitter = joint.actuator.command_jitter_s
    noise = planner.Noise(
        max(joint.scores.rmse_free_run_fresh_rad or 0.0, floor),
        _USUAL_NOISE.jitter_s if jitter.identified == "no" else jitter.value,
    )
    servos = []
    for name in SIMULATED:
        model = candidate(name)
        values = named.get(name) or (_preset(joint.actuator) if name == SIMULATED[0] else None)
        if values is not None and set(model.names) <= set(values):
            known = planner.prior_information(model) + _interval_information(model, joint.actuator)
            servos.append(Hypothesis(model, np.array([values[n] for n in model.names]), known))
    chosen = joint.selection.model
    servos.sort(key=lambda h: h.model.name != chosen)
    scores = {c.model: c.rmse_fresh_rad for c in joint.selection.candidate_models}
    best = scores.get(servos[0].model.name)
    # a calibration tells of its readings no more than the size of the errors: models whose errors
    # differ by less than a tenth count as equally good
    nats = tuple(
        planner.CLEAR_NATS if best and (scores.get(h.model.name) or best) > 1.1 * best else 0.0
        for h in servos
    )
    return Servo(tuple(servos), noise, nats)


def unknown_servos(seed: int) -> list[Servo]:
    """Servos drawn from the prior, with both structures each."""
    rng = np.random.default_rng(seed)
    servos: list[Servo] = []
    while len(servos) < _DRAWS:
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
            hypotheses.append(Hypothesis(model, values, planner.prior_information(model)))
        if shared["friction_rad_s2"] < 0.7 * shared["effort_rad_s2"]:  # it moves at all
            servos.append(Servo(tuple(hypotheses), _USUAL_NOISE, (0.0,) * len(hypotheses)))
    return servos


def feedback_setup(lag: LagBudget, setup: Setup) -> Setup:
    """`setup` with the poll, the loss and the quantisation step that a recording shows."""
    lattice = lag.feedback
    known = replace(setup, quantum_rad=lag.quantum_rad)
    if lattice.kind == "lattice":
        return replace(known, poll_period_s=lattice.poll_period_s, loss=lattice.assumed_loss)
    fresh = 1.0 if lattice.kind == "every read" else lattice.fresh_fraction
    return replace(known, poll_period_s=0.0, loss=min(max(1 - fresh, 0.0), 0.95))


def _values(fit: CandidateFit) -> NDArray[np.float64]:
    return np.array([fit.values[name] for name in candidate(fit.model).names])


def _preset(actuator: Actuator) -> dict[str, float]:
    """Values of DelayedPD from a calibration without fits, such as a preset."""
    one = actuator.parameters.per_inertia()
    numbers = (one.dead_time_s, one.stiffness, one.damping, one.friction_loss, one.effort_limit,
               one.velocity_limit, 0.0)  # fmt: skip
    parameters = candidate(SIMULATED[0]).parameters
    return {
        p.name: float(np.clip(np.asarray(number, float), p.low, p.high))
        for p, number in zip(parameters, numbers, strict=True)
    }


def _interval_information(model: Structure, actuator: Actuator) -> NDArray[np.float64]:
    """What a calibration's intervals say about each parameter on its own."""
    precision, quantities = np.zeros(len(model.parameters)), actuator.per_inertia
    for k, p in enumerate(model.parameters):
        if quantity := quantities.get(p.name):
            low, high = quantity.low, quantity.high
            if quantity.identified != "no" and low and high and high > low > 0:
                precision[k] = _sd(p, Interval(quantity.value, low, high)) ** -2
    return np.diag(precision)
