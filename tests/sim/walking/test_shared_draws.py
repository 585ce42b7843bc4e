"""Twins: one robot under several conditions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pupper_sysid.sim.walking.config import Curriculum, Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from pupper_sysid.sim.walking.shared_draws import Twins, generator


def test_twins_have_the_same_numbers_and_others_have_their_own():
    rng = generator(3, Twins(np.array([0, 1, 2, 0, 1]), 3))
    plain = np.random.default_rng(3)
    for draw in (
        lambda r, n: r.uniform(-1.0, np.arange(1.0, 5.0), (n, 4)), lambda r, n: r.random(n),
        lambda r, n: r.integers(0, 9, n), lambda r, n: r.exponential(5.0, n),
        lambda r, n: r.standard_normal((n, 1)),
    ):  # fmt: skip
        np.testing.assert_array_equal(draw(rng, 5), draw(plain, 3)[[0, 1, 2, 0, 1]])
        draw(rng, 2)  # of some robots only: leaves the others' numbers alone


def test_twins_walk_alike_until_their_conditions_differ():
    """The third robot equals the first but for 40 ms of dead time."""
    servos = servo_ranges("data/samples/calibrated.yaml")
    task = Walking(curriculum=Curriculum())
    task = replace(task, randomisation=replace(task.randomisation, push_m_s=0.0))
    alike, later = (
        PupperEnv(task, servos, 3, 0, 1, None, extra, Twins(np.array([0, 1, 0]), 2))
        for extra in (0.0, np.array([0.0, 0.0, 0.04]))
    )
    late_s = later.robots.drawn["dead_time_s"]
    np.testing.assert_allclose(late_s[2], late_s[0] + 0.04)
    assert (late_s[1] != late_s[0]).all()
    for env in (alike, later):
        env.set_command(np.zeros(3))
    wave = 0.3 * np.sin(np.arange(40)[:, None] * 0.4 + np.arange(12))
    for action in wave:
        same, late = (env.step(np.repeat(action[None], 3, axis=0)) for env in (alike, later))
    np.testing.assert_array_equal(same.observation[2], same.observation[0])
    np.testing.assert_array_equal(late.observation[:2], same.observation[:2])
    assert not np.allclose(same.observation[1], same.observation[0])
    assert not np.allclose(late.observation[2], late.observation[0])
