"""Recordings in which something is wrong give no number without a warning."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import pupper_sysid as ps
from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.doctor.checks import cautions, findings, refuse_unusable
from pupper_sysid.sysid.lag.lag_budget import lag_budget
from support.garbage import GARBAGE, good, spoilt
from support.made_recordings import JOINT, KINDS, USUAL_SERVO, Setup, good_recording, made, record
from support.refusals import assert_each_refused


def verdict(recording) -> str:
    """The worst verdict of a recording's joints, and the refusal or warnings that belong to it."""
    trials = {j: tuple(recording.trials(j)) for j in recording.joints}
    try:
        refuse_unusable(trials)
    except InputError as refused:
        joint, _, reason = str(refused).partition(": ")
        assert joint in trials and len(reason) > 60  # where, what, what to do
        return "do not use"
    return "use with care" if any(cautions(j, t) for j, t in trials.items()) else "use"


@pytest.mark.parametrize(
    "part", [0, *(pytest.param(part, marks=pytest.mark.slow) for part in range(1, 24))]
)
def test_no_number_of_garbage_without_a_warning(part):
    """Every 24th fault quickly; all with the slow tests."""
    problems = []
    for number, (name, fault) in list(enumerate(GARBAGE.items()))[part::24]:
        try:
            recording = spoilt(name, np.random.default_rng([3, number]))
        except InputError as refused:  # as it is read
            assert str(refused).startswith("made")
            continue
        found = verdict(recording)
        if found != "do not use" and (fault.refused or found != "use with care"):
            problems.append((name, found))
    assert not problems


@pytest.mark.parametrize(
    "kind",
    [k if k == "teleoperation" else pytest.param(k, marks=pytest.mark.slow) for k in KINDS],
)
def test_good_recordings_that_are_spoilt_above_are_for_use(kind):
    assert findings(made(good(kind)).trials(JOINT)) == []


@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 8), marks=pytest.mark.slow)])
def test_good_recordings_of_random_servos_are_for_use(seeds):
    found = []
    for seed in seeds:
        recording = good_recording(np.random.default_rng([11, seed]))
        found += [f.verdict for f in findings(recording.trials(JOINT)) if f.verdict != "use"]
    assert found == []  # of 329 good joints one asked for care


@pytest.mark.parametrize(
    ("rate", "step"),
    [(150.0, 0.0057), pytest.param(150.0, 0.012, marks=pytest.mark.slow), (32.0, 0.0015)],
)
def test_an_echo_is_seen_whether_its_steps_are_coarse_or_not_even_found(rate, step):
    # 0.09 rad at 4 Hz: 15 mrad a row at 150 Hz, so that each row moves by three steps at most
    setup = Setup(USUAL_SERVO, rate, amplitude_rad=0.09 if rate > 100 else 0.5,
                  frequencies_hz=(2.0, 4.0), trial_s=2.0)  # fmt: skip
    rows = record(setup, np.random.default_rng(1)).table.drop(columns="joint")
    late = rows.groupby("trial")["command_rad"].shift(2).fillna(0.0)
    echo = made(rows.assign(position_rad=step * np.round(late / step)))
    assert verdict(echo) == "do not use"
    servo = made(rows.assign(position_rad=step * np.round(rows.position_rad / step)))
    assert verdict(servo) == "use"


def test_readings_stamped_rows_before_their_commands_ask_for_care():
    slow = replace(USUAL_SERVO, dead_time_s=0.237, stiffness=600.0)
    rows = record(Setup(slow, 50.0), np.random.default_rng(2)).table.drop(columns="joint")
    assert verdict(made(rows)) == "use"
    # less than the servo's own lag, so that cause and effect keep their order
    early = made(rows.assign(read_time_s=rows.read_time_s - 0.15))
    assert verdict(early) == "use with care"
    (text,) = cautions(JOINT, early.trials(JOINT))
    assert "stamped 148 ms before" in text  # each row is read 2 ms after it is sent
    # a loop that reads first and then sends is one turn early
    assert verdict(made(rows.assign(read_time_s=rows.read_time_s - 0.02))) == "use"


def test_what_the_doctor_refuses_every_function_refuses_with_its_sentence():
    recording = spoilt("echo one row late", np.random.default_rng(0))
    (reason,) = ps.examine(recording)[JOINT].reasons
    functions = (ps.lag, ps.calibrate, ps.frequency_response, ps.fit_servo, ps.sparse_equations)
    assert_each_refused(
        [(function, f"{JOINT}: {reason}") for function in functions], lambda use: use(recording)
    )


def test_a_joint_beside_a_bad_one_can_be_chosen():
    table = good("teleoperation")
    both = [table.assign(joint="LF_hip"), table.assign(joint="LF_thigh", position_rad=0.1)]
    recording = made(pd.concat(both, ignore_index=True))
    with pytest.raises(InputError, match=r"LF_thigh: .*leave the joint out of `joints`"):
        ps.frequency_response(recording)
    with pytest.raises(InputError, match="LF_hip: this recording has no tone"):
        ps.frequency_response(recording, "LF_hip")


