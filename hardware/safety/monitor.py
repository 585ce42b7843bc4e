"""Detection of faults from the recent commands and readings of a bus.

`GuardLimits` holds the thresholds. `Monitor` keeps the last seconds of commands and readings and
raises `SafetyStop` for a fault; `hardware.safety.guard` decides what follows.
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

_CHECK_EVERY_S = 0.1
_SAME_RAD = 1e-6  # far below any quantisation step: rounding errors of sums of angles


@dataclass(frozen=True)
class GuardLimits:
    """Limits of commands and thresholds of the monitor."""

    speed_rad_s: float = 8.0
    """Highest speed of a command. The servos themselves reach about 7.6 rad/s."""
    acceleration_rad_s2: float = 1200.0
    """Highest acceleration of a command; deceleration is free. A servo reaches about 430 rad/s²."""
    first_command_rad: float = 0.15
    """Largest distance of the first command from the present position."""
    frozen_command_rad: float = 0.1
    """A reading must change when its command has moved by this much within `frozen_after_s`."""
    frozen_after_s: float = 0.85
    """Longer than any run of lost polls: at a loss of 0.6, 30 in a row."""
    astray_rad: float = 0.35
    """Largest distance of a joint from its command after `astray_after_s` at rest."""
    astray_after_s: float = 0.8
    load: float = 0.8
    """Fraction of full duty that may not be exceeded for `load_for_s` without a break; a fast tone
    exceeds it briefly. The servo's own protection acts at 0.8 for 2 s."""
    load_for_s: float = 1.5
    temperature_c: float = 65.0
    """The servo's own limits are 70 to 80 °C."""
    voltage_v: tuple[float, float] | None = None
    """Range of the supply; by default the bus's `voltage_band_v`."""
    fault_for_s: float = 0.3
    """Longest duration of a voltage, temperature or error bit out of order."""
    silent_for_s: float = 0.5
    """Longest silence of the whole bus; a single joint may be silent twice as long."""
    gentle_rad_s: float = 1.0
    """Highest speed on the way back."""
    park_within_s: float = 3.0
    """Longest duration of the way back; longer ways are taken faster."""


