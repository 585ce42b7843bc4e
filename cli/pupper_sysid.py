"""`pupper-sysid`: record a sweep, find out what is bus, sensor and servo, calibrate, report."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Sequence
from typing import Annotated

# Vectorised NumPy is the inner loop and joints run in processes: BLAS threads would only fight.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from cli.analyse import Bode, Delay, Doctor
from cli.calibrate import Calibrate
from cli.calibrate_joints import CalibrateJoints
from cli.compare import Compare
from cli.emulate import Emulate
from cli.export import Export
from cli.fit_servo import FitServo
from cli.monitor import Monitor
from cli.report import Report
from cli.scan import Scan
from cli.sindy import Sindy
from cli.sweep import Sweep
from cli.terminal import err
from common.errors import PupperError

Command = (
    Annotated[Scan, tyro.conf.subcommand("scan")]
    | Annotated[Monitor, tyro.conf.subcommand("monitor")]
    | Annotated[CalibrateJoints, tyro.conf.subcommand("calibrate-joints")]
    | Annotated[Sweep, tyro.conf.subcommand("sweep")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Delay, tyro.conf.subcommand("delay")]
    | Annotated[Bode, tyro.conf.subcommand("bode")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Sindy, tyro.conf.subcommand("sindy")]
    | Annotated[FitServo, tyro.conf.subcommand("fit-servo")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Emulate, tyro.conf.subcommand("emulate")]
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
        _end_politely()
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


def _end_politely() -> None:
    """End on SIGTERM and a closed terminal as on Ctrl-C: the robot is parked first."""

    def stop(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), stop)


if __name__ == "__main__":
    main()
