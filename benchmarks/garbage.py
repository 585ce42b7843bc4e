"""Does a fault ever give a confident number? Does the doctor refuse good recordings?

Three tables. Good recordings (those in `data/samples`, real ones in `$PUPPER_REAL_DATA`, sweeps of
emulated robots, and random servos of `tests/support/made_recordings.py`): how often the doctor asks
for care or refuses. Faults of `tests/support/garbage.py`, each on random servos' recordings: how
often one is refused, warned of, or not seen. And the same faults through `lag`: how often its
number is printed without a warning although it is wrong by more than 10 ms and its own interval.

    PYTHONPATH=tests .venv/bin/python benchmarks/garbage.py --good 300 --each 6 --lags 120

A fault that a recording does not show (a clip beyond its range, degrees that could be radians of a
fast servo, a position moved ahead by less than the servo's lag) counts as not seen.
"""

from __future__ import annotations

import argparse
import ast
import csv
import os
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sysid.doctor.checks import findings, refuse_unusable
from pupper_sysid.sysid.doctor.findings import VERDICTS
from pupper_sysid.sysid.identify.dead_time import lag
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.sweep.excitation import plan
from pupper_sysid.sysid.sweep.recorder import record as record_bus
from support.garbage import GARBAGE, spoilt
from support.made_recordings import JOINT, Setup, random_setup, record

ROOT = Path(__file__).resolve().parents[1]
REAL = Path(os.environ.get("PUPPER_REAL_DATA") or ROOT.parent / "shared" / "real")
NOT_SEEN = "not seen"
WRONG_S = 0.01


def worst(recording: Recording, joint: str) -> str:
    """The verdict of the checks on one joint."""
    found = [f.verdict for f in findings(recording.trials(joint))]
    return min(found, key=VERDICTS.index, default="use")


