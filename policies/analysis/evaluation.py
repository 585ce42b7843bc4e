"""How well a policy walks: falls and tracking errors over whole episodes, in numbers one can check.

Every episode lasts 20 s (or until the robot falls), with its own servos, friction and payload,
commands drawn anew every few seconds, and the measured feedback, unless told otherwise; no pushes.
Errors are of the instantaneous velocity at each control step, start included. Beside the policy
stands a robot that stands still: its error is the mean size of the command.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.policies.network.policy_file import Policy
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
    """What came of a number of episodes.

    Attributes
    ----------
    fell : ndarray of bool, shape (episodes,)
    error : ndarray, shape (episodes, 3)
        Mean absolute error of forward and sideways speed [m/s] and turn rate [rad/s].
    asked : ndarray, shape (episodes, 3)
        Mean absolute command: the error of a robot that stands still.
    contact : ndarray of bool, shape (steps, episodes, 4)
        Which feet were on the ground.
    velocity : ndarray, shape (steps, episodes, 3)
        Forward and sideways speed, turn rate.
    alive : ndarray of bool, shape (steps, episodes)
    swing_s : float
        Mean length of a swing [s].
    slip_m_s : float
        Mean speed of feet on the ground.
    """

    fell: NDArray[np.bool_]
    error: NDArray[np.float64]
    asked: NDArray[np.float64]
    contact: NDArray[np.bool_]
    velocity: NDArray[np.float64]
    alive: NDArray[np.bool_]
    swing_s: float
    slip_m_s: float


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
    """Run episodes; `policy` None stands still.

    Parameters
    ----------
    policy : Policy or None
    task : Walking
        See `evaluation_task`.
    servos : ServoRanges
    episodes, seed, threads : int
    command : (float, float, float), optional
        Instead of random ones.
    """
    model = servo_model_of(servos.source, task.control_step_s)
    env = PupperEnv(task, servos, episodes, seed, threads, model)
    if command is not None:
        env.set_command(np.array(command))
    observation, _ = env.observe()
    if policy:
        policy.reset(env.action)
    steps = task.episode_steps
    alive = np.ones(episodes, bool)
    fell = np.zeros(episodes, bool)
    error, asked, count = np.zeros((episodes, 3)), np.zeros((episodes, 3)), np.zeros(episodes)
    contacts, velocities, lives = [], [], []
    slip = slip_count = 0.0
    swings: list[float] = []
    for _ in range(steps):
        told = env.command.copy()
        action = policy.act(observation) if policy else np.zeros((episodes, 12))
        found = env.step(action)
        observation = found.observation
        fell |= alive & found.done & ~found.timed_out
        alive &= ~found.done
        facts = found.facts
        velocity = np.column_stack([facts.linear_velocity[:, :2], facts.angular_velocity[:, 2]])
        error += alive[:, None] * np.abs(velocity - told)
        asked += alive[:, None] * np.abs(told)
        count += alive
        standing = facts.contact & alive[:, None]
        slip += float((facts.foot_speed_m_s * standing).sum())
        slip_count += float(standing.sum())
        ended = standing & (facts.contact_s <= task.control_step_s + 1e-9)
        swings += facts.last_air_s[ended & (facts.last_air_s > 0)].tolist()
        contacts.append(facts.contact)
        velocities.append(velocity)
        lives.append(alive.copy())
        if not alive.any():
            break
    count = np.maximum(count, 1)[:, None]
    return Walk(
        fell, error / count, asked / count, np.array(contacts), np.array(velocities),
        np.array(lives), float(np.mean(swings)) if swings else float("nan"),
        slip / max(slip_count, 1.0),
    )  # fmt: skip


def summary(found: Walk) -> dict[str, Any]:
    """Figures of a number of episodes."""
    x, y, yaw = found.error.mean(axis=0)
    duty = found.contact[found.alive].mean(axis=0)
    return {
        "fall_rate": float(found.fell.mean()),
        "mae_vx_m_s": float(x),
        "mae_vy_m_s": float(y),
        "mae_yaw_rad_s": float(yaw),
        "duty": [float(d) for d in duty],
        "swing_s": found.swing_s,
        "foot_slip_m_s": found.slip_m_s,
    }


def evaluate(
    policy: Policy | None,
    task: Walking,
    servos: ServoRanges,
    episodes: int,
    seed: int,
    threads: int = 0,
    progress=None,
) -> dict[str, Any]:
    """Object of `pupper-eval --json`, for one actuator and one ground."""
    task = evaluation_task(task)
    overall = walk(policy, task, servos, episodes, seed, None, threads)
    asked = overall.asked.mean(axis=0)
    by_command = []
    for name, command in DIRECTIONS.items():
        if progress:
            progress(name)
        found = walk(policy, task, servos, max(episodes // 5, 1), seed, command, threads)
        moved = found.velocity[found.alive].mean(axis=0)
        by_command.append(
            {"name": name, "command": list(command), **summary(found),
             "mean_velocity": [float(v) for v in moved]}
        )  # fmt: skip
    return {
        "episodes": episodes,
        **summary(overall),
        "standing_still": {
            "mae_vx_m_s": float(asked[0]),
            "mae_vy_m_s": float(asked[1]),
            "mae_yaw_rad_s": float(asked[2]),
        },
        "actuator": servos.source,
        "terrain": task.terrain,
        "by_command": by_command,
    }
