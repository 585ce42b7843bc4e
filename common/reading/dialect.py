"""Tables of text in any dialect, made one: commas between cells, points in numbers, names apart.

Logs separate cells by tabs, runs of spaces or semicolons, write decimal commas, begin comments with
`%`, name their columns in a comment or nowhere, have a row of units, or lines before the table.
`plain` finds the dialect in the first lines and returns the text in the one that `csv_table`
reads, line for line, so that messages keep the file's line numbers.

The standard library's `csv` splits cells. The separator is the one by which most cells of the
table become numbers (`csv.Sniffer` takes the decimal commas of `0,1;0,2` for separators).

Numbers are decimal numerals in ASCII. Python's `float` and `int` also take `4_1` for 41 and the
digits of every script, which in a log or an option are misprints rather than numbers.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from pupper_sysid.common.errors import InputError

_WHOLE = re.compile(r"[+-]?[0-9]{1,300}")
_DECIMAL = re.compile(
    r"[+-]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?|nan|inf|infinity)", re.IGNORECASE
)
_SPACES = " \t\r\n"


def decimal(text: str) -> float:
    """The number that `text` is, `nan`, `inf` and exponents included; ValueError if it is none.

    >>> decimal(" -4.1e2 ")
    -410.0
    """
    if not is_decimal(text):
        raise ValueError(f"{text.strip(_SPACES)[:40]!r} is not a number")
    return float(text)


def is_decimal(text: str) -> bool:
    """Whether `text` is a number as `decimal` reads it."""
    text = text.strip(_SPACES)
    # re.IGNORECASE matches the Kelvin sign and others to ASCII letters
    return text.isascii() and _DECIMAL.fullmatch(text) is not None


def whole_number(text: str) -> int:
    """The whole number that `text` is, of at most 300 digits; ValueError if it is none."""
    text = text.strip(_SPACES)
    if not _WHOLE.fullmatch(text):
        raise ValueError(f"{text[:40]!r} is not a whole number")
    return int(text)


_SAMPLE = 500_000  # characters that are looked at
_SAMPLE_LINES = 400
_LABELS = 8  # values of a column of labels, at most
_OFTEN = 0.05  # share of the lines
_ROWS = 100  # of the table, from which its shape is taken
_SEPARATORS = ("\t", ";", ",", "|", " ")
_NAMES_OF = {"\t": "tabs", ";": "semicolons", "|": "bars", " ": "spaces", ",": "commas"}
_USUAL = 0.9  # share of ASCII in tables of numbers that are not in UTF-8
_FEWEST_TIMES, _LONGEST_TRANSPOSED = 20, 20_000_000  # rows of a log; characters
_SAME_SHAPE, _NUMERIC = 0.9, 0.9  # shares of rows, of cells
_COMMENT = re.compile(r"[ \t]*(#|%|//|!)")
_LABVIEW = re.compile(r"^(Channels|Samples)(\t\d+)+\t*$", re.MULTILINE)  # looks like a row
_COMMA_NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:,[0-9]*)?|,[0-9]+)(?:[eE][+-]?[0-9]+)?")
_CLOCK = re.compile(
    r"(\d{4}-\d\d-\d\d[T ]|\d{1,4}([-/.])(?:\d{1,2}|[A-Z][a-z]{2})\2\d{1,4} |\d+ days? )?"
    r"(\d{1,2}:\d\d:\d\d([.,]\d+|:\d{3})?(Z|[+-]\d\d:?\d\d| ?[AP]M)?|\d{1,3}:\d\d[.,]\d+)"
    r"|\d{8}T\d{6}([.,]\d+)?Z?"
)
_GROUP_MARKS = "['’\u00a0\u2009\u202f]"
_IN_TEXT, _IN_ROWS, _IN_EACH = range(3)  # somewhere in the text, in the rows, in each row
_MARKS = (  # around numbers, what to put in their place, and where they must be
    (re.compile(r"(?<![\w.])0x[0-9a-f]{1,8}(?![\w.])", re.IGNORECASE),
     lambda m: str(int(m[0], 16)), _IN_ROWS),
    (re.compile(r"^[ \t]*(\d+(?:\.\d+)?):(?=[ \t])", re.MULTILINE), r"\1", _IN_EACH),  # a time
    (re.compile(r"(?<=[\w.\"])[ \t]+(?:#|//)[^\n]*$", re.MULTILINE), "", _IN_EACH),  # a remark
    (re.compile(r"\*[0-9A-F]{2}[ \t]*$", re.MULTILINE), "", _IN_EACH),  # of NMEA
    (re.compile("[│┃]"), "|", _IN_TEXT),
    (re.compile("[\u2500-\u257f]"), "-", _IN_TEXT),  # lines around cells
    (re.compile(r"^[ \t|+:]*[-=]{3}[-=+ |:\t]*$", re.MULTILINE), "", _IN_TEXT),  # below names
    (re.compile(r"^[ \t]*\|[ \t|]*|(?<![ \t|])[ \t]*\|[ \t|]*$", re.MULTILINE), "", _IN_EACH),
    (re.compile(r"\x1b\[[\d;]*m"), "", _IN_TEXT),  # colours of a terminal
    (_NUMPY := re.compile(r"\bnp\.\w+\(([-+.\w]+)\)"), r"\1", _IN_ROWS),
    (re.compile(r"\b(?:tensor|array)\((?:'\w', ?)?(\[[^\]\n]*\])[^()\n]{0,80}\)"), r"\1", _IN_ROWS),
    (re.compile(r"(?<=[\d.])(?:[dD](?=[+-]\d{2,3}(?![\w.]))|\*\^(?=-?\d))"), "E", _IN_ROWS),
    (re.compile(rf"(?<![\w.,'’])[+-]?\d{{1,3}}(?:{_GROUP_MARKS}\d{{3}})+(?![\w'’])"),
     lambda m: re.sub(_GROUP_MARKS, "", m[0]), _IN_ROWS),
)  # fmt: skip
_SINGLE = re.compile(r"(?:^|[,;\t|])'[^',;\t|\n]*'")
_QUOTED_GROUPS = re.compile(r'"([+-]?\d{1,3}(?:,\d{3})+(?:\.\d+)?)"')
_COMMA_GROUPS = re.compile(r"(?<![\w.,])[+-]?\d{1,3}(?:,\d{3})+(?:\.\d+)?(?![\w,])")
_SPACE_GROUPS = re.compile(r"(?<![\w.,:-])[+-]?\d{1,3}(?: \d{3})+(?:[.,]\d+)?(?![\w.,:])")
_POINT_GROUPS = re.compile(r"(?<![\w.,])[+-]?\d{1,3}(?:\.\d{3})+(?:,\d+)?(?![\w.])")
_UNITS = (
    r"s|sec|seconds?|ms|us|µs|ns|rad|radians?|deg|degrees?|°|counts?|ticks?|turns?|rev|v|volts?|a|"
    r"amps?|ma|mv|n\*?m|nm|%|°?c|hz|rad/s|deg/s|rpm|rad/s\^?2|m|mm"
)
_UNIT = re.compile(rf"[(\[<{{]?\s*({_UNITS}|raw|-|1|none)\s*[)\]>}}]?", re.IGNORECASE)
_ANGLE_UNIT = re.compile(r"rad(ians?)?|deg(rees?)?|°|turns?|rev|counts?|ticks?", re.IGNORECASE)
_WITH_UNIT = re.compile(rf"([-+]?[\d.,]+(?:[eE][-+]?\d+)?) ?({_UNITS})", re.IGNORECASE)
_NAMED_LIST = re.compile(
    r"(?<![\w./])[./]*([A-Za-z_][\w./]*)(?:\s*[:=]\s*[\[(]|(?<=\w\w) +\[)([-+.\deE,; \t]+)[\])]"
)
_PAIR, _LONG_PAIR = (  # with names of a word, or of two
    re.compile(
        rf"(?<![\w\"'./])[\"']?[./]*([A-Za-z_][\w./]*{more})[\"']?\s*[:=]\s*"
        rf"([-+]?[\d.]+(?:[eE][-+]?\d+)?)(?: ?({_UNITS})(?!\s*[:=]))?(?![\w:])",
        re.IGNORECASE,
    )
    for more in ("", r"(?: [A-Za-z_]\w*)?")
)
_AHEAD = re.compile(r"[ \t]*[\[(]?(\d+(?:\.\d+)?)[\])]?[ \t]*[,;|:>]?[ \t]+(?=[\[(A-Za-z])")
_STAMPED = re.compile(
    r"^[ \t]*(?:\[[A-Za-z]+\][ \t]*)?(?:[A-Z][a-z]{2} +\d{1,2} )?"  # [INFO], May 04
    r"(?:\[?((?:\d{4}-\d\d-\d\d[T ])?\d{1,2}:\d\d:\d\d(?:[.,]\d+)?)\]?|"
    r"[(\[][ \t]*(\d+\.\d+|\d+(?=[ \t]*[mu]?s))[ \t]*([mu]?s)?[ \t]*[)\]]|"
    r"[EWIDV] \((\d+)\) [\w.-]+:)"  # ESP-IDF's milliseconds and tag
    r"[ \t]*(?:->|[|:>])?[ \t]+(?![AP]M)(?=\S)",
    re.MULTILINE,
)
_REMARK = re.compile(r"\W*\w+\W*:$")  # a first word such as WARN: or [INFO]:
_NUMBERS = re.compile(r"[\s,;]+")
_LONGEST_LIST = 1000
_BRACKETED = re.compile(
    r"^[ \t]*[\[(<]([^\[\]()<>\n]+|[-+.\deE,; \t\[\]()]+)[\])>][ \t]*[,;]?[ \t]*$",
    re.MULTILINE,
)
_LONG_LIST = re.compile(  # NumPy ends lines within long ones
    r'^((?:[^"\n]++|"(?!\[)|"\[[^"\]]*+\]")*"\[[^"\]\n]*+\n[^"\]]*+\]")([^\n]*)', re.MULTILINE
)
_BRACKETS = re.compile(r"[\[\]()]")
_HEX_CELL = re.compile(r"([0-9a-f]{2,8})(h?)", re.IGNORECASE)
_DOUBLED = re.compile(r"(?<!\d)([+-]?\d+),(\d+)(,|$)", re.MULTILINE)  # 0,1,0,2 of decimal commas
_CELL = r"(?:^|(?<=[;\t])) ?{} ?(?=[;\t]|$)"  # of a table that commas do not separate
_MARKED = re.compile(_CELL.format(r"([+-]?\d+)([.,])(\d+(?:[eE][+-]?\d+)?)"), re.MULTILINE)
_NEGATIVE = re.compile(_CELL.format(r"\((\d+(?:[.,]\d+)?)\)"), re.MULTILINE)
_TELEPLOT = re.compile(
    r"^>([\w./ \[\]-]+):(?:(\d+(?:\.\d+)?):)?([-+]?[\d.]+(?:e[-+]?\d+)?)(?:[§|].*)?$",
    re.IGNORECASE | re.MULTILINE,
)
_INFLUX = re.compile(
    r"^[\w.-]+((?:,[\w.-]+=[\w.-]+)*) ([^ =\n]+=[^ \n]+) (\d{10,19})$", re.MULTILINE
)
_LIST = re.compile(r'"?[\[(]\s*([-+.\d][-+.\deE,;\s]*?)\s*[\])]"?')


@dataclass(frozen=True)
class Plain:
    """A table of text in the dialect of `csv_table`."""

    text: str
    """With as many lines as before."""
    columns: list[str] | None = None
    """Names of the columns where no row of `text` has them."""
    numbered: str = ""
    """Why the columns have no names but their numbers from 0, as a clause; empty if they do."""
    notes: list[str] = field(default_factory=list)
    """What was assumed, as sentences."""


@dataclass(frozen=True)
class _Shape:
    """How the rows of a table are written."""

    separator: str
    comma: bool  # in numbers
    columns: int
    numeric: tuple[bool, ...]  # by column
    units: dict[int, str]  # of columns in whose cells one stands behind the number
    hexed: dict[int, int]  # columns of hexadecimal numbers; see `_hexadecimal`
    counted: bool  # whether the first column counts the rows
    clocked: bool  # whether the first column holds times of day
    blank: tuple[bool, ...]  # by column


def plain(text: str) -> Plain:
    """Text of a table in the dialect of `csv_table`; unchanged where no dialect is recognised."""
    if _LONG_LIST.search(text[:_SAMPLE]):
        text = _LONG_LIST.sub(
            lambda m: m[1].replace("\n", " ") + m[2] + "\n" * m[1].count("\n"), text
        )
    text = _LABVIEW.sub("", text)
    lines = text[:_SAMPLE].split("\n")
    if len(text) > _SAMPLE:
        lines.pop()
    lines = lines[:_SAMPLE_LINES]
    bare = [n for n, line in enumerate(lines) if line.strip() and not _COMMENT.match(line)]
    if bare and lines[bare[0]].lower().startswith("sep="):  # of spreadsheets
        lines[bare[0]] = ""
        bare.pop(0)
    if len(bare) < 3:
        return Plain(text)
    if (turned := _transposed(text)) is not None:
        return _noted(turned, "its rows were taken for columns.")
    rows = [lines[n] for n in bare[len(bare) // 2 :][:_ROWS]]
    if (usual := _usual_numbers(text, [*rows, *text[-2000:].split("\n")[1:-1]])) != text:
        return plain(usual)
    doubled = 2 * lines[bare[0]].count(",") + 1
    if all(row.count(",") == doubled and not _DOUBLED.sub("", row) for row in rows):
        return _noted(plain(_DOUBLED.sub(r"\1.\2\3", text)), "its numbers have decimal commas.")
    marks = [{m[2] for row in rows for m in _MARKED.finditer(row)}, *map(_MARKED.search, rows)]
    if marks[0] == {",", "."} and all(marks):
        return _noted(plain(_MARKED.sub(r"\1.\3", text)), "its numbers have decimal commas, too.")
    negative = [_NEGATIVE.search(row) is not None for row in rows]
    if any(negative) and not all(negative):
        below = plain(_NEGATIVE.sub(r"-\1", text))
        return _noted(below, "its numbers in parentheses are negative, as in accounts.")
    if all(_TELEPLOT.match(row) for row in rows):
        return _teleplot(text)
    if all(_INFLUX.match(row) for row in rows):
        return _influx(text)
    if all(_NAMED_LIST.search(row) for row in rows):
        return plain(_NAMED_LIST.sub(_apart, text))
    if labels := _labels(rows):
        return _labelled(text, rows, *labels)
    if all(_STAMPED.match(row) for row in rows):  # of a serial monitor
        inner = _shape([_STAMPED.sub("", row) for row in rows])
        separator = inner.separator if inner else ","
        stamped = _STAMPED.sub(lambda m: _stamp(m) + separator, text)
        if stamped != text:
            return plain(stamped)
    if all(_BRACKETED.match(row) for row in rows):
        return plain(_BRACKETED.sub(lambda m: _BRACKETS.sub("", m[1]), text))
    if all(_LIST.search(row) for row in rows) and (flat := _unlisted(text, lines, bare, rows)):
        return plain(flat)
    shape = _shape(rows)
    if shape is None:
        return Plain(text)
    return _rewritten(text, lines, bare, shape)


def _noted(table: Plain, note: str) -> Plain:
    return replace(table, notes=[*table.notes, note])


def _transposed(text: str) -> Plain | None:
    """The table of a text with a line per quantity and a cell per time; None if it is none."""
    if len(text) > _LONGEST_TRANSPOSED or text.count("\n") > _FEWEST_TIMES:
        return None
    lines = [line for line in text.split("\n") if line.strip() and not _COMMENT.match(line)]
    for separator in _SEPARATORS:
        rows = [_split(line, separator) for line in lines]
        if len({len(row) for row in rows}) == 1 and len(rows[0]) > 3 * _FEWEST_TIMES:
            return plain("\n".join(separator.join(row) for row in zip(*rows, strict=True)))
    return None


def _usual_numbers(text: str, rows: Sequence[str]) -> str:
    """The text without thousands separators, odd exponents, quotes and minus signs, and colours.

    A comma groups thousands where it is quoted, or where cells are separated otherwise, every
    comma stands before three digits, and other numbers have a decimal point; a point where the
    others have a decimal comma.
    """
    text = text.replace("\u2212", "-")
    sample, head = "\n".join(rows), text[:_SAMPLE]
    for pattern, replacement, where in _MARKS:
        if all(map(pattern.search, ([head], [sample], rows)[where])):
            text = pattern.sub(replacement, text)
    if all(_SINGLE.search(row) for row in rows) and '"' not in sample:
        text = text.replace("'", '"')
    if _QUOTED_GROUPS.search(sample):
        text = _QUOTED_GROUPS.sub(lambda m: m[1].replace(",", ""), text)
    elif all(";" in row or "\t" in row for row in rows):
        if _SPACE_GROUPS.search(sample):
            text = _SPACE_GROUPS.sub(lambda m: m[0].replace(" ", ""), text)
        for groups, mark, point in ((_COMMA_GROUPS, ",", "."), (_POINT_GROUPS, ".", ",")):
            bare = groups.sub("", sample)
            if bare != sample and mark not in bare and re.search(rf"\d[{point}]\d", bare):
                return groups.sub(lambda m, mark=mark: m[0].replace(mark, ""), text)
    return text


def without_numpy(text: str) -> str:
    """Numbers that are printed as `np.float64(0.1)` without their type."""
    return _NUMPY.sub(r"\1", text)


def _stamp(match: re.Match[str]) -> str:
    """The time at the start of a line as a cell."""
    if match[4]:
        return f"{int(match[4][:15]) / 1000}"
    if match[3]:
        return f"{float(match[2][:15]) / {'s': 1, 'ms': 1e3, 'us': 1e6}[match[3]]!r}"
    return match[2] or match[1].replace(" ", "T").replace(",", ".")


def _apart(match: re.Match[str]) -> str:
    """The numbers of a named list with a name each."""
    numbers = _NUMBERS.split(match[2].strip())[:_LONGEST_LIST]
    return " ".join(f"{match[1]}.{k}:{number}" for k, number in enumerate(numbers))


def is_clock(cell: str) -> bool:
    """Whether a cell is a time of day, with or without a date."""
    return _CLOCK.fullmatch(cell.strip()) is not None


def _shape(rows: Sequence[str]) -> _Shape | None:
    """The way in which most cells of the rows are numbers."""
    best, most = None, 0.0
    for separator in _SEPARATORS:
        split = [_split(row, separator) for row in rows]
        columns = Counter(map(len, split)).most_common(1)[0][0]
        cells = [row for row in split if len(row) == columns]
        if columns < 2 or len(cells) < _SAME_SHAPE * len(split):
            continue
        quoted = any('"' in row for row in rows)
        for comma in (False, True) if separator != "," or quoted else (False,):
            shares = [
                sum(_number(row[k], comma) for row in cells) / len(cells) for k in range(columns)
            ]
            full = tuple(any(row[k] for row in cells) for k in range(columns))
            units = {k: unit for k, share in enumerate(shares)
                     if share < _NUMERIC and separator != " "
                     and (unit := unit_behind([row[k] for row in cells], comma))}  # fmt: skip
            hexed = _hexadecimal(cells)
            shares = [1.0 if k in units or k in hexed else s for k, s in enumerate(shares)]
            if sum(shares) > most * columns:
                most = sum(shares) / columns
                numeric = tuple(s >= _NUMERIC and f for s, f in zip(shares, full, strict=True))
                counted = _counted([row[0] for row in cells])
                clocked = all(is_clock(row[0]) for row in cells)
                blank = tuple(not f for f in full)
                best = _Shape(separator, comma, columns, numeric, units, hexed, counted, clocked,
                              blank)  # fmt: skip
    return best if best is not None and any(best.numeric) else None


def unit_behind(cells: Sequence[str], comma: bool = False) -> str:
    """The one unit that stands behind each number of these cells; empty for none."""
    matches = (_WITH_UNIT.fullmatch(cell) for cell in cells if cell)
    words = {m[2] if m and _number(m[1], comma) else "" for m in matches}
    return words.pop() if len(words) == 1 else ""


def with_unit(name: str, unit: str) -> str:
    """The name of a column with its unit behind it."""
    return f"{name} [{'percent' if unit == '%' else unit}]"  # marks separate words of names


def _hexadecimal(cells: Sequence[Sequence[str]]) -> dict[int, int]:
    """Columns of hexadecimal numbers; of signed ones the numbers of their bits, else 0.

    They are of one width, or of many values, and some have a letter; without one in these rows a
    column is hexadecimal where its cells are as wide as those of another that is, and do not rise
    as times do. `1E05` is no such number by itself, nor are a few labels such as `a1`.
    """
    columns: dict[int, list[str]] = {}
    marked = set()
    for k, column in enumerate(zip(*cells, strict=True)):
        matches = [_HEX_CELL.fullmatch(cell) for cell in column if cell]
        if matches and all(matches):
            columns[k] = [m[1].lower() for m in matches if m]
            if all(m and m[2] for m in matches):
                marked.add(k)
    widths = {k: {*map(len, texts)} for k, texts in columns.items()}
    certain = {
        k for k, texts in columns.items()
        if (k in marked or any({*cell} & {*"abcdf"} for cell in texts))
        and 2 * sum(map(str.isalpha, texts)) < len(texts)
        and ((len(widths[k]) == 1 and min(widths[k]) > 2) or len({*texts}) > _LABELS)
    }  # fmt: skip
    wide = [widths[k] for k in certain if len(widths[k]) == 1]
    signed = {}
    for k, texts in columns.items():
        resembles = len(widths[k]) == 1 and widths[k] in wide and texts != sorted(texts)
        if k in certain or resembles:
            turn = 16 ** len(texts[0])
            numbers = [int(cell, 16) for cell in texts]
            near = all(min(n, turn - n) < turn / 4 for n in numbers)
            below = len(widths[k]) == 1 and len(texts[0]) in (4, 8) and max(numbers) >= turn / 2
            signed[k] = turn if near and below else 0
    return signed


def _counted(cells: Sequence[str]) -> bool:
    """Whether cells are whole numbers, each greater by one than the one before."""
    numbers = [int(cell) for cell in cells if _WHOLE.fullmatch(cell)]
    return len(numbers) == len(cells) and numbers == [*range(numbers[0], numbers[0] + len(cells))]


def _rewritten(text: str, lines: list[str], bare: list[int], shape: _Shape) -> Plain:
    """The text of a table of this shape, its names apart."""
    first = next((n for n in bare if _is_row(lines[n], shape)), None)
    if first is None:
        return Plain(text)
    complete = next((n for n in bare if _is_row(lines[n], shape, complete=True)), first)
    for cells in (_split(lines[n], shape.separator) for n in bare if first < n < complete):
        if len(cells) == shape.columns and all(
            cell and not _number(cell, shape.comma)
            for cell, number in zip(cells, shape.numeric, strict=True) if number
        ):  # fmt: skip
            first = complete  # lines above the names have as many cells, some of them numbers
    before = [n for n in bare if n < first]
    notes, columns, units, numbered = [], None, [], ""
    if before and (cells := _units(lines[before[-1]], shape)) and len(before) > 1:
        units = cells
        before.pop()
    if before and all(map(is_decimal, _split(lines[before[-1]], shape.separator))):
        lines[before.pop()] = ""  # the end of a row, where a monitor was opened
    if before:
        columns = _names(lines[before[-1]], shape)
        if columns is None or len(columns) != shape.columns:
            if columns and shape.separator == ",":  # its reader says which line has how many cells
                return Plain(text)
    else:
        comments = [line for line in lines[:first] if _COMMENT.match(line)]
        columns = next((c for c in map(lambda x: _named_in(x, shape), comments[:-4:-1]) if c), None)
        if columns is not None:
            notes.append("the names of its columns were taken from a comment")
    spaced = shape.separator == " "
    whole = columns is not None and len(columns) == shape.columns
    while (
        columns and whole and not spaced and len(before) > 1 and len({*columns, ""}) <= len(columns)
    ):
        above = _names(lines[before[-2]], shape)  # names in several lines, as of groups
        if above is None or len(above) != shape.columns:
            break
        for k in range(1, len(above)):  # a cell over several columns
            above[k] = above[k] or above[k - 1]
        columns = [f"{a}.{b}".strip(".") for a, b in zip(above, columns, strict=True)]
        lines[before.pop(-2)] = ""
    if columns and whole:
        above = (_units_above(line, shape) for line in lines[:first])
        units = units or next(filter(None, above), [])
        columns = _once(columns, [_split(row, shape.separator) for row in lines[first:]])
        unnamed = [k for k, name in enumerate(columns) if not name and shape.numeric[k] and k]
        named = [name for name in columns if name]
        if "send_time_s" not in named and (unnamed or len({*named}) < len(named)):
            twice = next((n for n in named if named.count(n) > 1), "")
            called = f"two columns would be called {twice}. Rename one of them"
            columns, numbered = None, called if twice else "some columns have no names"
    if columns is None:
        numbered = numbered or "its columns have no names"
        columns = [str(k) for k in range(shape.columns)]
        columns[0] = "time_of_day" if shape.clocked else "0"
        if shape.numeric == (True, False, True):  # 0.01 CMD 0.3
            columns, numbered = [columns[0].replace("0", "time"), "name", "value"], ""
    for k, word in [*enumerate(units), *shape.units.items()]:
        if k < len(columns) and word not in ("", "-", "1"):
            columns[k] = with_unit(columns[k], word)
    if units:
        notes.append("a line beside the names was taken for their units")
    if (above := len(before) - (not numbered)) > 0:
        what = "the numbers" if numbered else "the names of the columns"
        notes.append(f"{above} line{'s' if above > 1 else ''} above {what} left out")
    if shape.separator != ",":
        notes.append(f"cells are separated by {_NAMES_OF[shape.separator]}")
    if shape.hexed:
        notes.append("numbers of some columns are hexadecimal")
    if shape.comma:
        notes.append("numbers have decimal commas")
    start = sum(len(line) + 1 for line in text[:_SAMPLE].split("\n")[:first])
    head = "\n".join(line if line[:1] == "#" else "" for line in lines[:first])
    body = text[start:]
    if before and (names := lines[before[-1]]) in body:  # as appended passes have them
        body = re.sub(rf"^{re.escape(names)}$", "", body, flags=re.MULTILINE)
    body = _cells(body, shape)
    while len(columns) > 2 and not columns[-1]:  # each row ends with a separator
        columns = columns[:-1]
        body = re.sub(r",[ \t]*$", "", body, flags=re.MULTILINE)
    return Plain(f"{head}\n{body}" if first else body, columns, numbered, _sentence(notes))


def _cells(body: str, shape: _Shape) -> str:
    """Rows with commas between cells and points in numbers."""
    if any(mark in body for mark in ("%", "//", "!")):
        body = re.sub(r"^[ \t]*(?:%|//|!).*$", "", body, flags=re.MULTILINE)
    quoted = '"' in body and (shape.separator != "," or shape.comma)
    commas = shape.separator != "," and "," in body and not shape.comma
    if quoted or commas or shape.units or shape.hexed:
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        for line in body.split("\n"):
            if line[:1] == "#" or not line.strip():
                out.write(f"{line}\n")
                continue
            cells = _split(line, shape.separator)
            numerals = (_numeral(c, k, shape) for k, c in enumerate(cells))
            writer.writerow([c if n is None else n for c, n in zip(cells, numerals, strict=True)])
        body = out.getvalue().removesuffix("\n")
    elif shape.separator != ",":
        if shape.comma:
            body = body.replace(",", ".")
        if shape.separator == " ":
            body = re.sub(r"^[ \t]+|[ \t]+$", "", body, flags=re.MULTILINE)
            body = re.sub(r"[ \t]+", ",", body)
        else:
            body = body.replace(shape.separator, ",")
    return body


def _numbered(matches: Iterable[re.Match[str]]) -> dict[str, re.Match[str]]:
    """Pairs of a line by name; those that it has twice are of several joints, and get numbers."""
    pairs = [*matches]
    names = [m[1] for m in pairs]
    numbers = [f"_{names[:k].count(n) + 1}" * (names.count(n) > 1) for k, n in enumerate(names)]
    return {m[1] + number: m for m, number in zip(pairs, numbers, strict=True)}


def _labels(sample: Sequence[str]) -> tuple[re.Pattern[str], list[str]] | None:
    """How to find the pairs of name and number that most lines have, and their names.

    Lines with a few sets of names may take turns.
    """
    styles = []
    enough = _SAME_SHAPE * len(sample)
    for pattern in (_PAIR, _LONG_PAIR):
        labelled = [_numbered(pattern.finditer(line)) for line in sample]
        named = Counter(map(tuple, labelled)).most_common(_LABELS)
        named = named[: 1 if named[0][1] >= enough else None]
        kinds = [kind for kind, n in named if n >= _OFTEN * len(sample)]
        most = sum(n for kind, n in named if kind in kinds)
        names = list(dict.fromkeys(name for kind in kinds for name in kind))
        first = next((pairs for pairs in labelled if [*pairs] == [*kinds[0]]), {}) if kinds else {}
        times = {*Counter(m[1] for m in first.values()).values()}
        if most >= enough and all(kinds) and len(names) > len(times) == 1 < len(names) / max(times):
            styles.append((max(times), pattern, names))
    return min(styles, key=lambda style: style[0])[1:] if styles else None


def _labelled(
    text: str, sample: Sequence[str], pattern: re.Pattern[str], names: list[str]
) -> Plain:
    """Lines such as `t:0.1,cmd:0.3` (serial plotters, monitors) as rows; others are left empty."""
    labelled = [_numbered(pattern.finditer(line)) for line in sample]
    units = [{pairs[name][3] for pairs in labelled if name in pairs} for name in names]
    columns = [
        with_unit(name, unit) if len(words) == 1 and (unit := next(iter(words))) else name
        for name, words in zip(names, units, strict=True)
    ]
    ahead = [float(m[1]) for line in sample if (m := _AHEAD.match(line))]
    steps = {b - a for a, b in pairwise(ahead)}
    timed = len(ahead) == len(sample) and min(steps) >= 0 and not steps <= {0, 1}
    rows, others = [], 0
    stamped = False
    for line in text.split("\n"):
        pairs = _numbered(pattern.finditer(line))
        same = bool(pairs) and pairs.keys() <= {*names}
        stamp = (_AHEAD if timed else _STAMPED).match(line) if same else None
        stamped = stamped or (stamp is not None and not any(rows))
        cells = [pairs[name][2] if name in pairs else "" for name in names] if same else []
        if stamped and same:
            cells = ["" if stamp is None else stamp[1] if timed else _stamp(stamp), *cells]
        rows.append(",".join(cells))
        others += not same and bool(line.strip())
    notes = ["its lines are pairs of name and number"]
    notes += [f"{others} other lines were left out"] if others else []
    clock = ["stamp" if timed else "time_of_day"] if stamped else []
    return Plain("\n".join(rows), [*clock, *columns], notes=_sentence(notes))


def _teleplot(text: str) -> Plain:
    """Lines of Teleplot, `>name:milliseconds:value` or `>name:value`, one value each."""
    readings = _TELEPLOT.findall(text)
    if all(stamp for _, stamp, _ in readings):
        rows = [f"{stamp},{name},{value}" for name, stamp, value in readings]
        return Plain("\n".join(rows), ["time_ms", "name", "value"])
    columns: dict[str, list[str]] = {}
    for name, _, value in readings:
        columns.setdefault(name, []).append(value)
    return Plain("\n".join(map(",".join, zip(*columns.values(), strict=False))), [*columns])


def _influx(text: str) -> Plain:
    """Lines of InfluxDB's protocol: `servo,joint=knee goal=0.1,present=0.09 1700000000000000`."""
    rows = [
        {name: value for pair in f"{tags[1:]},{fields},time={stamp}".split(",")
         for name, _, value in [pair.partition("=")] if name}
        for tags, fields, stamp in _INFLUX.findall(text)
    ]  # fmt: skip
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = (",".join(re.sub(r"(?<=\d)[iu]$", "", row.get(n, "")) for n in names) for row in rows)
    return Plain("\n".join(cells), names)


