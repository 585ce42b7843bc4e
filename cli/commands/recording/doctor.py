"""`doctor`: check whether a recording is usable."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.text import Text

from pupper_sysid.cli import terminal


@dataclass(frozen=True)
class Doctor:
    """Check whether a recording is usable, and what is wrong with it.

    Example: pupper-sysid doctor recordings/sweep.csv
    """

    recording: tyro.conf.Positional[Path | None] = None
    """Recording to examine; by default the newest in recordings/."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the shuffles behind the z-score."""

    def run(self) -> None:
        """Examine and print."""
        import numpy as np

        from pupper_sysid.sysid.doctor import examination as doctor

        (recording,) = terminal.load_all([self.recording] if self.recording else [])
        found = doctor.examine(recording, np.random.default_rng(self.seed))
        if self.json:
            terminal.print_json(doctor.to_json(found))
            return
        shown = terminal.table(
            recording.name, "joint", "verdict", "loop ms", "jitter ms", "fresh %", "poll ms",
            "loss", "count mrad", "offset mrad",
        )  # fmt: skip
        for name, j in found.joints.items():
            shown.add_row(
                name, j.verdict, terminal.number(j.loop_period_ms),
                terminal.number(j.jitter_ms), terminal.number(100 * j.fresh_fraction, 0),
                terminal.number(j.poll_period_ms), terminal.number(j.loss),
                terminal.ms(j.quantum_rad, 3), terminal.ms(j.offset_rad),
            )  # fmt: skip
        terminal.out.print(shown)
        for name, j in found.joints.items():
            terminal.out.print(Text.assemble("\n", (name, "bold"), f": {j.verdict}"))
            for reason in j.reasons:
                terminal.out.print(f"  - {reason}", soft_wrap=True)
