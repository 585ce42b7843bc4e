"""Test the published claims: `python -m reproduction POLICY … [--recordings …]`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from pupper_sysid.cli.program import run_program
from pupper_sysid.common.errors import InputError

DESCRIPTION = """Every published claim beside what is found here, as pages with figures.

Example: python -m reproduction runs/A runs/B --recordings sweep.csv playback.csv
"""


@dataclass(frozen=True)
class Options:
    """Evidence for the claims, and where to write."""

    policies: tyro.conf.Positional[tuple[Path, ...]]
    """Runs (`runs/<name>`) or policy folders."""
    from_nothing: tuple[Path, ...] = ()
    """Runs from random weights (`pupper-train --preset paper`), for the claims about training:
    their curves count, whether they walk or not."""
    recordings: tuple[Path, ...] = ()
    """Sweeps and a playback of a robot."""
    imu: tuple[str, ...] = ()
    """IMU logs of walks of the robot, each with the kind of policy that walked: lstm=FILE."""
    servo: Path | None = None
    """Servo model of the emulated robot of --seed, to compare its stack with the closed loop."""
    command: tuple[float, float, float] = (0.15, 0.0, 0.0)
    """Forward and sideways speed [m/s], turn rate [rad/s]."""
    robots: int = 16
    """Number of robots that walk, each with its own servos."""
    seconds: float = 10.0
    """Duration of a walk; a gait needs 7 s."""
    actuator: str | None = None
    """Calibration, `paper`, `release` or `ideal` instead of what it was trained with."""
    feedback: str | None = None
    """`held`, `ideal` or a calibration instead of what it was trained with."""
    beside: Path | None = None
    """`tables/claims.csv` of another page, such as one on policies that began otherwise; claims
    that it judges otherwise are listed."""
    out: Path = Path("analysis/claims")
    """Folder for pages, figures and tables."""
    seed: int = 0
    """Of servos, friction, start and noise."""
    json: bool = False
    """Print one JSON object."""
    force: bool = False
    """Replace existing pages and figures."""


def _run(options: Options) -> None:
    if not options.policies:
        raise InputError("No policy was named: python -m reproduction runs/<name>.")
    import torch

    from pupper_sysid.cli.commands.walks import tries_of
    from reproduction.page import write_claims

    torch.set_num_threads(1)
    write_claims(options, tries_of(options, options.command, options.robots, options.seconds))


main = partial(run_program, Options, _run, "python -m reproduction", DESCRIPTION)

if __name__ == "__main__":
    main()
