"""Convert the fits of calibration to the `Calibration` that simulators read.

Free-air positions give ratios to the armature. One torque sets the scale: the stall torque, which
is the effort limit; so armature = stall torque / (effort limit per inertia), and the rest follows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np

from pupper_sysid.common.data_sheet import recorded_stall_torque
from pupper_sysid.common.files import versions
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.joints import JOINT_NAMES, STALL_TORQUE_NM, STALL_TORQUE_SOURCE
from pupper_sysid.servo_models.calibration.calibration import (
    PRESETS,
    Calibration,
    InputFile,
    load_calibration,
    utc_now,
)
from pupper_sysid.servo_models.calibration.parts import (
    NO_SPEED_LIMIT_RAD_S,
    Actuator,
    CandidateModel,
    Feedback,
    JointCalibration,
    Lag,
    RatiosToArmature,
    Scale,
    Scores,
    Selection,
)
from pupper_sysid.servo_models.calibration.quantity import Quantity, measured, quantity_of
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPDParameters
from pupper_sysid.sysid.feedback.poll_lattice import NO_LOSS
from pupper_sysid.sysid.identify.candidates.models import candidate_model
from pupper_sysid.sysid.identify.results import UNTOLD, CandidateFit, JointCalibrationResult
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.recordings.recording import Recording

GIVEN_TORQUE = "given by the user"
"""Source of a torque anchor that no data sheet gave."""

_LIMITS = {"velocity_limit_rad_s": NO_SPEED_LIMIT_RAD_S, "back_emf_per_s": 0.0}
"""The two limits on a servo's speed, with the value that stands for none."""


def to_calibration(
    results: Mapping[str, JointCalibrationResult],
    recordings: Sequence[Recording],
    seed: int,
    stall_torque_nm: float | None = None,
) -> Calibration:
    """The calibration file of `results`.

    Parameters
    ----------
    results : dict of joint to JointCalibrationResult
    recordings : sequence of Recording
        Their sources; names and hashes go into the file.
    seed : int
    stall_torque_nm : float, optional
        As for `torque_anchors`.
    """
    anchors = torque_anchors(list(results), recordings, stall_torque_nm)
    buses = [r.metadata.get("bus") or {} for r in recordings]
    kinds = {str(bus.get("kind", "unknown bus")) for bus in buses}
    maps = {str(bus["joint_map"]) for bus in buses if bus.get("joint_map")}
    pupper = set(results) <= set(JOINT_NAMES)
    own = "Mini Pupper 2" if pupper else ", ".join(sorted(maps)) or "another robot"
    return Calibration(
        robot=f"{own} ({', '.join(sorted(kinds))})",
        created=utc_now(),
        inputs=tuple(
            InputFile(name=r.path.name if r.path else r.name, sha256=r.sha256) for r in recordings
        ),
        seed=seed,
        versions=versions(),
        notes=(
            "Delay belongs to the actuator; poll period, loss and age belong to the observation.",
            "Only ratios to the armature come from the recording; torques scale with the anchor.",
        ),
        joints={name: _joint(r, *anchors[name]) for name, r in results.items()},
    )


def torque_anchors(
    joints: Sequence[str], recordings: Sequence[Recording], stall_torque_nm: float | None = None
) -> dict[str, tuple[float, str]]:
    """Stall torque [N·m] that sets the scale of each joint's torques, and its source.

    Parameters
    ----------
    joints : sequence of str
    recordings : sequence of Recording
        Their headers may name the servo.
    stall_torque_nm : float, optional
        Of all joints; by default that of the data sheet of the recorded servo, or of the Mini
        Pupper's servo where no recording names one.
    """
    if stall_torque_nm is not None:
        return dict.fromkeys(joints, (stall_torque_nm, GIVEN_TORQUE))
    headers = [r.metadata.get("servos") or {} for r in recordings]
    return {
        joint: recorded_stall_torque(h.get(joint, {}) for h in headers)
        or (STALL_TORQUE_NM, STALL_TORQUE_SOURCE)
        for joint in joints
    }


def _joint(result: JointCalibrationResult, stall: float, source: str) -> JointCalibration:
    pd, lag = _covering(result), result.lag
    low, high = result.delay_steps
    armature = stall / pd.values["effort_rad_s2"]
    names = {
        "stiffness": "stiffness_per_s2",
        "damping": "damping_per_s",
        "friction_loss": "friction_rad_s2",
        "effort_limit": "effort_rad_s2",
        "back_emf": "back_emf_per_s",
    }
    ratios = {ours: _ratio(pd, fitted, 1.0) for ours, fitted in names.items()}
    torque = {ours: _ratio(pd, fitted, armature, "ratio only") for ours, fitted in names.items()}
    actuator = measured(
        Actuator,
        model="delayed_pd",
        stiffness_nm_per_rad=torque["stiffness"],
        damping_nm_s_per_rad=torque["damping"],
        friction_loss_nm=torque["friction_loss"],
        armature_kg_m2=_anchored(pd, stall),
        effort_limit_nm=Quantity(
            value=stall, identified="no", why="the anchor itself: taken as known, see scale"
        ),
        velocity_limit_rad_s=_ratio(pd, "velocity_limit_rad_s", 1.0),
        back_emf_nm_s_per_rad=torque["back_emf"],
        dead_time_s=quantity_of(result.dead_time_s, why=pd.undecided.get("dead_time_s")),
        command_jitter_s=_jitter(result),
        delay_steps_min=low,
        delay_steps_max=high,
        physics_step_s=TIME_STEP_S,
        ratios_to_armature=measured(RatiosToArmature, **ratios),
        scale=Scale(anchor="stall torque", value_nm=stall, source=source),
    )
    s = pd.scores
    return JointCalibration(
        actuator=actuator,
        feedback=_feedback(lag, pd.parameters["offset_rad"]),
        lag=measured(
            Lag,
            lag_s=quantity_of(lag.lag_s),
            raw_lag_s=quantity_of(lag.raw_lag_s),
            fresh_lag_s=quantity_of(lag.fresh_lag_s),
        ),
        selection=Selection(
            model=result.model,
            candidate_models=tuple(_candidate(f) for f in result.candidate_models.values()),
        ),
        scores=Scores(
            rmse_one_step_rad=_finite(s.rmse_one_step_rad),
            rmse_free_run_raw_rad=_finite(s.rmse_raw_rad),
            rmse_free_run_fresh_rad=_finite(s.rmse_fresh_rad),
            rmse_free_run_held_rad=_finite(s.rmse_held_rad),
            rmse_leave_one_frequency_out_rad=_finite(s.rmse_leave_one_frequency_out_rad),
            fit_percent=_finite(s.fit_percent),
        ),
        warnings=result.warnings,
    )


