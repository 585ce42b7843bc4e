"""What commands share: options, recordings, output on the terminal, questions at the keyboard.

Results go to stdout, everything else (progress, warnings, what to run next) to stderr: with
`--json`, stdout is one JSON object.

A message below `cli/` names an argument in back-quotes, as Python spells it; `spell` replaces it by
the option of the running command, and leaves every other word alone. So a message reads right both
for a caller of the library and at the command line::

    `stall_torque_nm`    --stall-torque
    `force=True`         --force
    `preset='paper'`     --preset paper
    `learning_rate`      --learner.learning-rate

An option is looked up by the argument's name, by its name without the unit, or by `_OTHER_NAMES`.
Errors (`program.user_errors`) and warnings (`warn`) are spelled so; a command need not call this.
"""

from __future__ import annotations

import json
import math
import os
import re
import select
import shlex
import sys
import termios
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import select_joints, share_sentences
from pupper_sysid.common.reading.dialect import whole_number

if TYPE_CHECKING:
    from pupper_sysid.common.tables import Table as ResultTable
    from pupper_sysid.sysid.recordings.recording import Recording

_COMMAND = re.compile(r"(^|\s)(pupper-[a-z]+|rerun|python|systemctl) ")
_LINE_S = 10.0  # between lines of progress where there is no terminal
_CONTROL = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


class _PlainConsole(Console):
    """Console on which text from files cannot move the cursor, set colours or reverse lines.

    Sentences are one line for other programs. On a terminal they are broken between words, unless
    they hold a command, which would then be copied in parts.
    """

    def print(self, *objects: Any, soft_wrap: bool | None = None, **how: Any) -> None:
        """As rich's."""
        if soft_wrap is None:
            words = all(isinstance(item, str | Text) for item in objects)
            command = _COMMAND.search(" ".join(map(str, objects)))
            soft_wrap = words and (command is not None or not self.is_terminal)
        super().print(*objects, soft_wrap=soft_wrap, **how)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            if segment.control is None and _CONTROL.search(segment.text):
                segment = Segment(
                    _CONTROL.sub("\N{REPLACEMENT CHARACTER}", segment.text), segment.style
                )
            yield segment


# no markup: names of files and joints may have brackets; `Text` where something is to stand out
out = _PlainConsole(highlight=False, markup=False)
err = _PlainConsole(stderr=True, highlight=False, markup=False)


def load_all(paths: Sequence[Path]) -> list[Recording]:
    """Read `paths`, or the newest recording in `recordings/`, and show the warnings.

    A folder that is no log itself stands for all logs in it.
    """
    from pupper_sysid.servo_models import kernel
    from pupper_sysid.sysid.recordings.files import load, newest_recording
    from pupper_sysid.sysid.recordings.importers.recognise import logs_in

    chosen = list(paths)
    if not chosen:
        chosen = [newest_recording()]
        err.print(f"Taking the newest recording, {chosen[0]}.")
    recordings: list[Recording] = []
    for path in chosen:
        if not path.exists() and any(str(path) in recording.joints for recording in recordings):
            raise InputError(f"{path} is a joint, no file: choose it with `--joints {path}`.")
        recordings += [load(log) for log in logs_in(path)]
    by_name: dict[str, list[str]] = {}
    for recording in recordings:
        by_name.setdefault(recording.name, []).extend(recording.warnings)
    for names, text in share_sentences(by_name):
        warn(f"{'all logs' if names == 'All joints' else names}: {text}")
    if not kernel.compiled():
        err.print("Compiling the simulation, once after an installation: about half a minute.")
    if len(recordings) > 1 and all(recording.joints == ["joint"] for recording in recordings):
        warn("the logs name no joint: they were taken as runs of one. Give those of several joints "
             "names, each with `pupper-sysid import LOG --joints NAME`.")  # fmt: skip
    return recordings


def pick_joints(recordings: Sequence[Recording], text: str) -> list[str]:
    """Recorded joints that `text` names."""
    return select_joints(text, list(dict.fromkeys(j for r in recordings for j in r.joints)))


Joints = Annotated[
    str, tyro.conf.arg(help="Names (LF_hip), legs (LF), kinds (hip), several with commas, or all.")
]
Json = Annotated[bool, tyro.conf.arg(help="Print one JSON object and nothing else.")]
Replace = Annotated[bool, tyro.conf.arg(help="Replace files that exist.")]


@dataclass(frozen=True)
class OfRecordings:
    """Options of a command that reads recordings."""

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    joints: Joints = "all"
    json: Json = False
    seed: int = 0
    """Seed of the bootstrap and of the models' global starts."""

    def load(self) -> tuple[list[Recording], list[str]]:
        """The recordings, and the joints of them that were chosen."""
        recordings = load_all(self.recordings)
        return recordings, pick_joints(recordings, self.joints)


