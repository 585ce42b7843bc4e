"""Slips of the poll's phase within a trial: false alarms, detection, dates and fits.

Synthetic joints of random servos (dead time, stiffness, damping, dry friction with Stribeck's
effect, play, torque and speed limits) under four tones of 1 to 10 Hz, behind a bus of random poll
period (10–60 ms), jitter, drift and loss (0–0.6); in half of the trials its phase jumps once or
twice, by any amount. The fitted model has neither play nor Stribeck's effect. Slips are looked for
from the times of changes alone (`find_poll_lattice`) and with the motion of the first fit
(`redate`). Then the real sweeps in `$PUPPER_REAL_DATA`, fitted by the same model.

    .venv/bin/python benchmarks/lattice_slips.py --joints 100 --first 3000
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pupper_sysid.sysid.feedback import slips
from pupper_sysid.sysid.feedback.poll_lattice import (
    PollLattice,
    find_poll_lattice,
    readings,
    redate,
)
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Trial

STEP_S = 0.001
REAL = Path(
    os.environ.get("PUPPER_REAL_DATA") or Path(__file__).resolve().parents[2] / "shared" / "real"
)


@dataclass(frozen=True)
class Joint:
    """Trials of one synthetic joint and what is true of them."""

    trials: list[Trial]
    polls: list[NDArray[np.float64]]
    """Instants of the successful polls, per trial [s]."""
    slips: list[list[tuple[float, float]]]
    """Time from the trial's first row and jump, per trial [s]."""
    period_s: float
    loss: float
    servo: NDArray[np.float64]


@njit(cache=True)
def simulate(command, servo, step):
    """Position of a servo at every step [rad], from rest at 0.

    `servo`: dead time [s], natural frequency [rad/s], damping ratio, friction [rad/s²], effort
    limit [rad/s²], speed limit of the set-point [rad/s], share of friction that fades with speed,
    play [rad].
    """
    dead, natural, ratio, friction, effort, limit, fading, play = servo
    position, speed, goal = np.zeros(len(command)), 0.0, 0.0
    here, shown = 0.0, 0.0
    late = dead / step
    for n in range(len(command)):
        at = n - late
        low = int(np.floor(at))
        sent = 0.0
        if low >= 0:
            sent = command[low]
            if low + 1 < len(command):
                sent += (at - low) * (command[low + 1] - command[low])
        goal += min(max(sent - goal, -limit * step), limit * step)
        torque = natural * natural * (goal - here) - 2 * ratio * natural * speed
        torque = min(max(torque, -effort), effort)
        dry = friction * (1 - fading * (1 - np.exp(-((speed / 0.5) ** 2))))
        free = speed + step * torque
        if abs(free) <= step * dry:
            speed = 0.0
        else:
            speed = free - np.sign(free) * step * dry
        here += step * speed
        shown = min(max(shown, here - play), here + play)
        position[n] = shown
    return position


