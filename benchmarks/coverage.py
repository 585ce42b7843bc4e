"""Do 90 % intervals hold the truth? Emulated robots and servos in three worlds, one table each.

    .venv/bin/python benchmarks/coverage.py --world sweep --robots 240
    .venv/bin/python benchmarks/coverage.py --world motion --robots 120
    .venv/bin/python benchmarks/coverage.py --world strokes --robots 60

`sweep`: robots on a polled, lossy bus, one joint swept at four tones, through `calibrate`.
`motion`: the same robots under chirps, multisines, steps and pseudo-random binary commands, half
polled and half live; the recording does not state which, and the lag is that of the motion.
`strokes`: servos with play of 0 to 2° and dead zones of 0 to 5 counts, through `sysid.backlash`.
"""

from __future__ import annotations

import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import Literal

from shared import print_rows  # isort: skip

import numpy as np
import tyro
from random_robots import SweptRobot, sweep_random_robot
from wide_servo import best_shift_s

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.backlash import backlash
from pupper_sysid.sysid.compare.truth import truth_table
from pupper_sysid.sysid.feedback.staleness import staleness
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.lag.lag_budget import lag_budget
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.sweep.excitation import parse_frequencies, plan
from support.strokes import stroked as strokes

MOTIONS = ("chirp", "multisine", "steps", "prbs")
RATIOS = ("stiffness", "damping", "friction_loss", "effort_limit", "velocity_limit_rad_s")
"""Quantities whose width is printed as the ratio of the interval's ends."""


@dataclass(frozen=True)
class Row:
    """One quantity of one robot; a verdict instead of an interval where `verdict` is not empty."""

    quantity: str
    truth: float = float("nan")
    low: float = float("nan")
    value: float = float("nan")
    high: float = float("nan")
    identified: bool = True
    verdict: str = ""


def row(quantity: str, interval: Interval, truth: float, identified: bool = True) -> Row:
    """A row of an interval."""
    return Row(quantity, truth, interval.low, interval.value, interval.high, identified)


# ------------------------------------------------------------------------------ robots in free air


def swept(seed: int) -> Iterator[Row]:
    """Calibrate one joint of a robot from four tones."""
    rng = np.random.default_rng([20261122, 7, seed])
    loss, noise = float(rng.uniform(0.0, 0.5)), float(rng.uniform(0.002, 0.008))
    robot = sweep_random_robot(rng, "1,2,4,8", loss=loss, reading_noise_rad=noise)
    result = calibrate(robot.recording, [robot.joint])
    for quantity in truth_table(result, robot.bus.truth(), robot.recording).quantities:
        found = quantity.found
        if found is not None and np.isfinite([found.low, found.high]).all():
            yield row(quantity.quantity, found, quantity.truth, quantity.identified != "no")


