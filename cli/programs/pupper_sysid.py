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

from pupper_sysid.cli.commands.analyse import Bode, Delay, Doctor
from pupper_sysid.cli.commands.calibrate import Calibrate
from pupper_sysid.cli.commands.calibrate_joints import CalibrateJoints
from pupper_sysid.cli.commands.compare import Compare
from pupper_sysid.cli.commands.emulate import Emulate
from pupper_sysid.cli.commands.export import Export
from pupper_sysid.cli.commands.fit_servo import FitServo
from pupper_sysid.cli.commands.init_robot import InitRobot
from pupper_sysid.cli.commands.monitor import Monitor
from pupper_sysid.cli.commands.report import Report
from pupper_sysid.cli.commands.scan import Scan
from pupper_sysid.cli.commands.sindy import Sindy
from pupper_sysid.cli.commands.sweep import Sweep
from pupper_sysid.cli.flags import remember
from pupper_sysid.cli.user_errors import end_politely, need_seed, user_errors

Command = (
    Annotated[InitRobot, tyro.conf.subcommand("init-robot")]
    | Annotated[Scan, tyro.conf.subcommand("scan")]
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
    with user_errors(given, "pupper-sysid") as rest:
        command = tyro.cli(
            Command,
            prog="pupper-sysid",
            description=DESCRIPTION,
            args=rest or ["--help"],
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
        )
        remember(command)
        need_seed(command)
        end_politely()
        command.run()


if __name__ == "__main__":
    main()
