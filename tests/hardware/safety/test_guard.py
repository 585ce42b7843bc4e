"""The guard keeps commands inside their bounds, and stops a robot that does not follow them."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.common.errors import BusError, SafetyStop
from pupper_sysid.hardware.bus import Coupling, PositionLimits, Sent
from pupper_sysid.hardware.safety.guard import GuardedBus, GuardLimits, guarded
from pupper_sysid.hardware.safety.watchdog import Watchdog
from support.following_bus import FollowingBus

PERIOD = 0.02
NOTHING_CHANGED = {"clipped": 0, "slowed": 0, "unsent": 0, "missing": 0}


class PlainBus(FollowingBus):
    """Two servos that follow at once, until a fault is set."""

    def __init__(self, high=2.0):
        super().__init__(("LF_thigh", "LF_calf"))
        self.limits.high_rad[:] = high
        self.metadata = {"voltage_band_v": [4.2, 8.7]}
        self.frozen = self.blocked = self.deaf = False
        self.silent = np.zeros(2, bool)
        self.load, self.volts, self.heat, self.status = np.zeros(2), 7.4, 30.0, np.zeros(2, int)
        self.ticks = 0

    def write(self, position_rad):
        return Sent(float("nan"), position_rad) if self.deaf else super().write(position_rad)

    def read(self):
        self.ticks += 1
        # an encoder flickers by a count; a frozen one does not
        position = self.goal + 0.0015 * (self.ticks % 2)
        if self.frozen or self.blocked:
            position = np.zeros(2) + (0.0015 * (self.ticks % 2) if self.blocked else 0.0)
        return self.sample(
            np.where(self.silent, np.nan, position), voltage_v=np.full(2, self.volts),
            temperature_c=np.full(2, self.heat), load=self.load, status=self.status,
        )  # fmt: skip


class RecordingWatchdog(Watchdog):
    """A watchdog that writes its messages into the bus's log."""

    ended = False

    def __init__(self, bus: PlainBus):
        self.log = bus.log

    def _send(self, message):
        self.log += [f"watchdog {word}" for word in message]

    def arm(self, joints, pose_rad):
        self._send({"arm": True})

    def disarm(self):
        self._send({"disarm": True})

    def beat(self):
        if self.ended:
            raise SafetyStop("the watchdog process has ended")

    def close(self):
        self._send({"bye": True})

    def take_over(self):
        self._send({"take over": True})


def linked(bus: PlainBus) -> PlainBus:
    """The same servos, the second of which turns its joint by a push rod, as on the Mini Pupper."""
    one = np.array([0])
    rod = Coupling(one + 1, one, 1, np.array([-3.0]), np.array([3.0]))
    bus.limits = PositionLimits(np.full(2, -2.0), np.full(2, 2.0), rod)
    return bus


def ready(bus: PlainBus, limits: GuardLimits | None = None) -> GuardedBus:
    """A guarded bus with the torque on and the first command sent."""
    guard = GuardedBus(bus, limits)
    guard.read()
    guard.torque(True)
    guard.write(np.zeros(2))
    return guard


def drive(guard: GuardedBus, seconds: float, goal=lambda t: np.zeros(2)) -> None:
    """Command `goal(t)` at the loop's rate."""
    start = guard.now()
    for k in range(round(seconds / PERIOD)):
        guard.sleep_until(start + (k + 1) * PERIOD)
        guard.write(goal(guard.now() - start))
        guard.read()


def swing(t: float) -> np.ndarray:
    """One joint at 1 Hz and 0.3 rad, the other at rest."""
    return np.array([0.3 * np.sin(2 * np.pi * t), 0.0])


def afflict(bus: PlainBus, fault: dict) -> dict:
    """Set a fault; the values before it, which take it away."""
    before = {name: getattr(bus, name) for name in fault}
    for name, value in fault.items():
        setattr(bus, name, value)
    return before


# ---- commands ----


def test_a_step_becomes_a_ramp_at_the_speed_limit():
    bus = PlainBus()
    guard = ready(bus, GuardLimits(speed_rad_s=5.0, acceleration_rad_s2=1e6))
    drive(guard, 0.2, lambda t: np.array([0.35, 0.0]))
    # 5 rad/s in ticks of 20 ms: 0.1 rad each
    np.testing.assert_allclose([g[0] for g in bus.written[1:6]], [0.1, 0.2, 0.3, 0.35, 0.35])
    assert guard.report.slowed == 3


