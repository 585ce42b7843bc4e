"""Made-up walks of robots, for analyses whose answer is then known."""

import numpy as np

from pupper_sysid.policies.analysis.trial import Trial
from pupper_sysid.policies.evaluation.evaluate import Recorder, Walk
from pupper_sysid.policies.walks.rollouts import Rollout
from pupper_sysid.policies.walks.together import Condition, walk_together
from pupper_sysid.sim.walking.config import Randomisation, Walking
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

STEP = 0.02
"""Their control step [s]."""
STILL = Randomisation(
    friction=(0.8, 0.8), payload_kg=(0.0, 0.0), torque_scale=(1.0, 1.0), joint_rad=0.0,
    joint_rad_s=0.0, base_velocity_m_s=(0.0, 0.0, 0.0), base_rate_rad_s=(0.0, 0.0, 0.0),
    push_m_s=0.0, on_the_move=0.0,
)  # fmt: skip
"""Robots that are alike, start at rest and are not pushed."""


def walked(command, forward, left, turn, seconds=6.0, robots=3, action=None) -> Rollout:
    """Robots that move steadily in their own frames, from a heading of their own."""
    steps = round(seconds / STEP)
    heading = 0.7 + np.zeros(robots)
    place = np.zeros((robots, 3))
    place[:, 2] = heading
    path = []
    for _ in range(steps):
        c, s = np.cos(place[:, 2]), np.sin(place[:, 2])
        place = place + STEP * np.column_stack(
            [c * forward - s * left, s * forward + c * left, np.full(robots, turn)]
        )
        path.append(place)
    shape = (steps, robots)
    return Rollout(
        STEP, command, 0.5, np.zeros((*shape, 60), np.float32),
        np.zeros((*shape, 12), np.float32) if action is None else action,
        np.zeros((*shape, 4), np.float32), np.zeros((*shape, 12)), np.ones((*shape, 4), bool),
        np.zeros((*shape, 3)), np.array(path), np.ones(shape, bool), np.zeros(robots, bool),
    )  # fmt: skip


def recorded(plain: Rollout, *others: Rollout) -> Trial:
    """A trial whose walks are known: one alone is `plain`, several are the `others` in turn."""

    class Recorded(Trial):
        def walks(self, policy, conditions, part=(0.0, 1.0)):
            if len(conditions) == 1 or not others:
                return [plain] * len(conditions)
            return [others[i * len(others) // len(conditions)] for i in range(len(conditions))]

    return Recorded(Walking(), servo_ranges("ideal"), robots=plain.alive.shape[1])


def walk(policy, task, servos, episodes, seed, command=None, threads=0, walker="policy") -> Walk:
    """Episodes under one condition, as an evaluation walks them."""
    one = [Condition(task, episodes, command, walker=walker)]
    return walk_together(policy, servos, one, task.episode_s, seed, threads, Recorder)[0]
