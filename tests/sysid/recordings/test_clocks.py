"""Clocks of commands and readings that drift apart: seen in the stamps, taken out of the dates."""

import numpy as np
import pytest

import pupper_sysid as ps
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice
from pupper_sysid.sysid.lag.lag_budget import lag_budget

PERIOD_S, LAG_S = 0.01, 0.06
SENT_S = PERIOD_S * np.arange(1800)


def recording(later_s: np.ndarray | float, seed: int = 0) -> ps.Recording:
    """A joint that follows 60 ms late, read 2 to 3 ms after the command and stamped `later_s`."""
    rng = np.random.default_rng(seed)
    read_s = SENT_S + 0.0025 + 0.0005 * rng.uniform(-1, 1, len(SENT_S))

    def motion(time_s):
        return 0.3 * np.sin(2 * np.pi * 0.7 * time_s) + 0.2 * np.sin(2 * np.pi * 1.9 * time_s)

    return ps.Recording.from_arrays(
        SENT_S, {"pan": motion(SENT_S)}, {"pan": motion(read_s - LAG_S)},
        read_time_s=read_s + later_s, metadata={"readings": "live"},
    )  # fmt: skip


def test_readings_on_a_clock_that_drifts_are_dated_by_that_of_the_commands():
    (trial,) = recording(1e-3 * SENT_S).trials("pan")
    assert trial.clock_drift == pytest.approx(1e-3, rel=0.02)
    assert np.abs(trial.read_time_s - SENT_S - 0.0025).max() < 1e-3
    rng = np.random.default_rng(0)
    lag = lag_budget("pan", (trial,), rng, find_poll_lattice((trial,), rng)).lag_s
    # the command is held for half a turn on average before it is renewed
    assert lag.low <= LAG_S - PERIOD_S / 2 <= lag.high and lag.high - lag.low < 6 * PERIOD_S


def test_the_doctor_names_the_drift_and_the_doubt():
    findings = ps.examine(recording(-1e-3 * SENT_S)).joints["pan"].findings
    (drift,) = [f for f in findings if f.code == "clocks_drift"]
    assert drift.values["percent"] == pytest.approx(-0.1, rel=0.02)


def test_a_growth_within_a_turn_of_the_loop_may_be_two_rates_and_is_a_doubt():
    (trial,) = recording(2e-4 * SENT_S).trials("pan")
    assert trial.clock_drift == 0 and trial.falls_behind_s == pytest.approx(0.0035, rel=0.1)
    assert trial.read_time_doubt_s == pytest.approx(trial.falls_behind_s)


@pytest.mark.parametrize("later_s", [0.0, 0.004 * (SENT_S > 8.0)], ids=["steady", "one jump"])
def test_stamps_of_one_clock_are_left_alone(later_s):
    for seed in range(20):
        (trial,) = recording(later_s, seed).trials("pan")
        assert trial.clock_drift == trial.falls_behind_s == trial.read_time_doubt_s == 0
