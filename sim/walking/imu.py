"""The IMU of many robots: sampled at its own rate, late, mounted askew and biased.

The trunk's rates and the direction of gravity are kept at the last control steps. A sample of
another time is interpolated between them. With all of `Differences` off it reports the truth.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sim.walking.differences import Differences

Array = NDArray[np.float64]


class Imu:
    """Rates and direction of gravity as n robots measure them.

    Parameters
    ----------
    settings : Differences
    robots : int
    span_s : float
        Control step [s].

    Attributes
    ----------
    mounting_rad, bias_rad_s : ndarray, shape (n, 3)
        Rotation vector of the IMU, constant error of its rates.
    latency_s, period_s : ndarray, shape (n,)
        Age of the newest sample, time between samples.
    """

    def __init__(self, settings: Differences, robots: int, span_s: float):
        self._settings, self._span = settings, span_s
        self.mounting_rad, self.bias_rad_s = np.zeros((robots, 3)), np.zeros((robots, 3))
        self.latency_s, self.period_s = np.zeros(robots), np.zeros(robots)
        self._since = np.zeros(robots)  # from a sample to the present step
        oldest = settings.imu_latency_s[1] + settings.imu_period_s[1]
        # in turn, the newest where `_at` says; rates, then gravity
        self._kept = np.zeros((int(np.ceil(oldest / span_s)) + 2, robots, 6))
        self._at = np.zeros(robots, int)

    @property
    def state(self) -> dict[str, Any]:
        """Everything that changes, live."""
        return {
            "mounting_rad": self.mounting_rad, "bias_rad_s": self.bias_rad_s,
            "latency_s": self.latency_s, "period_s": self.period_s, "since": self._since,
            "kept": self._kept, "at": self._at,
        }  # fmt: skip

    def reset(
        self, ids: NDArray[np.intp], rate: Array, gravity: Array, rng: np.random.Generator
    ) -> None:
        """Draw the IMU of some robots that have long been as they are; nothing that is off."""
        own, n = self._settings, len(ids)
        if own.imu_mounting_rad:
            most = own.imu_mounting_rad
            self.mounting_rad[ids] = rng.uniform(-most, most, (n, 3))
        if own.gyro_bias_rad_s:
            most = own.gyro_bias_rad_s
            self.bias_rad_s[ids] = rng.uniform(-most, most, (n, 3))
        if own.imu_late:
            self.latency_s[ids] = rng.uniform(*own.imu_latency_s, n)
            self.period_s[ids] = rng.uniform(*own.imu_period_s, n)
            self._since[ids] = rng.random(n) * self.period_s[ids]
            self._kept[:, ids, :3], self._kept[:, ids, 3:] = rate, gravity

    def advance(self, rows: slice, rate: Array, gravity: Array) -> None:
        """Let one control step pass, at whose end robots `rows` have these rates and gravity."""
        if not self._settings.imu_late:
            return
        at = (self._at[rows] + 1) % len(self._kept)
        self._at[rows] = at
        each = np.arange(rows.start, rows.stop)
        self._kept[at, each, :3], self._kept[at, each, 3:] = rate, gravity
        period = self.period_s[rows]
        since = self._since[rows] + self._span
        self._since[rows] = np.where(period > 0, since % np.where(period > 0, period, 1.0), 0.0)

    def read(
        self, rows: slice | NDArray[np.intp], rate: Array, gravity: Array
    ) -> tuple[Array, Array]:
        """Measured rates [rad/s] and direction of gravity, shape (k, 3) each; given the true."""
        own = self._settings
        if own.imu_late:
            age = (self.latency_s[rows] + self._since[rows]) / self._span
            whole = age.astype(int)
            share, size = (age - whole)[:, None], len(self._kept)
            each = np.arange(self._kept.shape[1])[rows]
            newer = self._kept[(self._at[rows] - whole) % size, each]
            older = self._kept[(self._at[rows] - whole - 1) % size, each]
            seen = newer + share * (older - newer)
            rate, gravity = seen[:, :3], seen[:, 3:]
        if own.imu_askew:
            turn = self.mounting_rad[rows]
            # small angles: axes of the IMU turned by +θ see vectors turned by -θ
            rate = rate - np.cross(turn, rate) + self.bias_rad_s[rows]
            gravity = gravity - np.cross(turn, gravity)
        if own.imu_late or own.imu_askew:
            gravity = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
        return rate, gravity
