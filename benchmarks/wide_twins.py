"""Do the numbers of `calibrate` hold on servos of any kind? Twins from an independent simulator.

`wide_servo.py` draws servos, motions and buses from wide ranges and simulates them at 0.1 ms, with
no code of the package. Here recordings of them go through `calibrate`, and each number that the
calibration file calls identified is compared with the truth.

    .venv/bin/python benchmarks/wide_twins.py --kinds profile gravity --motions tones walk \
        --count 4 --seed 1 --out twins.json
    .venv/bin/python benchmarks/wide_twins.py --table twins.json [--detail]
    .venv/bin/python benchmarks/wide_twins.py --compare before.json after.json
    .venv/bin/python benchmarks/wide_twins.py --self-test

`--out` is a file of JSON lines, one twin each, written as they end; `--resume` continues it.
Definitions: a number *holds* where its 90 % interval touches the truth, which is an interval itself
where the servo has no single number (`wide_servo.truths`); a miss counts as the factor (times: ms)
between the nearer ends; *identified* is what the file calls so, `ratio only` included; *stretch* is
the factor by which intervals must grow about their values for 90 % to hold.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pandas as pd
from wide_servo import (
    IN_CLASS,
    KINDS,
    MOTIONS,
    Rows,
    Servo,
    Twin,
    draw_twin,
    lag_truth,
    readings,
    simulate,
    tone_truths,
    truths,
)

import pupper_sysid as ps

JOINT = "servo"
RATIOS = ("stiffness", "damping", "back_emf", "damping_sum", "friction_loss", "effort_limit")
QUANTITIES = ("dead_time_s", *RATIOS, "speed_limit", "acceleration_limit", "offset_rad")
DIFFERENCES = {"dead_time_s": (1e3, "ms"), "offset_rad": (1e3, "mrad"), "lag": (1e3, "ms")}
"""Quantities whose errors and widths are differences; all others are factors."""
NO_LIMIT = 300.0
"""A limit from here on, in rad/s or 100 rad/s², counts as none."""
GOODNESS = re.compile(
    r"goodness|misfit|chi2|chi_2|residual_over|over_noise|r_hat|rhat|effective_draws|"
    r"prior_share|between_rec|converged"
)


# -------------------------------------------------------------------------------------- one twin


def recording(twin: Twin, rows: Rows, folder: Path) -> ps.Recording:
    """The rows as a user has them: arrays with true times, or a table with one time per row."""
    bus = twin.bus
    if bus.stamps == "end":
        path = folder / "log.csv"
        columns = {"time_s": rows.sent_s, f"{JOINT}_command_rad": rows.command,
                   f"{JOINT}_position_rad": rows.position, "trial": rows.trial}  # fmt: skip
        if np.isfinite(rows.frequency_hz).any():
            columns["freq_hz"] = rows.frequency_hz
        pd.DataFrame(columns).to_csv(path, index=False)
        return ps.load(path)
    metadata: dict[str, Any] = {}
    if bus.stated:
        metadata["readings"] = "polled" if bus.poll_s > 0 else "live"
    if bus.setup:
        metadata["servos"] = {JOINT: bus.setup}
    return ps.Recording.from_arrays(
        rows.sent_s, {JOINT: rows.command}, {JOINT: rows.position}, read_time_s=rows.read_s,
        trial=rows.trial, frequency_hz=rows.frequency_hz, metadata=metadata, name="log",
    )  # fmt: skip


def measured(kind: str, motion: str, number: int, seed: int) -> dict[str, Any]:
    """Calibrate one twin: truth, answers, times."""
    warnings.simplefilter("ignore")
    twin, path, sent, commands = draw_twin(kind, motion, number, seed)
    rows = readings(twin, path)
    record: dict[str, Any] = {
        "kind": kind, "motion": motion, "number": number, "seed": seed,
        "servo": twin.servo._asdict(),
        "bus": {k: v for k, v in vars(twin.bus).items() if k != "setup"},
        "stated_registers": bool((twin.bus.setup or {}).get("registers")),
        "rows": len(rows.sent_s), "truth": truths(twin, path),
        "lag_truth": lag_truth(twin, path, sent, commands), "refused": None,
    }  # fmt: skip
    tones = tone_truths(twin, path, sent, commands)
    wall, processor = time.perf_counter(), _processor_s()
    try:
        with tempfile.TemporaryDirectory() as folder:
            result = ps.calibrate(recording(twin, rows, Path(folder)))
        joint = result.calibration.joints[JOINT].model_dump(mode="json")
        lag = result.joints[JOINT].to_dict()["lag"]
    except ps.PupperError as error:
        record["refused"] = str(error)
    else:
        answers = {t["trial"]: t["lag_s"] for t in lag["by_frequency"]}
        record["answers"] = answered(joint)
        record["tones"] = [t | {"answer": answers.get(t["trial"])} for t in tones]
        record["lag"] = lag["lag_s"]
        record["goodness"] = {k: v for k, v in leaves(joint) if GOODNESS.search(k)}
        record["calibration"] = joint
    record["wall_s"] = time.perf_counter() - wall
    record["processor_s"] = _processor_s() - processor
    return record


def _processor_s() -> float:
    used = [resource.getrusage(x) for x in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def leaves(tree: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Values of nested mappings and sequences, by dotted name."""
    pairs: Iterable = ()
    if isinstance(tree, dict):
        pairs = tree.items()
    elif isinstance(tree, list):
        pairs = enumerate(tree)
    else:
        yield name, tree
    for key, value in pairs:
        yield from leaves(value, f"{name}.{key}" if name else str(key))


