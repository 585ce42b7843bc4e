"""`report`: everything about some recordings as one page, with its figures and tables."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from pathlib import Path

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.common.files import refuse_overwrite, resolved


@dataclass(frozen=True)
class Report:
    """Write one HTML page that opens anywhere, with its figures as PNG and SVG, its tables as CSV.

    Example: pupper-sysid report recordings/sweep.csv --out reports/sweep

    Example: pupper-sysid report --open
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    out: Path | None = None
    """Folder to write; by default reports/ and the first recording's name."""
    calibration: Path | None = None
    """Calibration made from these recordings: it is shown, and nothing is fitted again."""
    servo: tuple[str, ...] = ()
    """Servo models of fit-servo to show on these recordings, beside the calibration."""
    open: bool = False
    """Show it in the browser when it is written."""
    force: bool = False
    """Replace files of a report that is there already."""
    json: bool = False
    """Print one JSON object that names the files written, and nothing else."""
    seed: int = 0
    """Seed of the bootstrap and of the models' global starts."""

    def run(self) -> None:
        """Examine, measure, calibrate, write."""
        # here, because drawing and python-control take a second that --help should not
        from pupper_sysid.servo_models.calibration.calibration import load_calibration
        from pupper_sysid.sysid.report.report import PAGE, write_report

        recordings = terminal.load_all(self.recordings)
        joints = terminal.pick_joints(recordings, self.joints)
        folder = self.out or Path("reports") / recordings[0].name
        refuse_overwrite(folder / PAGE, self.force)
        calibration = load_calibration(self.calibration) if self.calibration else None
        with terminal.share_progress("report") as advance:
            written = write_report(
                recordings, folder, joints=joints, calibration=calibration, models=self.servo,
                seed=self.seed, workers=2, force=self.force, progress=advance,
            )  # fmt: skip
        if self.json:
            terminal.print_json(
                {
                    "report": written.path,
                    "figures": written.figures,
                    "drawings": written.drawings,
                    "tables": written.tables,
                }
            )
        else:
            hint = "" if self.open else " Open it in a browser, or add --open."
            terminal.err.print(f"Wrote {written.path}.{hint}", soft_wrap=True)
        if self.open and not webbrowser.open(resolved(written.path).as_uri()):
            terminal.warn([f"No browser could be started here; open {written.path} yourself."])
