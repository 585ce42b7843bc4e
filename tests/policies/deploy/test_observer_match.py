"""The check before deployment: it measures what theory says, and names what does not fit."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.policies.deploy.matches import FREQUENCIES_HZ, Match, compare
from pupper_sysid.policies.deploy.stacks import HeldEncoder, SyntheticPD, Zero
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from support.observer_response import response

P = 0.02
LINEAR = DelayedPDParameters(
    stiffness=10.0, damping=0.15, friction_loss=0.0, armature=8e-4, effort_limit=np.inf,
    velocity_limit=np.inf, dead_time_s=0.024,
)  # fmt: skip
TRAINED = replace(LINEAR, friction_loss=0.0167, effort_limit=0.35, velocity_limit=7.6)


def theory(servo: DelayedPDParameters, frequency_hz: np.ndarray, period_s: float) -> np.ndarray:
    """Second order with dead time behind a hold, as it is seen once per period.

    A held sine contains images one control rate apart, and sampling folds them back.
    """
    k, d, inertia = (float(np.asarray(x)) for x in (servo.stiffness, servo.damping, servo.armature))
    s = 2j * np.pi * (np.asarray(frequency_hz) + np.arange(-100, 101)[:, None] / period_s)
    hold = (1 - np.exp(-s * period_s)) / (s * period_s)
    motion = k / (inertia * s**2 + d * s + k)
    return (hold * np.exp(-s * float(np.asarray(servo.dead_time_s))) * motion).sum(axis=0)


# ---------------------------------------------------------------------------------- response


def test_response_of_a_linear_servo_is_its_transfer_function():
    frequencies = np.array([0.7, 1.0, 2.3, 4.0, 6.0])
    for period_s in (0.02, 0.04):
        observer = SyntheticPD(LINEAR, period_s, substeps=50)
        swing = response(observer, frequencies, 0.1, period_s)
        assert swing.shape == (5, 12)
        expected = theory(LINEAR, frequencies, period_s)
        assert np.abs(swing - expected[:, None]).max() < 0.01


# ---------------------------------------------------------------------------------- match


def test_an_observer_with_the_trained_parameters_fits_exactly_as_do_readings_of_the_actuator():
    for observer, period_s in (
        (SyntheticPD(TRAINED, 0.02), 0.02), (SyntheticPD(TRAINED, 0.04), 0.04),
        (HeldEncoder(P, 4), P),
    ):  # fmt: skip
        match = compare(observer, TRAINED, period_s)
        assert match.fits and match.worst_gain_ratio == pytest.approx(1)
        assert match.worst_phase_difference_deg == pytest.approx(0, abs=1e-9)
        assert "from 0.5 to 6 Hz: gain ratio 1.00" in match.sentence()


def test_the_papers_observer_does_not_fit_and_the_sentence_names_its_resonance():
    match = compare(SyntheticPD.paper(P), TRAINED, P)
    assert not match.fits
    i, _ = np.unravel_index(np.argmax(match.gain_ratio), match.gain_ratio.shape)
    # natural frequency of 70 N·m/rad on 0.20 kg·m²
    assert match.frequencies_hz[i] == pytest.approx(np.sqrt(70 / 0.20) / (2 * np.pi), abs=0.15)
    assert match.sentence().startswith("The observer swings 3.")
    assert f"times as far as commanded at {match.frequencies_hz[i]:.1f} Hz" in match.sentence()
    assert "(all joints)" in match.sentence()
    assert "resonance" in match.sentence()


def late(seconds: float | np.ndarray) -> DelayedPDParameters:
    """The servo of the training with a dead time that is longer by `seconds`."""
    return replace(TRAINED, dead_time_s=0.024 + seconds)


def test_what_does_not_fit_is_named_by_its_time_or_its_swing_and_the_joint():
    early = np.where(np.arange(12) == 7, -0.024, 0.0)
    for observer, robot, gain, phase_deg, words in (
        # 360° x 6 Hz x 0.2 s, beyond a whole turn
        (SyntheticPD(late(0.2), P), TRAINED, 1, -432, "200 ms later than the trained actuator at"),
        (SyntheticPD(late(early), P), TRAINED, None, 360 * 6 * 0.024, "24 ms earlier"),
        (SyntheticPD(late(early), P), TRAINED, None, None, "LB_thigh"),
        (Zero(P), TRAINED, 0, None, "swings 0.0 times"),
        (Zero(P), TRAINED, 0, None, "not see"),
        # readings are those of the robot, not of the training
        (HeldEncoder(P, 4), late(2 * P), 1, None, "40 ms later"),
    ):
        match = compare(observer, TRAINED, P, robot)
        assert not match.fits and words in match.sentence()
        if gain is not None:
            assert match.worst_gain_ratio == pytest.approx(gain, abs=1e-3)
        if phase_deg is not None:
            assert match.worst_phase_difference_deg == pytest.approx(phase_deg, abs=0.5)
    # twenty degrees at six hertz are the border
    for shift_s, fits in ((0.008, True), (0.011, False)):
        assert compare(SyntheticPD(late(shift_s), P), TRAINED, P).fits is fits


def test_table_has_a_row_for_every_kind_of_joint_and_frequency():
    rows = compare(SyntheticPD(LINEAR, P, substeps=20), LINEAR, P).table()
    assert len(rows) == 3 * len(FREQUENCIES_HZ)
    assert [r["joints"] for r in rows[:: len(FREQUENCIES_HZ)]] == ["hip", "thigh", "calf"]
    last = rows[len(FREQUENCIES_HZ) - 1]
    expected = theory(LINEAR, np.array([6.0]), P)[0]
    assert last["frequency_hz"] == 6.0
    assert last["observer_gain"] == pytest.approx(abs(expected), abs=0.01)
    assert last["actuator_gain"] == pytest.approx(abs(expected), abs=0.03)
    assert last["observer_phase_deg"] == pytest.approx(np.degrees(np.angle(expected)), abs=1)


def test_the_table_of_another_robot_has_each_joint_by_its_own_name():
    own, two = np.ones((1, 2), complex), np.array([[1.0, 3.0]], complex)
    match = Match(np.array([1.0]), two, own, ("0", "10"))  # one name ends as the other
    assert [(row["joints"], row["observer_gain"]) for row in match.table()] == [
        ("0", 1.0), ("10", 3.0),
    ]  # fmt: skip
