"""What the subcommands of `pupper-analyze` share: options, trials, and how results are shown."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.terminal import err, need_positive, out, print_json, warn
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

    from pupper_sysid.common.interval import Interval
    from pupper_sysid.policies.analysis.trial import Trial
    from pupper_sysid.policies.network.policy_file import Policy

    Tries = Mapping[str, tuple[Any, Trial]]
    """Policy and trial by the policy's name."""
    Found = tuple[Mapping[str, Any], Figure, Table]
    """Results for --json, figure, and table."""

_FULL, _QUICK = (16, 10.0), (5, 8.0)  # robots, seconds each


@dataclass(frozen=True)
class Drawn(ABC):
    """Options of every analysis, each of which draws a picture."""

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
        from pupper_sysid.common.figure_style import save

        picture = self.out / f"{self.word}.png"
        refuse_overwrite(picture, self.force)
        found, figure, table = self.analyse()
        if caption := self.caption(str(table.title)):
            figure.suptitle(caption, fontsize=8)
        save(figure, picture, self.force)
        if self.json:
            print_json({**self.about(), **found, "picture": picture})
            return
        out.print(table)
        err.print(f"Picture: {picture}")

    def caption(self, title: str) -> str:
        """Title of the picture of a table with a title; none if it has its own."""
        return ""

    @property
    def word(self) -> str:
        """The command's word."""
        return re.sub(r"(?<!^)(?=[A-Z])", "-", type(self).__name__).lower()

    @abstractmethod
    def analyse(self) -> Found:
        """Results, figure and table."""

    def about(self) -> dict[str, Any]:
        """What else stands in the JSON object."""
        return {}


