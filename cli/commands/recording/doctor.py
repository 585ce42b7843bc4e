"""`doctor`: whether a recording is usable."""

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

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings to examine, pooled per joint; by default the newest in recordings/."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the shuffles behind the z-score."""

    def run(self) -> None:
        """Examine and print."""
        from pupper_sysid.sysid.doctor.examination import examine
        from pupper_sysid.sysid.doctor.findings import USE, Finding, shared

        recordings = terminal.load_all(self.recordings)
        found = examine(recordings, seed=self.seed)
        if self.json:
            terminal.print_json(found)
            return
        title = found.recording if len(recordings) < 4 else f"{len(recordings)} recordings"
        shown = terminal.table(
            title, "joint", "verdict", "loop ms", "jitter ms", "fresh %", "poll ms",
            "loss", "step mrad", "offset mrad",
        )  # fmt: skip
        for name, j in found.items():
            shown.add_row(
                name, j.verdict, terminal.ms(j.loop_period_s, 2), terminal.ms(j.jitter_s, 2),
                terminal.number(100 * j.fresh_fraction, 0), terminal.ms(j.poll_period_s, 2),
                terminal.number(j.loss), terminal.ms(j.quantum_rad, 3),
                terminal.ms(j.reading_minus_command_rad),
            )  # fmt: skip
        terminal.out.print(shown)
        terminal.out.print()
        nothing = (Finding("nothing_wrong", USE),)
        for joints, text in shared({name: j.findings or nothing for name, j in found.items()}):
            terminal.out.print(Text.assemble((joints, "bold"), f": {text}"), soft_wrap=True)
        for text in found.advice:
            terminal.out.print(f"\n{text}", soft_wrap=True)
