"""Recordings in joint coordinates: a calf's servo is found again behind the linkage."""

import numpy as np
import pytest

from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.sysid.recordings.recording import Recording

JOINTS = ["LF_hip", "LF_thigh", "LF_calf"]
TIME_S = 0.02 * np.arange(60)


def servo_angles() -> tuple[np.ndarray, np.ndarray]:
    """Commands and readings of the three servos, in servo coordinates; all move."""
    rest = np.array([0.0, 0.785, -1.57])
    phase = np.array([0.0, 1.0, 2.5])
    turn = 2 * np.pi * TIME_S[:, None] * np.array([1.0, 1.5, 0.7])
    return rest + 0.3 * np.sin(turn + phase), rest + 0.29 * np.sin(turn + phase - 0.4)


def recorded(coordinates: str, joints=JOINTS, **bus) -> Recording:
    """What a bus in these coordinates logs of the same servos."""
    servo = load_joint_map("mini_pupper_2").per_servo().select(JOINTS)
    joint = load_joint_map("mini_pupper_2").select(JOINTS)
    command, position = servo_angles()
    if coordinates == "joint":
        command, position = (joint.to_angles(servo.to_counts(x)) for x in (command, position))
    return Recording.from_arrays(
        TIME_S,
        {j: command[:, JOINTS.index(j)] for j in joints},
        {j: position[:, JOINTS.index(j)] for j in joints},
        metadata={"bus": {"coordinates": coordinates, "joint_map": "mini_pupper_2"} | bus},
    )


@pytest.mark.parametrize("bus", [{}, {"linkage": "parallel knee"}])
def test_a_calf_in_joint_coordinates_is_its_servos_motion_again(bus):
    assert np.ptp(recorded("joint").table["command_rad"] - recorded("servo").table["command_rad"])
    for joint in JOINTS:
        (expected,), (found,) = (recorded(c, **bus).trials(joint) for c in ("servo", "joint"))
        np.testing.assert_allclose(found.command_rad, expected.command_rad, atol=1e-9)
        np.testing.assert_allclose(found.position_rad, expected.position_rad, atol=1e-9)
        assert found.initial_command_rad == pytest.approx(expected.initial_command_rad)


@pytest.mark.parametrize(
    ("joints", "bus"),
    [(JOINTS, {"linkage": "none"}), (JOINTS, {"joint_map": "mine"}), (["LF_calf"], {})],
)
def test_a_calf_without_a_linkage_or_without_its_thigh_keeps_its_angles(joints, bus):
    (calf,) = recorded("joint", joints, **bus).trials("LF_calf")
    own = recorded("joint").table.query("joint == 'LF_calf'")["command_rad"]
    np.testing.assert_array_equal(calf.command_rad, own)


def test_rows_of_the_calf_without_one_of_the_thigh_are_left_out():
    whole = recorded("joint")
    rows = whole.table.index[(whole.table["joint"] == "LF_thigh")][[5, 9]]
    cut = Recording.from_frame(whole.table.drop(index=rows), metadata=whole.metadata)
    (calf,), (expected,) = cut.trials("LF_calf"), recorded("servo").trials("LF_calf")
    kept = np.setdiff1d(np.arange(60), [5, 9])
    np.testing.assert_allclose(calf.position_rad, expected.position_rad[kept], atol=1e-9)
