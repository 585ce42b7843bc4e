"""Evaluation of a policy: falls and tracking errors over whole episodes.

Every episode lasts 20 s (or until the robot falls), with its own servos, friction and payload,
commands drawn anew every few seconds, and the measured feedback by default; no pushes. Errors are
of the instantaneous velocity at each control step, start included. The error of a robot that stands
still, the mean size of the command, is given next to the policy's.

Episodes under all conditions run together (`policies.walks.conditions`), and no condition runs
twice: flat ground and no added dead time are episodes of the random commands. Episode k of every
condition has the same robot, so that rows differ by their conditions, not by their robots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.results import Result
from pupper_sysid.policies.analysis.rhythm import mean_of
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks.conditions import (
    DIRECTIONS,
    Condition,
    Moment,
    evaluation_task,
    walk_together,
)
from pupper_sysid.policies.walks.tracking import ERRORS, named, planar_velocity, tracking_errors
from pupper_sysid.sim.robot.terrain import Terrain
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import ServoRanges


@dataclass(frozen=True)
class Walk:
    """Episodes of one or more robots."""

    fell: NDArray[np.bool_]
    """Shape (episodes,)."""
    command: NDArray[np.float64]
    """Forward and sideways speed [m/s], turn rate [rad/s]; shape (steps, episodes, 3)."""
    velocity: NDArray[np.float64]
    contact: NDArray[np.bool_]
    """Feet on the ground; shape (steps, episodes, 4)."""
    alive: NDArray[np.bool_]
    """Shape (steps, episodes)."""
    slip_m_s: NDArray[np.float64]
    """Speed of the feet on the ground, summed over those; shape (steps, episodes)."""
    swing_s: NDArray[np.float64]
    """Length of the swings that ended, summed; shape (steps, episodes)."""
    swings: NDArray[np.int_]
    """How many ended; shape (steps, episodes)."""

    @property
    def error(self) -> NDArray[np.float64]:
        """Mean absolute errors, shape (episodes, 3)."""
        return tracking_errors(self.velocity, self.command, self.alive)

    @property
    def commanded(self) -> NDArray[np.float64]:
        """Mean absolute command: the error of a robot that stands still, shape (episodes, 3)."""
        return tracking_errors(np.zeros_like(self.velocity), self.command, self.alive)

    def first(self, episodes: int) -> Walk:
        """The same of the first episodes."""
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        return Walk(
            **{k: v[:episodes] if k == "fell" else v[:, :episodes] for k, v in given.items()}
        )


@dataclass(frozen=True, kw_only=True)
class Standing(Result):
    """Errors of a robot that stands still."""

    mae_vx_m_s: float
    mae_vy_m_s: float
    mae_yaw_rad_s: float


@dataclass(frozen=True, kw_only=True)
class Intervals(Result):
    """90 % intervals over episodes.

    Of the share that fell by Clopper and Pearson, of the mean errors by Student's t.
    """

    fall_rate: Interval
    mae_vx_m_s: Interval
    mae_vy_m_s: Interval
    mae_yaw_rad_s: Interval


@dataclass(frozen=True, kw_only=True)
class Figures(Standing):
    """Figures of a number of episodes."""

    fall_rate: float
    episodes: int
    intervals: Intervals
    duty: tuple[float, ...]
    """Share of time that each foot stands."""
    swing_s: float
    """Mean length of a swing."""
    foot_slip_m_s: float
    """Mean speed of feet on the ground."""


@dataclass(frozen=True, kw_only=True)
class OfCommand(Figures):
    """Figures under one command."""

    name: str
    command: tuple[float, float, float]
    mean_velocity: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class OfTerrain(Figures):
    """Figures on one kind of ground."""

    terrain: Terrain


@dataclass(frozen=True, kw_only=True)
class OfDelay(Figures):
    """Figures with a longer dead time of every servo."""

    extra_delay_ms: float


@dataclass(frozen=True, kw_only=True)
class Evaluation(Figures):
    """Evaluation of a policy under random commands, by command, ground and added dead time."""

    episode_s: float
    """Length of an episode without a fall."""
    standing_still: Standing
    actuator: str
    feedback: str
    terrain: Terrain
    by_command: tuple[OfCommand, ...]
    by_terrain: tuple[OfTerrain, ...]
    by_extra_delay: tuple[OfDelay, ...]


def walk(
    policy: Policy | None,
    task: Walking,
    servos: ServoRanges,
    episodes: int,
    seed: int,
    command: tuple[float, float, float] | None = None,
    threads: int = 0,
) -> Walk:
    """Run episodes under one condition.

    Parameters
    ----------
    policy : Policy or None
        None stands still.
    task : Walking
        See `evaluation_task`.
    servos : ServoRanges
    episodes, seed : int
    command : (float, float, float), optional
        Instead of random ones.
    threads : int
    """
    one = [Condition(task, episodes, command)]
    return walk_together(policy, servos, one, task.episode_s, seed, threads, _Recorder)[0]


def summary(found: Walk) -> Figures:
    """Figures of a number of episodes."""
    return Figures(**_figures(found))


def evaluate(
    policy: Policy | None,
    task: Walking,
    servos: ServoRanges,
    episodes: int,
    seed: int,
    threads: int = 0,
    *,
    feedback: str = "held",
    grounds: Sequence[Terrain] = (),
    extra_delays_ms: Sequence[float] = (),
    progress: Callable[[float], None] = lambda share: None,
) -> Evaluation:
    """Evaluate a policy.

    Parameters
    ----------
    policy : Policy or None
        None stands still.
    task : Walking
        Its ground is that of the random and of the fixed commands.
    servos : ServoRanges
    episodes : int
        With random commands; a fifth of them per direction, half per ground and dead time.
    seed, threads : int
    feedback : str
        Name of the feedback in `servos`, for the result.
    grounds : sequence of str
        Kinds of ground to evaluate on.
    extra_delays_ms : sequence of float
        Added to every servo's dead time.
    progress : callable
        Called with the share of the work that is done.
    """
    plain = evaluation_task(task)
    half, fifth = max(episodes // 2, 1), max(episodes // 5, 1)
    conditions: dict[Any, Condition] = {"random": Condition(plain, episodes)}
    conditions |= {name: Condition(plain, fifth, c) for name, c in DIRECTIONS.items()}
    for ground in grounds:
        if ground != plain.terrain:
            conditions["ground", ground] = Condition(replace(plain, terrain=ground), half)
    for extra in extra_delays_ms:
        if extra:
            conditions["late", extra] = Condition(plain, half, None, extra / 1e3)
    walks = walk_together(
        policy, servos, list(conditions.values()), plain.episode_s, seed, threads, _Recorder,
        progress,
    )  # fmt: skip
    found = dict(zip(conditions, walks, strict=True))
    overall = found["random"]
    usual = overall.first(half)
    by_command = []
    for name, command in DIRECTIONS.items():
        moved = tuple(found[name].velocity[found[name].alive].mean(axis=0).tolist())
        by_command.append(
            OfCommand(name=name, command=command, mean_velocity=moved, **_figures(found[name]))
        )
    return Evaluation(
        **_figures(overall),
        episode_s=plain.episode_s,
        standing_still=Standing(**named(overall.commanded.mean(axis=0))),
        actuator=servos.source,
        feedback=feedback,
        terrain=task.terrain,
        by_command=tuple(by_command),
        by_terrain=tuple(
            OfTerrain(terrain=g, **_figures(found.get(("ground", g), usual))) for g in grounds
        ),
        by_extra_delay=tuple(
            OfDelay(extra_delay_ms=extra, **_figures(found.get(("late", extra), usual)))
            for extra in extra_delays_ms
        ),
    )


class _Recorder:
    """What figures are made of, for the robots of one environment."""

    def __init__(self, env: PupperEnv, policy: Policy | None, conditions: Sequence[Condition]):
        self._step_s = env.config.control_step_s
        self._fell = np.zeros(env.environments, bool)
        self._steps: list[dict[str, NDArray]] = []

    def keep(self, now: Moment) -> None:
        facts = now.facts
        self._fell |= now.fell
        standing = facts.contact & now.alive[:, None]
        ended = standing & (facts.contact_s <= self._step_s + 1e-9) & (facts.last_air_s > 0)
        self._steps.append(
            {
                "command": now.command, "velocity": planar_velocity(facts),
                "contact": facts.contact, "alive": now.alive,
                "slip_m_s": (facts.foot_speed_m_s * standing).sum(axis=1),
                "swing_s": (facts.last_air_s * ended).sum(axis=1), "swings": ended.sum(axis=1),
            }
        )  # fmt: skip

    def of(self, condition: Condition, robots: slice, steps: int) -> Walk:
        kept = self._steps[:steps]
        arrays = {name: np.stack([step[name][robots] for step in kept]) for name in kept[0]}
        return Walk(fell=self._fell[robots], **arrays)


def _figures(found: Walk) -> dict:
    alive = found.alive
    standing, swings = (found.contact & alive[..., None]).sum(), found.swings.sum()
    count, fallen = len(found.fell), int(found.fell.sum())
    errors = found.error
    return {
        "fall_rate": float(found.fell.mean()),
        **named(errors.mean(axis=0)),
        "duty": tuple(found.contact[alive].mean(axis=0).tolist()),
        "swing_s": float(found.swing_s.sum() / swings) if swings else float("nan"),
        "foot_slip_m_s": float(found.slip_m_s.sum() / max(standing, 1)),
        "episodes": count,
        "intervals": Intervals(
            fall_rate=_share(fallen, count),
            **{name: mean_of(errors[:, k]) for k, name in enumerate(ERRORS)},
        ),
    }


def _share(some: int, of: int) -> Interval:
    """Share with its interval by Clopper and Pearson."""
    tail = (1 - LEVEL) / 2
    low = float(beta.ppf(tail, some, of - some + 1)) if some else 0.0
    high = float(beta.ppf(1 - tail, some + 1, of - some)) if some < of else 1.0
    return Interval(some / of, low, high)
