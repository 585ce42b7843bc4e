"""Convert the fits of calibration to the `Calibration` that simulators read.

Free-air positions give ratios to the armature. One torque sets the scale: the stall torque, which
is the effort limit; so armature = stall torque / (effort limit per inertia), and the rest follows.
A known load sets the scale itself. A servo recorded under load or at several gains has a block
`servo` besides: the servo at any gain and load.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from types import MappingProxyType
from typing import Literal

import numpy as np

from pupper_sysid.common.data_sheet import recorded_stall_torque
from pupper_sysid.common.errors import InputError
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
    LOADED_KEYS,
    NO_SPEED_LIMIT_RAD_S,
    Actuator,
    CandidateModel,
    Feedback,
    FittedServo,
    JointCalibration,
    Lag,
    RatiosToArmature,
    RecordedLoad,
    Scale,
    Scores,
    Selection,
)
from pupper_sysid.servo_models.calibration.quantity import Quantity, measured, quantity_of
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPDParameters, whole_steps
from pupper_sysid.servo_models.step_size import at_step
from pupper_sysid.sysid.feedback.poll_lattice import NO_LOSS
from pupper_sysid.sysid.fit.goodness import overall
from pupper_sysid.sysid.fit.results import (
    RATIO_SOURCES,
    UNTOLD,
    CandidateFit,
    JointCalibrationResult,
    LoadedFit,
)
from pupper_sysid.sysid.fit.servo_prior import ServoPrior
from pupper_sysid.sysid.fit.structure import candidate
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.recordings.recording import Recording

GIVEN_TORQUE = "given by the user"
"""Source of a torque anchor that no data sheet gave."""

_KNOWN_SCALE = (
    "Torques, armature and friction are in N·m from the known load of the recordings; the "
    "armature is the servo's own, without the load."
)
_RATIOS = {
    "stiffness": "stiffness_per_s2", "damping": "damping_per_s", "friction_loss": "friction_rad_s2",
    "effort_limit": "effort_rad_s2", "back_emf": "back_emf_per_s",
}  # fmt: skip
"""Ratios to the armature in the file, and their names in a fit."""

_LIMITS = {"velocity_limit_rad_s": NO_SPEED_LIMIT_RAD_S, "back_emf_per_s": 0.0}
"""The two limits on a servo's speed, with the value that stands for none."""


def to_calibration(
    results: Mapping[str, JointCalibrationResult],
    recordings: Sequence[Recording],
    seed: int,
    stall_torque_nm: float | None = None,
    priors: Mapping[str, ServoPrior] = MappingProxyType({}),
) -> Calibration:
    """The calibration file of `results`.

    `recordings`: their sources; names and hashes go into the file. `stall_torque_nm`, `priors`: as
    for `torque_anchors`.
    """
    anchors = torque_anchors(list(results), recordings, stall_torque_nm, priors)
    buses = [r.metadata.get("bus") or {} for r in recordings]
    kinds = {str(bus.get("kind", "unknown bus")) for bus in buses}
    maps = {str(bus["joint_map"]) for bus in buses if bus.get("joint_map")}
    pupper = set(results) <= set(JOINT_NAMES)
    robot = "Mini Pupper 2" if pupper else ", ".join(sorted(maps)) or "another robot"
    return Calibration(
        robot=f"{robot} ({', '.join(sorted(kinds))})",
        created=utc_now(),
        inputs=tuple(
            InputFile(name=r.path.name if r.path else r.name, sha256=r.sha256) for r in recordings
        ),
        seed=seed,
        versions=versions(),
        notes=(
            "Delay belongs to the actuator; poll period, loss and age belong to the observation.",
            _KNOWN_SCALE
            if all(r.loaded is not None and r.loaded.known_load for r in results.values())
            else "Only ratios to the armature come from the recording; torques scale with the "
            "anchor.",
        ),
        joints={name: _joint(r, *anchors[name]) for name, r in results.items()},
    )


