"""Draws of a posterior whose ridge bends: damping and back-EMF, of which a motion tells the sum."""

import numpy as np
import pytest

import pupper_sysid as ps
from pupper_sysid.servo_models.step_size import CONTINUOUS_S
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice
from pupper_sysid.sysid.fit.posterior import (
    LATCH_SD_S,
    _Target,
    as_wide_as_folds,
    sample,
    with_date_errors,
)
from pupper_sysid.sysid.fit.run import prepare
from pupper_sysid.sysid.fit.search import Fit, Problem, curvatures, refine
from pupper_sysid.sysid.fit.structure import candidate
from support.runs import fine_run, problem_of

NOISE_RAD = 5e-4
STRUCTURE = candidate("delayed_pd_back_emf")
TRUTH = {
    "dead_time_s": 0.01, "stiffness_per_s2": 9000.0, "damping_per_s": 60.0,
    "friction_rad_s2": 10.0, "effort_rad_s2": 3000.0, "no_load_speed_rad_s": 40.0,
    "offset_rad": 0.0,
}  # fmt: skip
NUMBERS = np.array([TRUTH[name] for name in STRUCTURE.names])


@pytest.fixture(scope="module")
def slow() -> Problem:
    """A motion that is far from the limits of effort and speed."""
    time = CONTINUOUS_S * np.arange(int(4.0 / CONTINUOUS_S))
    run = fine_run(0.1 * np.sin(2 * np.pi * 1.3 * time) + 0.05 * np.sin(2 * np.pi * 3.1 * time))
    return problem_of(STRUCTURE, NUMBERS, run, NOISE_RAD, np.random.default_rng(1))


def test_what_a_motion_does_not_show_keeps_its_prior_and_the_sum_is_known(slow):
    start = STRUCTURE.encode(NUMBERS)
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
    straight, centre = target.straight, STRUCTURE.encode(NUMBERS)
    fitted = centre + 0.3 * rng.standard_normal((5, len(centre)))
    points = straight.of(fitted)
    np.testing.assert_allclose(straight.fitted(points), fitted, atol=1e-12)
    away = 1e-6 * np.eye(len(centre))
    slope = (straight.fitted(points[0] + away) - straight.fitted(points[0] - away)).T / 2e-6
    np.testing.assert_allclose(straight.slope(points[:1])[0], slope, atol=1e-8)
    assert abs(np.linalg.det(slope)) == pytest.approx(1.0, rel=1e-6)
    precision = STRUCTURE.prior_precision
    (bent,) = target.curvature(points[:1])
    (of_readings,) = curvatures(slow, fitted[:1], 0.01) - precision
    np.testing.assert_allclose(bent, slope.T @ (of_readings + precision) @ slope, rtol=1e-5)


def test_folds_that_disagree_on_back_emf_leave_the_sum_of_damping_and_back_emf_known():
    # each fit without a tone has another share of back-EMF, all the same sum
    names = STRUCTURE.names
    places = [names.index(n) for n in ("damping_per_s", "no_load_speed_rad_s", "effort_rad_s2")]

    def point(back_emf: float) -> np.ndarray:
        values = STRUCTURE.decode(STRUCTURE.encode(NUMBERS))
        values[places] = 50.0 - back_emf, 120.0 / back_emf, 120.0
        return STRUCTURE.encode(values)

    rng, best = np.random.default_rng(4), Fit(point(0.6), 0.0)
    draws = best.point + 0.01 * rng.standard_normal((2000, len(names)))
    folds = [Fit(point(back_emf), 0.0) for back_emf in (4.0, 12.0, 30.0, 48.0)]
    wide = STRUCTURE.decode(as_wide_as_folds(draws, STRUCTURE, best, folds, 4))
    damping, speed, effort = wide[:, places].T
    low, high = np.quantile(damping + effort / speed, [0.05, 0.95])
    assert low < 50.0 < high < 1.1 * low
    assert np.quantile(effort / speed, 0.95) > 25.0


@pytest.mark.parametrize(("jumps", "noise_rad"), [(1, 0.02), (16, 0.02), (1, 1e-5)])
def test_a_dead_time_is_no_surer_than_the_turn_of_the_servo_at_which_each_command_begins(
    jumps, noise_rad
):
    rng, loop_s = np.random.default_rng(3), 0.01
    sent = loop_s * np.arange(round(0.4 / loop_s * jumps))
    level = 0.1 * (np.arange(len(sent)) // round(0.2 / loop_s) % 2)
    trial = ps.Recording.from_arrays(
        sent, {"knee": level}, {"knee": level}, read_time_s=sent + 0.001,
        metadata={"readings": "live", "start_pose_rad": {"knee": 0.0}},
    ).trials("knee")[0]  # fmt: skip
    lattice = find_poll_lattice([trial], rng)
    run = prepare(trial, lattice).in_free_air()
    problem = problem_of(STRUCTURE, NUMBERS, run, noise_rad, rng)
    point = STRUCTURE.encode(NUMBERS)
    still = np.tile(point, (4000, 1))
    wider = with_date_errors(still, problem, Fit(point, 0.0), [trial], False, rng)
    spread_s = STRUCTURE.decode(wider)[:, 0].std()
    if noise_rad < 1e-3:  # readings that are exact allow no command to be late
        assert spread_s < 0.1 * LATCH_SD_S
    else:
        assert spread_s == pytest.approx(LATCH_SD_S / np.sqrt(2 * jumps), rel=0.6)
