"""Effect of a simulator's time step on a servo's lag, and the dead time that compensates for it.

MuJoCo, like most engines, computes set-point and damping of a step with the values at the step's
end. A stepped servo therefore responds earlier than the same servo in continuous time, by about a
step: a calibration fitted in steps of 2 ms and simulated with 5 ms would be 2 to 3 ms too early. A
simulator without a speed limit on set-points responds earlier, too, and one that computes the PD
before its step later. `delay_at_step` is the dead time with which another `Engine`, or another
step, gives the same lag to commands at any time. A calibration holds a servo's own numbers, in
continuous time; `at_step` has those that a simulator needs to move like it. A simulator's control
loop gives its commands at the beginnings of physics steps: `nearest_in_loop` has the dead time with
which the positions are nearest then, which leaves two thirds of the distance.

What is left has no cure in an actuator's numbers. Within one step a torque, a friction and the
speed of a set-point are constant: the largest torque moves a servo by `effort_limit / armature *
h**2` in a step of h, 1.5 mrad in 2 ms and 9 mrad in 5 ms for a small servo, and by some part of
this it is off wherever it stops, slips or reaches a limit. Poles of the PD loop could be matched
exactly (stiffness 10 % higher in 2 ms), but a stance under load would then sag less than the
servo's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.tones import least_squares, sine_design
from pupper_sysid.servo_models.delayed_pd import (
    TIME_STEP_S,
    TORQUES,
    DelayedPDParameters,
    DelayLine,
    integrate,
)

CONTINUOUS_S = 0.0002
"""Step that stands for continuous time [s]: a tenth of the physics step of training."""

_TONES_HZ, _AMPLITUDE_RAD = (1.0, 2.0, 4.0), 0.2  # a walk's speeds, below most servos' limits
_LOOP_S = 0.0193  # no multiple of a step: a delay puts commands anywhere in one
_WARM_UP_S, _LENGTH_S = 1.0, 3.0
CONTROL_S = 0.02
"""Period of the control loops that policies run in [s]."""
_LOOP_TONES, _LOOP_TONE_S = 24, 1.0
_TRIALS = 21
_LIKE_USUAL = 2.0  # in a quarter of a step one eighth of the squared error
_FAR_RAD = 100.0  # beyond any servo's travel; small enough to be squared
_UNSTABLE_STEP = (
    "a servo of this calibration is not stable in physics steps of {:g} ms; take shorter ones."
)
_UNSTABLE = 0.5  # random servos in steps of up to 10 ms are at most 0.4 from the usual


@dataclass(frozen=True)
class Engine:
    """How a simulator integrates a PD servo."""

    slews: bool = True
    """Whether it limits the speed of the set-point."""
    implicit: bool = True
    """Whether damping acts on the velocity at the step's end; otherwise the PD is computed
    before."""
    short_delays: bool = True
    """Whether a delay may be a part of the first step; otherwise it becomes all of it."""


MUJOCO = Engine()
"""The arithmetic of MuJoCo's `<pid>`, with which calibrations are fitted."""
MUJOCO_PID = Engine(short_delays=False)
"""MuJoCo's `<pid>` itself, whose delay line has nothing between 0 and one step."""