def _unlisted(text: str, lines: list[str], bare: list[int], rows: Sequence[str]) -> str | None:
    """The text with a cell per number where a cell held a list (`"[0.1, 0.2]"`)."""

    def count(match: re.Match[str]) -> str:
        return f"@{len(_NUMBERS.split(match[1]))}"

    counted = [_LIST.sub(count, row) for row in rows]
    for separator in _SEPARATORS:
        cells = _split(counted[0], separator)
        names = _split(lines[bare[0]], separator)
        alike = sum(_sizes(row, separator) == _sizes(counted[0], separator) for row in counted)
        if len(cells) > 1 and len(names) == len(cells) and alike >= _SAME_SHAPE * len(rows):
            break
    else:
        return None
    wide = [
        name if cell[:1] != "@" else separator.join(f"{name}.{k}" for k in range(int(cell[1:])))
        for name, cell in zip(names, cells, strict=True)
        if cell[:1] != "@" or int(cell[1:]) <= _LONGEST_LIST
    ]
    start = sum(len(line) + 1 for line in lines[: bare[0]])
    head, body = text[:start], text[start + len(lines[bare[0]]) :]
    body = _LIST.sub(lambda match: separator.join(_NUMBERS.split(match[1])), body)
    return head + separator.join(wide) + body