def torque_anchors(
    joints: Sequence[str],
    recordings: Sequence[Recording],
    stall_torque_nm: float | None = None,
    priors: Mapping[str, ServoPrior] = MappingProxyType({}),
) -> dict[str, tuple[float, str]]:
    """Stall torque [N·m] that sets the scale of each joint's torques, and its source.

    `recordings`: their headers may name the servo. `stall_torque_nm`: of all joints; by default
    that of the data sheet of the recorded servo; where no recording names one, of the prior's, or
    of the Mini Pupper's servo. `priors`: by joint, of those that have one.
    """
    if stall_torque_nm is not None:
        return dict.fromkeys(joints, (stall_torque_nm, GIVEN_TORQUE))
    known = {
        joint: (prior.effort_limit_nm, f"effort limit of {prior.source}")
        for joint, prior in priors.items()
        if prior.effort_limit_nm is not None
    }
    headers = [r.metadata.get("servos") or {} for r in recordings]
    return {
        joint: recorded_stall_torque(h.get(joint, {}) for h in headers)
        or known.get(joint, (STALL_TORQUE_NM, STALL_TORQUE_SOURCE))
        for joint in joints
    }


def _joint(result: JointCalibrationResult, stall: float, source: str) -> JointCalibration:
    lag, loaded, s = result.lag, result.loaded, result.delayed_pd.scores
    if loaded is None:
        actuator, block = _free_actuator(result, stall, source), None
        numbers, undecided = result.delayed_pd.parameters, result.delayed_pd.undecided
    else:
        # without a known load torques are per inertia: the anchor makes them N·m
        torque = 1.0 if loaded.known_load else stall / loaded.numbers["stall_torque"].value
        actuator = _loaded_actuator(result, loaded, torque, stall, source)
        block, numbers, undecided = _block(loaded, torque), loaded.numbers, loaded.undecided
    return JointCalibration(
        actuator=actuator,
        servo=block,
        feedback=_feedback(
            lag, quantity_of(numbers["offset_rad"], why=undecided.get("offset_rad"))
        ),
        lag=measured(
            Lag,
            lag_s=quantity_of(lag.lag_s),
            raw_lag_s=quantity_of(lag.raw_lag_s),
            fresh_lag_s=quantity_of(lag.fresh_lag_s),
        ) if loaded is None or _one_motion(loaded) else Lag(),
        selection=Selection(
            model=result.model,
            candidate_models=tuple(
                _candidate(f) for f in result.candidate_models.values()
            ) if loaded is None else tuple(
                CandidateModel(
                    model=f.name, parameter_count=len(f.parameters), parameters=f.parameters,
                    rmse_fresh_rad=_finite(f.rmse_rad),
                    mae_unseen_runs_rad=_finite(f.mae_unseen_rad),
                )
                for f in loaded.structures
            ),
        ),
        scores=Scores(
            rmse_one_step_rad=_finite(s.rmse_one_step_rad),
            rmse_free_run_raw_rad=_finite(s.rmse_raw_rad),
            rmse_free_run_fresh_rad=_finite(s.rmse_fresh_rad),
            rmse_free_run_held_rad=_finite(s.rmse_held_rad),
            rmse_leave_one_frequency_out_rad=_finite(s.rmse_leave_one_frequency_out_rad),
            rmse_unseen_runs_rad=_finite(s.rmse_unseen_runs_rad),
            fit_percent=_finite(s.fit_percent),
            residual_over_noise=_finite(overall(result.goodness)),
            r_hat=_finite(result.r_hat),
            effective_draws=_finite(result.effective_draws),
        ),
        between_recordings=result.between_recordings,
        warnings=result.warnings,
    )  # fmt: skip


def _one_motion(loaded: LoadedFit) -> bool:
    """Whether the lag is that of the joint, not a mean over gains and loads."""
    return not loaded.known_load and len(loaded.p_gains) < 2


