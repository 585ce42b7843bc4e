"""Does the doctor name the right fault? Recordings of healthy and faulty servos, by fault.

Each recording is drawn from `tests/support/strange_servos.py`, which simulates servos of four
classes, seven motions and many buses with no code of the package, and spoils them with one fault.

    .venv/bin/python benchmarks/doctor_confusion.py --count 14 --seed 1 [--only clamp stop] [--each]

Right: a finding of the fault's codes that asks for care or refuses. Undecided: another one, or none
where the recording shows too little. Accused: a healthy recording with a finding that names a fault
of the pair of columns (`ACCUSING`).
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
from support.strange_servos import ACCUSING, FAULTS, draw_recording

import pupper_sysid as ps
from pupper_sysid.sysid.doctor.checks import findings
from pupper_sysid.sysid.doctor.findings import USE


def named(table) -> tuple[list[str], float]:
    """Codes of the findings about one recording, and the processor time [s]."""
    recording = ps.Recording.from_arrays(
        table.send_time_s.to_numpy(), {"joint": table.command_rad.to_numpy()},
        {"joint": table.position_rad.to_numpy()}, read_time_s=table.read_time_s.to_numpy(),
    )  # fmt: skip
    began = time.process_time()
    codes = [f.code for f in findings(recording.trials("joint")) if f.verdict != USE]
    return codes, time.process_time() - began


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
                codes, spent = named(table)
            except ps.InputError as error:
                codes, spent = [f"not read: {error}"[:90]], 0.0
            longest = max(longest, spent)
            right = set(FAULTS[fault][1]) & set(codes)
            accused = set(ACCUSING) & set(codes)
            if fault == "healthy":
                kind = "accused" if accused else "right"
            else:
                kind = "right" if right else "accused" if accused else "undecided"
            told[kind] += 1
            if kind != "right":
                for code in codes or ["nothing"]:
                    others[code] += 1
                if options.each:
                    print(fault, number, world.motion, f"{world.rate_hz:.0f} Hz", codes, flush=True)
        rest = ", ".join(f"{code} {n}" for code, n in sorted(others.items(), key=lambda o: -o[1]))
        lines.append((fault, options.count, told["right"], told["undecided"], told["accused"], rest))
        print("| " + " | ".join(map(str, lines[-1])) + " |", flush=True)
    shares = np.array([line[1:5] for line in lines], float)
    total, right, undecided, wrong = shares.sum(axis=0)
    print(f"\n{total:.0f} recordings: {right / total:.1%} right, {undecided / total:.1%} undecided, "
          f"{wrong / total:.1%} another fault named; {longest:.1f} s at most")  # fmt: skip


if __name__ == "__main__":
    main()