def _sizes(row: str, separator: str) -> list[str]:
    """Cells of a row, those that are no lists left empty."""
    return [cell if cell[:1] == "@" else "" for cell in _split(row, separator)]


def _sentence(notes: Sequence[str]) -> list[str]:
    return [f"read as a table: {'; '.join(notes)}."] if notes else []


def _split(line: str, separator: str) -> list[str]:
    if separator == " " and '"' not in line:
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    try:
        reader = csv.reader([line], delimiter=separator, skipinitialspace=separator == " ")
        return [c.strip() for c in next(reader, [])]
    except csv.Error:
        return [cell.strip() for cell in line.split(separator)]


def _number(cell: str, comma: bool) -> bool:
    """Whether a cell of a table of numbers is one, empty, or a time of day."""
    if not is_decimal(cell):
        return not cell or is_clock(cell) or bool(comma and _COMMA_NUMBER.fullmatch(cell))
    return not (comma and "." in cell)


def _numeral(cell: str, k: int, shape: _Shape) -> str | None:
    """The number in a cell of column `k` as a decimal numeral; None if it holds none."""
    if k in shape.units and (match := _WITH_UNIT.fullmatch(cell)):
        cell = match[1]
    elif k in shape.hexed and (match := _HEX_CELL.fullmatch(cell)):
        number, turn = int(match[1], 16), shape.hexed[k]
        return str(number - turn if turn and 2 * number >= turn else number)
    return cell.replace(",", ".") if _number(cell, shape.comma) else None


