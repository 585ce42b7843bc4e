"""Do file descriptors, threads or memory of long runs grow: `emulate`, `monitor`, a deployed walk?

    nice -n 5 .venv/bin/python benchmarks/long_runs.py --minutes 60

Processes in real time, at once: an emulated Mini Pupper 2 on the ground behind the proxy's socket,
`pupper-deploy` that walks it, a line of emulated servos, `monitor` on that line, and `monitor` of
the emulated robot within it. Each
is sampled every ten seconds; a walk that ends is begun again and said so. "First" is after two
minutes, in which libraries and buffers fill; growth is the slope of a straight line from then on,
with twice its standard error.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

POLICY = Path(__file__).resolve().parents[1] / "data/samples/policies/lstm"
_EVERY_S, _WARM_S, _START_S = 10.0, 120.0, 60.0
_PAGE = os.sysconf("SC_PAGESIZE")


class Sample(NamedTuple):
    """What a process holds."""

    time_s: float
    descriptors: int
    threads: int
    resident_mb: float


@dataclass
class Run:
    """One process, begun again whenever it ends."""

    name: str
    command: Sequence[str]
    log: Path
    ready: Path | None = None
    """Exists once it serves."""
    samples: list[Sample] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    """Exit codes of earlier ones."""

    def start(self) -> None:
        """Begin it; its output goes to `log`."""
        with self.log.open("ab") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-m", *self.command],
                stdout=out, stderr=out, cwd=self.log.parent,
            )  # fmt: skip
        until = time.monotonic() + _START_S
        while self.ready and not self.ready.exists():
            if time.monotonic() > until or self.process.poll() is not None:
                raise SystemExit(f"{self.name} did not start: {self.log.read_text()}")
            time.sleep(0.1)

    def sample(self, time_s: float) -> None:
        """Count what it holds; begin it again if it has ended."""
        code = self.process.poll()
        if code is not None:
            self.ends.append(code)
            print(f"{self.name} ended with {code}: {self.log.read_text()[-500:]}", file=sys.stderr)
            self.start()
            return
        own = Path(f"/proc/{self.process.pid}")
        self.samples.append(
            Sample(
                time_s, len(os.listdir(own / "fd")), len(os.listdir(own / "task")),
                int((own / "statm").read_text().split()[1]) * _PAGE / 1e6,
            )
        )  # fmt: skip

    def row(self) -> str:
        """Its line of the table."""
        warm = np.array([s for s in self.samples if s.time_s >= _WARM_S])
        if len(warm) < 3:
            return f"| {self.name} | ended before two minutes were over |"
        hours = warm[:, 0] / 3600
        (slope, _), covariance = np.polyfit(hours, warm[:, 3], 1, cov=True)
        counts = [f"{int(c[0])} | {int(c[-1])} | {int(c.max())}" for c in warm[:, 1:3].T]
        return (
            f"| {self.name} | {self.samples[-1].time_s / 60:.0f} | {len(self.ends)} | {counts[0]} "
            f"| {counts[1]} | {warm[0, 3]:.1f} | {warm[-1, 3]:.1f} | {warm[:, 3].max():.1f} "
            f"| {slope:+.2f} ± {2 * np.sqrt(covariance[0, 0]):.2f} |"
        )


def main() -> None:
    """Run all of them, and print the table."""
    parser = argparse.ArgumentParser(description="Do long runs grow?")
    parser.add_argument("--minutes", type=float, default=60.0)
    options = parser.parse_args()
    seconds = 60 * options.minutes
    programs, sysid = "pupper_sysid.cli.programs.", "pupper_sysid.cli.programs.pupper_sysid"
    with tempfile.TemporaryDirectory(prefix="long") as name:
        folder = Path(name)
        proxy, line = folder / "proxy", folder / "servos"
        runs = [
            Run("emulate esp32 --walking",
                [sysid, "emulate", "esp32", "--walking", "--socket", str(proxy)],
                folder / "0.log", proxy),
            Run("pupper-deploy",
                [programs + "pupper_deploy", str(POLICY), "--bus", f"esp32:{proxy}", "--name",
                 "walk", "--force", "--seconds", f"{seconds + 600:.0f}"],
                folder / "1.log"),
            Run("emulate feetech",
                [sysid, "emulate", "feetech", "--link", str(line)], folder / "2.log", line),
            Run("monitor", [sysid, "monitor", "--bus", f"feetech:{line}"], folder / "3.log"),
            Run("monitor --bus emulated", [sysid, "monitor", "--bus", "emulated"],
                folder / "4.log"),
        ]  # fmt: skip
        begun = []
        try:
            for run in runs:
                run.start()
                begun.append(run)
            start = time.monotonic()
            while (elapsed := time.monotonic() - start) < seconds:
                for run in runs:
                    run.sample(elapsed)
                time.sleep(_EVERY_S)
        except KeyboardInterrupt:
            pass
        finally:
            for run in begun:
                run.process.terminate()
            for run in begun:
                run.process.wait(30)
        print(
            "| process | minutes | ends | descriptors: first | last | most | threads: first | last "
            "| most | MB: first | last | most | MB per hour |"
        )
        print("|" + "---|" * 13)
        for run in begun:
            print(run.row())
        print(f"\nLoad of the machine: {' '.join(f'{x:.1f}' for x in os.getloadavg())}.")


if __name__ == "__main__":
    main()
