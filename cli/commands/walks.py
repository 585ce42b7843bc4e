"""Analyses of walks: the gait and its orbit, and walks under altered conditions.

`OfPolicies` has what the subcommands of `pupper-analyze` share: options, trials, and how results
are shown.
"""

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
from pupper_sysid.cli.terminal import err, need_positive, number, out, print_json, warn
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
    Results = tuple[Mapping[str, Any], Figure, Table]
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
        data, figure, table = self.analyse()
        if caption := self.caption(str(table.title)):
            figure.suptitle(caption, fontsize=8)
        save(figure, picture, self.force)
        if self.json:
            return print_json({**self.about(), **data, "picture": picture})
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
    def analyse(self) -> Results:
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

    def per_policy(
        self,
        analyse: Callable[[Policy, Trial], Any],
        command: tuple[float, float, float] = (0.15, 0.0, 0.0),
    ) -> dict[str, Any]:
        """An analysis of every policy, by its short name, with a progress bar over all of them."""
        tries = self.tries(command)
        done = {}
        with terminal.share_progress("walking") as advance:
            for name, (policy, trial) in tries.items():

                def watch(share: float, name: str = name) -> None:
                    advance(name, (len(done) + share) / len(tries))

                done[name] = analyse(policy, replace(trial, threads=self.threads, progress=watch))
        return done

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
    from pupper_sysid.policies.deploy.deployment import checked_command

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
        servos = policy_choice.simulator(path, policy, run, options.actuator, options.feedback)
        trained = policy_choice.trained_commands(policy, run)
        forward, left, turn = trained.clipped(np.array([command], float), warn)[0]
        trial = Trial(*servos, (forward, left, turn), robots, seconds, options.seed)
        tries[name] = policy, trial
    policy_choice.warn_of_fallbacks(trial.servos for _, trial in tries.values())
    return tries


_HEADINGS = {
    "extra_delay_ms": "added dead time ms", "survival": "still up", "frequency_hz": "gait Hz",
    "amplitude_rad": "amplitude rad", "mae_vx_m_s": "vx error m/s", "mae_vy_m_s": "vy error m/s",
    "mae_yaw_rad_s": "yaw error rad/s",
}  # fmt: skip


def table_of(title: str, tables: Mapping[str, Sequence[Any]], columns: Sequence[str]) -> Table:
    """Rows of results by policy, with these fields as columns."""
    rows = (
        (name, *(terminal.cell(getattr(row, c), 3).replace("_", " ") for c in columns))
        for name, rows in tables.items()
        for row in rows
    )
    return terminal.table(title, "policy", *(_HEADINGS.get(c, c) for c in columns), rows=rows)


def interval(value: Interval, digits: int) -> str:
    """A value, and its interval where it has one."""
    number, low, high = (terminal.number(x, digits) for x in (value.value, value.low, value.high))
    return f"{number} ({low}–{high})" if np.isfinite([value.low, value.high]).all() else number


@dataclass(frozen=True)
class Gait(Commanded):
    """Frequency, sine fit, phases, duty factors and jitter of a gait.

    Example: pupper-analyze gait runs/<name> --command 0.15 0 0
    """

    def analyse(self) -> Results:
        """Describe the gait of each policy."""
        from pupper_sysid.policies.analysis.figures import gait_figure
        from pupper_sysid.policies.analysis.gait import describe

        rng = np.random.default_rng(self.seed)
        walks = self.per_policy(lambda policy, trial: trial.walk(policy), self.command)
        reports = {name: describe(walked, rng) for name, walked in walks.items()}
        table = terminal.table(
            self.title("Gait, 90 % intervals over robots"), "policy", "Hz", "sine R² actions",
            "of noise", "diagonal", "duty", "jitter rad", "robots",
            rows=(
                (
                    name, interval(gait.frequency_hz, 2), interval(gait.action_r2, 2),
                    number(gait.null_r2, 2), interval(gait.diagonal, 2),
                    number(float(np.mean([d.value for d in gait.duty])), 2),
                    number(gait.jitter_rad.value, 3), f"{gait.robots} of {self.size[0]}",
                )
                for name, gait in reports.items()
            ),
        )  # fmt: skip
        return {"gaits": reports}, gait_figure(next(iter(walks.values()))), table


@dataclass(frozen=True)
class Attractor(Commanded):
    """Orbits of actions and hidden states in replay, with more delay of the joints.

    Example: pupper-analyze attractor runs/<name>
    """

    def analyse(self) -> Results:
        """Orbits of each policy."""
        from pupper_sysid.policies.analysis.autonomy import DELAYS_MS, orbits
        from pupper_sysid.policies.analysis.figures import orbit_figure
        from pupper_sysid.policies.analysis.gait import SETTLE_S, SHORTEST_S

        walks = self.per_policy(orbits, self.command)
        by_policy = {name: orbits_of for name, orbits_of in walks.items() if orbits_of}
        if not by_policy:
            raise InputError(
                f"No robot walked for {SETTLE_S + SHORTEST_S:g} s and moved: there is no orbit to "
                "analyse. Give a policy that walks, or more --seconds."
            )
        every = {
            f"{name} {states}": orbit
            for name, orbits_of in by_policy.items() for states, orbit in orbits_of.items()
        }  # fmt: skip
        table = terminal.table(
            self.title("Orbits at more delay of the joints, in replay, as published"), "states",
            "variance in 3 PCs", "dimensions", *(f"closure +{d:g} ms" for d in DELAYS_MS),
            *(f"area +{d:g} ms" for d in DELAYS_MS[1:]),
            rows=(
                (
                    name, number(orbit.explained_3, 3), number(orbit.participation_ratio, 1),
                    *(number(x, 2) for x in (*orbit.closure, *orbit.area_ratio[1:])),
                )
                for name, orbit in every.items()
            ),
        )  # fmt: skip
        drawn = {name: orbit.orbits for name, orbit in every.items()}
        return {"delays_ms": DELAYS_MS, "orbits": by_policy}, orbit_figure(drawn, DELAYS_MS), table


