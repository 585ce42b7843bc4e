"""Ways to spoil any file: its content, or what its name stands for."""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np

Generator = np.random.Generator
MB100 = 100_000_000


def _text(change: Callable[[str, Generator], str]) -> Callable[[bytes, Generator], bytes | None]:
    """A change of text; None for content that is none."""

    def changed(data: bytes, rng: Generator) -> bytes | None:
        try:
            return change(data.decode(), rng).encode("utf-8", "surrogatepass")
        except UnicodeDecodeError:
            return None

    return changed


def _number(text: str, rng: Generator, new: str) -> str:
    """`text` with one of its numbers replaced; `{}` in the new one is the old."""
    found = list(re.finditer(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.])", text))
    if not found:
        return text
    at = found[int(rng.integers(len(found)))]
    return text[: at.start()] + new.replace("{}", at[0]) + text[at.end() :]


def _word(text: str, rng: Generator, new: str) -> str:
    """`text` with one of its names replaced."""
    found = list(re.finditer(r"[A-Za-z][A-Za-z_]{2,}", text))
    if not found:
        return text
    at = found[int(rng.integers(len(found)))]
    return text[: at.start()] + new + text[at.end() :]


def _flipped(data: bytes, rng: Generator) -> bytes:
    spoiled = bytearray(data)
    for at in rng.integers(0, len(spoiled), 20):
        spoiled[at] ^= 1 << int(rng.integers(8))
    return bytes(spoiled)


def _moved(data: bytes, rng: Generator) -> bytes:
    """Two pieces exchanged."""
    a, b = sorted(int(x) for x in rng.integers(0, len(data), 2))
    return data[b:] + data[a:b] + data[:a]


NUMBERS = {
    "a NaN": "nan", "YAML's NaN": ".nan", "an infinity": "inf", "1e400": "1e400",
    "-1e308": "-1e308", "1e-320": "1e-320", "400 digits": "9" * 400, "5000 digits": "9" * 5000,
    "4_1": "4_1", "Arabic digits": "٤١", "a hexadecimal": "0x7f", "a negative": "-{}",
    "a million times": "{}e6", "a text": '"x"', "nothing": "", "null": "null", "a list": "[1, 2]",
    "a mapping": '{"a": 1}', "true": "true", "NaN in JSON": "NaN",
    "Infinity in JSON": "-Infinity", "2**63": str(2**63), "half a number": "{}.5", "zero": "0",
}  # fmt: skip
WORDS = {
    "terminal escapes": "\x1b]0;x\x07\x1b[2J", "reversed text": "\u202egnp", "a path": "../../../x",
    "100,000 letters": "x" * 100_000, "a null": "\0", "a surrogate": "\ud800", "markup": "[red]<b>",
    "a formula": "=cmd|' /C calc'!A0", "a template": "{{7*7}}${x}", "nothing": "",
}  # fmt: skip

CONTENT: dict[str, Callable[[bytes, Generator], bytes | None]] = {
    "empty": lambda d, rng: b"",
    "blank": lambda d, rng: b"\n \n\t\n",
    "random bytes": lambda d, rng: rng.bytes(5000),
    "null bytes": lambda d, rng: d[: len(d) // 2] + bytes(50) + d[len(d) // 2 :],
    "UTF-16": _text(lambda t, rng: t.encode("utf-16").decode("latin-1")),
    "not UTF-8": lambda d, rng: d[: len(d) // 2] + b"\xe9\xff" + d[len(d) // 2 :],
    "half of it": lambda d, rng: d[: len(d) // 2],
    "a byte short": lambda d, rng: d[:-2],
    "twice": lambda d, rng: d + d,
    "pieces exchanged": _moved,
    "bits flipped": _flipped,
    "a byte order mark": lambda d, rng: b"\xef\xbb\xbf" + d,
    "old line ends": _text(lambda t, rng: t.replace("\n", "\r")),
    "100 MB of letters": lambda d, rng: b"x" * MB100,
    "100 MB of line ends": lambda d, rng: b"\n" * MB100,
    "100 MB of brackets": lambda d, rng: b"[" * MB100,
    "100 MB of braces": lambda d, rng: b"{}," * (MB100 // 3),
    "100 MB of commas": lambda d, rng: b"," * MB100,
    "100 MB behind it": lambda d, rng: d + bytes(MB100),
    "100 MB of comments": lambda d, rng: b"# a: 1\n" * (MB100 // 7),
    "a million names": lambda d, rng: b",".join(b"c%d" % k for k in range(10**6)) + b"\n" + d,
    "a million keys": lambda d, rng: b"{" + b",".join(b'"k%d":1' % k for k in range(10**6)) + b"}",
    "brackets in brackets": lambda d, rng: b"[" * 50_000 + b"]" * 50_000,
    "keys in keys": lambda d, rng: b'{"a":' * 500 + b"1" + b"}" * 500,
    "aliases of aliases": lambda d, rng: b"".join(
        [b'a0: &a0 "lol"\n',
         *(b"a%d: &a%d [%s]\n" % (k, k, b",".join([b"*a%d" % (k - 1)] * 9)) for k in range(1, 12))]
    ),
    "a Python object": lambda d, rng: b'!!python/object/apply:os.system ["touch executed"]\n',
    **{f"number: {n}": _text(lambda t, rng, new=new: _number(t, rng, new))
       for n, new in NUMBERS.items()},
    **{f"name: {n}": _text(lambda t, rng, new=new: _word(t, rng, new)) for n, new in WORDS.items()},
}  # fmt: skip
"""New content by name, from the content and a generator; None where it has no meaning."""

ALWAYS_REFUSED = (
    "empty", "blank", "random bytes", "100 MB of letters", "100 MB of line ends",
    "100 MB of brackets", "100 MB of braces", "100 MB of commas", "100 MB of comments",
    "a million keys", "brackets in brackets", "keys in keys", "aliases of aliases",
    "a Python object",
)  # fmt: skip


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(path))


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(20_000_000_000)


PLACES: dict[str, Callable[[Path], None]] = {
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "a socket": _socket,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a terminal": lambda path: path.symlink_to("/dev/tty"),
    "a link to itself": lambda path: path.symlink_to(path),
    "a link to nothing": lambda path: path.symlink_to("/nonexistent/x"),
    "20 GB of holes": _sparse,
    "the kernel's log": lambda path: path.symlink_to("/proc/kmsg"),
    "a process's memory": lambda path: path.symlink_to("/proc/self/mem"),
}
"""What stands at the name of a file, instead of it."""
