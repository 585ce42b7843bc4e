"""Calibrate joints that carry a load, or were recorded at several P gains.

`loaded_joints` says which joints of recordings these are, `fit_joints` fits them, and `with_loaded`
puts what was found into a calibration: DelayedPD at a reference gain, and the servo at any gain and
load beside it. `sysid.identify.calibrate` calls all three.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import (
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
from pupper_sysid.servo_models.calibration.under_load import LOADED_KEYS, RecordedLoad, UnderLoad
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, whole_steps
from pupper_sysid.sysid.feedback.poll_lattice import quantum, readings
from pupper_sysid.sysid.identify.candidates.simulation import prepare
from pupper_sysid.sysid.identify.results import CandidateFit, JointCalibrationResult
from pupper_sysid.sysid.identify.scores import Scores as FitScores
from pupper_sysid.sysid.lag.lag_budget import LagBudget, lag_budget
from pupper_sysid.sysid.loaded.joint_fit import LoadedFit, fit_loaded_joint
from pupper_sysid.sysid.recordings.joints import joint_rng, map_joints
from pupper_sysid.sysid.recordings.recording import Trial

_SLOW_SHARE = 0.2  # of the fastest motion: a joint that slow is nearly at rest
_DROOP_RAD = 0.01  # of the static error over the motion, from which on it is a load's
_CARRIED = "delayed_pd_back_emf"
_KNOWN = "loaded recording"


@dataclass(frozen=True, kw_only=True)
class LoadedJointResult(JointCalibrationResult):
    """Calibration of one joint under load: what simulators run, and the servo itself.

    Attributes
    ----------
    loaded : LoadedFit
    """

    loaded: LoadedFit

    def __str__(self) -> str:
        errors = self.loaded.errors
        return (
            f"servo under load ({self.loaded.structure}) with {1e3 * self.dead_time_s.value:.1f} "
            f"ms dead time, free-run error {1e3 * errors['fresh']:.1f} mrad, "
            f"{1e3 * errors['unseen']:.1f} mrad on runs left out of the fit"
        )


def loaded_joints(trials: Mapping[str, Sequence[Trial]]) -> list[str]:
    """Joints whose trials tell of a load: a known one, several gains, torque off, or droop.

    Droop counts in motions without tones of servos with a known P gain, and then for all of them:
    the joints of an arm are calibrated in one way.
    """
    told = [j for j, own in trials.items() if _told(own)]
    arm = [
        j
        for j, own in trials.items()
        if j not in told and all(not t.frequency_hz > 0 and np.isfinite(t.p_gain) for t in own)
    ]
    return [*told, *arm] if any(droops(trials[j]) for j in arm) else told


def _told(trials: Sequence[Trial]) -> bool:
    gains = {t.p_gain for t in trials if np.isfinite(t.p_gain)}
    limp = any(t.torque_enabled is not None and not t.torque_enabled.all() for t in trials)
    return len(gains) > 1 or limp or any(t.load is not None for t in trials)


def droops(trials: Sequence[Trial]) -> bool:
    """Whether the error at rest depends on the position as gravity's torque does.

    The error of slow rows is regressed on sine and cosine of the position and on the direction of
    motion, which stands for dry friction and lag.
    """
    design, error = [], []
    for t in trials:
        known = np.isfinite(t.position_rad)
        if known.sum() < 50:
            continue
        time, position = t.read_time_s[known], t.position_rad[known]
        span = max(5, int(0.1 / max(float(np.median(np.diff(time))), 1e-3)))
        speed = np.convolve(np.gradient(position, time), np.full(span, 1 / span), "same")
        rate = np.convolve(np.gradient(t.command_rad[known], time), np.full(span, 1 / span), "same")
        fastest = np.quantile(np.abs(speed), 0.98)
        slow = (np.abs(speed) < _SLOW_SHARE * fastest) & (np.abs(rate) < _SLOW_SHARE * fastest)
        slow[: len(slow) // 50] = False
        design.append(
            np.column_stack(
                [np.sin(position), np.cos(position), np.ones(len(position)), np.sign(rate), rate]
            )[slow]
        )
        error.append((t.command_rad[known] - position)[slow])
    if not design or sum(map(len, error)) < 100:
        return False
    a, e = np.concatenate(design), np.concatenate(error)
    found = np.linalg.lstsq(a, e, rcond=None)[0]
    of_gravity = a[:, :2] @ found[:2]
    left = e - a @ found
    spread = float(np.quantile(of_gravity, 0.95) - np.quantile(of_gravity, 0.05))
    return spread > _DROOP_RAD and float(np.std(of_gravity)) > float(np.std(left))


def fit_joints(
    trials: Mapping[str, tuple[Trial, ...]],
    seed: int,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> dict[str, JointCalibrationResult]:
    """Fit every joint; parameters as for `sysid.recordings.joints.each_joint`."""
    return map_joints(partial(fit_joint, seed=seed), dict(trials), workers, progress)


def fit_joint(joint: str, trials: tuple[Trial, ...], seed: int) -> JointCalibrationResult:
    """Fit one joint under load.

    Raises
    ------
    InputError
        If there is too little motion.
    """
    found = fit_loaded_joint(joint, trials, seed)
    lag = _lag(joint, trials, seed, found)
    inertia = _total_inertia(found)
    pd = found.servo.delayed_pd(found.p_gain, 0.0, _torque(found)).arrays()
    ratios = {
        "stiffness_per_s2": ("stiffness_nm_per_rad", pd["stiffness"]),
        "damping_per_s": ("", pd["damping"]),
        "friction_rad_s2": ("friction_loss", pd["friction_loss"]),
        "effort_rad_s2": ("stall_torque", pd["effort_limit"]),
        "back_emf_per_s": ("back_emf", pd["back_emf"]),
    }
    parameters = {"dead_time_s": found.numbers["dead_time_s"]}
    for name, (source, value) in ratios.items():
        parameters[name] = _scaled(found, source, float(value), 1 / inertia)
    parameters["no_load_speed_rad_s"] = found.numbers["no_load_speed_rad_s"]
    parameters["offset_rad"] = found.numbers["offset_rad"]
    errors = found.errors
    spread = float(np.std(np.concatenate([r.sample_rad for r in found.runs])))
    scores = FitScores(
        rmse_fresh_rad=errors["fresh"],
        rmse_held_rad=errors["held"],
        rmse_raw_rad=errors["raw"],
        rmse_one_step_rad=float("nan"),
        rmse_leave_one_frequency_out_rad=float("nan"),
        rmse_by_left_out_frequency_rad={},
        fit_percent=100 * (1 - errors["fresh"] / max(spread, 1e-9)),
        rmse_unseen_runs_rad=errors["unseen"],
    )
    undecided = {
        name: found.undecided[source]
        for name, (source, _) in ratios.items()
        if source in found.undecided
    }
    undecided |= {k: v for k, v in found.undecided.items() if k == "dead_time_s"}
    nan = float("nan")
    data = tuple(
        d for t in trials if len((d := prepare(t, readings(t, found.lattice))).sample_step)
    )
    return LoadedJointResult(
        joint=joint,
        model=found.structure,
        simulated_model=_CARRIED,
        structure_nats={_CARRIED: 0.0},
        command_jitter_s=Interval(nan, nan, nan),
        candidate_models={_CARRIED: CandidateFit(
            model=_CARRIED, parameters=parameters, undecided=undecided, scores=scores
        )},
        lag=lag.with_dead_time(
            found.numbers["dead_time_s"], found.numbers["offset_rad"].value
        ),
        presets={},
        warnings=(*lag.warnings, *_warnings(joint, found)),
        trials=data,
        loaded=found,
    )  # fmt: skip


def with_loaded(
    calibration: Calibration,
    results: Mapping[str, JointCalibrationResult],
    anchors: Mapping[str, tuple[float, str]],
) -> Calibration:
    """The calibration with the joints that were fitted under load.

    Parameters
    ----------
    calibration : Calibration
        Of all joints, from `sysid.identify.calibration_file`.
    results : mapping of joint to JointCalibrationResult
    anchors : mapping of joint to (float, str)
        Torque anchor of joints whose load is unknown [N·m], and its source.
    """
    loaded = {j: r for j, r in results.items() if isinstance(r, LoadedJointResult)}
    if not loaded:
        return calibration
    joints = dict(calibration.joints)
    for joint, result in loaded.items():
        joints[joint] = _joint(result, joints[joint].feedback, *anchors[joint])
    notes = calibration.notes
    if all(r.loaded.known_load for r in loaded.values()) and len(loaded) == len(joints):
        notes = (
            *notes[:1],
            "Torques, armature and friction are in N·m from the known load of the recordings; the "
            "armature is the servo's own, without the load.",
        )
    return calibration.model_copy(update={"joints": joints, "notes": notes})


def _joint(
    result: LoadedJointResult, feedback: Feedback, stall: float, source: str
) -> JointCalibration:
    found = result.loaded
    # without a known load torques are per inertia: the anchor makes them N·m
    torque = 1.0 if found.known_load else stall / found.numbers["stall_torque"].value
    known = found.known_load
    pd = found.servo.delayed_pd(found.p_gain, 0.0, _torque(found)).arrays()
    armature = float(pd["armature"]) * torque

    def number(name: str, source: str, factor: float = torque) -> Quantity:
        interval = _scaled(found, source, float(pd[name]), factor)
        return _quantity(interval, found.undecided.get(source), known or factor == 1.0)

    if known:
        inertia = _quantity(found.numbers["armature"], found.undecided.get("armature"), True)
        scale = Scale(
            anchor=_KNOWN, value_nm=max(g for _, g in found.loads), source="the known load"
        )
    else:
        inertia = Quantity(value=armature, identified="ratio only", why="scale from the anchor")
        scale = Scale(anchor="stall torque", value_nm=stall, source=source)
    ratio = {
        name: _quantity(
            _scaled(found, source, float(pd[name]), torque / armature),
            found.undecided.get(source), True,
        )
        for name, source in (
            ("stiffness", "stiffness_nm_per_rad"), ("damping", "duty_s_per_rad"),
            ("friction_loss", "friction_loss"), ("effort_limit", "stall_torque"),
            ("back_emf", "back_emf"),
        )
    }  # fmt: skip
    dead_time = found.numbers["dead_time_s"]
    low, high = whole_steps(dead_time.low, dead_time.high, TIME_STEP_S)
    actuator = measured(
        Actuator,
        model="delayed_pd",
        stiffness_nm_per_rad=number("stiffness", "stiffness_nm_per_rad"),
        damping_nm_s_per_rad=number("damping", "duty_s_per_rad"),
        friction_loss_nm=number("friction_loss", "friction_loss"),
        armature_kg_m2=inertia,
        effort_limit_nm=number("effort_limit", "stall_torque"),
        velocity_limit_rad_s=Quantity(
            value=1000.0, identified="no", why="the chosen model has none"
        ),
        back_emf_nm_s_per_rad=number("back_emf", "back_emf"),
        dead_time_s=_quantity(dead_time, found.undecided.get("dead_time_s"), True),
        delay_steps_min=low,
        delay_steps_max=high,
        physics_step_s=TIME_STEP_S,
        ratios_to_armature=measured(RatiosToArmature, **ratio),
        scale=scale,
    )
    errors = found.errors
    finite = {k: v if np.isfinite(v) else None for k, v in errors.items()}
    return JointCalibration(
        actuator=actuator,
        under_load=_block(found, torque),
        feedback=measured(
            Feedback,
            **dict(feedback) | {"offset_rad": _quantity(found.numbers["offset_rad"], None, True)},
        ),
        lag=Lag(),
        selection=Selection(
            model=found.structure,
            candidate_models=tuple(
                CandidateModel(
                    model=s.name,
                    parameter_count=len(s.parameters),
                    rmse_fresh_rad=s.rmse_rad if np.isfinite(s.rmse_rad) else None,
                    mae_unseen_runs_rad=(
                        s.mae_unseen_rad if np.isfinite(s.mae_unseen_rad) else None
                    ),
                    parameters=s.parameters,
                )
                for s in found.structures
            ),
        ),
        scores=Scores(
            rmse_free_run_raw_rad=finite["raw"],
            rmse_free_run_fresh_rad=finite["fresh"],
            rmse_free_run_held_rad=finite["held"],
            rmse_unseen_runs_rad=finite["unseen"],
        ),
        warnings=result.warnings,
    )


def _block(found: LoadedFit, torque: float) -> UnderLoad:
    """The servo at any gain and load; `torque` makes torques of the fit N·m."""
    factor = dict.fromkeys(
        ("stall_torque", "back_emf", "armature", "friction_loss", "stribeck_friction",
         "torque_limit", "gravity_nm"), torque
    ) | {"load_friction_quadratic": 1 / torque}  # fmt: skip
    known = found.known_load

    def number(name: str) -> Quantity | None:
        if name not in found.numbers:
            return None
        scale = factor.get(name, 1.0)
        interval = found.numbers[name]
        scaled = Interval(*(scale * x for x in (interval.value, interval.low, interval.high)))
        return _quantity(scaled, found.undecided.get(name), known or name not in factor)

    own = {key: number(name) for name, key in LOADED_KEYS.items()}
    if not known:
        own["armature_kg_m2"] = Quantity(
            value=torque, identified="ratio only", why="scale from the anchor; holds the load's"
        )
    return measured(
        UnderLoad,
        structure=found.structure,
        known_load=known,
        p_gain=found.p_gain,
        p_gains_tested=found.p_gains,
        loads_tested=tuple(
            RecordedLoad(inertia_kg_m2=inertia, gravity_nm=gravity)
            for inertia, gravity in (found.loads if known else ())
        ),
        reference_voltage_v=(
            found.reference_voltage_v if np.isfinite(found.reference_voltage_v) else None
        ),
        **own,
        gravity_nm=number("gravity_nm"),
        hanging_rad=number("hanging_rad"),
    )


def _scaled(found: LoadedFit, source: str, value: float, factor: float) -> Interval:
    """`value` times `factor`, with the relative interval of the number it comes from."""
    own = found.numbers.get(source)
    if own is None or own.value <= 0:
        return Interval(factor * value, factor * value, factor * value)
    return Interval(
        factor * value, factor * value * own.low / own.value, factor * value * own.high / own.value
    )


def _quantity(interval: Interval, why: str | None, absolute: bool) -> Quantity:
    return quantity_of(interval, "yes" if absolute else "ratio only", why)


def _torque(found: LoadedFit) -> float:
    """Torque at which the friction of DelayedPD is that of the servo [N·m]."""
    return found.motor_torque_nm


def _total_inertia(found: LoadedFit) -> float:
    """Armature and the largest load [kg·m²]; 1 without a known load."""
    armature = float(np.asarray(found.servo.armature))
    return armature + (max(i for i, _ in found.loads) if found.known_load else 0.0)


def _lag(joint: str, trials: tuple[Trial, ...], seed: int, found: LoadedFit) -> LagBudget:
    """The lag in these recordings; it moves with gain and load, so it is not the servo's."""
    try:
        budget = lag_budget(joint, trials, joint_rng(seed, joint), found.lattice)
    except InputError:
        nan = float("nan")
        none = Interval(nan, nan, nan)
        budget = LagBudget(
            joint=joint, raw_lag_s=none, fresh_lag_s=none, lag_s=none, stale_lag_s=nan,
            command_hold_s=nan, feedback=found.lattice, quantum_rad=quantum(trials),
            by_frequency=(), estimators_s={}, noise_rad=nan, warnings=(),
        )  # fmt: skip
    own = tuple(w for w in budget.warnings if "mechanical stop clips" not in w)  # friction holds it
    if len(found.p_gains) > 1 or len(found.loads) > 1:
        own = (*own, f"{joint}: the lag is a mean over gains and loads; only the dead time is "
                     "the servo's own.")  # fmt: skip
    return replace(budget, warnings=own)


def _warnings(joint: str, found: LoadedFit) -> list[str]:
    made = []
    for name, why in found.undecided.items():
        made.append(f"{joint}: {name} is not identified: {why}.")
    if lost := found.servo.beyond_delayed_pd():
        made.append(
            f"{joint}: simulators' actuators do not carry {', '.join(lost)}; DelayedPD has the "
            f"friction of a motor torque of {_torque(found):.2g}"
            f"{' N·m' if found.known_load else ' rad/s²'}. `under_load` has the whole servo."
        )
    others = [
        f"run {n} ({'none' if np.isinf(r.ramp_share) else f'{r.ramp_share:g} times as large'})"
        for n, r in enumerate(found.runs, 1)
        if r.ramp_share > 1
    ]
    if others and np.isfinite(float(found.servo.arrays()["acceleration_limit"])):
        made.append(
            f"{joint}: the set-point's acceleration is limited, but otherwise in "
            f"{', '.join(others)} of {len(found.runs)}. A register decides that "
            "(`acceleration`), so it belongs to the recording, not to the servo."
        )
    if not found.folds:
        made.append(f"{joint}: one run only, so no structure was tested on unseen motion.")
    return made
