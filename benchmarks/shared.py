"""What the programs of this folder share: one thread per process, recordings, tables."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pupper_sysid.servo_models.calibration.calibration import Calibration
    from pupper_sysid.sysid.recordings.recording import Recording

for _library in ("OMP", "OPENBLAS"):  # before NumPy is imported: workers share the cores
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parents[1]
REAL = Path(os.environ.get("PUPPER_REAL_DATA") or ROOT.parent / "shared" / "real")
sys.path.insert(0, str(ROOT / "tests"))  # for `support`


def print_rows(head: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Print a Markdown table, row by row as they come."""
    head = list(head)
    print(f"\n| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for row in rows:
        print(f"| {' | '.join(map(str, row))} |", flush=True)


def mrad(value_rad: float) -> str:
    """An error in mrad."""
    return f"{1e3 * value_rad:.1f}"


def free_run_error_rad(unseen: Recording, calibration: Calibration, joint: str) -> float:
    """RMS error of a free run by the calibration as it is written."""
    from pupper_sysid.sysid.compare.compare import compare
    from pupper_sysid.sysid.servo_fit.scores import LINEAR

    models = compare(unseen, [calibration], joint).models
    (scored,) = (model for name, model in models.items() if name != LINEAR)
    return scored.joints[joint].rmse_held_rad


def share(part: int, whole: int) -> str:
    """Counts, with the percentage."""
    return f"{part} of {whole} ({100 * part / whole:.0f} %)" if whole else "–"
