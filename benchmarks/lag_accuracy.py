"""How accurate is the measured lag? Random emulated robots, every estimator, one table.

Each robot is drawn with its own servos, read losses from 0 to 0.6, count size, poll period and
jitters; one joint is swept from 1 to 10 Hz through the recorder, exactly as a user would. The
truth is the lag of the joint's real motion (noise-free, at the instants of the host's reads)
against the held command, averaged over the tones with the estimator's own weights.

    .venv/bin/python benchmarks/lag_accuracy.py --robots 240

The Cramér-Rao bound is that of a tone of unknown amplitude, phase and offset in white noise,
var(lag) >= 2 s² / (N A² ω²), where s² is the reading's noise, the count's q²/12 and the poll
jitter times the speed; information adds over tones.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pandas as pd

from common.joints import JOINT_NAMES
from sim.emulated_bus import EmulatedBus
from sim.emulated_robot import draw_robot, random_spec
from sysid.delay import lag_budget
from sysid.excitation import parse_frequencies, plan
from sysid.poll_lattice import Readings, find_poll_lattice, readings
from sysid.recorder import record
from sysid.recording import load
from sysid.tone import tone_response


@dataclass(frozen=True)
class Result:
    """One robot: truth, estimates, bound [s]."""

    loss: float
    truth: float
    bound: float
    low: float
    high: float
    estimates: dict[str, float]
    period_error: float
    kind: str


def measure(seed: int) -> Result:
    """Build, sweep and measure one robot."""
    rng = np.random.default_rng([20261121, seed])
    spec = random_spec(rng, loss=float(rng.uniform(0.0, 0.6)))
    bus = EmulatedBus(draw_robot(rng, spec), rng)
    joint = JOINT_NAMES[int(rng.integers(len(JOINT_NAMES)))]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sweep.csv"
        record(bus, plan("sine", [joint], parse_frequencies("1-10")), path)
        trials = load(path).trials(joint)
    true = pd.DataFrame(bus.truth_rows(), columns=["time", "joint", "position", "reading_time"])
    true = true[true.joint == joint]
    lattice = find_poll_lattice(trials)
    budget = lag_budget(joint, trials, np.random.default_rng(seed), lattice)

    weights, lags, information = [], [], 0.0
    for trial in trials:
        tone = tone_response(trial, readings(trial, lattice), np.random.default_rng(0), draws=2)
        if tone is None:
            continue
        position = np.interp(trial.read_time_s, true.time, true.position)
        exact = Readings(
            np.arange(len(position)), trial.read_time_s, position, trial.read_time_s, 0.0
        )
        clean = tone_response(
            replace(trial, position_rad=position), exact, np.random.default_rng(0), draws=2
        )
        omega = 2 * np.pi * tone.frequency_hz
        lag = -np.angle(clean.response) / omega
        # the truth's own whole periods: dead times are known to the emulator
        centre = budget_free_centre(bus, joint)
        lags.append(centre + ((lag - centre + np.pi / omega) % (2 * np.pi / omega)) - np.pi / omega)
        weights.append(1 / tone.lag_variance_s2)
        speed = abs(tone.command_held) * omega
        noise = spec.reading_noise_rad**2 + spec.quantum_rad**2 / 12
        noise += 0.5 * (spec.poll_jitter_s * speed) ** 2
        information += tone.fresh_count * speed**2 / (2 * noise)
    truth = float(np.average(lags, weights=weights))
    estimates = {k: v for k, v in budget.estimators.items() if "hold-aware" not in k}
    for name in estimates:  # the others measure from rows: give them the command hold
        estimates[name] -= budget.command_hold_s
    return Result(
        spec.loss, truth, information**-0.5, budget.lag.low, budget.lag.high,
        estimates | {"hold-aware (default)": budget.lag.value},
        abs(lattice.period_s - spec.poll_period_s), lattice.kind,
    )  # fmt: skip


def budget_free_centre(bus: EmulatedBus, joint: str) -> float:
    """A rough lag from the true parameters, to pick the truth's whole period [s]."""
    actuator = bus.truth()["joints"][joint]["actuator"]
    return actuator["delay_s"] + actuator["damping"] / actuator["stiffness"] + 0.008


def table(results: list[Result]) -> str:
    """The printed table, as Markdown."""
    truth = np.array([r.truth for r in results])
    bound = np.array([r.bound for r in results])
    lines = [
        "| estimator | bias ms | spread ms | worst ms | whole-period errors | spread / bound |",
        "|---|---|---|---|---|---|",
    ]
    for name in results[0].estimates:
        error = np.array([r.estimates[name] for r in results]) - truth
        whole = int(np.sum(np.abs(error) > 0.05))
        ratio = np.sqrt(np.mean((error - error.mean()) ** 2) / np.mean(bound**2))
        lines.append(
            f"| {name} | {1e3 * error.mean():+.2f} | {1e3 * error.std():.2f} "
            f"| {1e3 * np.abs(error).max():.2f} | {whole} | {ratio:.2f} |"
        )
    inside = np.array([r.low <= r.truth <= r.high for r in results])
    width = np.array([r.high - r.low for r in results]) / 2
    found = np.array([r.kind == "lattice" for r in results])
    period = np.array([r.period_error for r in results])[found]
    lines += [
        "",
        f"{len(results)} robots, losses {min(r.loss for r in results):.2f} to "
        f"{max(r.loss for r in results):.2f}. 90 % interval covers the truth in "
        f"{100 * inside.mean():.1f} %; half width {1e3 * width.mean():.2f} ms on average; "
        f"Cramér-Rao bound {1e3 * np.sqrt(np.mean(bound**2)):.2f} ms.",
        f"Poll lattice found for {100 * found.mean():.1f} %, "
        f"{100 * np.mean(period < 1e-4):.1f} % of them within 0.1 ms of the period.",
    ]
    for low, high in ((0.0, 0.2), (0.2, 0.4), (0.4, 0.61)):
        chosen = np.array([low <= r.loss < high for r in results])
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
    given = parser.parse_args()
    with ProcessPoolExecutor(given.workers) as pool:
        found = list(pool.map(measure, range(given.robots), chunksize=4))
    print(table(found))