def _free_actuator(result: JointCalibrationResult, stall: float, source: str) -> Actuator:
    """DelayedPD of a joint in free air."""
    pd = _covering(result)
    armature = stall / pd.values["effort_rad_s2"]
    values = {ours: pd.values[name] for ours, name in _RATIOS.items()}
    servo = DelayedPDParameters(
        **values, armature=1.0, velocity_limit=pd.values["velocity_limit_rad_s"],
        dead_time_s=result.dead_time_s.value,
    )  # fmt: skip
    low, high = _delay_steps(servo, result.dead_time_s)
    ratios = {ours: _ratio(pd, name, 1.0) for ours, name in _RATIOS.items()}
    if "braking_per_s" in pd.parameters:  # a calibration that was read again has no draws for it
        ratios["damping_and_back_emf"] = _ratio(pd, "braking_per_s", 1.0)
    torque = {ours: _ratio(pd, name, armature, "ratio only") for ours, name in _RATIOS.items()}
    return measured(
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
        numbers_in="continuous time",
        ratios_to_armature=measured(RatiosToArmature, **ratios),
        scale=Scale(anchor="stall torque", value_nm=stall, source=source),
    )


def _loaded_actuator(
    result: JointCalibrationResult, loaded: LoadedFit, torque: float, stall: float, source: str
) -> Actuator:
    """DelayedPD at the reference gain, with the servo's own armature; `torque` makes it N·m."""
    known = loaded.known_load
    servo = loaded.servo.delayed_pd(loaded.p_gain, 0.0, loaded.motor_torque_nm)
    pd, (low, high) = servo.arrays(), _delay_steps(servo, result.dead_time_s)
    armature = float(pd["armature"]) * torque

    def number(name: str, factor: float, absolute: bool) -> Quantity:
        place = RATIO_SOURCES[_RATIOS[name]][0]
        if not float(pd[name]):
            return Quantity(value=0.0, identified="no", why="the chosen structure has none")
        interval = loaded.relative(place, factor * float(pd[name]))
        return quantity_of(
            interval, "yes" if absolute else "ratio only", loaded.undecided.get(place)
        )

    if known:
        inertia = quantity_of(loaded.numbers["armature"], why=loaded.undecided.get("armature"))
        scale = Scale(
            anchor="loaded recording", value_nm=max(g for _, g in loaded.loads),
            source="the known load",
        )  # fmt: skip
    else:
        inertia = Quantity(value=armature, identified="ratio only", why="scale from the anchor")
        scale = Scale(anchor="stall torque", value_nm=stall, source=source)
    numbers = {name: number(name, torque, known) for name in _RATIOS}
    ratios = {name: number(name, torque / armature, True) for name in _RATIOS}
    braking = loaded.numbers["braking"]
    ratios["damping_and_back_emf"] = quantity_of(
        loaded.relative("braking", braking.value * torque / armature),
        why=loaded.undecided.get("braking"),
    )
    return measured(
        Actuator,
        model="delayed_pd",
        stiffness_nm_per_rad=numbers["stiffness"],
        damping_nm_s_per_rad=numbers["damping"],
        friction_loss_nm=numbers["friction_loss"],
        armature_kg_m2=inertia,
        effort_limit_nm=numbers["effort_limit"],
        velocity_limit_rad_s=quantity_of(
            loaded.numbers["velocity_limit"], why=loaded.undecided.get("velocity_limit")
        )
        if "velocity_limit" in loaded.numbers
        else Quantity(
            value=NO_SPEED_LIMIT_RAD_S, identified="no", why="the chosen structure has none"
        ),
        back_emf_nm_s_per_rad=numbers["back_emf"],
        dead_time_s=quantity_of(result.dead_time_s, why=loaded.undecided.get("dead_time_s")),
        delay_steps_min=low,
        delay_steps_max=high,
        physics_step_s=TIME_STEP_S,
        numbers_in="continuous time",
        ratios_to_armature=measured(RatiosToArmature, **ratios),
        scale=scale,
    )


def _delay_steps(servo: DelayedPDParameters, dead_time_s: Interval) -> tuple[int, int]:
    """Dead times to train with, in whole physics steps, rounded outward.

    Those of the servo itself where it is too stiff to be simulated in such steps.
    """
    try:
        more = float(np.squeeze(at_step(servo, TIME_STEP_S).dead_time_s)) - dead_time_s.value
    except InputError:
        more = 0.0
    low, high = (max(t + more, 0.0) for t in (dead_time_s.low, dead_time_s.high))
    return whole_steps(low, high, TIME_STEP_S)


