"""Random servos that no model of ours describes, under commands of every kind, in free air.

A servo is a PD with torque limit, back-EMF, Coulomb and Stribeck friction, set-point slew and
deadband, each present or not; a first-order lag; or a second-order one; behind a dead time of 0 to
200 ms. It runs in steps of 0.25 ms on the held command. Benchmarks read it live or through a poll.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import lfilter

from pupper_sysid.sysid.recordings.recording import Trial

STEP_S = 2.5e-4
KINDS = ("prbs", "chirp", "teleoperation", "moves", "steps")
"""Pseudo-random binary, chirp, filtered noise with pauses, minimum-jerk moves, random steps."""

_NONE = 1e9


@njit(cache=True)
def _simulate(target, kind, values, h):
    stiffness, inside, effort, outside, friction, stribeck, slew, dead, time_constant = values
    track = np.empty(len(target))
    position, speed, goal = target[0], 0.0, target[0]
    for i in range(len(target)):
        goal += min(max(target[i] - goal, -slew * h), slew * h)
        if kind == 0:
            error = goal - position
            force = stiffness * (0.0 if abs(error) < dead else error) - inside * speed
            force = min(max(force, -effort), effort) - outside * speed
            held = friction + stribeck * np.exp(-((speed / 0.3) ** 2))
            wanted = speed / h + force
            speed = 0.0 if abs(wanted) <= held else h * (wanted - held * np.sign(wanted))
            position += h * speed
        elif kind == 1:
            position += h * (goal - position) / time_constant
        else:
            speed += h * (stiffness * (goal - position) - inside * speed)
            position += h * speed
        track[i] = position
    return track


@dataclass(frozen=True)
class RandomServo:
    """A servo: its kind, parameters per inertia, and dead time."""

    kind: str
    values: NDArray[np.float64]
    dead_time_s: float

    def motion(self, held_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """Position under a held command, both in steps of `STEP_S`, from rest."""
        late = round(self.dead_time_s / STEP_S)
        seen = np.concatenate([np.full(late, held_rad[0]), held_rad[: len(held_rad) - late]])
        kind = ("pd", "first order", "second order").index(self.kind)
        return _simulate(seen, kind, self.values, STEP_S)


def draw_servo(rng: np.random.Generator) -> RandomServo:
    """Draw a servo."""
    ranges = (rng.uniform(0, 0.03), rng.uniform(0, 0.06), rng.uniform(0, 0.2))
    dead_time = float(rng.choice(ranges))
    kind = str(rng.choice(["pd", "pd", "pd", "first order", "second order"]))
    slew = float(rng.choice([_NONE, rng.uniform(1.5, 12)]))
    values = np.array([0.0, 0.0, _NONE, 0.0, 0.0, 0.0, slew, 0.0, 1.0])
    if kind == "pd":
        stiffness = np.exp(rng.uniform(np.log(150), np.log(20000)))
        damping = 2 * rng.uniform(0.3, 1.5) * np.sqrt(stiffness)
        share = rng.uniform(0, 1)
        effort = np.exp(rng.uniform(np.log(60), np.log(2000)))
        friction = min(effort * rng.uniform(0, 0.25), 0.03 * stiffness) * rng.integers(0, 2)
        values[:6] = (
            stiffness, damping * share, effort, damping * (1 - share), friction,
            friction * rng.uniform(0, 0.5) * rng.integers(0, 2),
        )  # fmt: skip
        values[7] = rng.choice([0.0, 0.0, 0.005])
    elif kind == "first order":
        values[8] = np.exp(rng.uniform(np.log(0.004), np.log(0.25)))
    else:
        natural = np.exp(rng.uniform(np.log(8), np.log(200)))
        values[:2] = natural**2, 2 * rng.uniform(0.35, 2) * natural
    return RandomServo(kind, values, dead_time)


@dataclass(frozen=True)
class Excitation:
    """A kind of command; every call draws another one of it."""

    kind: str
    amplitude: float
    hold_s: float
    period_s: float
    fastest_hz: float
    cutoff_hz: float
    pause_s: float
    slowness: float

    def __call__(self, time: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Command at each time [rad]."""
        if self.kind == "chirp":
            past = np.mod(time, self.period_s)
            rate = (self.fastest_hz - 0.2) / self.period_s
            return self.amplitude * np.sin(2 * np.pi * (0.2 * past + 0.5 * rate * past**2))
        if self.kind in ("prbs", "steps"):
            hold = self.hold_s * (1 if self.kind == "prbs" else 3)
            count = int(time[-1] / hold) + 2
            two, any_level = rng.choice([-1.0, 1.0], count), rng.uniform(-1, 1, count)
            level = two if self.kind == "prbs" else any_level
            return self.amplitude * level[(time / hold).astype(int)]
        if self.kind == "moves":
            return self._moves(time, rng)
        step = 0.01
        even = step * np.arange(int(time[-1] / step) + 2)
        value, keep = rng.standard_normal(len(even) + 1000), np.exp(-0.02 * np.pi * self.cutoff_hz)
        for _ in range(3):
            value = lfilter([1 - keep], [1, -keep], value)
        value = np.asarray(value)[1000:]
        value = self.amplitude * value / np.std(value)
        going = lfilter([0.1], [1, -0.9], np.sin(2 * np.pi * even / self.pause_s) > -0.3)
        value = np.cumsum(np.diff(value, prepend=value[0]) * going)
        return np.interp(time, even, value - lfilter([0.002], [1, -0.998], value))

    def _moves(self, time: NDArray, rng: np.random.Generator) -> NDArray[np.float64]:
        found, now, here = np.zeros_like(time), 0.0, 0.0
        while now < time[-1]:
            lasts, there = (
                rng.uniform(0.25, 1.2) * self.slowness,
                self.amplitude * rng.uniform(-1, 1),
            )
            first, last = np.searchsorted(time, [now, now + lasts])
            x = (time[first:last] - now) / lasts
            found[first:last] = here + (there - here) * x**3 * (10 - 15 * x + 6 * x * x)
            now, here = now + lasts, there
            rests = rng.choice([0.0, rng.uniform(0, 1)])
            first, last = np.searchsorted(time, [now, now + rests])
            found[first:last] = here
            now += rests
        return found


