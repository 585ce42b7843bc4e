"""Tones are found in a command, and nothing else is taken for one."""

from dataclasses import replace

import numpy as np
import pytest

import pupper_sysid as ps
from pupper_sysid.sysid.doctor.checks import joint_trials
from pupper_sysid.sysid.recordings.excitation import describe, named_tones, segments, split_tones
from pupper_sysid.sysid.recordings.recording import Trial
from support.real_recordings import FOLDER
from support.synthetic import LOOP_S, tone_trials

NAN = float("nan")
CASES = FOLDER.parent / "cases"


def trial(time: np.ndarray, command: np.ndarray) -> Trial:
    return Trial("hip", 0, NAN, time, time + 1e-3, command, command, None, float(command[0]))


def clock(rate_hz: float, duration_s: float, rng: np.random.Generator) -> np.ndarray:
    rows = int(rate_hz * duration_s)
    return np.cumsum((1 + 0.02 * rng.standard_normal(rows)) / rate_hz)


def stepped(time: np.ndarray, tones: list[float], rest_s: float) -> np.ndarray:
    """One tone after the other, smaller and smaller, with a rest in front of each."""
    command, each = np.zeros_like(time), time[-1] / len(tones)
    for n, hz in enumerate(tones):
        start = n * each + rest_s
        inside = (time >= start) & (time < (n + 1) * each)
        command[inside] = np.sin(2 * np.pi * hz * (time[inside] - start)) / (1 + 0.2 * n)
    return command


@pytest.mark.parametrize("rate_hz", [25.0, 200.0])
@pytest.mark.parametrize("rest_s", [0.0, 0.4])
@pytest.mark.parametrize("counts", [0, 40])
def test_tones_in_turn_are_found_with_their_frequencies(rate_hz, rest_s, counts):
    time = clock(rate_hz, 16.0, np.random.default_rng(1))
    command = stepped(time, [0.8, 1.7, 3.1, 4.6], rest_s)
    command = np.round(counts * command) / counts if counts else command
    found = split_tones(trial(time, 0.3 * command))
    assert [t.frequency_hz for t in found] == pytest.approx([0.8, 1.7, 3.1, 4.6], rel=0.01)
    # a simulation starts at rest: tones that follow one another directly stay in one trial
    assert len(named_tones([trial(time, command)])) == (4 if rest_s else 1)


