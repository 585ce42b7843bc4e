"""`export`: a calibration or a recording in a form that other programs read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from cli import terminal
from common.errors import InputError
from servo_models.calibration import PRESETS, load_calibration
from sysid.export import to_csv
from sysid.recording import load


@dataclass(frozen=True)
class Export:
    """Write a calibration, a preset or a recording as a tidy table.

    Example: pupper-sysid export calibrated.yaml --to csv --out calibrated.csv
    """

    source: tyro.conf.Positional[str]
    """calibrated.yaml, the name of a preset (paper, release), or a recording."""
    to: Literal["csv"] = "csv"
    """Format: csv."""
    out: Path | None = None
    """File to write; by default the source's name with the format's ending, beside it."""
    force: bool = False
    """Replace the file if it exists."""
    json: bool = False
    """Print one JSON object that names the file written, and nothing else."""

    def run(self) -> None:
        """Convert and write."""
        path = Path(self.source)
        if self.source in PRESETS or path.suffix.lower() in (".yaml", ".yml"):
            found = load_calibration(self.source)
        elif path.suffix.lower() == ".csv":
            found = load(path)
            terminal.warn(found.warnings)
        else:
            raise InputError(
                f"{self.source}: neither a calibration (.yaml), nor a recording (.csv), nor one of "
                f"the presets {', '.join(PRESETS)}."
            )
        ending = ".tidy.csv" if path.suffix.lower() == ".csv" else ".csv"
        target = self.out or Path(path.name).with_suffix(ending)
        to_csv(found, target, self.force)
        if self.json:
            terminal.print_json({"written": str(target)})
        else:
            terminal.err.print(f"Wrote {target}.")