def _is_row(line: str, shape: _Shape, complete: bool = False) -> bool:
    """Whether a line is a row of the table rather than its names, units or a remark.

    Of a whole row all cells are numbers where the others' are, rather than most of them.
    """
    cells = _split(line, shape.separator)
    if len(cells) != shape.columns:
        return False
    full = [(k, c) for k, c in enumerate(cells) if c]
    if any(shape.blank[k] and not _number(c, shape.comma) for k, c in full):
        return False
    numbers = [_numeral(c, k, shape) is not None for k, c in full if shape.numeric[k]]
    return sum(numbers) > (len(numbers) - 1 if complete else len(numbers) / 2)


def _names(line: str, shape: _Shape) -> list[str] | None:
    """Names of the columns in a line, whose separators may differ from those of the rows."""
    tied = re.sub(r"(?<!\s)\s+(?=[(\[])", "_", line.strip())  # time (s): a name and its unit
    ways = [_split(line, shape.separator), _split(tied, shape.separator)]
    if not _REMARK.match(line.split(maxsplit=1)[0]) or shape.separator == " ":
        spaced = re.split(r"\s{2,}|\t", line.strip())
        ways += [spaced, _split(line, ","), _split(line, ";"), tied.split()]
    for cells in ways:
        if len(cells) == shape.columns - 1 and not shape.numeric[-1]:
            cells = [*cells, ""]
        if len(cells) == shape.columns + 1 and cells[-1].lower() in ("comment", "remark", "note"):
            cells = cells[:-1]
        if len(cells) == shape.columns - 1 and (shape.counted or shape.clocked):
            cells = ["row" if shape.counted else "time_of_day", *cells]
        if shape.clocked and is_clock(cells[0]):  # a monitor's, before the names
            cells[0] = "time_of_day"
        if len(cells) == shape.columns and not any(is_decimal(c) for c in cells if c):
            return cells
    return ways[0] if len(ways[0]) > 1 else None