def test_speed_is_gained_at_the_acceleration_limit_in_either_direction_and_lost_at_once():
    bus = PlainBus()
    guard = ready(bus, GuardLimits(speed_rad_s=100.0, acceleration_rad_s2=100.0))
    drive(guard, 0.1, lambda t: np.array([0.3, 0.0]))
    # 100 rad/s²: 2 rad/s more every 20 ms tick, so 0.04, 0.08, 0.12 rad, then the rest of the way
    np.testing.assert_allclose([g[0] for g in bus.written[1:]], [0.04, 0.12, 0.24, 0.3, 0.3])
    drive(guard, 0.06, lambda t: np.array([1.0, 0.0]))
    turned = bus.goal[0]
    drive(guard, 0.04, lambda t: np.array([-1.0, 0.0]))
    # 2 rad/s after the first tick of 20 ms, 4 after the second, whatever the speed was before
    np.testing.assert_allclose([g[0] - turned for g in bus.written[-2:]], [-0.04, -0.12])


def test_a_pause_of_any_length_saves_up_no_more_than_half_a_tick():
    for pause_s in (0.03, 0.059, 0.09, 0.5, 5.0):
        bus = PlainBus()
        guard = ready(bus, GuardLimits(acceleration_rad_s2=1e4))
        drive(guard, 0.5, lambda t: np.array([0.01 * t, 0.0]))
        before = bus.goal[0]
        guard.sleep_until(guard.now() + pause_s)
        guard.write(np.array([1.5, 0.0]))
        assert bus.goal[0] - before <= 8.0 * 1.5 * 0.02 + 1e-9, pause_s
    bus = PlainBus()
    guard = ready(bus)
    guard.sleep_until(guard.now() + 5.0)
    guard.write(np.array([1.5, 0.0]))
    assert bus.goal[0] <= 8.0 * 0.06 + 1e-9  # after the first command alone, three ticks


def test_speed_is_bounded_where_the_servo_turns_not_where_the_joint_bends():
    """The calf's servo turns by thigh + calf: a calf that folds as its thigh rises stands still."""

    def moved(goal: list[float]) -> np.ndarray:
        bus = linked(PlainBus())
        guard = ready(bus, GuardLimits(speed_rad_s=8.0, acceleration_rad_s2=1e6))
        bus.time += PERIOD
        guard.write(np.array(goal))
        return bus.written[-1]

    # thigh at its limit of 0.16 rad per tick, calf's servo at rest
    np.testing.assert_allclose(moved([0.15, -0.15]), [0.15, -0.15])
    # both forward: the calf's servo would turn by twice as much
    thigh, calf = moved([0.15, 0.15])
    assert thigh == pytest.approx(0.15) and thigh + calf == pytest.approx(0.16)


def test_a_first_command_is_refused_unless_every_joint_is_known_and_near_and_nothing_is_sent():
    for high, found, silent, command, words in (
        (2.0, 0.0, [False, True], [0.0, 0.0], "no position reading from LF_calf yet."),
        (2.0, 0.0, [False, False], [0.0, 0.4], "would move LF_calf by 0.40 rad at once"),
        (1.0, 1.8, [False, False], [1.8, 0.0], "LF_thigh was found at 1.80 rad, 0.80 rad outside"),
    ):
        bus = PlainBus(high=high)
        bus.goal, bus.silent = np.array([found, 0.0]), np.array(silent)
        guard = GuardedBus(bus)
        guard.read()
        if not any(silent):
            guard.torque(True)
        with pytest.raises(SafetyStop) as stop:
            guard.write(np.array(command))
        assert words in str(stop.value)
        guard.close()
        assert bus.written == [] and bus.log[-1] == "close"
        assert bus.log[-2:] == ["torque False", "close"] or any(silent)


def test_lost_commands_and_missing_readings_are_counted():
    bus = PlainBus()
    guard = ready(bus)
    assert guard.report.summary() == NOTHING_CHANGED
    for silent in ([True, False], [True, True]):
        bus.silent = np.array(silent)
        guard.read()
    bus.deaf = True
    guard.sleep_until(PERIOD)
    assert np.isnan(guard.write(np.array([0.1, 0.0])).time_s)
    assert guard.report.summary() == NOTHING_CHANGED | {"unsent": 1, "missing": 3}


