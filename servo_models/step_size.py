"""What a simulator's time step does to a servo's lag, and the delay that makes up for it.

In a step MuJoCo, like most engines, turns the set-point and brakes the joint with what will be true
at the step's end. A stepped servo therefore answers sooner than the same servo in continuous time,
by about a step: a calibration found with steps of 2 ms and simulated with 5 ms would be 2 to 3 ms
too quick. `delay_at_step` is the delay with which another step gives the same lag.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from common.errors import InputError
from servo_models.delayed_pd import TIME_STEP_S, DelayedPD, DelayedPDParameters

_TONES_HZ, _AMPLITUDE_RAD = (1.0, 2.0, 4.0), 0.2  # a walk's speeds, below most servos' limits
_LOOP_S = 0.0193  # no multiple of a step: a delay puts commands anywhere in one
_WARM_UP_S, _LENGTH_S = 1.0, 3.0


def lag_in_steps_of(parameters: DelayedPDParameters, time_step_s: float) -> NDArray[np.float64]:
    """Mean lag behind slow tones [s] of servos stepped so, without their delay.

    Parameters
    ----------
    parameters : DelayedPDParameters
        Numbers, or arrays of shape (servos,).
    time_step_s : float

    Returns
    -------
    ndarray, shape (servos,)

    Raises
    ------
    InputError
        If the servo is not stable at this step.
    """
    count = round(_LENGTH_S / time_step_s)
    edge = time_step_s * np.arange(count + 1)
    turn = 2 * np.pi * np.array(_TONES_HZ)
    # commands in stairs, as control loops give them: on each stair the set-point runs at its limit;
    # a step gets the mean of the command over it
    told = _LOOP_S * np.arange(round(_LENGTH_S / _LOOP_S) + 2)
    stairs = _AMPLITUDE_RAD * np.sin(told[:-1, None] * turn)
    area = np.concatenate([np.zeros((1, len(turn))), np.cumsum(stairs * _LOOP_S, axis=0)])
    commands = np.stack([np.diff(np.interp(edge, told, a)) for a in area.T], axis=1) / time_step_s
    tall = replace(
        parameters,
        **{
            name: np.atleast_1d(getattr(parameters, name))[:, None]
            for name in ("stiffness", "damping", "friction_loss", "armature", "effort_limit",
                         "velocity_limit")
        },
        delay_s=0.0,
    )  # fmt: skip
    servo = DelayedPD(tall, time_step_s)
    servo.reset(np.zeros((len(np.atleast_1d(parameters.stiffness)), len(turn))))
    moved = servo.rollout(commands[:, None])
    late = edge[1:] > _WARM_UP_S
    lags = []
    for n, w in enumerate(turn):
        at = w * edge[1:][late]
        basis = np.stack([np.sin(at), np.cos(at), np.ones_like(at)], axis=1)
        sine, cosine, _ = np.linalg.lstsq(basis, moved[late, :, n], rcond=None)[0]
        lags.append(np.arctan2(-cosine, sine) / w)
    found = np.mean(lags, axis=0)
    if not (np.isfinite(found).all() and np.abs(moved).max() < 10 * _AMPLITUDE_RAD):
        raise InputError(
            f"a servo of this calibration is not stable in physics steps of {1e3 * time_step_s:g} "
            "ms; take shorter ones."
        )
    return found


def delay_at_step(
    parameters: DelayedPDParameters, time_step_s: float, fitted_step_s: float = TIME_STEP_S
) -> NDArray[np.float64]:
    """Delay [s] with which servos in steps of `time_step_s` lag as they do in `fitted_step_s`.

    Parameters
    ----------
    parameters : DelayedPDParameters
        Numbers, or arrays of shape (servos,); found in steps of `fitted_step_s`.
    time_step_s, fitted_step_s : float

    Returns
    -------
    ndarray, shape (servos,)
        May be negative, where the step alone is more than the whole lag.

    Raises
    ------
    InputError
        If the servo is not stable at this step.
    """
    delay = np.atleast_1d(parameters.delay_s)
    if time_step_s == fitted_step_s:
        return delay
    quicker = lag_in_steps_of(parameters, fitted_step_s) - lag_in_steps_of(parameters, time_step_s)
    return delay + quicker