def _named_in(comment: str, shape: _Shape) -> list[str] | None:
    """Names of the columns in a comment; None if it has others, or none."""
    text = re.sub(r"^[ \t]*(?:#|%|//|!)+[ \t]*", "", comment)
    for part in (text, text.partition(":")[2]):
        cells = _names(part, shape) if part.strip() else None
        if cells is not None and len(cells) == shape.columns and len(set(cells)) == len(cells):
            return cells
    return None


def _units(line: str, shape: _Shape) -> list[str]:
    """Units of the columns in the line below their names; empty if it has none."""
    cells = _split(line, shape.separator)
    if len(cells) != shape.columns or not all(_UNIT.fullmatch(c) for c in cells if c):
        return []
    units = [c.strip("()[]<>{} ") for c in cells]
    return units if sum(map(bool, units)) > 1 else []


def _units_above(line: str, shape: _Shape) -> list[str]:
    """Units of the columns in a line above their names, as LabVIEW's `Y_Unit_Label`, or a comment.

    Without an angle's among them there are none: volts are LabVIEW's own, whatever was measured.
    """
    bare = line[mark.end() :] if (mark := _COMMENT.match(line)) else line
    for separator in (shape.separator, ","):
        head, *cells = _split(bare, separator) or [""]
        if "unit" in head.lower():
            head = head.partition(":")[2].strip()
        cells = [head, *cells, *[""] * shape.columns][: shape.columns]
        if all(_UNIT.fullmatch(c) for c in cells if c) and any(map(_ANGLE_UNIT.fullmatch, cells)):
            return [c.strip("()[]<>{} ") for c in cells]
    return []


