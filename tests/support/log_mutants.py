"""Logs of other tools, damaged: bytes, rows and columns changed by a seeded generator.

`mutant(rng, seeds)` takes one of `seeds`, whole files by name, and damages it once to three times,
as transfers, editors, spreadsheets and loggers do; some mutants are packed. `stated` invents what a
user may state of a log.
"""

import bz2
import gzip
import io
import lzma
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

TOKENS = [
    b"nan", b"inf", b"1e400", b"-1e308", b"1e-320", b"9" * 400, b"4_1", "٤١".encode(), b"0x7f",
    b'"x"', b"", b"null", b"[1, 2]", b'{"a": 1}', b"true", b"-Infinity", str(2**63).encode(), b"0",
    b"-1", b"\x1b[2J", "\u202egnp".encode(), b"x" * 100_000, b"\0", b"\xff\xfe", b"[" * 5000, b"\n",
    b",", b";", b"\t", b"# a: 1\n", b"\xef\xbb\xbf", b"\r", b"1.2.3", b"12:30:61", b"3,141", b"%",
    b"2026-13-45T99:00:00", b"1" * 19, b"-0", b"1e5", b"FFFF", b"'", b'"', b"deg", b"ms", b"time",
    b"command", b"position", b"joint", b"{joint}", b"\xc2\xb0", b"1.#INF", b"NULL", b"#N/A",
]  # fmt: skip
NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.])")
NAME = re.compile(rb"[A-Za-z][A-Za-z_]{2,}")
SEPARATORS = [b",", b";", b"\t", b" ", b"|", b"  "]
FACTORS = [1e3, 1e-3, 1e6, 1e9, -1.0, 0.0, 180 / np.pi, 4096 / (2 * np.pi), 1e18, 1e300, 1e-300]
Change = Callable[[np.random.Generator, bytes], bytes]


def _flip(rng: np.random.Generator, data: bytes) -> bytes:
    at = int(rng.integers(len(data)))
    return data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :]


def _pieces(rng: np.random.Generator, data: bytes) -> bytes:
    first, last = sorted(rng.integers(len(data) + 1, size=2).tolist())
    return (data[:first], data[:first] + data[last:], data[:last] + data[first:],
            data[last:] + data[first:last] + data[:first])[rng.integers(4)]  # fmt: skip


def _insert(rng: np.random.Generator, data: bytes) -> bytes:
    at = int(rng.integers(len(data) + 1))
    return data[:at] + TOKENS[rng.integers(len(TOKENS))] + data[at:]


def _replace(rng: np.random.Generator, data: bytes) -> bytes:
    matches = [*(NUMBER, NAME)[rng.integers(2)].finditer(data)]
    if not matches:
        return data
    match = matches[rng.integers(min(len(matches), 12) if rng.random() < 0.5 else len(matches))]
    return data[: match.start()] + TOKENS[rng.integers(len(TOKENS))] + data[match.end() :]


def _separated(rng: np.random.Generator, data: bytes) -> bytes:
    old, new = rng.choice(len(SEPARATORS), 2, replace=False)
    return data.replace(SEPARATORS[old], SEPARATORS[new])


def _spelled(rng: np.random.Generator, data: bytes) -> bytes:
    spellings = [(b".", b","), (b"\n", b"\r\n"), (b"\n", b"\r"), (b"-", b"\xe2\x88\x92"),
                 (b"e", b"E"), (b'"', b""), (b"\n", b"\n\n"), (b"_", b" ")]  # fmt: skip
    return data.replace(*spellings[rng.integers(len(spellings))])


def _coded(rng: np.random.Generator, data: bytes) -> bytes:
    coding = ("utf-16", "utf-16-le", "utf-32", "utf-8-sig", "cp1252", "gb18030")[rng.integers(6)]
    return data.decode("utf-8", "replace").encode(coding, "replace")


def _of_lines(change: Callable[[np.random.Generator, list[bytes]], list[bytes]]) -> Change:
    return lambda rng, data: b"\n".join(change(rng, data.split(b"\n")))


def _rows(rng: np.random.Generator, lines: list[bytes]) -> list[bytes]:
    """Rows twice, backwards, in no order, thinned, or two passes."""
    head, rows = lines[:1], lines[1:]
    order = np.arange(len(rows))
    orders = (np.repeat(order, 2), order[::-1], rng.permutation(order), order[rng.random(len(order))
              < rng.random()], np.tile(order, 2), order[: rng.integers(6)])  # fmt: skip
    return head + [rows[k] for k in orders[rng.integers(len(orders))]]