def _block(loaded: LoadedFit, torque: float) -> FittedServo:
    """The servo at any gain and load; `torque` makes torques of the fit N·m."""
    factor = dict.fromkeys(
        ("stall_torque", "back_emf", "armature", "friction_loss", "stribeck_friction",
         "torque_limit", "gravity_nm"), torque
    ) | {"load_friction_quadratic": 1 / torque}  # fmt: skip
    known = loaded.known_load

    def number(name: str) -> Quantity | None:
        if name not in loaded.numbers:
            return None
        scale, interval = factor.get(name, 1.0), loaded.numbers[name]
        scaled = Interval(scale * interval.value, scale * interval.low, scale * interval.high)
        absolute = known or name not in factor
        return quantity_of(scaled, "yes" if absolute else "ratio only", loaded.undecided.get(name))

    numbers = {key: number(name) for name, key in LOADED_KEYS.items()}
    if not known:
        numbers["armature_kg_m2"] = Quantity(
            value=torque, identified="ratio only", why="scale from the anchor; holds the load's"
        )
    volts = loaded.reference_voltage_v
    return measured(
        FittedServo,
        structure=loaded.structure,
        known_load=known,
        p_gain=loaded.p_gain,
        p_gains_tested=loaded.p_gains,
        loads_tested=tuple(
            RecordedLoad(inertia_kg_m2=inertia, gravity_nm=gravity)
            for inertia, gravity in (loaded.loads if known else ())
        ),
        reference_voltage_v=volts if np.isfinite(volts) else None,
        **numbers,
        gravity_nm=number("gravity_nm"),
        hanging_rad=number("hanging_rad"),
    )


def _covering(result: JointCalibrationResult) -> CandidateFit:
    """The fit that is exported, its intervals widened to the other structure if it may be that."""
    fitted, rival = result.delayed_pd, result.rival
    parameters, undecided = dict(fitted.parameters), dict(fitted.undecided)
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
    return replace(fitted, parameters=parameters, undecided=undecided)


def _candidate(fit: CandidateFit) -> CandidateModel:
    s = fit.scores
    return CandidateModel(
        model=fit.model,
        parameter_count=len(candidate(fit.model).parameters),
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
    parameter = pd.parameters[name]
    scaled = Interval(parameter.value * factor, parameter.low * factor, parameter.high * factor)
    return quantity_of(scaled, known, pd.undecided.get(name))


def _anchored(pd: CandidateFit, stall: float) -> Quantity:
    effort, why = pd.parameters["effort_rad_s2"], pd.undecided.get("effort_rad_s2")
    armature = Interval(stall / effort.value, stall / effort.high, stall / effort.low)
    return quantity_of(armature, "ratio only", why)


def _feedback(lag: LagBudget, offset_rad: Quantity) -> Feedback:
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
        offset_rad=offset_rad, mean_age_s=age,
    )  # fmt: skip


def _jitter(result: JointCalibrationResult) -> Quantity:
    jitter = result.command_jitter_s
    if not np.isfinite(jitter.value):
        return Quantity(value=0.0, identified="no", why="it takes several tones to see it")
    why = "an upper bound: friction that the model lacks grows with the tone, too"
    if jitter.low <= 0:
        why = "it cannot be distinguished from none"
    if result.lag.feedback.kind == "unresolved":
        why = "readings are dated to half a loop only"
    return quantity_of(jitter, why=why)


def _finite(number: float) -> float | None:
    return number if np.isfinite(number) else None


@cache
def preset_parameters() -> dict[str, dict[str, DelayedPDParameters]]:
    """The published settings per preset and joint, to be scored beside a fit; read once."""
    presets = {}
    for preset in PRESETS:
        calibration = load_calibration(preset)
        presets[preset] = {
            joint: calibration.delayed_pd([joint]).parameters for joint in calibration.joint_names
        }
    return presets
