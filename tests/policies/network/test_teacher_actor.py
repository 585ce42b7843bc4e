"""What a teacher sees."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from pupper_sysid.policies.network.actor_critic import build
from pupper_sysid.policies.network.hyperparameters import Architecture, Hyperparameters
from pupper_sysid.policies.network.teacher import inputs
from pupper_sysid.sim.walking.observation import (
    OBSERVATION_PARTS,
    OBSERVATION_SIZE,
    PRIVILEGED_PARTS,
    PRIVILEGED_SIZE,
)

TURNS = 0.1


@pytest.fixture
def seen() -> TensorDict:
    """Random observations of five robots, whose clocks stand at a tenth of a turn."""
    generator = torch.Generator().manual_seed(0)
    sizes = {"policy": OBSERVATION_SIZE, "privileged": PRIVILEGED_SIZE, "noise": 12}
    found = TensorDict(
        {k: torch.randn(5, n, generator=generator) for k, n in sizes.items()}, batch_size=[5]
    )
    angle = 2 * np.pi * TURNS
    clock = torch.tensor([np.cos(angle), np.sin(angle), 0.3])
    found["privileged"][:, PRIVILEGED_PARTS["clock"]] = clock.float()
    return found


def test_a_teacher_sees_command_imu_and_the_clock_with_its_harmonics(seen):
    found = inputs(seen)
    assert found.shape == (5, 34)
    torch.testing.assert_close(found[:, :9], seen["policy"][:, 3:12])
    angles = 2 * np.pi * TURNS * np.array([1, 2, 3])
    cos, sin = np.cos(angles), np.sin(angles)
    np.testing.assert_allclose(found[0, 9:16], [0.3, *cos, *sin], atol=1e-6)
    strokes = np.multiply.outer(seen["policy"][0, 9:12], [*cos, *sin])
    np.testing.assert_allclose(found[0, 16:], strokes.flatten(), atol=1e-6)


def test_nothing_else_reaches_its_actions(seen):
    architecture = Architecture("mlp", (16,), 8, (16,), privileged_actor=True)
    actor, critic = build(architecture, seen, Hyperparameters(), 0.02)
    actor.update_normalization(seen)
    before, valued = actor(seen), critic(seen)
    other = seen.clone()
    other["policy"][:, OBSERVATION_PARTS["joint_velocity"]] += 1.0
    other["privileged"][:, PRIVILEGED_PARTS["friction"]] += 1.0
    other["privileged"][:, PRIVILEGED_PARTS["base_linear_velocity"]] += 1.0
    torch.testing.assert_close(actor(other), before)
    assert not torch.allclose(critic(other), valued)
    other["privileged"][:, PRIVILEGED_PARTS["clock"]] *= -1.0
    assert not torch.allclose(actor(other), before)
