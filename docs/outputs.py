"""What the commands of a page print, in the page: a block of text behind a block of commands.

A block ```` ```text ```` that follows a block ```` ```console ```` directly holds what its commands
print on a terminal of 80 columns. `python docs/outputs.py docs/tutorial.md` runs the page in an
empty folder, writes these blocks anew and copies the pictures that it shows; the tests run it, too,
and compare (`tests/test_docs.py`).
"""

from __future__ import annotations

import importlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

BLOCK = re.compile(r"```console\n(?P<commands>.*?)```\n\n```text\n(?P<output>.*?)```", re.DOTALL)
_CONSOLE = re.compile(r"```console\n(.*?)```(?:\n\n```text\n.*?```)?", re.DOTALL)
_PICTURE = re.compile(r"<!-- (?P<made>\S+) -->\n!\[[^\]]*\]\((?P<shown>[^)]+)\)")
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_ELAPSED = re.compile(r"in \d+(?:\.\d+)? s\b")
_NEAR, _NEARER = 0.1, 0.11  # relative, and for small numbers in the last digit shown


def plain(printed: str) -> str:
    """What was printed, without the ends of lines and the time that it took."""
    lines = (line.rstrip() for line in printed.strip().splitlines())
    return _ELAPSED.sub("in … s", "\n".join(lines))


def differs(shown: str, printed: str) -> str:
    """How two outputs differ; empty if they do in the last digits only.

    On another processor the last digits of a fit are others, and with them the columns' widths.
    """
    before, now = " ".join(plain(shown).split()), " ".join(plain(printed).split())
    if _NUMBER.sub("#", before) != _NUMBER.sub("#", now):
        return f"it says\n{shown}\nand prints\n{printed}"
    for a, b in zip(_NUMBER.findall(before), _NUMBER.findall(now), strict=True):
        if abs(float(a) - float(b)) > max(_NEAR * abs(float(a)), _NEARER):
            return f"it says {a} and prints {b} in\n{printed}"
    return ""


def write(page: Path) -> None:
    """Run a page's commands and put what they print into it."""
    settings = os.environ | {"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"}
    with tempfile.TemporaryDirectory() as folder:

        def run(block: re.Match) -> str:
            printed = ""
            for line in block[1].splitlines():
                words = shlex.split(line.removeprefix("$ "))
                words[0] = str(Path(sys.executable).with_name(words[0]))
                done = subprocess.run(
                    words, cwd=folder, env=settings, capture_output=True, text=True, check=True
                )
                printed += done.stdout
            if "```text" not in block[0]:
                return block[0]
            return f"```console\n{block[1]}```\n\n```text\n{plain(printed)}\n```"

        text = _CONSOLE.sub(run, page.read_text())
        for picture in _PICTURE.finditer(text):
            shutil.copy(Path(folder) / picture["made"], page.parent / picture["shown"])
    page.write_text(text)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
    importlib.import_module("support.avx2")  # the same kernels as when the page is tested
    for name in sys.argv[1:]:
        write(Path(name))
