"""A file of this project that is of another kind is called what it is, with what reads it."""

import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.data import SAMPLES
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.servo_models.servo_file import load_servo_model
from pupper_sysid.sysid.plan.plan_file import load_plan
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.importers.recognise import logs_in
from support.package import ROOT

FILES = {
    "a recording": SAMPLES / "sweep.csv",
    "the truth of an emulated recording": SAMPLES / "sweep.truth.yaml",
    "a calibration": SAMPLES / "calibrated.yaml",
    "a servo card": ROOT / "servo_models/cards/data/sts3215-12v.yaml",
    "a policy": SAMPLES / "policies/lstm",
    "a training run": SAMPLES / "policies/lstm/run.yaml",
}
READERS = {
    "a recording": load, "a calibration": load_calibration, "a servo card": load_card,
    "a plan": load_plan, "a fitted servo model": load_servo_model,
}  # fmt: skip


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("wanted", READERS)
def test_a_file_of_another_kind_is_named_with_what_reads_it(kind, wanted):
    if kind == wanted or (kind, wanted) == ("a servo card", "a calibration"):
        return  # which a card stands for
    if wanted == "a fitted servo model" and FILES[kind].is_file():
        return  # which is a folder
    with pytest.raises(InputError, match=rf"is {kind}, not {wanted}: `pupper-[a-z]+"):
        READERS[wanted](FILES[kind])


def test_folders_are_looked_into(tmp_path):
    with pytest.raises(InputError, match="is a policy, not a recording: `pupper-eval`"):
        logs_in(FILES["a policy"])
    (tmp_path / "run.yaml").write_text("schema: pupper-run\nschema_version: 2\n")
    with pytest.raises(InputError, match="is a training run, not a policy"):
        load_policy(tmp_path)


def test_what_is_not_of_this_project_is_left_to_its_reader(tmp_path):
    (tmp_path / "cal.yaml").write_text("schema: other\n")
    with pytest.raises(InputError, match="is not a calibration: it does not say"):
        load_calibration(tmp_path / "cal.yaml")