def test_a_recordings_footer_has_the_first_500_changed_commands_and_counts_all():
    bus = PlainBus(high=0.1)
    guard = ready(bus)
    drive(guard, 0.04, lambda t: np.array([0.12, 0.0]))
    # at the recording's times, which are the bus's and a shift
    assert guard.report.footer(0.5) == {
        "guard": NOTHING_CHANGED | {"clipped": 2},
        "guard_events": [[0.52, "clipped"], [0.54, "clipped"]],
    }
    drive(guard, 10.0, lambda t: np.array([0.12, 0.0]))
    footer = guard.report.footer()
    assert footer["guard"]["clipped"] == 502 and len(footer["guard_events"]) == 500


def test_a_guard_is_not_guarded_twice():
    guard = GuardedBus(PlainBus())
    assert guarded(guard) is guard


# ---- torque ----


def test_the_torque_waits_for_every_position_but_not_longer_than_a_lost_reading():
    bus = PlainBus()
    bus.silent = np.array([False, True])
    with pytest.raises(BusError, match="LF_calf"):
        GuardedBus(bus).torque(True)
    assert bus.log == []
    reads = bus.read

    def once_silent():
        sample = reads()
        bus.silent = np.zeros(2, bool)
        return sample

    bus.read = once_silent
    assert GuardedBus(bus).torque(True)


def test_a_limp_robot_is_not_judged_and_leaving_it_sends_nothing():
    bus = PlainBus()
    guard = GuardedBus(bus)
    bus.heat = 80.0
    for _ in range(50):
        guard.sleep_until(guard.now() + PERIOD)
        guard.read()
    guard.close()
    assert bus.written == [] and bus.log == ["close"]


def test_protections_that_are_off_are_on_while_the_torque_is_and_off_again_at_the_end():
    class Unprotected(PlainBus):
        def __init__(self):
            super().__init__()
            self.values = {"overload": 0, "p": 32}

        def protections_to_set(self):
            return {"LF_calf": {"overload": 80}}

        def register(self, joint, name):
            return self.values[name]

        def set_register(self, joint, name, value):
            self.values = self.values | {name: value}

        def torque(self, on):
            self.log.append(f"overload {self.values['overload']}")
            return super().torque(on)

    bus = Unprotected()
    guard = GuardedBus(bus)
    guard.set_register("LF_calf", "p", 8)
    guard.torque(True)
    assert bus.values == {"overload": 80, "p": 8}
    guard.close()
    assert bus.values == {"overload": 0, "p": 32}
    assert bus.log == ["overload 80", "torque True", "overload 80", "torque False", "close"]


def test_a_robot_that_was_moved_by_hand_while_limp_is_found_anew():
    bus = PlainBus()
    guard = ready(bus)
    guard.park()
    bus.goal = by_hand = np.array([-0.9, 0.0])
    guard.sleep_until(guard.now() + 1.0)
    guard.torque(True)
    guard.write(by_hand)
    drive(guard, 0.5, lambda t: np.array([-0.5, 0.0]))
    guard.park()
    np.testing.assert_allclose(bus.goal, by_hand, atol=0.002)


def test_a_program_that_takes_over_goes_home_although_a_servo_does_not_confirm():
    bus = PlainBus()
    bus.goal = np.array([0.3, -0.2])
    switch = bus.torque

    def unsure(on):
        switch(on)
        return not on

    bus.torque = unsure
    guard = GuardedBus(bus, GuardLimits(park_within_s=0.5))
    with pytest.raises(BusError, match="confirm"):
        guard.torque(True)
    guard.take_over()
    assert bus.log[-1] == "torque True"
    guard.park(np.zeros(2))
    np.testing.assert_allclose(bus.goal, 0.0, atol=1e-6)
    assert bus.log[-1] == "torque False"


def test_servos_that_did_not_all_go_on_are_switched_off_until_they_confirm_it():
    bus = PlainBus()
    switch, answers = bus.torque, [False, False, False, True]
    bus.torque = lambda on: switch(on) and answers.pop(0)
    with pytest.raises(BusError, match="confirm"):
        GuardedBus(bus, watchdog=RecordingWatchdog(bus)).torque(True)
    off = ["torque False"] * 3
    # the watchdog stands by before the first servo is on
    assert bus.log == ["watchdog arm", "torque True", "watchdog limp", *off, "watchdog disarm"]


