"""How every command ends: 0, or 2 for what the user gave, or 1, and never with a traceback.

`--debug` shows the traceback after all.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import tyro

from cli.terminal import err
from common.errors import PupperError

Options = TypeVar("Options")


def run_program(
    options: type[Options],
    work: Callable[[Options], None],
    program: str,
    description: str,
    arguments: Sequence[str] | None,
) -> None:
    """Parse a program's arguments into `options` and do its `work`; ends the process on errors."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    with user_errors(given, program) as rest:
        work(
            tyro.cli(
                options, args=rest, description=description, prog=program,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
        )  # fmt: skip


def end_politely() -> None:
    """End on SIGTERM and a closed terminal as on Ctrl-C: the robot is parked first."""

    def stop(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), stop)


@contextmanager
def user_errors(arguments: Sequence[str], program: str) -> Iterator[list[str]]:
    """Yields the arguments without `--debug`; what goes wrong inside becomes a sentence."""
    debug = "--debug" in arguments
    try:
        yield [a for a in arguments if a != "--debug"]
    except PupperError as error:
        if debug:
            raise
        err.print(f"[red]error:[/] {error}", soft_wrap=True)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        err.print("Stopped.")
        sys.exit(1)
    except BrokenPipeError:  # `| head` closed its end: not our user's mistake
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except Exception as error:
        if debug:
            raise
        err.print(
            f"[red]error:[/] {type(error).__name__}: {error}. This is a defect of {program}; "
            "run again with --debug and report what it prints.",
            soft_wrap=True,
        )
        sys.exit(1)
