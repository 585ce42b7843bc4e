"""Rows with the torque off: kept in the recording, left out where a servo is to follow."""

import numpy as np
import pytest

from pupper_sysid.sysid.doctor.checks import findings
from pupper_sysid.sysid.recordings.recording import Recording


def dropped(off: slice | None) -> Recording:
    """A servo that trails by 60 ms; while its torque is off it falls, against its command."""
    time = 0.01 * np.arange(600)
    command = 0.4 * np.sin(2 * np.pi * time)
    position = 0.4 * np.sin(2 * np.pi * (time - 0.06))
    on = np.ones(600)
    if off is not None:
        on[off], position[off] = 0, -command[off]
    table = Recording.from_arrays(time, {"knee": command}, {"knee": position}).to_frame()
    return Recording.from_frame(table.assign(torque_enabled=on))


@pytest.mark.parametrize(
    ("off", "first", "stop"),
    [(None, 0, 600), (slice(250, 600), 0, 250), (slice(0, 200), 200, 600), (slice(9, 90), 90, 600),
     (slice(0, 600), 0, 0)],
)  # fmt: skip
def test_the_longest_stretch_with_torque_is_taken(off, first, stop):
    (trial,) = dropped(off).trials("knee")
    own = trial.powered()
    np.testing.assert_array_equal(own.send_time_s, trial.send_time_s[first:stop])
    before = trial.command_rad[first - 1] if first else trial.initial_command_rad
    assert own.initial_command_rad == before
    assert own.torque_enabled is None or own.torque_enabled.all()


def test_a_fall_with_the_torque_off_is_no_fault_of_the_recording():
    assert findings(dropped(slice(200, 600)).trials("knee")) == findings(
        dropped(None).trials("knee")
    )
