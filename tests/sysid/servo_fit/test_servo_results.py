"""Results of fits and comparisons: plain data, tables, figures, and models that are read back."""

import json
from dataclasses import astuple

import numpy as np
import pytest

from pupper_sysid.common.errors import FileExistsRefusal, InputError
from pupper_sysid.common.interval import LEVEL
from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.networks import CommandNetwork
from pupper_sysid.servo_models.servo_file import load_servo_model
from pupper_sysid.sysid.compare.compare import compare
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit.data import servo_data
from pupper_sysid.sysid.servo_fit.fit import ServoFit, Split, fit_servo
from pupper_sysid.sysid.servo_fit.scores import (
    LINEAR,
    Errors,
    band,
    errors,
    interval,
    persistence,
    pooled,
    repeatability,
    tracks,
)
from support.saved_servo_models import linear_filter
from support.servo_recordings import JOINT, P, everything, ramp, recording, sine, trial

ROWS = 120


@pytest.fixture(scope="module")
def walk() -> Recording:
    """Three equal loops of a servo that follows two ticks late, with noise of 3 mrad."""
    t = P * np.arange(3 * ROWS)
    command = 0.2 * np.sin(2 * np.pi * 0.9 * (t % (P * ROWS))) + 0.1 * np.sin(2 * np.pi * 2.5 * t)
    noise = np.random.default_rng(0).normal(0, 0.003, len(t))
    position = np.concatenate([[0.0, 0.0], command[:-2]]) + noise
    rows = [slice(ROWS * n, ROWS * n + ROWS) for n in range(3)]
    made = recording(*(trial(n, P * r.start, command[r], position[r]) for n, r in enumerate(rows)))
    return Recording.from_frame(made.table, metadata={"start_pose_rad": {JOINT: 0.0}})


@pytest.fixture(scope="module")
def fit(walk) -> ServoFit:
    return fit_servo(walk, arch="fir", split=Split.by_trials([0, 1], [2]), readings="all")


def test_a_fit_is_plain_data_and_its_table_has_the_same_numbers(walk, fit):
    again = fit_servo([walk], [JOINT], "fir", split=Split.by_trials([0, 1], [2]), readings="all")
    assert again.to_dict() == fit.to_dict(), "one recording is a sequence of one"
    data = json.loads(json.dumps(fit.to_dict()))
    assert data["split"] == "trained on loops 0,1, tested on 2" and data["arch"] == "fir"
    assert data["rmse_free_run_rad"]["value"] == data["mean"]["rmse_free_run_rad"]
    assert data["difference_to_linear_rad"] == {"value": 0.0, "low": 0.0, "high": 0.0}
    assert data["readings"] == {JOINT: 2 * ROWS} and "model" not in data and "data" not in data
    (row,) = fit.to_frame().reset_index().to_dict("records")
    assert row.pop("joint") == JOINT and row == pytest.approx(data["joints"][JOINT], nan_ok=True)


def test_a_fit_is_saved_with_its_scores_and_not_over_another(fit, tmp_path):
    fit.save(tmp_path / "a")
    contract = load_servo_model(tmp_path / "a").contract
    scores = fit.to_dict()["joints"][JOINT]
    assert contract.joints[JOINT].scores == {k: v for k, v in scores.items() if k[-4:] == "_rad"}
    assert contract.split == fit.split and contract.seed == fit.seed
    with pytest.raises(FileExistsRefusal):
        fit.save(tmp_path / "a")
    fit.save(tmp_path / "a", force=True)


def test_models_are_compared_from_memory_as_from_files(walk, fit, tmp_path):
    fit.save(tmp_path / "a")
    found = compare(walk, [fit, load_calibration("paper")])
    files = compare(walk, [tmp_path / "a", "paper"])
    names = list(found.models)
    assert names == ["FIR", "DelayedPD", LINEAR]
    for ours, theirs in zip(names, files.models, strict=True):
        assert found.models[ours].joints == files.models[theirs].joints
    table = found.to_frame()
    assert list(table.index) == [(JOINT, name) for name in names]
    assert table.loc[(JOINT, "FIR"), "rmse_free_run_rad"] < 0.01
    assert json.loads(json.dumps(found.to_dict()))["time_step_s"] == pytest.approx(P)


