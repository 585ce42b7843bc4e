"""Options that most commands share, and fleets of recordings."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.common.errors import PupperError
from pupper_sysid.common.files import resolved

if TYPE_CHECKING:
    from pupper_sysid.sysid.fleet import Fleet
    from pupper_sysid.sysid.recordings.recording import Recording


@dataclass(frozen=True)
class OfRecordings:
    """Options of a command that reads recordings."""

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the bootstrap and of the models' global starts."""

    def load(self) -> tuple[list[Recording], list[str]]:
        """The recordings, and the joints of them that were chosen."""
        recordings = terminal.load_all(self.recordings)
        return recordings, terminal.pick_joints(recordings, self.joints)


def each_robot(
    options: Any,
    root: Path,
    doing: str,
    ending: str,
    what: str,
    columns: Mapping[str, tuple[str, int]],
    make: Callable[[Path, Any], Fleet],
) -> None:
    """Have a fleet's results made, and print its joints, outliers and failed recordings.

    The folder is by default that of the recordings and an `ending`. `what` names the result per
    robot; `columns` gives title and digits by column of the table. A recording that could not be
    used is a `PupperError` at the end: the exit code says so, too.
    """
    from pupper_sysid.sysid.fleet import TABLE, robots_in, trust

    started = time.perf_counter()
    folder = options.out or resolved(root).with_name(f"{resolved(root).name}_{ending}")
    if options.cluster is not None:
        terminal.warn(trust(options.cluster))
    with terminal.progress(doing, len(robots_in(root))) as advance:
        fleet = make(folder, advance)
    elapsed_s = time.perf_counter() - started
    if options.json:
        terminal.print_json(fleet.summary(folder, elapsed_s))
    else:
        titles = [title for title, _ in columns.values()]
        table = terminal.table(
            "Fleet: median and middle 90 % of the robots", "joint", "robots", *titles
        )
        known = fleet.table.query("problem == ''")
        for joint, rows in known.groupby("joint", sort=False):
            cells = [_spread(rows[key], digits) for key, (_, digits) in columns.items()]
            table.add_row(str(joint), str(len(rows)), *cells)
        terminal.out.print(table)
        for _, row in known.query("outliers != ''").iterrows():
            terminal.out.print(
                f"{row['robot']} {row['joint']} is an outlier: "
                f"{', '.join(str(row['outliers']).split(';'))}."
            )
        for name, problem in sorted(fleet.problems.items()):
            terminal.warn(f"{name} was left out: {problem}")
        terminal.err.print(
            f"{len(fleet.made)} made, {len(fleet.kept)} kept, {len(fleet.failed)} failed in "
            f"{elapsed_s:.0f} s. Wrote {folder / TABLE} and {what} per robot beside it."
        )
    if fleet.failed:
        raise PupperError(
            f"{len(fleet.failed)} of {len(fleet.failed) + len(fleet.made) + len(fleet.kept)} "
            f"recordings could not be used: {', '.join(sorted(fleet.failed)[:5])}"
            f"{' …' if len(fleet.failed) > 5 else ''}. The others are done; {folder / TABLE} says "
            "why."
        )


def _spread(values: Any, digits: int) -> str:
    """Median and middle 90 % of a pandas column; a single value as it is."""
    if values.count() == 1:
        return terminal.number(values.median(), digits)
    return "{} ({} … {})".format(
        *(terminal.number(x, digits) for x in values.quantile([0.5, 0.05, 0.95]))
    )
