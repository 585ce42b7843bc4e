"""Where the bus asks the servo itself, no reading is taken for a held one."""

from __future__ import annotations

import numpy as np

from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice, fresh_rows, readings
from pupper_sysid.sysid.recordings.recording import Trial


def test_a_servo_that_sticks_is_not_mistaken_for_a_bus_that_holds():
    rng = np.random.default_rng(0)
    t = 0.02 * np.arange(300)
    move = 0.0015 * np.round(0.1 * np.sin(2 * np.pi * t) / 0.0015)
    # half of the rows repeat the one before
    last = np.maximum.accumulate(np.where(rng.random(300) < 0.5, np.arange(300), 0))
    stuck = move[last]
    stuck[40] = np.nan

    def trial(direct: bool) -> Trial:
        return Trial("LF_hip", 0, 1.0, t, t + 0.001, move, stuck, None, 0.0, direct)

    assert len(fresh_rows(trial(False))) < 200
    asked = trial(True)
    lattice, rows = (
        find_poll_lattice([asked], np.random.default_rng(0)),
        np.delete(np.arange(300), 40),
    )
    assert lattice.kind == "every read" and fresh_rows(asked).tolist() == rows.tolist()
    # each at the time it was read, not somewhere between two reads
    assert np.allclose(readings(asked, lattice).time_s, asked.read_time_s[rows])
