"""The servos of a training in the policy's file: whole, exact, and refused where they are wrong."""

import json
import time
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.policies.network.policy_file import CONTRACT, VERSION, load_policy, trained_servo
from pupper_sysid.sim.walking.config import Randomisation, Walking
from pupper_sysid.sim.walking.draws import Differences
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.refusals import assert_each_refused
from support.tiny_training import CALIBRATION

SERVOS = servo_ranges(CALIBRATION)


@pytest.fixture
def folder(copied) -> Path:
    return copied("mlp")


def test_every_number_of_the_servos_is_read_back_to_the_last_bit(folder):
    contract = load_policy(folder).contract
    own = contract.servo
    assert own is not None and own.joints is not None and own.kind == "calibration"
    assert own.actuator == contract.actuator == "calibrated.yaml"
    assert own.actuator_sha256 == sha256(Path(CALIBRATION))
    assert list(own.joints) == list(JOINT_NAMES)
    for i, name in enumerate(JOINT_NAMES):
        joint = own.joints[name]
        for field in SERVOS.value:
            for end in ("low", "value", "high"):
                assert getattr(getattr(joint, field), end) == getattr(SERVOS, end)[field][i]
        for field in ("poll_period_s", "loss", "quantum_rad", "offset_rad"):
            assert getattr(joint.feedback, field) == getattr(SERVOS.feedback[i], field)
    assert own.command_jitter_s.value == SERVOS.command_jitter_s
    assert list(own.dead_times_s) == contract.dead_time_s


def test_what_a_training_draws_widens_the_ranges():
    task = Walking(
        randomisation=Randomisation(torque_scale=(0.5, 1.5)),
        differences=Differences(battery=(0.86, 1.1), poll_period=(0.9, 1.2), command_jitter=(0, 2)),
    )
    own = trained_servo(CALIBRATION, "held", task, replace(SERVOS, command_jitter_s=0.004))

    def ends(range_):
        return range_.low, range_.value, range_.high

    assert ends(own.torque_scale) == (0.5, 1.0, 1.5)
    assert ends(own.voltage_scale) == (0.86, 1.0, 1.1)
    assert ends(own.poll_scale) == (0.9, 1.0, 1.2)
    assert ends(own.command_jitter_s) == (0, 0.004, 0.008)


def test_servos_without_a_file_have_a_name_and_a_learned_model_its_weights_and_no_numbers(tmp_path):
    for name, kind in (("ideal", "ideal"), ("paper", "calibration")):
        own = trained_servo(name, "ideal", Walking(), servo_ranges(name, "ideal"))
        assert (own.actuator, own.actuator_sha256, own.kind) == (name, None, kind)
        assert own.joints is not None and own.joints["LF_hip"].feedback.poll_period_s == 0
    (tmp_path / "weights.safetensors").write_bytes(b"weights")
    own = trained_servo(str(tmp_path), "held", Walking(), servo_ranges("ideal"))
    assert own.kind == "learned" and own.joints is None and own.dead_times_s is None
    assert own.actuator == tmp_path.name
    assert own.actuator_sha256 == sha256(tmp_path / "weights.safetensors")


def test_an_absent_servo_is_no_evidence_and_older_files_are_read(folder):
    path = folder / CONTRACT
    for version, servo in ((3, None), (2, ...), (1, ...)):
        whole = json.loads(path.read_text())
        whole["schema_version"] = version
        if servo is ...:
            whole.pop("servo", None)
        else:
            whole["servo"] = servo
        if version == 1:
            whole["delay_s"] = whole.pop("dead_time_s")
        path.write_text(json.dumps(whole))
        contract = load_policy(folder).contract
        assert contract.servo is None and contract.schema_version == VERSION


def first(servo):
    return servo["joints"]["LF_hip"]


def with_order_reversed(servo):
    servo["joints"] = dict(reversed(servo["joints"].items()))


def with_another_joint(servo):
    servo["joints"]["tail"] = deepcopy(first(servo))


WRONG = {
    "a newer version": lambda s: s.update(schema_version=2),
    "a missing joint": lambda s: s["joints"].pop("RB_calf"),
    "another joint": with_another_joint,
    "joints in another order": with_order_reversed,
    "joints of a learned model": lambda s: s.update(kind="learned"),
    "NaN": lambda s: first(s)["stiffness"].update(value=float("nan")),
    "a huge number": lambda s: first(s)["effort_limit"].update(high=1e300),
    "a negative number": lambda s: first(s)["friction_loss"].update(low=-1.0),
    "a dead time of a minute": lambda s: first(s)["dead_time_s"].update(high=60.0),
    "a dead time other than the contract's": lambda s: [
        j["dead_time_s"].update(high=1.0) for j in s["joints"].values()
    ],
    "a loss of one": lambda s: first(s)["feedback"].update(loss=1.0),
    "an offset of many turns": lambda s: first(s)["feedback"].update(offset_rad=1e6),
    "another actuator": lambda s: s.update(actuator="another.yaml"),
    "a name of a million letters": lambda s: s.update(actuator="x" * 10**6),
    "another hash": lambda s: s.update(actuator_sha256="0" * 64),
    "no hash": lambda s: s.update(actuator_sha256=None),
}


def test_a_servo_that_is_present_and_wrong_is_refused_at_once(folder):
    path = folder / CONTRACT
    good = path.read_text()

    def load(servo):
        whole = json.loads(good)
        if isinstance(servo, str) and servo in WRONG:
            WRONG[servo](whole["servo"])
        else:
            whole["servo"] = servo
        path.write_text(json.dumps(whole))
        began = time.process_time()
        try:
            load_policy(folder)
        except InputError as refused:
            assert len(str(refused)) < 1000
            raise
        finally:
            assert time.process_time() - began < 2.0

    no_objects = (5, "servo", [], True, {}, [[[[]]]])
    assert_each_refused([(w, "") for w in (*WRONG, *no_objects)], load, names=folder)
    assert_each_refused([("a newer version", "Upgrade pupper-sysid")], load, names="servo")
