"""Live, stale or cannot tell: repeats in the midst of motion are the bus's, others are not."""

import ast
import csv

import numpy as np
import pytest
from scipy.signal import lfilter

from pupper_sysid.sysid.doctor.examination import examine
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice, readings
from pupper_sysid.sysid.feedback.slips import find_lost_commands, without_commands
from pupper_sysid.sysid.feedback.staleness import episodes, quantum, staleness
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording, Trial
from support.real_recordings import real_recording

COUNT = 2 * np.pi / 4096
TIME = 0.02 * np.arange(600)
WAVE = 0.5 * np.sin(2 * np.pi * 0.7 * TIME)


def trial(command, position, time=TIME) -> Trial:
    return Trial("LF_hip", 0, 0.7, time, time, command, np.asarray(position), None, 0.0)


def whole(position):
    """Readings in counts."""
    return COUNT * np.round(position / COUNT)


def sticking(command, play=0.08):
    """A joint that follows its command once that leads by `play`, and stays where it is till then.

    It stands at every reversal, as friction makes it.
    """
    position = np.empty(len(command))
    here = command[0]
    for k, c in enumerate(command):
        here = float(np.clip(here, c - play, c + play))
        position[k] = here
    return position


def polled(position, every=3):
    """Every third value, shown until the next one."""
    return np.repeat(position[::every], every)[: len(position)]


def test_a_joint_that_sticks_at_reversals_is_live_and_dated_at_its_reads_though_readings_repeat():
    position = whole(sticking(WAVE))
    assert np.mean(np.diff(position) == 0) > 0.2
    stuck = trial(WAVE, position)
    found = staleness([stuck])
    assert (found.kind, found.episodes_with_repeat, found.repeat_share) == ("live", 0, 0.0)
    lattice = find_poll_lattice([stuck], np.random.default_rng(0))
    assert lattice.kind == "every read"
    np.testing.assert_array_equal(readings(stuck, lattice).time_s, TIME)
    recording = Recording.from_arrays(
        TIME, {"LF_hip": WAVE}, {"LF_hip": position}, frequency_hz=0.7
    )
    joint = examine(recording)["LF_hip"]
    assert joint.feedback is not None and joint.feedback.kind == "every read"
    assert not [r for r in joint.reasons if "fail" in r or "poll" in r or "new reading" in r]


def test_a_servo_polled_every_third_row_is_stale_and_two_of_three_readings_repeat():
    found = staleness([trial(WAVE, polled(whole(sticking(WAVE))))])
    assert found.kind == "stale" and found.episodes_with_repeat == found.episodes
    assert found.repeat_share == pytest.approx(2 / 3)


def test_constant_or_few_readings_tell_nothing_and_missing_ones_and_an_offset_change_nothing():
    few = trial(WAVE[:12], WAVE[:12] - 0.1, TIME[:12])
    gone, stuck = np.random.default_rng(0).random(600) < 0.1, whole(sticking(WAVE))
    for trials, kind in (
        ([trial(WAVE, np.full(600, 0.3))], "cannot tell"), ([few], "cannot tell"),
        ([], "cannot tell"), ([trial(WAVE, np.full(600, np.nan))], "cannot tell"),
        ([trial(WAVE, np.where(gone, np.nan, stuck))], "live"),
        ([trial(WAVE, np.where(gone, np.nan, polled(stuck)))], "stale"),
    ):  # fmt: skip
        assert staleness(trials).kind == kind
    here, there = staleness([trial(WAVE, stuck)]), staleness([trial(WAVE, stuck + 0.8)])
    assert (there.kind, there.repeat_share) == (here.kind, here.repeat_share)
    assert there.episodes == pytest.approx(here.episodes, rel=0.05)


def test_a_joint_that_moves_less_than_a_count_per_row_is_not_stale():
    time = 0.002 * np.arange(6000)
    command = 0.1 * np.sin(2 * np.pi * 0.5 * time)
    slow = whole(sticking(command, 0.02))
    assert np.mean(np.diff(slow) == 0) > 0.5
    assert staleness([trial(command, slow, time)]).kind in ("live", "cannot tell")


def test_episodes_are_counted_by_hand():
    # steps of 1 each, the value 3 is read twice; the command leads by 5
    position = np.array([0.0, 1.0, 2.0, 3.0, 3.0, 4.0, 5.0, 6.0])
    # values 1 to 4 lie between steps in one direction; the rates beside 3 are those of 2 and 4
    assert episodes(position + 5, position, 0.4).tolist() == [0, 0, 1, 0]
    # mirrored, it is the same; a command that does not lead proves nothing
    assert episodes(-position - 5, -position, 0.4).tolist() == [0, 0, 1, 0]
    assert episodes(position + 0.5, position, 0.4).tolist() == []
    # steps below the smallest that is motion do not count
    assert episodes(position + 5, position, 1.5).tolist() == []


