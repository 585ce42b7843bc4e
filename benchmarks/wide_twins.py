"""Do the numbers of `calibrate` hold on servos of any kind? Twins from an independent simulator.

`tests/support/wide_servo.py` draws servos, motions and buses from wide ranges and simulates them
at 0.1 ms, with no code of the package. Here recordings of them go through `calibrate`, and each
number that the calibration file calls identified is compared with the truth.

    .venv/bin/python benchmarks/wide_twins.py --kinds profile gravity --motions tones walk \
        --count 4 --seed 1 --out twins.json
    .venv/bin/python benchmarks/wide_twins.py --repeats changed --kinds slew back_emf --count 5
    .venv/bin/python benchmarks/wide_twins.py --tables before.json after.json

With `--repeats` two recordings of a servo are calibrated together, and the truth is that of the
next one: `alike`, numbers vary by `BETWEEN` from each to the next; `changed`, they do not, and the
second recording has 0.8 of the position loop's gains. Differences that are named are counted.

`--out` is a file of JSON lines, one twin each, written as they end; a file that is there goes on.
Of several files in `--tables` the twins count that all have. Definitions: a number *holds* where
its 90 % interval touches the truth, which is an interval itself where the servo has no single
number (`wide_servo.truths`); a miss counts as the factor (times: ms) between the nearer ends;
*identified* is what the file calls so, `ratio only` included; *stretch* is the factor by which
intervals must grow about their values for 90 % to hold.
"""

from __future__ import annotations

import json
import math
import re
import resource
import tempfile
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

from shared import print_rows, share  # isort: skip

import numpy as np
import pandas as pd
import tyro

import pupper_sysid as ps
from support import wide_servo as wide

JOINT = "knee"
RATIOS = ("stiffness", "damping", "back_emf", "damping_sum", "friction_loss", "effort_limit")
LAGS = ("lag by tone", "lag of motion")
QUANTITIES = (
    "dead_time_s", *RATIOS, "speed_limit", "acceleration_limit", "offset_rad", *LAGS
)  # fmt: skip
DIFFERENCES = {"dead_time_s": "ms", "offset_rad": "mrad", **dict.fromkeys(LAGS, "ms")}
"""Quantities whose errors and widths are differences, in thousandths; all others are factors."""
NO_LIMIT = 300.0
"""A limit from here on, in rad/s or 100 rad/s², counts as none."""
BETWEEN = 0.03
"""Standard deviation of the logarithm of each number between recordings; an assumption."""
MISFIT = re.compile("does not describe|moves as if it had|may as well have")
"""What warnings of a file say where the model does not fit, or another structure fits better."""
Repeats = Literal["none", "alike", "changed"]


# -------------------------------------------------------------------------------------- one twin


def recording(twin: wide.Twin, rows: wide.Rows, folder: Path) -> ps.Recording:
    """The rows as a user has them: arrays with true times, or a table with one time per row."""
    bus = twin.bus
    if bus.stamps == "end":
        columns = {"time_s": rows.sent_s, f"{JOINT}_command_rad": rows.command,
                   f"{JOINT}_position_rad": rows.position, "trial": rows.trial}  # fmt: skip
        if np.isfinite(rows.frequency_hz).any():
            columns["freq_hz"] = rows.frequency_hz
        pd.DataFrame(columns).to_csv(folder / "log.csv", index=False)
        return ps.load(folder / "log.csv")
    metadata: dict[str, Any] = {}
    if bus.stated:
        metadata["readings"] = "polled" if bus.poll_s > 0 else "live"
    if bus.setup:
        metadata["servos"] = {JOINT: bus.setup}
    return ps.Recording.from_arrays(
        rows.sent_s, {JOINT: rows.command}, {JOINT: rows.position}, read_time_s=rows.read_s,
        trial=rows.trial, frequency_hz=rows.frequency_hz, metadata=metadata, name="log",
    )  # fmt: skip