@dataclass(frozen=True)
class Analysis(Drawn):
    """Options of the analyses of policies."""

    policies: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Runs (`runs/<name>`) or policy folders."""
    actuator: str | None = None
    """Calibration, `paper`, `release` or `ideal` instead of what it was trained with."""

    def run(self) -> None:
        """Analyse, draw and print."""
        import torch

        if not self.policies:
            raise InputError(f"No policy was named: pupper-analyze {self.word} runs/<name>.")
        torch.set_num_threads(1)
        super().run()

    def caption(self, title: str) -> str:
        """What was done, by which policies on which servos."""
        servos = f"; servos {Path(self.actuator).name}" if self.actuator else ""
        return f"{title}\n{', '.join(path.name for path in self.policies)}{servos}"


@dataclass(frozen=True)
class OfPolicies(Analysis):
    """Options of the analyses of walks in the simulator."""

    quick: bool = False
    """Fewer robots and shorter walks: 5 of 8 s. A first look, not for publication."""
    robots: int | None = None
    """Number of robots that walk, each with its own servos (16, --quick 5)."""
    seconds: float | None = None
    """Duration of a walk (10, --quick 8); a gait needs 7 s."""
    feedback: str | None = None
    """`held`, `ideal` or a calibration instead of what it was trained with."""
    threads: int = 0
    """Of the physics; 0 for all cores."""

    def each(
        self,
        analyse: Callable[[Policy, Trial], Any],
        command: tuple[float, float, float] = (0.15, 0.0, 0.0),
    ) -> dict[str, Any]:
        """An analysis of every policy, by its short name, with a progress bar over all of them."""
        tries = self.tries(command)
        found = {}
        with terminal.share_progress("walking") as advance:
            for name, (policy, trial) in tries.items():

                def watch(share: float, name: str = name) -> None:
                    advance(name, (len(found) + share) / len(tries))

                found[name] = analyse(policy, replace(trial, threads=self.threads, progress=watch))
        return found

    def tries(self, command: tuple[float, float, float]) -> Tries:
        """Policies by their short names, and how each is tried."""
        return tries_of(self, command, *self.size)

    @property
    def size(self) -> tuple[int, float]:
        """Robots, and seconds of a walk."""
        robots, seconds = _QUICK if self.quick else _FULL
        return (
            robots if self.robots is None else self.robots,
            seconds if self.seconds is None else self.seconds,
        )

    def about(self) -> dict[str, Any]:
        """Size of the walks."""
        robots, seconds = self.size
        return {"quick": self.quick, "robots": robots, "seconds": seconds}

    def title(self, title: str) -> str:
        """Title of the table, with what it is made of."""
        robots, seconds = self.size
        look = "; a quick look" if self.quick else ""
        return f"{title} ({robots} robot{'s' * (robots != 1)}, {seconds:g} s each{look})"


@dataclass(frozen=True)
class Commanded(OfPolicies):
    """Options of the analyses of walks under one command."""

    command: tuple[float, float, float] = (0.15, 0.0, 0.0)
    """Forward and sideways speed [m/s], turn rate [rad/s]."""

    def caption(self, title: str) -> str:
        """The same, and under which command."""
        forward, left, turn = self.command
        commanded = f"{forward:g} m/s forward, {left:g} m/s left, {turn:g} rad/s"
        return f"{super().caption(title)}; command {commanded}"


def check_walk(command: tuple[float, float, float], robots: int, seconds: float) -> None:
    """Refuse walks that cannot be."""
    from pupper_sysid.policies.deploy.commands import checked_command

    if robots < 1:
        raise InputError(f"--robots is {robots}; it must be at least 1.")
    need_positive("--seconds", seconds)
    checked_command(command)


def tries_of(
    options: Any,
    command: tuple[float, float, float],
    robots: int,
    seconds: float,
    other_robots: bool = False,
) -> Tries:
    """Policies by the names of their runs, and how each is tried.

    `other_robots` is whether the analysis is one for any robot's policy.
    """
    from pupper_sysid.cli import policy_choice
    from pupper_sysid.policies.analysis.trial import Trial

    check_walk(command, robots, seconds)
    names = [policy_choice.run_folder(path).name for path in options.policies]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        raise InputError(
            f"Two policies are called {twice}, after their run's folder, and results go by these "
            "names: give one of them, or rename a folder."
        )
    tries: dict[str, tuple[Policy, Trial]] = {}
    for name, path in zip(names, options.policies, strict=True):
        policy, run = policy_choice.policy_at(path)
        if not other_robots:
            policy_choice.refuse_other_robot(policy)
        task, servos = policy_choice.simulator(
            path, policy, run, options.actuator, options.feedback
        )
        wanted = np.array([command], float)
        within = policy_choice.trained_commands(policy, run).clipped(wanted, warn)[0]
        tries[name] = (
            policy,
            Trial(task, servos, (within[0], within[1], within[2]), robots, seconds, options.seed),
        )
    policy_choice.warn_of_fallbacks(trial.servos for _, trial in tries.values())
    return tries


_HEADINGS = {
    "extra_delay_ms": "delay ms", "survival": "still up", "frequency_hz": "gait Hz",
    "amplitude_rad": "amplitude rad", "mae_vx_m_s": "vx error m/s", "mae_vy_m_s": "vy error m/s",
    "mae_yaw_rad_s": "yaw error rad/s",
}  # fmt: skip


def table_of(title: str, tables: Mapping[str, Sequence[Any]], columns: Sequence[str]) -> Table:
    """Rows of results by policy, with these fields as columns."""
    made = terminal.table(title, "policy", *(_HEADINGS.get(c, c) for c in columns))
    for name, rows in tables.items():
        for row in rows:
            cells = (terminal.cell(getattr(row, c), 3) for c in columns)
            made.add_row(name, *(cell.replace("_", " ") for cell in cells))
    return made


def interval(value: Interval, digits: int) -> str:
    """A value, and its interval where it has one."""
    number, low, high = (terminal.number(x, digits) for x in (value.value, value.low, value.high))
    return f"{number} ({low}–{high})" if np.isfinite([value.low, value.high]).all() else number