def test_figures_have_a_panel_per_joint_and_a_line_per_model(walk, fit):
    (panel,) = fit.plot().axes
    assert panel.get_title(loc="left") == JOINT
    (panel,) = compare(walk, [fit, "paper"]).plot().axes
    labels = [text.get_text().split(",")[0] for text in panel.get_legend().get_texts()]
    assert labels == ["command", "reading", "FIR", "DelayedPD (paper)"]


def test_splits_that_would_test_on_seen_data_are_refused():
    with pytest.raises(InputError, match="Loop 1 is in `train_loops` and in `test_loops`"):
        Split.by_trials([0, 1], [1])
    with pytest.raises(InputError, match="`train_before_s` is 2 and `test_after_s` 1"):
        Split.by_time(2.0, 1.0)


# ----- scores of servo models, worked out by hand or known from theory


def follower(*fir: float, joints=(JOINT,), **feedback: float) -> CommandNetwork:
    """position = fir · last commands, in rad."""
    return linear_filter(joints, P, *fir, **feedback)


def made(**arrays) -> Errors:
    """Errors with what a test does not name left empty."""
    free = np.asarray(arrays.get("free_run", []), float)
    filled = {"speed": np.zeros(len(free)), "block": [("", 0, n // 10) for n in range(len(free))]}
    empty = {"one_step": np.empty(0), "held": np.empty(0), "raw": np.empty(0)}
    return Errors(**{**empty, **filled, **arrays, "free_run": free})


# ------------------------------------------------------------------------------- by hand


def test_persistence_is_the_rms_of_the_moves_and_none_reaches_over_a_pause():
    first = trial(0, 0.0, ramp(4), [0.0, 0.3, 0.3, -0.1])
    second = trial(1, 9.0, ramp(3), [5.0, 5.2, 5.2])
    data = servo_data([recording(first, second)], [JOINT], "all")
    moves = np.array([0.3, 0.0, -0.4, 0.2, 0.0])
    assert persistence(data, everything)[JOINT] == pytest.approx(np.sqrt(np.mean(moves**2)))
    second_only = persistence(data, lambda number, elapsed, group: number == 1)
    assert second_only[JOINT] == pytest.approx(np.sqrt(0.04 / 2))


def test_repeatability_is_the_difference_of_equal_trials_over_root_two():
    same = [trial(n, n * 9.0, ramp(30), ramp(30) + 0.06 * n) for n in range(2)]
    other = trial(2, 27.0, ramp(30, 1.0), ramp(30) + 77.0)  # other commands: nothing to compare
    data = servo_data([recording(*same, other)], [JOINT], "all")
    assert repeatability(data, everything)[JOINT] == pytest.approx(0.06 / np.sqrt(2))
    alone = repeatability(data, lambda number, elapsed, group: number == 2)
    assert np.isnan(alone[JOINT])
    # loops without a pause: 1500 independent differences, 0.01 to within 2 % (1 sd)
    rng = np.random.default_rng(0)
    loops = [
        trial(n, n * 300 * P, sine(300), sine(300) + 0.01 * rng.normal(size=300)) for n in range(6)
    ]
    data = servo_data([recording(*loops)], [JOINT], "all")
    assert repeatability(data, everything)[JOINT] == pytest.approx(0.01, rel=0.06)


def test_free_run_errors_are_model_minus_reading_at_the_readings_own_times():
    # the model is where the command before was; on a ramp that is 0.01 (tick - 1)
    rows = trial(0, 0.0, ramp(30), ramp(30) + 0.0025 - 0.01 + 0.005)  # read a quarter tick later
    data = servo_data([recording(rows, rest=-0.01)], [JOINT], "all")
    model = follower(1.0)
    found = errors(model, tracks(model, data), data, everything)[JOINT]
    np.testing.assert_allclose(found.free_run[1:-1], -0.005, atol=1e-6)
    np.testing.assert_allclose(found.raw[1:-1], -0.005, atol=1e-6)
    # its move from the last reading on is right, though its position is not
    np.testing.assert_allclose(found.one_step[1:-1], 0.0, atol=1e-6)
    np.testing.assert_allclose(found.speed[1:-1], 0.01 / P, rtol=1e-4)
    assert found.block == [("", 0, int((n * P + 0.005) / 0.5)) for n in range(30)]


def test_held_errors_look_through_the_hold_and_raw_ones_do_not():
    held = np.repeat(ramp(4, -0.01) * 3, 3)[:12]  # new at rows 3, 6 and 9
    held = np.where(np.arange(12) < 3, -0.5, 0.01 * (np.arange(12) // 3 * 3 - 0.25 - 1))
    data = servo_data([recording(trial(0, 0.0, ramp(12), held), rest=-0.01)], [JOINT], "fresh")
    model = follower(1.0)
    found = errors(model, tracks(model, data), data, everything)[JOINT]
    np.testing.assert_allclose(found.free_run, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.held, 0.0, atol=1e-6)
    assert len(found.held) == 9  # what rows show before the first change is of unknown age
    assert len(found.raw) == 12
    # a row's read is 0.5, 1.5 and 2.5 ticks later than its value
    np.testing.assert_allclose(found.raw[3:11], 0.01 * np.tile([0.5, 1.5, 2.5], 3)[:8], atol=1e-6)


def test_one_step_of_a_model_with_feedback_starts_from_the_readings():
    position = 0.3 * np.random.default_rng(1).normal(size=40)
    rows = trial(0, 0.0, np.zeros(40), position, read_after_s=0.0)
    data = servo_data([recording(rows)], [JOINT], "all")
    model = follower(0.0, feedback=0.5)
    found = errors(model, tracks(model, data), data, everything)[JOINT]
    np.testing.assert_allclose(found.one_step[1:], 0.5 * position[:-1] - position[1:], atol=1e-6)
    np.testing.assert_allclose(found.free_run, -position, atol=1e-6)


def test_runs_of_different_lengths_are_run_as_if_alone():
    parts = [trial(0, 0.0, sine(40), sine(40)), trial(1, 9.0, ramp(25, 0.3), ramp(25))]
    short = trial(0, 0.0, ramp(10), ramp(10), joint="RF_hip")
    joints = (JOINT, "RF_hip")
    data = servo_data([recording(*parts, short, rest=0.1)], joints, "all")
    found = tracks(follower(0.5, 0.3, joints=joints), data)
    for joint in joints:
        for run, track in zip(data.runs[joint], found[joint], strict=True):
            model = follower(0.5, 0.3)
            model.reset([0.1])
            alone = model.rollout(run.command_rad[:, None])[:, 0]
            # at rest this one is at 0.8 of its command
            np.testing.assert_allclose(track, [0.08, *alone], atol=1e-6)


def test_a_part_is_scored_on_its_own_readings_only():
    loops = [trial(n, n * 50 * P, sine(50), np.full(50, float(n))) for n in range(3)]
    data = servo_data([recording(*loops)], [JOINT], "all")
    model = follower(0.0)
    parts = [
        errors(model, tracks(model, data), data, lambda number, elapsed, group, n=n: group == n)
        for n in range(3)
    ]
    for n, part in enumerate(parts):
        own = part[JOINT]
        assert len(own.free_run) == len(own.raw) == len(own.block) == 50
        # between ticks the model is a cubic through its zeros
        np.testing.assert_allclose(own.free_run, -n, atol=1e-6)
    whole = pooled(parts)[JOINT]
    np.testing.assert_allclose(whole.free_run, -np.repeat([0.0, 1.0, 2.0], 50), atol=1e-6)
    assert [b[1] for b in whole.block] == [0] * 50 + [1] * 50 + [2] * 50
    assert len(whole.raw) == len(whole.speed) == 150


def test_joints_recorded_together_share_stretches_and_others_do_not():
    joints, model = (JOINT, "RF_hip"), follower(1.0, joints=(JOINT, "RF_hip"))

    def blocks(start_s: float) -> tuple[set, set]:
        starts = dict(zip(joints, (0.0, start_s), strict=True))
        pair = [trial(0, s, sine(30), sine(30), joint=j) for j, s in starts.items()]
        data = servo_data([recording(*pair)], joints, "all")
        found = errors(model, tracks(model, data), data, everything)
        return set(found[JOINT].block), set(found["RF_hip"].block)

    first, second = blocks(0.0)
    assert first == second
    first, second = blocks(20.0)
    assert not first & second


# ------------------------------------------------------------------------------- from theory


def test_the_interval_covers_the_true_rms_as_often_as_it_says_and_is_as_wide_as_theory_says():
    sd, covered = 0.01, 0
    for seed in range(100):
        noise = sd * np.random.default_rng([7, seed]).normal(size=600)
        found = interval({JOINT: made(free_run=noise)}, seed)
        assert found.low < rms(noise) == found.value < found.high
        covered += found.low <= sd <= found.high
    # 90 % less a little for 60 stretches, give or take 3 sd of 100 draws
    assert LEVEL == 0.90
    assert 0.79 <= covered / 100 <= 0.98
    # an RMS of n Gaussian errors has a standard deviation of sd / sqrt(2 n)
    noise = made(free_run=sd * np.random.default_rng(3).normal(size=6000))
    found = interval({JOINT: noise}, 0)
    assert found.high - found.low == pytest.approx(2 * 1.645 * sd / np.sqrt(12000), rel=0.15)
    # a joint without test readings changes nothing
    np.testing.assert_allclose(
        astuple(interval({JOINT: noise, "RF_hip": made()}, 0)), astuple(found)
    )


def test_errors_that_last_make_the_interval_wider():
    rng = np.random.default_rng(4)
    white = made(free_run=rng.normal(size=600))
    lasting = made(free_run=np.repeat(rng.normal(size=60), 10))  # as long as a stretch
    found = interval({JOINT: white}, 0)
    wider = interval({JOINT: lasting}, 0)
    # a tenth as many independent errors
    expected = np.sqrt(10) * (found.high - found.low)
    assert wider.high - wider.low == pytest.approx(expected, rel=0.35)


def test_the_difference_of_models_is_known_better_than_either():
    shared = np.random.default_rng(5).normal(size=600)
    ours, theirs = {JOINT: made(free_run=0.9 * shared)}, {JOINT: made(free_run=shared)}
    found = interval(ours, 0, theirs)
    assert found.value == pytest.approx(-0.1 * rms(shared))
    assert found.low < found.value < found.high < 0
    alone = interval(theirs, 0)
    assert found.high - found.low == pytest.approx(0.1 * (alone.high - alone.low), rel=1e-6)
    np.testing.assert_allclose(astuple(interval(theirs, 0, theirs)), 0, atol=1e-12)


def test_the_band_finds_noise_and_timing_and_is_not_widened_by_one_outlier():
    rng = np.random.default_rng(7)
    speed = np.abs(3.0 * np.sin(np.linspace(0, 40, 6000)))
    noise, timing = 0.004 * rng.normal(size=6000), 0.005 * speed * rng.normal(size=6000)
    found = band(made(free_run=noise + timing, speed=speed))
    assert found == pytest.approx((0.004, 0.005), rel=0.15)
    floor, jitter = band(made(free_run=noise, speed=speed))
    assert floor == pytest.approx(0.004, rel=0.05)
    assert jitter < 0.0006  # 3 sd of what 6000 readings can tell
    outlier = noise[:1000].copy()
    outlier[500] = 1.0
    # capped at 5 sd it adds 25 to a sum of 1000 squares
    assert band(made(free_run=outlier))[0] == pytest.approx(0.004 * np.sqrt(1.025), rel=0.06)
    assert np.isnan(band(made(free_run=np.ones(4)))).all()
