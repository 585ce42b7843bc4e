"""`compare`: servo models and calibrations on the same readings, as a table and a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.common.errors import InputError


@dataclass(frozen=True)
class Compare:
    """Which model moves like the servo? Free run of each on the same recording, per joint.

    Every model predicts readings: with the age that the bus gives them, and the offset of this
    recording. A calibration of a sweep on the same bus gives the poll where a recording of another
    motion does not show it.

    Example: pupper-sysid compare recordings/playback.csv --models servo/ calibrated.yaml
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings to compare on; by default the newest in recordings/."""
    models: Annotated[tuple[str, ...], tyro.conf.arg(metavar="MODEL [MODEL ...]")] = ()
    """Folders of fit-servo, calibration files, servo cards (names or files), or presets (paper,
    release)."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    readings: Literal["auto", "fresh", "all"] = "auto"
    """Which readings count: fresh ones at the time they were taken, all rows as logged, or what
    suits the recording."""
    plot: Path = Path("compare.png")
    """Picture to draw, PNG or SVG."""
    force: bool = False
    """Replace the picture if it exists."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the bootstrap."""

    def run(self) -> None:
        """Compare, print, draw."""
        from pupper_sysid.common.figure_style import refuse_picture, save
        from pupper_sysid.sysid.compare.compare import compare

        if not self.models:
            raise InputError(
                "Nothing to compare: name models, such as `--models servo/ calibrated.yaml`."
            )
        refuse_picture(self.plot, self.force)
        recordings = terminal.load_all(self.recordings)
        joints = terminal.pick_joints(recordings, self.joints)
        found = compare(recordings, self.models, joints, self.readings, self.seed)
        save(found.plot(), self.plot, self.force)
        if self.json:
            terminal.print_json(found.to_dict() | {"written": str(self.plot)})
            return
        shown = terminal.table(
            "RMS error in free run, mrad", "joint", *found.models, "persistence", "repeatability"
        )
        for joint in joints:
            errors = [m.joints[joint].rmse_free_run_rad for m in found.models.values()]
            errors += [found.persistence_rmse_rad[joint], found.repeatability_rad[joint]]
            shown.add_row(joint, *map(terminal.ms, errors))
        if len(joints) > 1:
            means = (terminal.ms(m.mean.rmse_free_run_rad) for m in found.models.values())
            shown.add_row("mean", *means, style="bold")
        terminal.out.print(shown)
        for title in ("held", "raw", "one_step"):
            means = {n: getattr(m.mean, f"rmse_{title}_rad") for n, m in found.models.items()}
            text = ", ".join(f"{name} {terminal.ms(value)}" for name, value in means.items())
            terminal.out.print(f"Mean, {title.replace('_', ' ')}: {text}", soft_wrap=True)
        shifted = {name: m.offset_rad for name, m in found.models.items() if m.offset_rad}
        offsets = terminal.table("Offset of this recording, mrad", "joint", *shifted)
        for joint in joints:
            offsets.add_row(joint, *(terminal.ms(own[joint]) for own in shifted.values()))
        terminal.out.print()
        terminal.out.print(offsets)
        for sentence in found.reading_notes():
            terminal.out.print(sentence, soft_wrap=True)
        terminal.warn(found.notes)
        terminal.err.print(f"Wrote {self.plot}.", soft_wrap=True)