def _covering(result: JointCalibrationResult) -> CandidateFit:
    """The fit that is carried, its intervals widened to the other structure if it may be that."""
    own, rival = result.delayed_pd, result.rival
    parameters, undecided = dict(own.parameters), dict(own.undecided)
    if rival is not None:
        for name in parameters.keys() & rival.parameters.keys():
            mine, other = parameters[name], rival.parameters[name]
            low, high = min(mine.low, other.low), max(mine.high, other.high)
            parameters[name] = Interval(mine.value, low, high)
            if name in rival.undecided:
                undecided.setdefault(name, rival.undecided[name])
    for name, absent in _LIMITS.items():
        mine = parameters.get(name, Interval(absent, absent, absent))
        if rival is not None:  # it may have none, or the other's
            other = rival.parameters.get(name, Interval(absent, absent, absent))
            mine = Interval(mine.value, min(mine.low, other.low), max(mine.high, other.high))
            undecided.setdefault(name, UNTOLD)
        elif name not in parameters:
            undecided[name] = "the chosen model has none"
        parameters[name] = mine
    return replace(own, parameters=parameters, undecided=undecided)


def _candidate(fit: CandidateFit) -> CandidateModel:
    s = fit.scores
    return CandidateModel(
        model=fit.model,
        parameter_count=len(candidate_model(fit.model).parameters),
        rmse_fresh_rad=_finite(s.rmse_fresh_rad),
        rmse_held_rad=_finite(s.rmse_held_rad),
        rmse_raw_rad=_finite(s.rmse_raw_rad),
        rmse_leave_one_frequency_out_rad=_finite(s.rmse_leave_one_frequency_out_rad),
        fit_percent=_finite(s.fit_percent),
        parameters=fit.values,
    )


def _ratio(
    pd: CandidateFit, name: str, factor: float, known: Literal["yes", "ratio only"] = "yes"
) -> Quantity:
    """A fitted number times `factor`, with its interval and whether the data settled it."""
    own = pd.parameters[name]
    scaled = Interval(own.value * factor, own.low * factor, own.high * factor)
    return quantity_of(scaled, known, pd.undecided.get(name))


def _anchored(pd: CandidateFit, stall: float) -> Quantity:
    effort, why = pd.parameters["effort_rad_s2"], pd.undecided.get("effort_rad_s2")
    armature = Interval(stall / effort.value, stall / effort.high, stall / effort.low)
    return quantity_of(armature, "ratio only", why)


def _feedback(lag: LagBudget, offset_rad: Interval) -> Feedback:
    lattice, step = lag.feedback, lag.quantum_rad
    quantum = Quantity(value=step, low=step, high=step, identified="yes")
    if step == 0:
        quantum = Quantity(value=0.0, identified="no", why="readings show no common step")
    if lattice.kind == "lattice":
        why = None if np.isfinite(lattice.loss) else NO_LOSS
        period = quantity_of(lattice.poll_period_interval)
        loss = quantity_of(lattice.loss_interval, why=why)
        age = quantity_of(lattice.mean_age_interval, why=why)
    else:
        why = (
            "readings are live: no poll slower than the loop"
            if lattice.kind == "every read"
            else "readings are held, but no poll period is significant"
        )
        period = loss = Quantity(value=0.0, identified="no", why=why)
        live = lattice.kind == "every read"
        age = Quantity(value=0.0 if live else lattice.time_doubt_s, identified="no", why=why)
    return measured(
        Feedback, poll_period_s=period, loss=loss, quantum_rad=quantum,
        offset_rad=quantity_of(offset_rad), mean_age_s=age,
    )  # fmt: skip


def _jitter(result: JointCalibrationResult) -> Quantity:
    found = result.command_jitter_s
    if not np.isfinite(found.value):
        return Quantity(value=0.0, identified="no", why="it takes several tones to see it")
    why = "an upper bound: friction that the model lacks grows with the tone, too"
    if found.low <= 0:
        why = "it cannot be told from none"
    if result.lag.feedback.kind == "unresolved":
        why = "readings are dated to half a loop only"
    return quantity_of(found, why=why)


def _finite(number: float) -> float | None:
    return number if np.isfinite(number) else None


@cache
def preset_parameters() -> dict[str, dict[str, DelayedPDParameters]]:
    """The published settings per preset and joint, to be scored beside a fit; read once."""
    found = {}
    for preset in PRESETS:
        calibration = load_calibration(preset)
        found[preset] = {
            joint: calibration.delayed_pd([joint]).parameters for joint in calibration.joint_names
        }
    return found
