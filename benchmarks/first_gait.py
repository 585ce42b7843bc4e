"""How well does the open-loop trot walk on other servos, before and after it is fitted to them?

    .venv/bin/python benchmarks/first_gait.py [--only weak ideal] [--seed 0] [--threads 0]

Seven actuators: the shipped calibration; the same with stiffness and torque doubled, with 0.6 of
the stiffness and 0.8 of the torque, with equal dead times of 20 and of 60 ms; and the presets
`paper` and `ideal`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro

from pupper_sysid.policies.train.first_gait import fit_trot
from pupper_sysid.sim.walking.config import PRESETS
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_ranges

CALIBRATION = Path(__file__).resolve().parents[1] / "data/samples/calibrated.yaml"


@dataclass(frozen=True)
class Options:
    """Which servos, and how."""

    only: tuple[str, ...] = ()
    """Names of actuators; all by default."""
    seed: int = 0
    """Of robots and search."""
    threads: int = 0
    """Of the physics; 0 for all cores."""


def main() -> None:
    """Fit a trot to each, and print one row of a table for each."""
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(1)
    print(
        "| servos | score | forward, % of 0.15 m/s | turn, % of 0.4 rad/s | clearance p10, mm "
        "| low swings, % | thigh and calf at limit, % | minutes (of one core) | limited by |\n"
        "|---|---|---|---|---|---|---|---|---|"
    )
    for name, servos in _actuators().items():
        if options.only and name not in options.only:
            continue
        begun, used = time.monotonic(), time.process_time()
        found = fit_trot(PRESETS["fast"], servos, options.seed, options.threads)
        wall, used = time.monotonic() - begun, time.process_time() - used
        a, b = found.before, found.after
        pairs = (
            (f"{a.score:.2f}", f"{b.score:.2f}"), _percent(a.forward_share, b.forward_share),
            _percent(a.turn_share, b.turn_share),
            (f"{1e3 * a.clearance_p10_m:.1f}", f"{1e3 * b.clearance_p10_m:.1f}"),
            _percent(a.low_swing_share, b.low_swing_share),
            _percent(a.saturated_share, b.saturated_share),
        )  # fmt: skip
        cells = " | ".join(f"{before} → {after}" for before, after in pairs)
        limit = found.limit or "–"
        print(f"| {name} | {cells} | {wall / 60:.1f} ({used / 60:.1f}) | {limit} |", flush=True)


def _percent(before: float, after: float) -> tuple[str, str]:
    return f"{100 * before:.0f}", f"{100 * after:.0f}"


def _actuators() -> dict[str, ServoRanges]:
    own = servo_ranges(CALIBRATION)
    return {
        "sample": own,
        "stiffness and torque × 2": _scaled(own, 2.0, 2.0),
        "stiffness × 0.6, torque × 0.8": _scaled(own, 0.6, 0.8),
        "dead time 20 ms": _dead_time(own, 0.02),
        "dead time 60 ms": _dead_time(own, 0.06),
        "paper": servo_ranges("paper"),
        "ideal": servo_ranges("ideal"),
    }


def _scaled(own: ServoRanges, stiffness: float, torque: float) -> ServoRanges:
    factors = {"stiffness": stiffness, "effort_limit": torque}
    ends = {
        end: {name: x * factors.get(name, 1.0) for name, x in getattr(own, end).items()}
        for end in ("low", "value", "high")
    }
    return replace(own, **ends)


def _dead_time(own: ServoRanges, dead_time_s: float) -> ServoRanges:
    ends = {
        end: getattr(own, end) | {"dead_time_s": np.full(12, dead_time_s)}
        for end in ("low", "value", "high")
    }
    return replace(own, **ends)


if __name__ == "__main__":
    main()
