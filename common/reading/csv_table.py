"""CSV text as columns of numbers, in blocks of lines: exact, and fast where the text is plain.

    table = read_table(path, text, texts={"joint"})
    table.numbers["time_s"], table.texts["joint"], table.line

The first line that is no comment (`# …`) names the columns. Plain blocks are converted by pandas'
parser, which rounds as Python does; a block in which it finds anything else is read again line by
line, strictly, so that a fault is named with its place. `distinct` refuses a name that stands
twice, in a table of any format: a mapping from names to columns would keep only the last.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import allowed, refuse_more
from pupper_sysid.common.reading.dialect import decimal, is_clock, is_decimal
from pupper_sysid.common.strict_yaml import printable


def distinct(where: Path | str, names: Iterable[str], what: str = "columns") -> None:
    """Refuse `names` of `what` (a plural) of which two are the same; `where` is for messages.

    >>> distinct("log.npz", ["knee", "ankle", "knee"], "joints")
    Traceback (most recent call last):
    ...
    pupper_sysid.common.errors.InputError: log.npz: two joints would be called knee. Rename one of \
them.
    """
    seen: set[str] = set()
    for name in names:
        if name in seen:
            called = f"would be called {printable(name)[:60]}" if name else "have no name"
            raise InputError(f"{where}: two {what} {called}. Rename one of them.")
        seen.add(name)


def one_each(where: Path | str, counts: Mapping[str, int], remedy: str = "Mend the log.") -> None:
    """Refuse parts of a row that are not equally long: commands, positions, names of joints.

    `counts`: how many values each part has. `remedy`: what else to do, as a sentence.

    >>> one_each("log.npz", {"command": 3, "joint_names": 2})
    Traceback (most recent call last):
    ...
    pupper_sysid.common.errors.InputError: log.npz: command has 3 values and joint_names has 2; \
each joint has one of each. Mend the log.
    """
    if len(set(counts.values())) > 1:
        first, *others = counts.items()
        *listed, last = [f"{printable(first[0])[:60]} has {first[1]} values",
                         *(f"{printable(what)[:60]} has {n}" for what, n in others)]  # fmt: skip
        text = f"{', '.join(listed)} and {last}; each joint has one of each"
        raise InputError(f"{where}: {text}. {remedy}")


MOST_ROWS = 5_000_000
MOST_COLUMNS = 2_000
MOST_CELLS = 40_000_000
MOST_COMMENTS = 10_000
LONGEST_CELL = 100_000
LONGEST_COMMENT = 1_000_000
LONGEST_NAME = 1_000

# from 3.1 on, pandas rounds as Python does and deprecates the argument
_OLD_PANDAS = tuple(map(int, pd.__version__.split(".")[:2])) < (3, 1)
_EXACTLY: dict[str, Any] = {"float_precision": "round_trip"} if _OLD_PANDAS else {}
_SPLIT = "Split it by joint or by time."
_BLOCK, _TAIL, _FEW_LINES = 4_000_000, 20_000, 20  # characters, the last of them; lines
_FEW_BROKEN = 0.01  # of the lines: a serial line lost characters
_NOTHING = re.compile(
    r"[\W_]*(\d\.#([qs]?nan|ind)\d*|nan(\(\w+\))?|none|null|nil|n\.?/?a|div/0|num|value|ref|missing|"
    r"invalid|lost|failed|err|error|timeout)?[\W_]*"
)
"""Words for a reading that failed."""
_LONGEST_WORD = 30  # of them
_REMARKS = ("comment", "comments", "remark", "remarks", "note", "notes", "message")
_COMMENT = re.compile(r"^#.*$", re.MULTILINE)
_QUOTED = re.compile(r'(?:^|(?<=[,\n]))"([^",\n]*)"(?=[,\n]|$)')


@dataclass
class CsvTable:
    """Columns of a CSV text."""

    columns: list[str]
    """All names, in the order of the text."""
    numbers: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    """Empty cells are NaN, shape (rows,)."""
    texts: dict[str, list[str]] = field(default_factory=dict)
    """Columns to read as text."""
    faults: dict[str, str] = field(default_factory=dict)
    """Other columns that hold text, and the sentence on the first such cell."""
    line: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Line of each row, from 1, shape (rows,)."""
    comments: list[tuple[int, str]] = field(default_factory=list)
    """Comment lines, numbered."""
    broken: list[int] = field(default_factory=list)
    """Lines that are no rows, and have been left out: remarks without a number, and a few with
    another number of cells; none if strict."""
    cut: bool = False
    """Whether the last row was incomplete and has been left out."""

    def __len__(self) -> int:
        return len(self.line)


