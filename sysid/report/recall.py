"""Results of a calibration from its file: everything that a report shows, without fitting again.

The file holds each candidate model's numbers, and the intervals of those that simulators run. The
readings are dated with the calibrated motion, so free runs and scores come out as they did.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace

import numpy as np

from pupper_sysid.common.interval import Interval
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import CandidateModel, JointCalibration
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.sysid.fit.calibration_file import preset_parameters
from pupper_sysid.sysid.fit.joint_fit import score_preset
from pupper_sysid.sysid.fit.preparation import PreparedJoint, prepare_joint
from pupper_sysid.sysid.fit.results import CandidateFit, JointCalibrationResult
from pupper_sysid.sysid.fit.run import free_run
from pupper_sysid.sysid.fit.scores import Scores, score
from pupper_sysid.sysid.fit.structure import SIMULATED
from pupper_sysid.sysid.fit.structure import candidate as structure
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.recordings.joints import Recordings, usable_trials
from pupper_sysid.sysid.recordings.recording import Trial


def can_recall(joint: JointCalibration) -> bool:
    """Whether the file holds all of a joint's fits: those of servos under load it does not."""
    return joint.under_load is None and _carried(joint) in {
        candidate.model for candidate in joint.selection.candidate_models
    }


def recall(
    calibration: Calibration,
    recordings: Recordings,
    joints: Sequence[str],
    progress: Callable[[str], None] | None = None,
) -> dict[str, JointCalibrationResult]:
    """Results by joint, as `sysid.fit.calibrate.calibrate` made them.

    Intervals are those of the file: of the model that simulators run. Errors by left-out frequency
    are not in the file; the error over all of them is.

    Parameters
    ----------
    calibration : Calibration
    recordings : Recording or sequence of Recording
        What it was made from.
    joints : sequence of str
        For which `can_recall` holds.
    progress : callable, optional
        Called with a joint's name when it is done.

    Raises
    ------
    InputError
        If a joint is not recorded.
    """
    found = {}
    for name, trials in usable_trials(recordings, joints).items():
        found[name] = _joint(name, calibration.joint(name), trials, calibration.seed or 0)
        if progress:
            progress(name)
    return found


def _joint(
    name: str, known: JointCalibration, trials: tuple[Trial, ...], seed: int
) -> JointCalibrationResult:
    values = {c.model: _values(c) for c in known.selection.candidate_models}
    carried, a = _carried(known), known.actuator
    ready = prepare_joint(name, trials, seed, True, {carried: values[carried]})
    fits = {
        c.model: _fit(c, values[c.model], ready, known if c.model == carried else None)
        for c in known.selection.candidate_models
    }
    presets = {n: joints[name] for n, joints in preset_parameters().items() if name in joints}
    return JointCalibrationResult(
        joint=name,
        model=known.selection.model,
        simulated_model=carried,
        structure_nats={carried: 0.0},
        command_jitter_s=_interval(a.command_jitter_s),
        candidate_models=fits,
        lag=_lag(ready.lag, known),
        presets={n: score_preset(parameters, ready.runs) for n, parameters in presets.items()},
        warnings=known.warnings,
        runs=ready.runs,
    )


def _lag(measured: LagBudget, known: JointCalibration) -> LagBudget:
    """The lag budget with the numbers of the file: other dates move the last digits."""
    own = known.lag
    lags = {
        name: measured_lag if quantity is None else _interval(quantity)
        for name, quantity, measured_lag in (
            ("lag_s", own.lag_s, measured.lag_s),
            ("raw_lag_s", own.raw_lag_s, measured.raw_lag_s),
            ("fresh_lag_s", own.fresh_lag_s, measured.fresh_lag_s),
        )
    }
    lattice = measured.feedback
    if lattice.kind == "lattice":
        poll = known.feedback
        loss = math.nan if poll.loss.identified == "no" else poll.loss.value
        lattice = replace(lattice, poll_period_s=poll.poll_period_s.value, loss=loss)
    stated = {getattr(measured, name).value: lag.value for name, lag in lags.items()}
    budget = replace(
        measured,
        **lags,
        estimators_s={n: stated.get(lag, lag) for n, lag in measured.estimators_s.items()},
        stale_lag_s=lags["raw_lag_s"].value - lags["fresh_lag_s"].value,
        command_hold_s=lags["fresh_lag_s"].value - lags["lag_s"].value,
        feedback=lattice,
    )
    dead_time = _interval(known.actuator.dead_time_s)
    return budget.with_dead_time(dead_time, known.feedback.offset_rad.value)


def _carried(joint: JointCalibration) -> str:
    """The model that simulators run: DelayedPD by either limit of its speed."""
    return SIMULATED[joint.actuator.back_emf_nm_s_per_rad.value > 0]


def _values(candidate: CandidateModel) -> np.ndarray:
    names = structure(candidate.model).names
    return np.array([candidate.parameters[name] for name in names])


def _fit(
    candidate: CandidateModel,
    values: np.ndarray,
    ready: PreparedJoint,
    carried: JointCalibration | None,
) -> CandidateFit:
    """One candidate model; `carried` is the joint if simulators run this one."""
    model = structure(candidate.model)
    quantities = {} if carried is None else _quantities(carried)
    parameters = {
        name: _interval(quantities[name], value)
        if name in quantities
        else Interval(value, value, value)
        for name, value in candidate.parameters.items()
    }
    scores = score(free_run(model, values, ready.runs), ready.runs)
    return CandidateFit(
        model=candidate.model,
        parameters=parameters,
        undecided={
            name: quantities[name].why or ""
            for name in quantities.keys() & parameters.keys()
            if quantities[name].identified == "no"
        },
        scores=replace(scores, **_stated(candidate)),
    )


def _stated(candidate: CandidateModel) -> dict[str, float]:
    """Scores that the file holds; null there is NaN."""
    names = {f.name for f in fields(Scores)} & set(type(candidate).model_fields)
    stated = {name: getattr(candidate, name) for name in names}
    return {name: float("nan") if value is None else value for name, value in stated.items()}


def _quantities(joint: JointCalibration) -> dict[str, Quantity]:
    """Quantities of the file by the names that the fit has for them."""
    a, ratios = joint.actuator, joint.actuator.ratios_to_armature
    return {
        "dead_time_s": a.dead_time_s,
        "stiffness_per_s2": ratios.stiffness,
        "damping_per_s": ratios.damping,
        "friction_rad_s2": ratios.friction_loss,
        "effort_rad_s2": ratios.effort_limit,
        "velocity_limit_rad_s": a.velocity_limit_rad_s,
        "back_emf_per_s": ratios.back_emf,
        "offset_rad": joint.feedback.offset_rad,
    }


def _interval(quantity: Quantity, value: float | None = None) -> Interval:
    own = quantity.value if value is None else value
    low = own if quantity.low is None else quantity.low
    return Interval(own, low, own if quantity.high is None else quantity.high)
