"""Which joints of recordings carried a load, or were recorded at several P gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pupper_sysid.sysid.recordings.recording import Trial

_SLOW_SHARE = 0.2  # of the fastest motion: a joint that slow is nearly at rest
_DROOP_RAD = 0.01  # of the static error over the motion, from which on it is a load's


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
