"""Lag of tones read live at one phase of the loop, against the truth.

Random servos (`benchmarks/random_servos.py`) swept by four tones of 4 s from rest, their readings
live: 30, 50, 100 and 200 Hz in turn. What a servo's ripple between two commands adds to a tone
that is read once per loop is in the lag "with ripple"; `lag_budget` takes it out. The truth is the
phase of the true motion every millisecond, with the same weights of the tones.

    .venv/bin/python benchmarks/live_tones.py --servos 120
"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from random_servos import STEP_S, draw_bus, draw_servo, held, recorded, send_times

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.feedback.poll_lattice import Readings, find_poll_lattice, readings
from pupper_sysid.sysid.lag.lag_budget import lag_budget
from pupper_sysid.sysid.lag.phase_slope import slope, tone_lags, tone_weights
from pupper_sysid.sysid.lag.tone import tone_response
from pupper_sysid.sysid.recordings.recording import Trial

RATES_HZ = (30.0, 50.0, 100.0, 200.0)
SETS_HZ = ((1.0, 2.0, 3.0, 4.0), (1.0, 2.0, 4.0, 6.0), (1.0, 3.0, 5.0, 8.0))
TRIAL_S = 4.0
EVERY = 4


@dataclass(frozen=True)
class Result:
    """Lags of one servo [s]; tones as (found, truth)."""

    rate_hz: float
    truth: float
    with_ripple: Interval
    found: Interval
    tones: list[tuple[Interval, float]]
    feedback: str


def sweep(seed: int) -> tuple[float, list[Trial], list[Readings]]:
    """Loop rate, trials and true motion of one servo."""
    rng = np.random.default_rng([20261122, 78, seed])
    rate = RATES_HZ[seed % len(RATES_HZ)]
    while True:
        servo, bus = draw_servo(rng), draw_bus(rng, rate, False)
        amplitude, frequencies = rng.uniform(0.05, 0.35), SETS_HZ[int(rng.integers(len(SETS_HZ)))]
        trials, motions = [], []
        for number, frequency in enumerate(frequencies):
            send = send_times(rate, TRIAL_S, bus.jitter, rng)
            command = amplitude * np.sin(2 * np.pi * frequency * send)
            motion = servo.motion(held(send, command, TRIAL_S))
            trial = recorded(bus, send, command, motion, rng, number, frequency)
            time = np.asarray(STEP_S * np.arange(len(motion))[::EVERY], np.float64)
            rows = np.arange(len(time))
            trials.append(trial)
            motions.append(Readings(rows, time, motion[::EVERY], time, 0.0))
        if np.std(motions[0].position_rad) > 0.3 * amplitude:
            return rate, trials, motions


def measure(seed: int) -> Result | None:
    """Sweep and measure one servo; None if it is refused."""
    rate, trials, motions = sweep(seed)
    lattice = find_poll_lattice(trials, np.random.default_rng(0))
    try:
        budget = lag_budget("LF_hip", trials, np.random.default_rng(seed), lattice)
    except InputError:
        return None
    tones, clean = [], []
    for trial, motion in zip(trials, motions, strict=True):
        tone = tone_response(trial, readings(trial, lattice), np.random.default_rng(seed))
        exact = tone_response(trial, motion, np.random.default_rng(0), draws=2)
        if tone is not None and exact is not None:
            tones.append(tone)
            clean.append(exact)
    frequency = np.array([t.frequency_hz for t in clean])
    near = budget.lag_s.value
    lags = tone_lags(np.array([t.response for t in clean]), frequency, near)
    doubt = lattice.time_doubt_s
    by_tone = [(f.lag_s, float(t)) for f, t in zip(budget.by_frequency, lags, strict=True)]
    return Result(
        rate, float(tone_weights(tones) @ lags), slope(tones, "fresh_held", near).widened(doubt),
        budget.lag_s, by_tone, lattice.kind,
    )  # fmt: skip


def row(name: str, found: list[tuple[Interval, float]]) -> str:
    """Counts of intervals that hold the truth, their widths and errors."""
    held_ = np.mean([i.low <= t <= i.high for i, t in found])
    width = 1e3 * np.median([i.high - i.low for i, _ in found])
    error = 1e3 * np.abs([i.value - t for i, t in found])
    return (
        f"| {name} | {len(found)} | {100 * held_:.0f} % | {width:.2f} | {np.median(error):.2f} "
        f"| {np.quantile(error, 0.95):.2f} |"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Lag of live tones")
    parser.add_argument("--servos", type=int, default=120)
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--list", action="store_true", help="every servo")
    given = parser.parse_args()
    found = []
    for seed in range(given.first, given.first + given.servos):
        result = measure(seed)
        if result is None:
            continue
        found.append(result)
        if given.list:
            a, b = result.with_ripple, result.found
            inside = b.low <= result.truth <= b.high
            print(
                f"{seed} {result.rate_hz:.0f} Hz {result.feedback}: true {1e3 * result.truth:.2f}, "
                f"with ripple {1e3 * a.value:.2f} [{1e3 * a.low:.2f}, {1e3 * a.high:.2f}], found "
                f"{1e3 * b.value:.2f} [{1e3 * b.low:.2f}, {1e3 * b.high:.2f}]"
                f"{'' if inside else ' missed'}",
                flush=True,
            )
    print("| lag | count | interval held the truth | median width, ms | median error, ms | 95 % |")
    print("|---|---|---|---|---|---|")
    for rate in (*RATES_HZ, 0.0):
        own = [r for r in found if rate in (0.0, r.rate_hz)]
        name = f"{rate:.0f} Hz" if rate else "all"
        print(row(f"{name}, with ripple", [(r.with_ripple, r.truth) for r in own]))
        print(row(f"{name}", [(r.found, r.truth) for r in own]))
        print(row(f"{name}, each tone", [pair for r in own for pair in r.tones]))
    print(f"\n{given.servos - len(found)} of {given.servos} refused.")
