"""The safety guard: it stands between whoever commands and any bus, and nobody gets past it.

    bus = GuardedBus(FeetechBus("/dev/ttyUSB0"))

It is itself a `ServoBus`. Goals are kept inside the joints' limits, and inside a speed and an
acceleration; the first one must be near to where the robot is. Readings are watched: a joint that
is told to move and does not, that stays away from where it is held, that strains, overheats or
starves, a servo that reports an error, a bus that has gone silent, all end in `SafetyStop`.

`park` is the way out of everything: stop, return to the pose the robot was found in, torque off,
each bounded in time; after a stop for safety the way back is left out. Because nothing on the
robot notices that its host has died, `hardware.watchdog` does the same from another process.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.errors import BusError, SafetyStop
from hardware.bus import BusSample, Sent, ServoBus
from hardware.feetech_registers import error_words
from hardware.watchdog import Watchdog

Angles = NDArray[np.float64]

_HEARTBEAT_S = 0.1
_LOOK_EVERY_S = 0.1
_PARK_PERIOD_S = 0.02
_LONGEST_TICK_S = 0.06  # a pause does not save up for a jump
_REST_S = 0.1  # longer since the last goal than any tick: the goal has been at rest
_TORQUE_OFF_TRIES = 10


@dataclass(frozen=True)
class GuardLimits:
    """What the guard lets pass."""

    speed_rad_s: float = 8.0
    """Fastest way of a goal. The servos themselves do about 7.6 rad/s."""
    acceleration_rad_s2: float = 1200.0
    """How fast a goal may gain speed; losing it is free. A servo itself does about 430 rad/s²."""
    first_command_rad: float = 0.15
    """How far from the present position the first goal may lie."""
    frozen_command_rad: float = 0.1
    """A reading must change when its goal has moved by this much within `frozen_after_s`."""
    frozen_after_s: float = 1.2
    """Longer than any run of lost polls: at a loss of 0.6, 45 in a row."""
    astray_rad: float = 0.35
    """A joint at rest must be nearer than this to its goal, `astray_after_s` after it got there."""
    astray_after_s: float = 0.8
    load: float = 0.8
    """Share of full duty that may not be exceeded for `load_for_s` without a break; a fast tone
    exceeds it now and then. The servo's own protection comes at 0.8 for 2 s."""
    load_for_s: float = 1.5
    temperature_c: float = 65.0
    """The servo's own limits are 70 to 80 °C."""
    voltage_v: tuple[float, float] | None = None
    """Supply band; by default what the bus's metadata say of it."""
    fault_for_s: float = 0.3
    """How long a voltage, temperature or error bit may be out of order."""
    silent_for_s: float = 0.5
    """How long the whole bus may be silent; a single joint twice that."""
    gentle_rad_s: float = 1.0
    """Highest speed of the way back."""
    park_within_s: float = 3.0
    """Longest way back; farther ones are taken faster."""


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
        self._stopped_for_safety = False
        self._found: Angles | None = None
        self._present = np.full(len(bus.joint_names), np.nan)
        self._sent: Angles | None = None
        self._sent_s = -np.inf
        self._velocity = np.zeros(len(bus.joint_names))
        self._watch = _Watch(bus, self.guard)

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
            If the first goal is far from where the robot is.
        """
        goal = np.asarray(position_rad, float)
        allowed = self.limits.clip(goal)
        self.report.clipped += int(np.any(allowed != goal))
        now = self.bus.now()
        if self._sent is None:
            self._refuse_far(goal)
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
            If it has not, or if a servo did not confirm that it is on.
        """
        if on:
            if not np.isfinite(self._present).all():
                self.read()
            if not np.isfinite(self._present).all():
                raise BusError(
                    f"{self.name}: the torque stays off, for {self._silent()} does not say where "
                    "it is."
                )
            if self._found is None:
                self._found = self._present.copy()
        self._on = on
        done = self.bus.torque(on)
        if on and not done:
            self.bus.torque(False)
            self._on = False
            raise BusError(f"{self.name}: not every servo confirmed that its torque is on.")
        if not on:
            self._sent = None
        if self._watchdog and self._found is not None:
            if on:
                self._watchdog.arm(self._found)
            else:
                self._watchdog.disarm()
        self._watch.forget(self.bus.now())
        return done

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
            self._on = False
            self._sent = None
            off = False
            for _ in range(_TORQUE_OFF_TRIES):
                try:
                    off = self.bus.torque(False)
                except BusError:
                    pass
                if off:
                    break
                self.bus.sleep_until(self.bus.now() + 0.02)
            if self._watchdog and off:
                self._watchdog.disarm()

    def close(self) -> None:
        """Park if that has not been done, and release the bus."""
        try:
            self.park()
        finally:
            self.bus.close()
            if self._watchdog:
                self._watchdog.close()

    def _alive(self) -> None:
        if self._watchdog:
            self._watchdog.beat()

    def _return(self, pose: Angles) -> None:
        origin = (self._present if self._sent is None else self._sent).copy()
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
            self.write(origin + (0.5 - 0.5 * np.cos(np.pi * share)) * way)
            self.read()

    def _bounded(self, goal: Angles, since_s: float) -> Angles:
        """`goal`, or as much of the way there as speed and acceleration allow."""
        assert self._sent is not None
        dt = float(np.clip(since_s, 1e-4, _LONGEST_TICK_S))
        if since_s > _REST_S:
            self._velocity[:] = 0.0
        asked = (goal - self._sent) / dt
        gain = self.guard.acceleration_rad_s2 * dt
        low = np.maximum(np.minimum(self._velocity, 0.0) - gain, -self.guard.speed_rad_s)
        high = np.minimum(np.maximum(self._velocity, 0.0) + gain, self.guard.speed_rad_s)
        self._velocity = np.clip(asked, low, high)
        held = self._velocity != asked
        self.report.slowed += int(held.any())
        return np.where(held, self._sent + self._velocity * dt, goal)

    def _refuse_far(self, goal: Angles) -> None:
        away = np.abs(goal - self._present)
        if not np.isfinite(self._present).all():
            self._stopped_for_safety = True
            raise SafetyStop(f"{self.name}: no first command, for {self._silent()} is not known.")
        far = int(np.argmax(away))
        if away[far] > self.guard.first_command_rad:
            self._stopped_for_safety = True
            raise SafetyStop(
                f"the first command would send {self.joint_names[far]} "
                f"{away[far]:.2f} rad away at once (it is at {self._present[far]:.2f} rad). "
                "Begin from where the robot is."
            )

    def _silent(self) -> str:
        names = [n for n, x in zip(self.joint_names, self._present, strict=True) if np.isnan(x)]
        return ", ".join(names[:3]) + (" …" if len(names) > 3 else "")