def print_json(value: Any) -> None:
    """Print one JSON object on stdout; non-finite numbers become null."""
    from pupper_sysid.common.results import plain

    text = json.dumps(plain(value), indent=2, ensure_ascii=False)
    # control characters that JSON leaves as they are; its line ends are not within strings
    print(_CONTROL.sub(lambda match: f"\\u{ord(match[0]):04x}", text))


def warn(*sentences: str) -> None:
    """Print warnings on stderr, one per line."""
    for sentence in sentences:
        err.print(Text.assemble(("warning: ", "yellow"), spell(sentence)))


class _FittingTable(Table):
    """Table whose columns give way at spaces before any word or number is broken."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        # a space on both sides of each gap
        available = options.max_width - 2 * (len(self.columns) - 1)
        texts = [[str(text) for text in (c.header, *c.cells)] for c in self.columns]
        words = [[w for t in ts for w in (t.split() if k else [t])] for k, ts in enumerate(texts)]
        natural = [max(map(cell_len, ts)) for ts in texts]
        least = [max(map(cell_len, ws), default=0) for ws in words]
        while sum(natural) > available and natural != least:
            spare = [n if n > m else 0 for n, m in zip(natural, least, strict=True)]
            natural[spare.index(max(spare))] -= 1
        if sum(natural) <= available:
            for column, width_of in zip(self.columns, natural, strict=True):
                column.width = width_of
        yield from super().__rich_console__(console, options)


def table(title: str, *columns: str, rows: Iterable[Iterable[Any]] = ()) -> Table:
    """Table of rows; the first column is left-aligned text, the others numbers."""
    filled = _FittingTable(
        title=title, title_justify="left", title_style="bold", box=None, pad_edge=False,
        min_width=min(len(title), out.width),  # a title is broken at the table's width
    )  # fmt: skip
    for k, column in enumerate(columns):
        # folded where it is too wide, headings between words: a truncated number would be wrong
        filled.add_column(
            column, justify="left" if k == 0 else "right", no_wrap=k == 0, overflow="fold",
            min_width=max(map(len, column.split()), default=0),
        )  # fmt: skip
    for row in rows:
        filled.add_row(*(cell if isinstance(cell, Text) else str(cell) for cell in row))
    return filled


def result_table(results: ResultTable) -> Table:
    """A table of results, without its details."""
    columns = [column for column in results.columns if not column.detail]
    filled = table(results.title, *(column.terminal_heading for column in columns))
    for row in results.rows:
        style = "bold" if row.get(results.marked) else None
        filled.add_row(*(column.text(row) for column in columns), style=style)
    return filled


def print_table(title: str, *columns: str, rows: Iterable[Iterable[Any]]) -> None:
    """Print a table of rows."""
    out.print(table(title, *columns, rows=rows))


def print_tables(*tables: ResultTable) -> None:
    """Print tables of results, an empty line between them; those without rows are left out."""
    for k, table in enumerate(t for t in tables if t.rows):
        if k:
            out.print()
        out.print(result_table(table))


def ms(seconds: float | None, digits: int = 1) -> str:
    """Seconds as milliseconds, or a dash."""
    return number(None if seconds is None else 1e3 * seconds, digits)


def number(value: float | None, digits: int = 2) -> str:
    """A number, or a dash if it is missing or not finite."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def command(*words: Any) -> str:
    """A command to copy: a name with a space, or with another sign of the shell, is in quotes."""
    return shlex.join(map(str, words))


