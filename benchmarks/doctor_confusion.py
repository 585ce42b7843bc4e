"""Does the doctor name the right fault? Recordings of healthy and faulty servos, by fault.

Each recording is drawn from `tests/support/strange_servos.py`, which simulates servos of four
classes, seven motions and many buses with no code of the package, and spoils them with one fault.

    .venv/bin/python benchmarks/doctor_confusion.py --count 14 --seed 1 [--only clamp stop] [--each]

Right: a finding of the fault's codes that asks for care or refuses, or a refusal to read it for its
unit. Undecided: none, or one that names the fault as its runner-up. Accused: a finding that names
another fault (`ACCUSING`), on a healthy recording any.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import warnings
from collections import Counter, defaultdict
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import numpy as np

import pupper_sysid as ps
from pupper_sysid.sysid.doctor.checks import findings
from pupper_sysid.sysid.doctor.findings import USE
from support.strange_servos import ACCUSING, FAULTS, draw_recording


def named(table) -> tuple[list[str], list[str], float]:
    """Codes of the findings about one recording, of their runners-up, and processor time [s]."""
    recording = ps.Recording.from_arrays(
        table.send_time_s.to_numpy(), {"joint": table.command_rad.to_numpy()},
        {"joint": table.position_rad.to_numpy()}, read_time_s=table.read_time_s.to_numpy(),
    )  # fmt: skip
    began = time.process_time()
    found = [f for f in findings(recording.trials("joint")) if f.verdict != USE]
    spent = time.process_time() - began
    return [f.code for f in found], [f.values.get("rival", "") for f in found], spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=14, help="recordings of each fault")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=list(FAULTS), choices=list(FAULTS))
    parser.add_argument("--each", action="store_true", help="a line for each that is not right")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    lines, longest = [], 0.0
    for fault in options.only:
        told: Counter[str] = Counter()
        others: dict[str, int] = defaultdict(int)
        for number in range(options.count):
            world, table = draw_recording(fault, number, options.seed)
            try:
                codes, rivals, spent = named(table)
            except ps.InputError as error:
                codes, rivals, spent = [str(error)[:90]], [], 0.0
                codes += FAULTS[fault][1] if "Angles must be radians" in str(error) else []
            longest = max(longest, spent)
            right = set(FAULTS[fault][1]) & set(codes)
            # a gain that asks for care names no cause, and on a sound recording is an accusation
            hedged = set() if fault == "healthy" else {"scale_asks_care"}
            accused = set(ACCUSING) & set(codes) - hedged
            if fault == "healthy":
                kind = "accused" if accused else "right"
            else:
                also = set(FAULTS[fault][1]) & set(rivals)
                kind = "right" if right else "undecided" if also or not accused else "accused"
            told[kind] += 1
            if kind != "right":
                for code in codes or ["nothing"]:
                    others[code] += 1
                if options.each:
                    print(fault, number, world.motion, f"{world.rate_hz:.0f} Hz", codes, rivals)
        rest = ", ".join(f"{code} {n}" for code, n in sorted(others.items(), key=lambda o: -o[1]))
        counts = [told[kind] for kind in ("right", "undecided", "accused")]
        lines.append((fault, options.count, *counts, rest))
        print("| " + " | ".join(map(str, lines[-1])) + " |", flush=True)
    shares = np.array([line[1:5] for line in lines], float)
    total, right, undecided, wrong = shares.sum(axis=0)
    print(f"\n{total:.0f} recordings: {right / total:.1%} right, {undecided / total:.1%} undecided,"
          f" {wrong / total:.1%} another fault named; {longest:.1f} s at most")  # fmt: skip


if __name__ == "__main__":
    main()
