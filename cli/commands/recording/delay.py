"""`delay`: the lag of each joint, and its parts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.common.joints import share_sentences

if TYPE_CHECKING:
    from pupper_sysid.common.interval import Interval
    from pupper_sysid.sysid.fit.dead_time import LagBudgets


@dataclass(frozen=True)
class Delay:
    """Measure each joint's lag, and split it into bus, sensor and servo.

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
        from pupper_sysid.sysid.fit.dead_time import lag

        recordings = terminal.load_all(self.recordings)
        joints = terminal.pick_joints(recordings, self.joints)
        with terminal.progress("measuring", len(joints)) as advance:
            found = lag(recordings, joints, self.seed, workers=2, progress=advance)
        if self.json:
            terminal.print_json(found)
            return
        budget = terminal.table(
            "Lag budget, ms: raw = stale readings + command hold + servo lag", "joint", "raw",
            "stale", "hold", "servo", "90 %", "of it dead time", "90 %",
        )  # fmt: skip
        for name, b in found.items():
            dead = b.dead_time_s
            assert dead is not None
            budget.add_row(
                name, terminal.ms(b.raw_lag_s.value), terminal.ms(b.stale_lag_s),
                terminal.ms(b.command_hold_s), terminal.ms(b.lag_s.value), _ends(b.lag_s),
                terminal.ms(dead.value), _ends(dead),
            )  # fmt: skip
        terminal.out.print(budget)
        terminal.out.print(
            "Only the dead time is the servo's own; the lag moves with gain, amplitude and load."
        )
        ranges = {name: [f"servo lag is the {b.lag_range}; its table by frequency has the lag of "
                         "a motion at each."] for name, b in found.items()
                  if b.lag_range.startswith("mean")}  # fmt: skip
        for names, text in share_sentences(ranges):
            terminal.out.print(f"{names}: {text}", soft_wrap=True)
        self._print_frequencies(found)
        first = next(iter(found.values()))
        shown = terminal.table(f"Estimators on {first.joint}", "estimator", "lag ms")
        for name, value in first.estimators_s.items():
            shown.add_row(name, terminal.ms(value))
        terminal.out.print()
        terminal.out.print(shown)
        by_joint = {n: [w.removeprefix(f"{n}: ") for w in b.warnings] for n, b in found.items()}
        terminal.warn(f"{names}: {text}" for names, text in share_sentences(by_joint))

    def _print_frequencies(self, found: LagBudgets) -> None:
        shown = terminal.table(
            "Per frequency, fresh readings", "joint", "Hz", "gain", "phase °", "lag ms",
            "90 %", "raw lag ms", "raw gain",
        )  # fmt: skip
        for name, b in found.items():
            for f in b.by_frequency:
                shown.add_row(
                    name, terminal.number(f.frequency_hz), terminal.number(f.gain),
                    terminal.number(f.phase_deg, 0), terminal.ms(f.lag_s.value), _ends(f.lag_s),
                    terminal.ms(f.raw_lag_s), terminal.number(f.raw_gain),
                )  # fmt: skip
        if shown.row_count:
            terminal.out.print()
            terminal.out.print(shown)


def _ends(interval: Interval) -> str:
    # without spaces, at which a narrow table would break it
    return f"{terminal.ms(interval.low)}…{terminal.ms(interval.high)}"
