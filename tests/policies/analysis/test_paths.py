"""Paths, terrain, pushes and rates: what the closed-loop analyses say of known motions."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.policies.analysis.autonomy import (
    NUDGE_M_S,
    PUSH_M_S,
    RatePoint,
    _pusher,
    push_response,
    rate_exponent,
    rate_response,
)
from pupper_sysid.policies.analysis.trial import DirectionWalk, compliance, terrain
from pupper_sysid.policies.walks.rollouts import Rollout
from pupper_sysid.policies.walks.together import DIRECTIONS
from reproduction.evidence import scales
from support.walks import STEP, recorded, walked


def measured(walk: Rollout) -> DirectionWalk:
    return compliance(None, recorded(walk))[0]  # pyright: ignore[reportArgumentType]


def test_speed_drift_arc_and_wandering_of_a_path_are_those_of_its_motion():
    half = measured(walked((0.2, 0.0, 0.0), 0.1, 0.0, 0.0))
    assert half.share.value == pytest.approx(0.5, rel=0.01)
    assert half.drift.value == pytest.approx(0.0, abs=1e-9)
    assert half.arc_rad_m.value == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(half.wander_m.value) and half.survival == 1.0
    # walking backward, the robot's left is to the right of where it goes
    backward = measured(walked((-0.2, 0.0, 0.0), -0.2, 0.05, 0.0))
    assert backward.drift.value == pytest.approx(-0.25, rel=0.01)
    curved = measured(walked((0.2, 0.0, 0.0), 0.2, 0.0, -0.06))
    assert curved.arc_rad_m.value == pytest.approx(-0.3, rel=0.03)
    turned = measured(walked((0.0, 0.0, -0.4), 0.0, 0.0, -0.3))
    assert turned.share.value == pytest.approx(0.75, rel=0.01)
    assert turned.wander_m.value == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(turned.drift.value)


def test_a_robot_that_fell_went_nowhere_and_says_nothing_of_drift():
    rollout = walked((0.2, 0.0, 0.0), 0.2, 0.0, -0.06, robots=2)
    rollout.alive[150:, 0] = False
    one = measured(rollout)
    assert one.share.value == pytest.approx(0.5, rel=0.01)
    assert one.arc_rad_m.value == pytest.approx(-0.3, rel=0.03)
    rollout.alive[150:] = False
    none = measured(rollout)
    assert none.share.value == 0.0 and np.isnan(none.drift.value)


def waves(hz: float, ahead: float, steps: int) -> np.ndarray:
    """Actions of a trot, `ahead` of the plain one by so many cycles."""
    phase = hz * STEP * np.arange(steps)[:, None] + ahead
    return np.sin(2 * np.pi * (phase + np.linspace(0, 0.5, 12)))[:, None, :].astype(np.float32)


@pytest.mark.parametrize(
    ("hz", "nudged", "pushed", "tolerance"),
    # of 0.6 Hz the window of the last push would end after the walk
    [(3.1, 0.0, 0.1, 0.01), (3.1, -0.3, 0.45, 0.01), (0.6, 0.0, 0.1, 0.05)],
)
def test_the_shift_that_a_push_leaves_is_that_of_the_phases(hz, nudged, pushed, tolerance):
    """Walks of 10 s: a plain one, and for each speed of a push one that is ahead of it."""
    plain, nudge, push = (
        walked((0.1, 0, 0), 0.1, 0, 0, 10.0, 1, waves(hz, ahead, round(10.0 / STEP)))
        for ahead in (0.0, nudged, pushed)
    )
    small, large = push_response(None, recorded(plain, nudge, push))  # type: ignore[arg-type]
    assert (small.push_m_s, large.push_m_s) == (NUDGE_M_S, PUSH_M_S)
    assert small.shift_early == pytest.approx(abs(nudged), abs=tolerance)
    assert large.shift_late == pytest.approx(abs(pushed), abs=tolerance)
    assert large.shifts == pytest.approx([pushed] * len(large.shifts), abs=tolerance)
    assert large.kept == pytest.approx(1.0, abs=0.1), "the phase stays where it was pushed"


def test_a_push_changes_the_sideways_speed_at_its_step_only(walker):
    policy, trial = walker
    trial = replace(trial, seconds=0.5)
    plain = trial.walk(policy)
    (pushed,) = trial.walks(policy, [trial.condition(None, _pusher(15, 0.3))])
    np.testing.assert_array_equal(plain.velocity[:15], pushed.velocity[:15])
    # a foot on the ground takes some of it within the step
    assert (pushed.velocity[15, :, 1] - plain.velocity[15, :, 1]).min() > 0.1


@pytest.mark.slow
def test_a_policy_walks_at_other_rates_with_other_scales_and_on_other_ground(walker, monkeypatch):
    policy, trial = walker
    monkeypatch.setattr("pupper_sysid.policies.analysis.autonomy.RATES_HZ", (50.0, 71.43))
    usual, faster = rate_response(policy, trial)
    assert usual.survival == 1 and usual.frequency_hz == pytest.approx(3.0, abs=0.15)
    assert faster.rate_hz == pytest.approx(71.43, abs=0.01)
    assert usual.cycles_per_step == pytest.approx(usual.frequency_hz / 50)
    short = replace(trial, seconds=0.4)
    assert [r.scale_rad for r in scales(policy, short)] == [0.45, 0.5, 0.6, 0.75]
    rows = {r.ground: r.survival for r in terrain(policy, short)}
    assert set(rows) >= {"flat", "rough", "slopes", "troughs", "steps"} and rows["flat"] == 1.0


def test_a_policy_goes_where_it_is_commanded(walker, monkeypatch):
    policy, trial = walker
    some = {k: DIRECTIONS[k] for k in ("forward", "turn left", "stand")}
    monkeypatch.setattr("pupper_sysid.policies.analysis.trial.DIRECTIONS", some)
    forward, turn = compliance(policy, replace(trial, seconds=3.5))
    assert forward.direction == "forward" and forward.share.value > 0.7
    assert turn.share.value > 0.3 and np.isnan(turn.drift.value)


def test_a_rate_exponent_tells_steps_from_seconds():
    def rows(power, survival=1.0):
        return [
            RatePoint(rate_hz=r, cycles_per_step=0.06, frequency_hz=3 * (r / 50) ** power,
                      survival=survival)
            for r in (25.0, 50.0, 100.0)
        ]  # fmt: skip

    assert rate_exponent(rows(1.0)) == pytest.approx(1.0)
    assert rate_exponent(rows(0.0)) == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(rate_exponent(rows(1.0, survival=0.0)))
