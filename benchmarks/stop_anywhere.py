"""Does Ctrl-C, SIGTERM or SIGHUP end every command, at any moment, with nothing left?

    .venv/bin/python benchmarks/stop_anywhere.py --cases 0:120 --log stops.jsonl    # 20 minutes
    .venv/bin/python benchmarks/stop_anywhere.py --table --log stops.jsonl

120 stops of eight commands, 60 while they start and 60 later, each signal sent alone and to the
process group. Moments are drawn in processor time of the command's session, so that a busy machine
does not shift them. A stop is right if

- the command ends within 1 s (training after two Ctrl-C, 1 s apart: 2 s after the second), times
  `--patience` for a machine that is busy with something else;
- stderr has "Stopped." once, as its last line, and no traceback, "error" or "defect"; of training
  whose iteration ended "finishing this iteration" instead;
- the exit code is 130, 143 or 129;
- no process of its session is left, no temporary file, no file that cannot be read.

Before the program's first line Python answers a signal itself, with its default action or a
traceback of its own. Such stops are counted apart ("Python"): they end, too, and leave nothing.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from shared import ROOT, print_rows

SAMPLES = ROOT / "data/samples"
SWEEP, CALIBRATION = str(SAMPLES / "sweep.csv"), str(SAMPLES / "calibrated.yaml")
POLICY = str(SAMPLES / "policies/mlp")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

COMMANDS: dict[str, tuple[float, tuple[str, ...]]] = {
    "sweep": (1.0, ("pupper_sysid", "sweep", "--freqs", "1-10", "--duration", "60", "--out",
                    "s.csv")),
    "delay": (3.0, ("pupper_sysid", "delay", SWEEP)),
    "calibrate": (3.0, ("pupper_sysid", "calibrate", SWEEP, "--out", "c.yaml")),
    "fleet": (3.0, ("pupper_sysid", "calibrate", "robots", "--jobs", "2")),
    "fit-servo": (6.0, ("pupper_sysid", "fit-servo", SWEEP, "--arch", "mlp", "--out", "servo")),
    "report": (3.0, ("pupper_sysid", "report", SWEEP, "--calibration", CALIBRATION, "--out",
                     "report")),
    "pupper-train": (15.0, ("pupper_train", "--actuator", CALIBRATION, "--environments", "64",
                           "--name", "run", "--threads", "1")),
    "pupper-eval": (6.0, ("pupper_eval", POLICY, "--threads", "2")),
}  # fmt: skip
"""By name: processor time until the work has begun [s], and the command."""
LATER_S = 5.0
"""Range of the later moments behind that [s]."""
LINES = ("Stopped.", "finishing this iteration; again ends at once")
WRONG = ("Traceback", "defect", "error:", "Exception ignored", "Error")


def drawn_cases() -> list[tuple[str, bool, int, bool, float]]:
    """Command, whether later, signal, whether to the group, and moment in processor time [s]."""
    rng = np.random.default_rng(39)
    every = [
        (name, later, number, group)
        for later in (False, True)
        for name in COMMANDS
        for number in SIGNALS
        for group in (False, True)
    ]
    chosen = []
    for later in (False, True):
        half = [case for case in every if case[1] == later]
        more = rng.choice(len(half), 60 - len(half), replace=False)
        chosen += [*half, *(half[k] for k in more)]
    moments = []
    for name, later, *_ in chosen:
        start = COMMANDS[name][0]
        moments.append(rng.uniform(start, start + LATER_S) if later else rng.uniform(0, start))
    order = rng.permutation(len(chosen))
    return [(*chosen[k], float(moments[k])) for k in order]


def processes(session: int) -> dict[int, float]:
    """Processor time of each process of a session that has not ended [s]."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            ticks = sum(map(int, fields[11:15]))  # with that of its children that have ended
            found[int(path.parent.name)] = ticks / os.sysconf("SC_CLK_TCK")
    return found


