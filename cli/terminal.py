"""What all commands share: where words go, how a table looks, what a number looks like.

Results go to stdout, everything else (progress, warnings, what to run next) to stderr, so that
`--json` leaves one object on stdout and nothing else.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from pupper_sysid.cli.flags import spell
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import select_joints

if TYPE_CHECKING:
    from pupper_sysid.sysid.identify.fleet import Fleet
    from pupper_sysid.sysid.recordings.recording import Recording

# no markup: names of files and joints may have brackets; `Text` where something is to stand out
out = Console(highlight=False, markup=False)
err = Console(stderr=True, highlight=False, markup=False)


def load_all(paths: Sequence[Path]) -> list[Recording]:
    """The recordings at `paths`, or the newest in `recordings/`; their warnings are shown."""
    from pupper_sysid.sysid.recordings.files import load, newest_recording

    chosen = list(paths)
    if not chosen:
        chosen = [newest_recording()]
        err.print(f"Taking the newest recording, {chosen[0]}.", soft_wrap=True)
    recordings = [load(path) for path in chosen]
    for recording in recordings:
        warn(f"{recording.name}: {text}" for text in recording.warnings)
    return recordings


def pick_joints(recordings: Sequence[Recording], text: str) -> list[str]:
    """Joints that were recorded and that `text` names."""
    recorded: list[str] = []
    for recording in recordings:
        recorded += [j for j in recording.joints if j not in recorded]
    return select_joints(text, recorded)


def print_json(value: Any) -> None:
    """One JSON object on stdout; non-finite numbers become null."""
    from pupper_sysid.common.results import plain

    print(json.dumps(plain(value), indent=2, ensure_ascii=False))


def warn(sentences) -> None:
    """Sentences the user should read, on stderr."""
    for sentence in sentences:
        err.print(Text.assemble(("warning: ", "yellow"), spell(sentence)))


def table(title: str, *columns: str) -> Table:
    """An empty table in the house style; the first column is left-aligned text."""
    made = Table(
        title=title, title_justify="left", title_style="bold", box=None, pad_edge=False,
        min_width=min(len(title), out.width),  # or a long title is broken to a small table's width
    )  # fmt: skip
    for k, column in enumerate(columns):
        # folded, where it is too wide: a number that ends in … is none
        made.add_column(
            column, justify="left" if k == 0 else "right", no_wrap=k == 0, overflow="fold"
        )
    return made


def ms(seconds: float | None, digits: int = 1) -> str:
    """Seconds as milliseconds, or a dash."""
    return number(None if seconds is None else 1e3 * seconds, digits)


def number(value: float | None, digits: int = 2) -> str:
    """A number, or a dash where there is none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def spread(values: Any, digits: int) -> str:
    """Median and middle 90 % of a pandas column."""
    return "{} ({} … {})".format(*(number(x, digits) for x in values.quantile([0.5, 0.05, 0.95])))


def print_fleet(
    fleet: Fleet,
    folder: Path,
    elapsed_s: float,
    as_json: bool,
    what: str,
    columns: Mapping[str, tuple[str, int]],
) -> None:
    """A fleet's joints, servos unlike the others, recordings that failed, where it all is.

    `what` is made of each robot; `columns` has, by column of the fleet's table, title and digits.
    """
    from pupper_sysid.sysid.identify.fleet import TABLE

    if as_json:
        print_json(fleet.summary(folder, elapsed_s))
        return
    titles = [title for title, _ in columns.values()]
    shown = table("Fleet: median and middle 90 % of the robots", "joint", "robots", *titles)
    known = fleet.table.query("problem == ''")
    for joint, rows in known.groupby("joint", sort=False):
        cells = [spread(rows[key], digits) for key, (_, digits) in columns.items()]
        shown.add_row(str(joint), str(len(rows)), *cells)
    out.print(shown)
    for _, row in known.query("unlike != ''").iterrows():
        out.print(
            f"{row['robot']} {row['joint']} is unlike its sisters: "
            f"{', '.join(str(row['unlike']).split(';'))}.",
            soft_wrap=True,
        )
    for name, problem in sorted(fleet.problems.items()):
        warn([f"{name} was left out: {problem}"])
    err.print(
        f"{len(fleet.made)} made, {len(fleet.kept)} kept, {len(fleet.failed)} failed in "
        f"{elapsed_s:.0f} s. Wrote {folder / TABLE} and {what} per robot beside it.",
        soft_wrap=True,
    )


def cell(value: Any, digits: int) -> str:
    """What a table shows of a value: numbers rounded, those of lists and dicts, too."""
    if isinstance(value, dict):
        return ", ".join(f"{k} {cell(v, digits)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(cell(v, digits) for v in value)
    return number(value, digits) if isinstance(value, float) else str(value)


@contextmanager
def progress(label: str, total: int) -> Iterator[Any]:
    """A progress bar on stderr if that is a terminal; yields `advance(what)`."""
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(), console=err, disable=not err.is_terminal, transient=True,
    ) as bar:  # fmt: skip
        task = bar.add_task(label, total=total)

        def advance(what: str = "") -> None:
            bar.update(task, advance=1, description=f"{label} {what}".strip())

        yield advance


@contextmanager
def share_progress(label: str) -> Iterator[Any]:
    """A progress bar over shares of stages; yields `advance(what, share)`."""
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(), console=err, disable=not err.is_terminal, transient=True,
    ) as bar:  # fmt: skip
        task = bar.add_task(label, total=1.0)

        def advance(what: str, share: float) -> None:
            bar.update(task, completed=share, description=f"{label}: {what}")

        yield advance


def need_positive(name: str, value: float) -> None:
    """Refuse an option that must be positive."""
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{name} is {value}; it must be a positive number.")


@contextmanager
def seconds_progress(label: str, total_s: float) -> Iterator[Any]:
    """A progress bar over seconds; yields `advance(done_s, total_s, what)`."""
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f} s"),
        TimeElapsedColumn(), console=err, disable=not err.is_terminal, transient=True,
    ) as bar:  # fmt: skip
        task = bar.add_task(label, total=total_s)

        def advance(done_s: float, total: float, what: str) -> None:
            bar.update(task, completed=done_s, total=total, description=f"{label} {what}")

        yield advance
