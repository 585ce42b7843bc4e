"""A robot's servos beside those of a training: what is outside, and by how much."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.policies.deploy.matches import servo_match
from pupper_sysid.policies.network.policy_file import trained_servo
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.draws import Differences
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_ranges
from support.tiny_training import CALIBRATION

HERE = servo_ranges(CALIBRATION)
TRAINED = trained_servo(CALIBRATION, "held", Walking(), HERE)


def with_joint(joint: int, **factors: float) -> ServoRanges:
    """The same servos, but for some numbers of one joint."""
    ends = {}
    for end in ("low", "value", "high"):
        own = {name: values.copy() for name, values in getattr(HERE, end).items()}
        for name, factor in factors.items():
            own[name][joint] *= factor
        ends[end] = own
    return replace(HERE, source="here.yaml", **ends)


def outside(here: ServoRanges, trained=TRAINED) -> dict[str, list]:
    found: dict[str, list] = {}
    for one in servo_match(trained, here).outside:
        found.setdefault(one.quantity, []).append(one)
    return found


def test_the_servos_of_the_training_are_within_its_ranges_though_files_round():
    match = servo_match(TRAINED, HERE)
    assert match.outside == () and match.compared == 12 * 8 + 1
    (said,) = match.sentences()
    assert "within the ranges that the policy was trained for (calibrated.yaml; 97" in said
    feedback = tuple(replace(f, quantum_rad=1.0001 * f.quantum_rad) for f in HERE.feedback)
    assert not outside(replace(HERE, feedback=feedback))


def test_a_later_servo_is_outside_by_the_time_beyond_the_longest_of_the_training():
    here = HERE.later(0.02)
    found = outside(here)
    assert list(found) == ["dead time"] and len(found["dead time"]) == 12
    one = found["dead time"][5]
    assert one.joint == "RF_calf" and one.trained_high == pytest.approx(
        1e3 * HERE.high["dead_time_s"][5]
    )
    assert one.beyond == pytest.approx(one.here.value - one.trained_high)
    assert one.here.value == pytest.approx(1e3 * HERE.value["dead_time_s"][5] + 20.0)
    (said,) = servo_match(TRAINED, here).sentences()
    assert said.startswith("Dead time (") and "ms more than in the training" in said
    assert "and 11 more joints differ" in said


def test_a_common_scale_of_all_torques_is_not_seen_and_a_stiffer_servo_is():
    torques = ("stiffness", "damping", "friction_loss", "effort_limit", "back_emf", "armature")
    assert not outside(with_joint(4, **dict.fromkeys(torques, 3.0)))
    stiffer = with_joint(4, stiffness=2.0, friction_loss=2.0)
    found = outside(stiffer)
    assert list(found) == ["stiffness per inertia"]
    (one,) = found["stiffness per inertia"]
    end = HERE.high["stiffness"][4] / HERE.low["armature"][4]
    assert one.trained_high == pytest.approx(end) and one.joint == JOINT_NAMES[4]
    factor = 2.0 * HERE.value["stiffness"][4] / HERE.value["armature"][4] / end
    (said,) = servo_match(TRAINED, stiffer).sentences()
    assert f" {factor:.2g} times the largest of the training (" in said


def test_what_the_training_drew_is_within():
    drained = {
        name: 0.9 for name in ("stiffness", "effort_limit", "velocity_limit", "friction_loss")
    }
    empty = with_joint(7, **drained)
    assert "stiffness per inertia" in outside(empty)
    task = Walking(differences=Differences(battery=(0.8, 1.1), command_jitter=(0.0, 9.0)))
    wide = trained_servo(CALIBRATION, "held", task, HERE)
    assert not outside(empty, wide)


def test_older_readings_and_more_jitter_are_outside():
    slow = tuple(replace(f, poll_period_s=3 * f.poll_period_s) for f in HERE.feedback)
    here = replace(HERE, feedback=slow, command_jitter_s=HERE.command_jitter_s + 0.01)
    found = outside(here)
    assert set(found) == {"mean age of readings", "command jitter"}
    age = found["mean age of readings"][3]
    assert age.here.value == pytest.approx(3e3 * HERE.feedback[3].mean_age_s)
    assert age.beyond == pytest.approx(2e3 * HERE.feedback[3].mean_age_s)
    assert found["command jitter"][0].joint is None
    assert found["command jitter"][0].beyond == pytest.approx(10.0)


def test_training_on_ideal_servos_is_told_by_how_much_the_robot_is_later():
    ideal = trained_servo("ideal", "ideal", Walking(), servo_ranges("ideal", "ideal"))
    found = outside(HERE, ideal)
    assert len(found["mean age of readings"]) == 12
    beyond = [one.beyond for one in found["dead time"]]
    np.testing.assert_allclose(beyond, 1e3 * HERE.value["dead_time_s"])
    # and a learned model has no numbers to compare
    learned = TRAINED.model_copy(update={"joints": None, "kind": "learned"})
    assert servo_match(learned, HERE) is None
