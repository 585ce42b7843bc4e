"""Lag of recordings without tones, against the truth: live and polled readings.

Random servos (`benchmarks/random_servos.py`) under pseudo-random binary commands, chirps,
teleoperation with pauses, minimum-jerk moves and steps, 15 to 60 s at 30 to 200 Hz; readings live,
or polled every 5 to 60 ms with losses of 0 to 0.5, quantised, noisy, offset. The lag is that of
`sysid.lag.time_shift`, the 90 % interval that of `lag_budget`. Its truth is from the true motion
every millisecond: of the recording itself, and of 400 s of other commands of the same kind (a
servo that is not linear answers them with another lag, as does a linear one whose phase delay
varies with frequency).

    .venv/bin/python benchmarks/lag_without_tones.py --servos 200
    .venv/bin/python benchmarks/lag_without_tones.py --servos 200 --stale
    .venv/bin/python benchmarks/lag_without_tones.py --time
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from dataclasses import dataclass

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from random_servos import (
    KINDS,
    Bus,
    draw_bus,
    draw_excitation,
    draw_servo,
    held,
    recorded,
    send_times,
    true_lag,
)

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.lag.lag_budget import lag_budget
from pupper_sysid.sysid.recordings.recording import Trial

LONG_S = 400.0


@dataclass(frozen=True)
class Case:
    """One recording and what is true of it [s]."""

    kind: str
    bus: Bus
    trial: Trial
    own_s: float
    long_s: float


@dataclass(frozen=True)
class Result:
    """What was found of a case [s]."""

    case: Case
    value: float
    low: float
    high: float
    feedback: str
    seconds: float

    def holds(self, truth: float) -> bool:
        """Whether the interval holds it."""
        return self.low <= truth <= self.high


def draw(seed: int, stale: bool) -> Case:
    """A random servo, recorded; one that hardly moves is drawn again."""
    rng = np.random.default_rng([20261122, 77, seed])
    kind = KINDS[seed % len(KINDS)]
    while True:
        servo, excitation = draw_servo(rng), draw_excitation(kind, rng)
        bus = draw_bus(rng, float(np.exp(rng.uniform(np.log(30), np.log(200)))), stale)
        lasts = rng.uniform(15, 60)
        send = send_times(bus.rate_hz, lasts, bus.jitter, rng)
        command = excitation(send, rng)
        staircase = held(send, command, lasts)
        motion = servo.motion(staircase)
        if np.std(motion) > 0.3 * np.std(staircase):
            break
    trial = recorded(bus, send, command, motion, rng)
    send = send_times(bus.rate_hz, LONG_S, bus.jitter, rng)
    long = held(send, excitation(send, rng), LONG_S)
    return Case(
        kind, bus, trial, true_lag(staircase, motion), true_lag(long, servo.motion(long))
    )  # fmt: skip


def measure(case: Case, seed: int) -> Result | None:
    """The lag budget's interval; None if it was refused."""
    start = time.process_time()
    try:
        found = lag_budget("LF_hip", [case.trial], np.random.default_rng(seed))
    except InputError as refused:
        print(f"- refused: {refused}")
        return None
    lag = found.lag_s
    return Result(
        case, lag.value, lag.low, lag.high, found.feedback.kind, time.process_time() - start
    )


def line(name: str, results: list[Result]) -> str:
    """A row of the table."""
    own = np.mean([r.holds(r.case.own_s) for r in results])
    long = np.mean([r.holds(r.case.long_s) for r in results])
    width = 1e3 * np.array([r.high - r.low for r in results])
    error = 1e3 * np.array([r.value - r.case.own_s for r in results])
    return (
        f"| {name} | {len(results)} | {100 * own:.0f} % | {100 * long:.0f} % "
        f"| {np.median(width):.1f} | {width.min():.2f} | {np.median(np.abs(error)):.2f} "
        f"| {np.quantile(np.abs(error), 0.95):.1f} |"
    )


def table(results: list[Result]) -> str:
    """All rows, by kind of command, by rate, by what was found of the feedback."""
    groups: dict[str, list[Result]] = {kind: [] for kind in KINDS}
    rates = {"30–50 Hz": (0, 50), "50–100 Hz": (50, 100), "100–200 Hz": (100, 201)}
    for result in results:
        groups[result.case.kind].append(result)
    for name, (low, high) in rates.items():
        groups[name] = [r for r in results if low <= r.case.bus.rate_hz < high]
    for feedback in sorted({r.feedback for r in results}):
        groups[f"feedback: {feedback}"] = [r for r in results if r.feedback == feedback]
    lines = [
        "| recordings | count | this motion's lag held | lag of 400 s held | median width, ms "
        "| smallest | median error, ms | 95 % |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [line(name, own) for name, own in groups.items() if own]
    seconds = np.median([r.seconds for r in results])
    return "\n".join(
        [*lines, line("all", results), f"\nProcessor time {seconds:.2f} s (median) each."]
    )


def five_joints() -> None:
    """Time and memory of five joints of 6,000 rows."""
    cases = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        bus = draw_bus(rng, 50.0, False)
        send = send_times(50.0, 120.05, 0.01, rng)
        command = draw_excitation(KINDS[seed], rng)(send, rng)
        motion = draw_servo(rng).motion(held(send, command, 120.05))
        cases.append(recorded(bus, send, command, motion, rng))
    start = time.process_time()
    for trial in cases:
        lag_budget("LF_hip", [trial], np.random.default_rng(0))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"Five joints of {len(cases[0].send_time_s)} rows: {time.process_time() - start:.1f} s of "
        f"processor time, {peak:.0f} MB in all."
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Lag of recordings without tones")
    parser.add_argument("--servos", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--stale", action="store_true", help="polled readings instead of live ones")
    parser.add_argument("--time", action="store_true", help="time and memory only")
    parser.add_argument("--list", action="store_true", help="every recording")
    given = parser.parse_args()
    if given.time:
        five_joints()
        raise SystemExit
    found = []
    for seed in range(given.first, given.first + given.servos):
        case = draw(seed, given.stale)
        result = measure(case, seed)
        if result is None:
            continue
        found.append(result)
        if given.list:
            print(
                f"{seed} {case.kind} {case.bus.rate_hz:.0f} Hz {result.feedback}: own "
                f"{1e3 * case.own_s:.1f}, long {1e3 * case.long_s:.1f}, found "
                f"{1e3 * result.value:.1f} [{1e3 * result.low:.1f}, {1e3 * result.high:.1f}]"
                f"{'' if result.holds(case.own_s) else ' own missed'}"
                f"{'' if result.holds(case.long_s) else ' long missed'} {result.seconds:.1f} s",
                flush=True,
            )
    print(table(found))
    print(f"{given.servos - len(found)} of {given.servos} refused.")
