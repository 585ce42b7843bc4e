"""The safety guard: it stands between whoever commands and any bus, and nobody gets past it.

    bus = GuardedBus(FeetechBus("/dev/ttyUSB0"))

It is itself a `ServoBus`. Goals are kept inside the joints' limits, and inside a speed and an
acceleration; the first one must be near to where the robot is. Readings are watched: a joint that
is told to move and does not, that stays away from where it is held, that strains, overheats or
starves, a servo that reports an error, a bus that has gone silent, all end in `SafetyStop`.

`park` is the way out of everything: stop, return to the pose the robot was found in, torque off,
each bounded in time; after a stop for safety the way back is left out. Because nothing on the
robot notices that its host has died, `hardware.safety.watchdog` does the same from another process.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pupper_sysid.common.errors import BusError, SafetyStop
from pupper_sysid.hardware.bus import BusSample, Sent, ServoBus
from pupper_sysid.hardware.moves import raised_cosine
from pupper_sysid.hardware.safety.monitor import Angles, GuardLimits, Watch
from pupper_sysid.hardware.safety.watchdog import Watchdog

_HEARTBEAT_S = 0.1
_PARK_PERIOD_S = 0.02
_LONGEST_TICK_S = 0.06  # a pause does not save up for a jump
_REST_S = 0.1  # longer since the last goal than any tick: the goal has been at rest
_TORQUE_OFF_TRIES = 10
_STALE_S = 0.1  # as old as what some buses say anyway
_FIND_TRIES = 10  # a lost reading is no reason to leave a robot where its driver died


@dataclass
class GuardReport:
    """What the guard had to do, for a recording's footer."""

    clipped: int = 0
    """Goals that were moved into the limits."""
    slowed: int = 0
    """Goals that came later than asked because of the speed or acceleration limit."""
    unsent: int = 0
    """Commands that could not be sent."""
    missing: int = 0
    """Readings of single joints that did not come."""

    def summary(self) -> dict[str, int]:
        """As plain numbers."""
        return dict(vars(self))


