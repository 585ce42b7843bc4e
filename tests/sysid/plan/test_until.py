"""Rounds of recording: until every joint is narrow enough, or it is said why one cannot be."""

from pathlib import Path

import pytest

from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.plan.planner import LEAST_HALF_WIDTH_S
from pupper_sysid.sysid.plan.until import Goal, half_width, parse_goal, record_until
from pupper_sysid.sysid.recordings.recording import Recording
from support.planned_servos import SECONDS, fit_of_half_width, two_joints
from support.refusals import assert_each_refused


class Robot:
    """Writes the same recording for every round, and fits dead times of given half widths."""

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
        Recording.from_frame(
            table[table["joint"].isin(joints)], metadata={"readings": "live"}
        ).save(path)
        return path

    def run(self, goal_ms: float, most_seconds: float = 1000.0, report=None):
        return record_until(
            Goal("dead_time", 1e-3 * goal_ms), [self.first], list(self._widths), self.fit,
            self.record_next, most_seconds=most_seconds, report=report,
        )  # fmt: skip


def test_a_sweep_that_is_narrow_enough_is_not_extended(tmp_path):
    robot = Robot(tmp_path, {"LF_hip": [2.0]})
    outcome = robot.run(2.0)
    assert outcome.reached and outcome.recordings == (robot.first,) and robot.plans == []
    assert outcome.to_dict()["joints"]["LF_hip"]["reached"] is True


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


def test_rounds_end_when_two_of_them_did_not_help(tmp_path):
    robot = Robot(tmp_path, {"LF_hip": [5.0, 5.1, 4.95, 1.0]})
    outcome = robot.run(2.0)
    assert len(robot.plans) == 2 and "did not narrow it" in outcome.joints["LF_hip"].why


def test_rounds_end_where_a_plan_promises_nothing(tmp_path):
    least_ms = 1e3 * LEAST_HALF_WIDTH_S
    robot = Robot(tmp_path, {"LF_hip": [1.02 * least_ms]})
    outcome = robot.run(1.01 * least_ms)
    assert robot.plans == [] and "no trial within the limits" in outcome.joints["LF_hip"].why


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
