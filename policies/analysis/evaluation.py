"""Evaluation of a policy: falls and tracking errors over whole episodes.

Every episode lasts 20 s (or until the robot falls), with its own servos, friction and payload,
commands drawn anew every few seconds, and the measured feedback by default; no pushes. Errors are
of the instantaneous velocity at each control step, start included. The error of a robot that stands
still, the mean size of the command, stands beside the policy's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import Result
from pupper_sysid.policies.analysis.tracking import named, planar_velocity, tracking_errors
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.sim.robot.terrain import Terrain
from pupper_sysid.sim.walking.config import Commands, Curriculum, Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_model_of

DIRECTIONS = {
    "forward": (0.15, 0.0, 0.0),
    "backward": (-0.15, 0.0, 0.0),
    "left": (0.0, 0.08, 0.0),
    "right": (0.0, -0.08, 0.0),
    "turn left": (0.0, 0.0, 0.4),
    "turn right": (0.0, 0.0, -0.4),
    "stand": (0.0, 0.0, 0.0),
}
"""Commands [m/s, m/s, rad/s] of the table by direction."""

RANDOM = Commands((-0.2, 0.2), (-0.1, 0.1), (-0.5, 0.5), standing=0.0, single=0.0, every_s=5.0)
"""Commands of the overall figures: uniform in all three at once."""


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
    swing_s: float
    """Mean length of a swing [s]."""
    slip_m_s: float
    """Mean speed of feet on the ground."""

    @property
    def error(self) -> NDArray[np.float64]:
        """Mean absolute errors, shape (episodes, 3)."""
        return tracking_errors(self.velocity, self.command, self.alive)

    @property
    def commanded(self) -> NDArray[np.float64]:
        """Mean absolute command: the error of a robot that stands still, shape (episodes, 3)."""
        return tracking_errors(np.zeros_like(self.velocity), self.command, self.alive)


@dataclass(frozen=True, kw_only=True)
class Standing(Result):
    """Errors of a robot that stands still."""

    mae_vx_m_s: float
    mae_vy_m_s: float
    mae_yaw_rad_s: float


@dataclass(frozen=True, kw_only=True)
class Figures(Standing):
    """Figures of a number of episodes."""

    fall_rate: float
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

    episodes: int
    standing_still: Standing
    actuator: str
    feedback: str
    terrain: Terrain
    by_command: tuple[OfCommand, ...]
    by_terrain: tuple[OfTerrain, ...]
    by_extra_delay: tuple[OfDelay, ...]


def evaluation_task(task: Walking, seconds: float | None = None) -> Walking:
    """`task` as it is evaluated: random commands, no curriculum, no pushes, no thrown start."""
    gentle = replace(
        task.randomisation, push_m_s=0.0, on_the_move=0.0, joint_rad=0.05, joint_rad_s=0.0,
        base_velocity_m_s=(0.0, 0.0, 0.0), base_rate_rad_s=(0.0, 0.0, 0.0),
    )  # fmt: skip
    return replace(
        task, commands=RANDOM, curriculum=Curriculum(), randomisation=gentle,
        episode_s=task.episode_s if seconds is None else seconds,
    )  # fmt: skip


def walk(
    policy: Policy | None,
    task: Walking,
    servos: ServoRanges,
    episodes: int,
    seed: int,
    command: tuple[float, float, float] | None = None,
    threads: int = 0,
) -> Walk:
    """Run episodes.

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
    model = servo_model_of(servos.source, task.control_step_s)
    env = PupperEnv(task, servos, episodes, seed, threads, model)
    if command is not None:
        env.set_command(np.array(command))
    observation, _ = env.observe()
    if policy:
        policy.reset(env.action)
    alive, fell = np.ones(episodes, bool), np.zeros(episodes, bool)
    commands, velocities, contacts, lives = [], [], [], []
    slip = slip_count = 0.0
    swings: list[float] = []
    for _ in range(task.episode_steps):
        commands.append(env.command.copy())
        found = env.step(policy.act(observation) if policy else np.zeros((episodes, 12)))
        observation, facts = found.observation, found.facts
        fell |= alive & found.done & ~found.timed_out
        alive = alive & ~found.done
        standing = facts.contact & alive[:, None]
        slip += float((facts.foot_speed_m_s * standing).sum())
        slip_count += float(standing.sum())
        ended = standing & (facts.contact_s <= task.control_step_s + 1e-9)
        swings += facts.last_air_s[ended & (facts.last_air_s > 0)].tolist()
        contacts.append(facts.contact)
        velocities.append(planar_velocity(facts))
        lives.append(alive)
        if not alive.any():
            break
    return Walk(
        fell, np.array(commands), np.array(velocities), np.array(contacts), np.array(lives),
        float(np.mean(swings)) if swings else float("nan"), slip / max(slip_count, 1.0),
    )  # fmt: skip


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
    progress: Callable[[str], None] = lambda what: None,
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
        With random commands; a fifth of them per direction, half per ground and delay.
    seed, threads : int
    feedback : str
        Name of the feedback in `servos`, for the result.
    grounds : sequence of str
        Kinds of ground to evaluate on.
    extra_delays_ms : sequence of float
        Added to every servo's dead time.
    progress : callable
        Called with the name of the next part.
    """
    plain = evaluation_task(task)

    def part(name: str, share: int, task: Walking, servos: ServoRanges, command=None) -> Walk:
        progress(name)
        return walk(policy, task, servos, max(episodes // share, 1), seed, command, threads)

    overall = walk(policy, plain, servos, episodes, seed, None, threads)
    by_command = []
    for name, command in DIRECTIONS.items():
        found = part(name, 5, plain, servos, command)
        moved = tuple(found.velocity[found.alive].mean(axis=0).tolist())
        by_command.append(
            OfCommand(name=name, command=command, mean_velocity=moved, **_figures(found))
        )
    return Evaluation(
        **_figures(overall),
        episodes=episodes,
        standing_still=Standing(**named(overall.commanded.mean(axis=0))),
        actuator=servos.source,
        feedback=feedback,
        terrain=task.terrain,
        by_command=tuple(by_command),
        by_terrain=tuple(
            OfTerrain(terrain=g, **_figures(part(g, 2, replace(plain, terrain=g), servos)))
            for g in grounds
        ),
        by_extra_delay=tuple(
            OfDelay(
                extra_delay_ms=extra,
                **_figures(part(f"+{extra:g} ms", 2, plain, servos.later(extra / 1000))),
            )
            for extra in extra_delays_ms
        ),
    )


def _figures(found: Walk) -> dict:
    return {
        "fall_rate": float(found.fell.mean()),
        **named(found.error.mean(axis=0)),
        "duty": tuple(found.contact[found.alive].mean(axis=0).tolist()),
        "swing_s": found.swing_s,
        "foot_slip_m_s": found.slip_m_s,
    }