def test_the_quantisation_step_is_found_in_a_file_of_few_decimals_and_not_where_there_is_none():
    for decimals in (4, 6, 9):
        written = np.round(whole(sticking(WAVE)), decimals)
        assert quantum([trial(WAVE, written)]) == pytest.approx(COUNT, rel=1e-3)
    assert quantum([trial(WAVE, sticking(WAVE))]) == 0.0


def test_the_real_sweeps_of_a_polled_robot_are_stale(real_sweeps):
    for path in real_sweeps:
        recording = load(path)
        for joint in recording.joints:
            assert staleness(recording.trials(joint)).kind == "stale"


def test_a_real_arm_on_a_direct_bus_is_never_stale():
    columns = {}
    for name in ("control", "state_motor"):
        with real_recording(f"sage_so101/frequency_sweep/{name}.csv").open() as file:
            rows = list(csv.DictReader(file))
        columns[name] = np.array([ast.literal_eval(r["positions"]) for r in rows])
    rows = min(len(c) for c in columns.values())
    time = 0.02006 * np.arange(rows)
    found = [
        staleness([trial(columns["control"][:rows, k], columns["state_motor"][:rows, k], time)])
        for k in range(6)
    ]
    assert "stale" not in {f.kind for f in found}
    assert [f.kind for f in found].count("live") >= 4


# ----- lost commands are found from the readings behind them; slips of the model are not

LOOP, NOISE = 0.02, 0.005
TIME_S = LOOP * np.arange(150)
COMMAND = 0.3 * np.sin(2 * np.pi * 4 * TIME_S)


def test_values_that_repeat_between_steps_of_noise_are_stale():
    """The noise hides the motion, in which `episodes` looks for repeats."""
    rng = np.random.default_rng(8)
    time = 0.019 * np.arange(900)
    command = 0.1 * np.sin(2 * np.pi * 1.3 * time)

    def kind(read_s) -> str:
        position = 0.1 * np.sin(2 * np.pi * 1.3 * (read_s - 0.05))
        noise = dict(zip(np.unique(read_s), 0.02 * rng.standard_normal(900), strict=False))
        position = 0.0015 * np.round((position + [noise[t] for t in read_s]) / 0.0015)
        return staleness([Trial("LF_hip", 0, 1.3, time, time, command, position, None, 0.0)]).kind

    assert kind(0.024 * np.floor(time / 0.024)) == "stale"
    assert kind(time) != "stale"


def servo(command):
    """First-order lag of 30 ms behind two rows of dead time."""
    late = np.concatenate([np.zeros(2), command[:-2]])
    return lfilter([0.5], [1, -0.5], late)


def trial_of_lost_commands(command=COMMAND):
    return Trial("LF_hip", 3, 4.0, TIME_S + 7, TIME_S + 7, command, np.zeros(150), None, 0.0)


def search(position, scale=NOISE):
    """Lost commands, where every row has a fresh reading."""
    return find_lost_commands(
        trial_of_lost_commands(), TIME_S + 7, scale,
        lambda command, readings: (servo(command) - position)[:readings],
    )  # fmt: skip


def test_lost_commands_are_found_with_their_time_and_number():
    for row, rows in ((62, 1), (75, 2), (87, 3)):
        lost = servo(without_commands(trial_of_lost_commands(), row, rows))
        noise = NOISE * np.random.default_rng(row).standard_normal(150)
        (found,) = search(lost + noise)
        assert (found.trial, found.commands) == (3, rows)
        assert found.time_s == pytest.approx(LOOP * row) and found.nats > 10
        # the readings it moves, and no others, are left out
        moved = np.flatnonzero(np.abs(lost - servo(COMMAND)) > NOISE / 2)
        assert found.readings == tuple(moved)


def test_two_losses_of_a_trial_are_told_apart():
    command = without_commands(trial_of_lost_commands(), 50, 2)
    command = without_commands(trial_of_lost_commands(command), 100, 2)
    found = search(servo(command))
    assert [(u.time_s, u.commands) for u in found] == [
        (pytest.approx(1.0), 2), (pytest.approx(2.0), 2)
    ]  # fmt: skip


def test_noise_knocks_and_wild_readings_are_no_lost_commands():
    for seed in range(5):
        noise = NOISE * np.random.default_rng(seed).standard_t(4, 150)
        assert search(servo(COMMAND) + noise) == [], seed
    knocked, wild = servo(COMMAND), servo(COMMAND)
    knocked[70:74] += 0.2 * np.array([1, -1, 1, -1])  # no lost command explains it
    wild[70] += 0.3
    assert search(knocked) == [] == search(wild)
