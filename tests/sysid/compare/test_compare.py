"""Comparisons: the age and the offset of a recording's readings, by one rule for all models."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pupper_sysid.data import SAMPLES
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.sysid.compare import compare as four_way_module
from pupper_sysid.sysid.compare.compare import Comparison, calibrated_run, compare
from pupper_sysid.sysid.fit.predict import ComparedRun, ReadingRule, ages, notes
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording, Trial
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import servo_data
from pupper_sysid.sysid.servo_fit.fit import ServoFit, Split, fit_servo
from pupper_sysid.sysid.servo_fit.scores import LINEAR, run_with_offset, with_ages
from support.runs import PAD, run_of
from support.servo_recordings import JOINT, recording, trial

POLL_S, LOSS = 0.027, 0.4


def calibration(poll_s: float = POLL_S) -> Calibration:
    """The sample's, its hip with this poll and with an offset of its recording."""
    made = load_calibration(SAMPLES / "calibrated.yaml")
    own = made.joint(JOINT)
    numbers = {"poll_period_s": poll_s, "loss": LOSS, "offset_rad": -0.78}
    feedback = own.feedback.model_copy(
        update={
            k: getattr(own.feedback, k).model_copy(update={"value": v, "low": None, "high": None})
            for k, v in numbers.items()
        }
    )
    joints = {JOINT: own.model_copy(update={"feedback": feedback})}
    return made.model_copy(update={"joints": joints, "inputs": ()})


@cache
def walk(zero_rad: float = 0.0, seed: int = 0, old: float | None = None) -> Recording:
    """A servo of `calibration` under a gait, polled behind a loop too slow to show the poll."""
    rng, loop_s = np.random.default_rng(seed), 0.04
    rows = round(12 / loop_s)
    t = loop_s * np.arange(rows)
    command = 0.2 * np.sin(2 * np.pi * 0.9 * t) + 0.1 * np.sin(2 * np.pi * 2.1 * t + 1.0)
    command -= command[0]
    model = calibration().delayed_pd([JOINT], 0.002)
    model.reset(np.zeros(1))
    steps = round(loop_s / 0.002)
    position = np.concatenate([[0.0], model.rollout(np.repeat(command, steps)[:, None])[:, 0]])
    read = t + 0.005
    if old is None:
        polls = np.arange(-1.0, t[-1] + 1, POLL_S) + rng.uniform(0, POLL_S)
        good = polls[(rng.random(len(polls)) >= LOSS) | (polls < -0.5)]
        measured = good[np.searchsorted(good, read, side="right") - 1]
    else:
        measured = read - old
    reading = np.interp(measured, 0.002 * np.arange(len(position)), position) + zero_rad
    made = trial(0, 0.0, command, reading, period_s=loop_s)
    table = recording(made, rest=0.0).table
    return Recording.from_frame(table, metadata={"start_pose_rad": {JOINT: 0.0}})


@cache
def learned() -> ServoFit:
    """A filter of the rows of another walk, as they were logged."""
    return fit_servo(walk(seed=1), arch="fir", readings="all")


@cache
def compared(zero_rad: float = 0.0, poll_s: float = POLL_S) -> Comparison:
    """The true servo, a preset and a learned model on one walk."""
    return compare(walk(zero_rad), [calibration(poll_s), "paper", learned()])


def raw(found: Comparison, name: str) -> float:
    return found.models[name].joints[JOINT].rmse_raw_rad


def test_ages_are_those_of_a_polled_bus():
    for period, loss in ((0.027, 0.0), (0.027, 0.42), (0.008, 0.8)):
        rng = np.random.default_rng(0)
        polls = period * np.arange(200_000)
        good = polls[rng.random(len(polls)) >= loss]
        read = rng.uniform(good[0], good[-1], 100_000)
        simulated = read - good[np.searchsorted(good, read, side="right") - 1]
        found = ages(period, loss, 200)
        assert found.mean() == pytest.approx(HeldFeedback(period, loss).mean_age_s)
        share = np.linspace(0.05, 0.9, 18)
        np.testing.assert_allclose(
            np.quantile(found, share), np.quantile(simulated, share), atol=0.03 * found.mean()
        )


def test_a_tone_read_at_a_random_phase_of_the_poll_is_smaller_and_later_as_theory_says():
    # mean of sin(w (t - a)) over ages a uniform within T: sinc, half a period late
    data = servo_data([walk()], [JOINT], "all")
    rule = ReadingRule(rule="expected", source="", poll_period_s=0.03, loss=0.0, mean_age_s=0.015)
    (run,) = with_ages(data, {JOINT: rule}).runs[JOINT]
    w = 2 * np.pi * 3.0
    tick = np.arange(len(run.command_rad) * 20 + 1) / 20
    track = np.sin(w * 0.04 * tick)
    late = slice(10, -10)
    found = scores.predicted(track, run, run.reading_tick)[late]
    expected = np.sinc(w * 0.015 / np.pi) * np.sin(w * (0.04 * run.row_tick - 0.015))
    np.testing.assert_allclose(found, expected[late], atol=2e-3)


def test_the_age_of_readings_is_predicted_where_the_recording_does_not_show_its_poll():
    found, logged = compared(), compared(poll_s=0.0)
    rule = found.models["DelayedPD"].readings[JOINT]
    assert (rule.rule, rule.poll_period_s, rule.loss) == ("expected", POLL_S, LOSS)
    assert any("does not show its poll" in note for note in found.reading_notes())
    # the servo is the true one: what is left is that the age of each reading is not known
    assert raw(found, "DelayedPD") < 0.75 * raw(logged, "DelayedPD")
    spread = found.models["DelayedPD"].age_spread_rad[JOINT]
    # over 12 walks their ratio is 0.99 ± 0.12
    assert raw(found, "DelayedPD") == pytest.approx(spread, rel=0.3)


