"""Live readings are dated at their read, polled ones to their poll; doubt is given in numbers."""

import json
import math
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from scipy.stats import beta

from pupper_sysid.sysid.feedback.poll_lattice import (
    PollLattice,
    common_period,
    find_poll_lattice,
    fresh_rows,
    readings,
    redate,
)
from pupper_sysid.sysid.feedback.poll_search import Phase, Stretch, log_likelihood, most_hits
from pupper_sysid.sysid.feedback.slips import count_loss, fast
from pupper_sysid.sysid.recordings.recording import Trial
from support.synthetic import LOOP_S, tone_trials


def test_a_servo_that_sticks_is_not_mistaken_for_a_bus_that_holds():
    rng = np.random.default_rng(0)
    t = 0.02 * np.arange(300)
    move = 0.0015 * np.round(0.1 * np.sin(2 * np.pi * t) / 0.0015)
    # half of the rows repeat the one before
    last = np.maximum.accumulate(np.where(rng.random(300) < 0.5, np.arange(300), 0))
    stuck = move[last]
    stuck[40] = np.nan

    def trial(readings: Literal["live"] | None) -> Trial:
        return Trial("LF_hip", 0, 1.0, t, t + 0.001, move, stuck, None, 0.0, readings)

    assert len(fresh_rows(trial(None))) < 200
    asked = trial("live")
    lattice, rows = (
        find_poll_lattice([asked], np.random.default_rng(0)),
        np.delete(np.arange(300), 40),
    )
    assert lattice.kind == "every read" and fresh_rows(asked).tolist() == rows.tolist()
    # each at the time it was read, not somewhere between two reads
    assert np.allclose(readings(asked, lattice).time_s, asked.read_time_s[rows])


@pytest.mark.parametrize("seed", range(8))
def test_the_poll_behind_steps_is_not_taken_for_an_alias_of_it(seed):
    """Most rows are at rest, where a repeat says nothing of failed polls."""
    rng, poll_s, count_rad = np.random.default_rng(seed), 0.02685, 0.0057
    read = LOOP_S * np.arange(450) + 0.001
    levels = np.repeat(rng.uniform(-0.4, 0.4, 15), 30)
    polls = poll_s * np.arange(-4, 330) + rng.uniform(0.0, poll_s)
    polls = polls[rng.random(len(polls)) > 0.42]
    held = levels[np.clip((polls / LOOP_S).astype(int), 0, 449)]
    angle, moved = 0.0, []
    for gap, level in zip(np.diff(polls, prepend=polls[0]), held, strict=True):
        angle += (level - angle) * -np.expm1(-gap / 0.06)
        moved.append(angle + 0.003 * rng.standard_normal())
    counted = count_rad * np.round(np.array(moved) / count_rad)
    position = counted[np.searchsorted(polls, read, "right") - 1]
    trial = Trial("LF_hip", 0, 0.0, read - 0.001, read, levels, position, None, 0.0, "polled")
    lattice = find_poll_lattice([trial], rng)
    assert lattice.poll_period_s == pytest.approx(poll_s, abs=2e-4)


def test_a_header_that_says_polled_outweighs_motion_that_looks_live_or_cannot_be_told():
    rng = np.random.default_rng(1)
    trials = tone_trials(0.04, rng, period_s=0.0)
    assert find_poll_lattice(trials, rng).readings == "live"
    polled = [replace(t, readings="polled") for t in trials]
    # a second of a slow tone: too few steps for either
    few = tone_trials(0.04, rng, frequencies=(0.5,), duration_s=1.0, period_s=0.0)
    for asked, kind in ((polled, "polled"), (few, "cannot tell")):
        found = find_poll_lattice(asked, rng)
        # the poll must be faster than the loop of 19 ms: dated to the middle between two reads
        assert (found.kind, found.readings) == ("unresolved", kind)
        assert found.time_doubt_s == pytest.approx(LOOP_S / 2)


def test_live_trials_beside_polled_ones_are_dated_at_their_reads():
    rng = np.random.default_rng(4)
    polled = tone_trials(0.04, rng)
    live = replace(
        tone_trials(0.04, rng, frequencies=(2.0,), period_s=0.0)[0], number=9, readings="live"
    )
    found = find_poll_lattice([*polled, live], rng)
    # a lattice leaves no doubt and means polled
    assert (found.kind, found.readings, found.time_doubt_s) == ("lattice", "polled", 0.0)
    assert 9 not in {p.trial for p in found.phases}
    np.testing.assert_array_equal(readings(live, found).time_s, live.read_time_s)


# ----------------------------------------------------- times of readings on a known lattice

ROWS = np.arange(100)
READ = 0.02 * ROWS + 0.001
MIDDLE = READ - 0.01
"""Between the read before and this one."""


