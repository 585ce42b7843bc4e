"""Coverage of `sysid.backlash` on emulated servos: play 0 to 2°, dead zones of 0 to 5 counts.

Each servo is drawn (`sim.emulator.servos.pendulum_bench.BenchSpec`), swings 0.1 kg at 0.1 m, and is
stroked slowly at P 8 and P 32. Printed are how often the 90 % intervals hold the truth, and the
errors.

    .venv/bin/python benchmarks/backlash.py --servos 60
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.backlash.measure import backlash
from support.strokes import stroked


def main() -> None:
    """Draw, stroke, measure, count."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--servos", type=int, default=60)
    servos = options.parse_args().servos
    kept: dict[str, list[tuple[bool, float, float]]] = {}

    def keep(name: str, found: Interval | None, truth: float) -> None:
        if found is not None:
            holds = found.low <= truth <= found.high
            half = (found.high - found.low) / 2
            kept.setdefault(name, []).append((holds, found.value - truth, half))

    for seed in range(servos):
        rng = np.random.default_rng(1000 + seed)
        degrees, zone = float(rng.uniform(0, 2)), int(rng.integers(0, 6))
        recording, true = stroked(seed, degrees, zone)
        found = backlash(recording)["bench"]
        keep("backlash", found.backlash_rad, true.backlash_rad)
        assert found.dead_zone_rad is not None
        seen = "dead zone, seen" if found.dead_zone_rad.value > 0 else "dead zone, bounded"
        keep(seen, found.dead_zone_rad, zone * true.count_rad)
        for own in found.gains:
            if own.p_gain == 8 or found.dead_zone_rad.value == 0:
                stiffness = true.torque_nm * true.duty_per_rad * own.p_gain
                width = 2 * true.friction_nm / stiffness
                keep(f"hysteresis, P {own.p_gain:g}", own.hysteresis_rad, width)
    print(f"{'':20}   n  held   bias    sd  half interval [mrad]")
    for name, rows in kept.items():
        holds, error, half = np.array(rows, float).T
        print(
            f"{name:20} {len(rows):3d} {100 * holds.mean():4.0f} % {1e3 * error.mean():6.2f} "
            f"{1e3 * error.std():5.2f} {1e3 * np.median(half):5.2f}"
        )


if __name__ == "__main__":
    main()