def test_servos_that_do_not_confirm_that_they_are_limp_are_left_to_the_watchdog():
    bus = PlainBus()
    guard = GuardedBus(bus, watchdog=RecordingWatchdog(bus))
    guard.torque(True)
    bus.torque = lambda on: False
    assert not guard.torque(False)
    guard.close()
    armed = ["watchdog arm", "torque True", "watchdog limp"]
    assert bus.log == [*armed, "close", "watchdog take over"]


def test_torque_off_is_requested_again_whatever_comes_between():
    for trouble in (KeyboardInterrupt(), ValueError("counts"), OSError("gone")):
        bus = PlainBus()
        guard = GuardedBus(bus, watchdog=RecordingWatchdog(bus))
        guard.torque(True)
        switch, troubles = bus.torque, [trouble]

        def troubled(on, switch=switch, troubles=troubles):
            if troubles:
                raise troubles.pop()
            return switch(on)

        bus.torque = troubled
        pressed = isinstance(trouble, KeyboardInterrupt)
        with pytest.raises(KeyboardInterrupt) if pressed else nullcontext():
            guard.park()
        guard.close()
        assert bus.log[-4:] == ["torque False", "watchdog disarm", "close", "watchdog bye"]


# ---- faults ----

FAULTS = {
    "did not change once": {"frozen": True},
    "95 % of full duty": {"load": np.array([0.95, 0.0])},
    "70 °C": {"heat": 70.0},
    "3.9 V": {"volts": 3.9},
    "9.5 V": {"volts": 9.5},
    "LF_calf reports an error: overload": {"status": np.array([0, 32])},
    "bus has been silent": {"silent": np.ones(2, bool)},
    "LF_thigh has not answered": {"silent": np.array([True, False])},
}


def test_a_fault_that_lasts_stops_the_robot_by_its_name_and_leaves_it_limp_where_it_is():
    for words, fault in FAULTS.items():
        bus = PlainBus()
        guard = ready(bus)
        drive(guard, 2.0, swing)
        afflict(bus, fault)
        with pytest.raises(SafetyStop) as stop:
            drive(guard, 3.0, swing)
        assert words in str(stop.value)
        commands = len(bus.written)
        guard.close()
        # no way back for a robot that may be jammed
        assert bus.log[-2:] == ["torque False", "close"] and len(bus.written) == commands, words


def test_a_reading_lost_now_and_then_does_not_hide_a_fault_that_lasts():
    none = np.full(2, np.nan)
    for words in ("70 °C", "3.9 V", "LF_calf reports an error: overload"):
        bus = PlainBus()
        guard = ready(bus)
        afflict(bus, FAULTS[words])
        read = bus.read

        def every_fifth_lost(bus=bus, read=read):
            sample, gone = read(), np.zeros(2, int)
            if bus.ticks % 5:
                return sample
            return replace(
                sample, position_rad=none, voltage_v=none, temperature_c=none, status=gone
            )

        bus.read = every_fifth_lost
        with pytest.raises(SafetyStop, match=words):
            drive(guard, 2.0, swing)


def test_a_healthy_robot_is_left_alone_and_so_is_one_whose_fault_passes_in_a_moment():
    bus = PlainBus()
    guard = ready(bus)
    drive(guard, 5.0, swing)
    assert guard.report.summary() == NOTHING_CHANGED
    for fault in ({"volts": 3.9}, {"heat": 80.0}, {"status": np.array([1, 0])},
                  {"silent": np.ones(2, bool)}):  # fmt: skip
        healthy = afflict(bus, fault)
        drive(guard, 0.2, swing)
        afflict(bus, healthy)
        drive(guard, 2.0, swing)


def test_what_a_bus_does_not_report_is_not_judged():
    bus = PlainBus()
    bus.metadata, bus.volts = {}, 3.9  # of a supply whose range is not known
    drive(ready(bus), 1.0, swing)
    bus = PlainBus()
    read = bus.read
    unknown = {"voltage_v": None, "temperature_c": None, "load": None, "status": None}
    bus.read = lambda: replace(read(), **unknown)
    drive(ready(bus), 2.0, swing)


def test_a_command_too_recent_to_show_does_not_make_a_servo_frozen():
    bus = PlainBus()
    guard = ready(bus)
    bus.frozen = True  # at rest, its reading does not change either
    drive(guard, 1.2)
    drive(guard, 0.25, lambda t: np.array([0.2, 0.0]))
    bus.frozen = False
    drive(guard, 1.0, lambda t: np.array([0.2, 0.0]))