def times(*phases: Phase) -> np.ndarray:
    """Times of readings that change in every row, on these stretches of a lattice."""
    trial = Trial("LF_hip", 0, 1.0, READ - 0.001, READ, 0.01 * ROWS, 0.01 * ROWS, None, 0.0)
    found = readings(trial, PollLattice(kind="lattice", fresh_fraction=1.0, phases=phases))
    assert found.rows[-3:].tolist() == [97, 98, 99]
    full = np.full(len(ROWS), np.nan)
    full[found.rows] = found.time_s
    return full[1:]  # the first row has no read before it


def test_readings_within_a_stretch_are_dated_to_its_instants_and_others_to_the_middle():
    # instants at 0.009 + 0.02 n: 2 ms before the middle
    dated = times(Phase(0, 0.5, 1.0, 0.02, 0.009, 1e-4))
    inside = (READ >= 0.5) & (READ <= 1.0)
    np.testing.assert_allclose(dated, np.where(inside, MIDDLE - 0.002, MIDDLE)[1:], atol=1e-12)
    # instants at 0.013, 0.113, 0.213 …: in the rows 1, 6, 11 …, 2 ms after the middle
    dated = times(Phase(0, 0.0, 2.0, 0.1, 0.013, 1e-4))
    np.testing.assert_allclose(
        dated, np.where(ROWS % 5 == 1, MIDDLE + 0.002, MIDDLE)[1:], atol=1e-12
    )
    np.testing.assert_allclose(
        times(Phase(1, 0.0, 2.0, 0.02, 0.009, 1e-4)), MIDDLE[1:], err_msg="of another trial"
    )


# ----------------------------------------------------- the compiled search


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


# ----- intervals of poll period, loss and mean age, against formulas worked out by hand


def lattice(**numbers) -> PollLattice:
    return PollLattice(kind="lattice", readings="polled", fresh_fraction=0.5, **numbers)


def test_the_interval_of_the_loss_is_jeffreys_and_that_of_the_age_follows():
    found = lattice(poll_period_s=0.02, loss=0.25, polls=80.0)
    low, high = beta(20.5, 60.5).ppf([0.05, 0.95])
    assert (found.loss_interval.low, found.loss_interval.high) == pytest.approx((low, high))
    expected = [0.02 * (0.5 + p / (1 - p)) for p in (low, high)]
    assert [found.mean_age_interval.low, found.mean_age_interval.high] == pytest.approx(expected)
    # without a lost poll the value stays inside
    none = lattice(poll_period_s=0.02, loss=0.0, polls=80.0).loss_interval
    assert none.low == none.value == 0.0 and none.high == pytest.approx(beta(0.5, 80.5).ppf(0.95))
    # where every poll seems lost a reading is infinitely old
    lost = lattice(poll_period_s=0.02, loss=1.0, polls=40)
    assert math.isinf(lost.mean_age_s)
    assert json.loads(json.dumps(lost.to_dict()))["mean_age_s"] is None


def test_loss_and_age_cover_the_periods_that_are_not_ruled_out():
    # 60 of 80 polls each 20 ms brought a value; each 16 ms it would be 60 of 100
    found = lattice(poll_period_s=0.02, loss=0.25, polls=80.0, close_s=(0.016,))
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
        poll_period_s=0.0216, poll_period_sd_s=1e-5, loss=0.2, polls=128, close_s=(0.021,)
    )
    assert both.poll_period_interval.low < 0.021 < 0.0216 < both.poll_period_interval.high


def test_the_error_of_the_period_is_scatter_shrunk_towards_the_usual_drift():
    none = np.zeros(0)
    part = Stretch(0, 0.0, 3.0, np.zeros(50), np.zeros(50), none, none, np.ones(50, bool))
    periods = (0.0201, 0.0199, 0.0200, 0.0200)
    phases = [Phase(n, 0.0, 3.0, p, 0.0, 1e-4) for n, p in enumerate(periods)]
    period, error = common_period([part] * 4, phases, range(4))
    # variance (2e-8 + 3 · (0.002 · 0.02)²) / (4 - 1 + 3); neighbours are alike: 3 / 4 of it
    variance = (2e-8 + 3 * 1.6e-9) / 6
    assert period == pytest.approx(0.02) and error == pytest.approx(math.sqrt(3 * variance / 4))
    # segments of one stretch are one measurement
    half = replace(part, begin=np.zeros(25), end=np.zeros(25), moving=np.ones(25, bool))
    split = common_period([half] * 2 + [part] * 3, [phases[0], *phases], (0, 0, 1, 2, 3))
    assert split == pytest.approx((period, error))


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
    trials, motions = standing(np.random.default_rng(0))
    lattice = find_poll_lattice(trials, np.random.default_rng(0))
    again = redate(trials, lattice, [motions[n] for n in range(4)])
    # 400 polls: the share of lost ones scatters by 0.02
    assert again.polls > 100 and again.loss == pytest.approx(0.2, abs=0.05) and lattice.loss > 0.3


def test_the_loss_is_counted_without_bias():
    for loss, quantum in ((0.0, 0.0057), (0.6, 0.0057)):
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