def answered(joint: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Numbers of a joint in the calibration file, by quantity; those that it lacks are absent."""
    actuator = joint["actuator"]
    ratios = actuator["ratios_to_armature"]
    numbers = {name: ratios.get(name) for name in RATIOS if name in ratios}
    numbers |= {
        "dead_time_s": actuator["dead_time_s"],
        "speed_limit": actuator["velocity_limit_rad_s"],
        "offset_rad": joint["feedback"]["offset_rad"],
    }
    for part in (ratios, actuator, joint):
        for key, value in part.items():
            if not (isinstance(value, dict) and "value" in value):
                continue
            if "damping" in key and "back_emf" in key:
                numbers.setdefault("damping_sum", value)
            if "acceleration_limit" in key:
                numbers.setdefault("acceleration_limit", value)
    under_load = joint.get("under_load") or {}
    for name, value in leaves(under_load):
        stem, _, leaf = name.rpartition(".")
        if leaf == "value" and "acceleration_limit" in stem:
            ends = {k: v for k, v in leaves(under_load) if k.startswith(f"{stem}.")}
            own = {k.rpartition(".")[2]: v for k, v in ends.items()}
            numbers.setdefault("acceleration_limit", own | {"value": value})
    parts = [numbers.get(n) for n in ("damping", "back_emf")]
    if "damping_sum" not in numbers and all(p and identified(p) for p in parts):
        numbers["damping_sum"] = {
            k: sum(p[k] for p in parts if p) for k in ("value", "low", "high")
        } | {"identified": "yes", "why": "the sum of two identified numbers"}
    return {n: q for n, q in numbers.items() if q is not None}


def identified(answer: dict[str, Any]) -> bool:
    """Whether the file calls a number identified and gives its interval."""
    ends = [answer.get("low"), answer.get("high")]
    return answer.get("identified") != "no" and None not in ends


def holds(answer: dict[str, Any], truth: list[float]) -> bool:
    """Whether the interval touches the truth."""
    if math.isinf(truth[0]):
        return answer["high"] >= NO_LIMIT
    slack = 1e-9 * max(abs(x) for x in truth)
    return answer["low"] <= truth[1] + slack and answer["high"] >= truth[0] - slack


def miss(quantity: str, answer: dict[str, Any], truth: list[float]) -> float:
    """Distance of the interval from the truth: a factor ≥ 1, or a difference in ms or mrad."""
    low, high = answer["low"], answer["high"]
    if quantity in DIFFERENCES:
        return DIFFERENCES[quantity][0] * max(low - truth[1], truth[0] - high, 0.0)
    if math.isinf(truth[0]):
        return 1.0 if high >= NO_LIMIT else math.inf
    up = low / truth[1] if truth[1] > 0 else math.inf
    down = truth[0] / high if high > 0 else math.inf if truth[0] > 0 else 1.0
    return max(up, down, 1.0)


# ----------------------------------------------------------------------------------------- tables


WORDS = ("identified", "holds", "beyond a factor 2", "worst miss", "median width", "stretch")
Answer = tuple[str, dict[str, Any], list[float], dict[str, Any]]
"""Quantity, answer of the file, truth, and the twin's record."""


def answers(records: list[dict[str, Any]]) -> list[Answer]:
    """All answers of all twins, lags included."""
    every = []
    for record in records:
        if record["refused"]:
            continue
        for quantity, answer in record["answers"].items():
            truth = [math.inf if x is None else x for x in record["truth"][quantity]]
            every.append((quantity, answer, truth, record))
        for tone in record["tones"]:
            if tone["answer"] is not None:
                every.append(("lag by tone", _known(tone["answer"]), [tone["truth"]] * 2, record))
        if not any(t["answer"] for t in record["tones"]):
            every.append(
                ("lag of motion", _known(record["lag"]), [record["lag_truth"]] * 2, record)
            )
    return every


def _known(interval: dict[str, Any]) -> dict[str, Any]:
    return interval | {"identified": "yes"}


def coverage(rows: list[Answer]) -> dict[str, Any]:
    """Counts of some answers: all, identified, holding; worst miss, median width."""
    known = [r for r in rows if identified(r[1])]
    inside = [r for r in known if holds(r[1], r[2])]
    misses = [miss(_named(q), a, t) for q, a, t, _ in known]
    widths = [width(_named(q), a) for q, a, _, _ in known]
    scores = [stretch(_named(q), a, t) for q, a, t, _ in known]
    return {
        "all": len(rows), "identified": len(known), "holds": len(inside),
        "misses": [m for (q, a, t, _), m in zip(known, misses, strict=True) if not holds(a, t)],
        "worst": max(misses, default=math.nan),
        "width": float(np.median(widths)) if widths else math.nan,
        "stretch": float(np.quantile(scores, 0.9, method="higher")) if scores else math.nan,
    }  # fmt: skip


def _named(quantity: str) -> str:
    return "lag" if quantity.startswith("lag") else quantity


def width(quantity: str, answer: dict[str, Any]) -> float:
    """Ratio of the ends, or their difference in ms or mrad."""
    low, high = answer["low"], answer["high"]
    if quantity in DIFFERENCES:
        return DIFFERENCES[quantity][0] * (high - low)
    return high / low if low > 0 else math.inf


def stretch(quantity: str, answer: dict[str, Any], truth: list[float]) -> float:
    """Factor by which an interval must grow about its value to touch the truth (conformal score).

    In logarithms where the quantity's errors are factors.
    """
    if math.isinf(truth[0]):
        return 0.0 if holds(answer, truth) else math.inf
    ends = np.array([answer["low"], answer["value"], answer["high"], *truth], float)
    if quantity not in DIFFERENCES:
        ends = np.log(np.maximum(ends, 1e-12))
    low, value, high, first, last = ends
    if first <= value <= last:
        return 0.0
    part, whole = (first - value, high - value) if first > value else (value - last, value - low)
    return float(part / whole) if whole > 0 else math.inf


def share(part: int, whole: int) -> str:
    """Counts, with the percentage."""
    return f"{part} of {whole} ({100 * part / whole:.0f} %)" if whole else "–"


def size(quantity: str, value: float) -> str:
    """A width or a miss with its unit."""
    if math.isnan(value):
        return "–"
    unit = DIFFERENCES.get(_named(quantity))
    digits = f"{value:.3g}" if unit or not 1 < value < 1.1 else f"{value:.4f}"
    return f"{digits} {unit[1]}" if unit else f"× {digits}".replace("inf", "∞")


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print a Markdown table."""
    heads = list(heads)
    print("\n| " + " | ".join(heads) + " |\n|" + "---|" * len(heads))
    for row in rows:
        print("| " + " | ".join(row) + " |")


def order(quantity: str) -> int:
    """Place of a quantity in tables."""
    names = [*QUANTITIES, "lag by tone", "lag of motion"]
    return names.index(quantity)


def grouped(rows: Iterable[Any], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """Lists by key."""
    groups = defaultdict(list)
    for row in rows:
        groups[key(row)].append(row)
    return groups


def print_tables(records: list[dict[str, Any]], detail: bool = False) -> None:
    """Print coverage by quantity, by kind and by motion; with `detail` by all three."""
    every = answers(records)
    refused = [r for r in records if r["refused"]]
    spent = [r["processor_s"] for r in records]
    seeds, wall = sorted({r["seed"] for r in records}), sum(r["wall_s"] for r in records)
    print(f"\n{len(records)} twins, {len(refused)} refused; seeds {seeds}")
    print(
        f"processor time per twin {np.median(spent):.1f} s (median), {max(spent):.1f} s (largest), "
        f"{sum(spent) / 60:.1f} min in all; wall {wall / 60:.1f} min"
    )
    for text, count in sorted(grouped(refused, lambda r: r["refused"].split(":")[0]).items()):
        print(f"refused, {len(count)}: {text}")
    for name, chosen in (("in class", True), ("out of class", False)):
        part = [r for r in every if (r[3]["kind"] in IN_CLASS) is chosen]
        if part:
            print(f"\n{name}")
            quantities = grouped(part, lambda r: r[0])
            table(
                ("quantity", *WORDS),
                (quantity_row(q, quantities[q]) for q in sorted(quantities, key=order)),
            )
    heads = ("dead time: identified", "holds", "worst", "width",
             "ratios: identified", "holds", "worst", "width", "lag holds",
             "processor s")  # fmt: skip
    kinds = grouped(every, lambda r: r[3]["kind"])
    motions = grouped(every, lambda r: r[3]["motion"])
    both = grouped(every, lambda r: (r[3]["kind"], r[3]["motion"]))
    table(("kind", *heads), ((k, *cells(kinds[k])) for k in KINDS if k in kinds))
    table(("motion", *heads), ((m, *cells(motions[m])) for m in MOTIONS if m in motions))
    table(
        ("kind, motion", *heads),
        ((f"{k}, {m}", *cells(both[k, m])) for k in KINDS for m in MOTIONS if (k, m) in both),
    )
    goodness(records)
    if detail:
        for quantity, rows in sorted(
            grouped(every, lambda r: r[0]).items(), key=lambda x: order(x[0])
        ):
            parts = grouped(rows, lambda r: (r[3]["kind"], r[3]["motion"]))
            table(
                (quantity, *WORDS),
                (
                    (f"{k}, {m}", *quantity_row(quantity, parts[k, m])[1:])
                    for k in KINDS for m in MOTIONS if (k, m) in parts
                ),
            )  # fmt: skip


def quantity_row(quantity: str, rows: list[Answer]) -> tuple[str, ...]:
    """Cells of one quantity."""
    c = coverage(rows)
    far = "–" if _named(quantity) in DIFFERENCES else str(sum(m > 2 for m in c["misses"]))
    return (
        quantity, share(c["identified"], c["all"]), share(c["holds"], c["identified"]), far,
        size(quantity, c["worst"]) if c["misses"] else "–", size(quantity, c["width"]),
        size("", c["stretch"]),
    )  # fmt: skip


def cells(rows: list[Answer]) -> tuple[str, ...]:
    """Dead time, ratios, lags and time of some twins."""
    row = []
    for quantities, unit in ((("dead_time_s",), "dead_time_s"), (RATIOS, "ratio")):
        c = coverage([r for r in rows if r[0] in quantities])
        row += [share(c["identified"], c["all"]), share(c["holds"], c["identified"]),
                size(unit, c["worst"]) if c["misses"] else "–", size(unit, c["width"])]  # fmt: skip
    lags = coverage([r for r in rows if r[0].startswith("lag")])
    twins = {(r[3]["kind"], r[3]["motion"], r[3]["number"]): r[3]["processor_s"] for r in rows}
    return (
        *row,
        share(lags["holds"], lags["identified"]),
        f"{np.median(list(twins.values())):.1f}",
    )


def goodness(records: list[dict[str, Any]]) -> None:
    """Print what the files say of their fit by kind: medians of numbers, the commonest word."""
    by_name = defaultdict(lambda: defaultdict(list))
    for record in records:
        for name, value in (record.get("goodness") or {}).items():
            if value is not None:
                by_name[name][record["kind"]].append(value)
    common = [n for n, by in by_name.items() if sum(map(len, by.values())) >= len(records) / 4][:10]
    if common:
        kinds = [k for k in KINDS if any(by_name[n][k] for n in common)]
        rows = ((k, *(summary(by_name[n][k]) for n in common)) for k in kinds)
        table(("goodness of fit", *common), rows)


def summary(values: list[Any]) -> str:
    """Median of numbers, or the commonest of other values with its share."""
    if not values:
        return "–"
    if all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values):
        return f"{np.median(values):.3g}"
    word, count = Counter(map(str, values)).most_common(1)[0]
    return f"{word[:30]}, {share(count, len(values))}"


def print_comparison(before: list[dict[str, Any]], after: list[dict[str, Any]]) -> None:
    """Print two versions side by side on the twins that both have."""

    def key(record: dict[str, Any]) -> tuple:
        return tuple(record[k] for k in ("kind", "motion", "number", "seed"))

    common = {key(r) for r in before} & {key(r) for r in after}
    sides = [[r for r in records if key(r) in common] for records in (before, after)]
    refused = " → ".join(str(sum(bool(r["refused"]) for r in s)) for s in sides)
    spent = " → ".join(f"{np.mean([r['processor_s'] for r in s]):.1f}" for s in sides)
    print(f"{len(common)} twins in both; refused {refused}; processor s per twin {spent}")
    every = [answers(s) for s in sides]
    heads = ("identified", "still identified", "holds", "worst miss", "median width")
    for title, of in (
        ("in class", lambda k: k in IN_CLASS),
        ("out of class", lambda k: k not in IN_CLASS),
    ):
        parts = [[r for r in rows if of(r[3]["kind"])] for rows in every]
        names = sorted({r[0] for r in parts[0]} | {r[0] for r in parts[1]}, key=order)
        if names:
            print(f"\n{title}")
            rows = [[[r for r in p if r[0] == q] for p in parts] for q in names]
            table(
                ("quantity", *heads),
                ((q, *pair(own, q, key)) for q, own in zip(names, rows, strict=True)),
            )
    for label in ("kind", "motion"):
        rows = []
        for name in KINDS if label == "kind" else MOTIONS:
            parts = [[r for r in p if r[3][label] == name] for p in every]
            if any(parts):
                dead = [[r for r in p if r[0] == "dead_time_s"] for p in parts]
                ratios = [[r for r in p if r[0] in RATIOS] for p in parts]
                rows.append((name, *pair(dead, "dead_time_s", key), *pair(ratios, "ratio", key)))
        table((label, *(f"{q}: {h}" for q in ("dead time", "ratios") for h in heads)), rows)


def pair(parts: list[list[Answer]], quantity: str, key: Callable) -> tuple[str, ...]:
    """Cells of one quantity in two versions."""
    a, b = map(coverage, parts)
    known = [{(key(r[3]), r[0]) for r in p if identified(r[1])} for p in parts]
    kept = share(len(known[0] & known[1]), len(known[0]))
    return (
        f"{a['identified']} → {b['identified']} of {max(a['all'], b['all'])}", kept,
        f"{share(a['holds'], a['identified'])} → {share(b['holds'], b['identified'])}",
        f"{size(quantity, a['worst'])} → {size(quantity, b['worst'])}",
        f"{size(quantity, a['width'])} → {size(quantity, b['width'])}",
    )  # fmt: skip


# -------------------------------------------------------------------------------------- self-test


def self_test() -> None:
    """Compare the simulator with closed forms, and 0.2 ms with 0.05 ms steps."""
    rng, checks = np.random.default_rng(0), []
    hard = {"dead_time_s": 0.0, "friction": 0.0, "effort": 1e9}

    def moved(servo: Servo, size: float, stop: float, step: float = 1e-4):
        path = simulate(servo, np.array([0.0, 0.1]), np.array([0.0, size]), stop, rng, step)
        return path.time_s - 0.1, path

    time_s, path = moved(Servo(stiffness=2500, damping=100, **hard), 0.5, 0.6)
    after = np.maximum(time_s, 0)
    exact = 0.5 * (1 - (1 + 50 * after) * np.exp(-50 * after))
    checks.append(("critically damped step [rad]", np.abs(path.angle - exact).max(), 1e-3))

    time_s, path = moved(Servo(dead_time_s=0.0203, effort=200, friction=50, damping=0), 9.0, 0.2)
    after = np.clip(time_s - 0.0203, 0, None)
    checks.append(("full effort against friction [rad]",
                   np.abs(path.angle - 0.5 * 150 * after**2).max(), 2e-3))  # fmt: skip

    for speed, duration in ((np.inf, 2 * np.sqrt(0.5 / 40)), (2.0, 0.5 / 2 + 2 / 40)):
        time_s, path = moved(Servo(acceleration_limit=40, speed_limit=speed, **hard), 0.5, 1.0)
        there = time_s[np.argmax(path.set_point > 0.5 - 1e-5)]
        checks.append((f"end of the profile, {speed:g} rad/s [s]", abs(there - duration), 2e-3))
    time_s, path = moved(Servo(speed_limit=5, **hard), 0.5, 1.0)
    exact = np.clip(5 * time_s, 0, 0.5)
    checks.append(("slew [rad]", np.abs(path.set_point - exact).max(), 1e-3))

    swing = Servo(stiffness=1e-9, damping=0, gravity=30, gravity_phase=0.01, friction=0)
    path = simulate(swing, np.array([0.0]), np.array([0.0]), 5.0, rng)
    exact = -0.01 + 0.01 * np.cos(np.sqrt(30) * (path.time_s + 1.5))
    checks.append(("small swing, 6.5 s [rad]", np.abs(path.angle - exact).max(), 3e-5))
    still = Servo(stiffness=100, friction=20, gravity=15, gravity_phase=np.pi / 2)
    path = simulate(still, np.array([0.0]), np.array([0.0]), 2.0, rng)
    checks.append(("stick below friction [rad]", np.abs(path.angle).max(), 1e-12))

    emf = Servo(stiffness=1e6, effort=100, back_emf=20, damping=0, friction=0, dead_time_s=0)
    time_s, path = moved(emf, 100.0, 0.5)
    after = np.clip(time_s, 0, None)
    exact = 5 * (after - (1 - np.exp(-20 * after)) / 20)
    checks.append(("no-load speed [rad]", np.abs(path.angle - exact).max(), 2e-3))

    # two masses joined by a stiff spring move as one
    one = Servo(stiffness=2500, damping=60, **hard)
    two = one._replace(motor_share=0.6, link_stiffness=0.4 * 800.0**2, link_damping=100)
    paths = [moved(s, 0.3, 0.8)[1].angle for s in (one, two)]
    checks.append(("stiff link [rad]", np.abs(paths[0] - paths[1]).max(), 3e-3))
    low = one._replace(low_pass_s=0.05, stiffness=1e5, damping=600)
    time_s, path = moved(low, 0.3, 0.8)
    exact = 0.3 * (1 - np.exp(-np.clip(time_s, 0, None) / 0.05))
    checks.append(("low-pass [rad]", np.abs(path.set_point - exact).max(), 1e-3))
    droop = Servo(stiffness=1000, damping=60, friction=0, gravity=50, gravity_phase=np.pi / 2)
    path = simulate(droop, np.array([0.0]), np.array([0.0]), 3.0, rng)
    end = path.angle[-1]
    checks.append(("droop balances gravity", abs(1000 * end + 50 * np.cos(end)), 1e-2))
    path = simulate(droop._replace(integral=5e3, integral_clamp=200), np.array([0.0]),
                    np.array([0.0]), 8.0, rng)  # fmt: skip
    checks.append(("an integral term removes it [rad]", abs(path.angle[-1]), 1e-4))

    for kind in KINDS:
        twin, _, sent, commands = draw_twin(kind, "tones", 0, 3)
        plain = twin.servo._replace(dead_time_jitter_s=0.0)
        stop = twin.stretches[0].duration_s  # later, play and profiles amplify any difference
        rough, fine = (simulate(plain, sent, commands, stop, rng, step) for step in (2e-4, 5e-5))
        difference = rough.angle - np.interp(rough.time_s, fine.time_s, fine.angle)
        name = f"0.2 against 0.05 ms, {kind} [share of the motion]"
        most = max(0.005, twin.servo.play / fine.angle.std())
        checks.append((name, difference.std() / fine.angle.std(), most))
    for name, error, most in checks:
        print(f"{'ok  ' if error <= most else 'FAIL'} {name}: {error:.2g} (at most {most:g})")
    if any(error > most for _, error, most in checks):
        sys.exit("The simulator is wrong.")


# -------------------------------------------------------------------------------------------- main


def read_records(path: Path) -> list[dict[str, Any]]:
    """Twins of a file; a last line that was cut short is left out."""
    lines = path.read_text().splitlines()
    records = []
    for n, line in enumerate(lines):
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            if n < len(lines) - 1:
                raise
    return records


def finite(tree: Any) -> Any:
    """Infinite numbers become null, as JSON has none."""
    if isinstance(tree, dict):
        return {k: finite(v) for k, v in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [finite(v) for v in tree]
    if isinstance(tree, np.generic):
        tree = tree.item()
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def line(record: dict[str, Any]) -> str:
    """One twin in one line."""
    name = f"{record['kind']:>18} {record['motion']:<13} {record['number']:>3}"
    if record["refused"]:
        return f"{name}  refused: {record['refused'][:90]}"
    words = []
    for quantity, answer, truth, _ in answers([record]):
        if quantity == "dead_time_s":
            ends = "…".join(
                f"{1e3 * x:.1f}" for x in (answer["low"], answer["high"]) if x is not None
            )
            words.append(f"dead time {ends} ms of {1e3 * truth[0]:.1f} {answer['identified']}")
    known = [a for a in answers([record]) if identified(a[1]) and not a[0].startswith("lag")]
    wrong = [f"{q} {size(q, miss(q, a, t))}" for q, a, t, _ in known if not holds(a, t)]
    words.append(f"{len(known)} identified, wrong: {', '.join(wrong) or 'none'}")
    return f"{name}  {'; '.join(words)}  ({record['processor_s']:.1f} s)"


def version() -> str:
    """Commit of the package under test."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=Path(ps.__file__).parent,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.stdout.strip()


def main() -> None:
    """Run twins, or print the tables of finished ones."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--motions", nargs="+", choices=list(MOTIONS), default=list(MOTIONS))
    parser.add_argument("--count", type=int, default=2, help="twins of each kind and motion")
    parser.add_argument("--first", type=int, default=0, help="number of the first twin")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=math.inf, help="start none after that")
    parser.add_argument("--out", type=Path, default=Path("twins.json"))
    parser.add_argument("--resume", action="store_true", help="continue the file of --out")
    parser.add_argument("--table", type=Path, help="print the tables of a file")
    parser.add_argument("--detail", action="store_true", help="by quantity, kind and motion, too")
    parser.add_argument("--compare", type=Path, nargs=2, help="two files side by side")
    parser.add_argument("--self-test", action="store_true")
    options = parser.parse_args()
    if options.self_test:
        return self_test()
    if options.table:
        return print_tables(read_records(options.table), options.detail)
    if options.compare:
        return print_comparison(*map(read_records, options.compare))
    if options.out.exists() and not options.resume:
        sys.exit(f"{options.out} exists. Continue it with --resume, or name another.")
    done = read_records(options.out) if options.out.exists() else []
    options.out.write_text("".join(f"{json.dumps(r)}\n" for r in done))  # without a cut line
    finished = {(r["kind"], r["motion"], r["number"], r["seed"]) for r in done}
    # number by number, so that a run that is stopped has some of every kind
    wanted = [
        (kind, motion, number, options.seed)
        for number in range(options.first, options.first + options.count)
        for kind in options.kinds
        for motion in options.motions
    ]
    todo = [w for w in wanted if w not in finished]
    start, about = time.monotonic(), {"version": version()}
    with options.out.open("a") as file:
        for record in run(
            todo, options.jobs, lambda: time.monotonic() - start > 60 * options.minutes
        ):
            record = finite(record | about)
            file.write(json.dumps(record) + "\n")
            file.flush()
            done.append(record)
            print(line(record), flush=True)
    print_tables(done, options.detail)


def run(
    todo: list[tuple[str, str, int, int]], jobs: int, late: Callable[[], bool]
) -> Iterator[dict[str, Any]]:
    """Records of the twins as they end; Ctrl-C ends with those that are done."""
    try:
        if jobs == 1:
            for one in todo:
                if late():
                    return
                yield measured(*one)
            return
        with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
            waiting = {pool.submit(partial(measured, *one)) for one in todo}
            for future in as_completed(waiting):
                yield future.result()
                if late():
                    pool.shutdown(wait=False, cancel_futures=True)
                    return
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)


if __name__ == "__main__":
    main()
