"""Excitations start and stay where a servo can follow, and ask for what the user asked for."""

import os
from itertools import product

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import DEFAULT_POSE
from pupper_sysid.sysid.sweep.excitation import (
    LEAD_IN_S,
    off_harmonics,
    parse_frequencies,
    plan,
)
from pupper_sysid.sysid.sweep.recorder import playback
from support.refusals import assert_each_refused

STEP = 1e-4


def sampled(trial):
    time = np.arange(0.0, trial.duration_s, STEP)
    return time, trial.offset(time)


def test_a_sweep_has_one_trial_per_joint_and_frequency_in_that_order():
    made = plan("sine", ["LF_hip", "RB_calf"], [1.0, 2.0])
    assert [(t.joints, t.frequency_hz) for t in made.trials] == [
        (("LF_hip",), 1.0),
        (("LF_hip",), 2.0),
        (("RB_calf",), 1.0),
        (("RB_calf",), 2.0),
    ]
    assert made.start_pose_rad == DEFAULT_POSE
    assert made.duration_s == pytest.approx(4 * (5.0 + LEAD_IN_S))
    # tones last five seconds or five periods
    slow = plan("sine", ["LF_hip"], [0.25, 0.5, 8.0]).trials
    np.testing.assert_allclose([t.duration_s - LEAD_IN_S for t in slow], [20.0, 10.0, 5.0])


def test_after_its_onset_a_sine_is_the_tone_it_says():
    (trial,) = plan("sine", ["LF_hip"], [2.0], amplitude_rad=0.3).trials
    time, offset = sampled(trial)
    late = time > LEAD_IN_S + 0.25 + 1e-9
    tone = 0.3 * np.sin(2 * np.pi * 2.0 * (time - LEAD_IN_S))
    np.testing.assert_allclose(offset[late], tone[late], atol=1e-12)


def test_smooth_excitations_start_at_rest_and_never_jump():
    kinds = [
        plan(kind, ["LF_hip"], [1.0, 2.5, 6.0], amplitude_rad=0.3, speed_limit_rad_s=7.5)
        for kind in ("sine", "chirp", "multisine")
    ]
    for trial in (t for made in kinds for t in made.trials):
        time, offset = sampled(trial)
        assert (offset[time <= LEAD_IN_S] == 0).all()
        speed = np.diff(offset) / STEP
        assert np.abs(speed).max() <= 0.9 * 7.5 * 1.001
        # the first millisecond of motion is slow: amplitude and tone both start from zero
        start = np.searchsorted(time, LEAD_IN_S)
        assert np.abs(offset[start : start + 10]).max() < 1e-4
        assert np.abs(offset).max() <= 0.3 * (1 + 1e-4)


def test_amplitude_is_reduced_to_nine_tenths_of_the_speed_limit_with_a_warning():
    made = plan("sine", ["LF_hip"], [2.0, 10.0], amplitude_rad=0.3, speed_limit_rad_s=7.5)
    peaks = [np.abs(sampled(t)[1]).max() for t in made.trials]
    np.testing.assert_allclose(peaks, [0.3, 0.9 * 7.5 / (2 * np.pi * 10.0)], rtol=1e-4)
    (warning,) = made.warnings
    assert warning.startswith("10 Hz: amplitude reduced from 0.3 to 0.107 rad")
    assert made.description["warnings"] == [warning]
    # once, however many joints move, and not where nothing is reduced
    assert len(plan("sine", ["LF_hip", "RF_hip"], [10.0]).warnings) == 1
    assert plan("sine", ["LF_hip"], [1.0, 2.0, 3.0]).warnings == ()


@pytest.mark.parametrize("kind", ["sine", "multisine", "chirp"])
def test_a_ramp_by_the_servos_registers_bounds_the_acceleration(kind):
    ramp = 12.0
    made = plan(kind, ["LF_hip"], [1.0, 3.0], 0.3, 6.0, acceleration_limit_rad_s2=ramp)
    for trial in made.trials:
        time, offset = sampled(trial)
        grown = time > LEAD_IN_S + 0.6  # a tone grows over its first half period
        bend = np.abs(np.diff(offset, 2))[grown[2:]].max() / STEP**2
        assert bend <= 0.9 * ramp * 1.02
        assert bend >= 0.5 * min(0.9 * ramp, 0.3 * (2 * np.pi) ** 2)
    assert any("registers ramp" in w for w in made.warnings)


