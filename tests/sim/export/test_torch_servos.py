"""Set-points and readings that exports compute on torch, and their twin in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.delayed_pd import DelayLine
from pupper_sysid.servo_models.held_feedback import HeldFeedback as Feedback
from pupper_sysid.sim.export.torch_servos import HeldFeedback, ServoBank, SetPoint

FAST = {"dead_time_s": 0.0137, "jitter_s": 0.0, "velocity_limit_rad_s": 1000.0}
SLOW = {"dead_time_s": 0.0301, "jitter_s": 0.0, "velocity_limit_rad_s": 2.0}
READ = {"poll_period_s": 0.0268, "loss": 0.42, "quantum_rad": 0.0, "offset_rad": 0.0}
AGE_S = 0.0268 * (0.5 + 0.42 / 0.58)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("step_s", [0.002, 0.005, 1 / 240])
def test_a_command_arrives_after_its_dead_time_to_a_fraction_of_a_step(step_s):
    rng = np.random.default_rng(0)
    commands = np.repeat(rng.uniform(-0.9, 0.9, (12, 3, 2)), 4, axis=0)
    set_point = SetPoint({"a": FAST, "b": FAST | {"dead_time_s": 0.03}}, ["a", "b"], 3, step_s)
    set_point.reset(torch.zeros(3, 2))
    there = np.stack([set_point.step(torch.tensor(c).float()).numpy() for c in commands])
    line = DelayLine(np.array([FAST["dead_time_s"], 0.03]), step_s)
    line.reset(np.zeros((3, 2)))
    np.testing.assert_allclose(there, line.shift(commands), atol=1e-5)


def test_a_set_point_moves_at_the_servos_speed():
    set_point = SetPoint({"a": SLOW}, ["a"], 1, 0.005)
    set_point.reset(torch.zeros(1, 1))
    track = np.array([set_point.step(torch.ones(1, 1)).item() for _ in range(60)])
    # 30.1 ms late, then 2 rad/s
    expected = np.clip(2.0 * (0.005 * np.arange(1, 61) - 0.0301), 0, None)
    np.testing.assert_allclose(track, np.minimum(expected, track.max()), atol=0.011)
    assert np.diff(track).max() == pytest.approx(0.01, rel=1e-4)


def test_each_command_has_a_latency_of_its_own_and_none_overtakes_another():
    jittery = FAST | {"dead_time_s": 0.03, "jitter_s": 0.008}
    robots, step_s = 4000, 0.001
    set_point = SetPoint({"a": jittery}, ["a"], robots, step_s, generator=generator())
    set_point.reset(torch.zeros(robots, 1))
    track = [set_point.step(torch.full((robots, 1), 1.0)) for _ in range(100)]
    latency = step_s * (100 - torch.stack(track).sum(0))  # the area above a step is its delay
    assert latency.mean().item() == pytest.approx(0.03, abs=5e-4)
    assert latency.std().item() == pytest.approx(0.008, rel=0.05)
    assert latency.min().item() >= 0.022 - 1e-5
    rising = SetPoint({"a": jittery}, ["a"], 200, step_s, generator=generator(1))
    rising.reset(torch.zeros(200, 1))
    track = torch.stack([rising.step(torch.full((200, 1), float(k // 5))) for k in range(200)])
    assert (track.diff(dim=0) >= -1e-5).all()


@pytest.mark.parametrize("step_s", [0.001, 0.005, 0.02])
def test_readings_are_as_old_as_the_servos_say_at_any_physics_step(step_s):
    robots = 3000
    feedback = HeldFeedback({"a": READ}, ["a"], robots, step_s, generator=generator())
    feedback.reset(torch.zeros(robots, 1))
    for k in range(1, round(0.4 / step_s) + 1):
        reading = feedback.step(torch.full((robots, 1), k * step_s))
    ages = (k * step_s - reading).numpy()
    # three standard errors of the mean of so many ages
    assert ages.mean() == pytest.approx(AGE_S, abs=3 * ages.std() / np.sqrt(robots))
    torch.testing.assert_close(feedback.age, k * step_s - reading, atol=2e-5, rtol=0)


@pytest.mark.parametrize("step_s", [0.002, 0.005, 0.04])
def test_readings_in_numpy_are_as_old(step_s):
    feedback = Feedback(poll_period_s=0.0268, loss=0.42)
    feedback.reset(np.zeros(3000), step_s, np.random.default_rng(0))
    for k in range(1, round(0.4 / step_s) + 1):
        reading = feedback.step(np.full(3000, k * step_s))
    ages = k * step_s - reading
    assert ages.mean() == pytest.approx(AGE_S, abs=3 * ages.std() / np.sqrt(3000))
    np.testing.assert_allclose(feedback.age_s, ages, atol=1e-9)


def test_both_read_counts_and_ideal_feedback_is_fresh():
    coarse = Feedback(quantum_rad=0.01, offset_rad=0.003)
    coarse.reset(0.0, 0.005)
    assert coarse.step(0.0179) == pytest.approx(0.02) and coarse.age_s == 0.0
    numbers = READ | {"poll_period_s": 0.0, "quantum_rad": 0.01}
    ideal = HeldFeedback({"a": numbers}, ["a"], 1, 0.005)
    ideal.reset(torch.zeros(1, 1))
    assert ideal.step(torch.full((1, 1), 0.0179)).item() == pytest.approx(0.02)
    with pytest.raises(InputError, match="reset"):
        Feedback().step(0.0)
    with pytest.raises(InputError, match="time_step_s"):
        Feedback().reset(0.0, 0.0)


def test_one_robot_is_reset_and_the_others_go_on():
    bank = ServoBank({"a": FAST}, {"a": READ}, ["a"], 3, 0.005)
    rest = torch.tensor([[0.1], [0.2], [0.3]])
    for _ in range(10):
        target = bank.command(torch.ones(3, 1), rest)
        bank.read(rest)
    assert torch.equal(target, torch.ones(3, 1))
    bank.restart([1])
    moved = torch.tensor([[0.1], [-0.5], [0.3]])
    assert bank.read(moved)[1].item() == pytest.approx(-0.5)
    assert torch.equal(bank.command(torch.ones(3, 1), moved)[:, 0], torch.tensor([1, -0.5, 1]))
    before = bank.feedback.age.clone()
    bank.read(moved)
    bank.read(moved)  # no time passes between two readings
    assert (bank.feedback.age - before <= 0.005 + 1e-6).all()
