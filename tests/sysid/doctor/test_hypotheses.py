"""The doctor names the fault of a recording, and nothing where there is none."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import pupper_sysid as ps
from pupper_sysid.sysid.doctor.changes import followed
from pupper_sysid.sysid.doctor.checks import findings
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, RIVALS, USE, WORDS, Finding, rivalled
from pupper_sysid.sysid.doctor.hypotheses import _since_command_s
from pupper_sysid.sysid.feedback.staleness import staleness
from pupper_sysid.sysid.recordings.excitation import named_tones
from support.real_recordings import case, real_recording
from support.strange_servos import ACCUSING, FAULTS, draw_recording, draw_world, simulated
from support.synthetic import first_order_trial


def slow(case):
    """A case of the slow tests."""
    return pytest.param(case, marks=pytest.mark.slow)


def recorded(table) -> ps.Recording:
    return ps.Recording.from_arrays(
        table.send_time_s.to_numpy(), {"joint": table.command_rad.to_numpy()},
        {"joint": table.position_rad.to_numpy()}, read_time_s=table.read_time_s.to_numpy(),
    )  # fmt: skip


def codes(recording, joint: str = "joint") -> dict[str, Finding]:
    return {f.code: f for f in findings(recording.trials(joint)) if f.verdict != USE}


@pytest.mark.slow
@pytest.mark.parametrize("fault", [name for name in FAULTS if name not in (
    "healthy", "scale", "second writer", "friction", "heats", "speed", "writer now and then",
    "writer at its rate", "torque fades")])  # fmt: skip
def test_a_fault_is_named_by_its_code(fault):
    """Of four recordings (servos and motions in turn) three or more; none names another fault."""
    told = [codes(recorded(draw_recording(fault, n, 5)[1])) for n in (0, 1, 2, 5)]
    right = [bool(set(FAULTS[fault][1]) & set(one)) for one in told]
    assert sum(right) >= 3, [list(one) for one in told]


@pytest.mark.slow
def test_sound_recordings_are_not_accused():
    for number in range(14):
        table = draw_recording("healthy", number, 6)[1]
        assert set(codes(recorded(table))) & set(ACCUSING) == set(), number


def test_a_joint_that_rests_in_slow_strokes_is_held_by_friction_and_not_dead():
    """A backlash test: the joint follows a slow triangle at the distance of its friction."""
    time = 0.02 * np.arange(1500)
    command = 0.06 * (2 * np.abs((0.1 * time) % 2 - 1) - 1)
    position, now = np.empty_like(command), command[0]
    for k, goal in enumerate(command):
        now = min(max(now, goal - 0.04), goal + 0.04)
        position[k] = 0.0015 * np.round(now / 0.0015)
    found = codes(ps.Recording.from_arrays(
        time, {"joint": command}, {"joint": position}, read_time_s=time + 1e-3,
    ))  # fmt: skip
    assert set(found) == {"held_by_friction"}
    assert found["held_by_friction"].values["travel_rad"] == pytest.approx(0.08, rel=0.1)
    assert found["held_by_friction"].verdict == CARE


def test_a_joint_that_hunts_in_its_play_has_no_swapped_columns():
    """A low-pass takes the oscillation out of the position, so that the command seems to follow."""
    rng = np.random.default_rng(3)
    time = 0.005 * np.arange(5000)
    command = sum(
        0.05 * np.sin(2 * np.pi * hz * time + phase)
        for hz, phase in zip(rng.uniform(0.1, 0.8, 5), rng.uniform(0, 6.3, 5), strict=True)
    )
    hunting = 0.02 * np.sin(2 * np.pi * 14.0 * time + 3.0 * np.sin(7.0 * time))
    position = np.interp(time - 0.028, time, command) + hunting
    position += 1e-3 * rng.standard_normal(len(time))

    recording = ps.Recording.from_arrays(
        time, {"joint": command}, {"joint": position}, read_time_s=time + 1e-3
    )
    assert set(codes(recording)) & set(ACCUSING) == set()


@pytest.mark.parametrize("rate_hz", [50.0, slow(500.0)])
def test_a_servo_that_settles_after_each_step_is_no_echo(rate_hz):
    """At rest the position is the command, a while late; on its way it is not."""
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 14.0, 1 / rate_hz)
    level = 0.4 * rng.uniform(-1, 1, 80)
    late = time - 0.03
    at = np.maximum((late / 0.8).astype(int), 0)
    since = late - 0.8 * at
    before = level[np.maximum(at - 1, 0)]
    position = level[at] + (before - level[at]) * np.exp(-since / 0.04)
    command = level[(time / 0.8).astype(int)]
    recording = ps.Recording.from_arrays(
        time, {"joint": command}, {"joint": np.round(position, 3)}, read_time_s=time + 1e-3
    )
    assert not {"echo", "echo_between_rows"} & set(codes(recording))
    shift = round(0.3 * rate_hz)
    echo = np.concatenate([np.full(shift, command[0]), command[:-shift]])
    recording = ps.Recording.from_arrays(
        time, {"joint": command}, {"joint": echo}, read_time_s=time + 1e-3
    )
    assert {"echo", "echo_between_rows"} & set(codes(recording))


def test_an_echo_is_told_from_a_fast_servo_by_the_time_that_it_had():
    """A servo that is read before the next command may have arrived, and one at once has not."""
    rng, sent = np.random.default_rng(0), 0.02 * np.arange(350)
    command = np.repeat(0.2 * rng.standard_normal(35), 10)
    before = np.concatenate([command[:1], command[:-1]])
    noise = 2e-3 * rng.standard_normal(350)
    for position, read, since in ((before, sent - 0.005, 0.015), (command, sent + 0.001, 0.001)):
        log = ps.Recording.from_arrays(
            sent, {"joint": command}, {"joint": position + noise}, read_time_s=read
        )
        (trial,) = log.trials("joint")
        assert _since_command_s(trial) == pytest.approx(since)
        assert ("at_once" in codes(log)) == (since < 0.008)


def test_a_runner_up_is_named_in_words_and_by_its_code():
    best = Finding("clipped", CARE, {"level_rad": 0.2, "percent": 20.0})
    near = rivalled(best, "held_by_friction")
    assert near.values["rival"] == "held_by_friction" and near.text.startswith(best.text)
    assert RIVALS["held_by_friction"] in near.text
    assert set(RIVALS) <= set(WORDS) and {c for _, all_ in FAULTS.values() for c in all_} <= set(
        WORDS
    )


def free_world():
    """A servo that moves freely for 14 s, and the generator that drew it."""
    rng = np.random.default_rng(3)
    world = replace(
        draw_world(rng, "smart", "teleoperation", 3e-4), amplitude_rad=0.3, rate_hz=50.0,
        poll_s=0.0, friction_rad=0.0, gravity_rad=0.0, duration_s=14.0, quantum_rad=0.0015,
    )  # fmt: skip
    return world, rng


@cache
def healthy_codes() -> frozenset[str]:
    return frozenset(codes(recorded(simulated(free_world()[0]))))


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        pytest.param("heats", "gain_drifts", marks=pytest.mark.slow),
        ("zero jumps", "zero_moves"), ("loses power", "frozen"), ("speed", "speed_for_position"),
        ("commands of speed", "speed_for_command"), ("changes of the goal", "speed_for_command"),
    ],
)  # fmt: skip
def test_free_motion_shows_what_happened_within_a_trial(fault, code):
    world, rng = free_world()
    assert code not in healthy_codes()
    assert code in codes(recorded(FAULTS[fault][0](world, rng)[1]))


@pytest.mark.parametrize("pause_s", [4.0, slow(1000.0)])
def test_a_gain_that_changes_in_a_pause_is_named_at_the_first_reading_after_it(pause_s):
    def strokes(time):
        return 0.3 * np.sin(7 * time) + 0.1 * np.sin(14 * time + 1)

    trials = []
    for number, gain in enumerate((1.0, 0.5)):
        trial = first_order_trial(
            strokes, 0.02, 0.03, loop_s=0.02, duration_s=6.0, number=number, gain=gain
        )
        start = number * (6.0 + pause_s)
        noise = 1e-3 * np.random.default_rng(number).standard_normal(len(trial.position_rad))
        trials.append(
            replace(
                trial, send_time_s=trial.send_time_s + start, read_time_s=trial.read_time_s + start,
                position_rad=trial.position_rad + noise,
            )
        )  # fmt: skip
    (finding,) = findings(trials)
    assert finding.code == "gain_changed"
    assert finding.values["time_s"] == pytest.approx(6.0 + pause_s, abs=0.1)


def test_windows_that_differ_by_themselves_are_no_drift():
    """Three short trials of one policy: gains of windows from 0.6 to 1.1 in no order."""
    recording = ps.load(real_recording("playback_lstm_25hz.csv"))
    assert not {"gain_drifts", "lag_drifts"} & set(codes(recording, "LB_calf"))


def test_clocks_that_drift_are_no_early_position_and_no_swapped_columns():
    world = draw_world(np.random.default_rng(3), "smart", "walk", 3e-4)
    world = replace(
        world, rate_hz=50.0, poll_s=0.0, friction_rad=0.0, gravity_rad=0.0, duration_s=12.0,
        quantum_rad=0.0015,
    )  # fmt: skip
    table = simulated(world)
    late = np.interp(1.006 * table.read_time_s, table.read_time_s, table.position_rad)
    found = codes(recorded(table.assign(position_rad=late)))
    assert found["lag_drifts"].verdict == REFUSE and len(found) == 1
    assert found["lag_drifts"].values["drift_ms"] == pytest.approx(-6, rel=0.1)


@pytest.mark.slow  # one motion is quick: the test above
@pytest.mark.parametrize("motion", ["prbs", "steps", "tones", "chirp"])
def test_clocks_that_drift_are_found_in_any_motion(motion):
    """All readings together show what the lags of short windows, or of one tone, do not."""
    world = replace(
        draw_world(np.random.default_rng(3), "smart", motion, 3e-4), rate_hz=60.0, poll_s=0.0,
        friction_rad=0.0, gravity_rad=0.0, duration_s=14.0, quantum_rad=0.0015,
    )  # fmt: skip
    table = simulated(world)
    late = np.interp(1.006 * table.read_time_s, table.read_time_s, table.position_rad)
    assert "lag_drifts" in codes(recorded(table.assign(position_rad=late)))
    assert "lag_drifts" not in codes(recorded(table))


def followed_by_a_ramp(command, rate_hz, speed_rad_s, acceleration_rad_s2):
    """Readings of a servo whose set-point ramps to each command, 20 ms late."""
    out, place, rate = np.empty_like(command), command[0], 0.0
    for k, goal in enumerate(command):
        for _ in range(10):
            step, away = 0.1 / rate_hz, goal - place
            wanted = np.sign(away) * min(speed_rad_s, np.sqrt(2 * acceleration_rad_s2 * abs(away)))
            most = acceleration_rad_s2 * step
            rate += min(max(wanted - rate, -most), most)
            place += rate * step
        out[k] = place
    late = round(0.02 * rate_hz)
    return 0.0015 * np.round(np.concatenate([np.full(late, out[0]), out[:-late]]) / 0.0015)


def test_a_set_point_that_ramps_is_a_position_servo():
    """Of a walk of 0.65 rad at 2.2 Hz a ramp of 12 rad/s² leaves a fraction, half a turn late."""
    time = np.arange(0.0, 8.0, 0.01)
    angle = 2 * np.pi * 2.2 * np.maximum(time - 0.4, 0.0)
    command = 0.65 * (0.7 * np.sin(angle) + 0.3 * np.sin(2 * angle))
    position = followed_by_a_ramp(command, 100.0, 5.0, 12.0)
    log = ps.Recording.from_arrays(
        time, {"joint": command}, {"joint": position}, read_time_s=time + 1e-3
    )
    assert not {"unrelated", "not_a_position_servo", "sign_inverted"} & set(codes(log))


@pytest.mark.parametrize("motion", ["teleoperation", slow("steps")])
def test_a_joint_that_falls_for_a_while_is_no_other_servo(motion):
    """A supply that breaks down for two seconds: the joint falls to its stop and comes back."""
    world = replace(
        draw_world(np.random.default_rng(3), "smart", motion, 3e-4), amplitude_rad=0.3,
        rate_hz=80.0, poll_s=0.0, friction_rad=0.0, gravity_rad=0.0, duration_s=14.0,
        quantum_rad=0.0015,
    )  # fmt: skip
    table = simulated(world)
    since = table.read_time_s - 6.0
    fall = np.clip(np.minimum(3 * since, 12 * (2.2 - since)), 0, 1)
    position = table.position_rad * (1 - fall) - (0.6 - world.offset_rad) * fall
    found = codes(recorded(table.assign(position_rad=position)))
    assert len(found) == 1 and set(found) < {"left_path", "frozen"}  # at its stop it rests


def of_a_usual_servo(motion: str, seed: int = 3, **changes):
    """A world of a smart servo at 40 Hz, small and without a poll."""
    world = draw_world(np.random.default_rng(seed), "smart", motion, 3e-4)
    usual = {"amplitude_rad": 0.4, "rate_hz": 40.0, "poll_s": 0.0, "friction_rad": 0.0,
             "gravity_rad": 0.0, "duration_s": 10.0, "quantum_rad": 0.0015}  # fmt: skip
    return replace(world, **(usual | changes))


def test_a_servo_with_limits_explains_a_weak_motor_and_its_changes_are_few():
    """What a limit of the speed leaves of a line is no fault, and nothing is left of the servo."""
    table = simulated(of_a_usual_servo("walk", speed_rad_s=2.0))
    (trial,) = recorded(table).trials("joint")
    joint = followed([trial], 0.0015)
    assert joint.fit.cost < 0.5 * joint.screen[0].cost and joint.changes == []


def test_rests_of_a_joint_count_as_one_reading():
    """Steps from rest to rest: any change explains a few of them, however often they are read."""
    table = simulated(of_a_usual_servo("steps", rate_hz=100.0))
    (trial,) = recorded(table).trials("joint")
    fit = followed([trial], 0.0015).fit
    travel = np.abs(np.diff(fit.path_rad)).sum() / np.ptp(fit.path_rad)
    assert fit.independent <= 8 * travel + 1e-9 < len(table)


def test_a_motion_that_ends_at_a_stop_is_clipped_at_its_level():
    world = of_a_usual_servo("teleoperation", gain=1.0, offset_rad=0.0)
    world = replace(world, stop_rad=(-np.inf, 0.1))
    found = codes(recorded(simulated(world)))
    assert found["clipped"].values["level_rad"] == pytest.approx(0.1, abs=0.01)


@pytest.mark.slow  # tones are quick: `test_later_tones_...`
def test_a_chirp_beyond_the_speed_limit_is_no_change_of_gain_and_no_drift():
    world = draw_world(np.random.default_rng(1), "smart", "chirp", 3e-4)
    world = replace(
        world, amplitude_rad=0.4, speed_rad_s=3.0, bandwidth_hz=8.0, rate_hz=50.0, poll_s=0.0,
        friction_rad=0.0, gravity_rad=0.0, gain=0.9, duration_s=14.0, quantum_rad=0.0015,
    )  # fmt: skip
    assert not {"gain_changed", "lag_drifts"} & set(codes(recorded(simulated(world))))


CASES = {
    "made/C6_sample_sweep_LF_hip_sign_flipped.csv": ("LF_hip", "sign_inverted", REFUSE),
    "made/D1_goal_clamped_by_firmware.csv": ("hip", "clipped", CARE),
    "made/F1_derated_halfway.csv": ("hip", "trials_differ", CARE),
    "made/L4_failed_zero_0.005.csv": ("knee", "bad_readings", CARE),
    "made/L2_sign_bit15.csv": ("knee", "sign_bit", REFUSE),
    "made/L4_foreign.csv": ("knee", "bad_readings", CARE),
    "real/c06b_ankle_two_columns.csv": ("joint", "not_a_position_servo", REFUSE),
}
SOUND = {
    "made/B4_14bit.csv": "hip",
    "made/B6_trials_14bit.csv": "hip",
    "made/L5_freq_no_trial.csv": "knee",
    "real/c01_sine_5hz_said_inverted.csv": "joint",
    "real/c02_mx106_four_sines_no_freq_column.csv": "servo",
    "real/c03_mx106_steps_same_servo.csv": "servo",
    "real/c05_mx106_2hz_quantised.csv": "joint",
    "real/c07_mx106_telemetry_takes_ticks.csv": "joint",
}
LONG = {  # beside shorter ones of the same kind
    "made/L4_failed_zero_0.005.csv", "real/c06b_ankle_two_columns.csv", "made/B6_trials_14bit.csv",
    "made/L5_freq_no_trial.csv", "real/c02_mx106_four_sines_no_freq_column.csv",
}  # fmt: skip


@pytest.mark.parametrize("name", [slow(n) if n in LONG else n for n in CASES])
def test_the_fault_of_a_stranger_s_log_is_named(name):
    joint, code, verdict = CASES[name]
    found = codes(ps.load(case(name)), joint)
    assert code in found and found[code].verdict == verdict


@pytest.mark.parametrize("name", [slow(n) if n in LONG else n for n in SOUND])
def test_a_stranger_s_sound_log_is_not_accused(name):
    assert set(codes(ps.load(case(name)), SOUND[name])) & set(ACCUSING) == set()


def test_the_bit_of_the_sign_is_found_wherever_the_zero_is():
    found = codes(ps.load(case("made/L2_sign_bit15.csv")), "knee")["sign_bit"]
    assert found.values["bit"] == 15


WRITERS = {  # that replace commands by chance, write every second or two, and at 8 Hz
    "by chance": lambda rng: {"writer_share": 0.05},
    "now and then": lambda rng: {"times_s": 0.5 + np.cumsum(rng.uniform(0.5, 2.0, 30))},
    "at its rate": lambda rng: {"times_s": np.arange(0.3, 15.0, 0.125)},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["teleoperation", "multisine", "walk", "steps"])
@pytest.mark.parametrize("writes", WRITERS)
def test_pushes_towards_one_goal_are_a_second_writer(motion, writes):
    """Of servos that another program commands as well, and of the same alone."""
    named, accused = 0, 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        world = replace(
            draw_world(rng, "hobby", motion, 3e-4), rate_hz=60.0, poll_s=0.0, friction_rad=0.0,
            amplitude_rad=0.4, quantum_rad=0.0015, duration_s=15.0,
        )  # fmt: skip
        changes = WRITERS[writes](rng)
        share = changes.pop("writer_share", 0.0)
        disturbed = replace(world, writer_share=share, values={"home": 0.2} | changes)
        named += "second_writer" in codes(recorded(simulated(disturbed)))
        accused += "second_writer" in codes(recorded(simulated(world)))
    assert named >= 2 and accused == 0  # some writes come right before the next command


def test_later_tones_beyond_the_speed_limit_are_no_change_of_gain_and_no_drift():
    """Of 0.5 rad at 8 Hz, 25 rad/s, a servo of 4 rad/s follows a sixth."""
    world = draw_world(np.random.default_rng(1), "smart", "tones", 3e-4)
    world = replace(
        world, amplitude_rad=0.5, speed_rad_s=4.0, bandwidth_hz=10.0, rate_hz=80.0, poll_s=0.0,
        friction_rad=0.0, gravity_rad=0.0, gain=0.9, duration_s=11.0, quantum_rad=0.0015,
    )  # fmt: skip
    assert not {"gain_changed", "lag_drifts"} & set(codes(recorded(simulated(world))))


@pytest.mark.slow
def test_tones_that_do_not_repeat_are_disturbed():
    (found,) = ps.examine(ps.load(case("made/W3_esp32_second_writer_5pc.csv"))).values()
    (uneven,) = (f for f in found.findings if f.code == "unrepeatable")
    assert uneven.verdict == CARE and "second writer" in uneven.text
    sound = ps.examine(ps.load(case("made/L5_freq_no_trial.csv")))
    assert not any(f.code == "unrepeatable" for j in sound.values() for f in j.findings)


def polled_tone(rate_hz, period_rows, step, seed):
    """Rows of a tone whose readings are those of a poll, or live for a period of 0."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 10, 1 / rate_hz)
    period = period_rows / rate_hz
    read = np.floor((time - rng.uniform(0, 1)) / period) * period if period_rows else time
    hz, amplitude = rng.uniform(1, 3), rng.uniform(0.2, 0.6)
    position = amplitude * np.sin(2 * np.pi * hz * (read - 0.03))
    return ps.Recording.from_arrays(
        time, {"joint": amplitude * np.sin(2 * np.pi * hz * time)},
        {"joint": step * np.round(position / step)}, read_time_s=time,
    ).trials("joint")  # fmt: skip