def read_table(
    path: Path | str,
    text: str,
    texts: Collection[str] = (),
    strict: bool = True,
    whole_lines: bool = False,
    columns: Sequence[str] | None = None,
) -> CsvTable:
    """Columns of CSV text.

    A last row with too few cells is left out, since its writer was interrupted.

    `path`: for messages. `texts`: columns that hold text. `strict`: refuse text in other columns,
    rather than name it in `faults`, and each line with another number of cells, rather than leave a
    few out. `whole_lines`: leave a last line out, too, that does not end. `columns`: names of the
    columns where no line has them.
    """
    text = one_line_end(text)
    refuse_more(path, text.count("\n"), MOST_ROWS + 2 * MOST_COMMENTS, "lines", _SPLIT)
    table, first, at = _opening(path, text, columns)
    rows = text.count("\n", at)
    refuse_more(path, rows, MOST_ROWS, "rows", _SPLIT)
    refuse_more(path, rows * len(table.columns), MOST_CELLS, "cells", _SPLIT)
    end = len(text)
    if not text.endswith("\n"):  # the last of many lines may be cut where it is the shortest
        *others, last = text[-_TAIL:].split("\n")[1:] or [""]
        shortest = min(map(len, others[-_FEW_LINES:]), default=0)
        short = len(others) >= _FEW_LINES and last[:1] != "#" and len(last.rstrip()) < shortest
        if whole_lines or short:
            end = max(text.rfind("\n") + 1, at)
            last = text[end:].strip()
            table.cut = bool(last) and last[0] != "#"
    blocks = _Blocks(path, table, texts, strict)
    while at < end:
        stop = end if at + _BLOCK >= end else text.find("\n", at + _BLOCK, end) + 1 or end
        first += blocks.add(text[at:stop], first, last=stop == end)
        at = stop
    blocks.finish()
    return table


def one_line_end(text: str) -> str:
    """`text` with the line ends of other systems made one."""
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def column_names(path: Path | str, text: str) -> list[str]:
    """Names of the columns of CSV text; empty if it has none."""
    return _opening(path, one_line_end(text))[0].columns


def comments_of(path: Path | str, text: str) -> list[tuple[int, str]]:
    """Comment lines of CSV text, numbered from 1."""
    return _comments(path, one_line_end(text))


def _comments(path: Path | str, text: str, n: int = 1, known: int = 0) -> list[tuple[int, str]]:
    """Comment lines of text that begins at line `n`, before which `known` ones are."""
    comments: list[tuple[int, str]] = []
    if text[:1] != "#" and "\n#" not in text:
        return comments
    at = 0
    for match in _COMMENT.finditer(text):
        n, at = n + text.count("\n", at, match.start()), match.start()
        comments.append((n, match[0]))
        refuse_more(path, known + len(comments), MOST_COMMENTS, "comment lines", exact=False)
        refuse_more(f"{path}, line {n}", len(match[0]), LONGEST_COMMENT, "characters")
    return comments