def not_ignored() -> None:
    """Have the signals act, though this may run in the background, where a shell ignores them."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL)


def stop_at(case: tuple[str, bool, int, bool, float], patience: float) -> dict[str, Any]:
    """Start the command, stop it at its moment, and say what came of it."""
    name, later, number, group, moment_s = case
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        if name == "fleet":
            (folder / "robots").mkdir()
            for k in range(4):
                shutil.copy(SWEEP, folder / "robots" / f"r{k}.csv")
        with (folder.with_suffix(".err")).open("w+b") as err:
            program, *arguments = COMMANDS[name][1]
            process = subprocess.Popen(
                [sys.executable, "-m", f"pupper_sysid.cli.programs.{program}", *arguments],
                cwd=folder, stdout=subprocess.DEVNULL, stderr=err, start_new_session=True,
                preexec_fn=not_ignored,
            )  # fmt: skip
            try:
                while process.poll() is None and (sum(processes(process.pid).values()) < moment_s):
                    time.sleep(0.01)
                early = process.poll() is not None
                took_s, presses = _stop(process, name, number, group)
                left = _left_after(process.pid, patience)
            finally:
                for one in processes(process.pid):
                    os.kill(one, signal.SIGKILL)
                process.wait()
            err.seek(0)
            said = err.read().decode(errors="replace")
        folder.with_suffix(".err").unlink()
        wrong = _wrong(said, process.returncode, number, took_s, patience, name, folder)
        if left:
            wrong.append(f"{left} processes left")
    verdict = "wrong" if wrong else "right"
    if wrong and not left and _by_python(said, process.returncode, number):
        verdict = "Python"
    return {
        "command": name, "later": later, "signal": number, "group": group, "moment_s": moment_s,
        "took_s": took_s, "presses": presses, "code": process.returncode,
        "load": os.getloadavg()[0], "verdict": "ended before" if early else verdict,
        "wrong": wrong, "said": said[-2000:],
    }  # fmt: skip


def _stop(
    process: subprocess.Popen[bytes], name: str, number: int, group: bool
) -> tuple[float, int]:
    """Send the signal, of training a second one; the time from the last one [s], and how many."""
    for presses in (1, 2):
        sent_s = time.monotonic()
        if process.poll() is None:
            (os.killpg if group else os.kill)(process.pid, number)
        first = name == "pupper-train" and number == signal.SIGINT and presses == 1
        try:
            process.wait(1.0 if first else 60.0)
            break
        except subprocess.TimeoutExpired:
            if not first:
                break
    return time.monotonic() - sent_s, presses


def _left_after(session: int, patience: float) -> int:
    until = time.monotonic() + patience
    while (left := len(processes(session))) and time.monotonic() < until:
        time.sleep(0.02)
    return left


def _wrong(
    said: str, code: int, number: int, took_s: float, patience: float, name: str, folder: Path
) -> list[str]:
    """What is not as it should be."""
    wrong = []
    limit = 2.0 if name == "pupper-train" else 1.0
    if took_s > limit * patience:
        wrong.append(f"took {took_s:.1f} s")
    if code != 128 + number:
        wrong.append(f"exit code {code}")
    lines = said.strip().splitlines()
    count, finished = lines.count(LINES[0]), LINES[1] in lines and name == "pupper-train"
    if not (count == 1 and lines[-1] == LINES[0]) and not (finished and count == 0):
        wrong.append("message")
    wrong += [f'"{word}"' for word in WRONG if word in said]
    for path in folder.rglob("*"):
        if path.name.startswith("."):
            wrong.append(f"{path.name} left")
        elif path.suffix == ".pt" and (not zipfile.is_zipfile(path)):
            wrong.append(f"{path.name} is cut off")
        elif path.is_file() and not path.stat().st_size:
            wrong.append(f"{path.name} is empty")
    return wrong


def _by_python(said: str, code: int, number: int) -> bool:
    """Whether the interpreter answered, before the program's first line."""
    before = ("pupper_sysid/cli/programs" not in said and "File" in said) or not said
    return before and code in (-number, 1, 130) and "Stopped." not in said


def print_table(rows: list[dict[str, Any]]) -> None:
    """Verdicts by command."""

    def cells(name: str) -> list[object]:
        chosen = [r for r in rows if name in (r["command"], "all")]
        took = [r["took_s"] for r in chosen if r["verdict"] != "ended before"]
        count = Counter((r["later"], r["verdict"]) for r in chosen)
        both = Counter(r["verdict"] for r in chosen)
        start = sum(n for (later, _), n in count.items() if not later)
        return [
            name, start, count[False, "right"], both["Python"], len(chosen) - start,
            count[True, "right"], both["ended before"], both["wrong"],
            f"{np.median(took):.2f}", f"{max(took):.2f}",
        ]  # fmt: skip

    print_rows(
        ("command", "stops at start", "right", "Python", "later", "right", "ended before", "wrong",
         "median s", "longest s"),
        map(cells, [*sorted({r["command"] for r in rows}), "all"]),
    )  # fmt: skip
    load = [r["load"] for r in rows]
    print(f"\nLoad average of the machine: {min(load):.0f} to {max(load):.0f}.")


def main(
    cases: str = "0:120", patience: float = 1.0, log: Path = Path("stops.jsonl"),
    table: bool = False,
) -> None:  # fmt: skip
    """Run the `cases` that the log lacks, and add a line each to it; then print the table."""
    lines = log.read_text().splitlines() if log.exists() else []
    rows = [json.loads(line) for line in lines]
    if not table:
        done, (first, _, last) = {row["case"] for row in rows}, cases.partition(":")
        for k, case in list(enumerate(drawn_cases()))[int(first) : int(last)]:
            if k in done:
                continue
            row = {"case": k} | stop_at(case, patience)
            with log.open("a") as file:
                file.write(json.dumps(row) + "\n")
            rows.append(row)
            print(k, *case[:4], f"{case[4]:.2f} s:", row["verdict"], *row["wrong"],
                  f"({row['took_s']:.2f} s)", flush=True)  # fmt: skip
    if rows:
        print_table(rows)


if __name__ == "__main__":
    tyro.cli(main)
