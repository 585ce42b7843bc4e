"""The plan file: read back as written, refused in a sentence, executed within the bus's limits."""

from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.servo_models.calibration.calibration import InputFile
from pupper_sysid.sysid.plan.plan_file import (
    Goal,
    executable,
    half_width,
    load_plan,
    parse_goal,
    record_until,
    save_plan,
)
from pupper_sysid.sysid.plan.planner import LEAST_HALF_WIDTH_S, PlannedTrial, Prediction
from pupper_sysid.sysid.plan.proposal import SweepPlan
from pupper_sysid.sysid.recordings.recording import Recording
from support.planned_servos import SECONDS, fit_of_half_width, two_joints
from support.refusals import assert_each_refused

POSE = {"LF_hip": 0.1, "LF_thigh": 0.785}


def trial(joint: str, frequency_hz: float, amplitude_rad: float, kind: str = "sine"):
    return PlannedTrial(
        joint=joint, kind=kind, frequency_hz=frequency_hz, amplitude_rad=amplitude_rad,
        duration_s=3.0, purpose="dead time",
    )  # fmt: skip


PROPOSAL = SweepPlan(
    made_from=(InputFile(name="sweep.csv", sha256="0" * 64),),
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
        (("frequency_hz: 7.0", "frequency_hz: -7.0"), "frequency_hz"),
        (("frequency_hz: 7.0", "frequency_hz: 700.0"), "frequency_hz"),
        (("amplitude_rad: 0.12", "amplitude_rad: 12"), "amplitude_rad"),
        (("amplitude_rad: 0.12", "amplitude_deg: 7"), "amplitude_rad"),
        (("duration_s: 3.0", "duration_s: 1e9"), "duration_s"),
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


# ----- rounds of recording: until every joint is narrow enough, or it is said why one cannot be


class Robot:
    """Records the same motion in every round; dead times have the given half widths."""

    def __init__(self, folder: Path, half_widths_ms: dict[str, list[float]]):
        self.folder, self._widths = folder, {j: list(w) for j, w in half_widths_ms.items()}
        self.plans = []
        self.first = self._write(1, list(half_widths_ms))

    def fit(self, recordings, joints):
        found = {}
        for joint in joints:
            found[joint] = fit_of_half_width(joint, self._widths[joint].pop(0))
        return found

    def record_next(self, plan, number):
        self.plans.append(plan)
        return self._write(number, plan.joints)

    def _write(self, number, joints):
        path = self.folder / f"sweep_{number}.csv"
        table = two_joints().table
        table = table[table["joint"].isin(joints)]
        table = table.assign(position_rad=table["position_rad"] + 1e-6 * number)
        Recording.from_frame(table, metadata={"readings": "live"}).save(path)
        return path

    def run(self, goal_ms: float, most_seconds: float = 1000.0, report=None):
        return record_until(
            Goal("dead_time", 1e-3 * goal_ms), [self.first], list(self._widths), self.fit,
            self.record_next, most_seconds=most_seconds, report=report,
        )  # fmt: skip


LEAST_MS = 1e3 * LEAST_HALF_WIDTH_S


@pytest.mark.parametrize(
    ("widths", "goal_ms", "plans", "why"),
    [([2.0], 2.0, 0, ""), ([5.0, 5.1, 4.95, 1.0], 2.0, 2, "did not narrow it"),
     ([1.02 * LEAST_MS], 1.01 * LEAST_MS, 0, "no trial within the limits")],
)  # fmt: skip
def test_rounds_end_where_it_is_narrow_enough_or_where_the_last_or_the_next_ones_do_not_help(
    tmp_path, widths, goal_ms, plans, why
):
    robot = Robot(tmp_path, {"LF_hip": widths})
    outcome = robot.run(goal_ms)
    assert len(robot.plans) == plans and why in (outcome.joints["LF_hip"].why or "")
    assert outcome.reached is (not why) and outcome.recordings[0] == robot.first
    assert outcome.to_dict()["joints"]["LF_hip"]["reached"] is outcome.reached


def test_only_joints_that_are_still_wide_are_recorded_again(tmp_path):
    robot = Robot(tmp_path, {"LF_hip": [5.0, 2.5, 1.9], "LF_thigh": [1.8]})
    reports = []
    outcome = robot.run(2.0, report=lambda found: reports.append(dict(found)))
    assert outcome.reached and [p.joints for p in robot.plans] == [["LF_hip"], ["LF_hip"]]
    assert len(outcome.recordings) == 3 and len(reports) == 3
    hip, thigh = outcome.joints["LF_hip"], outcome.joints["LF_thigh"]
    assert (hip.rounds, thigh.rounds) == (3, 1)
    assert hip.recorded_s == pytest.approx(3 * SECONDS, abs=0.2)
    assert reports[0]["LF_hip"].why == "more recordings are needed"


def test_the_limit_of_seconds_is_kept_and_named(tmp_path):
    robot = Robot(tmp_path, {"LF_hip": [5.0, 4.0]})
    outcome = robot.run(2.0, most_seconds=8.0)
    assert not outcome.reached and len(robot.plans) == 1
    # 5 s were left, one planned trial of which fits
    planned = sum(t.duration_s + 0.2 for t in robot.plans[0].trials)
    assert planned <= 8.0 - SECONDS + 0.1
    assert "`most_seconds` is 8" in outcome.joints["LF_hip"].why


def test_a_goal_is_half_of_an_interval():
    for text, seconds in (("dead_time:2ms", 0.002), ("dead_time:0.003s", 0.003)):
        goal = parse_goal(text)
        assert goal.half_width_s == pytest.approx(seconds)
        assert goal.reached(Interval(0.02, 0.02 - seconds, 0.02 + 0.999 * seconds))
        assert not goal.reached(Interval(0.02, 0.02 - seconds, 0.02 + 1.01 * seconds))
    assert half_width(Interval(0.0, 1.0, 4.0)) == 1.5
    texts = (
        "", "dead_time", "dead_time:2", "dead_time:ms", "dead_time:-2ms", "dead_time:2h",
        "friction:2ms", "dead_time:1e3s", "dead_time:.ms", "dead_time:nanms",
        f"dead_time:{999 * LEAST_HALF_WIDTH_S:.6f}ms",
    )  # fmt: skip
    assert_each_refused([(text, "`until`") for text in texts], parse_goal)