def draw_excitation(kind: str, rng: np.random.Generator) -> Excitation:
    """Draw a command of a kind."""
    return Excitation(
        kind, rng.uniform(0.05, 0.6), rng.uniform(0.08, 0.5), rng.uniform(8, 25), rng.uniform(2, 8),
        rng.uniform(0.4, 2), rng.uniform(3, 9), rng.uniform(0.7, 2),
    )  # fmt: skip


def send_times(
    rate_hz: float, duration_s: float, jitter: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Times at which commands are sent [s], from 0; `jitter` is relative to the loop period."""
    gaps = 1 + jitter * rng.standard_normal(int(1.3 * duration_s * rate_hz))
    sent = np.cumsum(np.maximum(gaps, 0.3)) / rate_hz
    return sent[sent < duration_s - 0.05] - sent[0]


def held(send_s: NDArray, command_rad: NDArray, duration_s: float) -> NDArray[np.float64]:
    """The command as the bus holds it, in steps of `STEP_S` from 0."""
    time = STEP_S * np.arange(int(duration_s / STEP_S))
    return command_rad[np.maximum(np.searchsorted(send_s, time + 1e-9, side="right") - 1, 0)]


def true_lag(held_rad: NDArray, motion_rad: NDArray, longest_s: float = 1.5) -> float:
    """The lag as `sysid.lag.time_shift` defines it, from motion in steps of `STEP_S` [s].

    Over one window of time, so that neither its ends nor the command before it matter.
    """
    every, earliest = 4, 0.05
    step, count = every * STEP_S, len(held_rad) // every
    command, motion = (
        x[: count * every].reshape(-1, every).mean(1) for x in (held_rad, motion_rad)
    )
    command = command - command.mean()
    first, last = int(longest_s / step) + 1, count - int(earliest / step) - 1
    window = np.zeros(count)
    window[first:last] = 1.0
    motion = np.where(window > 0, motion - motion[first:last].mean(), 0.0)
    size = 1 << (2 * count).bit_length()
    shift = np.arange(-int(earliest / step), int(longest_s / step))

    def products(one: NDArray, other: NDArray) -> NDArray:
        spectrum = np.fft.rfft(one, size) * np.conj(np.fft.rfft(other, size))
        return np.fft.irfft(spectrum, size)[shift]

    total, square = products(window, command), products(window, command**2)
    spread = np.sqrt(np.maximum(square - total**2 / (last - first), 1e-12))
    score = products(motion, command) / spread
    k = int(np.clip(np.argmax(score), 1, len(score) - 2))
    left, top, right = score[k - 1 : k + 2]
    return float(step * (shift[k] + 0.5 * (left - right) / (left - 2 * top + right)))


@dataclass(frozen=True)
class Bus:
    """How readings are taken: `poll_s` 0 reads live."""

    rate_hz: float
    jitter: float
    read_after_s: float
    quantum_rad: float
    noise_rad: float
    offset_rad: float
    poll_s: float
    loss: float


def draw_bus(rng: np.random.Generator, rate_hz: float, stale: bool) -> Bus:
    """Draw a bus of that loop rate."""
    poll = np.exp(rng.uniform(np.log(max(0.005, 1.3 / rate_hz)), np.log(0.06)))
    jitter, quantum = rng.choice([0, 0.01, 0.05]), rng.choice([0, 0.0015, 0.0015, 0.0057, 0.012])
    after = rng.choice([rng.uniform(3e-4, 2e-3), rng.uniform(3e-4, 0.5 / rate_hz)])
    noise, offset = rng.choice([0, 0, 0.001, 0.004]), rng.uniform(-0.3, 0.3) * rng.integers(0, 2)
    loss = rng.choice([0.0, rng.uniform(0, 0.5)])
    drawn = (jitter, after, quantum, noise, offset, poll * stale, loss * stale)
    return Bus(rate_hz, *(float(x) for x in drawn))


def recorded(
    bus: Bus, send_s: NDArray, command_rad: NDArray, motion_rad: NDArray,
    rng: np.random.Generator, number: int = 0, frequency_hz: float = np.nan,
) -> Trial:  # fmt: skip
    """The rows of a trial, `motion_rad` in steps of `STEP_S` from 0."""
    read = measured = send_s + bus.read_after_s
    if bus.poll_s:
        polls = np.arange(rng.uniform(0, bus.poll_s), STEP_S * len(motion_rad), bus.poll_s)
        polls = polls + rng.choice([0, 3e-4]) * rng.standard_normal(len(polls))
        measured = polls[rng.random(len(polls)) >= bus.loss]
    value = np.interp(measured, STEP_S * np.arange(len(motion_rad)), motion_rad)
    value += bus.noise_rad * rng.standard_normal(len(value)) + bus.offset_rad
    # fewer than four counts of motion are no recording
    quantum = bus.quantum_rad if np.std(motion_rad) > 4 * bus.quantum_rad else 0.0015
    value = quantum * np.round(value / quantum) if bus.quantum_rad else value
    shown = value[np.maximum(np.searchsorted(measured, read, side="right") - 1, 0)]
    return Trial(
        "LF_hip", number, frequency_hz, send_s, read, command_rad, shown, None,
        float(command_rad[0]),
    )  # fmt: skip