def guarded(bus: ServoBus) -> GuardedBus:
    """`bus` behind a guard; as it is if it already is."""
    return bus if isinstance(bus, GuardedBus) else GuardedBus(bus)


class _Watch:
    """Remembers the last seconds of goals and readings, and judges them."""

    def __init__(self, bus: ServoBus, limits: GuardLimits):
        self._names, self._limits = bus.joint_names, limits
        band: Any = limits.voltage_v or bus.metadata.get("voltage_band_v")
        self._band = tuple(band) if band else None
        self._keep_s = max(limits.frozen_after_s, limits.load_for_s, limits.astray_after_s) + 0.2
        self.forget(bus.now())

    def forget(self, now_s: float) -> None:
        """Start anew: the robot was limp, or is only now in someone's hands."""
        joints = len(self._names)
        self._goals: deque[tuple[float, Angles]] = deque()
        self._readings: deque[tuple[float, Angles]] = deque()
        self._loads: deque[tuple[float, Angles]] = deque()
        self._last_here_s = np.full(joints, now_s)
        self._fault_since_s = {
            name: np.full(joints, np.inf) for name in ("voltage", "heat", "status")
        }
        self._next_s = now_s

    def commanded(self, now_s: float, goal: Angles) -> None:
        """Remember a goal."""
        self._goals.append((now_s, goal))

    def look(self, sample: BusSample, sent: Angles | None) -> None:
        """Judge a reading and what came before it."""
        now = float(sample.time_s.max())
        here = np.isfinite(sample.position_rad)
        self._last_here_s[here] = now
        self._silence(now)
        self._faults(sample, now)
        self._readings.append((now, sample.position_rad))
        if sample.load is not None:
            self._loads.append((now, sample.load))
        if now < self._next_s:
            return
        self._next_s = now + _LOOK_EVERY_S
        for memory in (self._goals, self._readings, self._loads):
            while memory and memory[0][0] < now - self._keep_s:
                memory.popleft()
        if sent is not None:
            self._frozen(now)
            self._astray(now, sent)
        self._strained(now)

    def _silence(self, now: float) -> None:
        quiet = now - self._last_here_s
        if quiet.min() > self._limits.silent_for_s:
            raise SafetyStop(
                f"the bus has been silent for {quiet.min():.1f} s. Check the cable, the power and "
                "whether another program uses the servos."
            )
        if quiet.max() > 2 * self._limits.silent_for_s:
            name = self._names[int(np.argmax(quiet))]
            raise SafetyStop(
                f"{name} has not answered for {quiet.max():.1f} s. Check its cable; a servo of the "
                "SCS series that stops answering needs its power switched off and on."
            )

    def _faults(self, sample: BusSample, now: float) -> None:
        if sample.voltage_v is not None and self._band:
            low, high = self._band
            bad = (sample.voltage_v < low) | (sample.voltage_v > high)
            k = self._lasting("voltage", bad, now)
            if k is not None:
                raise SafetyStop(
                    f"{self._names[k]}: the supply is {sample.voltage_v[k]:.1f} V, outside "
                    f"{low:.1f} to {high:.1f} V. Charge the battery or check the supply."
                )
        if sample.temperature_c is not None:
            k = self._lasting("heat", sample.temperature_c > self._limits.temperature_c, now)
            if k is not None:
                raise SafetyStop(
                    f"{self._names[k]} is at {sample.temperature_c[k]:.0f} °C. Let it cool down, "
                    "then use a smaller --amplitude or fewer --freqs."
                )
        if sample.status is not None:
            k = self._lasting("status", sample.status != 0, now)
            if k is not None:
                raise SafetyStop(
                    f"{self._names[k]} reports an error: {error_words(int(sample.status[k]))}. "
                    "Relieve it, and switch its power off and on if the error stays."
                )

    def _lasting(self, what: str, bad: NDArray[np.bool_], now: float) -> int | None:
        """Index of a joint that has been `bad` for long enough."""
        since = self._fault_since_s[what]
        since[~bad] = np.inf
        since[bad] = np.minimum(since[bad], now)
        worst = int(np.argmin(since))
        return worst if now - since[worst] >= self._limits.fault_for_s else None

    def _frozen(self, now: float) -> None:
        """Goals moved, long enough ago, and not one reading changed."""
        window = self._limits.frozen_after_s
        read = np.array([x for t, x in self._readings if t >= now - window])
        # what was told in the last third may not show yet
        told = np.array([x for t, x in self._goals if now - window <= t <= now - window / 3])
        if len(told) < 2 or len(read) < 10 or now - self._readings[0][0] < window:
            return
        moved = np.ptp(told, axis=0) >= self._limits.frozen_command_rad
        with np.errstate(invalid="ignore"):
            same = np.nanmax(read, axis=0, initial=-np.inf) == np.nanmin(
                read, axis=0, initial=np.inf
            )
        frozen = np.flatnonzero(moved & same)
        if len(frozen):
            k = int(frozen[0])
            raise SafetyStop(
                f"{self._names[k]} was told to move by {np.ptp(told[:, k]):.2f} rad within "
                f"{window:.1f} s, and its reading did not change once. It is blocked, without "
                "power, or has stopped answering; switch the servos' power off and on."
            )

    def _astray(self, now: float, sent: Angles) -> None:
        """At rest for a while, and not where it was sent."""
        since = now - self._limits.astray_after_s
        if not self._goals or self._goals[0][0] > since:
            return
        told = np.array([x for t, x in self._goals if t >= since] or [sent])
        read = np.array([x for t, x in self._readings if t >= now - 0.3])
        resting = np.ptp(told, axis=0) < 0.02
        some = np.isfinite(read).any(axis=0)
        away = np.zeros(len(self._names))
        away[some] = np.nanmedian(read[:, some], axis=0) - sent[some]
        astray = np.flatnonzero(resting & (np.abs(away) > self._limits.astray_rad))
        if len(astray):
            k = int(astray[0])
            raise SafetyStop(
                f"{self._names[k]} is held at {sent[k]:.2f} rad and stays {abs(away[k]):.2f} rad "
                "away. It is blocked, or another program commands it too: stop that first."
            )

    def _strained(self, now: float) -> None:
        since = now - self._limits.load_for_s
        if not self._loads or self._loads[0][0] > since:
            return
        loads = np.abs(np.array([x for t, x in self._loads if t >= since]))
        least = np.where(np.isfinite(loads), loads, np.inf).min(axis=0)
        strained = np.flatnonzero((least > self._limits.load) & np.isfinite(least))
        if len(strained):
            k = int(strained[0])
            raise SafetyStop(
                f"{self._names[k]} has worked at {100 * least[k]:.0f} % of full duty or more for "
                f"{self._limits.load_for_s:.1f} s. Something holds it, or the motion is too much "
                "for it: free it, or use a smaller --amplitude."
            )