def test_what_asks_for_care_is_a_warning_of_every_number():
    recording = spoilt("clock steps of 1 s", np.random.default_rng(0))
    trials = tuple(recording.trials(JOINT))
    wanted = cautions(JOINT, trials)
    assert any("stood still 3 times" in text for text in wanted)
    examined = ps.examine(recording)[JOINT]
    assert examined.verdict == "use with care"
    assert {f"{JOINT}: {reason}" for reason in examined.reasons} >= set(wanted)
    # what lag and calibrate both begin with
    assert set(lag_budget(JOINT, trials, np.random.default_rng(0)).warnings) >= set(wanted)
    assert set(ps.frequency_response(recording)[JOINT].warnings) >= set(wanted)


def test_times_of_another_unit_cost_no_memory():
    recording = spoilt("times in ns", np.random.default_rng(0))
    tracemalloc.start()
    assert ps.examine(recording)[JOINT].verdict == "do not use"
    with pytest.raises(InputError, match="seconds: divide them"):
        ps.lag(recording)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 50e6


def test_a_resolved_poll_asks_for_no_care_and_its_consequence_is_told_once(hip):
    found = ps.examine(ps.load(hip), "LF_hip")
    (joint,) = found.values()
    assert joint.verdict == "use"
    assert "the bus reads each servo every" in " ".join(joint.reasons)
    assert "Do not compute lag" in found.advice[0] and "Do not" not in " ".join(joint.reasons)


NAN, HUGE = float("nan"), 1e99


def test_every_entry_of_the_header_that_is_computed_with_is_checked():
    cases = [
        ({"start_pose_rad": {JOINT: NAN}}, "start_pose_rad.LF_hip"),
        ({"start_pose_rad": {JOINT: HUGE}}, "start_pose_rad.LF_hip"),
        ({"start_pose_rad": {JOINT: 10**400}}, "start_pose_rad.LF_hip"),
        ({"start_pose_rad": {JOINT: [1.0]}}, "start_pose_rad.LF_hip"),
        ({"start_pose_rad": [1.0]}, "start_pose_rad"),
        ({"bus": {"count_zero_rad": {JOINT: NAN}}}, "bus.count_zero_rad.LF_hip"),
        ({"bus": {"count_zero_rad": {JOINT: HUGE}}}, "bus.count_zero_rad.LF_hip"),
        ({"bus": {"command_quantum_rad": NAN}}, "bus.command_quantum_rad"),
        ({"bus": {"command_quantum_rad": HUGE}}, "bus.command_quantum_rad"),
        ({"bus": {"command_quantum_rad": -0.001}}, "bus.command_quantum_rad"),
        ({"bus": {"command_quantum_rad": 1e-300}}, "bus.command_quantum_rad"),
        ({"bus": {"command_quantum_rad": {JOINT: {"a": 1}}}}, "bus.command_quantum_rad"),
        ({"bus": {"speed_limit_rad_s": 0.0}}, "bus.speed_limit_rad_s"),
        ({"bus": {"speed_limit_rad_s": float("inf")}}, "bus.speed_limit_rad_s"),
        ({"bus": {"read_time_doubt_s": -1.0}}, "bus.read_time_doubt_s"),
        ({"bus": [1]}, "bus"),
        ({"read_after_send_s": 1e9}, "read_after_send_s"),
    ]
    cases = [(header, f"made, header: {place} ") for header, place in cases]
    assert_each_refused(cases, lambda header: made(good(), **header))
    columns = [
        (("trial", 0.5), "whole numbers"), (("trial", 1e99), "whole numbers"),
        (("position_count", 1e18), "position_count"),
    ]  # fmt: skip
    assert_each_refused(columns, lambda case: made(good().assign(**dict([case]))))


def test_a_start_pose_that_is_not_where_the_joint_stands_is_told():
    (caution,) = cautions(JOINT, made(good(), start_pose_rad={JOINT: 2.0}).trials(JOINT))
    assert "`start_pose_rad` is 2.00" in caution


def test_the_bend_of_a_loaded_joint_on_a_single_way_is_no_motion_before_the_command():
    time = 0.01 * np.arange(300)
    command = 0.75 * (1 - np.cos(np.pi * time / 3.0))  # a lift, from rest to rest
    late = np.interp(time - 0.05, time, command)
    sagging = 0.9 * late - 0.25 * late**2  # the load pulls more, the higher the arm
    rows = pd.DataFrame({"send_time_s": time, "command_rad": command, "position_rad": sagging})
    trials = made(rows).trials(JOINT)
    assert [f for f in findings(trials) if f.verdict == "do not use"] == []


def test_a_recording_that_is_given_twice_is_refused():
    with pytest.raises(InputError, match="same readings, which would count twice"):
        ps.calibrate([made(good("teleoperation")) for _ in range(2)])