def not_tones(time: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    end, level = time[-1], rng.uniform(-1, 1, 200)
    growth = np.log(20.0) / end
    wander = np.outer(time, rng.uniform(0.1, 1.5, 6)) * 2 * np.pi + rng.uniform(0, 6, 6)
    return {
        "chirp": np.sin(2 * np.pi * (0.3 * time + 3 / end * time**2)),
        "logarithmic chirp": np.sin(2 * np.pi * 0.3 * np.expm1(growth * time) / growth),
        "steps": level[(time / 0.7).astype(int)],
        "random binary": np.sign(level)[(time / 0.2).astype(int)],
        "square wave": np.sign(np.sin(2 * np.pi * 0.9 * time)),
        "triangle": np.abs((1.2 * time) % 2 - 1),
        "gait": np.maximum(np.sin(2 * np.pi * 1.4 * time), 0.0),
        "teleoperation": np.sin(wander).sum(axis=1),
        "multisine": np.sin(2 * np.pi * np.outer(time, [0.7, 1.3, 2.9])).sum(axis=1),
        "rest": np.zeros_like(time),
    }  # fmt: skip


@pytest.mark.parametrize("rate_hz", [30.0, 250.0])
def test_other_motion_is_left_whole(rate_hz):
    rng = np.random.default_rng(2)
    time = clock(rate_hz, 12.0, rng)
    whole = {name: trial(time, 0.3 * c) for name, c in not_tones(time, rng).items()}
    assert [name for name, t in whole.items() if split_tones(t) != [t]] == []
    kinds = {name: {s.kind for s in segments(t)} for name, t in whole.items()}
    for name in ("steps", "random binary", "square wave"):
        assert kinds[name] == {"steps"}, name
    assert kinds["chirp"] == kinds["logarithmic chirp"] == {"chirp"}
    assert describe([whole["teleoperation"]]) == {"free": []}


def test_lags_of_unnamed_tones_are_those_of_named_ones():
    """The named trials one after the other, in one trial and without a frequency."""
    rng = np.random.default_rng(3)
    named = tone_trials(0.04, rng, (1.0, 2.0, 4.0), period_s=0.0, noise_rad=1e-3, duration_s=4.0)
    rest = np.zeros(round(0.5 / LOOP_S))
    times, commands, positions, start = [], [], [], 0.0
    for t in named:
        time = start + LOOP_S * np.arange(len(rest) + len(t.command_rad))
        times.append(time)
        commands.append(np.concatenate([rest, t.command_rad]))
        positions.append(np.concatenate([rest, t.position_rad]))
        start = time[-1] + LOOP_S
    sent = np.concatenate(times)
    header = {"readings": "live"}
    read = dict(read_time_s=sent + 0.0005, metadata=header)
    one = ps.Recording.from_arrays(
        sent, {"hip": np.concatenate(commands)}, {"hip": np.concatenate(positions)}, **read
    )
    numbers = np.repeat(np.arange(3), [len(t) for t in times])
    three = ps.Recording.from_arrays(
        sent, {"hip": np.concatenate(commands)}, {"hip": np.concatenate(positions)},
        trial=numbers, frequency_hz=np.array([1.0, 2.0, 4.0])[numbers], **read,
    )  # fmt: skip
    assert len(joint_trials(one, "hip")) == 3
    found, wanted = (ps.frequency_response(r)["hip"] for r in (one, three))
    assert found.frequency_hz == pytest.approx(wanted.frequency_hz, rel=1e-5)
    lags = [np.angle(r.response) / (2 * np.pi * r.frequency_hz) for r in (found, wanted)]
    assert lags[0] == pytest.approx(lags[1], abs=1e-4)
    assert found.gain == pytest.approx(wanted.gain, rel=2e-3)


def test_a_sine_and_four_sines_of_strangers_are_read_by_frequency():
    """Gain and lag of the first by a sine fit; lags of the second by the same for each tone."""
    if not CASES.is_dir():
        pytest.skip("the cases are not here")
    sine = ps.frequency_response(ps.load(CASES / "real/c01_sine_5hz_said_inverted.csv"))["joint"]
    assert sine.gain == pytest.approx([0.749], abs=0.01)
    assert sine.phase_deg == pytest.approx([-52.3], abs=2.0)  # half a row is 1.8°
    four = ps.frequency_response(ps.load(CASES / "real/c02_mx106_four_sines_no_freq_column.csv"))
    tones = four["servo"]
    assert tones.frequency_hz == pytest.approx([0.25, 0.5, 1, 2], rel=0.01)
    lags_ms = -tones.phase_deg / 360 / tones.frequency_hz * 1e3
    assert lags_ms == pytest.approx([27.4, 23.7, 19.4, 15.5], abs=0.7)


def slow_answer(trial_time: np.ndarray, command: np.ndarray) -> np.ndarray:
    """A joint that follows its command with a time constant of 80 ms."""
    position, lag = np.empty_like(command), 0.08
    position[0] = command[0]
    for n in range(1, len(command)):
        share = 1 - np.exp(-(trial_time[n] - trial_time[n - 1]) / lag)
        position[n] = position[n - 1] + share * (command[n - 1] - position[n - 1])
    return position


def test_tones_are_cut_where_the_joint_has_come_to_rest():
    # the command rests at once, the joint half a second later
    time = clock(200.0, 16.0, np.random.default_rng(1))
    command = stepped(time, [1.0, 2.1, 3.3], 1.2)
    rested = replace(trial(time, command), position_rad=slow_answer(time, command))
    parts = named_tones([rested])
    assert [round(part.frequency_hz, 1) for part in parts] == [1.0, 2.1, 3.3]
    for part in parts:
        assert abs(part.position_rad[0]) < 0.01
    hurried = stepped(time, [1.0, 2.1, 3.3], 0.2)
    moving = replace(trial(time, hurried), position_rad=slow_answer(time, hurried))
    assert len(named_tones([moving])) == 1
