"""Lost commands are found from the readings behind them; slips of the model are not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from pupper_sysid.sysid.feedback.upsets import find_upsets, without_commands
from pupper_sysid.sysid.recordings.recording import Trial

LOOP, NOISE = 0.02, 0.005
TIME = LOOP * np.arange(150)
COMMAND = 0.3 * np.sin(2 * np.pi * 4 * TIME)


def servo(command):
    """First-order lag of 30 ms behind two rows of dead time."""
    late = np.concatenate([np.zeros(2), command[:-2]])
    return lfilter([0.5], [1, -0.5], late)


def trial(command=COMMAND):
    return Trial("LF_hip", 3, 4.0, TIME + 7, TIME + 7, command, np.zeros(150), None, 0.0)


def search(position, scale=NOISE):
    """Upsets of readings of every row."""
    return find_upsets(trial(), TIME + 7, scale, lambda command: servo(command) - position)


def test_lost_commands_are_found_with_their_time_and_number():
    for row, rows in ((62, 1), (75, 2), (87, 3)):
        lost = servo(without_commands(trial(), row, rows))
        noise = NOISE * np.random.default_rng(row).standard_normal(150)
        (found,) = search(lost + noise)
        assert (found.trial, found.commands) == (3, rows)
        assert found.time_s == pytest.approx(LOOP * row) and found.nats > 10
        # the readings it moves, and no others, are left out
        moved = np.flatnonzero(np.abs(lost - servo(COMMAND)) > NOISE / 2)
        assert found.readings == tuple(moved)


def test_two_upsets_of_a_trial_are_told_apart():
    command = without_commands(trial(), 50, 2)
    command = without_commands(trial(command), 100, 2)
    found = search(servo(command))
    assert [(u.time_s, u.commands) for u in found] == [
        (pytest.approx(1.0), 2), (pytest.approx(2.0), 2)
    ]  # fmt: skip


def test_noise_knocks_and_wild_readings_are_no_upsets():
    for seed in range(5):
        noise = NOISE * np.random.default_rng(seed).standard_t(4, 150)
        assert search(servo(COMMAND) + noise) == [], seed
    knocked, wild = servo(COMMAND), servo(COMMAND)
    knocked[70:74] += 0.2 * np.array([1, -1, 1, -1])  # no lost command explains it
    wild[70] += 0.3
    assert search(knocked) == [] == search(wild)
