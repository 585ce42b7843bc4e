"""Other people's logs: recognised by their columns, made absolute, put in one time."""

import math

import numpy as np
import pytest

from common.errors import InputError
from common.joints import DEFAULT_POSE, JOINT_NAMES
from sysid.importers import PAUSE_S, READ_AFTER_SEND_S, rounding
from sysid.recording import load

SWEEP = "time_s,phase,amp_rad,freq_hz,motor_idx,signal,command_rad,actual_rad"
PLAYBACK = (
    "global_step,loop,csv_step,time_s,LF_hip_command_rad,LF_hip_position_rad,"
    "RB_calf_command_rad,RB_calf_position_rad"
)


def tones(frequencies=(1.0, 2.0), motor=1, count=30):
    """Lines of a sweep with recognisable numbers: command 0.01 k, position 0.005 k in row k."""
    return [
        f"{0.02 * k:.4f},0,0.3,{f},{motor},0,{0.01 * k:.4f},{0.005 * k:.4f}"
        for f in frequencies
        for k in range(count)
    ]


def loops():
    """Lines of a playback of three loops; the calf's numbers are a tenth of the row's below -1."""
    return [
        f"{k},{k // 30},{k % 30},{0.04 * k:.3f},0.1,0.2,{-1 - 0.01 * k:.4f},{-1 - 0.02 * k:.4f}"
        for k in range(90)
    ]


def write(tmp_path, header, lines):
    path = tmp_path / "log.csv"
    path.write_text("\n".join([header, *lines, ""]))
    return path


def changed(lines, index, column, text, header=SWEEP):
    """Lines with one cell replaced."""
    cells = lines[index].split(",")
    cells[header.split(",").index(column)] = text
    return [*lines[:index], ",".join(cells), *lines[index + 1 :]]


def test_a_sweep_becomes_absolute_and_its_tones_follow_each_other(tmp_path):
    recording = load(write(tmp_path, SWEEP, tones()))
    first, second = recording.trials("LF_thigh")
    assert recording.joints == ["LF_thigh"] and recording.warnings == ()
    assert (first.frequency_hz, second.frequency_hz) == (1.0, 2.0)
    # 29 steps of 0.02 s of tone, then the pause
    assert second.send_time_s[0] == pytest.approx(0.58 + PAUSE_S)
    np.testing.assert_allclose(first.command_rad, 0.785 + 0.01 * np.arange(30))
    np.testing.assert_allclose(first.position_rad, 0.785 + 0.005 * np.arange(30))
    np.testing.assert_allclose(first.read_time_s - first.send_time_s, READ_AFTER_SEND_S)
    assert first.initial_command_rad == 0.785


def test_what_a_sweep_does_not_say_is_in_its_metadata(tmp_path):
    metadata = load(write(tmp_path, SWEEP, tones())).metadata
    assert metadata["read_after_send_s"] == READ_AFTER_SEND_S
    assert metadata["start_pose_rad"] == {"LF_thigh": DEFAULT_POSE["LF_thigh"]}
    assert metadata["bus"]["command_quantum_rad"] == math.pi / 550
    assert metadata["bus"]["command_rounding"] == {"LF_thigh": "up"}


def test_truncated_counts_round_up_where_the_count_falls_with_the_angle():
    # d(count)/d(angle), hardware facts D2: rows hip, thigh, calf; columns LF, RF, LB, RB
    falls = {"hip": "--++", "thigh": "-+-+", "calf": "-+-+"}
    for kind, signs in falls.items():
        for leg, sign in zip(("LF", "RF", "LB", "RB"), signs, strict=True):
            assert rounding(f"{leg}_{kind}") == ("up" if sign == "-" else "down")


def test_a_tone_that_is_repeated_is_a_trial_of_its_own(tmp_path):
    recording = load(write(tmp_path, SWEEP, tones((2.0, 2.0))))
    assert [len(t.send_time_s) for t in recording.trials("LF_thigh")] == [30, 30]
    send = recording.table["send_time_s"].to_numpy()
    assert (np.diff(send) > 0).all()


def test_two_motors_in_one_file_become_two_joints(tmp_path):
    recording = load(write(tmp_path, SWEEP, tones((1.0,), 11) + tones((1.0,), 0)))
    assert recording.joints == ["LF_hip", "RB_calf"]
    assert recording.trials("RB_calf")[0].command_rad[0] == -1.57


def test_sweep_rows_without_time_tone_or_joint_are_left_out_and_said(tmp_path):
    lines = tones()
    for row, column in ((3, "time_s"), (7, "freq_hz"), (40, "motor_idx")):
        lines = changed(lines, row, column, "")
    recording = load(write(tmp_path, SWEEP, lines))
    assert [len(t.send_time_s) for t in recording.trials("LF_thigh")] == [28, 29]
    assert recording.warnings == ("3 rows without time, tone or joint were left out.",)


