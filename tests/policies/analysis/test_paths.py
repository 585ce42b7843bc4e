"""Paths, terrain, pushes and rates: what the closed-loop analyses say of known motions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.policies.analysis.autonomy import (
    RatePoint,
    _pusher,
    _shift,
    push_response,
    rate_exponent,
    rate_response,
)
from pupper_sysid.policies.analysis.paths import _measured, compliance
from pupper_sysid.policies.analysis.robustness import terrain
from pupper_sysid.policies.walks.conditions import DIRECTIONS
from reproduction.evidence import scales
from support.walks import STEP, walked

ROOT = Path(__file__).resolve().parents[3]


def test_a_straight_walk_at_half_speed_has_half_the_share_and_neither_drift_nor_arc():
    found = _measured(walked((0.2, 0.0, 0.0), 0.1, 0.0, 0.0))
    assert found["share"].value == pytest.approx(0.5, rel=0.01)
    assert found["drift"].value == pytest.approx(0.0, abs=1e-9)
    assert found["arc_rad_m"].value == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(found["wander_m"].value)


def test_drift_is_to_the_left_of_the_command_and_an_arc_is_heading_per_metre():
    found = _measured(walked((-0.2, 0.0, 0.0), -0.2, 0.05, 0.0))
    # walking backward, the robot's left is to the right of where it goes
    assert found["drift"].value == pytest.approx(-0.25, rel=0.01)
    curved = _measured(walked((0.2, 0.0, 0.0), 0.2, 0.0, -0.06))
    assert curved["arc_rad_m"].value == pytest.approx(-0.3, rel=0.03)


def test_a_turn_on_the_spot_wanders_nowhere():
    found = _measured(walked((0.0, 0.0, -0.4), 0.0, 0.0, -0.3))
    assert found["share"].value == pytest.approx(0.75, rel=0.01)
    assert found["wander_m"].value == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(found["drift"].value)


def test_a_robot_that_fell_went_nowhere_and_says_nothing_of_drift():
    rollout = walked((0.2, 0.0, 0.0), 0.2, 0.0, -0.06, robots=2)
    rollout.alive[150:, 0] = False
    found = _measured(rollout)
    assert found["share"].value == pytest.approx(0.5, rel=0.01)
    assert found["arc_rad_m"].value == pytest.approx(-0.3, rel=0.03)
    rollout.alive[150:] = False
    nobody = _measured(rollout)
    assert nobody["share"].value == 0.0 and np.isnan(nobody["drift"].value)


def waves(hz: float, ahead: float, steps: int) -> np.ndarray:
    """Actions of a trot, `ahead` of the plain one by so many cycles."""
    phase = hz * STEP * np.arange(steps)[:, None] + ahead
    return np.sin(2 * np.pi * (phase + np.linspace(0, 0.5, 12)))[:, None, :].astype(np.float32)


@pytest.mark.parametrize("ahead", [-0.3, 0.0, 0.1, 0.45])
def test_the_shift_between_two_walks_is_that_of_their_phases(ahead):
    steps = round(10.0 / STEP)
    plain, pushed = (
        walked((0.1, 0, 0), 0.1, 0, 0, 10.0, 1, waves(3.1, a, steps)) for a in (0.0, ahead)
    )
    assert _shift(plain, pushed, 200, (1.0, 3.0), 0, 3.1) == pytest.approx(ahead, abs=0.01)


def test_the_last_push_of_a_slow_gait_is_judged_by_what_there_is():
    steps = round(10.0 / STEP)
    plain, pushed = (
        walked((0.1, 0, 0), 0.1, 0, 0, 10.0, 1, waves(0.6, a, steps)) for a in (0.0, 0.1)
    )
    # pushed after 5.5 s, its window would end after 10.5 s
    assert _shift(plain, pushed, 275, (3.0, 5.0), 0, 0.6) == pytest.approx(0.1, abs=0.05)


def test_a_push_changes_the_sideways_speed_at_its_step_only(walker):
    policy, trial = walker
    trial = replace(trial, seconds=2.0)
    plain, pushed = trial.walk(policy), trial.walk(policy, None, _pusher(60, 0.3))
    np.testing.assert_array_equal(plain.velocity[:60], pushed.velocity[:60])
    # a foot on the ground takes some of it within the step
    assert (pushed.velocity[60, :, 1] - plain.velocity[60, :, 1]).min() > 0.1


def test_a_push_shifts_the_phase_more_than_a_nudge(walker, monkeypatch):
    monkeypatch.setattr("pupper_sysid.policies.analysis.autonomy._PUSHES", 1)
    nudge, push = push_response(*walker)
    assert push.survival == 1.0 and nudge.shift_early < push.shift_early
    assert len(push.shifts) == len(push.phases) == 2


def test_it_is_asked_at_other_rates_with_other_scales_and_on_other_ground(walker, monkeypatch):
    policy, trial = walker
    monkeypatch.setattr("pupper_sysid.policies.analysis.autonomy.RATES_HZ", (50.0, 71.43))
    usual, faster = rate_response(policy, trial)
    assert usual.survival == 1 and usual.frequency_hz == pytest.approx(3.6, abs=0.15)
    assert faster.rate_hz == pytest.approx(71.43, abs=0.01)
    assert usual.cycles_per_step == pytest.approx(usual.frequency_hz / 50)
    short = replace(trial, seconds=1.5)
    assert [r.scale_rad for r in scales(policy, short)] == [0.45, 0.5, 0.6, 0.75]
    rows = {r.ground: r.survival for r in terrain(policy, short)}
    assert set(rows) >= {"flat", "rough", "slopes", "troughs", "steps"} and rows["flat"] == 1.0


def test_it_goes_where_it_is_told(walker, monkeypatch):
    policy, trial = walker
    some = {k: DIRECTIONS[k] for k in ("forward", "turn left", "stand")}
    monkeypatch.setattr("pupper_sysid.policies.analysis.paths.DIRECTIONS", some)
    forward, turn = compliance(policy, trial)
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
