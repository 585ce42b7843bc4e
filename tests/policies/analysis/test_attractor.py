"""Orbits: circles, ellipses, bands and noise, whose shapes are known."""

import numpy as np
import pytest

from pupper_sysid.policies.analysis.autonomy import area, area_ratio, closure, principal_components

STEP_S, HZ = 0.02, 3.25


def loop(major: float, minor: float, steps: int = 600) -> np.ndarray:
    """An ellipse in the plane, run through at 3.25 Hz; 600 steps are 39 whole periods."""
    angle = 2 * np.pi * HZ * STEP_S * np.arange(steps)
    return np.stack([major * np.cos(angle), minor * np.sin(angle)], axis=1)


def somewhere(plane: np.ndarray, size: int, rng: np.random.Generator) -> np.ndarray:
    """A plane orbit put at a random place and attitude of `size` dimensions."""
    frame = np.linalg.qr(rng.standard_normal((size, plane.shape[-1])))[0]
    return plane @ frame.T + rng.standard_normal(size)


def test_components_are_those_of_an_svd_and_noise_of_twelve_dimensions_is_spread_over_twelve():
    rng = np.random.default_rng(2)
    parts = [rng.standard_normal((30, 2, 5)) @ rng.standard_normal((5, 5)), np.ones((20, 5))]
    found = principal_components(parts, 3)
    states = np.concatenate([p.reshape(-1, 5) for p in parts])  # about their common mean
    _, singular, axes = np.linalg.svd(states - states.mean(axis=0))
    np.testing.assert_allclose(found.variance, singular**2 / len(states), atol=1e-12)
    np.testing.assert_allclose(np.abs((found.axes * axes[:3]).sum(axis=1)), 1.0)
    noise = principal_components([rng.standard_normal((50_000, 12))], 3)
    assert noise.participation_ratio == pytest.approx(12.0, abs=0.05)
    np.testing.assert_allclose(noise.explained, 1 / 12, atol=0.005)


def test_conditions_share_their_axes_so_orbits_keep_size_and_place():
    rng = np.random.default_rng(3)
    large = somewhere(loop(0.4, 0.2), 12, rng)
    small = 0.5 * (large - large.mean(axis=0)) + large.mean(axis=0)
    found = principal_components([large, small], 2)
    np.testing.assert_allclose(
        np.ptp(found.orbit(large), axis=0), 2 * np.ptp(found.orbit(small), axis=0)
    )
    # robots keep their dimension
    robots = np.stack([large, small], axis=1)
    assert found.orbit(robots).shape == (600, 2, 2)
    np.testing.assert_allclose(found.orbit(robots)[:, 1], found.orbit(small))
    assert area_ratio(found.orbit(small), found.orbit(large)) == pytest.approx(0.25)


def test_a_circle_closes_though_a_period_is_no_whole_number_of_steps():
    orbit = somewhere(loop(0.3, 0.3), 12, np.random.default_rng(4))
    assert 1 / (HZ * STEP_S) % 1 > 0.3
    assert closure(orbit, STEP_S, HZ) < 1e-3
    # half a period off, every point is opposite: a diameter over √2 radii
    assert closure(orbit, STEP_S, 2 * HZ) == pytest.approx(np.sqrt(2), rel=0.01)


def test_the_closure_of_a_noisy_orbit_is_the_share_of_noise():
    """Points a period apart differ by the noise of both: closure² = noise / whole variance."""
    # eight whole steps a period, where the spline goes through the points
    angle = 2 * np.pi / 8 * np.arange(20_000)
    noise = np.random.default_rng(6).standard_normal((20_000, 2))
    orbit = np.stack([np.cos(angle), np.sin(angle)], axis=1) + 0.5 * noise
    share = 2 * 0.25 / (1 + 2 * 0.25)
    assert closure(orbit, STEP_S, 1 / (8 * STEP_S)) == pytest.approx(np.sqrt(share), abs=0.01)
    assert closure(noise, STEP_S, 1 / (8 * STEP_S)) == pytest.approx(1.0, abs=0.02)


def test_an_ellipse_has_its_area_wherever_it_lies_and_a_band_is_what_is_left_of_a_circle():
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    assert area(loop(0.4, 0.1) @ turn.T + [3.0, -1.0]) == pytest.approx(np.pi * 0.04)
    # robots with centres of their own are no wider for it
    apart = np.stack([loop(0.4, 0.1), loop(0.4, 0.1) + 5.0], axis=1)
    assert area(apart) == pytest.approx(np.pi * 0.04)
    circle, still = loop(0.3, 0.3), np.zeros((100, 2))
    assert area_ratio(loop(0.3, 0.003), circle) == pytest.approx(0.01)
    assert area_ratio(still, circle) == 0.0 and np.isnan(area_ratio(circle, still))
    for too_little in (loop(1, 1, 30), np.ones((100, 2))):
        assert np.isnan(closure(too_little, STEP_S, HZ))
