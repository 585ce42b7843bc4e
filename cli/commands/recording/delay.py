"""`delay`: lag per joint, split into bus, sensor and servo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pupper_sysid.cli import terminal

if TYPE_CHECKING:
    from pupper_sysid.sysid.lag.lag_budget import LagBudget


@dataclass(frozen=True)
class Delay:
    """Split the lag of each joint into the bus's, the sensor's and the servo's share.

    Example: pupper-sysid delay recordings/sweep.csv --joints LF_thigh
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the bootstrap and of the model's global start."""

    def run(self) -> None:
        """Measure and print."""
        from pupper_sysid.sysid.identify import calibrate as calibration
        from pupper_sysid.sysid.report.json_objects import delay_json

        recordings = terminal.load_all(self.recordings)
        joints = terminal.pick_joints(recordings, self.joints)
        with terminal.progress("measuring", len(joints)) as advance:
            found = calibration.dead_times(recordings, joints, self.seed, progress=advance)
        if self.json:
            terminal.print_json(delay_json(found))
            return
        budget = terminal.table(
            "Lag budget, ms: naive = feedback age + command hold + servo lag", "joint", "naive",
            "feedback age", "command hold", "servo lag", "90 % interval", "of it dead time",
            "90 % interval",
        )  # fmt: skip
        for name, f in found.items():
            b, dead = f.budget, f.dead_time
            budget.add_row(
                name, terminal.ms(b.naive.value), terminal.ms(b.feedback_age_s),
                terminal.ms(b.command_hold_s), terminal.ms(b.lag.value),
                f"{terminal.ms(b.lag.low)} … {terminal.ms(b.lag.high)}",
                terminal.ms(dead.value), f"{terminal.ms(dead.low)} … {terminal.ms(dead.high)}",
            )  # fmt: skip
        terminal.out.print(budget)
        self._print_frequencies([f.budget for f in found.values()])
        first = next(iter(found.values())).budget
        shown = terminal.table(f"Estimators on {first.joint}", "estimator", "lag ms")
        for name, value in first.estimators.items():
            shown.add_row(name, terminal.ms(value))
        terminal.out.print()
        terminal.out.print(shown)
        for f in found.values():
            terminal.warn(f.budget.warnings)

    def _print_frequencies(self, budgets: list[LagBudget]) -> None:
        shown = terminal.table(
            "Per frequency, fresh readings", "joint", "Hz", "gain", "phase °", "lag ms",
            "90 % interval", "naive lag ms", "naive gain",
        )  # fmt: skip
        for b in budgets:
            for f in b.by_frequency:
                shown.add_row(
                    b.joint, terminal.number(f.frequency_hz), terminal.number(f.gain),
                    terminal.number(f.phase_deg, 0), terminal.ms(f.lag.value),
                    f"{terminal.ms(f.lag.low)} … {terminal.ms(f.lag.high)}",
                    terminal.ms(f.naive_lag_s), terminal.number(f.naive_gain),
                )  # fmt: skip
        if shown.row_count:
            terminal.out.print()
            terminal.out.print(shown)
