"""`samples`: copy the sample files that come with the package into a folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from pupper_sysid.cli import terminal


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
        from pupper_sysid.common.files import refuse_overwrite, write_bytes
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
            terminal.out.print(f"  {target}", soft_wrap=True)
        terminal.err.print(
            f"Wrote {len(files)} files. Next: pupper-sysid delay {self.out / 'sweep.csv'}",
            soft_wrap=True,
        )
