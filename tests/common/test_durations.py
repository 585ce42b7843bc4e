"""Streaming statistics of durations agree with those of all of them at once."""

from __future__ import annotations

import numpy as np
import pytest

from pupper_sysid.hardware.loop import Durations


@pytest.mark.parametrize("size", [1, 10, 5000])
def test_they_are_those_of_the_whole(size):
    values = np.random.default_rng(0).lognormal(-7.0, 1.0, size)
    found = Durations()
    for value in values:
        found.add(value)
    assert found.count == size and found.largest_s == values.max()
    assert found.mean_s == pytest.approx(values.mean()) and found.sd_s == pytest.approx(
        values.std()
    )
    for share in (0.5, 0.9, 0.99):
        exact = np.quantile(values, share, method="inverted_cdf")
        assert found.quantile(share) == pytest.approx(exact, rel=0.011)


def test_nothing_has_no_quantile_and_extremes_find_a_place():
    assert np.isnan(Durations().quantile(0.5))
    found = Durations()
    for value in (0.0, 1e-12, 1e6):
        found.add(value)
    assert found.largest_s == 1e6 and found.quantile(0.5) < 2e-7
