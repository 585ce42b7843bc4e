"""Training in two processes (gloo) against one process with one thread: samples per second.

    .venv/bin/python benchmarks/two_processes.py

Both learn from 512 robots in all, without imitation; the rate is that of the updates after the
first. Says, too, whether both processes end with the same parameters, bit for bit.
"""

from __future__ import annotations

import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

ROBOTS, UPDATES = 512, 8
ACTUATOR = "data/samples/calibrated.yaml"


def train(folder: Path, processes: int) -> float:
    """Samples per second."""
    own = [
        str(Path(sys.executable).with_name("pupper-train")), "--actuator", ACTUATOR, "--name",
        str(folder), "--environments", str(ROBOTS // processes), "--iterations", str(UPDATES),
        "--imitation.iterations", "0", "--threads", "1",
    ]  # fmt: skip
    torchrun = [str(Path(sys.executable).with_name("torchrun")), "--nproc-per-node", "2"]
    subprocess.run([*(torchrun if processes == 2 else []), *own], check=True, capture_output=True)
    with (Path("runs") / folder / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    first, last = rows[0], rows[-1]
    samples = float(last["samples"]) - float(first["samples"])
    return samples / (float(last["elapsed_s"]) - float(first["elapsed_s"]))


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as name:
        one = train(Path(name) / "one", 1)
        two = train(Path(name) / "two", 2)
        ranks = [
            torch.load(Path(name) / "two" / file, weights_only=True)
            for file in ("last.pt", "last.rank1.pt")
        ]
    same = all(
        torch.equal(value, ranks[1][part][key])
        for part in ("actor_state_dict", "critic_state_dict")
        for key, value in ranks[0][part].items()
    )
    print("| processes | threads each | samples/s | times |")
    print("|---|---|---|---|")
    print(f"| 1 | 1 | {one:,.0f} | 1.00 |")
    print(f"| 2 | 1 | {two:,.0f} | {two / one:.2f} |")
    print(f"\nParameters of both ranks equal bit for bit: {same}.")


if __name__ == "__main__":
    main()
