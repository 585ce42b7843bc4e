"""Plans of the next sweep: within the limits, better than a repetition, honest if nothing helps."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.plan.candidates import Setup, candidates, recorded, trial_seconds
from pupper_sysid.sysid.plan.planner import (
    CLEAR_NATS,
    LEAST_HALF_WIDTH_S,
    Noise,
    Servo,
    now,
    propose,
)
from pupper_sysid.sysid.sweep.excitation import plan
from support.planned_servos import NOISE, recorded_servo, tones

SECONDS = 20.8
"""Of the standard sweep in `tones`."""


def beyond_the_time_step(interval: Interval) -> float:
    """Half width without the part that no reading reduces."""
    return np.sqrt(((interval.high - interval.low) / 2) ** 2 - LEAST_HALF_WIDTH_S**2)


def later_rival(servo: Servo) -> Servo:
    """The servo with a second hypothesis whose dead time is 10 ms longer."""
    first, second = servo.hypotheses
    values = second.values.copy()
    values[0] += 0.010
    return replace(servo, hypotheses=(first, replace(second, values=values)))


def test_a_planned_sweep_narrows_the_dead_time_more_than_twice_as_much_as_a_repetition():
    first, twice = recorded_servo(tones()), recorded_servo(tones() + tones())
    (dead, *_) = propose("LF_hip", [first], Setup(), SECONDS).predictions
    before, after = beyond_the_time_step(dead.now), beyond_the_time_step(dead.after)
    repeated = beyond_the_time_step(now(twice))
    assert before == pytest.approx(beyond_the_time_step(now(first)))
    assert after < repeated < before
    assert before - after > 2 * (before - repeated)


def test_a_plan_keeps_to_its_seconds_margin_and_speed():
    setup = Setup(margin_rad=0.15, loop_period_s=0.02)
    made = propose("LF_hip", [recorded_servo(tones())], setup, SECONDS)
    seconds = sum(trial_seconds(t.duration_s) for t in made.trials)
    assert seconds == pytest.approx(SECONDS, abs=0.01)
    for t in made.trials:
        assert t.amplitude_rad <= 0.15
        if t.kind == "sine":
            assert 2 * np.pi * t.frequency_hz * t.amplitude_rad < 0.9 * 7.5
            assert t.frequency_hz <= 12.5  # four commands a period
        # the recorder would change nothing
        same = plan(t.kind, [t.joint], [t.frequency_hz], t.amplitude_rad, t.duration_s, 0.02)
        assert same.warnings == ()


def test_a_plan_asks_for_no_tone_that_the_servo_cannot_follow():
    weak = recorded_servo(tones())
    values = weak.hypotheses[0].values.copy()
    values[3], values[4] = 30.0, 100.0  # friction, effort: 0.05 rad at 10 Hz take 200 rad/s²
    weak = replace(weak, hypotheses=(replace(weak.hypotheses[0], values=values),))
    strong = propose("LF_hip", [recorded_servo(tones())], Setup(), SECONDS)
    made = propose("LF_hip", [weak], Setup(), SECONDS)
    fastest = [max(t.frequency_hz for t in p.trials if t.kind == "sine") for p in (made, strong)]
    assert fastest[0] < fastest[1]


def test_no_plan_rests_on_one_tone():
    made = propose("LF_hip", [recorded_servo(tones())], Setup(), 60.0)
    used = [(t.kind, t.frequency_hz) for t in made.trials]
    assert max(used.count(tone) for tone in used) <= 2


def test_models_that_explain_a_sweep_alike_are_told_apart():
    slow = tones((1.0, 2.0), 0.1)
    servo = later_rival(recorded_servo(slow, structures=2))
    made = propose("LF_hip", [servo], Setup(), SECONDS)
    assert "structure" in {t.purpose for t in made.trials}
    assert not any(f"{CLEAR_NATS:g} would tell" in note for note in made.notes)
    (dead, *_) = made.predictions
    assert dead.after.high - dead.after.low < dead.now.high - dead.now.low


def test_a_rival_that_is_ruled_out_already_widens_nothing():
    both = later_rival(recorded_servo(tones(), structures=2))
    hull, clear = now(both), now(replace(both, nats=(0.0, 1.01 * CLEAR_NATS)))
    alone = now(recorded_servo(tones()))
    assert hull.high > 0.035 > alone.high
    assert clear == alone


def test_what_cannot_be_seen_within_the_limits_is_named():
    still = replace(recorded_servo(tones((1.0, 2.0), 0.03)), noise=Noise(0.03, 0.0))
    setup = Setup(margin_rad=0.03, quantum_rad=0.005)
    notes = propose("LF_hip", [still], setup, 7.0).notes
    assert any("speed limit cannot be seen at any amplitude" in n for n in notes)
    free = propose("LF_hip", [recorded_servo(tones())], Setup(), SECONDS).notes
    assert not any("cannot be seen" in n for n in free)


def test_a_dead_time_at_the_models_time_step_is_left_alone():
    known = recorded_servo(tones())
    (one,) = known.hypotheses
    sure = replace(known, hypotheses=(replace(one, known=1e8 * np.eye(len(one.known))),))
    notes = propose("LF_hip", [sure], Setup(), SECONDS).notes
    assert any("no trial within the limits narrows the dead time" in n for n in notes)


def test_candidates_are_sent_as_the_guard_lets_them_through():
    """A square wave of 0.3 rad is slowed to 8 rad/s, one of 0.05 rad steps at once."""
    setup = Setup(loop_period_s=0.01)
    for amplitude, fastest in ((0.3, 8.0), (0.03, 6.0)):
        made = plan("square", ["LF_hip"], [1.0], amplitude, 3.0, 0.01)
        command = recorded(made.trials[0], setup).command
        per_tick = np.abs(command[5:] - command[:-5]).max() / 0.01
        assert per_tick == pytest.approx(fastest, rel=0.02)


def test_live_readings_come_with_every_tick_and_polled_ones_with_every_poll():
    live = candidates(Setup(loop_period_s=0.02, poll_period_s=0.0, loss=0.0), 3.0)[0]
    polled = candidates(Setup(loop_period_s=0.02, poll_period_s=0.04), 3.0)[0]
    assert len(live.run.sample_step) == pytest.approx(160, abs=1)
    assert len(polled.run.sample_step) == pytest.approx(80, abs=1)
    assert Setup(loop_period_s=0.02, poll_period_s=0.04, loss=0.4).seen == pytest.approx(0.6)
    # two polls between two reads: one of them succeeds
    assert Setup(loop_period_s=0.02, poll_period_s=0.01, loss=0.5).seen == pytest.approx(0.75)
    assert NOISE.floor_rad > 0
