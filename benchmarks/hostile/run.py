"""Run one command in a child of a warm process, within limits, and say what came of it."""

from __future__ import annotations

import os
import re
import resource
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

CPU_S, WALL_S, MEMORY_BYTES = 30, 60, 4 << 30
HANG_S = 15.0
LARGE_BYTES = 2 << 30
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
PROGRAMS = (
    "pupper_sysid", "pupper_train", "pupper_play", "pupper_eval", "pupper_deploy", "pupper_analyze",
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What a command did.

    Attributes
    ----------
    verdict : str
        "sentence" (refused, exit code 1 or 2), "accepted" (0), or what is wrong: "defect", "hang",
        "memory", "killed", "unprintable", "no sentence".
    cpu_s : float
        Of the command and its children, without its start.
    memory_bytes : float
        Beyond that of the warm process.
    said : str
        The end of what it printed on stderr.
    """

    verdict: str
    cpu_s: float
    memory_bytes: float
    said: str

    @property
    def wrong(self) -> bool:
        """Whether it is a fault of the tool."""
        return self.verdict not in ("sentence", "accepted")


def warm() -> None:
    """Import what the commands import, so that children need not."""
    for name in PROGRAMS:
        import_module(f"pupper_sysid.cli.programs.{name}")
    for name in ("torch", "mujoco", "pyarrow.parquet", "mcap.stream_reader", "matplotlib.figure",
                 "pupper_sysid.policies.train.training", "pupper_sysid.policies.deploy.assembly",
                 "pupper_sysid.sysid.recordings.files", "pupper_sysid.sysid.doctor.examination",
                 "pupper_sysid.sysid.servo_fit.fit", "pupper_sysid.sim.walking.bus"):  # fmt: skip
        import_module(name)
    import torch

    torch.set_num_threads(1)


def run(argv: Sequence[str], folder: Path, stdout: str | None = None) -> Outcome:
    """Run `argv`, whose first word is a program's module, in `folder`.

    `stdout` is a file to print to instead of one that is looked at.
    """
    out, err = folder / ".stdout", folder / ".stderr"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    child = os.fork()
    if child == 0:
        _command(argv, folder, stdout or str(out), str(err))
    ended, status, usage = 0, 0, None
    started = time.monotonic()
    while not ended:
        ended, status, usage = os.wait4(child, os.WNOHANG)
        if not ended and time.monotonic() - started > WALL_S:
            os.killpg(child, signal.SIGKILL)
            ended, status, usage = os.wait4(child, 0)
            status = -1
        elif not ended:
            time.sleep(0.01)
    assert usage is not None
    cpu = usage.ru_utime + usage.ru_stime
    memory = max(usage.ru_maxrss * 1024 - before, 0)
    said = err.read_text(errors="replace") if err.exists() else ""
    printed = out.read_text(errors="replace") if out.exists() else ""
    verdict = _verdict(status, cpu, memory, said, printed)
    return Outcome(verdict, cpu, memory, " ".join(said.split())[-300:])


def _command(argv: Sequence[str], folder: Path, out: str, err: str) -> None:
    """The child: never returns."""
    code = 99
    try:
        os.setpgid(0, 0)
        os.chdir(folder)
        for number, name, flags in (
            (0, os.devnull, os.O_RDONLY), (1, out, os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
            (2, err, os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
        ):  # fmt: skip
            os.dup2(os.open(name, flags, 0o644), number)
        sys.stdin = os.fdopen(0)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", buffering=1)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MEMORY_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
        code = 0
        import_module(f"pupper_sysid.cli.programs.{argv[0]}").main(list(argv[1:]))
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        import traceback

        code = 98
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except (OSError, ValueError):
                code = 97 if code == 0 else code
        os._exit(code)


def _verdict(status: int, cpu_s: float, memory: float, said: str, printed: str) -> str:
    if status == -1 or cpu_s > HANG_S:
        return "hang"
    if memory > LARGE_BYTES or "MemoryError" in said:
        return "memory"
    if os.WIFSIGNALED(status):
        return "killed"
    code = os.WEXITSTATUS(status)
    if "Traceback" in said or "This is a defect" in said or code >= 97:
        return "defect"
    if _UNPRINTABLE.search(said) or _UNPRINTABLE.search(printed):
        return "unprintable"
    if re.search(r"\w+Warning: ", said):
        return "a library's warning"
    if code == 0:
        return "accepted"
    refused = "error: " in said or "For full helptext" in said  # the latter is tyro's
    return "sentence" if refused and code in (1, 2) else "no sentence"
