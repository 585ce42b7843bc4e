"""What a measured servo is worth: policies trained with one actuator each, on the measured robot.

    .venv/bin/python benchmarks/actuator_worth.py RUN [RUN ...] --episodes 100

All walk the same robots: servos of the sample calibration, drawn within its intervals, with its
jitter and its held readings. Rows of one actuator are its seeds.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from shared import print_rows  # isort: skip

import torch
import tyro

from pupper_sysid.cli.policy_choice import policy_at
from pupper_sysid.policies.evaluation.evaluate import BATTERY, evaluate, share_interval, table
from pupper_sysid.policies.walks.together import Walker
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

CALIBRATED = "data/samples/calibrated.yaml"
_PUSHED = next(case for case in BATTERY if case.name == "pushes of 1.2 m/s")
_HEAD = (
    "trained with", "policy", "fell %", "instant: forward mm/s", "sideways mm/s", "turn mrad/s",
    "stride: forward", "sideways", "turn", "forward, % of commanded", "turn left, right, %",
    "pushed by 1.2 m/s: fell %",
)  # fmt: skip


def main(
    policies: tyro.conf.Positional[tuple[Path, ...]],
    episodes: int = 100,
    pushed: int = 0,
    threads: int = 0,
) -> None:
    """Print the table of the policies; `pushed` episodes have pushes, by default as many."""
    pushed = pushed or episodes
    torch.set_num_threads(1)
    servos = servo_ranges(CALIBRATED, "held")

    def rows() -> Iterator[list[str]]:
        trot: dict = {}
        for path in policies:
            policy = policy_at(path)[0]

            def robots(case, walker: Walker, first: bool = not trot) -> int:
                if walker == "policy" or (walker == "trot" and first):
                    return {"random": episodes, "push": pushed}.get(case.group, 16)
                return 1

            found = evaluate(
                policy, Walking(knee=policy.contract.knee), servos, (*table((), ()), _PUSHED),
                robots, 0, threads,
            )  # fmt: skip
            by_name = {row.name: row for row in found.conditions}
            walked = {k: v.policy for k, v in by_name.items()}
            yield _cells(Path(policy.contract.actuator).name, path.name, walked, pushed)
            trot = trot or {k: v.trot for k, v in by_name.items()}
        yield _cells("none", "open-loop trot with a clock", trot, pushed)

    print_rows(_HEAD, rows())


def _cells(trained: str, name: str, rows: dict, episodes: int) -> list[str]:
    figures = next(iter(rows.values()))
    cells = [trained, name, f"{100 * figures.fall_rate:.0f}"]
    for kind in ("mae", "stride_mae"):
        for axis in ("vx_m_s", "vy_m_s", "yaw_rad_s"):
            error = figures.intervals[f"{kind}_{axis}"]
            cells.append(f"{1e3 * error.value:.0f} ± {1e3 * (error.high - error.low) / 2:.0f}")
    share = {way: 100 * rows[way].speed_share for way in ("forward", "turn left", "turn right")}
    cells += [f"{share['forward']:.0f}", f"{share['turn left']:.0f}, {share['turn right']:.0f}"]
    falls = share_interval(round(rows[_PUSHED.name].fall_rate * episodes), episodes)
    return [*cells, f"{100 * falls.value:.0f} ({100 * falls.low:.0f}–{100 * falls.high:.0f})"]


if __name__ == "__main__":
    tyro.cli(main)
