"""`compare-truth`: a calibration beside the true parameters of an emulated robot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pupper_sysid.cli import terminal

if TYPE_CHECKING:
    from pupper_sysid.sysid.compare.truth import TruthRow

_SHOWN = {"_rad_s": ("rad/s", 1.0, 2), "_rad": ("mrad", 1e3, 2), "_s": ("ms", 1e3, 2)}


@dataclass(frozen=True)
class CompareTruth:
    """Was it found? Each calibrated number beside the true one of an emulated robot.

    `sweep --truth` writes the truth beside the recording. Where the interval holds it, the last
    column says yes; of many robots that should be nine in ten.

    Example: pupper-sysid compare-truth sweep.csv calibrated.yaml
    """

    recording: tyro.conf.Positional[Path]
    """Recording of an emulated robot, with its .truth.yaml beside it."""
    calibration: tyro.conf.Positional[Path | None] = None
    """Calibration file; by default the recording is calibrated now."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the calibration, where none is given."""

    def run(self) -> None:
        """Calibrate if need be, compare, print."""
        from pupper_sysid.servo_models.calibration.calibration import load_calibration
        from pupper_sysid.servo_models.calibration.quantity import unit_of
        from pupper_sysid.sysid.compare.truth import compared_with_truth, read_truth
        from pupper_sysid.sysid.fit.calibrate import calibrate

        truth = read_truth(self.recording)  # before the work, not after it
        (recording,) = terminal.load_all([self.recording])
        joints = terminal.pick_joints([recording], self.joints)
        if self.calibration:
            known = load_calibration(self.calibration)
        else:
            with terminal.progress("calibrating", len(joints)) as advance:
                known = calibrate(
                    recording, joints, self.seed, workers=2, progress=advance
                ).calibration
        found = compared_with_truth(recording, truth, known, joints)
        if self.json:
            terminal.print_json(found)
            return
        shown = terminal.table(
            "Found and true", "joint", "quantity", "found", "90 % interval", "truth", "identified",
            "held",
        )  # fmt: skip
        for row in found:
            unit, factor, digits = _scale(row, unit_of(row.quantity))
            low, high = (
                terminal.number(factor * x, digits) for x in (row.found.low, row.found.high)
            )
            shown.add_row(
                row.joint, f"{_words(row.quantity)}, {unit}".removesuffix(", 1"),
                terminal.number(factor * row.found.value, digits), f"{low}…{high}",
                terminal.number(factor * row.truth, digits), row.identified,
                {True: "yes", False: "no", None: "–"}[row.held],
            )  # fmt: skip
        terminal.out.print(shown)
        known_rows = [row for row in found if row.held is not None and row.identified != "no"]
        held = sum(bool(row.held) for row in known_rows)
        terminal.out.print(
            f"\n{held} of {len(known_rows)} intervals of identified numbers hold the truth. "
            "stiffness, damping, friction loss, effort limit and back EMF are ratios to the "
            "armature.",
            soft_wrap=True,
        )
        for definition in found.definitions:
            terminal.out.print(f"Both sides of {definition}", soft_wrap=True)
        terminal.warn(found.notes)


def _scale(row: TruthRow, unit: str) -> tuple[str, float, int]:
    """Unit to show a quantity in, the factor to it, and digits."""
    for end, shown in _SHOWN.items():
        if row.quantity.endswith(end):
            return shown
    return unit, 1.0, 3 if abs(row.truth) < 1 else 0


def _words(name: str) -> str:
    """A quantity's name without its unit."""
    for end in _SHOWN:
        if name.endswith(end):
            return name.removesuffix(end).replace("_", " ")
    return name.replace("_", " ")
