"""What the programs of this folder share: one thread per process, recordings, tables."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from pathlib import Path

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


def share(part: int, whole: int) -> str:
    """Counts, with the percentage."""
    return f"{part} of {whole} ({100 * part / whole:.0f} %)" if whole else "–"