def test_readings_that_are_new_wherever_the_joint_must_have_moved_are_live():
    """A poll of 1.25 loops or longer repeats one reading in five; none is called live."""
    kinds = {
        period: [staleness(polled_tone(100, period, 0.0015, n)).kind for n in range(6)]
        for period in (0, 1.3, 2.0, 3.4)
    }
    assert kinds.pop(0).count("live") >= 5
    assert all("live" not in each for each in kinds.values()), kinds
    measured = named_tones(ps.load(case("real/c05_mx106_2hz_quantised.csv")).trials("joint"))
    assert staleness(measured).kind == "live"


def test_the_moment_and_the_level_of_a_fault_are_those_of_the_case():
    clamped = codes(ps.load(case("made/D1_goal_clamped_by_firmware.csv")), "hip")["clipped"]
    assert abs(clamped.values["level_rad"]) == pytest.approx(0.2, abs=0.01)


@pytest.mark.slow
def test_a_torque_that_fades_is_named_with_its_trend_and_no_clock_is_blamed():
    """Torque falls to 60 %: the natural frequency to √0.6 of what it was."""
    world = draw_world(np.random.default_rng(3), "hobby", "walk", 3e-4)
    world = replace(
        world, rate_hz=100.0, poll_s=0.0, friction_rad=0.0, gravity_rad=0.0, amplitude_rad=0.4,
        quantum_rad=0.0015, duration_s=15.0, bandwidth_hz=5.0, values={
            "torque": ([0.0, 15.0], [1.0, 0.6])},
    )  # fmt: skip
    found = codes(recorded(simulated(world)))
    assert set(found) == {"torque_fades"}
    values = found["torque_fades"].values
    assert values["percent"] == pytest.approx(-40, abs=8)
    assert values["before_hz"] == pytest.approx(5.0, rel=0.15)
    assert values["after_hz"] == pytest.approx(5.0 * np.sqrt(0.6), rel=0.15)


@pytest.mark.slow
def test_a_joint_that_is_held_several_times_is_away_as_often():
    world = draw_world(np.random.default_rng(3), "hobby", "walk", 3e-4)
    holds = [(3.0, 4.0), (7.0, 7.8), (11.0, 12.0)]
    clock = np.ravel([(a - 1e-4, a, b, b + 1e-4) for a, b in holds])
    world = replace(
        world, rate_hz=100.0, poll_s=0.0, friction_rad=0.0, amplitude_rad=0.4, quantum_rad=0.0015,
        duration_s=15.0, values={"torque": (clock, np.tile([1.0, 0.0, 0.0, 1.0], 3))},
    )  # fmt: skip
    found = codes(recorded(simulated(world)))["left_path"]
    assert found.values["times"] == 3
    assert found.values["time_s"] == pytest.approx(3.0, abs=0.1)
    assert found.values["longest_s"] == pytest.approx(1.0, abs=0.15)