def test_a_chirp_passes_every_frequency_within_the_speed_limit():
    made = plan("chirp", ["LF_hip"], [1.0, 10.0], duration_s=20.0)
    time, offset = sampled(made.trials[0])
    turns = time[1:-1][np.diff(np.sign(np.diff(offset))) != 0] - LEAD_IN_S
    half_periods = np.diff(turns)
    middle = 0.5 * (turns[1:] + turns[:-1])
    expected = 1.0 * 10.0 ** (middle / 20.0)
    later = middle > 2.0
    np.testing.assert_allclose(0.5 / half_periods[later], expected[later], rtol=0.05)
    assert any("chirp" in w for w in made.warnings)


def test_a_multisine_holds_its_tones_in_equal_parts_and_nothing_else():
    tones = [1.0, 2.0, 3.0, 5.0]
    (trial,) = plan("multisine", ["LF_hip"], tones, duration_s=20.0).trials
    time = LEAD_IN_S + 2.0 + np.arange(0, 4.0, 0.01)
    spectrum = np.abs(np.fft.rfft(trial.offset(time))) / len(time)
    frequency = np.fft.rfftfreq(len(time), 0.01)
    chosen = np.isin(np.round(frequency, 6), tones)
    np.testing.assert_allclose(spectrum[chosen], spectrum[chosen].mean(), rtol=1e-6)
    assert spectrum[~chosen].max() < 1e-9


def test_steps_come_in_three_sizes_both_ways_and_a_square_wave_spends_half_its_time_on_each_side():
    (trial,) = plan("steps", ["LF_hip"], amplitude_rad=0.3).trials
    _, offset = sampled(trial)
    np.testing.assert_allclose(np.unique(offset.round(9)), [-0.3, -0.2, -0.1, 0, 0.1, 0.2, 0.3])
    assert np.isnan(trial.frequency_hz) and offset[-1] == 0
    (trial,) = plan("square", ["LF_hip"], [1.0], amplitude_rad=0.2, duration_s=5.0).trials
    time, offset = sampled(trial)
    moving = offset[time > LEAD_IN_S]
    assert set(moving.round(9)) == {-0.2, 0.2} and np.isnan(trial.frequency_hz)
    assert moving.mean() == pytest.approx(0.0, abs=1e-3)


def test_tones_that_samples_would_hit_at_few_phases_are_moved_and_that_is_said():
    """Samples at the rate leave no gap of phase larger than a ninth of a period."""
    for rate, asked in product((52.6, 37.24), (1.0, 4.0, 37.24 / 5, 52.6 / 8, 10.0)):
        tone = off_harmonics(asked, (52.6, 37.24), 5.0)
        assert abs(tone - asked) < 0.3
        phases = np.sort((tone * np.arange(int(5.0 * rate)) / rate) % 1.0)
        gaps = np.diff(np.concatenate([phases, [phases[0] + 1.0]]))
        assert gaps.max() < 1 / 9, (rate, asked)
    made = plan("sine", ["LF_hip"], [37.2439 / 5])
    assert made.trials[0].frequency_hz != pytest.approx(37.2439 / 5, abs=0.02)
    assert "became" in made.warnings[0]


def test_frequencies_are_read_as_users_write_them_or_refused_with_what_to_write():
    for text, expected in (
        ("1-10", [float(i) for i in range(1, 11)]), ("1-2:0.25", [1.0, 1.25, 1.5, 1.75, 2.0]),
        ("1,2,4,6.5", [1.0, 2.0, 4.0, 6.5]), (" 3 , 1-2 ", [1.0, 2.0, 3.0]),
        ("0.1-0.3:0.1", [0.1, 0.2, 0.3]), ("2,2", [2.0]),
    ):  # fmt: skip
        assert parse_frequencies(text) == expected
    cases = [
        ("", "not a frequency"), ("fast", "'fast'"), ("1,,2", "''"), ("0", "at least 0.01 Hz"),
        ("-3", "not a frequency"), ("1--3", "at least 0.01 Hz"), ("nan", "at least 0.01 Hz"),
        ("10-1", "write 1-10"), ("1-30", "at most 25"), ("0.001", "at least 0.01 Hz"),
        ("٣", "not a frequency"), ("1_0", "not a frequency"), ("1-5:0", "step"),
        ("1-5:-1", "step"), ("3:1", "step"), ("1-20:0.001", "larger step"),
    ]  # fmt: skip
    assert_each_refused(cases, parse_frequencies)


