"""Intervals of poll period, loss and mean age, against formulas worked out by hand."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.stats import beta

from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice
from pupper_sysid.sysid.feedback.poll_loss import count_loss
from pupper_sysid.sysid.feedback.poll_period import common_period
from pupper_sysid.sysid.feedback.poll_search import Phase, Stretch
from support.synthetic import tone_trials


def lattice(**numbers) -> PollLattice:
    return PollLattice(kind="lattice", readings="polled", fresh_fraction=0.5, **numbers)


def test_a_reading_is_infinitely_old_where_every_poll_seems_lost():
    found = lattice(poll_period_s=0.02, loss=1.0, polls=40)
    assert math.isinf(found.mean_age_s)
    assert json.loads(json.dumps(found.to_dict()))["mean_age_s"] is None


def test_the_interval_of_the_loss_is_jeffreys_for_five_eighths_of_the_polls():
    found = lattice(poll_period_s=0.02, loss=0.25, polls=128).loss_interval
    assert (found.low, found.high) == pytest.approx(beta(20.5, 60.5).ppf([0.05, 0.95]))
    # without a lost poll the value stays inside
    none = lattice(poll_period_s=0.02, loss=0.0, polls=128).loss_interval
    assert none.low == none.value == 0.0 and none.high == pytest.approx(beta(0.5, 80.5).ppf(0.95))


def test_the_interval_of_the_age_is_that_of_the_loss():
    found = lattice(poll_period_s=0.02, loss=0.25, polls=128)
    low, high = beta(20.5, 60.5).ppf([0.05, 0.95])
    expected = [0.02 * (0.5 + p / (1 - p)) for p in (low, high)]
    assert [found.mean_age_interval.low, found.mean_age_interval.high] == pytest.approx(expected)


def test_a_period_that_explains_as_much_is_inside_the_interval():
    alone = lattice(poll_period_s=0.0216, poll_period_sd_s=1e-5, loss=0.2, polls=128)
    assert alone.poll_period_interval.low == pytest.approx(0.0216 - 1.645e-5, abs=1e-8)
    both = lattice(
        poll_period_s=0.0216, poll_period_sd_s=1e-5, loss=0.2, polls=128, rivals_s=(0.021,)
    )
    assert both.poll_period_interval.low < 0.021 < 0.0216 < both.poll_period_interval.high


def test_the_error_of_the_period_is_scatter_shrunk_towards_the_usual_drift():
    none = np.zeros(0)
    part = Stretch(0, 0.0, 3.0, np.zeros(50), np.zeros(50), none, none)
    periods = (0.0201, 0.0199, 0.0200, 0.0200)
    phases = [Phase(n, 0.0, 3.0, p, 0.0, 1e-4) for n, p in enumerate(periods)]
    period, error = common_period([part] * 4, phases)
    # variance (2e-8 + 3 · (0.002 · 0.02)²) / (4 - 1 + 3); neighbours are alike: 3 / 4 of it
    variance = (2e-8 + 3 * 1.6e-9) / 6
    assert period == pytest.approx(0.02) and error == pytest.approx(math.sqrt(3 * variance / 4))


@pytest.mark.parametrize(("loss", "quantum"), [(0.0, 0.0057), (0.3, 0.0), (0.6, 0.0057)])
def test_the_loss_is_counted_without_bias(loss, quantum):
    rng = np.random.default_rng(8)
    counted = []
    for _ in range(2):
        trials = tone_trials(
            0.08, rng, frequencies=(2.0, 3.0, 4.0), gain=0.8, loss=loss, quantum_rad=quantum,
            period_s=0.031,
        )  # fmt: skip
        found = find_poll_lattice(trials, rng)
        counted.append(found.loss)
        assert count_loss(trials, found.phases) == (found.loss, found.polls)
        assert found.polls > 100
    sd = math.sqrt(max(loss * (1 - loss), 0.01) / (2 * 150))
    assert np.mean(counted) == pytest.approx(loss, abs=3 * sd)
