"""`sindy`: a sparse equation of motion per joint, with units, beside DelayedPD's error."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from rich.text import Text

from pupper_sysid.cli import terminal

if TYPE_CHECKING:
    from pupper_sysid.sysid.sparse import Equations


@dataclass(frozen=True)
class Sindy:
    """A short equation of motion per joint, with units (SINDy, refined by output error).

    Example: pupper-sysid sindy recordings/sweep.csv --joints LF_thigh
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the bootstrap and of the models' global starts."""

    def run(self) -> None:
        """Find the equations and print them."""
        from pupper_sysid.sysid.sparse import sparse_equations

        started = time.perf_counter()
        recordings = terminal.load_all(self.recordings)
        joints = terminal.pick_joints(recordings, self.joints)
        with terminal.progress("finding equations", len(joints)) as advance:
            results = sparse_equations(recordings, joints, self.seed, workers=2, progress=advance)
        if self.json:
            terminal.print_json(results)
            return
        self._print(results)
        terminal.err.print(f"Took {time.perf_counter() - started:.1f} s.")

    def _print(self, results: Equations) -> None:
        for name, r in results.items():
            terminal.out.print(Text.assemble((name, "bold"), f": {r.equation}"), soft_wrap=True)
            for line in r.explanation():
                terminal.out.print(f"  - {line}", soft_wrap=True)
            terminal.out.print()
        shown = terminal.table(
            "Free-run error, mrad", "joint", "equation, fresh", "all rows", "unseen Hz",
            "DelayedPD, fresh", "unseen Hz", "structures tried",
        )  # fmt: skip
        for name, r in results.items():
            shown.add_row(
                name, terminal.ms(r.scores.rmse_fresh_rad), terminal.ms(r.scores.rmse_held_rad),
                terminal.ms(r.scores.rmse_unseen_rad),
                terminal.ms(r.delayed_pd.rmse_fresh_rad),
                terminal.ms(r.delayed_pd.rmse_unseen_rad), str(len(r.candidates)),
            )  # fmt: skip
        terminal.out.print(shown)
        terminal.out.print(
            "\nq: joint angle, u: command, e: error. Per unit of inertia; each reading is compared "
            "with the motion at the time it was measured, none is fed back.",
            soft_wrap=True,
        )
        for r in results.values():
            terminal.warn(r.warnings)
