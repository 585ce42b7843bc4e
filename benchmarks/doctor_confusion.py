"""Does the doctor name the right fault? Recordings of healthy and faulty servos, by fault.

Each recording is drawn from `tests/support/strange_servos.py`, which simulates servos of four
classes, nine motions and many buses with no code of the package, and spoils them with one fault.

    .venv/bin/python benchmarks/doctor_confusion.py --seed 1 [--count 14] [--only clamp] [--each]
        [--out FILE]

Right: a finding of the fault's codes that asks for care or refuses, or a refusal to read it for its
unit. Undecided: none, or one that names the fault as its runner-up. Accused: a finding that names
another fault (`ACCUSING`), on a healthy recording any.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import warnings
from collections import Counter
from itertools import product
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

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


def judged(fault: str, number: int, seed: int) -> dict:
    """One recording: what it was, what the doctor named, and how that counts."""
    world, table = draw_recording(fault, number, seed)
    try:
        codes, rivals, spent = named(table)
    except ps.InputError as error:
        codes, rivals, spent = [str(error)[:90]], [], 0.0
        codes += FAULTS[fault][1] if "Angles must be radians" in str(error) else []
    right = set(FAULTS[fault][1]) & set(codes)
    # a gain that asks for care names no cause, and on a sound recording is an accusation
    hedged = set() if fault == "healthy" else {"scale_asks_care"}
    accused = set(ACCUSING) & set(codes) - hedged
    if fault == "healthy":
        kind = "accused" if accused else "right"
    else:
        also = set(FAULTS[fault][1]) & set(rivals)
        kind = "right" if right else "undecided" if also or not accused else "accused"
    return {"fault": fault, "number": number, "seed": seed, "motion": world.motion, "kind": kind,
            "codes": codes, "rivals": rivals, "spent_s": spent}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=14, help="recordings of each fault")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=list(FAULTS), choices=list(FAULTS))
    parser.add_argument("--each", action="store_true", help="a line for each that is not right")
    parser.add_argument("--out", type=Path, help="JSON lines, which a next call goes on with")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    lines = options.out.read_text().splitlines() if options.out and options.out.exists() else []
    rows = {(r["fault"], r["number"], r["seed"]): r for r in map(json.loads, lines)}
    for number, fault in product(range(options.count), options.only):
        key = fault, number, options.seed
        if key in rows:
            continue
        rows[key] = judged(*key)
        if options.out:
            with options.out.open("a") as file:
                file.write(json.dumps(rows[key]) + "\n")
    rows = {k: r for k, r in rows.items()
            if k[0] in options.only and k[1] < options.count and k[2] == options.seed}  # fmt: skip
    print("| fault | n | right | undecided | another named | not right |\n|" + " --- |" * 6)
    kinds = ("right", "undecided", "accused")
    total: Counter[str] = Counter(r["kind"] for r in rows.values())
    for fault in options.only:
        judgements = [r for r in rows.values() if r["fault"] == fault]
        wrong = [r for r in judgements if r["kind"] != "right"]
        others = Counter(code for r in wrong for code in r["codes"] or ["nothing"])
        count = Counter(r["kind"] for r in judgements)
        listed = ", ".join(f"{code} {n}" for code, n in others.most_common())
        print("|", " | ".join(map(str, (fault, len(judgements), *(count[k] for k in kinds),
                                        listed))), "|")  # fmt: skip
        for r in wrong if options.each else ():
            print("   ", r["number"], r["motion"], r["codes"], r["rivals"])
    right, undecided, wrong_named = (total[k] / len(rows) for k in kinds)
    longest = max(r["spent_s"] for r in rows.values())
    print(f"\n{len(rows)} recordings: {right:.1%} right, {undecided:.1%} undecided,"
          f" {wrong_named:.1%} another fault named; {longest:.1f} s at most")  # fmt: skip


if __name__ == "__main__":
    main()