def joint(seed: int, most_slips: int = 2, share: float = 0.5) -> Joint:
    """A random joint behind a random bus; a `share` of the trials have slips."""
    rng = np.random.default_rng([20261123, seed])
    loop = float(np.exp(rng.uniform(np.log(0.005), np.log(0.025))))
    period = float(np.clip(loop * rng.uniform(1.2, 3.0), 0.010, 0.060))
    loss, jitter = rng.uniform(0, 0.6), rng.uniform(0, 0.0015)
    drift = rng.uniform(0, 0.004)
    quantum = float(rng.choice([0.0, 0.0015, 0.0057]))
    noise = rng.uniform(0, 0.004)
    servo = np.array([
        rng.uniform(0.005, 0.04), np.exp(rng.uniform(np.log(50), np.log(150))),
        rng.uniform(0.3, 1.0), np.exp(rng.uniform(np.log(20), np.log(300))),
        np.exp(rng.uniform(np.log(300), np.log(2000))), rng.uniform(5, 15),
        rng.choice([0.0, rng.uniform(0, 0.6)]), rng.choice([0.0, rng.uniform(0, 0.008)]),
    ])  # fmt: skip
    trials, polls, jumps = [], [], []
    start = 0.0
    for n, frequency in enumerate(np.sort(rng.choice(np.arange(1.0, 11.0), 4, replace=False))):
        seconds = rng.uniform(2.5, 4.0)
        amplitude = min(0.3, rng.uniform(4, 10) / (2 * np.pi * frequency))
        send = np.arange(0, seconds, loop) + rng.uniform(
            0, 0.0003, len(np.arange(0, seconds, loop))
        )
        command = amplitude * np.sin(2 * np.pi * frequency * send)
        steps = np.arange(0, seconds + 0.1, STEP_S)
        held = command[np.maximum(np.searchsorted(send, steps, "right") - 1, 0)]
        motion = simulate(held, servo, STEP_S)
        count = int(rng.integers(1, most_slips + 1)) if rng.random() < share else 0
        own = sorted((float(rng.uniform(0.3, seconds - 0.3)), float(rng.uniform(0.1, 0.9) * period))
                     for _ in range(count))  # fmt: skip
        instants = poll_instants(period, drift, seconds, own, rng)
        instants = np.sort(instants + jitter * rng.standard_normal(len(instants)))
        good = instants[(rng.random(len(instants)) >= loss) | (instants < -0.3)]
        value = np.interp(good, steps, motion) + noise * rng.standard_normal(len(good))
        value = quantum * np.round(value / quantum) if quantum else value
        read = send + 0.0005
        shown = value[np.searchsorted(good, read, "right") - 1]
        trials.append(
            Trial("LF_hip", n, frequency, send + start, read + start, command, shown, None, 0.0,
                  "polled")
        )  # fmt: skip
        polls.append(good + start)
        jumps.append(own)
        start += seconds + 0.5
    return Joint(trials, polls, jumps, period, loss, servo)