@dataclass(frozen=True)
class Delay(Commanded):
    """Servos and readings with added dead time, in replay and in closed loop.

    Example: pupper-analyze delay runs/A runs/B
    """

    def analyse(self) -> Results:
        """Delay curves of each policy."""
        from pupper_sysid.policies.analysis.figures import delay_figure
        from pupper_sysid.policies.analysis.trial import delay_curve

        curves = self.per_policy(delay_curve, self.command)
        columns = (
            "extra_delay_ms", "mode", "survival", "frequency_hz", "amplitude_rad", "mae_vx_m_s",
        )  # fmt: skip
        table = table_of(self.title("Against more delay"), curves, columns)
        return {"curves": curves}, delay_figure(curves), table


@dataclass(frozen=True)
class Ablation(Commanded):
    """Noise, zeros and staleness per channel of the observation.

    Example: pupper-analyze ablation runs/<name>
    """

    def analyse(self) -> Results:
        """Ablations of each policy."""
        from pupper_sysid.policies.analysis.figures import ablation_figure
        from pupper_sysid.policies.analysis.trial import ablation

        points = self.per_policy(ablation, self.command)
        columns = ("channel", "kind", "level", "sigma", "correlation", "survival", "mae_vx_m_s")
        table = table_of(self.title("Altered observations"), points, columns)
        return {"ablations": points}, ablation_figure(points), table


@dataclass(frozen=True)
class Autonomy(Commanded):
    """Rhythm with frozen inputs, after pushes, and at other control rates.

    Example: pupper-analyze autonomy runs/<name>
    """

    def analyse(self) -> Results:
        """Tests of each policy."""
        from pupper_sysid.policies.analysis.autonomy import autonomy
        from pupper_sysid.policies.analysis.figures import autonomy_figure

        tests_of = self.per_policy(autonomy, self.command)
        rows = []
        for name, tests in tests_of.items():
            rows += [
                (name, r.test, number(r.frequency_hz, 2), number(r.share, 2), "", "", "")
                for r in tests.frozen
            ]
            rows += [
                (name, f"push of {r.push_m_s:g} m/s", "", "", number(r.survival, 2),
                 number(r.shift_late, 3), number(r.kept, 2))
                for r in tests.push
            ]  # fmt: skip
            rows += [
                (name, f"control rate {r.rate_hz:.4g} Hz", number(r.frequency_hz, 2), "",
                 number(r.survival, 2), "", "")
                for r in tests.rate
            ]  # fmt: skip
        table = terminal.table(
            self.title("Autonomy of the rhythm"), "policy", "test", "gait Hz", "share of amplitude",
            "still up", "phase shift", "of it kept", rows=rows,
        )  # fmt: skip
        return {"autonomy": tests_of}, autonomy_figure(tests_of), table


@dataclass(frozen=True)
class Terrain(Commanded):
    """Survival and errors on rough ground, slopes, troughs, steps and stairs.

    Example: pupper-analyze terrain runs/<name>
    """

    def analyse(self) -> Results:
        """Walks of each policy on each ground."""
        from pupper_sysid.policies.analysis.figures import terrain_figure
        from pupper_sysid.policies.analysis.trial import terrain

        points = self.per_policy(terrain, self.command)
        columns = (
            "ground", "survival", "frequency_hz", "mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s",
        )  # fmt: skip
        table = table_of(self.title("On other ground"), points, columns)
        return {"terrain": points}, terrain_figure(points), table


@dataclass(frozen=True)
class Compliance(OfPolicies):
    """Path, drift and arc in six directions.

    Example: pupper-analyze compliance runs/<name>
    """

    def analyse(self) -> Results:
        """Walks of each policy in each direction."""
        from pupper_sysid.policies.analysis.figures import compliance_figure
        from pupper_sysid.policies.analysis.trial import compliance

        walks = self.per_policy(compliance)
        table = terminal.table(
            self.title("Walks by direction, 90 % intervals over robots"), "policy", "direction",
            "still up", "share of speed", "drift m/m", "arc rad/m", "wander m/turn",
            rows=(
                (name, row.direction, number(row.survival, 2),
                 *(interval(m, 2) for m in (row.share, row.drift, row.arc_rad_m, row.wander_m)))
                for name, rows in walks.items() for row in rows
            ),
        )  # fmt: skip
        return {"compliance": walks}, compliance_figure(walks), table