def _opening(
    path: Path | str, text: str, columns: Sequence[str] | None = None
) -> tuple[CsvTable, int, int]:
    """Comments and names of the columns; line and place in the text of what follows."""
    at, n, stop = 0, 1, 0
    while at < len(text):
        stop = text.find("\n", at)
        stop = len(text) if stop < 0 else stop
        if text[at] != "#" and text[at:stop].strip():
            break
        at, n = stop + 1, n + 1
        if n > allowed(MOST_COMMENTS):  # blank lines, too
            refuse_more(path, n, MOST_COMMENTS, "lines before its column names", exact=False)
    comments = _comments(path, text[:at])
    if at >= len(text):
        return CsvTable([], comments=comments), n, len(text)
    line = text[at:stop]
    refuse_more(path, line.count(",") + 1, MOST_COLUMNS, "columns", _SPLIT)
    names = [name.strip() for name in (_cells(path, n, line) if columns is None else columns)]
    refuse_more(path, len(names), MOST_COLUMNS, "columns", _SPLIT)
    longest = max(map(len, names), default=0)
    refuse_more(f"{path}: the name of a column", longest, LONGEST_NAME, "characters")
    distinct(f"{path}, line {n}" if columns is None else f"{path}, its columns", names)
    if columns is not None:
        return CsvTable(names, comments=comments), n, at
    return CsvTable(names, comments=comments), n + 1, min(stop + 1, len(text))


class _Blocks:
    """Blocks of lines, one after another, as columns of one table."""

    def __init__(self, path: Path | str, table: CsvTable, texts: Collection[str], strict: bool):
        self._path, self._table, self._strict = path, table, strict
        self._lines: list[NDArray[np.int64]] = []
        self._numbers: dict[str, list[NDArray[np.float64]]] = {}
        self._known: dict[str, str] = {}  # each text once, however often it stands there
        for name in table.columns:
            if name in texts:
                table.texts[name] = []
            else:
                self._numbers[name] = []

    def add(self, block: str, first: int, last: bool) -> int:
        """Take a block of lines that begins at line `first`; how many lines it has."""
        count = block.count("\n")
        comments = _comments(self._path, block, first, len(self._table.comments))
        self._table.comments += comments
        plain = _QUOTED.sub(r"\1", block) if '"' in block else block
        rows = {n: line for n, line in enumerate(plain.split("\n"), first)
                if line and line[0] != "#"}  # fmt: skip
        if rows and not self._plain(rows):
            self._strictly(block, first, last)
        return count

    def finish(self) -> None:
        """Put the blocks together."""
        self._table.line = np.concatenate([np.zeros(0, np.int64), *self._lines])
        for name in list(self._numbers):
            self._table.numbers[name] = np.concatenate([np.zeros(0), *self._numbers.pop(name)])

    def _plain(self, rows: Mapping[int, str]) -> bool:
        """Take lines, by number, of decimal numerals and of texts without quotes; or do not."""
        table, commas = self._table, len(self._table.columns) - 1
        if any(line.count(",") != commas or '"' in line for line in rows.values()):
            return False
        numeric = {n: name in self._numbers for n, name in enumerate(table.columns)
                   if name not in table.faults}  # fmt: skip
        kinds: Any = {n: float if number else str for n, number in numeric.items()}
        try:
            read = pd.read_csv(
                io.StringIO("\n".join(rows.values())), header=None, index_col=False,
                usecols=list(kinds), dtype=kinds,
                na_values=[""], keep_default_na=False, skip_blank_lines=False,
                quoting=csv.QUOTE_NONE, engine="c", low_memory=False, **_EXACTLY,
            )  # fmt: skip
        except (ValueError, OverflowError):  # pandas raises kinds of ValueError
            return False
        numbers = {n: read[n].to_numpy(float) for n, number in numeric.items() if number}
        if len(read) != len(rows) or any(np.isinf(v).any() for v in numbers.values()):
            return False
        for n, number in numeric.items():
            name = table.columns[n]
            if number:
                self._numbers[name].append(numbers[n])
            else:
                places, distinct_texts = pd.factorize(read[n].fillna(""))
                known = np.array([*map(self._text, distinct_texts)], object)
                table.texts[name] += known[places].tolist()
        self._lines.append(np.array([*rows], np.int64))
        return True

    def _strictly(self, block: str, first: int, last: bool) -> None:
        """Take a block line by line, or refuse it with the place of its fault."""
        path, table = self._path, self._table
        # line by line: a stray quote must not swallow the lines behind it
        rows = {n: _cells(path, n, line) for n, line in enumerate(block.split("\n"), first)
                if line[:1] != "#" and line.strip()}  # fmt: skip
        if not self._strict:
            # in a table of numbers, lines without a number or a time of day are remarks
            remarks = [n for n, row in rows.items()
                       if not any(is_decimal(cell) or is_clock(cell) for cell in row)]  # fmt: skip
            rows = self._without(rows, remarks, len(rows) - 1)
            most = len(table.columns)
            if table.columns[-1].lower() in _REMARKS:  # with commas in them
                rows = {n: [*row[: most - 1], ",".join(row[most - 1 :])] if len(row) > most else row
                        for n, row in rows.items()}  # fmt: skip
        if last and rows and len(rows[max(rows)]) < len(table.columns):
            table.cut = True
            rows.popitem()
        if not self._strict:
            ragged = [n for n, row in rows.items() if len(row) != len(table.columns)]
            rows = self._without(rows, ragged, max(_FEW_BROKEN * len(rows), 1))
        for n, row in rows.items():
            if len(row) != len(table.columns):
                raise InputError(
                    f"{path}, line {n}: {len(row)} cells where the header names "
                    f"{len(table.columns)} columns; command and position must have the same "
                    "number of values. Mend or remove the line."
                )
        lines = [*rows]
        self._lines.append(np.array(lines, np.int64))
        for k, name in enumerate(table.columns):
            cells = [row[k] for row in rows.values()]
            if name in table.texts:
                table.texts[name] += [self._text(cell) for cell in cells]
            elif name in self._numbers:
                try:
                    numbers = numbers_of(path, name, cells, lines, not self._strict)
                    self._numbers[name].append(numbers)
                except InputError as error:
                    if self._strict:
                        raise
                    table.faults[name] = str(error)
                    del self._numbers[name]

    def _without(
        self, rows: dict[int, list[str]], broken: list[int], most: float
    ) -> dict[int, list[str]]:
        """Rows by line, without those that are broken if these are not more than `most`."""
        if len(broken) > most:
            return rows
        self._table.broken += broken
        gone = {*broken}
        return {n: row for n, row in rows.items() if n not in gone}

    def _text(self, cell: str) -> str:
        cell = cell.strip()
        return self._known.setdefault(cell, cell)


