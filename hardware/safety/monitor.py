"""Detection of faults from the recent commands and readings of a bus.

`GuardLimits` holds the thresholds. `Monitor` keeps the last seconds of commands and readings and
raises `SafetyStop` for a fault; `hardware.safety.guard` decides what follows.

A number that is none (NaN, infinite) never passes a check by comparing as false. As a position it
is a missing reading, and silence ends the motion. As a voltage or temperature of a servo that
returns its position it is out of range, like 3 V or 30 V. As a load it is a missing reading, which
neither begins nor ends an overload: the servo's own protection and the checks of its motion remain.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError, SafetyStop
from pupper_sysid.hardware.bus import BusSample, ServoBus, error_words

Angles = NDArray[np.float64]

ANY_SUPPLY_V = (3.5, 15.0)
"""Range of the supply where the bus states none: from one lithium cell nearly empty (an XL330 needs
3.7 V) to beyond the 14 V of a 12 V servo."""

_CHECK_EVERY_S = 0.1
_SAME_RAD = 1e-6  # far below any quantisation step: rounding errors of sums of angles
_FEWEST_READINGS = 10
_COARSEST_RAD = 2 * np.pi / 1024
_FLICKER_STEPS = 4.04  # from -2 to +2 quantisation steps, and rounding


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
    follows_share: float = 0.04
    """A reading must move by this share of its command's motion, where that is at least
    `follows_rad`; less, within four quantisation steps, is noise about one place. Healthy servos
    move by 0.64 of it and more; one on a bench at P 4 with 0.5 kg at 0.15 m by 0.02 at 7 Hz, by
    more than four steps."""
    follows_rad: float = 0.3
    """Beyond the dead band of friction at low gains (±0.06 rad with a third of the Mini Pupper's
    stiffness), and large enough for its share to be two steps of the coarsest encoder."""
    follows_within_s: float = 2.0
    """Time in which a command moves by `follows_rad`, and `frozen_after_s` for the reading to show
    it: a tone of 0.3 rad at 0.2 Hz does."""
    astray_rad: float = 0.35
    """Largest distance of a joint from its command after `astray_after_s` at rest."""
    astray_after_s: float = 0.8
    load: float = 0.8
    """Fraction of full duty that may not be exceeded for `load_for_s` without a break; a fast tone
    exceeds it briefly. The servo's own protection acts at 0.8 for 2 s."""
    load_for_s: float = 1.5
    temperature_c: float = 65.0
    """The servo's own limits are 70 to 80 °C."""
    coldest_c: float = -20.0
    """Below, the sensor is broken: hobby servos are made for -20 °C and more."""
    voltage_v: tuple[float, float] | None = None
    """Range of the supply; by default the bus's `voltage_band_v`, else `ANY_SUPPLY_V`."""
    fault_for_s: float = 0.3
    """Longest duration of a voltage, temperature or error bit out of order."""
    silent_for_s: float = 0.5
    """Longest silence of the whole bus; a single joint may be silent twice as long."""
    gentle_rad_s: float = 1.0
    """Highest speed on the way back."""
    park_within_s: float = 3.0
    """Longest duration of the way back; longer ways are taken faster."""

    def __post_init__(self):
        for field in fields(self):
            numbers = np.atleast_1d(np.array(getattr(self, field.name), float))
            if field.name == "voltage_v" and self.voltage_v is None:
                continue
            positive = field.name == "coldest_c" or (numbers > 0).all()
            if not (np.isfinite(numbers).all() and positive and (np.diff(numbers) > 0).all()):
                raise InputError(
                    f"GuardLimits: {field.name} is {getattr(self, field.name)}; it must be a "
                    "positive number, of a range the lower one first."
                )


