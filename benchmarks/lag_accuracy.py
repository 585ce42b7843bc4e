"""How accurate is the measured lag? Random emulated robots, every estimator, one table.

Each robot is drawn with its own servos, read losses from 0 to 0.6, count size, poll period and
jitters; one joint is swept from 1 to 10 Hz through the recorder, as by `sweep`. The
truth is the lag of the joint's real motion, without noise and every millisecond, against the held
command, averaged over the tones with the estimator's own weights. (Sampling the motion once per
loop would not do: it ripples with the steps of the command, and once per loop sees one phase of
the ripple only.)

    .venv/bin/python benchmarks/lag_accuracy.py --robots 240

The Cramér-Rao bound is that of a tone of unknown amplitude, phase and offset in white noise,
var(lag) >= 2 s² / (N A² ω²), where s is the scatter of the N fresh readings about the tone;
information adds over tones. It takes the times of the readings as known. They are not: the poll's
phase has to be found too, and its uncertainty (stated by the estimator) comes on top.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from random_robots import sweep_random_robot

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice, readings
from pupper_sysid.sysid.lag.lag_budget import lag_budget
from pupper_sysid.sysid.lag.tone import tone_lags, tone_response, tone_weights


@dataclass(frozen=True)
class Result:
    """One robot: truth, estimates, bound [s]."""

    loss: float
    truth: float
    bound: float
    bound_with_phase: float
    low: float
    high: float
    estimates: dict[str, float]
    period_error: float
    kind: str


def measure(seed: int) -> Result | None:
    """Build, sweep and measure one robot; None if its servo is refused, because it is stuck."""
    rng = np.random.default_rng([20261121, seed])
    # reading noise up to what the recordings of a real robot scatter by, 11 to 14 mrad
    noise = float(rng.uniform(0.001, 0.014))
    loss = float(rng.uniform(0.0, 0.6))
    robot = sweep_random_robot(rng, "1-10", loss=loss, reading_noise_rad=noise)
    trials = robot.recording.trials(robot.joint)
    lattice = find_poll_lattice(trials, np.random.default_rng(0))
    try:
        budget = lag_budget(robot.joint, trials, np.random.default_rng(seed), lattice)
    except InputError:
        return None

    tones, clean = [], []
    for trial in trials:
        tone = tone_response(trial, readings(trial, lattice), np.random.default_rng(0), draws=2)
        if tone is None:
            continue
        tones.append(tone)
        clean.append(
            tone_response(trial, robot.bus.motion(trial), np.random.default_rng(0), draws=2)
        )
    frequency = np.array([t.frequency_hz for t in tones])
    lags = tone_lags(np.array([t.response for t in clean]), frequency)
    speed = np.array([abs(t.command_held) for t in tones]) * 2 * np.pi * frequency
    fresh = np.array([t.fresh_count for t in tones])
    scatter = np.array([t.residual_rad for t in tones])
    used = tone_weights(tones) > 0
    information = float(np.sum((fresh * speed**2 / (2 * scatter**2))[used]))
    truth = float(np.average(lags, weights=tone_weights(tones)))
    estimates = {k: v for k, v in budget.estimators_s.items() if "hold-aware" not in k}
    for name in estimates:  # the others measure from rows: give them the command hold
        estimates[name] -= budget.command_hold_s
    return Result(
        robot.spec.loss, truth, information**-0.5,
        sum(1 / t.lag_variance_s2 for t in np.array(tones)[used]) ** -0.5,
        budget.lag_s.low, budget.lag_s.high,
        estimates | {"hold-aware (default)": budget.lag_s.value},
        abs(lattice.poll_period_s - robot.spec.poll_period_s), lattice.kind,
    )  # fmt: skip


def table(results: list[Result]) -> str:
    """The printed table, as Markdown."""
    truth = np.array([r.truth for r in results])
    bound = np.array([r.bound for r in results])
    lines = [
        "| estimator | bias ms | spread ms | worst ms | whole-period errors | spread / bound "
        "| middle half's spread / bound |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in results[0].estimates:
        error = np.array([r.estimates[name] for r in results]) - truth
        whole = int(np.sum(np.abs(error) > 0.05))
        ratio = np.sqrt(np.mean((error - error.mean()) ** 2) / np.mean(bound**2))
        lines.append(
            f"| {name} | {1e3 * error.mean():+.2f} | {1e3 * error.std():.2f} "
            f"| {1e3 * np.abs(error).max():.2f} | {whole} | {ratio:.2f} "
            f"| {np.median(np.abs(error - np.median(error)) / bound) / 0.6745:.2f} |"
        )
    phase = np.array([r.bound_with_phase for r in results])
    ours = np.array([r.estimates["hold-aware (default)"] for r in results]) - truth
    inside = np.array([r.low <= r.truth <= r.high for r in results])
    width = np.array([r.high - r.low for r in results]) / 2
    found = np.array([r.kind == "lattice" for r in results])
    period = np.array([r.period_error for r in results])[found]
    lines += [
        "",
        f"{len(results)} robots, losses {min(r.loss for r in results):.2f} to "
        f"{max(r.loss for r in results):.2f}. 90 % interval covers the truth in "
        f"{100 * inside.mean():.1f} %; half width {1e3 * width.mean():.2f} ms on average; "
        f"Cramér-Rao bound {1e3 * np.sqrt(np.mean(bound**2)):.2f} ms; with the poll's "
        f"unknown phase {1e3 * np.sqrt(np.mean(phase**2)):.2f} ms, of which the spread is "
        f"{np.sqrt(np.mean((ours - ours.mean()) ** 2) / np.mean(phase**2)):.2f} times "
        f"(middle half: {np.median(np.abs(ours - np.median(ours)) / phase) / 0.6745:.2f} times).",
        f"Poll lattice found for {100 * found.mean():.1f} %, "
        f"{100 * np.mean(period < 1e-4):.1f} % of them within 0.1 ms of the period.",
    ]
    for low, high in ((0.0, 0.2), (0.2, 0.4), (0.4, 0.61)):
        chosen = np.array([low <= r.loss < high for r in results])
        if not chosen.any():
            continue
        error = np.array([r.estimates["hold-aware (default)"] - r.truth for r in results])[chosen]
        lines.append(
            f"Loss {low:.1f}–{high:.1f}: {chosen.sum()} robots, bias {1e3 * error.mean():+.2f} ms, "
            f"coverage {100 * inside[chosen].mean():.0f} %."
        )
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", type=int, default=240)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.workers) as pool:
        results = list(pool.map(measure, range(options.robots), chunksize=4))
    print(table([r for r in results if r]))
    print(f"Refused, because the servo has more friction than torque: {results.count(None)}.")