def tones_in_steps_of(
    parameters: DelayedPDParameters, time_step_s: float, engine: Engine = MUJOCO
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lag of servos in such steps behind slow tones, without their dead time.

    The lag is the mean over the tones [s], shape (servos,). Beside it stands the motion that is no
    tone: its root mean square relative to the tone's amplitude, of the worst tone. An unstable
    servo oscillates between the limits of its torque.
    """
    count = round(_LENGTH_S / time_step_s)
    edge = time_step_s * np.arange(count + 1)
    turn = 2 * np.pi * np.array(_TONES_HZ)
    # commands in stairs, as control loops give them: on each stair the set-point runs at its limit;
    # a step gets the mean of the command over it
    stair = _LOOP_S * np.arange(round(_LENGTH_S / _LOOP_S) + 2)
    stairs = _AMPLITUDE_RAD * np.sin(stair[:-1, None] * turn)
    area = np.concatenate([np.zeros((1, len(turn))), np.cumsum(stairs * _LOOP_S, axis=0)])
    commands = np.stack([np.diff(np.interp(edge, stair, a)) for a in area.T], axis=1) / time_step_s
    values = {name: np.atleast_1d(v)[:, None] for name, v in parameters.arrays().items()}
    if not engine.slews:
        values["velocity_limit"] = np.full_like(values["velocity_limit"], np.inf)
    batch = (len(values["stiffness"]), len(turn))
    still = (np.zeros(batch), np.zeros(batch), np.zeros(batch))
    on_steps = np.broadcast_to(commands[:, None], (count, *batch))
    moved, _ = integrate(on_steps, still, values, time_step_s, implicit=engine.implicit)
    late = edge[1:] > _WARM_UP_S
    lags, residues = [], []
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable servo may end anywhere
        for n, w in enumerate(turn):
            at, track = w * edge[1:][late], np.clip(moved[late, :, n], -_FAR_RAD, _FAR_RAD)
            design = sine_design(at)
            tone = least_squares(design, track)
            lags.append(np.arctan2(-tone[1], tone[2]) / w)
            residue = np.sqrt(np.mean((track - design @ tone) ** 2, axis=0))
            residues.append(residue / np.hypot(tone[1], tone[2]))
    return np.mean(lags, axis=0), np.max(residues, axis=0)


def at_step(
    parameters: DelayedPDParameters,
    time_step_s: float,
    fitted_step_s: float = CONTINUOUS_S,
    engine: Engine = MUJOCO,
) -> DelayedPDParameters:
    """Numbers with which servos in steps of `time_step_s` move as in those of `fitted_step_s`.

    Back-EMF of d over the inertia slows a servo by exp(-h d) in a time h; a step of MuJoCo slows it
    by 1 / (1 + h d'), one with the torque from before by 1 - h d'. The drive of a step acts over h
    / (1 + h d') or h instead of (1 - exp(-h d)) / d. Back-EMF and all torques of steps follow from
    these. The loop's damping does the same only while its torque is not clipped; no number makes up
    for that in both states, and motions differ least without a change. The dead time is that of
    `delay_at_step`, and never below 0. Numbers are arrays of shape (servos,).
    """
    if time_step_s == fitted_step_s and engine == MUJOCO:
        return parameters
    moved = parameters
    if fitted_step_s > CONTINUOUS_S:
        moved = _continuous(moved, fitted_step_s)
    if time_step_s > CONTINUOUS_S:
        moved = _discrete(moved, time_step_s, engine.implicit)
    fitted, usual = tones_in_steps_of(parameters, fitted_step_s)
    in_steps, residue = tones_in_steps_of(moved, time_step_s, engine)
    if not (residue - usual < _UNSTABLE).all():
        raise InputError(_UNSTABLE_STEP.format(1e3 * time_step_s))
    delay = np.atleast_1d(parameters.dead_time_s) - (in_steps - fitted)
    return replace(moved, dead_time_s=np.maximum(delay, 0.0))


def nearest_in_loop(
    parameters: DelayedPDParameters,
    time_step_s: float,
    fitted_step_s: float = CONTINUOUS_S,
    engine: Engine = MUJOCO,
) -> DelayedPDParameters:
    """Numbers of `at_step` with the dead time of least error where commands come on steps.

    The error is the RMS of positions under tones of 0.7 to 4 Hz and 0.08 to 0.35 rad, as a
    control loop of 50 Hz gives them, if need be in whole steps. The set-point runs at its limit
    from the beginning of the step in which a command arrives, the servo's from the arrival; that
    makes the best dead time another than commands at any time need. An engine that does not limit
    the speed of set-points is another servo; its dead time stays that of the same lag.

    Parameters, returned value and errors as for `at_step`.
    """
    stepped = at_step(parameters, time_step_s, fitted_step_s, replace(engine, short_delays=True))
    usual = np.atleast_1d(stepped.dead_time_s)[:, None]
    short = (usual > 0) & (usual < time_step_s) & (not engine.short_delays)
    same = stepped is parameters
    if not engine.slews or (same and not short.any()):
        return stepped
    stairs = _loop_tones()
    at, fitted = in_loop(parameters, fitted_step_s, stairs)
    delay, reach = usual, time_step_s
    values = {k: np.broadcast_to(v, len(usual))[:, None] for k, v in stepped.arrays().items()}
    for _ in range(2):  # over a step either way, then between neighbours
        trials = np.maximum(delay + reach * np.linspace(-1.0, 1.0, _TRIALS), 0.0)
        if not engine.short_delays:
            whole_steps = time_step_s * np.round(trials / time_step_s)
            trials = np.where(trials < time_step_s, whole_steps, trials)
        candidates = DelayedPDParameters(**values | {"dead_time_s": trials})
        times, moved = in_loop(candidates, time_step_s, stairs, engine)
        expected = np.stack([np.interp(times, at, track) for track in fitted.T], axis=1)
        errors = np.mean((moved - expected[:, :, None]) ** 2, axis=0)
        # where a set-point that runs at its limit makes many dead times alike, the usual one
        errors *= 1.0 + _LIKE_USUAL * ((trials - usual) / time_step_s) ** 2
        delay = np.take_along_axis(trials, np.argmin(errors, axis=1)[:, None], axis=1)
        reach *= 2.0 / (_TRIALS - 1)
    if same:
        delay = np.where(short, delay, usual)
    return replace(stepped, dead_time_s=delay[:, 0])


def _loop_tones() -> NDArray[np.float64]:
    """Commands of a control loop: tones one after the other [rad]."""
    n = np.arange(_LOOP_TONES, dtype=float)
    # the golden ratio and its like spread frequencies, amplitudes and phases evenly
    hz, amplitude, turn = (
        low + (high - low) * (n * ratio % 1.0)
        for low, high, ratio in ((0.7, 4.0, 0.618), (0.08, 0.35, 0.755), (0.0, 2 * np.pi, 0.57))
    )
    time = np.arange(0.0, _LOOP_TONE_S, CONTROL_S)[:, None]
    return (amplitude * (np.sin(2 * np.pi * hz * time + turn) - np.sin(turn))).T.ravel()


def in_loop(
    parameters: DelayedPDParameters,
    time_step_s: float,
    commands: NDArray[np.float64],
    engine: Engine = MUJOCO,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Motion of servos under a control loop of 50 Hz, whose commands come at steps' beginnings.

    Numbers of the servos are arrays that broadcast; commands have the shape (n,) [rad], and the
    engine limits the speed of set-points. Gives times from 0 on, shape (steps + 1,), and positions
    from rest at the first command, shape (steps + 1, *servos).
    """
    values = {name: np.atleast_1d(value) for name, value in parameters.arrays().items()}
    batch = np.broadcast_shapes(*(value.shape for value in values.values()))
    # a step takes the mean of the held command: the loop's own where steps divide its period
    edges = CONTROL_S * np.arange(len(commands) + 1)
    times = time_step_s * np.arange(int(edges[-1] / time_step_s + 1e-9) + 1, dtype=float)
    area = np.append(0.0, np.cumsum(commands) * CONTROL_S)
    means = np.diff(np.interp(times, edges, area)) / time_step_s
    initial = np.full(batch, float(commands[0]))
    line = DelayLine(values["dead_time_s"], time_step_s)
    line.reset(initial)
    arriving = line.shift(
        np.broadcast_to(means.reshape(-1, *[1] * len(batch)), (len(means), *batch))
    )
    still = (initial, np.zeros(batch), initial)
    moved, _ = integrate(arriving, still, values, time_step_s, implicit=engine.implicit)
    return times, np.concatenate([initial[None], moved])


def _discrete(parameters: DelayedPDParameters, h: float, implicit: bool) -> DelayedPDParameters:
    v, sign = parameters.arrays(), 1.0 if implicit else -1.0
    brake = sign * h * v["back_emf"] / v["armature"]
    return _driven(parameters, _mean_exp(brake), sign * np.expm1(brake) / h * v["armature"])


def _continuous(parameters: DelayedPDParameters, h: float) -> DelayedPDParameters:
    v = parameters.arrays()
    brake = np.log1p(h * v["back_emf"] / v["armature"])
    return _driven(parameters, 1.0 / _mean_exp(brake), brake / h * v["armature"])


def _driven(
    parameters: DelayedPDParameters, factor: NDArray[np.float64], back_emf: NDArray[np.float64]
) -> DelayedPDParameters:
    torques = {name: getattr(parameters, name) * factor for name in TORQUES}
    return replace(parameters, **torques | {"back_emf": back_emf})


def _mean_exp(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of exp over [0, x], which is (exp(x) - 1) / x."""
    safe = np.where(np.abs(x) > 1e-9, x, 1.0)
    return np.where(np.abs(x) > 1e-9, np.expm1(safe) / safe, 1.0)


def delay_at_step(parameters: DelayedPDParameters, time_step_s: float) -> NDArray[np.float64]:
    """Dead time [s] with which servos in steps of `time_step_s` lag as in those of `TIME_STEP_S`.

    Shape (servos,). It may be negative, where the step alone is more than the whole lag.
    """
    delay = np.atleast_1d(parameters.dead_time_s)
    if time_step_s == TIME_STEP_S:
        return delay
    change = lag_of_steps(parameters, time_step_s)
    if not np.isfinite(change).all():
        raise InputError(_UNSTABLE_STEP.format(1e3 * time_step_s))
    return delay - change


def lag_of_steps(parameters: DelayedPDParameters, time_step_s: float) -> NDArray[np.float64]:
    """Lag that steps of `time_step_s` have more than those of `TIME_STEP_S` [s], shape (servos,).

    NaN where the motion in those steps is not the tones': the servo is not stable, or hardly moves
    at their frequencies.
    """
    fitted, usual = tones_in_steps_of(parameters, TIME_STEP_S)
    in_steps, residue = tones_in_steps_of(parameters, time_step_s)
    return np.where(residue - usual < _UNSTABLE, in_steps - fitted, np.nan)