def test_a_score_does_not_depend_on_what_stands_beside_it():
    """Each model predicts what its file says; one that knows no poll predicts rows as logged."""
    found, logged = compared(), compared(poll_s=0.0)
    assert logged.readings[JOINT].rule == "as logged"
    assert any("nothing is known of the poll" in note for note in logged.reading_notes())
    for name in ("DelayedPD (paper)", "FIR", LINEAR):
        assert found.models[name].joints == logged.models[name].joints, name
    alone = compare(walk(), [calibration()]).models["DelayedPD"]
    assert alone.joints == found.models["DelayedPD"].joints
    assert found.models["FIR"].age_spread_rad == {}


def test_live_readings_have_no_age():
    live = walk(old=0.0)
    live = Recording.from_frame(live.table, metadata=live.metadata | {"readings": "live"})
    found = compare(live, [calibration()])
    assert found.readings[JOINT].rule == "live"
    assert raw(found, "DelayedPD") < 1.5e-3


def test_the_poll_of_a_recording_comes_before_that_of_a_calibration(hip):
    found = compare(load(hip), [calibration()])
    rule = found.readings[JOINT]
    assert (rule.rule, rule.source) == ("own dates", "hip")
    assert rule.mean_age_s == pytest.approx(found.data.lattices[JOINT].mean_age_s)


def test_the_zero_of_a_recording_is_no_error_of_any_model():
    here, there = compared(), compared(0.78)
    for name, model in here.models.items():
        assert raw(there, name) == pytest.approx(raw(here, name), rel=1e-3), name
        if name != LINEAR:
            moved = there.models[name].offset_rad[JOINT] - model.offset_rad[JOINT]
            # fitted in three rounds, as it moves the start
            assert moved == pytest.approx(0.78, abs=1e-4)
    assert here.models["DelayedPD"].offset_rad[JOINT] == pytest.approx(0.0, abs=3e-3)
    # where the start is unknown it is the first reading less the offset
    unknown = compare(Recording.from_frame(walk(0.78).table, metadata={}), [calibration()])
    assert raw(unknown, "DelayedPD") == pytest.approx(raw(there, "DelayedPD"), rel=0.02)


def test_an_offset_is_estimated_from_the_given_part_only():
    table = walk().table.copy()
    late = table["send_time_s"] > 8.0
    table.loc[late, "position_rad"] += 0.2
    metadata = {"start_pose_rad": {JOINT: 0.0}}
    data = servo_data([Recording.from_frame(table, metadata=metadata)], [JOINT], "all")
    split = Split.by_time(8.0, 8.0)
    track, offset = run_with_offset(calibrated_run(calibration(), data), data, split.train)
    assert offset[JOINT] == pytest.approx(0.0, abs=0.01)
    errors = scores.errors(None, track, data, split.test)[JOINT].raw
    assert np.median(errors) == pytest.approx(-0.2, abs=0.02)


def test_ctrl_c_ends_a_comparison_of_networks_and_the_bar_of_both_fits_runs_once(monkeypatch):
    """Networks trained to different ends are not compared; `fit-servo` keeps the best so far."""
    fitted, shares = [], []

    def fit(recording, joints, arch, *, split, seed, progress, keep_unfinished):
        fitted.append(arch)
        assert not keep_unfinished
        for share in (0.0, 0.5, 1.0):
            progress(arch, share)
        progress("DelayedPD", 0.0)
        if arch == "mlp":
            raise KeyboardInterrupt

    monkeypatch.setattr(four_way_module, "fit_servo", fit)
    with pytest.raises(KeyboardInterrupt):
        four_way_module.four_way(walk(), [JOINT], 0, lambda what, share: shares.append(share))
    assert fitted == ["lstm", "mlp"]
    assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] == 1.0


# ----- runs with the torque off, scored on models that were never fitted to any


def bench(off_steps: int) -> ComparedRun:
    """A run of 1 s whose torque is off at its end."""
    held = np.ones((3, PAD + 500))
    held[1, len(held[1]) - off_steps :] = 0.0
    nothing = np.zeros(1)
    trial = Trial("knee", 0, np.nan, nothing, nothing, nothing, nothing, None, 0.0, p_gain=400.0)
    run = replace(run_of(np.zeros(500)), held=held, p_gain=400.0)
    return ComparedRun(trial, run, 0, False)


def model(off_brake: bool):
    """A calibration under load that knows how the servo brakes with the torque off, or not."""
    made = load_card("xl330-m288").calibration()
    joint = made.joint("knee")
    assert joint.servo is not None and joint.servo.off_brake is not None
    if not off_brake:
        block = joint.servo.model_copy(update={"off_brake": None})
        joint = joint.model_copy(update={"servo": block})
    return made.model_copy(update={"joints": {"knee": joint}})


@pytest.mark.parametrize(
    ("off_steps", "known", "count"), [(100, False, 1), (100, True, 0), (0, False, 0)]
)
def test_a_run_with_the_torque_off_is_noted_where_braking_then_is_unknown(off_steps, known, count):
    runs = {"knee": [bench(off_steps), bench(0)]}
    made = [n for n in notes({"a.yaml": model(known)}, runs) if "torque is off" in n]
    assert len(made) == count
    assert all("off for 0.2 s" in note and "`off_brake`" in note for note in made)
    # a model in torque has no such number
    fixed = load_card("sts3215-soarm100").calibration()
    assert any("`off_brake`" in note for note in notes({"card": fixed}, runs)) is bool(off_steps)
