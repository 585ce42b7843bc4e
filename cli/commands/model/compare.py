"""`compare` and `compare-truth`: models on the same readings, a calibration beside the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.common import OfRecordings
from pupper_sysid.common.errors import InputError

_UNITS = {"_rad_s": ("rad/s", 1.0, 2), "_rad": ("mrad", 1e3, 2), "_s": ("ms", 1e3, 2)}


@dataclass(frozen=True)
class Compare(OfRecordings):
    """Which model moves like the servo? Free run of each on the same recording, per joint.

    Every model predicts readings: with the age that the bus gives them, and the offset of this
    recording. A calibration of a sweep on the same bus gives the poll where a recording of another
    motion does not show it.

    Example: pupper-sysid compare recordings/playback.csv --models servo/ calibrated.yaml
    """

    models: Annotated[tuple[str, ...], tyro.conf.arg(metavar="MODEL [MODEL ...]")] = ()
    """Folders of fit-servo, calibration files, servo cards (names or files), or presets (paper,
    release)."""
    readings: Literal["auto", "fresh", "all"] = "auto"
    """Which readings count: fresh ones at the time they were taken, all rows as logged, or what
    suits the recording."""
    plot: Path = Path("compare.png")
    """Picture to draw, PNG or SVG."""
    force: bool = False
    """Replace the picture if it exists."""

    def run(self) -> None:
        """Compare, print, draw."""
        from pupper_sysid.common.figure_style import refuse_picture, save
        from pupper_sysid.sysid.compare.compare import compare
        from pupper_sysid.sysid.report.tables import comparison_tables

        if not self.models:
            raise InputError(
                "Nothing to compare: name models, such as `--models servo/ calibrated.yaml`."
            )
        refuse_picture(self.plot, self.force)
        recordings, joints = self.load()
        result = compare(recordings, self.models, joints, self.readings, self.seed)
        save(result.plot(), self.plot, self.force)
        if self.json:
            terminal.print_json(result.to_dict() | {"written": str(self.plot)})
            return
        terminal.print_tables(*comparison_tables(result))
        for sentence in result.reading_notes():
            terminal.out.print(sentence)
        terminal.warn(*result.notes)
        terminal.err.print(f"Wrote {self.plot}.")


@dataclass(frozen=True)
class CompareTruth:
    """Each calibrated number beside the true one of an emulated robot.

    `sweep --truth` writes the truth beside the recording, `emulate ... --truth FILE` that of a
    robot behind a real protocol. Where the interval holds it, the last column says yes; of many
    robots that should be nine in ten.

    Example: pupper-sysid compare-truth sweep.csv calibrated.yaml
    """

    recording: tyro.conf.Positional[Path]
    """Recording of an emulated robot."""
    calibration: tyro.conf.Positional[Path | None] = None
    """Calibration file; by default the recording is calibrated now."""
    truth: Path | None = None
    """File of the true parameters; by default the .truth.yaml beside the recording."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the calibration, where none is given."""

    def run(self) -> None:
        """Calibrate if need be, compare, print."""
        from pupper_sysid.servo_models.calibration.calibration import load_calibration
        from pupper_sysid.servo_models.calibration.quantity import unit_of, words_of
        from pupper_sysid.sysid.compare.truth import compared_with_truth, read_truth
        from pupper_sysid.sysid.fit.calibrate import calibrate

        truth = read_truth(self.recording, self.truth)  # before the work, not after it
        (recording,) = terminal.load_all([self.recording])
        joints = terminal.pick_joints([recording], self.joints)
        if self.calibration:
            fitted = load_calibration(self.calibration)
        else:
            with terminal.progress("calibrating", len(joints)) as advance:
                fitted = calibrate(
                    recording, joints, self.seed, workers=2, progress=advance
                ).calibration
        rows = compared_with_truth(recording, truth, fitted, joints)
        if self.json:
            terminal.print_json(rows)
            return
        table = terminal.table(
            "Found and true", "joint", "quantity", "found", "90 % interval", "truth", "identified",
            "held",
        )  # fmt: skip
        for row in rows:
            end = next((end for end in _UNITS if row.quantity.endswith(end)), "")
            places = 3 if abs(row.truth) < 1 else max(0, 3 - len(f"{abs(row.truth):.0f}"))
            unit, factor, digits = _UNITS.get(end, (unit_of(row.quantity), 1.0, places))
            low, high = (
                terminal.number(factor * x, digits) for x in (row.found.low, row.found.high)
            )
            table.add_row(
                row.joint, f"{words_of(row.quantity)}, {unit}".removesuffix(", 1"),
                terminal.number(factor * row.found.value, digits), f"{low}…{high}",
                terminal.number(factor * row.truth, digits), row.identified,
                {True: "yes", False: "no", None: "–"}[row.held],
            )  # fmt: skip
        terminal.out.print(table)
        known_rows = [row for row in rows if row.held is not None and row.identified != "no"]
        held = sum(bool(row.held) for row in known_rows)
        terminal.out.print(
            f"\n{held} of {len(known_rows)} intervals of identified numbers hold the truth. "
            "stiffness, damping, friction loss, effort limit and back-EMF are ratios to the "
            "armature."
        )
        for definition in rows.definitions:
            terminal.out.print(f"Both sides of {definition}")
        terminal.warn(*rows.notes)