class Monitor:
    """The last seconds of commands and readings of a bus, and the checks of them."""

    def __init__(self, bus: ServoBus, limits: GuardLimits):
        self._names, self._limits = bus.joint_names, limits
        # servo angles: a push rod changes a calf's joint angle with its thigh while its own servo
        # stands still
        self._servo_angles = bus.limits.servo_angles
        supply: Any = limits.voltage_v or bus.metadata.get("voltage_band_v")
        self._supply_v = tuple(supply) if supply else None
        self._keep_s = max(limits.frozen_after_s, limits.load_for_s, limits.astray_after_s) + 0.2
        self.reset(bus.now())

    def reset(self, now_s: float) -> None:
        """Forget everything: the torque has just been switched on."""
        joints = len(self._names)
        self._commands: deque[tuple[float, Angles]] = deque()
        self._readings: deque[tuple[float, Angles]] = deque()
        self._loads: deque[tuple[float, Angles]] = deque()
        self._last_read_s = np.full(joints, now_s)
        self._fault_since_s = {
            name: np.full(joints, np.inf) for name in ("voltage", "heat", "status")
        }
        self._next_s = now_s

    def add_command(self, now_s: float, command: Angles) -> None:
        """Store a command that was sent."""
        self._commands.append((now_s, self._servo_angles(command)))

    def check(self, sample: BusSample, command: Angles | None) -> None:
        """Store a reading and check it together with the ones before it.

        Raises
        ------
        SafetyStop
            If a fault is found; the sentence names the joint, the fault and what to check.
        """
        now = float(sample.time_s.max())
        valid = np.isfinite(sample.position_rad)
        self._last_read_s[valid] = now
        self._check_silence(now)
        self._check_faults(sample, valid, now)
        self._readings.append((now, self._servo_angles(sample.position_rad)))
        if sample.load is not None:
            self._loads.append((now, sample.load))
        if now < self._next_s:
            return
        self._next_s = now + _CHECK_EVERY_S
        for memory in (self._commands, self._readings, self._loads):
            while memory and memory[0][0] < now - self._keep_s:
                memory.popleft()
        if command is not None:
            self._check_frozen(now)
            self._check_astray(now, command)
        self._check_load(now)

    def _check_silence(self, now: float) -> None:
        silent_s = now - self._last_read_s
        if silent_s.min() > self._limits.silent_for_s:
            raise SafetyStop(
                f"the bus has been silent for {silent_s.min():.1f} s. Check the cable, the power "
                "and whether another program uses the servos."
            )
        if silent_s.max() > 2 * self._limits.silent_for_s:
            raise SafetyStop(
                f"{self._names[int(np.argmax(silent_s))]} has not answered for "
                f"{silent_s.max():.1f} s. Check its cable; a servo of the SCS series that stops "
                "answering needs its power switched off and on."
            )

    def _check_faults(self, sample: BusSample, valid: NDArray[np.bool_], now: float) -> None:
        if sample.voltage_v is not None and self._supply_v:
            low, high = self._supply_v
            bad = (sample.voltage_v < low) | (sample.voltage_v > high)
            k = self._persistent("voltage", bad, np.isfinite(sample.voltage_v), now)
            if k is not None:
                raise SafetyStop(
                    f"{self._names[k]}: the supply is {sample.voltage_v[k]:.1f} V, outside "
                    f"{low:.1f} to {high:.1f} V. Charge the battery or check the supply."
                )
        if sample.temperature_c is not None:
            bad = sample.temperature_c > self._limits.temperature_c
            k = self._persistent("heat", bad, np.isfinite(sample.temperature_c), now)
            if k is not None:
                raise SafetyStop(
                    f"{self._names[k]} is at {sample.temperature_c[k]:.0f} °C. Let it cool down, "
                    "then use a smaller amplitude or fewer frequencies."
                )
        if sample.status is not None:
            k = self._persistent("status", sample.status != 0, valid, now)
            if k is not None:
                raise SafetyStop(
                    f"{self._names[k]} reports an error: {error_words(int(sample.status[k]))}. "
                    "Relieve it, and switch its power off and on if the error stays."
                )

    def _persistent(
        self, what: str, bad: NDArray[np.bool_], known: NDArray[np.bool_], now: float
    ) -> int | None:
        """Index of a joint that is `bad` and has been so for `fault_for_s`.

        Only a good reading ends a fault; a missing one does not.
        """
        since = self._fault_since_s[what]
        since[known & ~bad] = np.inf
        since[bad] = np.minimum(since[bad], now)
        return _first(bad & (now - since >= self._limits.fault_for_s))

    def _check_frozen(self, now: float) -> None:
        """Stop if a command moved, long enough ago, and its readings did not change."""
        window = self._limits.frozen_after_s
        read = np.array([x for t, x in self._readings if t >= now - window])
        # a command of the last third may not show yet
        sent = np.array([x for t, x in self._commands if now - window <= t <= now - window / 3])
        if len(sent) < 2 or len(read) < 10 or now - self._readings[0][0] < window:
            return
        moved = np.ptp(sent, axis=0) >= self._limits.frozen_command_rad
        spread = np.nanmax(read, axis=0, initial=-np.inf) - np.nanmin(read, axis=0, initial=np.inf)
        # a servo that was never read has a spread of minus infinity
        k = _first(moved & (spread >= 0) & (spread < _SAME_RAD))
        if k is not None:
            raise SafetyStop(
                f"{self._names[k]} was commanded to move by {np.ptp(sent[:, k]):.2f} rad within "
                f"{window:g} s, and its reading did not change once. It is blocked, without "
                "power, or has stopped answering; switch the servos' power off and on."
            )

    def _check_astray(self, now: float, command: Angles) -> None:
        """Stop if a joint has been at rest for a while, away from its command."""
        since = now - self._limits.astray_after_s
        if not self._commands or self._commands[0][0] > since:
            return
        goal = self._servo_angles(command)
        sent = np.array([x for t, x in self._commands if t >= since] or [goal])
        read = np.array([x for t, x in self._readings if t >= now - 0.3])
        resting = np.ptp(sent, axis=0) < 0.02
        some = np.isfinite(read).any(axis=0)
        away = np.zeros(len(self._names))
        away[some] = np.nanmedian(read[:, some], axis=0) - goal[some]
        k = _first(resting & (np.abs(away) > self._limits.astray_rad))
        if k is not None:
            raise SafetyStop(
                f"{self._names[k]} is commanded to {command[k]:.2f} rad and stays "
                f"{abs(away[k]):.2f} rad away. It is blocked, or another program commands it too: "
                "stop that first."
            )

    def _check_load(self, now: float) -> None:
        since = now - self._limits.load_for_s
        if not self._loads or self._loads[0][0] > since:
            return
        loads = np.abs(np.array([x for t, x in self._loads if t >= since]))
        least = np.where(np.isfinite(loads), loads, np.inf).min(axis=0)
        k = _first((least > self._limits.load) & np.isfinite(least))
        if k is not None:
            raise SafetyStop(
                f"{self._names[k]} has worked at {100 * least[k]:.0f} % of full duty or more for "
                f"{self._limits.load_for_s:.1f} s. Something holds it, or the motion is too much "
                "for it: free it, or use a smaller amplitude."
            )


def _first(flags: NDArray[np.bool_]) -> int | None:
    """Index of the first true flag."""
    found = np.flatnonzero(flags)
    return int(found[0]) if len(found) else None
