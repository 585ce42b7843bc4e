"""`backlash`: hysteresis, dead zone and play of the gears from slow strokes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.common.interval import Interval


@dataclass(frozen=True)
class Backlash:
    """Measure hysteresis, dead zone and backlash from slow strokes up and down.

    Record them with `sweep --load pendulum:0.1kg@0.10m --gains 8,16,32 --kind reversal`.

    Example: pupper-sysid backlash recordings/reversal.csv
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    joints: str = "all"
    """Names, several with commas, or all."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the bootstrap."""

    def run(self) -> None:
        """Measure and print."""
        from pupper_sysid.sysid.backlash import backlash

        recordings = terminal.load_all(self.recordings)
        found = backlash(recordings, terminal.pick_joints(recordings, self.joints), self.seed)
        if self.json:
            terminal.print_json(found)
            return
        shown = terminal.table(
            "Width between strokes up and down, 90 % intervals",
            "joint", "P gain", "hysteresis °", "lag ms", "strokes",
        )  # fmt: skip
        for joint, one in found.items():
            for row in one.gains:
                shown.add_row(
                    joint, terminal.number(row.p_gain, 0), _degrees(row.hysteresis_rad),
                    terminal.ms(row.lag_s.value, 0), str(row.strokes),
                )  # fmt: skip
        terminal.out.print(shown)
        for joint, one in found.items():
            for name, value in (("dead zone", one.dead_zone_rad), ("backlash", one.backlash_rad)):
                said = "not determined" if value is None else f"{_degrees(value)}°"
                terminal.out.print(f"{joint}: {name} {said}", soft_wrap=True)
            for note in one.notes:
                terminal.out.print(f"  {note}", soft_wrap=True)


def _degrees(value: Interval) -> str:
    """Value and interval in degrees."""
    best, low, high = np.degrees([value.value, value.low, value.high])
    return f"{best:.2f} ({low:.2f} to {high:.2f})"
