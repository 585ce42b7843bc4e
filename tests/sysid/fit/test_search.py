"""Search: local fits leave the dents of a ridge, and find limits that have no slope."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.step_size import CONTINUOUS_S
from pupper_sysid.sysid.fit.choice import Fitted
from pupper_sysid.sysid.fit.joint_fit import _slight_limits
from pupper_sysid.sysid.fit.run import Run, fresh_residuals
from pupper_sysid.sysid.fit.search import (
    Fit,
    Problem,
    curvature,
    from_about,
    refine,
    search_widely,
    with_limits,
)
from pupper_sysid.sysid.fit.structure import candidate
from support.runs import fine_run, problem_of

NOISE_RAD = 4e-4
NUMBERS = {
    "dead_time_s": 0.0219, "stiffness_per_s2": 10_670.0, "damping_per_s": 140.0,
    "friction_rad_s2": 7.15, "effort_rad_s2": 144.0, "no_load_speed_rad_s": 400.0,
    "offset_rad": 0.0,
}  # fmt: skip
ALONG_THE_RIDGE = NUMBERS | {
    "dead_time_s": 0.0255, "stiffness_per_s2": 19_800.0, "damping_per_s": 168.0,
    "friction_rad_s2": 16.8, "effort_rad_s2": 216.0, "no_load_speed_rad_s": 13.3,
}  # fmt: skip


def test_local_fits_from_points_about_a_fit_find_the_way_along_a_ridge():
    time = CONTINUOUS_S * np.arange(int(4.0 / CONTINUOUS_S))
    sent = np.floor(time / 0.02) * 0.02
    chirp = 0.12 * np.sin(2 * np.pi * (0.5 * sent + 0.5 * (6.0 - 0.5) / 4.0 * sent**2))
    structure = candidate("delayed_pd_back_emf")
    truth, far = (
        structure.encode(np.array([numbers[name] for name in structure.names]))
        for numbers in (NUMBERS, ALONG_THE_RIDGE)
    )
    run = fine_run(chirp, 0.005)
    stuck = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        problem = problem_of(structure, structure.decode(truth), run, NOISE_RAD, rng)
        best = refine(problem, truth[None]).cost
        near = refine(problem, far[None])
        stuck.append(near.cost > best + 100)
        assert from_about(problem, near, rng).cost < best + 1
    assert any(stuck), "the ridge has no dent, so this proves nothing"


def test_residuals_that_are_too_large_to_square_print_no_warning():
    structure = candidate("delayed_pd_back_emf")
    point = structure.encode(np.array([NUMBERS[name] for name in structure.names]))
    run = fine_run(np.repeat([0.0, 0.3], 500), 0.005)
    run = replace(run, sample_rad=np.full(len(run.sample_step), 1e200))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        curvature(Problem(structure, (run,), (NOISE_RAD,)), point, 0.01)


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2))])
def test_a_stiff_servo_that_is_always_at_its_limits_is_found(seed):
    # in steps of 2 ms it moves so differently that the search in them leads elsewhere
    noise_rad, structure = 2e-3, candidate("delayed_pd")
    truth = np.array([0.015, 34_000.0, 397.0, 5.4, 152.0, 3.9, 0.0])
    time = CONTINUOUS_S * np.arange(int(4.0 / CONTINUOUS_S))
    sent = np.floor(time / 0.01) * 0.01
    run = fine_run(0.24 * np.sin(2 * np.pi * (2.0 * sent + 0.4 * sent**2)), 0.008)
    run = run.coarser().coarser()
    rng = np.random.default_rng(seed)
    problem = problem_of(structure, truth, run, noise_rad, rng)
    best = refine(problem, structure.encode(truth)[None]).cost
    # dents near the truth, of up to 34 by eight seeds, are left to the draws
    assert search_widely(problem, rng).cost < best + 50


def saturating(effort_rad_s2: float, rng: np.random.Generator) -> tuple[Problem, Fit]:
    """A chirp that meets a limit of the torque, and the fit from the truth."""
    structure = candidate("delayed_pd")
    truth = np.array([0.03, 1650.0, 40.0, 30.0, effort_rad_s2, 200.0, 0.0])
    time = CONTINUOUS_S * np.arange(int(3.0 / CONTINUOUS_S))
    run = fine_run(0.25 * np.sin(2 * np.pi * (0.5 * time + 0.6 * time**2)), 0.01)
    problem = problem_of(structure, truth, run, NOISE_RAD, rng)
    return problem, refine(problem, structure.encode(truth)[None])


def test_a_limit_that_the_fitted_motion_does_not_reach_is_found_where_it_cuts():
    """Above the largest torque of the motion the cost is flat: no slope leads to the limit."""
    rng = np.random.default_rng(0)
    problem, true = saturating(73.0, rng)
    unlimited = true.point + np.log(40.0) * (np.arange(7) == 4)
    flat = refine(problem, unlimited[None])
    assert flat.cost > 10 * true.cost, "the slope leads there, so this proves nothing"
    assert with_limits(problem, flat).cost < true.cost + 1


def test_a_limit_is_known_where_it_explains_more_than_noise_and_what_the_model_leaves_over():
    for effort_rad_s2, undescribed, known in (
        (73.0, 1.5, True), (160.0, 1.0, True), (160.0, 1.5, False), (300.0, 1.0, False),
    ):  # fmt: skip
        problem, fit = saturating(effort_rad_s2, np.random.default_rng(0))
        ready = SimpleNamespace(problem=lambda structure, problem=problem: problem)
        slight = _slight_limits(ready, Fitted(problem.structure, fit), {"chirp": undescribed})
        assert ("effort_rad_s2" not in slight) is known, (effort_rad_s2, undescribed)


def steps_of(seconds: float, rng: np.random.Generator) -> Run:
    """Random steps every 0.5 s, read 200 times per second."""
    levels = np.repeat(rng.uniform(-0.3, 0.3, int(2 * seconds)), round(0.5 / CONTINUOUS_S))
    return fine_run(levels, 0.005).coarser().coarser()


def test_a_search_sees_parts_of_a_long_motion_in_which_the_servo_moves_as_in_the_whole():
    structure = candidate("delayed_pd_back_emf")
    truth = np.array([NUMBERS[name] for name in structure.names])
    rng = np.random.default_rng(0)
    long = problem_of(structure, truth, steps_of(90.0, rng), NOISE_RAD, rng)
    excerpt = long.excerpt
    assert len(excerpt.runs) > 3 and excerpt.excerpt is excerpt
    steps = [float(np.ptp(r.sample_step)) for r in excerpt.runs]
    assert 11_000 < sum(steps) < 15_000 and max(steps) * excerpt.runs[0].step_s < 3.1
    for residuals in fresh_residuals(structure, truth, excerpt.runs):
        assert rms(residuals) < 1.2 * NOISE_RAD
    for whole in (steps_of(15.0, rng), replace(steps_of(2.0, rng), frequency_hz=1.0)):
        short = problem_of(structure, truth, whole, NOISE_RAD, rng)
        assert short.excerpt is short


def test_a_search_skips_where_no_command_changes_and_most_of_dense_readings():
    rng = np.random.default_rng(1)
    moves = rng.uniform(-0.3, 0.3, 60)
    levels = np.repeat(np.concatenate([np.zeros(120), moves]), round(0.5 / CONTINUOUS_S))
    run = fine_run(levels, 0.001)
    parts = run.excerpts(9.0)
    assert len(parts) == 3
    for part in parts:
        inside = part.sample_step.astype(int)
        assert len(np.unique(part.command[inside])) > 3
        assert np.median(np.diff(part.sample_step)) * part.step_s > 0.006


def test_a_search_sees_two_periods_of_a_long_slow_tone():
    time_s = CONTINUOUS_S * np.arange(round(12.0 / CONTINUOUS_S))
    tone = replace(fine_run(0.3 * np.sin(np.pi * time_s), 0.02), frequency_hz=0.5)
    (part,) = tone.excerpts(1.0)
    assert np.ptp(part.sample_step) * part.step_s == pytest.approx(4.0, abs=0.02)