def numbers_of(
    path: Path | str,
    name: str,
    cells: Sequence[str],
    lines: Sequence[int] | NDArray[np.int64],
    words: bool = False,
) -> NDArray[np.float64]:
    """Numbers of a column's cells; an empty one is NaN.

    `name`: of the column. `lines`: of the cells, for messages. `words`: whether a word for a
    reading that failed, such as `timeout`, stands for an empty cell.
    """
    values, column = np.full(len(cells), np.nan), printable(name)[:60]
    for k, cell in enumerate(cells):
        if not (text := cell.strip()) or (words and is_failure(text)):
            continue
        try:
            values[k] = decimal(text)
        except ValueError:
            raise InputError(
                f"{path}, line {lines[k]}, column {column}: '{printable(text[:40])}' is not a "
                "number. Mend the cell, or leave it empty if there was no reading."
            ) from None
        if np.isinf(values[k]):
            raise InputError(f"{path}, line {lines[k]}, column {column}: the value is infinite.")
    return values


def is_failure(word: str) -> bool:
    """Whether a word, such as `timeout`, stands for a reading that failed."""
    text = word.strip().lower()
    return len(text) < _LONGEST_WORD and _NOTHING.fullmatch(text) is not None


def _cells(path: Path | str, number: int, line: str) -> list[str]:
    most = int(allowed(LONGEST_CELL))
    if len(line) > most:
        csv.field_size_limit(max(most, 131_072))
        longest = max(map(len, line.split(",")))
        refuse_more(f"{path}, line {number}: a cell", longest, LONGEST_CELL, "characters")
    try:
        return next(csv.reader([line], strict=True))
    except csv.Error as error:
        if "limit" in str(error):
            refuse_more(f"{path}, line {number}: a cell", len(line), LONGEST_CELL, "characters")
        raise InputError(
            f"{path}, line {number}: a quotation mark is not closed. Mend or remove the line."
        ) from None