def cell(value: Any, digits: int) -> str:
    """Text of a value for a table: numbers rounded, also within lists and dicts."""
    if isinstance(value, dict):
        return ", ".join(f"{k} {cell(v, digits)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(cell(v, digits) for v in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return number(value, digits) if isinstance(value, float) else str(value)


def whole_numbers(option: str, text: str) -> list[int]:
    """Loop numbers that an option names, such as 0,1."""
    try:
        return [whole_number(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{option} is '{text}'; write loop numbers with commas: 0,1.") from None


def need_positive(name: str, value: float) -> None:
    """Refuse an option that is not a positive number."""
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{name} is {value}; it must be a positive number.")


@contextmanager
def progress(label: str, total: int) -> Iterator[Any]:
    """Show a bar over steps; yields `advance(what)`."""
    with _bar(label, total, "{task.completed}/{task.total}") as update:
        yield lambda what="": update(advance=1, description=f"{label} {what}".strip())


@contextmanager
def share_progress(label: str) -> Iterator[Any]:
    """Show a bar over shares of stages; yields `advance(what, share)`."""
    with _bar(label, 1.0, "{task.percentage:3.0f} %") as update:
        yield lambda what, share: update(completed=share, description=f"{label}: {what}")


@contextmanager
def seconds_progress(label: str, total_s: float) -> Iterator[Any]:
    """Show a bar over seconds; yields `advance(done_s, total_s, what)`."""
    with _bar(label, total_s, "{task.completed:.0f} s") as update:
        yield lambda done_s, total_s, what: update(
            completed=done_s, total=total_s, description=f"{label} {what}".strip()
        )


@contextmanager
def _bar(label: str, total: float, count: str) -> Iterator[Any]:
    """A progress bar on stderr; where that is no terminal a line each `_LINE_S`.

    Yields its `update`.
    """
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn(count), TimeElapsedColumn(),
        console=err, disable=not err.is_terminal, transient=True,
    ) as bar:  # fmt: skip
        task = bar.add_task(label, total=total)
        started = reported = time.monotonic()

        def update(**changes: Any) -> None:
            nonlocal reported
            bar.update(task, **changes)
            if not err.is_terminal and time.monotonic() - reported >= _LINE_S:
                reported = time.monotonic()
                state = bar.tasks[0]
                err.print(f"{state.description}: {state.percentage:.0f} %, "
                          f"{reported - started:.0f} s")  # fmt: skip

        yield update


# ----- arguments of the library, spelled as options


_OTHER_NAMES = {"frequencies": "freqs", "address": "bus", "workers": "jobs", "p_gain": "gain"}
_OF_EVERY_PROGRAM = {"read_limit": "--read-limit"}
"""Options of another name than the library's argument, by that (without its unit)."""

_ARGUMENT = re.compile(r"`([a-z][a-z0-9_]*)(?:=('?)([^`']*)\2)?`")
_UNIT = re.compile(r"_(rad_s|m_s|s|ms|hz|rad|nm)$")
_flags: ContextVar[Mapping[str, str]] = ContextVar("flags")


def remember(options: Any) -> None:
    """Take the options of the running command, parsed, as those that messages may name."""
    _flags.set(_flags_of(options))


def forget() -> None:
    """Spell nothing from now on: the command has ended."""
    _flags.set({})


def spell(text: str) -> str:
    """`text` with the arguments in back-quotes replaced by the running command's options."""
    known = _OF_EVERY_PROGRAM | dict(_flags.get({}))

    def flag(match: re.Match[str]) -> str:
        name = _UNIT.sub("", match[1])
        options = (known.get(n) for n in (match[1], name, _OTHER_NAMES.get(name)) if n)
        option = next(filter(None, options), None)
        if option is None:
            return match[0]
        return option if match[3] in (None, "True") else f"{option} {match[3]}"

    return _ARGUMENT.sub(flag, text)


def _flags_of(options: Any, prefix: str = "--") -> dict[str, str]:
    """Flag of every option that is not positional, by field; those of nested groups, too."""
    flat, nested = {}, {}
    for field in fields(options):
        value, kind = getattr(options, field.name), str(field.type)
        flag = prefix + field.name.replace("_", "-")
        if is_dataclass(value):
            nested = _flags_of(value, prefix if "name=''" in kind else f"{flag}.") | nested
        elif "Positional" not in kind:
            flat[field.name] = flag
    return nested | flat


@contextmanager
def terminal_without(flags: int, fd: int) -> Iterator[None]:
    """Local flags of a terminal, such as `termios.ECHO`, off during the block."""
    before = termios.tcgetattr(fd)
    changed = [*before[:3], before[3] & ~flags, *before[4:]]
    termios.tcsetattr(fd, termios.TCSANOW, changed)
    try:
        yield
    finally:
        termios.tcsetattr(fd, termios.TCSADRAIN, before)


class Keyboard:
    """Lines typed at the terminal, read without blocking."""

    def __init__(self) -> None:
        try:
            self._fd = sys.stdin.fileno()
        except (OSError, ValueError, AttributeError):
            raise _ended() from None
        self._typed = b""

    def ask(self, question: str) -> str:
        """Answer to a question, in lower case; waits for it."""
        err.print(Text(question, "bold"))
        self.forget()
        while (line := self.line()) is None:
            select.select([self._fd], [], [])
        return line

    def forget(self) -> None:
        """Discard what was typed before the question."""
        if os.isatty(self._fd):
            termios.tcflush(self._fd, termios.TCIFLUSH)
            self._typed = b""

    @contextmanager
    def unseen(self) -> Iterator[None]:
        """Without echo during the block: Enter would push a live table down by a line."""
        if not os.isatty(self._fd):
            yield
            return
        self.forget()
        with terminal_without(termios.ECHO, self._fd):
            yield

    def line(self) -> str | None:
        """A line if one has been typed."""
        if b"\n" not in self._typed and select.select([self._fd], [], [], 0)[0]:
            typed = os.read(self._fd, 1024)
            if not typed:
                raise _ended()
            self._typed += typed
        line, end, rest = self._typed.partition(b"\n")
        if not end:
            return None
        self._typed = rest
        return line.decode(errors="replace").strip().lower()


def _ended() -> InputError:
    return InputError(
        "the input ended before the calibration did, so nothing was written. Run it in a terminal, "
        "where questions can be answered; servos that went limp stay so."
    )
