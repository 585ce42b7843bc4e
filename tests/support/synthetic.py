"""Synthetic trials with a known truth: a servo's motion, seen through a polled bus."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.recordings.recording import Trial

LOOP_S = 0.019


def held_trial(
    motion: Callable[[NDArray], NDArray],
    command: Callable[[NDArray], NDArray],
    rng: np.random.Generator,
    *,
    frequency_hz: float = float("nan"),
    number: int = 0,
    start_s: float = 0.0,
    duration_s: float = 4.0,
    period_s: float = 0.02685,
    loss: float = 0.42,
    quantum_rad: float = 0.0057,
    noise_rad: float = 0.0,
    joint: str = "LF_hip",
) -> Trial:
    """A trial whose readings are `motion` at the last successful poll; `period_s` 0: at the read.

    `motion` and `command` map time since the trial's start to an angle.
    """
    send = np.arange(0.0, duration_s, LOOP_S)
    read = send + 0.0005
    if period_s > 0:
        polls = np.arange(-1.0, duration_s, period_s) + rng.uniform(0, period_s)
        good = polls[(rng.random(len(polls)) >= loss) | (polls < -0.5)]
        measured = good[np.searchsorted(good, read, side="right") - 1]
        noise = noise_rad * rng.standard_normal(len(good))
        jitter = noise[np.searchsorted(good, read, side="right") - 1]
    else:
        measured, jitter = read, noise_rad * rng.standard_normal(len(read))
    position = motion(np.maximum(measured, 0.0)) + jitter
    if quantum_rad:
        position = np.round(position / quantum_rad) * quantum_rad
    return Trial(
        joint, number, frequency_hz, send + start_s, read + start_s, command(send), position,
        None, float(command(np.zeros(1))[0]),
    )  # fmt: skip


def tone_trials(
    lag_s: float,
    rng: np.random.Generator,
    frequencies: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0),
    amplitude: float = 0.3,
    gain: float = 1.0,
    **options,
) -> list[Trial]:
    """Tones answered `lag_s` after the held command, scaled by `gain`."""
    trials = []
    for n, f in enumerate(frequencies):
        # the held command lags its tone by half a loop, and shrinks by sinc
        late = lag_s + LOOP_S / 2
        shrink = gain * np.sinc(f * LOOP_S)
        trials.append(
            held_trial(
                lambda t, f=f, a=amplitude * shrink, d=late: a * np.sin(2 * np.pi * f * (t - d)),
                lambda t, f=f: amplitude * np.sin(2 * np.pi * f * t),
                rng,
                frequency_hz=f,
                number=n,
                start_s=6.0 * n,
                **options,
            )
        )
    return trials


def first_order_trial(
    command: Callable[[NDArray], NDArray],
    dead_time_s: float,
    time_constant_s: float,
    *,
    loop_s: float = 1 / 30,
    duration_s: float = 20.0,
    frequency_hz: float = float("nan"),
    number: int = 0,
    gain: float = 1.0,
) -> Trial:
    """A live trial of a first-order servo, solved exactly on the held command.

    Each step of the command adds `gain (1 - exp(-(t - dead time) / time constant))` of itself.
    """
    send = np.arange(0.0, duration_s, loop_s)
    read, sent = send + 0.0005, command(send)
    past = read[:, None] - send - dead_time_s
    step = np.where(past > 0, -np.expm1(-np.maximum(past, 0.0) / time_constant_s), 0.0)
    position = sent[0] + gain * step @ np.diff(sent, prepend=sent[0])
    return Trial(
        "LF_hip", number, frequency_hz, send, read, sent, position, None, float(sent[0]), "live"
    )  # fmt: skip


def random_levels(rng: np.random.Generator, hold_s: float, amplitude: float = 0.3):
    """A command that jumps to plus or minus `amplitude` every `hold_s`."""
    level = rng.choice([-amplitude, amplitude], 1000)
    return lambda t: level[(t / hold_s).astype(int)]
