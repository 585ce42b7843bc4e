"""Give every command hostile files, option values and outputs, and say what came of it.

Good files of every kind (`hostile.kit`) are spoiled in content and place (`hostile.spoil`), files
are made to hurt one format (`hostile.bombs`), options take impossible values
(`hostile.options`), and every command prints to a full disk. Each command runs in a process of its
own with limits on memory and time. Repeatable by its seed; exits with 1 if anything was wrong.

    .venv/bin/python benchmarks/file_campaign.py --seed 0
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hostile.bombs import BOMBS
from hostile.kit import KINDS, Kind, make_kit
from hostile.options import OPTIONS, every_command
from hostile.run import Outcome, run, warm
from hostile.spoil import ALWAYS_REFUSED, CONTENT, PLACES

SLOW_S = 10.0
"""A refusal that takes longer is a fault [s of processor time]; MuJoCo has as much for a model."""
ELSEWHERE = ("executed", "evil.npy", "x.csv", "x.yaml")


@dataclass(frozen=True)
class Case:
    """One hostile thing, and the class it is counted in."""

    group: str
    name: str
    argv: tuple[str, ...]
    refused: bool
    outcome: Outcome

    @property
    def fault(self) -> str:
        """What is wrong; empty if nothing is."""
        if self.outcome.wrong:
            return self.outcome.verdict
        if self.refused and self.outcome.verdict == "accepted":
            return "accepted"
        if self.outcome.verdict == "sentence" and self.outcome.cpu_s > SLOW_S:
            return "slow"
        return ""


class Bench:
    """A folder of good files, copied for each case."""

    def __init__(self, kit: Path, work: Path):
        self.kit, self.work, self.at = kit, work, 0

    def fresh(self) -> Path:
        """A copy of the kit, at a place of its own."""
        self.at += 1
        folder = self.work / f"{self.at}" / "a" / "b"
        shutil.copytree(self.kit, folder, symlinks=True)
        return folder

    def done(self, folder: Path, outcome: Outcome) -> Outcome:
        """Remove a case; what it left outside its folder, or executed, is a fault."""
        top = folder.parent.parent
        stray = [p for p in top.rglob("*") if p.name in ELSEWHERE and p.parent != folder]
        executed = (folder / "executed").exists()
        shutil.rmtree(top, ignore_errors=True)
        if executed or stray:
            return Outcome("executed" if executed else "stray file", outcome.cpu_s, 0, "")
        return outcome


def files(bench: Bench, seed: int, only: str) -> Iterator[Case]:
    """Files of every kind with spoiled content or place."""
    for kind in KINDS:
        if only not in kind.name:
            continue
        for n, (name, change) in enumerate([*CONTENT.items(), *PLACES.items()]):
            rng = np.random.default_rng([seed, *f"{kind.name} {name}".encode()])
            folder = bench.fresh()
            path = _hit(folder, kind)
            place = name in PLACES
            if place:
                path.unlink()
                PLACES[name](path)
            else:
                data = change(path.read_bytes(), rng)
                if data is None:
                    shutil.rmtree(folder.parent.parent)
                    continue
                path.write_bytes(data)
            words = kind.argv[n % len(kind.argv)]
            argv = tuple(kind.source if word == "{}" else word for word in words)
            outcome = bench.done(folder, run(argv, folder))
            always = name in ALWAYS_REFUSED or (place and kind.name not in OPTIONAL)
            yield Case(kind.name, name, argv, always and kind.name not in TOLERANT, outcome)


OPTIONAL = ("run, curves", "policy, run")
TOLERANT = ("run, curves",)
"""Kinds whose fault need not stop the command: tables that are only appended to."""


def _hit(folder: Path, kind: Kind) -> Path:
    source = folder / kind.source
    return source / kind.hit if source.is_dir() else source


def bombs(bench: Bench, only: str) -> Iterator[Case]:
    """Files that hurt one format."""
    for name, (make, refused) in BOMBS.items():
        if only not in name:
            continue
        folder = bench.fresh()
        os.mkfifo(folder / "fifo.xml")
        argv = make(folder)
        yield Case("bombs", name, argv, refused, bench.done(folder, run(argv, folder)))


def options(bench: Bench, only: str) -> Iterator[Case]:
    """Values of options."""
    for argv, refused in OPTIONS:
        name = " ".join(argv)[:100]
        if only not in name:
            continue
        folder = bench.fresh()
        yield Case("options", name, argv, refused, bench.done(folder, run(argv, folder)))


def outputs(bench: Bench, only: str) -> Iterator[Case]:
    """Every command, printing to a full disk."""
    for argv in every_command():
        name = " ".join(argv)[:100]
        if only not in name:
            continue
        folder = bench.fresh()
        outcome = run(argv, folder, stdout="/dev/full")
        yield Case("full disk", name, argv, False, bench.done(folder, outcome))


def table(cases: Sequence[Case]) -> str:
    """Markdown, one line per group."""
    lines = [
        "| what | cases | sentence | accepted | faults | slowest refusal, CPU s | MB |",
        "|---|---|---|---|---|---|---|",
    ]
    groups: dict[str, list[Case]] = defaultdict(list)
    for case in cases:
        groups[case.group].append(case)
    groups["all"] = list(cases)
    for group, own in groups.items():
        refused = [c.outcome.cpu_s for c in own if c.outcome.verdict == "sentence"]
        lines.append(
            f"| {group} | {len(own)} | {len(refused)} | "
            f"{sum(c.outcome.verdict == 'accepted' for c in own)} | "
            f"{sum(bool(c.fault) for c in own)} | {max(refused, default=0):.1f} | "
            f"{max(c.outcome.memory_bytes for c in own) / 1e6:.0f} |"
        )
    return "\n".join(lines)


def main() -> int:
    """Print the faults as they come, then the table; 1 if there were any."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="cases with this in the name of their kind")
    parser.add_argument("--group", default="", help="files, bombs, options or outputs")
    parser.add_argument("--show", action="store_true", help="print what each case said")
    chosen = parser.parse_args()
    warm()
    cases: list[Case] = []
    started = time.perf_counter()
    here = Path.cwd()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        kit, work = Path(name) / "kit", Path(name) / "work"
        kit.mkdir(), work.mkdir()
        os.chdir(kit)
        with (Path(name) / "log").open("w") as log, redirect_stdout(log), redirect_stderr(log):
            make_kit(kit)
        os.chdir(here)
        bench = Bench(kit, work)
        groups = {
            "files": lambda: files(bench, chosen.seed, chosen.only),
            "bombs": lambda: bombs(bench, chosen.only),
            "options": lambda: options(bench, chosen.only),
            "outputs": lambda: outputs(bench, chosen.only),
        }
        for group, found in groups.items():
            for case in found() if chosen.group in group else ():
                cases.append(case)
                if case.fault or chosen.show:
                    print(
                        f"{case.fault or case.outcome.verdict}: {case.group}: {case.name}: "
                        f"{' '.join(case.argv)[:150]!r} {case.outcome.cpu_s:.1f} s "
                        f"{case.outcome.memory_bytes / 1e6:.0f} MB: {case.outcome.said}",
                        flush=True,
                    )
    print(table(cases))
    print(f"\n{len(cases)} cases in {time.perf_counter() - started:.0f} s.")
    return int(any(case.fault for case in cases))


if __name__ == "__main__":
    sys.exit(main())
