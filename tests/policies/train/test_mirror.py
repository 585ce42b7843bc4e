"""Mirror images of observations and actions are those of the physics."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import LEGS
from pupper_sysid.policies.train.learner import Learner, WalkingVecEnv, mirrored
from pupper_sysid.policies.train.run_file import Hyperparameters
from pupper_sysid.sim.robot.mini_pupper import foot_position
from pupper_sysid.sim.walking.config import Observation, Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.tiny_training import tiny_run
from support.walks import STILL


def test_feet_of_mirrored_joints_are_mirrored_feet():
    joints = torch.from_numpy(np.random.default_rng(0).uniform(-0.5, 0.5, 12))
    image = mirrored(joints)
    for leg, other in zip(LEGS, ("RF", "LF", "RB", "LB"), strict=True):
        own, theirs = 3 * LEGS.index(leg), 3 * LEGS.index(other)
        x, y, z = foot_position(leg, *joints[own : own + 3].numpy())
        np.testing.assert_allclose(
            foot_position(other, *image[theirs : theirs + 3].numpy()), (x, -y, z), atol=1e-9
        )


def test_a_robot_with_mirrored_commands_and_actions_sees_the_mirror_image():
    task = Walking(randomisation=STILL, observation=Observation(noise=False, base_velocity="true"))
    servos = servo_ranges("paper", "ideal")
    servos = replace(servos, low=servos.value, high=servos.value)
    env = PupperEnv(task, servos, 2, seed=0, threads=1)
    env.set_command(np.array([[0.1, 0.05, 0.3], [0.1, -0.05, -0.3]]))
    env._strides.phase[1] = 0.5  # the mirrored clock
    pose = torch.from_numpy(np.random.default_rng(1).uniform(-0.5, 0.5, 12))
    for k in range(10):
        action = pose * k / 20
        found = env.step(np.stack([action.numpy(), mirrored(action).numpy()]))
    for name, values in (("policy", found.observation), ("privileged", found.privileged)):
        own, other = torch.from_numpy(values)
        assert (own - other).abs().max() > 0.1
        # contacts are solved by a few iterations, in the order of the feet
        np.testing.assert_allclose(mirrored(own, name), other, atol=0.05)


def learner(kind: str) -> Learner:
    run = tiny_run(kind)
    env = PupperEnv(run.task, servo_ranges(run.actuator), 8, seed=0, threads=1)
    hyper = Hyperparameters(
        steps_per_environment=6, epochs=1, minibatches=1, learning_rate=1e-3, mirror=True
    )
    return Learner(WalkingVecEnv(env), run.architecture, hyper, seed=0)


def test_samples_and_their_images_teach_the_same():
    own, other = learner("mlp"), learner("mlp")
    before = [p.clone() for p in own.actor.parameters()]
    for one in (own, other):
        torch.manual_seed(4)
        one.rollout()
    stored = other.ppo.storage
    for name, values in stored.observations.items():
        stored.observations[name] = mirrored(values, name)
    stored.actions = mirrored(stored.actions)
    for one in (own, other):
        one.ppo.update()
    for network in ("actor", "critic"):
        pairs = zip(
            getattr(own.ppo, network).parameters(), getattr(other.ppo, network).parameters(),
            strict=True,
        )  # fmt: skip
        for a, b in pairs:
            # sums of another order; Adam divides small gradients by their size
            torch.testing.assert_close(a, b, atol=2e-5, rtol=0)
    assert any(
        (a - b).abs().max() > 1e-4 for a, b in zip(own.actor.parameters(), before, strict=True)
    )


def test_policies_with_a_memory_are_refused():
    with pytest.raises(InputError, match="mirror"):
        learner("lstm")
