"""Do 90 % intervals hold the truth? Emulated robots and servos in two worlds, one table each.

    .venv/bin/python benchmarks/coverage.py --world sweep --robots 240
    .venv/bin/python benchmarks/coverage.py --world strokes --robots 60

`sweep`: robots on a polled, lossy bus, one joint swept at four tones, through `calibrate`.
`strokes`: servos with play of 0 to 2° and dead zones of 0 to 5 counts, through `sysid.backlash`.
"""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Literal

from shared import print_rows, share  # isort: skip

import numpy as np
import tyro
from random_robots import sweep_random_robot

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.backlash import backlash
from pupper_sysid.sysid.compare.truth import truth_table
from pupper_sysid.sysid.fit.calibrate import calibrate
from support.strokes import stroked as strokes

RATIOS = ("stiffness", "damping", "friction_loss", "effort_limit", "velocity_limit_rad_s")
"""Quantities whose width is printed as the ratio of the interval's ends."""

Row = tuple[str, Interval, float, bool]
"""One quantity of one robot: name, answer, truth, whether it is called identified."""


def swept(seed: int) -> Iterator[Row]:
    """Calibrate one joint of a robot from four tones."""
    rng = np.random.default_rng([20261122, 7, seed])
    loss, noise = float(rng.uniform(0.0, 0.5)), float(rng.uniform(0.002, 0.008))
    robot = sweep_random_robot(rng, "1,2,4,8", loss=loss, reading_noise_rad=noise)
    result = calibrate(robot.recording, [robot.joint])
    for q in truth_table(result.calibration, robot.bus.truth(), robot.recording).quantities:
        if q.found is not None and np.isfinite([q.found.low, q.found.high]).all():
            yield q.quantity, q.found, q.truth, q.identified != "no"


def stroked(seed: int) -> Iterator[Row]:
    """Measure play, dead zone and hysteresis from slow strokes at P 8 and P 32."""
    rng = np.random.default_rng(1000 + seed)
    degrees, zone = float(rng.uniform(0, 2)), int(rng.integers(0, 6))
    recording, servo = strokes(seed, degrees, zone)
    result = backlash(recording)["bench"]
    dead_zone = result.dead_zone_rad
    assert dead_zone is not None
    if result.backlash_rad is not None:
        yield "backlash [rad]", result.backlash_rad, servo.backlash_rad, True
    bounded = "" if dead_zone.value > 0 else ", bounded from above"
    yield f"dead zone{bounded} [rad]", dead_zone, zone * servo.count_rad, True
    for gain in result.gains:
        if gain.p_gain == 8 or dead_zone.value == 0:  # else the dead zone sets it
            stiffness = servo.torque_nm * servo.duty_per_rad * gain.p_gain
            width = 2 * servo.friction_nm / stiffness
            yield f"hysteresis at P {gain.p_gain:g} [rad]", gain.hysteresis_rad, width, True


WORLDS = {"sweep": swept, "strokes": stroked}


def rows_of(world: str, seed: int) -> list[Row] | None:
    """Rows of one robot; None where it is refused, such as one that cannot move."""
    warnings.simplefilter("ignore")
    try:
        return list(WORLDS[world](seed))
    except InputError:
        return None


def held(rows: list[Row]) -> str:
    """How many intervals hold the truth; a quantisation step has no width but its last digits."""
    slack = [1e-6 * abs(truth) for _, _, truth, _ in rows]
    inside = [x.low - s <= truth <= x.high + s
              for (_, x, truth, _), s in zip(rows, slack, strict=True)]  # fmt: skip
    return share(sum(inside), len(rows))


def line(quantity: str, rows: list[Row]) -> list[str]:
    """A row of the table: coverage, width, error, and coverage where not identified."""
    known, others = ([r for r in rows if r[3] is yes] for yes in (True, False))
    width = error = "–"
    if known:
        low, high, value, truth = np.array([(x.low, x.high, x.value, t) for _, x, t, _ in known]).T
        off = np.abs(value - truth)
        if quantity in RATIOS:
            width = f"× {np.median(high / np.maximum(low, 1e-12)):.2f}"
            error = f"{np.median(off / np.abs(truth)):.1%}"
        else:
            width, error = f"{np.median(high - low):.2g}", f"{np.median(off):.2g}"
    return [quantity, f"{len(known)} of {len(rows)}", held(known), width, error, held(others)]


def main(world: Literal["sweep", "strokes"] = "sweep", robots: int = 40, workers: int = 2) -> None:
    """Print the table of a world."""
    by_quantity: dict[str, list[Row]] = defaultdict(list)
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        every = list(pool.map(partial(rows_of, world), range(robots)))
    for row in (row for rows in every for row in rows or ()):
        by_quantity[row[0]].append(row)
    print(f"{robots} robots, {world}, {every.count(None)} refused")
    print_rows(
        ("quantity", "identified", "holds the truth", "median width", "median error",
         "not identified: holds"), (line(*item) for item in sorted(by_quantity.items())),
    )  # fmt: skip


if __name__ == "__main__":
    tyro.cli(main)