def poll_instants(
    period: float, drift: float, seconds: float, slips: list, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Instants from a second before the trial on, the period wandering over seconds."""
    memory = np.exp(-period / 5.0)
    wander, at, found = drift * rng.standard_normal(), -1.0 - rng.uniform(0, period), []
    left = list(slips)
    while at < seconds + 0.1:
        found.append(at)
        at += period * (1 + wander)
        if left and at > left[0][0]:
            at += left.pop(0)[1]
        wander = memory * wander + drift * np.sqrt(1 - memory**2) * rng.standard_normal()
    return np.array(found)


def fit(
    trials: Sequence[Trial], lattice: PollLattice, start: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float, list[Callable]]:
    """A model without play and Stribeck's effect: its values, RMS error, and motion per trial."""
    read = [readings(t, lattice) for t in trials]
    held = []
    for t in trials:
        steps = t.send_time_s[0] + np.arange(0, t.read_time_s[-1] - t.send_time_s[0] + 0.1, STEP_S)
        row = np.maximum(np.searchsorted(t.send_time_s, steps, "right") - 1, 0)
        held.append((steps, t.command_rad[row] - t.initial_command_rad))

    def runs(z: NDArray) -> list[Callable]:
        servo = np.append(np.exp(z[:6]), (0.0, 0.0))
        made = []
        for t, (steps, command) in zip(trials, held, strict=True):
            track = simulate(command, servo, STEP_S) + t.initial_command_rad + z[6]
            made.append(lambda at, s=steps, p=track: np.interp(at, s, p))
        return made

    def residual(z: NDArray) -> NDArray[np.float64]:
        return np.concatenate(
            [m(r.time_s) - r.position_rad for m, r in zip(runs(z), read, strict=True)]
        )

    low = np.log([0.001, 20, 0.1, 1, 50, 2])
    high = np.log([0.08, 400, 3, 1500, 20000, 60])
    best = None
    # the dead time is found on a grid: it is the coordinate with local optima
    for dead in (0.5, 1.0, 1.6):
        z = np.append(np.log(start[:6] * np.array([dead, 1, 1, 1, 1, 1])), 0.0)
        z[:6] = np.clip(z[:6], low + 1e-6, high - 1e-6)
        z[6] = float(np.median(-residual(z)))
        found = least_squares(
            residual, z, loss="soft_l1", f_scale=0.012, diff_step=0.01, max_nfev=25,
            bounds=(np.append(low, -2), np.append(high, 2)),
        )  # fmt: skip
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    return (
        np.append(np.exp(best.x[:6]), best.x[6]),
        float(np.sqrt(np.mean(residual(best.x) ** 2))),
        runs(best.x),
    )


def unsplit(trials: Sequence[Trial], seed: int) -> PollLattice:
    """The lattice with one phase per trial, as if nothing ever slipped."""
    threshold, slips.NATS = slips.NATS, np.inf
    try:
        return find_poll_lattice(trials, np.random.default_rng(seed))
    finally:
        slips.NATS = threshold


def date_error(made: Joint, lattice: PollLattice) -> list[NDArray[np.float64]]:
    """Date minus true instant of every fresh row, per trial [s]."""
    found = []
    for trial, polls in zip(made.trials, made.polls, strict=True):
        reading = readings(trial, lattice)
        true = polls[np.searchsorted(polls, trial.read_time_s[reading.rows], "right") - 1]
        found.append(reading.time_s - true)
    return found


def matched(
    made: Joint, lattice: PollLattice
) -> tuple[list[tuple[float, float | None, bool]], int, int]:
    """Of each true slip its size, how far off it was placed and whether it was named.

    The size is that of the jump within half a period, in periods; the place is None if the dates do
    not follow it. Also the trials without a slip: those with one named, and all.
    """
    hits, extra, clean = [], 0, 0
    for trial, own in zip(made.trials, made.slips, strict=True):
        named = [s.time_s for s in lattice.slips if s.trial == trial.number]
        starts = sorted(p.start_s for p in lattice.phases if p.trial == trial.number)
        found = [s - trial.read_time_s[0] for s in starts[1:]]
        for at, jump in own:
            size = abs((jump / made.period_s + 0.5) % 1.0 - 0.5)
            near = [f for f in found if abs(f - at) < 0.35]
            best = min(near, key=lambda f: abs(f - at)) if near else None
            called = best is not None and any(abs(n - best) < 0.01 for n in named)
            if best is not None:
                found.remove(best)
            hits.append((size, None if best is None else abs(best - at), called))
        clean += not own
        extra += bool(named) and not own
    return hits, extra, clean


def rms(parts: Sequence[NDArray]) -> float:
    """Root mean square over all parts."""
    every = np.concatenate([np.zeros(0), *parts])
    return float(np.sqrt(np.mean(every**2))) if len(every) else float("nan")


def real_sweeps() -> None:
    """Slips of the real sweeps."""
    print("\n| real sweep | tone Hz | at s | jump ms | nats |\n|---|---|---|---|---|")
    for path in [*sorted(REAL.glob("real_motor*.csv")), *REAL.glob("mini_pupper_full_band/*.csv")]:
        recording = load(path)
        for name in recording.joints:
            trials = recording.trials(name)
            alone, single = find_poll_lattice(trials, np.random.default_rng(0)), unsplit(trials, 0)
            start = np.array([0.025, 110, 0.5, 200, 430, 7.5])
            servo, error, motions = fit(trials, single, start)
            found = redate(trials, single, motions)
            after, better, motions = fit(trials, found, servo[:6])
            print(f"| {path.stem} | {len(alone.slips)} from times alone; {1e3 * error:.1f} to "
                  f"{1e3 * better:.1f} mrad; dead time {1e3 * servo[0]:.1f} to "
                  f"{1e3 * after[0]:.1f} ms | | | |")  # fmt: skip
            for s in found.slips:
                tone = next(t.frequency_hz for t in trials if t.number == s.trial)
                print(f"| | {tone:g} | {s.time_s:.2f} | {1e3 * s.jump_s:+.1f} | {s.nats:.0f} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Slips of the poll's phase.")
    parser.add_argument("--joints", type=int, default=150)
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    given = parser.parse_args()
    hits: dict[str, list] = {"times": [], "motion": []}
    extra, clean = {"times": 0, "motion": 0}, 0
    dates: dict[str, list] = {k: [] for k in ("slip before", "slip after", "none before",
                                              "none after")}  # fmt: skip
    errors, dead, unresolved, seconds, count = [], [], 0, 0.0, 0
    for seed in range(given.first, given.first + given.joints):
        made = joint(seed)
        found = find_poll_lattice(made.trials, np.random.default_rng(seed))
        if found.kind != "lattice":
            unresolved += 1
            continue
        count += 1
        rng = np.random.default_rng([seed, 1])
        guess = made.servo * np.exp(0.3 * rng.standard_normal(8))
        single = unsplit(made.trials, seed)
        servo, error, motions = fit(made.trials, single, guess)
        before = time.process_time()
        again = redate(made.trials, single, motions)
        seconds += time.process_time() - before
        after, better, _ = fit(made.trials, again, servo[:6])
        for name, lattice in (("times", found), ("motion", again)):
            own, more, free = matched(made, lattice)
            hits[name] += own
            extra[name] += more
        clean += free
        for name, lattice in (("before", single), ("after", again)):
            for own, part in zip(made.slips, date_error(made, lattice), strict=True):
                dates[f"{'slip' if own else 'none'} {name}"].append(part)
        if any(made.slips):
            errors.append((error, better))
            dead.append((servo[0] - made.servo[0], after[0] - made.servo[0]))
    print("| | times of changes alone | with the motion of a first fit |\n|---|---|---|")
    print(f"| slips named, of {clean} trials without a slip | "
          + " | ".join(f"{extra[k]} ({100 * extra[k] / max(clean, 1):.1f} %)" for k in hits)
          + " |")  # fmt: skip
    for low, high in ((0.1, 0.2), (0.2, 0.3), (0.3, 0.4), (0.4, 0.51)):
        cells = []
        for k in hits:
            own = [(at, called) for size, at, called in hits[k] if low <= size < high]
            seen = [at for at, _ in own if at is not None]
            place = f"; placed within {1e3 * np.quantile(seen, 0.9):.0f} ms" if seen else ""
            place = f", {sum(called for _, called in own)} named{place}"
            cells.append(f"{len(seen)} of {len(own)} ({100 * len(seen) / max(len(own), 1):.0f} %"
                         f"{place})")  # fmt: skip
        print(
            f"| followed, jumps of {low:.1f}–{min(high, 0.5):.1f} periods | "
            + " | ".join(cells)
            + " |"
        )
    print("\n| dates and fits | one phase per trial | slips found |\n|---|---|---|")
    for name, text in (("slip", "trials with slips"), ("none", "without")):
        print(f"| dates, RMS error in {text}, ms | {1e3 * rms(dates[f'{name} before']):.2f} | "
              f"{1e3 * rms(dates[f'{name} after']):.2f} |")  # fmt: skip
    both = np.array(errors)
    print("| fit of joints with slips, mrad RMS of fresh readings (median) | "
          + " | ".join(f"{1e3 * e:.1f}" for e in np.median(both, axis=0)) + " |")  # fmt: skip
    both = np.array(dead)
    cells = [f"{1e3 * e:.2f}" for e in np.median(np.abs(both), axis=0)]
    print("| its dead time, error, ms (median) | " + " | ".join(cells) + " |")
    print(f"\n{count} joints of four tones; no lattice in {unresolved} more. "
          f"{1e3 * seconds / max(4 * count, 1):.0f} ms of processor time per trial.")  # fmt: skip
    real_sweeps()
