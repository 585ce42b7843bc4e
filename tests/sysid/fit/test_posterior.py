"""Draws of a posterior whose ridge bends: damping and back-EMF, of which a motion tells the sum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.servo_models.step_size import CONTINUOUS_S
from pupper_sysid.sysid.fit.posterior import _Target, sample
from pupper_sysid.sysid.fit.run import free_run
from pupper_sysid.sysid.fit.search import Problem, refine
from pupper_sysid.sysid.fit.structure import candidate
from support.runs import fine_run

NOISE_RAD = 5e-4
STRUCTURE = candidate("delayed_pd_back_emf")
TRUTH = {
    "dead_time_s": 0.01, "stiffness_per_s2": 9000.0, "damping_per_s": 60.0,
    "friction_rad_s2": 10.0, "effort_rad_s2": 3000.0, "no_load_speed_rad_s": 40.0,
    "offset_rad": 0.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def slow() -> Problem:
    """A motion that is far from the limits of effort and speed."""
    rng = np.random.default_rng(1)
    time = CONTINUOUS_S * np.arange(int(4.0 / CONTINUOUS_S))
    run = fine_run(0.1 * np.sin(2 * np.pi * 1.3 * time) + 0.05 * np.sin(2 * np.pi * 3.1 * time))
    (track,) = free_run(STRUCTURE, np.array([TRUTH[n] for n in STRUCTURE.names]), (run,))
    read = np.interp(run.sample_step, np.arange(len(track)), track)
    read += NOISE_RAD * rng.standard_normal(len(read))
    return Problem(STRUCTURE, (replace(run, sample_rad=read),), (NOISE_RAD,))


def test_what_a_motion_does_not_show_keeps_its_prior_and_the_sum_is_known(slow):
    start = STRUCTURE.encode(np.array([TRUTH[n] for n in STRUCTURE.names]))
    draws = sample(slow, refine(slow, start[None]), 1.0, np.random.default_rng(0)).points
    values = dict(zip(STRUCTURE.names, STRUCTURE.decode(draws).T, strict=True))
    total = values["damping_per_s"] + values["effort_rad_s2"] / values["no_load_speed_rad_s"]
    low, high = np.quantile(total, [0.05, 0.95])
    assert low <= 60.0 + 3000.0 / 40.0 <= high and high < 1.3 * low
    effort = np.log(values["effort_rad_s2"])
    # from the least effort that the motion needs on: half of the prior and more
    assert (
        effort.std() > 0.5 * STRUCTURE.parameters[STRUCTURE.names.index("effort_rad_s2")].prior_sd
    )
    share = np.quantile(values["damping_per_s"] / total, [0.05, 0.95])
    assert share[0] < 0.3 and share[1] > 0.9


def test_the_change_of_coordinates_has_an_inverse_a_determinant_of_one_and_a_hessian(slow):
    rng, target = np.random.default_rng(2), _Target(slow, 1.0)
    centre = STRUCTURE.encode(np.array([TRUTH[n] for n in STRUCTURE.names]))
    fitted = centre + 0.3 * rng.standard_normal((5, len(centre)))
    points = target.straight(fitted)
    np.testing.assert_allclose(target.fitted(points), fitted, atol=1e-12)
    away = 1e-6 * np.eye(len(centre))
    slope = (target.fitted(points[0] + away) - target.fitted(points[0] - away)).T / 2e-6
    assert abs(np.linalg.det(slope)) == pytest.approx(1.0, rel=1e-6)
    other = replace(target, temperature=1.0)
    object.__setattr__(other, "_places", None)
    np.testing.assert_allclose(
        target.curvature(points[:1])[0], slope.T @ other.curvature(fitted[:1])[0] @ slope, rtol=1e-5
    )