class GuardedBus:
    """A guarded `ServoBus`.

    Parameters
    ----------
    bus : ServoBus
    limits : GuardLimits, optional
    watchdog : Watchdog, optional
        Told when the torque is on and, often, that someone is in control.
    """

    def __init__(
        self,
        bus: ServoBus,
        limits: GuardLimits | None = None,
        watchdog: Watchdog | None = None,
    ):
        self.bus = bus
        self.name, self.joint_names = bus.name, bus.joint_names
        self.limits, self.metadata = bus.limits, bus.metadata
        self.guard = limits or GuardLimits()
        self.report = GuardReport()
        self._watchdog = watchdog
        self._on = False
        self._stopped_for_safety = self._left_on = False
        self._found: Angles | None = None
        self._present = np.full(len(bus.joint_names), np.nan)
        self._present_s = np.full(len(bus.joint_names), -np.inf)
        self._sent: Angles | None = None
        self._sent_s = -np.inf
        self._velocity = np.zeros(len(bus.joint_names))
        self._watch = Watch(bus, self.guard)

    def now(self) -> float:
        """Time of the bus's clock [s]."""
        return self.bus.now()

    def sleep_until(self, time_s: float) -> None:
        """Sleep, and tell the watchdog now and then that this is meant."""
        while self._on and (left := time_s - self.bus.now()) > _HEARTBEAT_S:
            self._alive()
            self.bus.sleep_until(self.bus.now() + min(_HEARTBEAT_S, left))
        self.bus.sleep_until(time_s)

    def read(self) -> BusSample:
        """Read, and watch.

        Raises
        ------
        SafetyStop
            The sentence says which joint, what was seen, and what to check.
        """
        sample = self.bus.read()
        here = np.isfinite(sample.position_rad)
        self._present = np.where(here, sample.position_rad, self._present)
        self._present_s[here] = self.bus.now()
        self.report.missing += int((~here).sum())
        if self._on:
            self._alive()
            try:
                self._watch.look(sample, self._sent)
            except SafetyStop:
                self._stopped_for_safety = True
                raise
        return sample

    def write(self, position_rad: Angles) -> Sent:
        """Send goals, after all limits; `Sent` says what they became.

        Raises
        ------
        SafetyStop
            If the first goal is far from where the robot is, or the robot outside its limits.
        """
        goal = np.asarray(position_rad, float)
        allowed = self.limits.clip(goal)
        self.report.clipped += int(np.any(allowed != goal))
        now = self.bus.now()
        if self._sent is None:
            self._refuse_far(allowed)
            self._velocity[:] = 0.0
        else:
            allowed = self._bounded(allowed, now - self._sent_s)
        sent = self.bus.write(allowed)
        self._alive()
        if np.isfinite(sent.time_s):
            self._sent, self._sent_s = sent.position_rad, now
            self._watch.commanded(now, sent.position_rad)
        else:
            self.report.unsent += 1
        return sent

    def torque(self, on: bool) -> bool:
        """Switch the torque; before it is switched on the robot must have said where it is.

        Raises
        ------
        BusError
            If it has not, or if a servo did not confirm that it is on; all are let go then.
        """
        if not on:
            self._let_go()
            return not self._left_on
        if not self._on:
            # a limp robot may have been moved by hand since it was read
            self._present[self.bus.now() - self._present_s > _STALE_S] = np.nan
            self._found = None
        self._find()
        if self._watchdog and self._found is not None:
            # before the first servo is on: who is killed from here on leaves some that are
            self._watchdog.arm(self.joint_names, self._found)
        self._on = True
        if not self.bus.torque(True):
            self._let_go()
            raise BusError(
                f"{self.name}: not every servo confirmed that its torque is on, and so all were "
                "told to go limp. Check cables and power, then try again."
            )
        self._alive()
        self._watch.forget(self.bus.now())
        return True

    def take_over(self) -> None:
        """The torque is on, and whoever switched it on is gone: from here on it is ours.

        As `torque`, but a servo that does not confirm does not cost the others their way back.

        Raises
        ------
        BusError
            If a servo does not say where it is.
        """
        self._on = True
        self._find()
        self.bus.torque(True)
        self._watch.forget(self.bus.now())

    @property
    def sent(self) -> Angles:
        """The last goal that went out [rad], or where the robot is if none did."""
        return (self._present if self._sent is None else self._sent).copy()

    def limp(self) -> None:
        """After a fault that the guard did not see itself: torque off, no way back."""
        self._stopped_for_safety = True
        self.park()

    def park(self, pose_rad: Angles | None = None) -> None:
        """Stop, go back to `pose_rad` (by default where the robot was found), torque off.

        Never raises for a bus in trouble: what can be done is done, and the torque is asked off
        several times. The way back takes at most `GuardLimits.park_within_s`, and is left out
        after a stop for safety or if the bus does not answer.
        """
        if not self._on:
            return
        try:
            pose = self._found if pose_rad is None else pose_rad
            if pose is not None and not self._stopped_for_safety:
                self._return(pose)
        except BusError:
            pass
        finally:
            self._let_go()

    def close(self) -> None:
        """Park if that has not been done, and release the bus.

        A robot that could not be told to go limp, such as one that was unplugged, is left to the
        watchdog, which tries for some seconds more.
        """
        try:
            self.park()
        finally:
            self.bus.close()
            if self._watchdog and self._left_on:
                self._watchdog.leave_limp()
            elif self._watchdog:
                self._watchdog.close()

    def _let_go(self) -> None:
        """Torque off, asked for several times; the watchdog goes on if that does not help."""
        self._on, self._sent = False, None
        self._left_on = True  # until a servo says otherwise, whatever ends the tries
        if self._watchdog:
            self._watchdog.only_limp()
        interrupted = None
        for _ in range(_TORQUE_OFF_TRIES):
            try:
                if self.bus.torque(False):
                    self._left_on = False
                    break
                self._alive()  # a line in trouble takes its time
            except KeyboardInterrupt as pressed:
                interrupted = pressed
            except Exception:  # of whatever kind: the robot is still on
                pass
            self.bus.sleep_until(self.bus.now() + _PARK_PERIOD_S)
        if self._watchdog and not self._left_on:
            self._watchdog.disarm()
        if interrupted:
            raise interrupted

    def _alive(self) -> None:
        """Tell the watchdog that someone is in control."""
        if self._watchdog:
            try:
                self._watchdog.beat()
            except SafetyStop:
                self._stopped_for_safety = True
                raise

    def _find(self) -> None:
        """Where the robot is, before anything is sent to it."""
        for _ in range(_FIND_TRIES):
            if np.isfinite(self._present).all():
                break
            self.read()
            self.bus.sleep_until(self.bus.now() + _PARK_PERIOD_S)
        if not np.isfinite(self._present).all():
            raise BusError(
                f"{self.name}: {self._silent()} does not say where it is, and so nothing is sent "
                "to it."
            )
        if self._found is None:
            self._found = self._present.copy()

    def _return(self, pose: Angles) -> None:
        origin = self.sent
        self.write(origin)
        way = self.limits.clip(pose) - origin
        farthest = float(np.max(np.abs(way)))
        if farthest < 1e-9:
            return
        # the fastest point of a raised cosine is pi/2 times its mean speed
        gentle = 0.5 * np.pi * farthest / self.guard.gentle_rad_s
        duration = min(max(gentle, 0.2), self.guard.park_within_s)
        start, share = self.bus.now(), 0.0
        while share < 1.0:
            self.bus.sleep_until(self.bus.now() + _PARK_PERIOD_S)
            share = min((self.bus.now() - start) / duration, 1.0)
            self.write(origin + raised_cosine(share) * way)
            self.read()

    def _bounded(self, goal: Angles, since_s: float) -> Angles:
        """`goal`, or as much of the way there as the servos' speed and acceleration allow."""
        assert self._sent is not None
        wanted, here = self.limits.servo_angles(goal), self.limits.servo_angles(self._sent)
        dt = float(np.clip(since_s, 1e-4, _LONGEST_TICK_S))
        if since_s > _REST_S:
            self._velocity[:] = 0.0
        asked = (wanted - here) / dt
        gain = self.guard.acceleration_rad_s2 * dt
        low = np.maximum(np.minimum(self._velocity, 0.0) - gain, -self.guard.speed_rad_s)
        high = np.minimum(np.maximum(self._velocity, 0.0) + gain, self.guard.speed_rad_s)
        self._velocity = np.clip(asked, low, high)
        held = self._velocity != asked
        if not held.any():
            return goal
        self.report.slowed += 1
        slower = np.where(held, here + self._velocity * dt, wanted)
        return self.limits.clip(self.limits.from_servo_angles(slower))

    def _refuse_far(self, allowed: Angles) -> None:
        """Refuse a first goal, within the limits, that would make a joint jump."""
        away = np.abs(allowed - self._present)
        if not np.isfinite(self._present).all():
            self._stopped_for_safety = True
            raise SafetyStop(f"{self.name}: no first command, for {self._silent()} is not known.")
        far = int(np.argmax(away))
        if away[far] > self.guard.first_command_rad:
            self._stopped_for_safety = True
            name, here = self.joint_names[far], self._present[far]
            outside = abs(here - self.limits.clip(self._present)[far])
            if outside > self.guard.first_command_rad:
                raise SafetyStop(
                    f"{name} was found at {here:.2f} rad, {outside:.2f} rad outside its limits, "
                    "and would jump to them. Move it by hand to where it may be, then start again."
                )
            raise SafetyStop(
                f"the first command would send {name} {away[far]:.2f} rad away at once (it is at "
                f"{here:.2f} rad). Begin from where the robot is."
            )

    def _silent(self) -> str:
        names = [n for n, x in zip(self.joint_names, self._present, strict=True) if np.isnan(x)]
        return ", ".join(names[:3]) + (" …" if len(names) > 3 else "")


def guarded(bus: ServoBus) -> GuardedBus:
    """`bus` behind a guard; as it is if it already is."""
    return bus if isinstance(bus, GuardedBus) else GuardedBus(bus)
