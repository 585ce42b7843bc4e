"""`report`: everything about some recordings as one page, with its figures and tables."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite

if TYPE_CHECKING:
    from pupper_sysid.servo_models.calibration.calibration import Calibration
    from pupper_sysid.sysid.recordings.recording import Recording


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
    """Calibration made from these recordings: its numbers and its seed are used."""
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
        from pupper_sysid.sysid.doctor.examination import examine
        from pupper_sysid.sysid.identify import calibrate as calibration
        from pupper_sysid.sysid.identify.calibration_file import preset_parameters, to_calibration
        from pupper_sysid.sysid.lag.frequency_response import frequency_response
        from pupper_sysid.sysid.report.report import write_report

        recordings = terminal.load_all(self.recordings)
        joints = terminal.pick_joints(recordings, self.joints)
        folder = self.out or Path("reports") / recordings[0].name
        refuse_overwrite(folder / "report.html", self.force)  # before the work, not after it
        made = self._stored(recordings, joints)
        seed = self.seed if made is None or made.seed is None else made.seed
        with terminal.progress("calibrating", len(joints)) as advance:
            results = calibration.calibrate(
                recordings, joints, seed, preset_parameters(), progress=advance
            )
        with terminal.progress("examining", len(recordings) + len(joints)) as advance:
            examinations, responses = [], {}
            for recording in recordings:
                found = examine(recording, seed)
                examinations.append((recording.name, found))
                advance(recording.name)
            for joint, result in results.items():
                if result.budget.by_frequency:
                    trials = calibration.joint_trials(recordings, joint)
                    rng = calibration.joint_rng(seed, joint)
                    responses[joint] = frequency_response(joint, trials, rng, result.budget.lattice)
                advance(joint)
        made = made or to_calibration(results, recordings, seed)
        more = []
        if self.servo:
            from pupper_sysid.sysid.report.servo_section import servo_section
            from pupper_sysid.sysid.servo_fit.compare import compare

            more.append(servo_section(compare(recordings, self.servo, joints, seed=seed)))
        written = write_report(
            folder, recordings, results, made, examinations, responses, self.force, more
        )
        if self.json:
            terminal.print_json(
                {
                    "report": str(written.path),
                    "figures": [str(p) for p in written.figures],
                    "drawings": [str(p) for p in written.drawings],
                    "tables": [str(p) for p in written.tables],
                }
            )
        else:
            hint = "" if self.open else " Open it in a browser, or add --open."
            terminal.err.print(f"Wrote {written.path}.{hint}", soft_wrap=True)
        if self.open and not webbrowser.open(written.path.resolve().as_uri()):
            terminal.warn([f"No browser could be started here; open {written.path} yourself."])

    def _stored(self, recordings: list[Recording], joints: list[str]) -> Calibration | None:
        """The calibration given, if it belongs to the recordings."""
        if self.calibration is None:
            return None
        from pupper_sysid.servo_models.calibration.calibration import load_calibration

        stored = load_calibration(self.calibration)
        if {i.sha256 for i in stored.inputs} != {r.sha256 for r in recordings}:
            made_from = ", ".join(i.name for i in stored.inputs) or "no recording"
            raise InputError(
                f"{self.calibration} was made from {made_from}, which is not, byte for byte, what "
                f"you gave ({', '.join(r.name for r in recordings)}). Give its own recordings, or "
                "leave --calibration out."
            )
        for joint in joints:
            stored.joint(joint)
        return stored
