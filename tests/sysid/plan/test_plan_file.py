"""The plan file: read back as written, refused in a sentence, executed within the bus's limits."""

from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.plan.plan_file import executable, load_plan, save_plan
from pupper_sysid.sysid.plan.planner import PlannedTrial, Prediction
from pupper_sysid.sysid.plan.proposal import Source, SweepPlan
from support.refusals import assert_each_refused

POSE = {"LF_hip": 0.1, "LF_thigh": 0.785}


def trial(joint: str, frequency_hz: float, amplitude_rad: float, kind: str = "sine"):
    return PlannedTrial(
        joint=joint, kind=kind, frequency_hz=frequency_hz, amplitude_rad=amplitude_rad,
        duration_s=3.0, purpose="dead time",
    )  # fmt: skip


PROPOSAL = SweepPlan(
    made_from=(Source(name="sweep.csv", sha256="0" * 64),),
    seed=3,
    loop_period_s=0.019,
    poll_rate_hz=37.2,
    speed_limit_rad_s=7.5,
    trials=(
        trial("LF_hip", 7.0, 0.12), trial("LF_hip", 0.7, 0.2, "square"),
        trial("LF_thigh", 8.0, 0.13),
    ),
    predictions=(
        Prediction(
            joint="LF_hip", quantity="dead_time_s", now=Interval(0.02, 0.01, 0.03),
            after=Interval(0.02, 0.018, 0.022),
        ),
    ),
    notes=("LF_hip: friction cannot be seen at any amplitude within the limits.",),
)  # fmt: skip


@pytest.fixture
def path(tmp_path) -> Path:
    save_plan(PROPOSAL, tmp_path / "plan.yaml")
    return tmp_path / "plan.yaml"


def test_a_plan_is_read_back_as_it_was_written_and_not_written_over_another_file(path):
    assert load_plan(path) == PROPOSAL
    before = path.read_bytes()
    with pytest.raises(InputError, match="exists already"):
        save_plan(PROPOSAL, path)
    assert path.read_bytes() == before


def test_what_is_wrong_in_a_plan_is_named(path):
    text = path.read_text()
    trials = text[text.index("trials:\n") : text.index("predictions:")]
    cases = [
        (("schema: pupper-sysid plan", "schema: other"), "is not a plan"),
        (("schema_version: 1", "schema_version: 2"), "newer"),
        (("joint: LF_thigh", "joint: LF_tigh"), "is no joint"),
        (("kind: square", "kind: saw"), "Write 'sine' or 'square'"),
        (("frequency_hz: 7.0", "frequency_hz: -7.0"), "frequency_hz"),
        (("frequency_hz: 7.0", "frequency_hz: 700.0"), "frequency_hz"),
        (("amplitude_rad: 0.12", "amplitude_rad: 12"), "amplitude_rad"),
        (("amplitude_rad: 0.12", "amplitude_rad: .nan"), "amplitude_rad"),
        (("amplitude_rad: 0.12", "amplitude_deg: 7"), "amplitude_rad"),
        (("duration_s: 3.0", "duration_s: 1e9"), "duration_s"),
        (("loop_period_s: 0.019", "loop_period_s: 0"), "loop_period_s"),
        (("seed: 3", "seed: 3\nmore: 4"), "is not a key of this file"),
        (("0" * 64, "0" * 63), "sha256"), ((trials, "trials: []\n"), "trials"),
    ]  # fmt: skip

    def read(change):
        assert change[0] in text
        path.write_text(text.replace(*change, 1))
        load_plan(path)

    assert_each_refused(cases, read, names=path)


def test_a_plan_is_executed_trial_by_trial_from_the_start_pose(path):
    margin = {"LF_hip": 0.4, "LF_thigh": 0.4}
    made = executable(load_plan(path), path, ["LF_hip", "LF_thigh"], margin, POSE, 7.5)
    assert [t.joints for t in made.trials] == [("LF_hip",), ("LF_hip",), ("LF_thigh",)]
    assert made.trials[0].frequency_hz == 7.0 and np.isnan(made.trials[1].frequency_hz)
    assert made.start_pose_rad == POSE and made.warnings == ()
    time = np.arange(0.0, 3.2, 0.001)
    assert np.abs(made.trials[2].offset(time)).max() == pytest.approx(0.13, rel=1e-3)
    some = executable(load_plan(path), path, ["LF_thigh"], margin, POSE, 7.5)
    assert [t.joints for t in some.trials] == [("LF_thigh",)]
    described = made.description
    assert described["file"] == "plan.yaml" and len(described["sha256"]) == 64
    assert described["made_from"] == [{"name": "sweep.csv", "sha256": "0" * 64}]


def test_a_plan_is_reduced_to_the_limits_of_the_bus_that_executes_it(path):
    margin = {"LF_hip": 0.1, "LF_thigh": 0.4}
    made = executable(load_plan(path), path, ["LF_hip", "LF_thigh"], margin, POSE, 5.0)
    time = np.arange(0.0, 3.2, 0.001)
    assert np.abs(made.trials[0].offset(time)).max() <= 0.1
    # 0.13 rad at 8 Hz would be 6.5 rad/s
    assert np.abs(made.trials[2].offset(time)).max() * 2 * np.pi * 8.0 < 0.91 * 5.0
    assert any(w.startswith("LF_hip: amplitude reduced") for w in made.warnings)
    assert any(w.startswith("LF_thigh: 8 Hz: amplitude reduced") for w in made.warnings)
