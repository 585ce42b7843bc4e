"""Wrapper around a ServoBus: limits commands, their speed and acceleration, and monitors readings.

    bus = GuardedBus(FeetechBus("/dev/ttyUSB0"))

It is itself a `ServoBus`, and every command passes through it. Commands are kept inside the joints'
limits, a speed and an acceleration; the first one must be near the robot's pose. Readings are
checked (`hardware.safety.monitor`): a joint that does not follow its command, is overloaded, too
warm or short of voltage, a servo that reports an error, or a silent bus end in `SafetyStop`.

`park` ends everything: stop, return to the pose of the start, torque off, each bounded in time;
after a safety stop the way back is left out. Nothing on the robot notices that its host has died,
so `hardware.safety.watchdog` does the same from another process.

A servo's register can be set for as long as the guard exists (`set_register`); `close` sets it back
to its original value, and the watchdog does if this process dies.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import BusError, SafetyStop
from pupper_sysid.hardware.address import KINDS, BusAddress
from pupper_sysid.hardware.bus import BusSample, PositionLimits, Sent, ServoBus
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.loop import BUS, GUARD, TimeSpent, raised_cosine
from pupper_sysid.hardware.safety.monitor import Angles, GuardLimits, Monitor
from pupper_sysid.hardware.safety.watchdog import Watchdog
from pupper_sysid.hardware.serial_servos.series import ERROR_BITS

_FIRST_TICK_S = 0.02  # until the driver's own rate is known
_LATE = 1.5
_SHORTEST_TICK_S, _LONGEST_TICK_S = 0.001, 0.06
_REST_S = 0.1  # longer than any tick: the command has been at rest
_RECENT_TICKS = 9


class RateLimit:
    """Speed and acceleration limits of the servo angles of a bus; deceleration is free."""

    def __init__(self, limits: PositionLimits, speed_rad_s: float, acceleration_rad_s2: float):
        self._limits = limits
        self._speed, self._acceleration = speed_rad_s, acceleration_rad_s2
        self._velocity = np.zeros(len(limits.low_rad))
        self._ticks: deque[float] = deque(maxlen=_RECENT_TICKS)

    def rest(self) -> None:
        """Begin from rest."""
        self._velocity[:] = 0.0

    def limited(
        self, command: NDArray[np.float64], sent: NDArray[np.float64], since_s: float
    ) -> NDArray[np.float64]:
        """`command`, or a point towards it that the limits allow; `command` itself if they do.

        Both it and the last one `sent`, `since_s` ago, have the shape (joints,) [rad].
        """
        limits = self._limits
        target, previous = limits.servo_angles(command), limits.servo_angles(sent)
        tick = float(np.median(self._ticks)) if self._ticks else _FIRST_TICK_S
        dt = max(min(since_s, _LATE * tick), 1e-4)
        if since_s > _REST_S:
            self.rest()
            dt = min(tick, _FIRST_TICK_S)
        else:
            self._ticks.append(min(max(since_s, _SHORTEST_TICK_S), _LONGEST_TICK_S))
        requested = (target - previous) / dt
        gain = self._acceleration * dt
        low = np.maximum(np.minimum(self._velocity, 0.0) - gain, -self._speed)
        high = np.minimum(np.maximum(self._velocity, 0.0) + gain, self._speed)
        velocity = np.clip(requested, low, high)
        exceeded = velocity != requested
        # averaged over a late tick the joint was slower than that
        self._velocity = velocity * min(dt / min(max(since_s, 1e-4), _LONGEST_TICK_S), 1.0)
        if not exceeded.any():
            return command
        slower = np.where(exceeded, previous + velocity * dt, target)
        return limits.clip(limits.from_servo_angles(slower))


_HEARTBEAT_S = 0.1
_MOST_EVENTS = 500  # that a report keeps; all are counted
_PARK_PERIOD_S = 0.02
_TORQUE_OFF_TRIES = 10
_STALE_S = 0.1  # older than any feedback age
_LOCATE_TRIES = 10  # so that a lost reading does not keep the robot from parking


@dataclass
class GuardReport:
    """Interventions of the guard, for a recording's footer."""

    clipped: int = 0
    """Commands that were moved into the limits."""
    slowed: int = 0
    """Commands delayed by the speed or acceleration limit."""
    unsent: int = 0
    """Commands that could not be sent."""
    missing: int = 0
    """Missing readings of single joints."""
    events: list[tuple[float, str]] = field(default_factory=list)
    """Times on the bus's clock [s] of the first commands that were changed or lost, and how:
    `clipped`, `slowed` or `unsent`."""

    def add(self, kind: str, time_s: float) -> None:
        """Count a command that was changed or lost."""
        setattr(self, kind, getattr(self, kind) + 1)
        if len(self.events) < _MOST_EVENTS:
            self.events.append((time_s, kind))

    def summary(self) -> dict[str, int]:
        """The counts."""
        return {name: value for name, value in vars(self).items() if name != "events"}

    def footer(self, shift_s: float = 0.0) -> dict[str, Any]:
        """Counts and events for a recording whose times are the bus's and `shift_s`."""
        events = [[round(time_s + shift_s, 4), kind] for time_s, kind in self.events]
        return {"guard": self.summary()} | ({"guard_events": events} if events else {})


