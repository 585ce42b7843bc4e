"""P gain, armature and load that a calibration's numbers are for, from its recordings.

A calibration under load holds at every P gain, and its stiffness is written down for one of them:
the servo's own when it was recorded. `reference_gain` says which that is; it depends neither on how
many runs came at each gain nor on their order. `loaded_joints` says which joints carried a load.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pupper_sysid.common.data_sheet import factory_p_gain
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import NOT_STATED, JointCalibration, OperatingPoint
from pupper_sysid.sysid.recordings.recording import Trial

_SLOW_SHARE = 0.2  # of the fastest motion: a joint that slow is nearly at rest
_DROOP_RAD = 0.01  # of the static error over the motion, from which on it is a load's


@dataclass(frozen=True)
class ReferenceGain:
    """P gain that the stiffness of a calibration is for.

    Attributes
    ----------
    value : float or None
        The register's value; None where no recording states a gain.
    source : str
        Where it comes from, in words.
    assumed : bool
        Whether the recordings leave it open, so that it was assumed.
    """

    value: float | None
    source: str
    assumed: bool = False


def reference_gain(trials: Sequence[Trial]) -> ReferenceGain:
    """The servo's own P gain in its recordings.

    In this order: the one that the headers state; that of all runs; the factory setting of the
    servo that the headers name; the largest that was recorded.

    `trials`: all of one joint.
    """
    headers = {t.servo.p_gain for t in trials if t.servo.p_gain}
    if len(headers) == 1:
        return ReferenceGain(headers.pop(), "the servo's own by the recording's header")
    gains = {t.p_gain for t in trials if np.isfinite(t.p_gain) and t.p_gain > 0}
    if not gains:
        return ReferenceGain(None, NOT_STATED)
    if len(gains) == 1:
        return gain_of_runs(trials)
    models = {t.servo.model for t in trials if t.servo.model}
    factory = factory_p_gain(models.pop()) if len(models) == 1 else None
    if factory:
        return ReferenceGain(factory[0], f"factory setting: {factory[1]}", assumed=True)
    return ReferenceGain(max(gains), "the largest that was recorded", assumed=True)


def gain_of_runs(trials: Sequence[Trial]) -> ReferenceGain:
    """The gain of runs that all have the same, as recordings in free air do; None otherwise."""
    gains = {t.p_gain for t in trials if np.isfinite(t.p_gain) and t.p_gain > 0}
    if len(gains) != 1:
        return ReferenceGain(None, NOT_STATED)
    return ReferenceGain(gains.pop(), "that of all runs")


def with_operating_points(
    calibration: Calibration, trials: Mapping[str, Sequence[Trial]]
) -> Calibration:
    """The calibration with the operating point of each joint, and notes on gains that were assumed.

    `trials`: that it was made from.
    """
    joints, notes = {}, list(calibration.notes)
    for name, joint in calibration.joints.items():
        # in free air the stiffness is that of the runs themselves
        gain = (reference_gain if joint.servo else gain_of_runs)(trials[name])
        joints[name] = joint.model_copy(
            update={"operating_point": _operating_point(joint, trials[name], gain)}
        )
        if gain.assumed and gain.value is not None:
            recorded = sorted({t.p_gain for t in trials[name] if np.isfinite(t.p_gain)})
            notes.append(
                f"{name}: the recordings, at P {', '.join(f'{g:g}' for g in recorded)}, do not say "
                f"which gain is the servo's own; the stiffness is for P {gain.value:g} "
                f"({gain.source})."
            )
    return calibration.model_copy(update={"joints": joints, "notes": tuple(notes)})


def _operating_point(
    joint: JointCalibration, trials: Sequence[Trial], gain: ReferenceGain
) -> OperatingPoint:
    block = joint.servo
    return OperatingPoint(
        p_gain=gain.value,
        p_gain_source=gain.source,
        armature="servo" if block is not None and block.known_load else "servo and load",
        load=_load(trials),
    )


def loads_in_words(trials: Sequence[Trial]) -> str:
    """The loads that the headers state; empty without any."""
    loads = dict.fromkeys(t.load for t in trials if t.load is not None)
    return ", ".join(
        f"{load.mass_kg:g} kg at {load.length_m:g} m"
        + (f" on an arm of {load.arm_mass_kg:g} kg" if load.arm_mass_kg else "")
        for load in loads
    )


def _load(trials: Sequence[Trial]) -> str:
    """What the joint carried, in words."""
    stated = loads_in_words(trials)
    if not stated:
        return "none stated, so the joint's link and whatever hung on it"
    return stated + (", runs without a stated load" if any(t.load is None for t in trials) else "")


def loaded_joints(trials: Mapping[str, Sequence[Trial]]) -> list[str]:
    """Joints whose trials tell of a load: a known one, several gains, torque off, or droop.

    Droop counts in motions without tones of servos with a known P gain, and then for all of them:
    the joints of an arm are calibrated in one way.
    """
    stated = [j for j, joint_trials in trials.items() if tells_of_load(joint_trials)]
    arm = [
        j
        for j, joint_trials in trials.items()
        if j not in stated
        and all(not t.frequency_hz > 0 and np.isfinite(t.p_gain) for t in joint_trials)
    ]
    return [*stated, *arm] if any(droops(trials[j]) for j in arm) else stated


def tells_of_load(trials: Sequence[Trial]) -> bool:
    """Whether trials state a load, several P gains, or torque switched off."""
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
    coefficients = np.linalg.lstsq(a, e, rcond=None)[0]
    of_gravity = a[:, :2] @ coefficients[:2]
    unexplained = e - a @ coefficients
    spread = float(np.quantile(of_gravity, 0.95) - np.quantile(of_gravity, 0.05))
    return spread > _DROOP_RAD and float(np.std(of_gravity)) > float(np.std(unexplained))
