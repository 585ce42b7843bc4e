"""What robots measure of themselves: joint angles as their bus reports them, and their IMUs.

Held feedback (`servo_models.held_feedback`) passes one control step at a time: the simulator gives
the positions after each physics step, and each poll that falls between them is interpolated there.
Servo `i` of twelve is polled a share `i / 12` of a round after the first, in the order of the
joints (the robot's firmware, and so the emulated bus, goes by the servos' ids). Joint rates are
differences of readings over a few control steps, as the controller of a real robot computes them.

An IMU is sampled at its own rate, late, mounted askew and biased. The trunk's rates and the
direction of gravity are kept at the last control steps, and a sample of another time is
interpolated between them. With all of `Differences` off it reports the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.sim.emulator.robot import RobotSpec
from pupper_sysid.sim.robot.robot_batch import Moved, RobotBatch
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.draws import Differences
from pupper_sysid.sim.walking.servo_ranges import ServoRanges
from pupper_sysid.sim.walking.step import VELOCITY_STEPS

Array = NDArray[np.float64]
Rows = slice | NDArray[np.intp]

# as of the emulated bus
_JITTER_S, _DRIFT = RobotSpec.poll_jitter_s, RobotSpec.poll_drift


class HeldReadings:
    """Readings of all servos of `environments` robots.

    `advance` is given positions that are `physics_step_s` apart. Servos that are `linked` turn
    their joint and the one before it, so that they read the sum of both. `shortest_period` is the
    least factor on a robot's periods that `reset` is given.

    `position` and `load`, shape (environments, servos): angle [rad] and torque [N·m] at the last
    successful poll, `age_s` the age of that. `rng` draws phases, drift, jitter and lost polls.
    """

    def __init__(
        self,
        feedback: Sequence[HeldFeedback],
        environments: int,
        physics_step_s: float,
        rng: np.random.Generator,
        linked: Sequence[int] = (),
        shortest_period: float = 1.0,
    ):
        self._shortest = shortest_period
        self._period = np.array([f.poll_period_s for f in feedback])
        self._loss = np.array([f.loss for f in feedback])
        quantum = np.array([f.quantum_rad for f in feedback])
        # readings without quantisation step are left as they are
        self._quantum, self._exact = np.where(quantum > 0, quantum, 1.0), quantum <= 0
        self._offset = np.array([f.offset_rad for f in feedback])
        self._step, self.rng, self._linked = physics_step_s, rng, np.array(linked, int)
        self._direct = self._period <= 0
        self._servos = np.arange(len(feedback))
        shape = (environments, len(feedback))
        self._lattice = np.ones(shape)  # period of each robot's rounds
        self._next = np.zeros(shape)  # time until the next poll
        self.position, self.load = np.zeros(shape), np.zeros(shape)
        self.age_s = np.zeros(shape)

    @property
    def state(self) -> dict[str, Array]:
        """Everything that changes, for an exact copy."""
        return {
            "lattice": self._lattice, "next": self._next, "position": self.position,
            "load": self.load, "age_s": self.age_s,
        }  # fmt: skip

    def reset(
        self,
        ids: NDArray[np.intp],
        position: Array,
        period: Array | float = 1.0,
    ) -> None:
        """Start robots `ids` at rest.

        They rest at servo angles `position` [rad], shape (len(ids), servos); `period` is a factor
        on the periods of their polls, one or one each.
        """
        servos = len(self._period)
        wander = 1.0 + _DRIFT * self.rng.standard_normal((len(ids), 1))
        wander *= np.broadcast_to(period, len(ids))[:, None]
        self._lattice[ids] = self._period * wander
        first = self.rng.random((len(ids), 1)) + np.arange(servos) / servos
        self._next[ids] = self._lattice[ids] * (first % 1.0)
        self.position[ids] = self._reported(position)
        self.load[ids] = 0.0
        self.age_s[ids] = self._lattice[ids] - self._next[ids]

    def chances(self, steps: int) -> Array:
        """Draw what decides losses and jitters of a control step of so many physics steps.

        Shape (environments, rounds, 2, servos): for all robots at once and for all servos, due or
        not, so that neither the order in which robots are advanced nor their number at a time
        changes their readings, and twins (`sim.walking.draws`) have the same.
        """
        rounds = 0
        if not self._direct.all():
            shortest = self._period[~self._direct].min() * (1 - 6 * _DRIFT) * self._shortest
            rounds = int(steps * self._step / shortest) + 1
        return self.rng.random((len(self.position), rounds, 2, len(self._period)))

    def advance(
        self,
        start: Array,
        position: Array,
        load: Array,
        chances: Array,
        rows: slice = slice(None),
    ) -> None:
        """Let one control step pass for the robots `rows`, n of them.

        `start` are the joint angles before [rad], shape (n, servos); `position` those after each
        physics step, the last columns of (n, physics steps, servos or more); `load` the servo
        torque in each physics step [N·m], shape (n, physics steps, servos), both C-contiguous;
        `chances` as drawn by the method of that name.
        """
        count, steps, width = position.shape
        span, servos = steps * self._step, len(self._period)
        held, torque, age = self.position[rows], self.load[rows], self.age_s[rows]
        next_, lattice, direct = self._next[rows], self._lattice[rows], self._direct
        age += span
        if direct.any():
            now = position[:, -1, width - servos :].copy()
            now[:, self._linked] += now[:, self._linked - 1]
            held[:, direct] = self._reported(now)[:, direct]
            torque[:, direct], age[:, direct] = load[:, -1][:, direct], 0.0
        # places in the flat arrays, of each robot's and servo's first value
        first = np.arange(count)[:, None] * steps
        at, at_load = first * width + (width - servos + self._servos), first * servos + self._servos
        flat, flat_load = position.reshape(-1), load.reshape(-1)
        for lost, shifted in chances[rows].transpose(1, 2, 0, 3):
            due = next_ <= span
            due &= ~direct
            # a uniform jitter of the same variance stays within bounds
            instant = np.clip(next_ + _JITTER_S * np.sqrt(12) * (shifted - 0.5), 0.0, span)
            place = instant / self._step
            before = np.minimum(place.astype(np.intp), steps - 1)
            share = place - before
            angle = _between(flat, at + before * width, width, start, before, share)
            calf = self._linked
            if len(calf):
                angle[:, calf] += _between(
                    flat, at[:, calf - 1] + before[:, calf] * width, width, start[:, calf - 1],
                    before[:, calf], share[:, calf],
                )  # fmt: skip
            read = due & (lost >= self._loss)
            np.copyto(held, self._reported(angle), where=read)
            np.copyto(torque, flat_load.take(at_load + before * servos), where=read)
            np.copyto(age, span - instant, where=read)
            np.add(next_, lattice, out=next_, where=due)
        next_ -= span

    def _reported(self, angle: Array) -> Array:
        """`angle` as the encoder reports it: with its offset, in whole quantisation steps."""
        shifted = angle + self._offset
        quantised = np.rint(shifted / self._quantum) * self._quantum
        return np.where(self._exact, shifted, quantised) if self._exact.any() else quantised


def _between(
    flat: Array,
    at: NDArray[np.intp],
    width: int,
    start: Array,
    before: NDArray[np.intp],
    share: Array,
) -> Array:
    """Values a `share` of a step after step `before`, which end at `at`; `start` is before all."""
    ends = flat.take(at)
    begins = np.where(before > 0, flat.take(at - width, mode="clip"), start)
    return begins + share * (ends - begins)


class Imu:
    """Rates and direction of gravity as n robots measure them.

    `mounting_rad` and `bias_rad_s`, shape (n, 3): rotation vector of the IMU, constant error of its
    rates; `latency_s` and `period_s`, shape (n,): age of the newest sample, time between samples.
    """

    def __init__(self, settings: Differences, robots: int, span_s: float):
        self._settings, self._span = settings, span_s
        self.mounting_rad, self.bias_rad_s = np.zeros((robots, 3)), np.zeros((robots, 3))
        self.latency_s, self.period_s = np.zeros(robots), np.zeros(robots)
        self._since = np.zeros(robots)  # from a sample to the present step
        oldest = settings.imu_latency_s[1] + settings.imu_period_s[1]
        # in turn, the newest where `_at` says; rates, then gravity
        self._recent = np.zeros((int(np.ceil(oldest / span_s)) + 2, robots, 6))
        self._at = np.zeros(robots, int)

    @property
    def state(self) -> dict[str, Any]:
        """Everything that changes, live."""
        return {
            "mounting_rad": self.mounting_rad, "bias_rad_s": self.bias_rad_s,
            "latency_s": self.latency_s, "period_s": self.period_s, "since": self._since,
            "kept": self._recent, "at": self._at,
        }  # fmt: skip

    def reset(
        self, ids: NDArray[np.intp], rate: Array, gravity: Array, rng: np.random.Generator
    ) -> None:
        """Draw the IMU of some robots that have long been as they are; nothing that is off."""
        settings, n = self._settings, len(ids)
        if settings.imu_mounting_rad:
            most = settings.imu_mounting_rad
            self.mounting_rad[ids] = rng.uniform(-most, most, (n, 3))
        if settings.gyro_bias_rad_s:
            most = settings.gyro_bias_rad_s
            self.bias_rad_s[ids] = rng.uniform(-most, most, (n, 3))
        if settings.imu_late:
            self.latency_s[ids] = rng.uniform(*settings.imu_latency_s, n)
            self.period_s[ids] = rng.uniform(*settings.imu_period_s, n)
            self._since[ids] = rng.random(n) * self.period_s[ids]
            self._recent[:, ids, :3], self._recent[:, ids, 3:] = rate, gravity

    def advance(self, rows: slice, rate: Array, gravity: Array) -> None:
        """Let one control step pass, at whose end robots `rows` have these rates and gravity."""
        if not self._settings.imu_late:
            return
        at = (self._at[rows] + 1) % len(self._recent)
        self._at[rows] = at
        robots = np.arange(rows.start, rows.stop)
        self._recent[at, robots, :3], self._recent[at, robots, 3:] = rate, gravity
        period = self.period_s[rows]
        since = self._since[rows] + self._span
        self._since[rows] = np.where(period > 0, since % np.where(period > 0, period, 1.0), 0.0)

    def read(
        self, rows: slice | NDArray[np.intp], rate: Array, gravity: Array
    ) -> tuple[Array, Array]:
        """Measured rates [rad/s] and direction of gravity, shape (k, 3) each; given the true."""
        settings = self._settings
        if settings.imu_late:
            age = (self.latency_s[rows] + self._since[rows]) / self._span
            age_steps = age.astype(int)
            share, size = (age - age_steps)[:, None], len(self._recent)
            robots = np.arange(self._recent.shape[1])[rows]
            newer = self._recent[(self._at[rows] - age_steps) % size, robots]
            older = self._recent[(self._at[rows] - age_steps - 1) % size, robots]
            seen = newer + share * (older - newer)
            rate, gravity = seen[:, :3], seen[:, 3:]
        if settings.imu_askew:
            turn = self.mounting_rad[rows]
            # small angles: axes of the IMU turned by +θ see vectors turned by -θ
            rate = rate - np.cross(turn, rate) + self.bias_rad_s[rows]
            gravity = gravity - np.cross(turn, gravity)
        if settings.imu_late or settings.imu_askew:
            gravity = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
        return rate, gravity


class Senses:
    """Readings and IMU of n robots, whose joints and trunks are measured.

    `rng` is that of the readings. `kept`, shape (VELOCITY_STEPS + 1, n, 12), has the joint angles
    [rad] as read at the last control steps, in turn.
    """

    def __init__(
        self,
        config: Walking,
        servos: ServoRanges,
        robots: RobotBatch,
        environments: int,
        rng: np.random.Generator,
    ):
        self._robots, self._span = robots, config.control_step_s
        self.readings = HeldReadings(
            servos.feedback, environments, config.physics_step_s, rng, robots.linked,
            config.differences.poll_period[0],
        )  # fmt: skip
        self.imu = Imu(config.differences, environments, config.control_step_s)
        self.recent = np.zeros((VELOCITY_STEPS + 1, environments, len(robots.body.joints)))

    def reset(
        self,
        ids: NDArray[np.intp],
        servo_rad: Array,
        rate: Array,
        gravity: Array,
        rng: np.random.Generator,
    ) -> None:
        """Start robots that have long been as they are; `rng` draws their IMUs."""
        self.readings.reset(ids, servo_rad, self._robots.bodies.poll[ids])
        self.recent[:, ids] = self.angles(ids)
        self.imu.reset(ids, rate, gravity, rng)

    def advance(self, moved: Moved, chances: Array, step: int) -> None:
        """Let the bus poll the servos of robots that have moved; `step` counts control steps."""
        self.readings.advance(moved.start, moved.qpos, moved.load, chances, moved.rows)
        self.recent[step % len(self.recent), moved.rows] = self.angles(moved.rows)

    def angles(self, rows: Rows) -> Array:
        """Joint angles [rad] as the controller reads them now, shape (k, 12)."""
        position = self.readings.position[rows] - self._robots.bodies.zero_rad[rows]
        return self._robots.from_servo(position)

    def joints(self, rows: Rows, step: int) -> tuple[Array, Array, Array]:
        """Angles [rad], rates [rad/s] and efforts [N·m] of joints at the last control step.

        Efforts are 0 on buses without load readings.
        """
        newest = step % len(self.recent)
        angle = self.recent[newest, rows]
        rate = angle - self.recent[(newest + 1) % len(self.recent), rows]
        rate /= VELOCITY_STEPS * self._span
        return angle, rate, self.readings.load[rows] * self._robots.bodies.effort[rows, None]
