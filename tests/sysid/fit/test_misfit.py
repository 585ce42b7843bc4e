"""Explanations of a misfit: a filter in front, play, a dead zone; none of a servo that has none."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.step_size import CONTINUOUS_S
from pupper_sysid.sysid.fit.choice import undescribed
from pupper_sysid.sysid.fit.goodness import DESCRIBED, goodness_of_fit, overall
from pupper_sysid.sysid.fit.joint_fit import unidentified
from pupper_sysid.sysid.fit.misfit import (
    Explanation,
    decided,
    explanations,
    low_passed,
    with_delays,
)
from pupper_sysid.sysid.fit.run import Run, free_run
from pupper_sysid.sysid.fit.search import Problem, refine
from pupper_sysid.sysid.fit.structure import SIMULATED, Structure, candidate, servo_structure
from support.runs import fine_run, run_of

NOISE_RAD = 5e-4
STEP_S = TIME_STEP_S
NUMBERS = {
    "dead_time_s": 0.015, "stiffness_per_s2": 4000.0, "damping_per_s": 80.0,
    "friction_rad_s2": 20.0, "effort_rad_s2": 1500.0, "velocity_limit_rad_s": 20.0,
    "offset_rad": 0.0,
}  # fmt: skip


def stepped_run(command: np.ndarray) -> Run:
    """A run under `command`, one a step, read every 10 ms from 0.1 s on."""
    sample = np.arange(0.1 / STEP_S, len(command) - 1, 0.01 / STEP_S)
    return run_of(command, sample_step=sample, sample_rad=np.zeros(len(sample)))


def found(
    structure: Structure, numbers: dict, filter_s: float = 0.0, undescribed: bool = True
) -> tuple[Problem, list[Explanation]]:
    """What may explain the motion of one servo, beside a fit of the plain one."""
    rng = np.random.default_rng(0)
    time = STEP_S * np.arange(int(2.0 / STEP_S))
    levels = np.repeat(0.3 * rng.standard_normal(8), len(time) // 8)
    runs = (stepped_run(levels), stepped_run(0.3 * np.sin(2 * np.pi * 2.0 * time)))
    moved = tuple(low_passed(r, filter_s) for r in runs) if filter_s else runs
    tracks = free_run(structure, np.array([numbers[n] for n in structure.names]), moved)
    read = tuple(
        replace(r, sample_rad=np.interp(r.sample_step, np.arange(len(t)), t)
                + NOISE_RAD * rng.standard_normal(len(r.sample_step)))
        for r, t in zip(runs, tracks, strict=True)
    )  # fmt: skip
    plain = candidate(SIMULATED[0])
    problem = Problem(plain, read, (NOISE_RAD,) * len(read))
    start = plain.encode(np.array([NUMBERS[n] for n in plain.names]))
    best = refine(problem, start[None])
    return problem, explanations(problem, best, 1.0, undescribed, rng)


def explanation(*servo, **options) -> Explanation | None:
    """The one that is decidedly better."""
    return decided(found(*servo, **options)[1])


def test_exact_readings_have_no_noise_below_a_tenth_of_a_milliradian():
    """A simulation of a simulation is off by its time step, which is no misfit."""
    plain = candidate(SIMULATED[0])
    time = STEP_S * np.arange(int(4.0 / STEP_S))
    run = replace(stepped_run(0.3 * np.sin(2 * np.pi * 2.0 * time)), frequency_hz=2.0)
    true = np.array([NUMBERS[n] for n in plain.names])
    track = free_run(plain, true, (run,))[0]
    run = replace(run, sample_rad=np.interp(run.sample_step, np.arange(len(track)), track))

    def ratio(damping_share: float) -> float:
        values = np.where(np.array(plain.names) == "damping_per_s", damping_share * true, true)
        return overall(goodness_of_fit(plain, values, (run,), 0.0))

    assert 0.0 < ratio(1.0005) < DESCRIBED < ratio(1.02)


def test_errors_in_the_transients_of_steps_count_the_same_however_long_the_rests_are():
    """As outliers among readings at rest they would be clipped."""
    rng, plain = np.random.default_rng(5), candidate(SIMULATED[0])
    true = np.array([NUMBERS[n] for n in plain.names])
    wrong = np.where(np.array(plain.names) == "damping_per_s", 1.05 * true, true)
    levels = rng.uniform(-0.4, 0.4, 40)

    def ratios(rest_s: float) -> list[float]:
        run = stepped_run(np.repeat(levels, int(rest_s / STEP_S)))
        track = free_run(plain, true, (run,))[0]
        noise = NOISE_RAD * rng.standard_normal(len(run.sample_step))
        read = np.interp(run.sample_step, np.arange(len(track)), track) + noise
        run = replace(run, sample_rad=read)
        return [overall(goodness_of_fit(plain, v, (run,), 0.0)) for v in (true, wrong)]

    short, long = ratios(0.4), ratios(3.0)
    assert [short[0], long[0]] == pytest.approx([1.0, 1.0], abs=0.1)
    assert long[1] == pytest.approx(short[1], rel=0.3)


def test_one_motion_that_is_not_described_is_a_misfit_among_others_that_are():
    others = {"1 Hz": 1.0, "2 Hz": 1.05, "3 Hz": 1.0, "4 Hz": float("nan")}
    assert undescribed(others | {"7 Hz": 2.0}) is None and undescribed({}) is None
    assert "in the motion 7 Hz: its errors are 2.5 times" in undescribed(others | {"7 Hz": 2.5})
    assert "its errors are 3.0 times the noise" in undescribed({"7 Hz": 3.0})


def test_numbers_that_are_unknown_for_one_reason_share_a_sentence():
    reasons = {"stiffness_per_s2": "too slow", "friction_rad_s2": "no load", "damping": "too slow"}
    assert list(unidentified("knee", reasons)) == [
        "knee: stiffness and damping are not identified: too slow.",
        "knee: friction loss is not identified: no load.",
    ]


def test_a_filter_of_a_step_command_rises_as_an_exponential():
    time = CONTINUOUS_S * np.arange(2000)
    run = low_passed(fine_run(np.where(time < 0.1, 0.0, 1.0)), 0.02)
    end = run.edges[0][run.pad :]
    expected = np.where(time < 0.1, 0.0, 1.0 - np.exp(-(time + CONTINUOUS_S - 0.1) / 0.02))
    np.testing.assert_allclose(end, expected, atol=1e-6)


def test_a_servo_without_anything_more_is_left_alone():
    assert explanation(candidate(SIMULATED[0]), NUMBERS) is None


def test_a_small_dead_zone_that_does_not_show_leaves_the_friction_open():
    """What a dead zone and friction hold back together is known, and not how much each does."""
    wider = servo_structure((*candidate(SIMULATED[0]).features, "dead zone"))
    numbers = NUMBERS | {"dead_zone_rad": 0.0006, "friction_rad_s2": 12.0}
    problem, rivals = found(wider, numbers, undescribed=False)
    assert decided(rivals) is None
    place = problem.structure.names.index("friction_rad_s2")
    frictions = [float(problem.structure.decode(r.point)[place]) for r in rivals]
    assert min(frictions) == pytest.approx(12.0, rel=0.1) and max(frictions) > 13.5
    assert all(0.0 < r.weight <= 1.0 for r in rivals)


def test_a_low_pass_filter_is_named_and_gains_make_up_for_a_part_of_it():
    _, rivals = found(candidate(SIMULATED[0]), NUMBERS, 0.016, undescribed=False)
    named = decided(rivals)
    assert named is rivals[0]
    constant = re.fullmatch(r"a low-pass filter of about (\d+) ms in front of it", named.words)
    assert constant is not None and 13 <= int(constant[1]) <= 19
    shortest, longest = with_delays(named, rivals).delays_s
    assert shortest < named.dead_time_s < longest
    width = longest - shortest
    assert shortest - width < 0.015 < longest + width < 0.016
    a_ninth_of_the_readings = replace(named, temperature=9.0)
    doubtful = with_delays(a_ninth_of_the_readings, rivals).delays_s
    assert doubtful[1] - doubtful[0] > 2.0 * width


@pytest.mark.parametrize(
    ("feature", "numbers", "words", "size"),
    [
        ("backlash", {"backlash_rad": 0.02}, "play of ([0-9.]+) mrad", 20.0),
        pytest.param("dead zone", {"dead_zone_rad": 0.02}, "a dead zone of ([0-9.]+) mrad", 20.0,
                     marks=pytest.mark.slow),
        ("integral", {"integral_per_s": 4.0}, "an integral term .* of ([0-9.]+)/s", 4.0),
        pytest.param(
            "integral", {"integral_per_s": 50.0, "stiffness_per_s2": 2e4, "damping_per_s": 160.0,
                         "effort_rad_s2": 1000.0, "dead_time_s": 0.015},
            "an integral term .* of ([0-9.]+)/s", 50.0, marks=pytest.mark.slow,
        ),
        pytest.param(
            "stribeck", {"stribeck_friction": 90.0, "stribeck_speed_rad_s": 0.5},
            "more friction at rest than in motion()", 0.0, marks=pytest.mark.slow,
        ),
        pytest.param("gravity", {"gravity_sin": 150.0, "gravity_cos": 0.0},
                     "a load whose weight pulls()", 0.0, marks=pytest.mark.slow),
        ("flexible", {"link_share": 0.3, "link_hz": 9.0, "link_damping_ratio": 0.06},
         "a link that bends, with ([0-9]+) % of the inertia", 30.0),
    ],
)  # fmt: skip
def test_what_a_servo_has_besides_is_named_with_its_size(feature, numbers, words, size):
    wider = servo_structure((*candidate(SIMULATED[0]).features, feature))
    named = explanation(wider, NUMBERS | numbers)
    assert named is not None
    match = re.match(words, named.words)
    assert match is not None, named.words
    assert float(match[1] or 0.0) == pytest.approx(size, rel=0.15)
    assert named.dead_time_s == pytest.approx(NUMBERS["dead_time_s"], abs=1e-3)
