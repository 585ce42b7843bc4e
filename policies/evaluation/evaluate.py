"""Evaluation of a policy: falls and tracking errors over whole episodes.

Every episode lasts 20 s, with its own servos, friction and payload, commands drawn anew every few
seconds, and the measured feedback by default. Beside the policy, in the same batch, the same robots
walk under the same conditions by an open-loop trot, which sees nothing and has a clock, and others
stand: what a policy has learnt is what it does better than these. Errors are given at every control
step, start included, and of the mean velocity over a stride, since within a stride every trot
sways; a robot that fell counts as one that stands still until the end of its episode.

Episodes under all conditions run together (`policies.walks.together`). Episode k of every condition
has the same robot, so that rows differ by their conditions, not by their robots. Robots and terrain
are others than those of a training with the same seed.

The battery holds conditions that make walking robots fall. Usual conditions separate nothing: an
open-loop trot falls under none of them. These go on until it does: pushes, slopes, stairs, loads
off centre, a weak leg, missed control ticks, late and jittered servos, slippery ground, and all
that typically differs between a robot and its model (`sim.walking.differences.TYPICAL`). All are
walked under random commands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from pupper_sysid.common.results import Result
from pupper_sysid.policies.evaluation.figures import Fall, Figures, Recorder, falls_of, figures_of
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks.conditions import (
    DIRECTIONS,
    Condition,
    Handicap,
    Walker,
    evaluation_task,
    share_of_usual,
)
from pupper_sysid.policies.walks.together import walk_together
from pupper_sysid.sim.robot.terrain import STAIRS_M, Terrain
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.differences import TYPICAL, Differences
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

Group = Literal[
    "random", "direction", "ground", "dead time", "push", "slope", "stairs", "payload", "leg",
    "ticks", "jitter", "friction", "robot",
]  # fmt: skip
WALKERS: tuple[Walker, ...] = ("policy", "trot", "standing")


@dataclass(frozen=True)
class Case:
    """One row of a table: a condition under which policy, trot and standing robots are compared."""

    group: Group
    name: str
    command: tuple[float, float, float] | None = None
    """Forward and sideways speed [m/s], turn rate [rad/s]; None for random ones."""
    terrain: Terrain = "flat"
    extra_dead_time_s: float = 0.0
    """Added to the dead time of every servo."""
    handicap: Handicap = field(default_factory=Handicap)
    differences: Differences = field(default_factory=Differences)
    """Of the robots from their model."""

    def condition(self, task: Walking, robots: int, walker: Walker) -> Condition:
        """The same for some robots."""
        return Condition(
            replace(task, terrain=self.terrain, differences=self.differences), robots,
            self.command, self.extra_dead_time_s, walker=walker, handicap=self.handicap,
        )  # fmt: skip


RANDOM = Case("random", "random commands")
"""The first row of every table."""


@dataclass(frozen=True, kw_only=True)
class Row(Result):
    """Figures under one condition."""

    group: Group
    name: str
    command: tuple[float, float, float] | None
    """None for random ones."""
    policy: Figures
    trot: Figures
    """Of the open-loop trot."""
    standing: Figures
    """Of robots that stand."""


@dataclass(frozen=True, kw_only=True)
class Evaluation(Result):
    """Evaluation of a policy beside an open-loop trot and standing."""

    episode_s: float
    """Length of an episode without a fall."""
    seed: int
    actuator: str
    feedback: str
    conditions: tuple[Row, ...]
    """The first is of random commands on flat ground."""
    falls: tuple[Fall, ...]

    def rows(self) -> list[dict[str, Any]]:
        """One row per condition and walker."""
        return [
            {"group": row.group, "name": row.name, "walker": walker, **own.rows()[0]}
            for row in self.conditions
            for walker, own in zip(WALKERS, (row.policy, row.trot, row.standing), strict=True)
        ]


def table(
    grounds: Sequence[Terrain] = ("rough", "slopes", "troughs"),
    extra_delays_ms: Sequence[float] = (40.0, 80.0),
) -> tuple[Case, ...]:
    """Cases of the usual table, after that of random commands.

    Flat ground and no added dead time are those of random commands, and have no rows of their own.
    """
    return (
        *(Case("direction", name, command) for name, command in DIRECTIONS.items()),
        *(Case("ground", f"ground: {g}", terrain=g) for g in grounds if g != "flat"),
        *(
            Case("dead time", f"dead time +{extra:g} ms", extra_dead_time_s=extra / 1e3)
            for extra in extra_delays_ms
            if extra
        ),
    )


def evaluate(
    policy: Policy | None,
    task: Walking,
    servos: ServoRanges,
    cases: Sequence[Case],
    robots: Callable[[Case, Walker], int],
    seed: int,
    threads: int = 0,
    *,
    feedback: str = "held",
    progress: Callable[[float], None] = lambda share: None,
) -> Evaluation:
    """Evaluate a policy, an open-loop trot and standing under random commands and `cases`.

    The ground is that of the cases (see `table` and `BATTERY`), not of the task; `robots` gives the
    episodes of a case and a walker (see `usual_robots`). No policy stands still. `feedback` names
    that of the servos in the result; `progress` is called with the share of the work that is done.
    """
    plain = evaluation_task(task)
    cases = (RANDOM, *cases)
    if task.robot:  # commands as far within its ranges as usual ones are within theirs
        size = share_of_usual(plain)
        cases = tuple(
            c if c.command is None else replace(c, command=tuple((size * c.command).tolist()))
            for c in cases
        )
    conditions = [c.condition(plain, robots(c, w), w) for c in cases for w in WALKERS]
    walks = walk_together(
        policy, servos, conditions, plain.episode_s, seed, threads, Recorder, progress
    )
    rows, falls = [], []
    found = list(zip(conditions, walks, strict=True))
    for i, case in enumerate(cases):
        figures = {}
        for condition, walked in found[i * len(WALKERS) : (i + 1) * len(WALKERS)]:
            figures[condition.walker] = figures_of(walked, case.command)
            falls += falls_of(
                case.name, condition, walked.fell, walked.alive, walked.gravity, walked.command
            )
        rows.append(Row(group=case.group, name=case.name, command=case.command, **figures))
    return Evaluation(
        episode_s=plain.episode_s, seed=seed, actuator=servos.source, feedback=feedback,
        conditions=tuple(rows), falls=tuple(falls),
    )  # fmt: skip


def usual_robots(episodes: int) -> Callable[[Case, Walker], int]:
    """Episodes of each case: `episodes` of random commands, an eighth of all others.

    Half of them for the trot, a sixth for standing, at least 2 each.
    """

    def count(case: Case, walker: Walker) -> int:
        own = episodes if case is RANDOM else max(episodes // 8, 1)
        return {"policy": own, "trot": max(own // 2, 2), "standing": max(own // 6, 2)}[walker]

    return count


BATTERY: tuple[Case, ...] = (
    *(
        Case("push", f"pushes of {speed:g} m/s", handicap=Handicap(push_m_s=speed))
        for speed in (0.4, 0.8, 1.2)
    ),
    *(
        Case("slope", f"slope of {slope:g}°", handicap=Handicap(slope_deg=slope))
        for slope in (10.0, 15.0, 20.0)
    ),
    *(
        Case(
            "stairs", f"steps of {1e3 * riser:g} mm", terrain="stairs",
            handicap=Handicap(riser_m=riser),
        )
        for riser in STAIRS_M
    ),
    Case(
        "payload", "150 g, 4 cm left",
        handicap=Handicap(payload_kg=0.15, payload_at_m=(0.0, 0.04)),
    ),
    Case(
        "payload", "150 g, 8 cm behind",
        handicap=Handicap(payload_kg=0.15, payload_at_m=(-0.08, 0.0)),
    ),
    *(
        Case("leg", f"one leg at {100 * torque:g} %", handicap=Handicap(weak_leg=torque))
        for torque in (0.5, 0.25)
    ),
    *(
        Case("ticks", f"{100 * share:g} % ticks missed", handicap=Handicap(missed_ticks=share))
        for share in (0.1, 0.3)
    ),
    *(
        Case("dead time", f"dead time +{1e3 * extra:g} ms", extra_dead_time_s=extra)
        for extra in (0.04, 0.08)
    ),
    *(
        Case("jitter", f"jitter +{1e3 * jitter:g} ms", handicap=Handicap(extra_jitter_s=jitter))
        for jitter in (0.01, 0.02)
    ),
    Case("friction", "friction of 0.15", handicap=Handicap(friction=0.15)),
    Case("robot", "unlike its model", differences=TYPICAL),
)  # fmt: skip
"""Rows of the battery, after that of random commands."""


def battery_robots(episodes: int) -> Callable[[Case, Walker], int]:
    """Episodes of each case and walker: equally many."""
    return lambda case, walker: episodes
