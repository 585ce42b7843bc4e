"""Information of simulated trials, against formulas."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.sysid.fit.posterior import PHASE_SD_S
from pupper_sysid.sysid.fit.run import at_steps, free_run
from pupper_sysid.sysid.fit.structure import candidate
from pupper_sysid.sysid.plan.planner import (
    Hypothesis,
    Noise,
    fitted_noise,
    prior_information,
    respond,
    separation,
    without_shift,
)
from support.planned_servos import NOISE, hypothesis, recorded_servo, tones, with_readings


def test_a_delay_is_as_uncertain_as_the_bound_of_a_tone_says():
    """sd(τ) = sqrt(2 / N) s / (A 2π f), the Cramér-Rao bound of a tone's time shift."""
    model, delay, floor = candidate("pure_delay"), 0.025, 0.01
    (trial,) = tones((2.0,), loop_period_s=0.002)  # else a delay shifts stairs, not a tone
    found = respond(
        Hypothesis(model, np.array([delay, 1.0, 0.0]), prior_information(model)), trial,
        Noise(floor, 0.0),
    )  # fmt: skip
    bound = np.sqrt(2 / len(trial.sample_step)) * floor / (0.3 * 2 * np.pi * 2.0)
    # about the logarithm of the delay; the rest at the head and the rise say nothing
    sd = delay / np.sqrt(found.information[0, 0])
    assert sd == pytest.approx(bound, rel=0.1)


def test_a_longer_dead_time_shows_where_the_joint_moves():
    own, (trial,) = hypothesis(), tones((2.0,), loop_period_s=0.002)
    found = respond(own, trial, NOISE)
    (track,) = free_run(own.model, own.values, [trial])
    expected = -own.values[0] * at_steps(np.gradient(track) / trial.step_s, trial.sample_step)
    off = found.sensitivity[:, 0] - expected
    assert np.sqrt(np.mean(off**2)) < 0.1 * np.sqrt(np.mean(expected**2))


def test_however_long_a_tone_is_its_own_shift_in_time_stays_in_doubt():
    own = hypothesis()
    information = respond(own, tones((3.0,))[0], NOISE).information
    for repeats in (1e3, 1e6):
        left = without_shift(repeats * information)
        assert own.values[0] / np.sqrt(left[0, 0]) == pytest.approx(PHASE_SD_S, rel=0.01)


def test_readings_that_do_not_arrive_say_nothing():
    trial = tones((2.0,))[0]
    whole, half = (respond(hypothesis(), trial, NOISE, seen).information for seen in (1.0, 0.5))
    assert half == pytest.approx(0.5 * whole)


def test_jitter_makes_fast_readings_uncertain():
    weights = Noise(0.003, 0.002).weights(np.array([0.0, 2.0]))
    assert weights == pytest.approx([1 / 0.003**2, 1 / (0.003**2 + 0.004**2)])


def test_noise_of_a_fit_is_told_apart_into_floor_and_jitter():
    own, rng, truth = hypothesis(), np.random.default_rng(5), Noise(0.003, 0.003)
    trials = [with_readings(own, t, truth, rng) for t in tones() for _ in range(4)]
    found = fitted_noise(own.model, own.values, trials, 1e-4)
    assert found.floor_rad == pytest.approx(truth.floor_rad, rel=0.15)
    assert found.jitter_s == pytest.approx(truth.jitter_s, rel=0.15)


def test_noise_is_never_smaller_than_the_quantisation_allows():
    own = hypothesis()
    rng = np.random.default_rng(0)
    exact = [with_readings(own, t, Noise(1e-9, 0.0), rng) for t in tones()]
    assert fitted_noise(own.model, own.values, exact, 0.0017).floor_rad == 0.0017


def test_a_model_is_not_told_apart_from_itself():
    own = hypothesis()
    responses = [respond(own, t, NOISE) for t in tones()]
    assert separation(responses, responses, own.known) == pytest.approx(0.0, abs=1e-9)


def test_models_are_told_apart_by_what_remains_after_the_rival_is_fitted_again():
    slew, back_emf = recorded_servo([], structures=2).hypotheses
    pair = [[respond(h, t, NOISE) for t in tones((4.0, 8.0))] for h in (slew, back_emf)]
    free = separation(*pair, known=back_emf.known)
    frozen = separation(*pair, known=1e12 * np.eye(len(back_emf.known)))
    assert 0 < free < frozen
    # a parameter that may take any value explains more still
    loose = replace(back_emf, known=1e-3 * back_emf.known)
    assert separation(*pair, known=loose.known) <= free