def repeated(twin: wide.Twin, repeats: Repeats) -> list[wide.Twin]:
    """The twin as it is recorded: once, or twice and the next time."""
    if repeats == "none":
        return [twin]
    rng = wide.sender(twin, "between recordings")
    vary = BETWEEN if repeats == "alike" else 0.0
    twins = []
    for n in range(3):
        factors = {
            name: math.exp(rng.normal(0, vary))
            for name in ("stiffness", "damping", "back_emf", "friction", "effort", "speed_limit")
        }
        if repeats == "changed" and n == 1:
            factors |= {"stiffness": 0.8, "damping": 0.8}
        servo = twin.servo._replace(**{k: f * getattr(twin.servo, k) for k, f in factors.items()})
        twins.append(replace(twin, servo=servo, seed=twin.seed + 100_000 * n))
    return twins


def measured(kind: str, motion: str, number: int, seed: int, repeats: Repeats) -> dict[str, Any]:
    """Calibrate one twin: truth, answers, processor time."""
    warnings.simplefilter("ignore")
    drawn, *_ = wide.draw_twin(kind, motion, number, seed)
    twins, moves = repeated(drawn, repeats), []
    for twin in twins:
        sent, commands, _ = wide.sends(twin)
        until, rng = sent[-1] + 0.5, wide.sender(twin, "servo")
        moves.append((wide.simulate(twin.servo, sent, commands, until, rng), sent, commands))
    twin, (path, sent, commands) = twins[-1], moves[-1]
    logged = [wide.readings(t, p) for t, (p, *_) in zip(twins, moves, strict=True)]
    logged = logged[:2] if repeats != "none" else logged
    record: dict[str, Any] = {
        "kind": kind, "motion": motion, "number": number, "seed": seed, "repeats": repeats,
        "servo": twin.servo._asdict(), "rows": sum(len(r.sent_s) for r in logged), "refused": None,
    }  # fmt: skip
    begun = _processor_s()
    try:
        with tempfile.TemporaryDirectory() as folder:
            result = ps.calibrate([
                replace(recording(t, rows, Path(folder)), name=f"log{n}")
                for n, (t, rows) in enumerate(zip(twins, logged, strict=False))
            ])  # fmt: skip
    except ps.PupperError as error:
        record["refused"] = str(error)
    else:
        joint = result.calibration.joints[JOINT].model_dump(mode="json")
        lag = result.joints[JOINT].to_dict()["lag"]
        truth = wide.truths(twin, path)
        record["answers"] = [(q, a, truth[q]) for q, a in answered(joint).items()]
        by_trial = {t["trial"]: t["lag_s"] for t in lag["by_frequency"]}
        lags = [(LAGS[0], by_trial.get(t["trial"]), [t["truth"]] * 2)
                for t in wide.tone_truths(twin, path, sent, commands)]  # fmt: skip
        if repeats != "none":
            lags = []
            record["named"] = list(result.joints[JOINT].differences)
        elif not by_trial:  # else the lag is a mean over tones, of which no row is named
            lags = [(LAGS[1], lag["lag_s"], [wide.lag_truth(twin, path, sent, commands)] * 2)]
        record["answers"] += [(q, a | {"identified": "yes"}, t) for q, a, t in lags if a]
        record["calibration"] = joint
        record["misfit"] = any(map(MISFIT.search, joint["warnings"]))
    record["processor_s"] = _processor_s() - begun
    return finite(record)


