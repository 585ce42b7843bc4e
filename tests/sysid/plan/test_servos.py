"""What a plan knows of a servo: the fit's own intervals, a calibration's, or the prior."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.sysid.plan.candidates import Setup
from pupper_sysid.sysid.plan.planner import now, propose
from pupper_sysid.sysid.plan.proposal import (
    Source,
    calibrated_servo,
    feedback_setup,
    fitted_servo,
    plan_first_sweep,
    plan_from_calibration,
    unknown_servos,
)
from support.package import ROOT
from support.planned_servos import fit_of_half_width

SAMPLE = ROOT / "data/samples/calibrated.yaml"


@pytest.mark.parametrize("half_width_ms", [2.0, 6.0])
def test_a_plan_starts_from_the_interval_that_the_fit_reports(half_width_ms):
    fit = fit_of_half_width("LF_hip", half_width_ms)
    interval = now(fitted_servo(fit))
    assert (interval.high - interval.low) / 2 == pytest.approx(1e-3 * half_width_ms, rel=0.02)


def test_a_doubt_about_the_dates_of_all_readings_stays():
    fit = fit_of_half_width("LF_hip", 3.0)
    doubted = replace(fitted_servo(fit), doubt_s=0.009)
    plan = propose("LF_hip", [doubted], Setup(), 20.0)
    (dead, *_) = plan.predictions
    assert (dead.after.high - dead.after.low) / 2 > 0.009
    assert any("in doubt by ± 9.0 ms" in note for note in plan.notes)


def test_live_readings_are_planned_as_live():
    setup = feedback_setup(fit_of_half_width("LF_hip", 3.0).lag, Setup())
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
    plan = plan_from_calibration(calibration, Source(name="c.yaml", sha256="0" * 64), ["LF_hip"])
    assert plan.joints == ["LF_hip"] and plan.predictions


def test_a_preset_is_planned_as_a_servo_of_the_usual_uncertainty():
    servo = calibrated_servo(load_calibration("paper").joint("LF_hip"))
    assert [h.model.name for h in servo.hypotheses] == ["delayed_pd"]
    interval = now(servo)
    assert interval.high - interval.low > 0.01


def test_unknown_servos_move_and_depend_on_the_seed_alone():
    servos, again, other = unknown_servos(0), unknown_servos(0), unknown_servos(1)
    values = [[s.hypotheses[0].values for s in drawn] for drawn in (servos, again, other)]
    assert np.array_equal(values[0], values[1]) and not np.array_equal(values[0], values[2])
    for servo in servos:
        slew, back_emf = servo.hypotheses
        assert slew.values[3] < slew.values[4]  # friction below effort
        assert np.array_equal(slew.values[:5], back_emf.values[:5])


def test_joints_with_the_same_margin_get_the_same_first_sweep():
    margins = {"LF_hip": 0.5, "RF_hip": 0.4, "LF_calf": 0.1}
    plan = plan_first_sweep(list(margins), setup=Setup(), margins=margins, seconds=10.0)
    tones = {
        joint: [(t.kind, t.frequency_hz, t.amplitude_rad) for t in plan.trials if t.joint == joint]
        for joint in margins
    }
    assert tones["LF_hip"] == tones["RF_hip"] != tones["LF_calf"]
    assert max(amplitude for *_, amplitude in tones["LF_calf"]) <= 0.1
