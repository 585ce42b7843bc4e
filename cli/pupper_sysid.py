"""`pupper-sysid`: record a sweep, find out what is bus, sensor and servo, calibrate, report."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated

# Vectorised NumPy is the inner loop and joints run in processes: BLAS threads would only fight.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from cli.analyse import Bode, Delay, Doctor
from cli.calibrate import Calibrate
from cli.export import Export
from cli.report import Report
from cli.sweep import Sweep
from cli.terminal import err
from common.errors import PupperError

Command = (
    Annotated[Sweep, tyro.conf.subcommand("sweep")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Delay, tyro.conf.subcommand("delay")]
    | Annotated[Bode, tyro.conf.subcommand("bode")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Report, tyro.conf.subcommand("report")]
)

DESCRIPTION = """Measure a cheap servo and get a simulator that moves like it.

Start with `pupper-sysid sweep --freqs 1-10` (no robot needed), then `delay`, `calibrate`, `report`.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; ends the process with 0, 2 (bad input, one sentence) or 1."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    given = [a for a in given if a != "--debug"] or ["--help"]
    try:
        command = tyro.cli(
            Command,
            prog="pupper-sysid",
            description=DESCRIPTION,
            args=given,
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
        )
        command.run()
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
            f"[red]error:[/] {type(error).__name__}: {error}. This is a defect of pupper-sysid; "
            "run again with --debug and report what it prints.",
            soft_wrap=True,
        )
        sys.exit(1)


if __name__ == "__main__":
    main()
