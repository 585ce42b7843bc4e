"""Does the doctor name the right fault? Recordings of healthy and faulty servos, by fault.

Each recording is drawn from `tests/support/strange_servos.py`, which simulates servos of four
classes, nine motions and many buses with no code of the package, and spoils them with one fault.

    .venv/bin/python benchmarks/doctor_confusion.py --count 38 --seed 606 [--only clamp]

Right: a finding of the fault's codes that asks for care or refuses, or a refusal to read it for its
unit. Undecided: none, or one that names the fault as its runner-up. Accused: a finding that names
another fault (`ACCUSING`), on a healthy recording any.
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Iterator
from itertools import product

from shared import print_rows  # isort: skip

import tyro

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


def main(count: int = 14, seed: int = 1, only: tuple[str, ...] = tuple(FAULTS)) -> None:
    """Print a line of each recording that is not right, and the table of `count` of each fault."""
    warnings.simplefilter("ignore")
    rows = []
    for number, fault in product(range(count), only):
        rows.append(r := judged(fault, number, seed))
        if r["kind"] != "right":
            print(fault, number, r["motion"], r["codes"], r["rivals"], flush=True)
    kinds = ("right", "undecided", "accused")

    def cells() -> Iterator[list[object]]:
        for fault in only:
            judgements = [r for r in rows if r["fault"] == fault]
            wrong = [r for r in judgements if r["kind"] != "right"]
            others = Counter(code for r in wrong for code in r["codes"] or ["nothing"])
            counts = Counter(r["kind"] for r in judgements)
            listed = ", ".join(f"{code} {n}" for code, n in others.most_common())
            yield [fault, len(judgements), *(counts[k] for k in kinds), listed]

    print_rows(("fault", "recordings", "right", "undecided", "another fault named",
                "codes where it is not right"), cells())  # fmt: skip
    total = Counter(r["kind"] for r in rows)
    shares = ", ".join(f"{total[k] / len(rows):.1%} {k}" for k in kinds)
    print(f"\n{len(rows)} recordings: {shares}; {max(r['spent_s'] for r in rows):.1f} s at most")


if __name__ == "__main__":
    tyro.cli(main)
