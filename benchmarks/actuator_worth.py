"""What a measured servo is worth: policies trained with one actuator each, on the measured robot.

    .venv/bin/python benchmarks/actuator_worth.py RUN [RUN ...] --episodes 100

All walk the same robots: servos of the sample calibration, drawn within its intervals, with its
jitter and its held readings. Rows of one actuator are its seeds.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import torch

from pupper_sysid.cli.policy_choice import policy_at
from pupper_sysid.common.interval import Interval
from pupper_sysid.policies.evaluation.evaluate import BATTERY, evaluate, table
from pupper_sysid.policies.evaluation.figures import share_interval
from pupper_sysid.policies.walks.conditions import Walker
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

CALIBRATED = "data/samples/calibrated.yaml"
_PUSHED = next(case for case in BATTERY if case.name == "pushes of 1.2 m/s")
_HEAD = (
    "trained with", "policy", "fell %", "instant: forward mm/s", "sideways mm/s", "turn mrad/s",
    "stride: forward", "sideways", "turn", "forward, % of commanded", "turn left, right, %",
    "pushed by 1.2 m/s: fell %",
)  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policies", type=Path, nargs="+")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--pushed", type=int, help="episodes with pushes; by default as many")
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    pushed = options.pushed or options.episodes
    torch.set_num_threads(1)
    print("|", " | ".join(_HEAD), "|")
    print("|---" * len(_HEAD) + "|")
    servos = servo_ranges(CALIBRATED, "held")
    trot = None
    for path in options.policies:
        policy = policy_at(path)[0]

        def robots(case, walker: Walker, first: bool = trot is None) -> int:
            if walker == "policy" or (walker == "trot" and first):
                of_group = {"random": options.episodes, "push": pushed}
                return of_group.get(case.group, 16)
            return 1

        found = evaluate(
            policy, Walking(knee=policy.contract.knee), servos, (*table((), ()), _PUSHED),
            robots, 0, options.threads,
        )  # fmt: skip
        rows = {row.name: row for row in found.conditions}
        trained = Path(policy.contract.actuator).name
        walked = {k: v.policy for k, v in rows.items()}
        print(_line(trained, f"{path.name}", walked, pushed), flush=True)
        trot = trot or {k: v.trot for k, v in rows.items()}
    if trot:
        print(_line("none", "open-loop trot with a clock", trot, pushed))


def _line(trained: str, name: str, rows: dict, episodes: int) -> str:
    figures = next(iter(rows.values()))
    intervals = figures.intervals
    cells = [trained, name, f"{100 * figures.fall_rate:.0f}"]
    for kind in ("mae", "stride_mae"):
        for axis in ("vx_m_s", "vy_m_s", "yaw_rad_s"):
            cells.append(_shown(getattr(intervals, f"{kind}_{axis}")))
    share = {way: 100 * rows[way].speed_share for way in ("forward", "turn left", "turn right")}
    cells += [f"{share['forward']:.0f}", f"{share['turn left']:.0f}, {share['turn right']:.0f}"]
    pushed = share_interval(round(rows[_PUSHED.name].fall_rate * episodes), episodes)
    cells.append(f"{100 * pushed.value:.0f} ({100 * pushed.low:.0f}–{100 * pushed.high:.0f})")
    return f"| {' | '.join(cells)} |"


def _shown(value: Interval) -> str:
    return f"{1e3 * value.value:.0f} ± {1e3 * (value.high - value.low) / 2:.0f}"


if __name__ == "__main__":
    main()
