"""Trials that a plan can choose from, and how a bus would record them.

`candidates` lists tones and square waves within a joint's margin, the speed limit and the loop's
rate, and puts each on the physics clock as the recorder and the guard would send it and a polled
bus would read it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.fit.run import Run, prepare
from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.sweep import excitation

LARGEST_RAD = 0.3  # largest excursion of a plan by default [rad]

Kind = Literal["sine", "square"]

_TONES_HZ = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 12.0)
_TONES_RAD = (0.05, 0.08, 0.12, 0.2, 0.3)
_SQUARES_HZ = (0.7, 1.2, 2.0, 3.0)
_SQUARES_RAD = (0.05, 0.1, 0.2)
_HARDEST_SQUARE_RAD_HZ = 0.25  # amplitude · frequency: gentler on gears than what a gait does
_COMMANDS_A_PERIOD = 4  # below, a tone is held so coarsely that it is another motion
_STEPS_OF_A_READING = 4  # a motion of fewer quantisation steps drowns in them
_POLL_PHASE = 0.3


@dataclass(frozen=True)
class Setup:
    """What a joint is recorded with."""

    loop_period_s: float = excitation.LOOP_PERIOD_S
    """Time between commands."""
    poll_period_s: float = 1 / excitation.POLL_RATE_HZ
    """Time between two polls of the servo; 0 where readings are live."""
    loss: float = 0.42
    """Share of the polls that fail."""
    quantum_rad: float = 0.0057
    """Quantisation step of a reading."""
    speed_limit_rad_s: float = 7.5
    """Of the servo, by its data sheet."""
    margin_rad: float = LARGEST_RAD
    """Largest excursion to either side of the start pose."""

    @property
    def poll_rate_hz(self) -> float:
        """Polls per second, 0 where readings are live."""
        return 1 / self.poll_period_s if self.poll_period_s > 0 else 0.0

    @property
    def seen(self) -> float:
        """Share of the instants of `read_times` that bring a new reading."""
        if self.poll_period_s >= self.loop_period_s:
            return 1 - self.loss
        each = self.loop_period_s / max(self.poll_period_s, 1e-9)
        return 1 - self.loss**each

    def read_times(self, duration_s: float) -> NDArray[np.float64]:
        """When a trial's readings are measured [s]: at the polls, or the loop's reads."""
        period = max(self.poll_period_s, self.loop_period_s)
        return np.arange(_POLL_PHASE * period, duration_s, period)


@dataclass(frozen=True)
class Candidate:
    """A trial to choose."""

    kind: Kind
    frequency_hz: float
    amplitude_rad: float
    duration_s: float
    """Without the lead-in."""
    run: Run
    """Its command, and the times of its readings."""


def candidates(setup: Setup, duration_s: float) -> list[Candidate]:
    """Trials of `duration_s` without the lead-in [s] that a joint may execute."""
    found = []
    for kind, frequency, amplitude in _choices(setup, duration_s):
        made = excitation.plan(
            kind, ["joint"], [frequency], amplitude, duration_s, setup.loop_period_s,
            setup.speed_limit_rad_s, setup.poll_rate_hz,
        )  # fmt: skip
        run = recorded(made.trials[0], setup)
        found.append(Candidate(kind, frequency, amplitude, duration_s, run))
    return found


def recorded(trial: excitation.TrialPlan, setup: Setup) -> Run:
    """A trial on the physics clock, as the recorder and the guard would send it; it reads zeros."""
    sent_s = np.arange(0.0, trial.duration_s, setup.loop_period_s)
    wanted = trial.offset(sent_s)
    farthest = GuardLimits().speed_rad_s * setup.loop_period_s
    command, last = np.empty_like(wanted), 0.0
    for k, goal in enumerate(wanted):
        last += float(np.clip(goal - last, -farthest, farthest))
        command[k] = last
    read_s = setup.read_times(trial.duration_s)
    nothing = np.zeros(len(sent_s))
    as_trial = Trial(
        trial.joints[0], 0, trial.frequency_hz, sent_s, sent_s, command, nothing, None, 0.0
    )
    return prepare(
        as_trial, Readings(np.arange(len(read_s)), read_s, np.zeros(len(read_s)), nothing, 0.0)
    )


def _choices(setup: Setup, duration_s: float) -> Iterator[tuple[Kind, float, float]]:
    """Kind, frequency [Hz] and amplitude [rad]."""
    rates = (1 / setup.loop_period_s, setup.poll_rate_hz)
    highest = min(excitation.HIGHEST_HZ, 1 / (_COMMANDS_A_PERIOD * setup.loop_period_s))
    largest = min(setup.margin_rad, LARGEST_RAD)
    least = _STEPS_OF_A_READING * setup.quantum_rad
    for wanted in _TONES_HZ:
        frequency = excitation.off_harmonics(wanted, rates, duration_s)
        if frequency > highest or frequency * duration_s < 1:
            continue
        fastest = excitation.SPEED_MARGIN * setup.speed_limit_rad_s / (2 * np.pi * frequency)
        most = _rounded_down(min(largest, fastest))
        amplitudes = {a for a in _TONES_RAD if a < 0.9 * most} | {most}
        for amplitude in sorted(a for a in amplitudes if a >= least):
            yield "sine", frequency, amplitude
    for wanted in _SQUARES_HZ:
        frequency = excitation.off_harmonics(wanted, rates, duration_s)
        most = _rounded_down(min(largest, _HARDEST_SQUARE_RAD_HZ / frequency))
        if frequency <= highest and frequency * duration_s >= 1:
            amplitudes = {a for a in _SQUARES_RAD if a < 0.9 * most} | {most}
            for amplitude in sorted(a for a in amplitudes if a >= least):
                yield "square", frequency, amplitude


def _rounded_down(angle_rad: float) -> float:
    return float(np.floor(1e3 * angle_rad + 1e-9) / 1e3)


def trial_seconds(duration_s: float) -> float:
    """Recorded seconds of a trial of `duration_s`: with its lead-in."""
    return excitation.LEAD_IN_S + duration_s