def _columns(rng: np.random.Generator, lines: list[bytes]) -> list[bytes]:
    """A column twice, left out, moved, emptied, constant, or scaled."""
    mark = max(SEPARATORS[:5], key=lambda s: min(line.count(s) for line in lines[:5] or [b""]))
    table = [line.split(mark) for line in lines]
    wide = max(map(len, table))
    k, other, way = int(rng.integers(wide)), int(rng.integers(wide)), int(rng.integers(8))
    factor = FACTORS[rng.integers(len(FACTORS))]
    token = TOKENS[rng.integers(len(TOKENS))]
    first = int(rng.integers(3))  # names may stay
    part = rng.random() if rng.random() < 0.5 else 1.0
    for n, cells in enumerate(table):
        if len(cells) <= max(k, other) or n < first or rng.random() > part:
            continue
        if way == 0:
            cells.insert(other, cells[k])
        elif way == 1:
            del cells[k]
        elif way == 2:
            cells[k], cells[other] = cells[other], cells[k]
        elif way == 3:
            cells[k] = b""
        elif way == 4:
            cells[k] = token
        elif way == 5:
            cells[k] = cells[other]
        else:
            try:
                cells[k] = repr(float(cells[k]) * factor).encode()
            except ValueError:
                continue
    return [mark.join(cells) for cells in table]


CHANGES: Sequence[Change] = (
    _flip, _flip, _pieces, _pieces, _insert, _replace, _replace, _replace, _separated, _spelled,
    _coded, _of_lines(_rows), _of_lines(_columns), _of_lines(_columns), _of_lines(_columns),
)  # fmt: skip


def _zipped(data: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("log.csv", data)
    return out.getvalue()


PACKERS: Sequence[Callable[[bytes], bytes]] = (
    gzip.compress, bz2.compress, lzma.compress, _zipped, lambda data: b"\x28\xb5\x2f\xfd" + data,
    lambda data: gzip.compress(_zipped(data)), lambda data: 2 * gzip.compress(data),
)  # fmt: skip


def mutant(rng: np.random.Generator, seeds: Mapping[str, bytes]) -> tuple[str, bytes]:
    """Name of a seed, and its damaged content."""
    name = [*seeds][int(rng.integers(len(seeds)))]
    data = seeds[name]
    for _ in range(1 + rng.binomial(2, 0.25)):
        if data:
            data = CHANGES[int(rng.integers(len(CHANGES)))](rng, data)
    if rng.random() < 0.1:
        data = PACKERS[int(rng.integers(len(PACKERS)))](data)
        if rng.random() < 0.5:
            data = (_flip, _pieces)[int(rng.integers(2))](rng, data)
    return name, data


def stated(rng: np.random.Generator) -> dict[str, Any]:
    """Options that a user may give; a third of the time none."""
    choices: dict[str, list[Any]] = {
        "time": ["0", "time", "t", "9", "", "1,0", "{joint}"],
        "command": ["1", "cmd", "goal", "{joint}_cmd", "1,2", "q_des[{joint}]", "{joint}"],
        "position": ["2", "pos", "present", "{joint}_pos", "3,4", "q[{joint}]", "{joint}"],
        "trial": ["0", "phase", "trial", "3"],
        "unit": ["deg", "turns", "counts:4096", "counts:8192:0", "percent:3", "scale:1e-9",
                 "deg,rad"],
        "rate": [30.0, 1000.0, 1e5, 0.1], "send_after": ["3ms", "-250us", "0s", "1s"],
        "command_time": ["0", "t_cmd", "time"], "readings": ["live", "polled"],
        "read_before_send": [True, False], "stamp": ["start", "middle", "end"],
        "joints": [["knee"], {"joint": "hip"}, {"a": "b", "c": "b"}], "units": [{"knee": "deg"}],
    }  # fmt: skip
    if rng.random() < 0.7:
        return {}
    names = [n for n in choices if rng.random() < 0.2]
    if {"command", "position"} & {*names}:
        names = list(dict.fromkeys([*names, "command", "position"]))
    return {n: choices[n][rng.integers(len(choices[n]))] for n in names}
