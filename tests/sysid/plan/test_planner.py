"""Plans of the next sweep: within the limits, better than a repetition, honest if nothing helps."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.common.interval import Interval
from pupper_sysid.data import SAMPLES
from pupper_sysid.servo_models.calibration.calibration import InputFile, load_calibration
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.sysid.fit.posterior import PHASE_SD_S
from pupper_sysid.sysid.fit.structure import candidate
from pupper_sysid.sysid.plan.planner import (
    CLEAR_NATS,
    LEAST_HALF_WIDTH_S,
    Hypothesis,
    Noise,
    Servo,
    Setup,
    fitted_noise,
    now,
    prior_information,
    propose,
    respond,
    trial_seconds,
    without_shift,
)
from pupper_sysid.sysid.plan.proposal import (
    calibrated_servo,
    feedback_setup,
    fitted_servo,
    plan_from_calibration,
    unknown_servos,
)
from pupper_sysid.sysid.sweep.excitation import plan
from support.planned_servos import (
    NOISE,
    fit_of_half_width,
    hypothesis,
    recorded_servo,
    tones,
    with_readings,
)

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


def test_what_cannot_be_seen_or_narrowed_within_the_limits_is_named():
    still = replace(recorded_servo(tones((1.0, 2.0), 0.03)), noise=Noise(0.03, 0.0))
    setup = Setup(margin_rad=0.03, quantum_rad=0.005)
    notes = propose("LF_hip", [still], setup, 7.0).notes
    assert any("speed limit cannot be seen at any amplitude" in n for n in notes)
    known = recorded_servo(tones())
    made = propose("LF_hip", [known], Setup(), 60.0)
    assert not any("cannot be seen" in n for n in made.notes)
    used = [(t.kind, t.frequency_hz) for t in made.trials]
    assert max(used.count(tone) for tone in used) <= 2, "no plan rests on one tone"
    # a dead time at the model's time step is left alone
    (one,) = known.hypotheses
    sure = replace(known, hypotheses=(replace(one, known=1e8 * np.eye(len(one.known))),))
    notes = propose("LF_hip", [sure], Setup(), SECONDS).notes
    assert any("no trial within the limits narrows the dead time" in n for n in notes)


# ----- information of simulated trials, against formulas


def test_a_delay_is_as_uncertain_as_the_bound_of_a_tone_says():
    """sd(τ) = sqrt(2 / N) s / (A 2π f), the Cramér-Rao bound of a tone's time shift."""
    model, delay, floor = candidate("pure_delay"), 0.025, 0.01
    (trial,) = tones((2.0,), loop_period_s=0.002)  # else a delay shifts stairs, not a tone
    found = respond(
        Hypothesis(model, np.array([delay, 1.0, 0.0]), prior_information(model)), trial,
        Noise(floor, 0.0),
    )  # fmt: skip
    bound = np.sqrt(2 / len(trial.sample_step)) * floor / (0.3 * 2 * np.pi * 2.0)
    # about the logarithm of the delay; the rest at the head and the rise say nothing
    sd = delay / np.sqrt(found.information[0, 0])
    assert sd == pytest.approx(bound, rel=0.1)


def test_however_long_a_tone_is_its_own_shift_in_time_stays_in_doubt():
    own = hypothesis()
    information = respond(own, tones((3.0,))[0], NOISE).information
    for repeats in (1e3, 1e6):
        left = without_shift(repeats * information)
        assert own.values[0] / np.sqrt(left[0, 0]) == pytest.approx(PHASE_SD_S, rel=0.01)


def test_noise_of_a_fit_is_told_apart_into_floor_and_jitter_and_not_below_the_quantisation():
    own, rng, truth = hypothesis(), np.random.default_rng(5), Noise(0.003, 0.003)
    trials = [with_readings(own, t, truth, rng) for t in tones() for _ in range(4)]
    found = fitted_noise(own.model, own.values, trials, 1e-4)
    assert found.floor_rad == pytest.approx(truth.floor_rad, rel=0.15)
    assert found.jitter_s == pytest.approx(truth.jitter_s, rel=0.15)
    exact = [with_readings(own, t, Noise(1e-9, 0.0), rng) for t in tones()]
    assert fitted_noise(own.model, own.values, exact, 0.0017).floor_rad == 0.0017


# ----- what a plan knows of a servo: the fit's own intervals, a calibration's, or the prior

SAMPLE = SAMPLES / "calibrated.yaml"


def test_a_plan_starts_from_the_interval_that_the_fit_reports_or_from_the_usual_uncertainty():
    for half_width_ms in (2.0, 6.0):
        interval = now(fitted_servo(fit_of_half_width("LF_hip", half_width_ms)))
        expected = pytest.approx(1e-3 * half_width_ms, rel=0.02)
        assert (interval.high - interval.low) / 2 == expected
    servo = calibrated_servo(load_calibration("paper").joint("LF_hip"))
    assert [h.model.name for h in servo.hypotheses] == ["delayed_pd"]
    interval = now(servo)
    assert interval.high - interval.low > 0.01


def test_a_doubt_about_the_dates_of_all_readings_stays():
    fit = fit_of_half_width("LF_hip", 3.0)
    doubted = replace(fitted_servo(fit), doubt_s=0.009)
    plan = propose("LF_hip", [doubted], Setup(), 20.0)
    (dead, *_) = plan.predictions
    assert (dead.after.high - dead.after.low) / 2 > 0.009
    assert any("in doubt by ± 9.0 ms" in note for note in plan.notes)
    # and live readings are planned as live
    setup = feedback_setup(fit.lag, Setup())
    assert setup.poll_period_s == 0.0 and setup.seen == 1.0


def test_a_calibration_is_planned_from_its_intervals():
    calibration = load_calibration(SAMPLE)
    joint = calibration.joint("LF_hip")
    for half in (0.003, 0.006):
        own = joint.actuator.dead_time_s.value
        wide = Quantity(value=own, low=own - half, high=own + half, identified="yes")
        actuator = joint.actuator.model_copy(update={"dead_time_s": wide})
        servo = calibrated_servo(joint.model_copy(update={"actuator": actuator}))
        interval = now(replace(servo, hypotheses=servo.hypotheses[:1], nats=(0.0,)))
        # the prior adds a little to what the interval says
        assert (interval.high - interval.low) / 2 == pytest.approx(half, rel=0.05)
    plan = plan_from_calibration(calibration, InputFile(name="c.yaml", sha256="0" * 64), ["LF_hip"])
    assert plan.joints == ["LF_hip"] and plan.predictions


def test_unknown_servos_move_and_depend_on_the_seed_alone():
    servos, again, other = unknown_servos(0), unknown_servos(0), unknown_servos(1)
    values = [[s.hypotheses[0].values for s in drawn] for drawn in (servos, again, other)]
    assert np.array_equal(values[0], values[1]) and not np.array_equal(values[0], values[2])
    for servo in servos:
        slew, back_emf = servo.hypotheses
        assert slew.values[3] < slew.values[4]  # friction below effort
        assert np.array_equal(slew.values[:5], back_emf.values[:5])
