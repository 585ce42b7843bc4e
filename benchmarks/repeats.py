"""Is a recording that differs from the others of a joint named, and is a healthy one left alone?

    .venv/bin/python benchmarks/repeats.py [--factors 0.8 1.0] [--count 4] [--seed 91]

Servos, motions and buses are those of the independent simulator (`wide_servo.py`). Each is recorded
twice; in the second recording, `tuesday`, stiffness and damping are those of the first times the
factor, as a P gain or a supply would make them. Both go through `calibrate`.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from wide_servo import draw_twin, readings, simulate
from wide_twins import JOINT, recording

import pupper_sysid as ps

KINDS = (("slew", "tones"), ("back_emf", "tones"), ("slew", "steps"), ("slew", "walk"),
         ("back_emf", "teleop"))  # fmt: skip


def pair(kind: str, motion: str, number: int, seed: int, factor: float) -> list[ps.Recording]:
    """Two recordings of one servo, the second with gains times a factor."""
    twin, path, sent, commands = draw_twin(kind, motion, number, seed)
    made = []
    for name, own in (("monday", 1.0), ("tuesday", factor)):
        servo = twin.servo._replace(
            stiffness=own * twin.servo.stiffness, damping=own * twin.servo.damping
        )
        rng = np.random.default_rng([number, len(made)])
        moved = simulate(servo, sent, commands, float(path.time_s[-1]), rng)
        with tempfile.TemporaryDirectory() as folder:
            rows = readings(replace(twin, servo=servo), moved)
            made.append(replace(recording(twin, rows, Path(folder)), name=name))
    return made


def main() -> None:
    """Print a line per pair, and how many were named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--factors", type=float, nargs="*", default=[0.8, 1.0])
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--seed", type=int, default=91)
    wanted = parser.parse_args()
    warnings.simplefilter("ignore")
    for factor in wanted.factors:
        named = pairs = 0
        for kind, motion in KINDS:
            for number in range(wanted.count):
                both = pair(kind, motion, number, wanted.seed, factor)
                result = ps.calibrate(both).joints[JOINT]
                said = [w for w in result.warnings if "differs from the other" in w]
                named, pairs = named + bool(said), pairs + 1
                print(kind, motion, number, factor, *(said or ["–"]), flush=True)
        print(f"factor {factor:g}: {named} of {pairs} named", flush=True)


if __name__ == "__main__":
    main()