def test_a_playback_has_a_trial_per_loop_and_angles_as_they_are(tmp_path):
    recording = load(write(tmp_path, PLAYBACK, loops()))
    assert recording.joints == ["LF_hip", "RB_calf"]
    second = recording.trials("RB_calf")[1]
    assert second.number == 1 and np.isnan(second.frequency_hz)
    np.testing.assert_allclose(second.command_rad, -1 - 0.01 * np.arange(30, 60))
    np.testing.assert_allclose(second.position_rad, -1 - 0.02 * np.arange(30, 60))
    assert recording.loop_period_s == pytest.approx(0.04)


# the first row stands on line 2
BAD = {
    "sweep without positions": (
        SWEEP.rsplit(",", 1)[0], [r.rsplit(",", 1)[0] for r in tones()], "actual_rad is missing",
    ),
    "sweep, renamed motor": (SWEEP.replace("motor_idx", "motor"), tones(), "Was 'motor' meant"),
    "sweep, text": (SWEEP, changed(tones(), 4, "actual_rad", "?"), r"line 6, .*'\?' is not a number"),
    "sweep, motor 12": (SWEEP, tones(motor=12), "line 2, column motor_idx: 12 is no joint"),
    "sweep, motor -1": (SWEEP, tones(motor=-1), "line 2, column motor_idx: -1 is no joint"),
    "sweep, half a motor": (SWEEP, tones(motor=0.5), "0.5 is not a whole number"),
    "sweep, degrees": (SWEEP, changed(tones(), 4, "actual_rad", "17"), "line 6, column actual_rad"),
    "sweep without times": (SWEEP, ["," + r.split(",", 1)[1] for r in tones()], "no row has all of"),
    "sweep, clock set back": (SWEEP, changed(tones(), 25, "time_s", "0.13"), "line 27, .*backwards"),
    "playback, unknown joint": (PLAYBACK.replace("RB_calf", "RB_clf"), loops(), "mean RB_calf"),
    "playback, renamed column": (
        PLAYBACK.replace("LF_hip_pos", "LF_hip_ps"), loops(), "LF_hip_psition_rad",
    ),
    "playback without a command": (
        PLAYBACK.replace("RB_calf_command_rad", "x"), loops(), "column RB_calf_command_rad is missing",
    ),
    "playback without loops": (PLAYBACK.replace("loop", "lap"), loops(), "Was 'lap' meant"),
    "playback, half a loop": (
        PLAYBACK, changed(loops(), 5, "loop", "0.5", PLAYBACK), "line 7, column loop",
    ),
    "playback, degrees": (
        PLAYBACK, changed(loops(), 5, "RB_calf_position_rad", "-90", PLAYBACK),
        "line 7, column RB_calf_position_rad: .*looks like degrees",
    ),
    "some other table": ("a,b,c", ["1,2,3"], "columns send_time_s, .* are missing; it has a, b, c"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_log_that_cannot_be_used_is_refused_in_a_sentence(tmp_path, case):
    header, lines, said = BAD[case]
    path = write(tmp_path, header, lines)
    with pytest.raises(InputError, match=said) as refusal:
        load(path)
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_the_real_sweeps_load_whole_at_the_rate_and_quantum_that_were_measured(real_sweeps):
    # facts/identification.md 5.1: 19.03 ms, 157 or 158 rows per tone, quantum pi/550
    for path, rows in zip(real_sweeps, (631, 632), strict=True):
        recording = load(path)
        assert len(recording.table) == rows and recording.warnings == ()
        (joint,) = recording.joints
        trials = recording.trials(joint)
        assert [t.frequency_hz for t in trials] == [1.0, 2.0, 3.0, 4.0]
        assert {len(t.send_time_s) for t in trials} <= {157, 158}
        assert recording.loop_period_s == pytest.approx(0.01903, abs=1e-4)
        relative = recording.table["position_rad"].to_numpy() - DEFAULT_POSE[joint]
        counts = relative / (math.pi / 550)
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)


def test_the_real_playback_has_twelve_joints_and_three_loops(real_data):
    recording = load(real_data / "playback_lstm_25hz.csv")
    assert recording.joints == list(JOINT_NAMES) and recording.warnings == ()
    for joint in recording.joints:
        assert [len(t.send_time_s) for t in recording.trials(joint)] == [150, 120, 120]
    assert recording.loop_period_s == pytest.approx(0.04, abs=2e-4)