def _processor_s() -> float:
    used = [resource.getrusage(x) for x in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def finite(tree: Any) -> Any:
    """Infinite numbers become null, as JSON has none."""
    if isinstance(tree, dict):
        return {k: finite(v) for k, v in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [finite(v) for v in tree]
    tree = tree.item() if isinstance(tree, np.generic) else tree
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def answered(joint: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Numbers of a joint in the calibration file, by quantity; those that it lacks are absent."""
    actuator, ratios = joint["actuator"], joint["actuator"]["ratios_to_armature"]
    numbers = {name: ratios.get(name) for name in RATIOS} | {
        "damping_sum": ratios["damping_and_back_emf"],
        "dead_time_s": actuator["dead_time_s"],
        "speed_limit": actuator["velocity_limit_rad_s"],
        "acceleration_limit": (joint["servo"] or {}).get("acceleration_limit_rad_s2"),
        "offset_rad": joint["feedback"]["offset_rad"],
    }
    parts = numbers["damping"], numbers["back_emf"]
    if numbers["damping_sum"] is None and all(p and identified(p) for p in parts):
        total = {k: sum(p[k] for p in parts) for k in ("value", "low", "high")}
        numbers["damping_sum"] = total | {"identified": "yes"}
    return {name: answer for name, answer in numbers.items() if answer is not None}


# ------------------------------------------------------------------------------------ statistics

Answer = tuple[str, dict[str, Any], list[float], dict[str, Any]]
"""Quantity, answer of the file, truth, and the twin's record."""


def identified(answer: dict[str, Any]) -> bool:
    """Whether the file calls a number identified and gives its interval."""
    return answer["identified"] != "no" and None not in (answer["low"], answer["high"])


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
        return 1e3 * max(low - truth[1], truth[0] - high, 0.0)
    if math.isinf(truth[0]):
        return 1.0 if high >= NO_LIMIT else math.inf
    up = low / truth[1] if truth[1] > 0 else math.inf
    down = truth[0] / high if high > 0 else math.inf if truth[0] > 0 else 1.0
    return max(up, down, 1.0)


def width(quantity: str, answer: dict[str, Any]) -> float:
    """Ratio of the ends, or their difference in ms or mrad."""
    low, high = answer["low"], answer["high"]
    if quantity in DIFFERENCES:
        return 1e3 * (high - low)
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


# ----------------------------------------------------------------------------------------- tables


def answers(records: Iterable[dict[str, Any]]) -> list[Answer]:
    """All answers of all twins, lags included."""
    return [
        (quantity, answer, [math.inf if x is None else x for x in truth], record)
        for record in records
        for quantity, answer, truth in record.get("answers", ())
    ]


def size(value: float, unit: str = "") -> str:
    """A width or a miss with its unit, or as a factor."""
    digits = f"{value:.3g}" if unit or not 1 < value < 1.1 else f"{value:.4f}"
    return f"{digits} {unit}" if unit else f"× {digits}".replace("inf", "∞")


def cells(rows: list[Answer]) -> list[str]:
    """Counts of answers that are identified and hold, worst miss, median width."""
    known = [r for r in rows if identified(r[1])]
    unit = DIFFERENCES.get(rows[0][0], "") if rows else ""
    misses = [miss(q, a, t) for q, a, t, _ in known if not holds(a, t)]
    widths = [width(q, a) for q, a, _, _ in known]
    return [
        share(len(known), len(rows)), share(len(known) - len(misses), len(known)),
        size(max(misses), unit) if misses else "–",
        size(float(np.median(widths)), unit) if widths else "–",
    ]  # fmt: skip


def quantity_row(quantity: str, rows: list[Answer]) -> list[str]:
    """Cells of one quantity, with far misses and stretch."""
    shares, held, worst, middle = cells(rows)
    known = [(q, a, t) for q, a, t, _ in rows if identified(a)]
    far = "–" if quantity in DIFFERENCES else str(sum(miss(*one) > 2 for one in known))
    scores = [stretch(*one) for one in known]
    factor = size(float(np.quantile(scores, 0.9, method="higher"))) if scores else "–"
    return [quantity, shares, held, far, worst, middle, factor]


def print_tables(records: list[dict[str, Any]]) -> None:
    """Print coverage by quantity, in class and out of it, by kind and by motion."""
    every = answers(records)
    spent = [r["processor_s"] for r in records]
    print(
        f"\n{len(records)} twins, seeds {sorted({r['seed'] for r in records})}; processor time per "
        f"twin {np.median(spent):.1f} s (median), {max(spent):.1f} s (largest)"
    )
    for record in records:
        if record["refused"]:
            print(f"refused: {record['kind']}, {record['motion']}: {record['refused']}")
    for repeats in ("alike", "changed"):
        if of := [r for r in records if r.get("repeats") == repeats and "named" in r]:
            print(
                f"repeats, {repeats}: a difference is named in "
                f"{share(sum(bool(r['named']) for r in of), len(of))}"
            )
    for title, in_class in (("in class", True), ("out of class", False)):
        part = grouped(
            (r for r in every if (r[3]["kind"] in wide.IN_CLASS) is in_class), lambda r: r[0]
        )
        print(f"\n{title}")
        print_rows(
            ("quantity", "identified", "holds", "beyond a factor 2", "worst miss", "median width",
             "stretch"), (quantity_row(q, part[q]) for q in QUANTITIES if q in part),
        )  # fmt: skip
    both = [
        (name, rows, {id(r[3]): r[3] for r in rows}.values())
        for label, names in (("kind", wide.KINDS), ("motion", wide.MOTIONS))
        for name, rows in ((n, [r for r in every if r[3][label] == n]) for n in names)
        if rows
    ]
    print_rows(
        ("kind or motion", "dead time: identified", "holds", "width", "ratios: identified",
         "holds", "width", "lag holds", "misfit or another structure named"),
        ((name, *(cells([r for r in rows if r[0] == "dead_time_s"])[k] for k in (0, 1, 3)),
          *(cells([r for r in rows if r[0] in RATIOS])[k] for k in (0, 1, 3)),
          cells([r for r in rows if r[0] in LAGS])[1],
          share(sum(r["misfit"] for r in twins), len(twins)))
         for name, rows, twins in both),
    )  # fmt: skip


def grouped(rows: Iterable[Any], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """Lists by key."""
    groups = defaultdict(list)
    for row in rows:
        groups[key(row)].append(row)
    return groups


# -------------------------------------------------------------------------------------------- main


Key = tuple[str, str, int, int, Repeats]


def key(record: dict[str, Any]) -> Key:
    """What names a twin."""
    numbered = record["kind"], record["motion"], record["number"], record["seed"]
    return *numbered, record.get("repeats", "none")


def read_records(path: Path) -> dict[Key, dict[str, Any]]:
    """Twins of a file."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {key(record): record for record in map(json.loads, lines)}


def main(
    kinds: tuple[str, ...] = wide.KINDS,
    motions: tuple[str, ...] = tuple(wide.MOTIONS),
    count: int = 2,
    seed: int = 1,
    repeats: Repeats = "none",
    jobs: int = 1,
    out: Path = Path("twins.json"),
    tables: tuple[Path, ...] = (),
) -> None:
    """Run `count` twins of each kind and motion, or print the tables of finished ones."""
    if tables:
        files = [read_records(path) for path in tables]
        common = set.intersection(*map(set, files))
        for file in files:
            print_tables([r for k, r in file.items() if k in common])
        return None
    done = read_records(out)
    # number by number, so that a run that is stopped has some of every kind
    wanted = [(k, m, n, seed, repeats) for n in range(count) for k in kinds for m in motions]
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool, out.open("a") as file:
        for future in as_completed(pool.submit(measured, *w) for w in wanted if w not in done):
            record = future.result()
            done[key(record)] = record
            print(json.dumps(record), file=file, flush=True)
            known = [a for a in answers([record]) if identified(a[1])]
            wrong = ", ".join(q for q, a, t, _ in known if not holds(a, t))
            print(*key(record), f"{len(known)} identified, wrong: {wrong or 'none'}", flush=True)
    print_tables(list(done.values()))


if __name__ == "__main__":
    tyro.cli(main)