def test_a_joint_away_from_its_command_is_given_time_after_the_first_and_after_each_move():
    bus = PlainBus()
    guard = ready(bus)
    read = bus.read
    bus.read = lambda: replace(read(), position_rad=np.array([0.5, 0.0]))
    drive(guard, 0.7)
    with pytest.raises(SafetyStop, match="LF_thigh is commanded to 0.00 rad and stays 0.50 rad"):
        drive(guard, 0.4)
    bus = PlainBus()
    guard = ready(bus)
    drive(guard, 2.0)
    bus.blocked = True
    drive(guard, 0.8, lambda t: np.array([0.5, 0.0]))
    with pytest.raises(SafetyStop, match="LF_thigh is commanded to 0.50 rad and stays 0.50 rad"):
        drive(guard, 0.5, lambda t: np.array([0.5, 0.0]))


def test_a_high_load_is_borne_for_a_while_from_the_start():
    bus = PlainBus()
    guard = ready(bus)
    bus.load = np.array([0.0, -0.95])
    drive(guard, 1.4, swing)
    with pytest.raises(SafetyStop, match="LF_calf has worked at 95 % of full duty"):
        drive(guard, 0.3, swing)


def test_a_calfs_servo_is_watched_though_its_joint_moves_with_the_thigh():
    bus = linked(PlainBus())
    guard = ready(bus)
    read = bus.read

    def stuck():
        sample = read()
        # a joint's angle is that of its servo less the thigh's
        sample.position_rad[1] = 0.3 - sample.position_rad[0]
        return sample

    bus.read = stuck
    with pytest.raises(SafetyStop, match=r"LF_calf was commanded to move .* did not change once"):
        drive(guard, 3.0, lambda t: np.full(2, 0.2 * np.sin(2 * np.pi * t)))
    bus = linked(PlainBus())
    guard, read = ready(bus), bus.read
    # each joint is 0.2 rad away, and so the calf's servo 0.4
    bus.read = lambda: replace(read(), position_rad=np.full(2, 0.2))
    with pytest.raises(SafetyStop, match=r"LF_calf is commanded to 0\.00 .* stays 0\.40 rad away"):
        drive(guard, 3.0)


# ---- the way back ----


def test_parking_stops_returns_to_where_the_robot_was_found_and_lets_go():
    for limits, seconds in ((None, 0.3 * np.pi / 2), (GuardLimits(gentle_rad_s=0.5), 0.3 * np.pi)):
        bus = PlainBus()
        guard = ready(bus, limits)
        drive(guard, 1.25, swing)
        assert bus.goal[0] == pytest.approx(0.3, abs=0.01)
        before = guard.now()
        guard.close()
        np.testing.assert_allclose(bus.goal, [0.0, 0.0], atol=0.002)
        assert bus.log == ["torque True", "torque False", "close"]
        # the fastest point of a raised cosine is π/2 times its mean speed: 1 and 0.5 rad/s
        assert guard.now() - before == pytest.approx(seconds, abs=0.05)


def test_a_robot_that_goes_limp_or_has_lost_its_watchdog_is_not_moved_home_first():
    for lost in (False, True):
        bus = PlainBus()
        watchdog = RecordingWatchdog(bus)
        guard = GuardedBus(bus, watchdog=watchdog)
        guard.torque(True)
        guard.write(np.zeros(2))
        drive(guard, 1.25, swing)
        commands, watchdog.ended = len(bus.written), lost
        if lost:
            with pytest.raises(SafetyStop, match="has ended"):
                guard.read()
            guard.close()
        else:
            guard.limp()
        assert len(bus.written) == commands and "torque False" in bus.log


def test_parking_a_bus_that_is_lost_is_over_soon_and_still_requests_torque_off():
    bus = PlainBus()
    guard = ready(bus)
    drive(guard, 1.25, swing)
    bus.deaf, bus.silent = True, np.ones(2, bool)
    tries: list[float] = []
    bus.torque = lambda on: tries.append(bus.time)
    before = guard.now()
    guard.close()
    assert guard.now() - before < 3.5
    np.testing.assert_allclose(np.diff(tries), np.full(9, 0.02))
    assert bus.log[-1] == "close"
