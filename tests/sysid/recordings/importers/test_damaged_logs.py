"""Logs of every form, damaged by chance: read, or refused in a sentence, in little time."""

import os
import runpy
import subprocess
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.sysid.recordings.files import load
from support.limited import limited
from support.log_mutants import mutant, stated

ROWS = 80
TABLE = "time,cmd,pos\n" + "".join(
    f"{0.01 * n:.2f},{0.3 * np.sin(0.08 * n):.6f},{0.3 * np.sin(0.08 * n - 0.3):.6f}\n"
    for n in range(ROWS)
)


def forms() -> Mapping[str, bytes]:
    """The logs of the other tests."""
    here = Path(__file__).parent
    tools = runpy.run_path(str(here / "test_tools_forms.py"))
    texts = runpy.run_path(str(here / "test_forms.py"))["FORMS"] | {"no names": tools["CSV"]}
    texts |= {name: log for name, (log, _) in {**tools["READ"], **tools["LINES"]}.items()}
    kinds = runpy.run_path(str(Path(__file__).parents[3] / "test_hostile_files.py"))
    for name in ("BAM", "ktune"):
        kinds["KINDS"][name].write(Path("."))
        texts[name] = Path(kinds["KINDS"][name].member).read_bytes()
    return {name: text if isinstance(text, bytes) else text.encode()
            for name, text in texts.items()}  # fmt: skip


@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_damaged_logs_are_read_or_refused_in_a_sentence(here, seed):
    """Damage and options by chance; no warning of Python's is left to the user, either."""
    seeds, count = forms(), 60 if seed == 1 else 2000
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        name, data = mutant(rng, seeds)
        options = stated(rng)
        Path("log.txt").write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                limited(lambda options=options: load("log.txt", options))
            except BaseException as error:
                error.add_note(f"mutant {number} of seed {seed}: {name}, {options}")
                raise


RUNS = ("x", "1", " ", "\t", "x.", "1,", "1 ", "a=", "a:[", "[1", "a=[1 ", '"[\n', '"[1]" ', "|",
        "1'", "a b ", "(1", ".", "->")  # fmt: skip


@pytest.mark.parametrize("place", [
    "first", "middle", pytest.param("every", marks=pytest.mark.slow)])  # fmt: skip
def test_long_runs_of_characters_are_answered_in_seconds(here, place):
    """No pattern that finds a dialect takes the square of a line's length."""
    lines = TABLE.splitlines()
    for run in RUNS:
        long = run * (60_000 // len(run))
        parts = {"first": [long, *lines], "middle": [*lines[:40], long, *lines[40:]],
                 "every": [line + long[:1000] for line in lines]}  # fmt: skip
        Path("log.txt").write_text("\n".join(parts[place]))
        limited(lambda: load("log.txt"))


FLIPS = """
import sys
from pathlib import Path
from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.recordings.importers.parquet import read_columns
data = Path(sys.argv[1]).read_bytes()
size = int.from_bytes(data[-8:-4], "little")
for at in range(len(data) - 8 - size, len(data) - 8):
    for bit in (0, 1, 2):
        damaged = data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
        try:
            read_columns(Path("log.parquet"), damaged, ["a"])
        except InputError:
            pass
print("all")
"""


@pytest.mark.slow
def test_damaged_footers_of_parquet_do_not_end_the_process(here):
    """Arrow raises for a histogram of another length in a reading, and aborts in its metadata."""
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    parquet.write_table(pyarrow.table({"a": [[0.1], [0.2]] * 40}), "log.parquet")
    command = [sys.executable, "-c", FLIPS, "log.parquet"]
    run = subprocess.run(command, capture_output=True, text=True, env=os.environ)
    assert run.stdout == "all\n", run.stderr[-500:]
