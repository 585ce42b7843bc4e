"""What the safety guard looks for: signs in goals and readings that going on would do harm.

`Watch` remembers the last seconds and judges them; `GuardLimits` says what is still well. The
guard itself (`hardware.safety.guard`) decides what comes of it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import SafetyStop
from pupper_sysid.hardware.bus import BusSample, ServoBus
from pupper_sysid.hardware.feetech.registers import error_words

Angles = NDArray[np.float64]

_LOOK_EVERY_S = 0.1
_SAME_RAD = 1e-6  # far below any encoder's count: what sums and differences of angles leave of zero


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
    frozen_after_s: float = 0.85
    """Longer than any run of lost polls: at a loss of 0.6, 30 in a row."""
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


class Watch:
    """Remembers the last seconds of goals and readings, and judges them."""

    def __init__(self, bus: ServoBus, limits: GuardLimits):
        self._names, self._limits = bus.joint_names, limits
        # where a push rod turns a calf, its joint's angle changes with a thigh though its own servo
        # does not: servos are judged by what they turn by themselves
        self._servo_angles = bus.limits.servo_angles
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
        self._goals.append((now_s, self._servo_angles(goal)))

    def look(self, sample: BusSample, sent: Angles | None) -> None:
        """Judge a reading and what came before it."""
        now = float(sample.time_s.max())
        here = np.isfinite(sample.position_rad)
        self._last_here_s[here] = now
        self._silence(now)
        self._faults(sample, here, now)
        self._readings.append((now, self._servo_angles(sample.position_rad)))
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

    def _faults(self, sample: BusSample, here: NDArray[np.bool_], now: float) -> None:
        if sample.voltage_v is not None and self._band:
            low, high = self._band
            bad = (sample.voltage_v < low) | (sample.voltage_v > high)
            k = self._lasting("voltage", bad, np.isfinite(sample.voltage_v), now)
            if k is not None:
                raise SafetyStop(
                    f"{self._names[k]}: the supply is {sample.voltage_v[k]:.1f} V, outside "
                    f"{low:.1f} to {high:.1f} V. Charge the battery or check the supply."
                )
        if sample.temperature_c is not None:
            bad = sample.temperature_c > self._limits.temperature_c
            k = self._lasting("heat", bad, np.isfinite(sample.temperature_c), now)
            if k is not None:
                raise SafetyStop(
                    f"{self._names[k]} is at {sample.temperature_c[k]:.0f} °C. Let it cool down, "
                    "then use a smaller --amplitude or fewer --freqs."
                )
        if sample.status is not None:
            k = self._lasting("status", sample.status != 0, here, now)
            if k is not None:
                raise SafetyStop(
                    f"{self._names[k]} reports an error: {error_words(int(sample.status[k]))}. "
                    "Relieve it, and switch its power off and on if the error stays."
                )

    def _lasting(
        self, what: str, bad: NDArray[np.bool_], known: NDArray[np.bool_], now: float
    ) -> int | None:
        """Index of a joint that is `bad` and has been for long enough.

        Only a reading that says so makes a joint well again: one that did not come says nothing.
        """
        since = self._fault_since_s[what]
        since[known & ~bad] = np.inf
        since[bad] = np.minimum(since[bad], now)
        lasting = np.flatnonzero(bad & (now - since >= self._limits.fault_for_s))
        return int(lasting[0]) if len(lasting) else None

    def _frozen(self, now: float) -> None:
        """Goals moved, long enough ago, and not one reading changed."""
        window = self._limits.frozen_after_s
        read = np.array([x for t, x in self._readings if t >= now - window])
        # what was told in the last third may not show yet
        told = np.array([x for t, x in self._goals if now - window <= t <= now - window / 3])
        if len(told) < 2 or len(read) < 10 or now - self._readings[0][0] < window:
            return
        moved = np.ptp(told, axis=0) >= self._limits.frozen_command_rad
        spread = np.nanmax(read, axis=0, initial=-np.inf) - np.nanmin(read, axis=0, initial=np.inf)
        # a servo that was never read has a spread of minus infinity
        frozen = np.flatnonzero(moved & (spread >= 0) & (spread < _SAME_RAD))
        if len(frozen):
            k = int(frozen[0])
            raise SafetyStop(
                f"{self._names[k]} was told to move by {np.ptp(told[:, k]):.2f} rad within "
                f"{window:g} s, and its reading did not change once. It is blocked, without "
                "power, or has stopped answering; switch the servos' power off and on."
            )

    def _astray(self, now: float, sent: Angles) -> None:
        """At rest for a while, and not where it was sent."""
        since = now - self._limits.astray_after_s
        if not self._goals or self._goals[0][0] > since:
            return
        goal = self._servo_angles(sent)
        told = np.array([x for t, x in self._goals if t >= since] or [goal])
        read = np.array([x for t, x in self._readings if t >= now - 0.3])
        resting = np.ptp(told, axis=0) < 0.02
        some = np.isfinite(read).any(axis=0)
        away = np.zeros(len(self._names))
        away[some] = np.nanmedian(read[:, some], axis=0) - goal[some]
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