class GuardedBus:
    """A guarded `ServoBus`; the watchdog is armed while the torque is on."""

    def __init__(
        self, bus: ServoBus, limits: GuardLimits | None = None, watchdog: Watchdog | None = None
    ):
        self.bus = bus
        self.name, self.joint_names = bus.name, bus.joint_names
        self.limits, self.metadata = bus.limits, bus.metadata
        self.error_bits = getattr(bus, "error_bits", ERROR_BITS)
        self.guard = limits or GuardLimits()
        self.report = GuardReport()
        self.spent = TimeSpent(bus.now)
        self._watchdog = watchdog
        self._on = False
        self._stopped_for_safety = self._left_on = False
        self._home: Angles | None = None
        self._present = np.full(len(bus.joint_names), np.nan)
        self._present_s = np.full(len(bus.joint_names), -np.inf)
        self._sent: Angles | None = None
        self._sent_s = -np.inf
        self._rates = RateLimit(self.limits, self.guard.speed_rad_s, self.guard.acceleration_rad_s2)
        self._monitor = Monitor(bus, self.guard)
        self.registers = ChangedRegisters(bus, watchdog)

    def now(self) -> float:
        """Time of the bus's clock [s]."""
        return self.bus.now()

    def sleep_until(self, time_s: float) -> None:
        """Sleep until `now()` has reached `time_s`; the watchdog gets its beats meanwhile."""
        while self._on and (remaining_s := time_s - self.bus.now()) > _HEARTBEAT_S:
            self._beat()
            getattr(self.bus, "keep_alive", lambda: None)()  # servos with a watchdog of their own
            self.bus.sleep_until(self.bus.now() + min(_HEARTBEAT_S, remaining_s))
        self.bus.sleep_until(time_s)

    def read(self) -> BusSample:
        """Read all joints once and check the readings; a fault is a `SafetyStop`."""
        with self.spent.on(BUS):
            sample = self.bus.read()
        with self.spent.on(GUARD):
            valid = np.isfinite(sample.position_rad)
            self._present = np.where(valid, sample.position_rad, self._present)
            self._present_s[valid] = self.bus.now()
            self.report.missing += int((~valid).sum())
            if self._on:
                self._beat()
                try:
                    self._monitor.check(sample, self._sent)
                except SafetyStop:
                    self._stopped_for_safety = True
                    raise
            return sample

    def write(self, position_rad: Angles) -> Sent:
        """Send commands after all limits; `Sent` holds the limited ones.

        `SafetyStop` if the first command is far from the robot's pose, or the pose is outside the
        limits.
        """
        with self.spent.on(GUARD):
            command = np.asarray(position_rad, float)
            # NaN would stay in the velocity
            if command.shape != self._present.shape or np.isnan(command).any():
                expected = f"{len(self.joint_names)} numbers"
                raise BusError(f"{self.name}: a command must be {expected}, got {command}.")
            allowed = self.limits.clip(command)
            now = self.bus.now()
            if np.any(allowed != command):
                self.report.add("clipped", now)
            if self._sent is None:
                self._check_first(allowed)
                self._rates.rest()
            else:
                slower = self._rates.limited(allowed, self._sent, now - self._sent_s)
                if slower is not allowed:
                    self.report.add("slowed", now)
                allowed = slower
            with self.spent.on(BUS):
                sent = self.bus.write(allowed)
            self._beat()
            if np.isfinite(sent.time_s):
                self._sent, self._sent_s = sent.position_rad, now
                self._monitor.add_command(now, sent.position_rad)
            else:
                self.report.add("unsent", now)
            return sent

    def torque(self, on: bool) -> bool:
        """Switch the torque; on only after every joint has returned a valid position.

        `BusError` if a servo's registers do not let it be driven (`SerialBus.refuse_unfit`), a
        position is missing, a servo does not take a protection that it lacks, or one did not
        confirm that its torque is on; the torque of all is switched off then.
        """
        if not on:
            self._torque_off()
            return not self._left_on
        if refuse := getattr(self.bus, "refuse_unfit", None):
            refuse()
        if not self._on:
            # a limp robot may have been moved by hand since it was read
            self._present[self.bus.now() - self._present_s > _STALE_S] = np.nan
            self._home = None
        home = self._locate()
        for joint, protections in getattr(self.bus, "protections_to_set", dict)().items():
            for name, value in protections.items():  # the servos' own, until `close`
                if name not in self.registers.originals.get(joint, {}):
                    self.set_register(joint, name, value)
        if self._watchdog:
            # before the first servo is on: a driver killed from here on leaves servos switched on
            self._watchdog.arm(self.joint_names, home)
        self._on = True
        if not self.bus.torque(True):
            self._torque_off()
            raise BusError(
                f"{self.name}: not every servo confirmed that its torque is on, so the torque of "
                "all was switched off. Check cables and power, then try again."
            )
        self._beat()
        self._monitor.reset(self.bus.now())
        return True

    def servo_setups(self) -> dict[str, dict[str, Any]]:
        """By joint, what a recording's header says of its servo; empty if the bus cannot tell."""
        return getattr(self.bus, "servo_setups", dict)()

    def set_register(self, joint: str, name: str, value: int) -> None:
        """Set a register of a servo, until `close` sets it back."""
        self._beat()
        self.registers.set(joint, name, value)
        self._beat()

    def take_over(self) -> None:
        """Continue after a driver that left the torque on.

        Like `torque(True)`, but a servo that does not confirm does not prevent the way back of the
        others.
        """
        self._on = True
        self._locate()
        self.bus.torque(True)
        self._monitor.reset(self.bus.now())

    @property
    def sent(self) -> Angles:
        """Last command sent [rad], shape (joints,); the robot's pose before the first one."""
        return (self._present if self._sent is None else self._sent).copy()

    def limp(self) -> None:
        """Torque off without a way back, after a fault that the guard did not detect itself."""
        self._stopped_for_safety = True
        self.park()

    def park(self, pose_rad: Angles | None = None) -> None:
        """Stop, return to `pose_rad` (by default the pose of the start), torque off.

        Never raises for a faulty bus; torque-off is tried several times. The way back takes at most
        `GuardLimits.park_within_s`, and is left out after a safety stop or if the bus does not
        answer.
        """
        if not self._on:
            return
        try:
            pose = self._home if pose_rad is None else pose_rad
            if pose is not None and not self._stopped_for_safety:
                self._go_to(pose)
        except BusError:
            pass
        finally:
            self._torque_off()

    def close(self) -> None:
        """Park if that has not been done, set registers back, and release the bus.

        If torque-off or a register was not confirmed (a robot that was unplugged), the watchdog
        keeps trying for some seconds.
        """
        restored = False
        try:
            self.park()
        finally:
            try:
                restored = self.registers.restore()
            finally:
                self.bus.close()
                if self._watchdog and (self._left_on or not restored):
                    self._watchdog.take_over()
                elif self._watchdog:
                    self._watchdog.close()

    def _torque_off(self) -> None:
        """Switch the torque off, in several tries."""
        self._on, self._sent = False, None
        self._left_on = True  # until it is confirmed, whatever ends the tries
        if self._watchdog:
            self._watchdog.only_limp()
        interrupted = None
        for _ in range(_TORQUE_OFF_TRIES):
            try:
                if self.bus.torque(False):
                    self._left_on = False
                    break
                self._beat()  # exchanges on a faulty line run into time-outs
            except KeyboardInterrupt as pressed:
                interrupted = pressed
            except Exception:  # of whatever kind: the torque is still on
                pass
            self.bus.sleep_until(self.bus.now() + _PARK_PERIOD_S)
        if self._watchdog and not self._left_on:
            self._watchdog.disarm()
        if interrupted:
            raise interrupted

    def _beat(self) -> None:
        if self._watchdog:
            try:
                self._watchdog.beat()
            except SafetyStop:
                self._stopped_for_safety = True
                raise

    def _locate(self) -> Angles:
        """Pose of the robot before anything is sent to it."""
        for _ in range(_LOCATE_TRIES):
            if np.isfinite(self._present).all():
                break
            self.read()
            self.bus.sleep_until(self.bus.now() + _PARK_PERIOD_S)
        if not np.isfinite(self._present).all():
            raise BusError(
                f"{self.name}: no position reading from {self._unread()}, so nothing is sent to it."
            )
        if self._home is None:
            self._home = self._present.copy()
        return self._home

    def _go_to(self, pose: Angles) -> None:
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

    def _check_first(self, allowed: Angles) -> None:
        """Refuse a first command, within the limits, that would make a joint jump."""
        if not np.isfinite(self._present).all():
            self._stopped_for_safety = True
            raise SafetyStop(
                f"First command refused: no position reading from {self._unread()} yet."
            )
        away = np.abs(allowed - self._present)
        far = int(np.argmax(away))
        if away[far] <= self.guard.first_command_rad:
            return
        self._stopped_for_safety = True
        name, at = self.joint_names[far], self._present[far]
        outside = abs(at - self.limits.clip(self._present)[far])
        if outside > self.guard.first_command_rad:
            raise SafetyStop(
                f"{name} was found at {at:.2f} rad, {outside:.2f} rad outside its limits, and "
                "would jump to them. Move it by hand into its limits, then start again."
            )
        raise SafetyStop(
            f"First command refused: it would move {name} by {away[far]:.2f} rad at once (it is "
            f"at {at:.2f} rad). Start from the present pose."
        )

    def _unread(self) -> str:
        """Joints without a position reading."""
        names = [n for n, x in zip(self.joint_names, self._present, strict=True) if np.isnan(x)]
        return ", ".join(names[:3]) + (" …" if len(names) > 3 else "")


