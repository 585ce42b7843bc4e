"""`report` and `samples`: findings as one page, and sample files to try everything with."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from pathlib import Path

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.common import OfRecordings
from pupper_sysid.common.files import refuse_overwrite, resolved, write_bytes


@dataclass(frozen=True)
class Report(OfRecordings):
    """Write one HTML page that opens anywhere, with its figures as PNG and SVG, its tables as CSV.

    Example: pupper-sysid report recordings/sweep.csv --out reports/sweep

    Example: pupper-sysid report --open
    """

    out: Path | None = None
    """Folder to write; by default reports/ and the first recording's name."""
    calibration: Path | None = None
    """Calibration made from these recordings: it is shown, and only joints under load are fitted
    again."""
    servo: tuple[str, ...] = ()
    """Servo models of fit-servo to show on these recordings, beside the calibration."""
    open: bool = False
    """Show it in the browser when it is written."""
    force: bool = False
    """Replace files of a report that is there already."""

    def run(self) -> None:
        """Examine, measure, calibrate, write."""
        # imported here: drawing and python-control take a second, which --help should not
        from pupper_sysid.servo_models.calibration.calibration import load_calibration
        from pupper_sysid.sysid.report.report import PAGE, write_report

        recordings = terminal.load_all(self.recordings)
        folder = self.out or Path("reports") / recordings[0].name
        refuse_overwrite(folder / PAGE, self.force)
        calibration = load_calibration(self.calibration) if self.calibration else None
        with terminal.share_progress("report") as advance:
            written = write_report(
                recordings, folder, joints=self.joints, calibration=calibration, models=self.servo,
                seed=self.seed, workers=2, force=self.force, progress=advance,
            )  # fmt: skip
        if self.json:
            kinds = ("figures", "drawings", "tables")
            named = {name: getattr(written, name) for name in kinds}
            terminal.print_json({"report": written.path} | named)
        else:
            hint = "" if self.open else " Open it in a browser, or add --open."
            terminal.err.print(f"Wrote {written.path}.{hint}")
        if self.open and not webbrowser.open(resolved(written.path).as_uri()):
            terminal.warn(f"No browser could be started here; open {written.path} yourself.")


@dataclass(frozen=True)
class Samples:
    """Copy the samples into a folder: recordings with their truth, a calibration, policies, an arm.

    README.md beside them says how each was made.

    Example: pupper-sysid samples

    Example: pupper-sysid delay samples/sweep.csv
    """

    out: tyro.conf.Positional[Path] = Path("samples")
    """Folder to write; made if missing."""
    force: bool = False
    """Replace files that exist."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Copy the files, then name them."""
        from pupper_sysid.data import SAMPLES

        sources = [p for p in sorted(SAMPLES.rglob("*")) if p.is_file()]
        files = {self.out / p.relative_to(SAMPLES): p for p in sources}
        for target in files:  # before the first is written
            refuse_overwrite(target, self.force)
        for target, source in files.items():
            write_bytes(target, source.read_bytes(), self.force)
        if self.json:
            terminal.print_json({"files": list(files)})
            return
        for target in files:
            terminal.out.print(f"  {target}")
        terminal.err.print(
            f"Wrote {len(files)} files. Next: "
            + terminal.command("pupper-sysid", "delay", self.out / "sweep.csv")
        )