def _once(columns: list[str], rows: list[list[str]]) -> list[str]:
    """Names of columns, where one that repeats another, cells included, is called an index."""
    full = [row for row in rows if len(row) >= len(columns)]
    names = [*columns]
    for k, name in enumerate(columns):
        first = columns.index(name)
        if name and first < k and all(row[first] == row[k] for row in full):
            names[k] = f"index {k}"
    return names


_HIGH = re.compile(rb"[\x80-\xff]+")
_BINARY = {
    b"MATLAB 7.3": ("a MATLAB file of version 7.3", "save it again with save(name, '-v7')"),
    b"MATLAB": ("a damaged MATLAB file", "save it again with save(name, '-v7')"),
    b"\x89HDF\r\n": ("an HDF5 file", "pandas.read_hdf or h5py reads it; write it with to_csv"),
    b"ARROW1": ("a feather file", "write it with pandas.read_feather(path).to_parquet"),
    b"\xd0\xcf\x11\xe0": ("a spreadsheet", "save it as CSV"),
    b"ULog": ("a PX4 log", "convert it with ulog2csv"),
    b"#ROSBAG": ("a bag of ROS 1", "convert it with `rosbags-convert` to rosbag2"),
    b"\x80\x04\x95": ("a pickle, which can hold programs", "write its arrays with numpy.savez"),
}
"""First bytes of files that are read by other programs, and what to do with them."""