def guarded(bus: ServoBus) -> GuardedBus:
    """`bus` behind a guard; as it is if it already is."""
    return bus if isinstance(bus, GuardedBus) else GuardedBus(bus)


_TRIES, _PAUSE_S = 3, 0.02


class ChangedRegisters:
    """Registers of a bus's servos that were changed, with their `originals` by joint and name.

    The watchdog sets them back if this process dies, those of an earlier driver, too.
    """

    def __init__(
        self,
        bus: ServoBus,
        watchdog: Watchdog | None = None,
        originals: Mapping[str, Mapping[str, int]] | None = None,
    ):
        self._bus: Any = bus
        self._watchdog = watchdog
        self.originals = {joint: dict(values) for joint, values in (originals or {}).items()}
        """Values to be set back, by joint and register."""

    def set(self, joint: str, name: str, value: int) -> None:
        """Set a register; the first time, keep its original value."""
        if not hasattr(self._bus, "set_register"):
            raise BusError(
                f"{self._bus.name}: registers of its servos cannot be set over this bus. Leave the "
                "gains out, or connect the servos to a serial adapter (feetech:DEVICE)."
            )
        values = self.originals.setdefault(joint, {})
        if name not in values:
            values[name] = self._bus.register(joint, name)
            self._update_watchdog()
        self._bus.set_register(joint, name, value)

    def restore(self) -> bool:
        """Set all back; whether every one is confirmed. What is not stays in `originals`."""
        if not self.originals:
            return True
        for joint, values in self.originals.items():
            for name, value in list(values.items()):
                for _ in range(_TRIES):
                    try:
                        self._bus.set_register(joint, name, value)
                        del values[name]
                        break
                    except BusError:
                        self._bus.sleep_until(self._bus.now() + _PAUSE_S)
        self.originals = {joint: values for joint, values in self.originals.items() if values}
        self._update_watchdog()
        return not self.originals

    def _update_watchdog(self) -> None:
        if self._watchdog:
            self._watchdog.restore(self.originals)


def open_bus(
    address: BusAddress,
    joint_map: JointMap | None = None,
    joints: Sequence[str] | None = None,
    exclusive: bool = True,
) -> Any:
    """The bus itself, unguarded; see its class for parameters and errors."""
    cls = KINDS[address.kind].bus_class()
    return cls.open_address(address, joint_map, joints, exclusive)


def open_guarded(
    address: BusAddress,
    joint_map: JointMap | None = None,
    joints: Sequence[str] | None = None,
    limits: GuardLimits | None = None,
) -> GuardedBus:
    """The bus behind its guard, with a watchdog that parks the robot if this process dies."""
    bus = open_bus(address, joint_map, joints)
    try:
        if hasattr(bus, "refuse_unfit"):
            bus.refuse_unfit()
        # rate and map as detected: a watchdog has no time to detect them again
        watchdog = Watchdog(replace(address, baud=bus.metadata.get("baud")), bus.joint_map)
    except BaseException:
        bus.close()
        raise
    return GuardedBus(bus, limits, watchdog)
