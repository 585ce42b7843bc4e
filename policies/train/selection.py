"""Which policy of a training is best: walks without noise, on a seed and robots of their own.

The reward of a training says little about that: noise is in it, and a curriculum changes its terms.
`Judge` lets the policy walk as in an evaluation, always from the same starts on the same robots.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from rsl_rl.models import MLPModel

from pupper_sysid.policies.train.learner import WalkingVecEnv
from pupper_sysid.policies.walks.together import evaluation_task, share_of_usual, within
from pupper_sysid.servo_models.networks import JointArrays
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

_SEED = 1_000_003
_SECONDS, _IGNORED = 5.0, 0.2
COMMANDS = np.array(
    [
        [0.15, 0, 0], [-0.15, 0, 0], [0, 0.08, 0], [0, -0.08, 0], [0, 0, 0.4], [0, 0, -0.4],
        [0.1, 0.05, 0], [0.1, 0, 0.3], [-0.1, 0, 0.3], [0.1, 0, -0.3], [0.05, 0, 0], [0, 0, 0],
    ]
)  # fmt: skip
"""Of the walks that are judged [m/s, m/s, rad/s]."""
_EACH = 4
_STANDING = np.abs(COMMANDS).mean(axis=0)  # errors of a robot that stands [m/s, m/s, rad/s]


class Judge:
    """Scores a policy, the same walks each time.

    Task and seed are those of the training; robots, starts and terrain are others. The last two are
    as for `WalkingVecEnv`.
    """

    def __init__(
        self,
        task: Walking,
        servos: ServoRanges,
        seed: int,
        threads: int,
        servo_model: JointArrays | None = None,
        action_history: int = 0,
        device: str = "cpu",
    ):
        # longer than it walks, so that no episode ends but by a fall
        seconds = min(_SECONDS, task.episode_s)
        task = evaluation_task(task, 2 * seconds)
        self._steps = round(seconds / task.control_step_s)
        robots = _EACH * len(COMMANDS)
        env = PupperEnv(task, servos, robots, seed + _SEED, threads, servo_model)
        self._scale = share_of_usual(task)
        self._command = np.repeat(within(task, COMMANDS), _EACH, axis=0)
        env.set_command(self._command)
        self._env = WalkingVecEnv(env, action_history, device)
        self._start = self._env.state

    def __call__(self, actor: MLPModel) -> dict[str, float]:
        """Walk for 5 s (at most an episode) with the mean of the policy's actions.

        The `score` is 1 without errors, 0 for a robot that stands, less with falls: 1 minus the
        errors relative to standing (mean of those at each instant and of those of the mean
        velocity) minus the share of falls. Beside it `score_falls`, the mean absolute errors
        `score_vx_m_s`, `score_vy_m_s` and `score_yaw_rad_s`, and `score_turn`, the turn rate over
        the commanded one where robots are to turn on the spot; of those that are to move,
        `score_steps_hz`, how often each foot comes down per second, bounces included, and
        `score_duty`, the share of the time that it is on the ground.
        """
        env = self._env
        env.restore(self._start)
        hidden = actor.get_hidden_state()
        actor.reset()
        first = round(_IGNORED * self._steps)
        alive, velocity, up = np.ones(env.num_envs, bool), [], []
        feet: list[tuple[float, float]] = []
        walks = self._command.any(axis=1)
        with torch.inference_mode():
            observations = env.get_observations()
            for _ in range(self._steps):
                observations, _, dones, extras = env.step(actor(observations))
                alive &= ~dones.cpu().numpy()
                facts = extras["facts"]
                velocity.append(facts.followed_velocity)
                feet.append((facts.landed[walks].mean(), facts.contact[walks].mean()))
                up.append(alive.copy())
                actor.reset(dones)
        actor.reset(hidden_state=hidden)
        landed, duty = np.mean(feet[first:], axis=0)
        scale = self._scale
        scores = scored(
            np.array(velocity)[first:] / scale, np.array(up)[first:], self._command / scale
        )
        for name, size in zip(("vx_m_s", "vy_m_s", "yaw_rad_s"), scale, strict=True):
            scores[f"score_{name}"] *= float(size)
        rate = float(landed / env.env.config.control_step_s)
        return scores | {"score_steps_hz": rate, "score_duty": float(duty)}


def scored(
    velocity: NDArray[np.float64], up: NDArray[np.bool_], command: NDArray[np.float64]
) -> dict[str, float]:
    """Score of walks with its parts; see `Judge`.

    Velocities have the shape (steps, n, 3): forward and sideways speed [m/s], turn rate [rad/s].
    `up`, shape (steps, n), says whether the robot has not fallen so far. Commands have the shape
    (n, 3).
    """
    fell = ~up[-1]
    # a robot that fell has the errors of one that stands, from then on
    followed = np.where(up[..., None], velocity, 0.0)
    instant = np.abs(followed - command).mean(axis=(0, 1))
    mean = np.abs(followed.mean(axis=0) - command).mean(axis=0)
    relative = 0.5 * (instant + mean) / _STANDING
    turning = (command[:, 2] != 0) & (command[:, :2] == 0).all(axis=1)
    turn = followed.mean(axis=0)[turning, 2] / command[turning, 2]
    return {
        "score": float(1.0 - relative.mean() - fell.mean()),
        "score_falls": float(fell.mean()),
        "score_vx_m_s": float(instant[0]),
        "score_vy_m_s": float(instant[1]),
        "score_yaw_rad_s": float(instant[2]),
        "score_turn": float(turn.mean()) if len(turn) else float("nan"),
    }
