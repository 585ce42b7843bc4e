"""How every command ends: 0, or 2 for what the user gave, or 1, and never with a traceback.

`--debug` shows the traceback after all.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from cli.terminal import err
from common.errors import PupperError


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