def test_impossible_excitations_are_refused():
    asked = {"kind": "sine", "joints": ["LF_hip"], "frequencies_hz": [1.0]}
    cases = [
        ({"kind": "noise"}, "noise"), ({"joints": []}, "joint"),
        ({"frequencies_hz": []}, "frequenc"), ({"frequencies_hz": [26.0]}, "25 Hz"),
        ({"loop_period_s": 0.1, "frequencies_hz": [6.0]}, "Hz"),
        ({"amplitude_rad": 0.0}, "amplitude"), ({"amplitude_rad": np.nan}, "amplitude"),
        ({"duration_s": -1.0}, "duration"), ({"speed_limit_rad_s": 0.0}, "speed"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda wrong: plan(**asked | wrong))


def write(path, **columns):
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def test_playback_holds_each_recorded_command_until_the_next(tmp_path):
    path = write(
        tmp_path / "gait.csv",
        loop=[0, 0, 0, 1, 1],
        time_s=[5.0, 5.04, 5.08, 9.0, 9.04],
        LF_hip_command_rad=[0.1, 0.2, 0.3, 0.4, 0.5],
        LF_hip_position_rad=[9.0] * 5,
        RB_calf_command_rad=[-1.5, -1.4, -1.3, -1.2, -1.1],
    )
    made = playback(path)
    assert [t.joints for t in made.trials] == [("LF_hip", "RB_calf")] * 2
    start = np.array([made.start_pose_rad[j] for j in ("LF_hip", "RB_calf")])
    np.testing.assert_allclose(start, [0.1, -1.5])
    first, second = made.trials
    for after, expected in ((-0.1, 0.1), (0.001, 0.1), (0.039, 0.1), (0.041, 0.2), (0.1, 0.3)):
        assert first.command(LEAD_IN_S + after, start)[0] == pytest.approx(expected)
    np.testing.assert_allclose(second.command(LEAD_IN_S + 0.05, start), [0.5, -1.1])
    assert first.duration_s == pytest.approx(LEAD_IN_S + 0.12)
    assert [t.joints for t in playback(path, ["RB_calf"]).trials] == [("RB_calf",)] * 2
    with pytest.raises(InputError, match="RF_hip_command_rad"):
        playback(path, ["RF_hip"])


def test_unusable_command_files_are_refused_by_place(tmp_path):
    two = {"time_s": [0.0, 1.0]}
    tables = [
        (two, "LF_hip_command_rad"), ({"LF_hip": [0.0, 1.0]}, "time_s"),
        (two | {"LF_hip": [0.0, np.nan]}, "line 3, column LF_hip is empty"),
        (two | {"LF_hip": ["0", "zero"]}, "line 3, column LF_hip: 'zero' is not"),
        (two | {"LF_hip": ["0", "4_1"]}, "'4_1' is not a number"),
        ({"time_s": [0.0, 1.0, 2.0], "LF_hip": [0, 0, 0], "loop": [0, 1, 0]}, "follow one another"),
        ({"time_s": range(2000), "LF_hip": [0] * 2000, "loop": range(2000)}, "2,000 loops"),
        (two | {"LF_hip": [0.0, 45.0]}, "radians"),
        ({"time_s": [1.0, 0.0], "LF_hip": [0.0, 0.1]}, "increase"),
        ({"time_s": [1.0], "LF_hip": [0.0]}, "increase"), ({"time_s": [], "LF_hip": []}, "rows"),
    ]  # fmt: skip
    assert_each_refused(
        tables, lambda columns: playback(write(tmp_path / "bad.csv", **columns)), names="bad.csv"
    )
    path = write(tmp_path / "cut.csv", time_s=[0.0, 1.0, 2.0], LF_hip=[0.0, 0.1, 0.2])
    path.write_text(path.read_text()[:-5])
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)))
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "device").symlink_to("/dev/zero")
    files = [
        ("cut.csv", "cut short"), ("none.csv", "none.csv"), ("binary.csv", "binary.csv"),
        ("fifo", "is not a file"), ("device", "is not a file"),
    ]  # fmt: skip
    assert_each_refused(files, lambda name: playback(tmp_path / name))
