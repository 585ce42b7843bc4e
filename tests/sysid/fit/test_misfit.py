"""Explanations of a misfit: a filter in front, play, a dead zone; none of a servo that has none."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.servo_models.step_size import CONTINUOUS_S
from pupper_sysid.sysid.fit.misfit import Explanation, decided, explanations, filtered
from pupper_sysid.sysid.fit.run import free_run
from pupper_sysid.sysid.fit.search import Problem, refine
from pupper_sysid.sysid.fit.structure import SIMULATED, Structure, candidate, servo_structure
from support.runs import fine_run

NOISE_RAD = 5e-4
NUMBERS = {
    "dead_time_s": 0.015, "stiffness_per_s2": 4000.0, "damping_per_s": 80.0,
    "friction_rad_s2": 20.0, "effort_rad_s2": 1500.0, "velocity_limit_rad_s": 20.0,
    "offset_rad": 0.0,
}  # fmt: skip


def explanation(
    structure: Structure, numbers: dict, filter_s: float = 0.0, undescribed: bool = True
) -> Explanation | None:
    """What is found of the motion of one servo, by a fit of the plain one."""
    rng = np.random.default_rng(0)
    time = CONTINUOUS_S * np.arange(int(2.0 / CONTINUOUS_S))
    levels = np.repeat(0.3 * rng.standard_normal(8), len(time) // 8)
    runs = (fine_run(levels), fine_run(0.3 * np.sin(2 * np.pi * 2.0 * time)))
    moved = tuple(filtered(r, filter_s) for r in runs) if filter_s else runs
    tracks = free_run(structure, np.array([numbers[n] for n in structure.names]), moved)
    read = tuple(
        replace(r, sample_rad=np.interp(r.sample_step, np.arange(len(t)), t)
                + NOISE_RAD * rng.standard_normal(len(r.sample_step)))
        for r, t in zip(runs, tracks, strict=True)
    )  # fmt: skip
    plain = candidate(SIMULATED[0])
    problem = Problem(plain, read, (NOISE_RAD,) * len(read))
    start = plain.encode(np.array([NUMBERS[n] for n in plain.names]))
    return decided(explanations(problem, refine(problem, start[None]), 1.0, undescribed, rng))


def test_a_filter_of_a_step_command_rises_as_an_exponential():
    time = CONTINUOUS_S * np.arange(2000)
    run = filtered(fine_run(np.where(time < 0.1, 0.0, 1.0)), 0.02)
    end = run.edges[0][run.pad :]
    expected = np.where(time < 0.1, 0.0, 1.0 - np.exp(-(time + CONTINUOUS_S - 0.1) / 0.02))
    np.testing.assert_allclose(end, expected, atol=1e-6)


def test_a_servo_without_anything_more_is_left_alone():
    assert explanation(candidate(SIMULATED[0]), NUMBERS) is None


def test_a_low_pass_filter_is_named_and_its_dead_time_is_the_true_one():
    found = explanation(candidate(SIMULATED[0]), NUMBERS, 0.016, undescribed=False)
    assert found is not None
    constant = re.fullmatch(r"a low-pass filter of about (\d+) ms in front of it", found.words)
    assert constant is not None and 13 <= int(constant[1]) <= 19
    assert found.dead_time_s == pytest.approx(0.015, abs=1e-3)


@pytest.mark.parametrize(
    ("feature", "name", "words"),
    [("backlash", "backlash_rad", "play of"), ("dead zone", "dead_zone_rad", "a dead zone of")],
)
def test_play_and_dead_zones_are_named_with_their_size(feature, name, words):
    wider = servo_structure((*candidate(SIMULATED[0]).features, feature))
    found = explanation(wider, NUMBERS | {name: 0.02})
    assert found is not None and found.words.startswith(words)
    size = float(found.words.removeprefix(words).split()[0])
    assert size == pytest.approx(20.0, rel=0.15)