class Monitor:
    """The last seconds of commands and readings of a bus, and the checks of them."""

    def __init__(self, bus: ServoBus, limits: GuardLimits):
        self._bus, self._names, self._limits = bus, bus.joint_names, limits
        # servo angles: a push rod changes a calf's joint angle with its thigh while its own servo
        # stands still
        self._servo_angles = bus.limits.servo_angles
        supply: Any = limits.voltage_v or bus.metadata.get("voltage_band_v") or ANY_SUPPLY_V
        self._supply_v = tuple(supply)
        steps: Any = bus.metadata.get("command_quantum_rad") or {}
        quantum = np.array([steps.get(name) or _COARSEST_RAD for name in bus.joint_names])
        self._flicker_rad = _FLICKER_STEPS * quantum
        self._now = bus.now
        self._keep_s = 0.2 + max(
            limits.frozen_after_s, limits.follows_within_s, limits.load_for_s, limits.astray_after_s
        )
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
        self._next_s = self._ask_s = now_s

    def add_command(self, now_s: float, command: Angles) -> None:
        """Store a command that was sent."""
        self._commands.append((now_s, self._servo_angles(command)))

    def check(self, sample: BusSample, command: Angles | None) -> None:
        """Store a reading and check it with the ones before it; a fault is a `SafetyStop`."""
        now = self._now()
        valid = np.isfinite(sample.position_rad)
        self._last_read_s[valid] = now
        self._check_silence(now)
        self._check_faults(sample, valid, now)
        position = np.where(valid, sample.position_rad, np.nan)
        self._readings.append((now, self._servo_angles(position)))
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
            self._check_following(now)
        self._check_load(now)

    def _check_silence(self, now: float) -> None:
        silent_s = now - self._last_read_s
        if silent_s.min() > self._limits.silent_for_s:
            if device := getattr(self._bus, "lost_device", None):
                raise SafetyStop(
                    f"{device} is gone: the adapter was unplugged or lost its power. Servos that "
                    "still have theirs hold their last command: plug it in again, or switch them "
                    "off."
                )
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
        if sample.voltage_v is not None:
            low, high = self._supply_v
            k = self._out_of("voltage", sample.voltage_v, self._supply_v, valid, now)
            if k is not None:
                volts = sample.voltage_v[k]
                cure = "Charge the battery or check the supply."
                if not 0 <= volts < np.inf:
                    cure = "That is no measurement: check the servo's cable and its supply."
                elif volts > high:
                    cure = "Switch the supply off and check it: more destroys the servos."
                raise SafetyStop(
                    f"{self._names[k]}: the supply is {volts:.1f} V, outside {low:.1f} to "
                    f"{high:.1f} V. {cure}"
                )
        if sample.temperature_c is not None:
            low, high = self._limits.coldest_c, self._limits.temperature_c
            k = self._out_of("heat", sample.temperature_c, (low, high), valid, now)
            if k is not None:
                degrees = sample.temperature_c[k]
                cure = "Let it cool down, then use a smaller amplitude or fewer frequencies."
                if not low <= degrees < np.inf:
                    cure = "That is no measurement: check its cable; its sensor may be broken."
                raise SafetyStop(f"{self._names[k]} is at {degrees:.0f} °C. {cure}")
        if sample.status is not None:
            k = self._persistent("status", sample.status != 0, valid, now)
            if k is not None:
                words = error_words(self._bus, int(sample.status[k]))
                raise SafetyStop(
                    f"{self._names[k]} reports an error: {words}. "
                    "Relieve it, and switch its power off and on if the error stays."
                )

    def _out_of(
        self, what: str, value: Angles, ends: tuple, valid: NDArray[np.bool_], now: float
    ) -> int | None:
        """Index of a joint whose value has been out of range, or none, for `fault_for_s`.

        Where the position is missing, too, a value that is none is a lost reading.
        """
        number = np.isfinite(value)
        inside = number & (value >= ends[0]) & (value <= ends[1])
        return self._persistent(what, ~inside & (number | valid), inside, now)

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
        if now - self._readings[0][0] < window:
            return
        # a command of the last third may not show yet
        moved, spread = self._motion(now - window, now - window / 3)
        k = _first((moved >= self._limits.frozen_command_rad) & (spread < _SAME_RAD))
        if k is not None:
            raise SafetyStop(
                f"{self._names[k]} was commanded to move by {moved[k]:.2f} rad within "
                f"{window:g} s, and its reading did not change once. "
                + self._why_still(k, "has stopped answering")
            )

    def _check_following(self, now: float) -> None:
        """Stop if a command moved far, long enough ago, and its readings stayed within noise."""
        limits = self._limits
        moved, spread = self._motion(now - limits.follows_within_s, now - limits.frozen_after_s)
        still = spread <= np.minimum(limits.follows_share * moved, self._flicker_rad)
        k = _first((moved >= limits.follows_rad) & still)
        if k is None:  # friction may hold a joint at a small motion, so its servo is asked
            k = self._limp((moved >= limits.frozen_command_rad) & still, now)
        if k is not None:
            raise SafetyStop(
                f"{self._names[k]} was commanded to move by {moved[k]:.2f} rad within "
                f"{limits.follows_within_s:g} s, and its reading stayed within {spread[k]:.3f} "
                "rad. " + self._why_still(k, "its reading is stuck but for noise")
            )

    def _limp(self, suspects: NDArray[np.bool_], now: float) -> int | None:
        """Index of a suspect whose torque is off; one is asked each `frozen_after_s`."""
        if not suspects.any() or now < self._ask_s:
            return None
        self._ask_s = now + self._limits.frozen_after_s
        k = int(np.argmax(suspects))
        return k if self._has_lost_torque(k) else None

    def _has_lost_torque(self, k: int) -> bool:
        ask = getattr(self._bus, "has_lost_torque", None)
        return ask is not None and ask(self._names[k])

    def _why_still(self, k: int, otherwise: str) -> str:
        """Why a joint does not move, and what to do; reads whether its servo lost its torque."""
        if self._has_lost_torque(k):
            return (
                "Its torque is off although it was switched on: its supply failed for a moment, or "
                "it shut down. Check the supply and the plugs, then start again."
            )
        return f"It is blocked, without power, or {otherwise}; switch the servos' power off and on."

    def _motion(self, begin: float, visible_at: float) -> tuple[Angles, Angles]:
        """Range of each command from `begin` to `shown`, and of its readings from `begin` on [rad].

        That of readings is infinite where there are too few, or none after `shown`: silence is
        another fault.
        """
        nothing = np.zeros(len(self._names))
        sent = np.array([x for t, x in self._commands if begin <= t <= visible_at])
        read = np.array([x for t, x in self._readings if t >= begin])
        late = np.array([x for t, x in self._readings if t >= visible_at])
        if len(sent) < 2 or len(read) < _FEWEST_READINGS or not len(late):
            return nothing, nothing + np.inf
        low = np.nanmin(read, axis=0, initial=np.inf)
        high = np.nanmax(read, axis=0, initial=-np.inf)
        seen = np.isfinite(late).any(axis=0)
        return np.ptp(sent, axis=0), np.where(seen, high - low, np.inf)

    def _check_astray(self, now: float, command: Angles) -> None:
        """Stop if a joint has been at rest for a while, away from its command."""
        since = now - self._limits.astray_after_s
        if not self._commands or self._commands[0][0] > since:
            return
        goal = self._servo_angles(command)
        sent = np.array([x for t, x in self._commands if t >= since] or [goal])
        read = np.array([x for t, x in self._readings if t >= now - 0.3])
        resting = np.ptp(sent, axis=0) < 0.02
        has_readings = np.isfinite(read).any(axis=0)
        away = np.zeros(len(self._names))
        away[has_readings] = np.nanmedian(read[:, has_readings], axis=0) - goal[has_readings]
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
    indices = np.flatnonzero(flags)
    return int(indices[0]) if len(indices) else None
