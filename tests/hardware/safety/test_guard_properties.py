"""The guard and its limits over arbitrary commands: what reaches the bus obeys all bounds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pupper_sysid.common.errors import BusError, SafetyStop
from pupper_sysid.hardware.bus import Coupling, PositionLimits
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from support.following_bus import FollowingBus

FEW = settings(max_examples=60, deadline=None)
MAPS = {
    "servo": load_joint_map("mini_pupper_2").per_servo(),
    "joint": load_joint_map("mini_pupper_2"),
}
JOINTS = 12
SPEED_RAD_S, ACCELERATION_RAD_S2, FIRST_RAD = 8.0, 1200.0, 0.15
"""The limits that a user gets (docs/safety.md)."""
LONGEST_TICK_S = 0.06
"""A pause gains no more speed than a tick of this length (`guard`)."""
NEAR = 1e-9


def follower(coordinates: str) -> FollowingBus:
    chosen = MAPS[coordinates]
    bus = FollowingBus(chosen.joint_names, chosen.position_limits())
    bus.goal = bus.limits.clip(chosen.rest_pose())
    return bus


def switched_on(coordinates: str) -> tuple[GuardedBus, FollowingBus]:
    bus = follower(coordinates)
    guard = GuardedBus(bus)
    guard.torque(True)
    guard.write(bus.goal)
    return guard, bus


angle = st.floats(-7, 7) | st.sampled_from([np.inf, -np.inf, 1e300, -1e300])
angles = st.lists(angle, min_size=JOINTS, max_size=JOINTS)
coordinates = st.sampled_from(sorted(MAPS))


@FEW
@given(
    coordinates=coordinates,
    script=st.lists(
        st.tuples(angles, st.sampled_from([0.0, 1e-5, 0.002, 0.02, 1])), min_size=1, max_size=12
    ),
)
def test_whatever_is_commanded_what_reaches_the_bus_is_within_limits_and_speed(coordinates, script):
    guard, bus = switched_on(coordinates)
    for goal, pause_s in script:
        bus.time += pause_s
        guard.write(np.array(goal))
    limits = bus.limits
    sent = np.array(bus.written)
    assert np.isfinite(sent).all()
    # inside the box, and inside the coupled bounds wherever the box leaves them a solution
    assert (sent >= limits.low_rad - NEAR).all() and (sent <= limits.high_rad + NEAR).all()
    np.testing.assert_allclose([limits.clip(x) for x in sent], sent, atol=NEAR)
    dt = np.clip(np.diff(bus.written_s), 1e-4, LONGEST_TICK_S)[:, None]
    servo = np.array([limits.servo_angles(x) for x in sent])
    speed = np.abs(np.diff(servo, axis=0)) / dt
    assert (speed <= SPEED_RAD_S + 1e-6).all()
    assert limits.coupling is not None
    free = ~np.isin(np.arange(JOINTS), limits.coupling.calf)  # a calf may yield
    gained = np.diff(speed, axis=0, prepend=0.0)
    assert (gained[:, free] <= (ACCELERATION_RAD_S2 * dt + 1e-6)).all()


@settings(FEW, max_examples=20)
@given(
    coordinates=coordinates, goal=angles, nan=st.sets(st.integers(0, JOINTS - 1), min_size=1),
    shape=st.sampled_from([(), (0,), (11,), (13,), (12, 1), (1, 12), (0, 12)]),
)  # fmt: skip
def test_a_command_that_is_not_one_number_per_joint_is_refused_and_changes_nothing(
    coordinates, goal, nan, shape
):
    guard, bus = switched_on(coordinates)
    holes, before = np.array(goal), len(bus.written)
    holes[list(nan)] = np.nan
    bus.time += 0.02
    for bad in (holes, np.zeros(shape)):
        with pytest.raises(BusError, match="must be 12 numbers"):
            guard.write(bad)
    assert len(bus.written) == before
    guard.write(bus.goal)
    assert np.isfinite(bus.written[-1]).all()


@FEW
@given(
    coordinates=coordinates, away=st.lists(st.floats(-1, 1), min_size=JOINTS, max_size=JOINTS),
    share=st.sampled_from([0.1, 0.3, 1.0]),
)  # fmt: skip
def test_a_first_command_is_refused_exactly_when_it_would_move_a_joint_too_far(
    coordinates, away, share
):
    bus = follower(coordinates)
    guard = GuardedBus(bus)
    guard.torque(True)
    start = bus.goal.copy()
    goal = start + share * np.array(away)
    far = np.abs(bus.limits.clip(goal) - start).max()
    try:
        guard.write(goal)
        assert far <= FIRST_RAD and len(bus.written) == 1
    except SafetyStop:
        assert far > FIRST_RAD and not bus.written


# ---- limits ----


def limits_of(low, high, sign: int, end: float) -> PositionLimits:
    """A thigh and a calf; `calf + sign * thigh` within ±`end`."""
    both = Coupling(np.array([1]), np.array([0]), sign, np.array([-end]), np.array([end]))
    return PositionLimits(np.array(low, float), np.array(high, float), both)


def test_a_goal_is_clipped_to_the_box_then_the_calf_to_the_bound_that_it_shares_with_its_thigh():
    for sign, pose, clipped in (
        (+1, [1.0, 1.0], [1.0, 0.5]),  # calf + thigh at most 1.5
        (+1, [-2.0, 0.0], [-2.0, 0.5]),  # and at least -1.5
        (-1, [1.0, -1.0], [1.0, -0.5]),  # calf - thigh at least -1.5
        (-1, [-1.0, 1.0], [-1.0, 0.5]),
        (+1, [5.0, 0.0], [3.0, -1.5]),  # the thigh clips first, then its calf
        (+1, [0.2, 0.3], [0.2, 0.3]),
    ):
        limits = limits_of([-3.0, -2.0], [3.0, 2.0], sign, 1.5)
        assert limits.clip(np.array(pose)) == pytest.approx(clipped), (sign, pose)
    # where the two bounds contradict each other the box wins
    narrow = limits_of([-3.0, -0.5], [3.0, 0.5], 1, 1.0)
    assert narrow.clip(np.array([3.0, 0.0])) == pytest.approx([3.0, -0.5])


def test_the_margin_is_the_travel_of_each_joint_alone_to_its_nearer_bound():
    box = PositionLimits(np.array([-1.0, 0.0]), np.array([2.0, 0.5]))
    assert box.margin(np.array([0.5, 0.4])) == pytest.approx([1.5, 0.1])
    assert box.margin(np.array([5.0, 0.25])) == pytest.approx([0.0, 0.25])
    # the thigh's is its own; the calf's ends where the sum of both does
    shared = limits_of([-1.0, -1.0], [1.0, 1.0], 1, 0.5)
    for thigh, margin in ((0.4, [0.6, 0.1]), (-0.4, [0.6, 0.1]), (0.1, [0.9, 0.4])):
        assert shared.margin(np.array([thigh, 0.0])) == pytest.approx(margin)
    # calf - thigh within ±0.5: the calf may go 0.2 further up, to 0.7
    apart = limits_of([-1.0, -1.0], [1.0, 1.0], -1, 0.5)
    assert apart.margin(np.array([0.2, 0.5])) == pytest.approx([0.8, 0.2])


box = st.floats(-3, 3)


@FEW
@given(
    low=st.tuples(box, box), width=st.tuples(st.floats(0, 3), st.floats(0, 3)),
    bound=box, span=st.floats(0, 3), sign=st.sampled_from([1, -1]),
    position=st.tuples(st.floats(-9, 9), st.floats(-9, 9)),
)  # fmt: skip
def test_clipping_is_idempotent_and_its_margin_is_none_outside(
    low, width, bound, span, sign, position
):
    coupling = Coupling(
        np.array([1]), np.array([0]), sign, np.array([bound]), np.array([bound + span])
    )
    limits = PositionLimits(np.array(low), np.array(low) + np.array(width), coupling)
    clipped = limits.clip(np.array(position))
    np.testing.assert_allclose(limits.clip(clipped), clipped, atol=NEAR)
    assert (limits.margin(clipped) >= 0).all()
    outside = (np.array(position) < limits.low_rad) | (np.array(position) > limits.high_rad)
    assert (limits.margin(np.array(position))[outside] == 0).all()
    servo = limits.servo_angles(clipped)
    np.testing.assert_allclose(limits.from_servo_angles(servo), clipped, atol=NEAR)