def decoded(path: object, data: bytes) -> str:
    """Text in UTF-8 or UTF-16, with or without a byte order mark, GB 18030, or Windows-1252.

    Letters with accents stand alone in words of Windows-1252; where bytes above 127 stand side by
    side throughout, they are Chinese characters.

    Zeros at the end, where a file system lost the last rows, are left out.
    """
    for first, (kind, cure) in _BINARY.items():
        if data.lstrip(b"\xef\xbb\xbf \r\n").startswith(first):
            raise InputError(f"{path} is {kind}, which is not read: {cure}, then give that file.")
    wide = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}.get(data[:2])
    if wide is None and b"\0" in data[:2]:
        wide = "utf-16-be" if data[:1] == b"\0" else "utf-16-le"
    chinese = all(len(run) % 2 == 0 for run in _HIGH.findall(data[:_SAMPLE]))
    others = "cp1252", "cp932", "latin-1"
    for coding in (wide,) if wide else ("utf-8-sig", *["gb18030"] * chinese, *others):
        try:
            text = data.decode(coding).rstrip("\0")
        except ValueError:
            continue
        usual = sum(32 <= ord(c) < 127 or c in "\t\r\n" for c in text[:_SAMPLE])
        enough = coding == "utf-8-sig" or usual > _USUAL * max(len(text[:_SAMPLE]), 1)
        if "\0" not in text and enough:
            return text
    raise InputError(f"{path} is not a text file. Give the log as it was written.")
