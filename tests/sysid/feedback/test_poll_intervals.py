"""Intervals of poll period, loss and mean age, against formulas worked out by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import beta

from pupper_sysid.sysid.feedback.poll_lattice import (
    PollLattice,
    common_period,
    find_poll_lattice,
    redate,
)
from pupper_sysid.sysid.feedback.poll_search import Phase, Stretch
from pupper_sysid.sysid.feedback.slips import count_loss, fast
from pupper_sysid.sysid.recordings.recording import Trial
from support.synthetic import tone_trials


def lattice(**numbers) -> PollLattice:
    return PollLattice(kind="lattice", readings="polled", fresh_fraction=0.5, **numbers)


def test_a_reading_is_infinitely_old_where_every_poll_seems_lost():
    found = lattice(poll_period_s=0.02, loss=1.0, polls=40)
    assert math.isinf(found.mean_age_s)
    assert json.loads(json.dumps(found.to_dict()))["mean_age_s"] is None


def test_the_interval_of_the_loss_is_jeffreys_and_that_of_the_age_follows():
    found = lattice(poll_period_s=0.02, loss=0.25, polls=80.0)
    low, high = beta(20.5, 60.5).ppf([0.05, 0.95])
    assert (found.loss_interval.low, found.loss_interval.high) == pytest.approx((low, high))
    expected = [0.02 * (0.5 + p / (1 - p)) for p in (low, high)]
    assert [found.mean_age_interval.low, found.mean_age_interval.high] == pytest.approx(expected)
    # without a lost poll the value stays inside
    none = lattice(poll_period_s=0.02, loss=0.0, polls=80.0).loss_interval
    assert none.low == none.value == 0.0 and none.high == pytest.approx(beta(0.5, 80.5).ppf(0.95))


def test_loss_and_age_cover_the_periods_that_are_not_ruled_out():
    # 60 of 80 polls each 20 ms brought a value; each 16 ms it would be 60 of 100
    found = lattice(poll_period_s=0.02, loss=0.25, polls=80.0, rivals_s=(0.016,))
    high = beta(40.5, 60.5).ppf(0.95)
    assert found.loss_interval.low == pytest.approx(beta(20.5, 60.5).ppf(0.05))
    assert found.loss_interval.high == pytest.approx(high)
    low = beta(20.5, 60.5).ppf(0.05)
    ends = [0.02 * (0.5 + low / (1 - low)), 0.016 * (0.5 + high / (1 - high))]
    assert found.mean_age_interval.low == pytest.approx(ends[0])
    assert found.mean_age_interval.high == pytest.approx(max(
        ends[1], 0.02 * (0.5 + 1 / (1 / beta(20.5, 60.5).ppf(0.95) - 1))))  # fmt: skip


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
    period, error = common_period([part] * 4, phases, range(4))
    # variance (2e-8 + 3 · (0.002 · 0.02)²) / (4 - 1 + 3); neighbours are alike: 3 / 4 of it
    variance = (2e-8 + 3 * 1.6e-9) / 6
    assert period == pytest.approx(0.02) and error == pytest.approx(math.sqrt(3 * variance / 4))


def test_segments_of_one_stretch_are_one_measurement_of_the_period():
    none = np.zeros(0)
    whole = Stretch(0, 0.0, 3.0, np.zeros(50), np.zeros(50), none, none)
    half = replace(whole, begin=np.zeros(25), end=np.zeros(25))
    periods = (0.0201, 0.0199, 0.0200)
    phases = [Phase(n, 0.0, 3.0, p, 0.0, 1e-4) for n, p in enumerate(periods)]
    plain = common_period([whole] * 3, phases, range(3))
    split = common_period([half] * 2 + [whole] * 2, [phases[0], *phases], (0, 0, 1, 2))
    assert split == pytest.approx(plain)


def standing(rng):
    """A joint that stands, while its command moves on, for half of each trial."""
    motions, trials = {}, []
    for n in range(4):
        polls = 5.0 * n + np.arange(-1.0, 4.0, 0.031)
        good = polls[(rng.random(len(polls)) > 0.2) | (polls < 5.0 * n - 0.5)]
        send = 5.0 * n + np.arange(0, 4.0, 0.019)
        command = 0.3 * np.sin(4 * np.pi * (send - 5.0 * n))

        def motion(time, start=5.0 * n):
            s = np.maximum(time - start - 0.05, 0.0)
            return 0.3 * np.sin(4 * np.pi * s) * ((s // 0.5) % 2 == 0)

        read = send + 0.0005
        shown = motion(good[np.searchsorted(good, read, "right") - 1])
        shown = 0.0057 * np.round(shown / 0.0057)
        trials.append(Trial("LF_hip", n, 2.0, send, read, command, shown, None, 0.0))
        motions[n] = motion
    return trials, motions


def test_a_joint_that_stands_still_loses_no_polls_once_its_motion_is_known():
    found = []
    for seed in range(2):
        trials, motions = standing(np.random.default_rng(seed))
        lattice = find_poll_lattice(trials, np.random.default_rng(0))
        again = redate(trials, lattice, [motions[n] for n in range(4)])
        assert again.polls > 100
        found.append((lattice.loss, again.loss))
    alone, known = np.mean(found, axis=0)
    assert known == pytest.approx(0.2, abs=0.05) and alone > 0.3


def test_the_loss_is_counted_without_bias():
    for loss, quantum in ((0.0, 0.0057), (0.3, 0.0), (0.6, 0.0057)):
        rng = np.random.default_rng(8)
        trials = tone_trials(
            0.08, rng, frequencies=(2.0, 3.0, 4.0), gain=0.8, loss=loss, quantum_rad=quantum,
            period_s=0.031,
        )  # fmt: skip
        found = find_poll_lattice(trials, rng)
        assert count_loss(trials, found.phases, fast(trials)) == (found.loss, found.polls)
        assert found.polls > 100
        sd = math.sqrt(max(loss * (1 - loss), 0.01) / 150)
        assert found.loss == pytest.approx(loss, abs=3 * sd)
