"""The compiled search for a poll lattice counts and weighs as its formulas say."""

from __future__ import annotations

import numpy as np

from pupper_sysid.sysid.feedback.poll_kernel import log_likelihood, most_hits


def intervals(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Reads every 19 ms of a bus polled every 26.8 ms, some a little late."""
    end = 0.019 * np.arange(1, 120) + rng.normal(0, 1e-4, 119)
    return end - 0.019, end


def test_hits_are_counted_over_all_phases():
    begin, end = intervals(np.random.default_rng(0))
    periods = np.array([0.0201, 0.0268, 0.0533])
    first = np.floor((begin / periods[:, None] % 1.0) * 64).astype(int)
    span = np.round((end - begin) / periods[:, None] * 64).astype(int)
    phase = np.arange(64)
    inside = (phase[:, None, None] - first) % 64 < np.minimum(span, 64)
    found = most_hits(begin, end, periods, 64)
    np.testing.assert_array_equal(found, inside.sum(axis=2).max(axis=0))


def test_likelihood_is_that_of_intervals_with_blurred_edges():
    rng = np.random.default_rng(1)
    begin, end = intervals(rng)
    periods, phases = np.array([0.0265, 0.0268]), np.linspace(-0.5, 0.5, 16, endpoint=False)
    blur, inside, outside = 0.0025, 0.97, rng.uniform(0.01, 0.03, len(begin))
    away = (0.5 * (begin + end) / periods[:, None])[:, None] - phases[:, None] + 0.5
    distance = np.abs(away % 1.0 - 0.5) * periods[:, None, None]
    share = np.clip((0.5 * (end - begin) - distance) / blur + 0.5, 0.0, 1.0)
    np.testing.assert_allclose(
        log_likelihood(begin, end, periods, phases, blur, inside, outside),
        np.log(inside * share + outside).sum(axis=2), rtol=1e-12,
    )  # fmt: skip
