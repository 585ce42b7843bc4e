"""`bode`: the frequency response of each joint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.text import Text

from pupper_sysid.cli import terminal


@dataclass(frozen=True)
class Bode:
    """Frequency response per joint: gain, phase, bandwidth, fitted transfer function.

    Example: pupper-sysid bode recordings/sweep.csv --plot bode.png
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    plot: Path | None = None
    """Also draw the Bode plot into this PNG or SVG file."""
    force: bool = False
    """Replace the plot if it exists."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the bootstrap."""

    def run(self) -> None:
        """Measure, draw and print."""
        from pupper_sysid.sysid.lag.frequency_response import frequency_response

        if self.plot:
            from pupper_sysid.common.figure_style import refuse_picture

            refuse_picture(self.plot, self.force)
        recordings = terminal.load_all(self.recordings)
        joints = terminal.pick_joints(recordings, self.joints)
        found = frequency_response(recordings, joints, self.seed)
        if self.plot:
            from pupper_sysid.common.figure_style import save

            save(found.plot(), self.plot, self.force)
        if self.json:
            terminal.print_json(found)
            return
        for joint, response in found.items():
            terminal.out.print(Text(joint, "bold"))
            terminal.out.print(str(response), soft_wrap=True)
            terminal.warn(response.warnings)
        if self.plot:
            terminal.err.print(f"Wrote {self.plot}.", soft_wrap=True)
