"""Sines are recovered exactly, and the bootstrap's spread is the textbook's."""

import numpy as np
import pytest

from pupper_sysid.common.tones import block_bootstrap, fit_sine, least_squares, phasors, sine_design


def test_phasors_of_two_tones_and_an_offset_are_recovered_at_irregular_times():
    time = np.sort(np.random.default_rng(0).uniform(0.0, 3.0, 90))
    first, second = 2 * np.pi * 1.3 * time, 2 * np.pi * 3.1 * time
    value = 0.7 + (np.exp(1j * first) * (0.2 - 0.5j)).real + (np.exp(1j * second) * 0.1j).real
    solution = least_squares(sine_design(first, second), value)
    assert solution[0] == pytest.approx(0.7)
    np.testing.assert_allclose(phasors(solution), [0.2 - 0.5j, 0.1j], atol=1e-12)


def test_channels_are_fitted_apart():
    angle = np.linspace(0.0, 20.0, 70)
    value = np.stack([1.0 + np.cos(angle), -2.0 + 3.0 * np.sin(angle)], axis=1)
    found = fit_sine(angle, value)
    np.testing.assert_allclose(found.offset, [1.0, -2.0], atol=1e-12)
    np.testing.assert_allclose(found.phasor, [1.0, -3.0j], atol=1e-12)


def test_the_bootstrap_spreads_a_mean_by_its_standard_error():
    rng = np.random.default_rng(1)
    value = rng.standard_normal(4000)
    fit = block_bootstrap(np.ones((4000, 1)), value, np.arange(4000) // 10, rng, 2000)
    assert fit.blocks == 400
    assert fit.solution == pytest.approx(value.mean())
    # 400 blocks: the spread of a spread is 4 %, of 2000 draws 2 %
    assert fit.drawn.std() == pytest.approx(4000**-0.5, rel=0.15)
    assert fit.inflated(2.0).std() == pytest.approx(2 * fit.drawn.std())


def test_too_few_blocks_are_cut_finer():
    design = sine_design(np.linspace(0.0, 30.0, 100))
    fit = block_bootstrap(
        design, np.arange(100.0), np.zeros(100, int), np.random.default_rng(2), 5, 8
    )
    assert fit.blocks == 8 and fit.drawn.shape == (5, 3)
    np.testing.assert_allclose(fit.solution, least_squares(design, np.arange(100.0)))