def moved(seed: int) -> Iterator[Row]:
    """Measure the lag of one joint in motion without single tones."""
    rng = np.random.default_rng([20261122, 77, seed])
    kind, live = MOTIONS[seed % len(MOTIONS)], bool(seed // len(MOTIONS) % 2)
    excitation = partial(plan, kind, frequencies_hz=parse_frequencies("1-5"), duration_s=20.0)
    chosen = {"loss": 0.0, "poll_period_s": 0.0} if live else {}
    robot = sweep_random_robot(rng, excitation, **chosen)
    # the motion has to decide whether readings are live
    header = {k: v for k, v in robot.recording.metadata.items() if k != "readings"}
    recording = Recording.from_frame(robot.recording.table, metadata=header)
    trials = recording.trials(robot.joint)
    truth = "live" if live else "polled"
    verdict = staleness(trials).kind
    yield Row(f"readings that are {truth}", verdict=verdict)
    lag = lag_budget(robot.joint, trials, np.random.default_rng(seed)).lag_s
    yield row(f"lag, {kind}, {truth} [s]", lag, true_lag(robot))
    yield row("lag, all [s]", lag, true_lag(robot))


def true_lag(robot: SweptRobot) -> float:
    """Lag of the true motion behind the held command, as defined for `lag` [s]."""
    (trial,) = robot.recording.trials(robot.joint)
    motion = robot.bus.motion(trial)
    sent = np.searchsorted(trial.send_time_s, motion.time_s, side="right") - 1
    return best_shift_s(trial.command_rad[sent], motion.position_rad, 0.05, 1.0)


def stroked(seed: int) -> Iterator[Row]:
    """Measure play, dead zone and hysteresis from slow strokes at P 8 and P 32."""
    rng = np.random.default_rng(1000 + seed)
    degrees, zone = float(rng.uniform(0, 2)), int(rng.integers(0, 6))
    recording, servo = strokes(seed, degrees, zone)
    result = backlash(recording)["bench"]
    dead_zone = result.dead_zone_rad
    assert dead_zone is not None
    if result.backlash_rad is not None:
        yield row("backlash [rad]", result.backlash_rad, servo.backlash_rad)
    bounded = "" if dead_zone.value > 0 else ", bounded from above"
    yield row(f"dead zone{bounded} [rad]", dead_zone, zone * servo.count_rad)
    for gain in result.gains:
        if gain.p_gain == 8 or dead_zone.value == 0:  # else the dead zone sets it
            stiffness = servo.torque_nm * servo.duty_per_rad * gain.p_gain
            width = 2 * servo.friction_nm / stiffness
            yield row(f"hysteresis at P {gain.p_gain:g} [rad]", gain.hysteresis_rad, width)


# ------------------------------------------------------------------------------------------- table

WORLDS = {"sweep": swept, "motion": moved, "strokes": stroked}


def rows_of(world: str, seed: int) -> list[Row] | None:
    """Rows of one robot; None where it is refused, such as one that cannot move."""
    warnings.simplefilter("ignore")
    try:
        return list(WORLDS[world](seed))
    except InputError:
        return None


def held(rows: list[Row]) -> str:
    """How many intervals hold the truth."""
    # a quantisation step has no width, but that of its last digits
    slack = [1e-6 * abs(r.truth) for r in rows]
    inside = sum(r.low - s <= r.truth <= r.high + s for r, s in zip(rows, slack, strict=True))
    return f"{inside} ({100 * inside / len(rows):.0f} %)" if rows else "–"


def line(quantity: str, rows: list[Row]) -> list[str]:
    """A row of the table: coverage, width, error, and coverage where not identified."""
    known, others = ([r for r in rows if r.identified is yes] for yes in (True, False))
    width = error = "–"
    if known:
        low, high, value, truth = np.array([(r.low, r.high, r.value, r.truth) for r in known]).T
        off = np.abs(value - truth)
        if quantity in RATIOS:
            width = f"× {np.median(high / np.maximum(low, 1e-12)):.2f}"
            error = f"{np.median(off / np.abs(truth)):.1%}"
        else:
            width, error = f"{np.median(high - low):.2g}", f"{np.median(off):.2g}"
    return [quantity, f"{len(known)} of {len(rows)}", held(known), width, error, held(others)]


def main(
    world: Literal["sweep", "motion", "strokes"] = "sweep", robots: int = 40, workers: int = 2
) -> None:
    """Print the table of a world."""
    by_quantity: dict[str, list[Row]] = defaultdict(list)
    verdicts: dict[str, Counter[str]] = defaultdict(Counter)
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        every = list(pool.map(partial(rows_of, world), range(robots)))
    for one in (row for rows in every for row in rows or ()):
        if one.verdict:
            verdicts[one.quantity][one.verdict] += 1
        else:
            by_quantity[one.quantity].append(one)
    print(f"{robots} robots, {world}, {every.count(None)} refused")
    for quantity, counts in verdicts.items():
        print(f"{quantity}: " + ", ".join(f"{n} called {word}" for word, n in counts.items()))
    print_rows(
        ("quantity", "identified", "holds the truth", "median width", "median error",
         "not identified: holds"), (line(*item) for item in sorted(by_quantity.items())),
    )  # fmt: skip


if __name__ == "__main__":
    tyro.cli(main)