def good_ones(count: int, folder: Path) -> Iterator[tuple[str, str, str, list[str]]]:
    """Group, name, verdict and reasons of every joint of good recordings."""
    samples = [("samples", p) for p in sorted((ROOT / "data/samples").glob("*.csv"))]
    real = [*REAL.glob("*.csv"), *REAL.glob("mini_pupper_full_band/*.csv")]
    for group, path in [*samples, *(("real, Mini Pupper 2", p) for p in sorted(real))]:
        try:
            recording = load(path)
        except InputError:  # truths, commands
            continue
        for joint in recording.joints:
            yield group, f"{path.name} {joint}", *told(recording, joint)
    for name, recording in arms():
        for joint in recording.joints:
            yield "real, SO-101", f"{name} {joint}", *told(recording, joint)
    for seed in range(count // 12):
        rng = np.random.default_rng([21, seed])
        kind = ("sine", "chirp", "multisine", "steps")[seed % 4]
        bus = EmulatedBus(draw_robot(rng), rng)
        path = folder / f"{seed}.csv"
        chosen = plan(kind, bus.joint_names[seed % 12 : seed % 12 + 2], duration_s=4.0)
        record_bus(bus, chosen, path, loop_period_s=float(rng.choice([0.01, 0.019, 0.03])))
        recording = load(path)
        for joint in recording.joints:
            yield "emulated robots", f"{seed} {kind} {joint}", *told(recording, joint)
    for seed in range(count):
        rng = np.random.default_rng([22, seed])
        setup = random_setup(rng)
        group = "random servos, " + ("polled" if setup.poll_s else "live")
        yield group, f"{seed} {setup.kind}", *told(record(setup, rng), JOINT)


def told(recording: Recording, joint: str) -> tuple[str, list[str]]:
    """Verdict and the sentences that ask for more than use."""
    found = findings(recording.trials(joint))
    verdict = min((f.verdict for f in found), key=VERDICTS.index, default="use")
    return verdict, [f.text for f in found if f.verdict != "use"]


def arms() -> Iterator[tuple[str, Recording]]:
    """SO-101 recordings, all joints that are angles."""
    for folder in sorted(REAL.glob("sage_so101/*/")):
        tables = [
            list(csv.DictReader((folder / f"{n}.csv").open())) for n in ("control", "state_motor")
        ]
        rows = min(map(len, tables))
        sent, read = ([1e-6 * float(r["timestamp"]) for r in t[:rows]] for t in tables)
        command, position = (
            np.array([ast.literal_eval(r["positions"]) for r in t[:rows]]) for t in tables
        )
        names = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll")
        yield folder.name, Recording.from_arrays(
            sent, dict(zip(names, command.T, strict=False)),
            dict(zip(names, position.T, strict=False)), read_time_s=read, name=folder.name,
        )  # fmt: skip


def spoilt_ones(each: int) -> Iterator[tuple[str, Recording | None, Setup]]:
    """Fault, recording (None if refused as it is read) and the servo behind it."""
    for n, (name, fault) in enumerate(GARBAGE.items()):
        for k in range(each):
            rng = np.random.default_rng([23, n, k])
            kind = fault.base.get("kind", "tones")
            setup = replace(random_setup(rng), kind=kind, trial_s=3.0)
            setup = replace(setup, rate_hz=min(setup.rate_hz, 150.0))
            if fault.base:
                setup = replace(setup, quantum_rad=fault.base.get("quantum", setup.quantum_rad))
            rows = record(setup, rng).table.drop(columns="joint")
            try:
                yield name, spoilt(name, rng, rows), setup
            except InputError:
                yield name, None, setup


def judged(recording: Recording | None) -> str:
    """How a fault is met."""
    if recording is None:
        return "do not use"
    trials = {j: tuple(recording.trials(j)) for j in recording.joints}
    try:
        refuse_unusable(trials)
    except InputError:
        return "do not use"
    return min((worst(recording, j) for j in trials), key=VERDICTS.index)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="Faults seen, and good recordings refused.")
    parser.add_argument("--good", type=int, default=300)
    parser.add_argument("--each", type=int, default=6, help="random servos per fault")
    parser.add_argument("--lags", type=int, default=120, help="faults that go through `lag`")
    given = parser.parse_args()
    counted: dict[str, Counter[str]] = {}
    reasons = []
    with tempfile.TemporaryDirectory() as folder:
        for group, name, verdict, texts in good_ones(given.good, Path(folder)):
            counted.setdefault(group, Counter())[verdict] += 1
            reasons += [f"- {group}, {name}: {verdict}: {t}" for t in texts]
    print("| good recordings, joints | use | use with care | do not use |\n|---|---|---|---|")
    for group, own in counted.items():
        print(f"| {group} | {own['use']} | {own['use with care']} | {own['do not use']} |")
    print("\n".join(["", *reasons, ""]))

    faults: dict[str, Counter[str]] = {}
    through = []
    for name, recording, setup in spoilt_ones(given.each):
        verdict = judged(recording)
        faults.setdefault(name, Counter())[verdict] += 1
        if recording is not None and verdict != "do not use":
            through.append((name, verdict, recording, setup))
    total = sum(faults.values(), Counter())
    print("| faults | refused | use with care | not seen |\n|---|---|---|---|")
    print(f"| all {total.total()} | {total['do not use']} | {total['use with care']} | "
          f"{total['use']} |")  # fmt: skip
    for name, own in faults.items():
        if own["use"]:
            print(f"| {name} | {own['do not use']} | {own['use with care']} | {own['use']} |")

    outcomes: Counter[str] = Counter()
    order = np.random.default_rng(24).permutation(len(through))[: given.lags]
    for n in order:
        name, verdict, recording, setup = through[n]
        try:
            (found,) = lag(recording, JOINT).values()
        except InputError:
            outcomes["refused"] += 1
            continue
        dead, truth = found.dead_time_s, float(np.asarray(setup.servo.dead_time_s))
        assert dead is not None
        wrong = abs(dead.value - truth) > max(WRONG_S, dead.high - dead.low)
        told = "warned" if found.warnings else "without a warning"
        outcomes[f"{'wrong' if wrong else 'right'} dead time, {told}"] += 1
        if wrong and not found.warnings:
            print(f"- {name} ({verdict}): {1e3 * dead.value:.1f} ms "
                  f"[{1e3 * dead.low:.1f}, {1e3 * dead.high:.1f}], truth "
                  f"{1e3 * truth:.1f} ms")  # fmt: skip
    print(f"\n{len(order)} faulty recordings that are not refused, through `lag`: "
          + ", ".join(f"{n} {what}" for what, n in sorted(outcomes.items())) + ".")  # fmt: skip


if __name__ == "__main__":
    main()
