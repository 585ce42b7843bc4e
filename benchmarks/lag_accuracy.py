"""How accurate is the measured lag? Random emulated robots, every estimator, one table.

Each robot is drawn with its own servos, read losses from 0 to 0.6, quantisation step, poll period
and jitters; one joint is swept from 1 to 10 Hz through the recorder. The truth is the lag of the
joint's real motion, without noise and every millisecond, against the held command, averaged over
the tones with the estimator's own weights. (Once per loop would not do: the motion ripples with
the steps of the command, and once per loop sees one phase of the ripple only.)

    .venv/bin/python benchmarks/lag_accuracy.py --robots 240

The Cramér-Rao bound is that of a tone of unknown amplitude, phase and offset in white noise,
var(lag) >= 2 s² / (N A² ω²), where s is the scatter of the N fresh readings about the tone; the
poll's phase has to be found too, and its uncertainty (stated by the estimator) comes on top.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

from shared import print_rows

# isort: split
import numpy as np
import tyro
from random_robots import sweep_random_robot

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.signals import rms
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice, readings
from pupper_sysid.sysid.lag.lag_budget import lag_budget
from pupper_sysid.sysid.lag.tone import tone_lags, tone_response, tone_weights

OURS = "hold-aware (default)"


@dataclass(frozen=True)
class Result:
    """One robot: truth, interval, bounds and errors of the estimates [s]."""

    truth: float
    low: float
    high: float
    bound: float
    bound_with_phase: float
    period_error: float
    kind: str
    errors: dict[str, float]


def measure(seed: int) -> Result | None:
    """Build, sweep and measure one robot; None if its servo is refused, because it is stuck."""
    rng = np.random.default_rng([20261121, seed])
    # reading noise up to what the recordings of a real robot scatter by, 11 to 14 mrad
    noise, loss = float(rng.uniform(0.001, 0.014)), float(rng.uniform(0.0, 0.6))
    robot = sweep_random_robot(rng, "1-10", loss=loss, reading_noise_rad=noise)
    trials = robot.recording.trials(robot.joint)
    lattice = find_poll_lattice(trials, np.random.default_rng(0))
    try:
        budget = lag_budget(robot.joint, trials, np.random.default_rng(seed), lattice)
    except InputError:
        return None

    def tone_of(trial, rows):
        return tone_response(trial, rows, np.random.default_rng(0), draws=2)

    tones, true = [], []
    for trial in trials:
        tone = tone_of(trial, readings(trial, lattice))
        if tone is not None:
            tones.append(tone)
            true.append(tone_of(trial, robot.bus.motion(trial)).response)
    frequency, weights = np.array([t.frequency_hz for t in tones]), tone_weights(tones)
    truth = float(np.average(tone_lags(np.array(true), frequency), weights=weights))
    speed = np.array([abs(t.command_held) for t in tones]) * 2 * np.pi * frequency
    fresh, scatter = np.array([(t.fresh_count, t.residual_rad) for t in tones]).T
    information = np.sum((fresh * speed**2 / (2 * scatter**2))[weights > 0])
    with_phase = sum(1 / t.lag_variance_s2 for t in np.array(tones)[weights > 0])
    # the others measure from rows: give them the command hold
    errors = {k: v - budget.command_hold_s - truth for k, v in budget.estimators_s.items()
              if "hold-aware" not in k}  # fmt: skip
    return Result(
        truth, budget.lag_s.low, budget.lag_s.high, float(information**-0.5), with_phase**-0.5,
        abs(lattice.poll_period_s - robot.spec.poll_period_s), lattice.kind,
        errors | {OURS: budget.lag_s.value - truth},
    )  # fmt: skip


def main(robots: int = 240, workers: int = 2) -> None:
    """Print the table and what the intervals are worth."""
    with ProcessPoolExecutor(workers) as pool:
        every = list(pool.map(measure, range(robots), chunksize=4))
    results = [r for r in every if r]
    bound = np.array([r.bound for r in results])

    def cells(name: str) -> list[str]:
        error = np.array([r.errors[name] for r in results])
        middle = np.median(np.abs(error - np.median(error)) / bound) / 0.6745
        figures = (error.std(), np.abs(error).max())
        return [name, f"{1e3 * error.mean():+.2f}", *(f"{1e3 * x:.2f}" for x in figures),
                f"{np.sum(np.abs(error) > 0.05)}", f"{error.std() / rms(bound):.2f}",
                f"{middle:.2f}"]  # fmt: skip

    print_rows(
        ("estimator", "bias ms", "spread ms", "worst ms", "whole-period errors", "spread / bound",
         "middle half's spread / bound"), map(cells, results[0].errors),
    )  # fmt: skip
    inside = np.mean([r.low <= r.truth <= r.high for r in results])
    half = np.mean([r.high - r.low for r in results]) / 2
    phase = rms(np.array([r.bound_with_phase for r in results]))
    spread = np.std([r.errors[OURS] for r in results])
    periods = np.array([r.period_error for r in results if r.kind == "lattice"])
    print(
        f"\n{len(results)} robots, {every.count(None)} refused (more friction than torque). The 90 "
        f"% interval holds the truth in {inside:.1%}, half width {1e3 * half:.2f} ms on average; "
        f"Cramér-Rao bound {1e3 * rms(bound):.2f} ms, with the unknown phase of the poll "
        f"{1e3 * phase:.2f} ms, of which the spread is {spread / phase:.2f} times. The poll is "
        f"found for {len(periods) / len(results):.1%}, within 0.1 ms of its period in "
        f"{np.mean(periods < 1e-4):.1%} of these."
    )


if __name__ == "__main__":
    tyro.cli(main)
