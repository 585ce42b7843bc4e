"""What the subcommands of `pupper-analyze` share: options, trials, and how results are shown."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.terminal import err, need_positive, out, print_json
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

    from pupper_sysid.common.interval import Interval
    from pupper_sysid.policies.analysis.trial import Trial
    from pupper_sysid.policies.network.policy_file import Policy

    Tries = dict[str, tuple[Policy, Trial]]
    """Policy and trial by the policy's name."""
    Found = tuple[Mapping[str, Any], Figure, Table]
    """Results for --json, figure, and table."""


@dataclass(frozen=True)
class Analysis:
    """Options of every analysis."""

    policies: tyro.conf.Positional[tuple[Path, ...]]
    """Runs (`runs/<name>`) or policy folders."""
    seconds: float = 10.0
    """Duration; a gait needs 7 s."""
    actuator: str | None = None
    """Calibration, `paper`, `release` or `ideal` instead of what it was trained with."""
    out: Path = Path("analysis")
    """Folder for the picture."""
    seed: int = 0
    """Of servos, friction, start and noise."""
    json: bool = False
    """Print one JSON object."""
    force: bool = False
    """Replace an existing picture."""

    def run(self) -> None:
        """Analyse, draw and print."""
        import torch

        from pupper_sysid.common.figure_style import save

        need_positive("--seconds", self.seconds)
        name = type(self).__name__.lower()
        if not self.policies:
            raise InputError(f"No policy was named: pupper-analyze {name} runs/<name>.")
        torch.set_num_threads(1)
        picture = self.out / f"{name}.png"
        refuse_overwrite(picture, self.force)
        found, figure, table = self.analyse()
        save(figure, picture, self.force)
        if self.json:
            print_json({**found, "picture": picture})
            return
        out.print(table)
        err.print(f"Picture: {picture}", soft_wrap=True)

    def analyse(self) -> Found:
        """Results, figure and table."""
        raise NotImplementedError


@dataclass(frozen=True)
class OfPolicies(Analysis):
    """Options of the analyses of walks in the simulator."""

    robots: int = 16
    """Number of robots that walk, each with its own servos."""
    feedback: str | None = None
    """`held`, `ideal` or a calibration instead of what it was trained with."""

    def tries(self, command: tuple[float, float, float] = (0.15, 0.0, 0.0)) -> Tries:
        """Policies by their short names, and how each is tried."""
        return tries_of(self, command)


@dataclass(frozen=True)
class Commanded(OfPolicies):
    """Options of the analyses of walks under one command."""

    command: tuple[float, float, float] = (0.15, 0.0, 0.0)
    """Forward and sideways speed [m/s], turn rate [rad/s]."""

    def each(self, analyse: Callable[[Policy, Trial], Any]) -> dict[str, Any]:
        """An analysis of every policy, by name."""
        return {name: analyse(*one) for name, one in self.tries(self.command).items()}


def tries_of(options: Any, command: tuple[float, float, float]) -> Tries:
    """Policies by the names of their runs, and how each is tried.

    Raises
    ------
    InputError
        If two have the same name, or one cannot be read.
    """
    from pupper_sysid.cli.policy_choice import policy_at, run_folder, simulator, warn_of_fallbacks
    from pupper_sysid.policies.analysis.trial import Trial

    if options.robots < 1:
        raise InputError(f"--robots is {options.robots}; it must be at least 1.")
    names = [run_folder(path).name for path in options.policies]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        raise InputError(
            f"Two policies are called {twice}, after their run's folder, and results go by these "
            "names: give one of them, or rename a folder."
        )
    tries: Tries = {}
    for name, path in zip(names, options.policies, strict=True):
        policy, run = policy_at(path)
        task, servos = simulator(path, policy, run, options.actuator, options.feedback)
        tries[name] = policy, Trial(
            task, servos, command, options.robots, options.seconds, options.seed
        )  # fmt: skip
    warn_of_fallbacks(trial.servos for _, trial in tries.values())
    return tries


def table_of(title: str, tables: Mapping[str, Sequence[Any]], columns: Sequence[str]) -> Table:
    """Rows of results by policy, with these fields as columns."""
    made = terminal.table(title, "policy", *columns)
    for name, rows in tables.items():
        for row in rows:
            made.add_row(name, *(terminal.cell(getattr(row, c), 3) for c in columns))
    return made


def interval(value: Interval, digits: int) -> str:
    """A value with its interval."""
    number, low, high = (terminal.number(x, digits) for x in (value.value, value.low, value.high))
    return f"{number} ({low}–{high})"
