"""One emulated robot that walks on flat ground, as a `ServoPlant` with an IMU.

Its servos are those of `sim.emulator`. MuJoCo steps it only to the instant of a call; a robot at
rest is not stepped until a command moves it. Commands come at any instant, not only on physics
steps: each actuator gets the mean of its held command over the step before
(`sim.robot.servo_mjcf.for_commands_between_steps`). The last two seconds are kept, because servos
are polled one after the other, each a little before the latest evaluated instant. `trunk` gives the
true motion, for scoring. `WalkingBus` puts it behind the same bus as a real one:

    bus = GuardedBus(WalkingBus(draw_robot(rng), rng))
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass, replace
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.hardware.bus import BusSample, Sent, finite_angles
from pupper_sysid.hardware.imu import GRAVITY_M_S2, SAMPLE_RATE_HZ, ImuSample, as_words, from_chip
from pupper_sysid.hardware.joint_map import (
    SCHEMA,
    SCHEMA_VERSION,
    JointEntry,
    JointMap,
    JointMapFile,
    load_joint_map,
)
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import SHORTEST_DELAY_S, EmulatedRobot, RobotSpec, draw_robot
from pupper_sysid.sim.robot.body import Body, mini_pupper
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import robot_xml
from pupper_sysid.sim.robot.servo_mjcf import for_commands_between_steps, hold, switch_torque
from pupper_sysid.sim.robot.terrain import make_ground
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

PHYSICS_STEP_S = 0.001
"""Half the step of training, so that a policy is not scored in the simulator it learnt in."""

ACCELERATION_NOISE_G, RATE_NOISE_DEG_S = 0.002, 0.15
"""Standard deviations of a chip of this class over its whole bandwidth, not measured on this one;
white, without bias."""

_IMU = "emulated_imu"
_MEMORY_STEPS = 2048
_SETTLING_S = 1.0
_STILL_RAD_S, _STILL_RAD_S2 = 1e-3, 1e-2  # of the trunk m/s and m/s²; settled, 1e-5 are left
_CHIP_UNITS = np.repeat([GRAVITY_M_S2, np.pi / 180], 3)
_NOISE = np.repeat([ACCELERATION_NOISE_G, RATE_NOISE_DEG_S], 3)


@dataclass(frozen=True)
class Trunk:
    """True motion of the trunk."""

    position_m: NDArray[np.float64]
    """Of its origin, from its place at time 0; z above the ground; shape (3,)."""
    velocity_m_s: NDArray[np.float64]
    """In the axes of the trunk: forward, to the left, up; shape (3,)."""
    yaw_rate_rad_s: float
    """About its vertical axis, to the left."""
    upright: float
    """Cosine of its tilt: 1 standing level, 0 on its side, -1 on its back."""


class WalkingRobot:
    """A robot that walks: a `ServoPlant`, for any number of threads.

    Every dead time of its servos is at least two physics steps; `rng` draws the IMU's noise. `body`
    is the Mini Pupper 2 by default; the servos are in the order of its joints.
    """

    def __init__(
        self,
        robot: EmulatedRobot,
        rng: np.random.Generator,
        body: Body | None = None,
    ):
        self.body = body = body or mini_pupper()
        self._rng, self._dt, self._lock = rng, PHYSICS_STEP_S, RLock()
        native = {
            s.joint: for_commands_between_steps(s.actuator, PHYSICS_STEP_S, s.joint)
            for s in robot.servos
        }
        self._model = _model(body, native)
        self._data = mujoco.MjData(self._model)
        self._gains = self._model.actuator_biasprm.copy()
        self._effort = np.array([s.actuator.effort_limit for s in robot.servos], float)
        self._force = self._data.actuator_force
        self._acceleration, self._rate = (
            self._data.sensor(name).data for name in ("accelerometer", "gyro")
        )
        layout, joints = body_joint_map(body), len(body.joints)
        # servo coordinates of absolute angles: a calf's is that with its thigh at neutral
        self._shift = layout.per_servo().to_angles(layout.to_counts(np.zeros(joints)))
        delays = [float(np.asarray(s.actuator.dead_time_s)) for s in robot.servos]
        self._settled_after = int(max(delays) / PHYSICS_STEP_S) + 3
        self._linked = np.array(body.linked, int)
        self._goal = self._absolute(body.pose)
        self._queue: deque[tuple[float, int, float]] = deque()
        self._angles = np.zeros((_MEMORY_STEPS, joints))  # absolute
        self._forces = np.zeros((_MEMORY_STEPS, joints))
        self._chip = np.zeros((_MEMORY_STEPS, 6))  # m/s², rad/s, along the chip's axes
        self._sampled = np.zeros(joints, int)
        self._conversion = -1
        self._sample: ImuSample | None = None
        self._step = self._changed = 0
        self._stand()

    def command(self, index: int, time_s: float, angle_rad: float) -> None:
        """Command one servo [rad] from `time_s` on, which must not go backwards.

        A limp servo ignores it.
        """
        with self._lock:
            goal = float(angle_rad) - self._shift[index]
            queued = [g for _, i, g in self._queue if i == index]
            latest = queued[-1] if queued else self._goal[index]
            limp = not self._model.actuator_biasprm[index].any()
            if not limp and goal != latest:
                self._queue.append((time_s, index, goal))

    def torque(self, index: int, time_s: float, on: bool) -> None:
        """Hold the present position, or go limp, from `time_s` on."""
        with self._lock:
            held = self.angle(index, time_s) - self._shift[index]
            switch_torque(self._model, self._gains, on, index)
            self._queue = deque(e for e in self._queue if e[1] != index)
            self._hold(index, held)
            self._changed = self._step

    def angle(self, index: int, time_s: float) -> float:
        """True angle of a servo [rad], at most two seconds before the latest call."""
        with self._lock:
            before, after, share = self._moment(time_s)
            self._sampled[index] = after
            first, second = self._angles[before, index], self._angles[after, index]
            # exact inside a step: MuJoCo moves the joints with the velocity at the step's end
            return float(first + share * (second - first) + self._shift[index])

    def load(self, index: int) -> float:
        """Signed share of a servo's effort limit in use at the time of the last `angle` call."""
        with self._lock:
            return float(self._forces[self._sampled[index], index] / self._effort[index])

    def imu(self, time_s: float) -> ImuSample | None:
        """Latest sample of the chip, at most 1/235 s old.

        True rate and specific force with white noise, in whole counts, clipped as the chip clips.
        """
        with self._lock:
            conversion = int(time_s * SAMPLE_RATE_HZ)
            if conversion > self._conversion:
                at = conversion / SAMPLE_RATE_HZ
                raw = self._chip[self._moment(at)[1]] / _CHIP_UNITS
                raw += _NOISE * self._rng.standard_normal(6)
                self._conversion, self._sample = conversion, from_chip(at, as_words(raw))
            return self._sample

    def trunk(self, time_s: float) -> Trunk:
        """True motion of the trunk at `time_s`, or at the latest evaluated instant."""
        with self._lock:
            self._advance(self._steps(time_s))
            position, velocity = self._data.qpos[:3].copy(), self._data.qvel[:3]
            axes = np.empty(9)
            mujoco.mju_quat2Mat(axes, self._data.qpos[3:7])
            axes = axes.reshape(3, 3)  # columns: the trunk's axes in the world
            rate, upright = float(self._data.qvel[5]), float(axes[2, 2])
            return Trunk(position, axes.T @ velocity, rate, upright)

    def push(self, velocity_m_s: NDArray[np.float64]) -> None:
        """Give the trunk a horizontal velocity, shape (2,), in the world's axes, now."""
        with self._lock:
            self._data.qvel[:2] = velocity_m_s
            self._changed = self._step

    # ------------------------------------------------------------------------- time

    def _stand(self) -> None:
        """Stand at the origin in the default pose, settled, with full delay lines."""
        if not self.body.is_mini_pupper:  # other robots start where their file places them
            self._data.qpos[:7] = [0, 0, self.body.standing_height_m, 1, 0, 0, 0]
        self._data.qpos[7:] = self.body.pose
        for index, held in enumerate(self._goal.copy()):
            self._hold(index, held)
        for _ in range(round(_SETTLING_S / self._dt)):
            mujoco.mj_step(self._model, self._data)
        w, _, _, z = self._data.qpos[3:7]
        heading = np.arctan2(z, w)  # half of it
        turn = np.array([np.cos(heading), 0.0, 0.0, -np.sin(heading)])
        mujoco.mju_mulQuat(self._data.qpos[3:7], turn, self._data.qpos[3:7].copy())
        self._data.qpos[:2] = 0.0
        mujoco.mj_forward(self._model, self._data)
        self._changed = -self._settled_after - 1
        self._remember()

    def _absolute(self, joints: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the servos hold: thigh + calf at a calf behind a linkage."""
        held = np.array(joints)
        held[self._linked] += held[self._linked - 1]
        return held

    def _hold(self, index: int, held: float) -> None:
        """Set a servo as if commanded to `held` [rad, absolute] for long."""
        self._goal[index] = held
        hold(self._model, self._data, index, held)

    def _steps(self, time_s: float) -> int:
        return int(np.ceil(time_s / self._dt - 1e-9))

    def _moment(self, time_s: float) -> tuple[int, int, float]:
        """Rows of the memory on both sides of a time, and where it lies between them."""
        after = self._steps(time_s)
        self._advance(after)
        oldest = max(self._step - _MEMORY_STEPS + 1, 0)
        after = min(max(after, oldest), self._step)
        before = max(after - 1, oldest)
        share = min(max(time_s / self._dt - before, 0.0), 1.0)
        return before % _MEMORY_STEPS, after % _MEMORY_STEPS, share

    def _advance(self, last: int) -> None:
        """Take physics steps until the state is that of the start of step `last`."""
        while self._step < last:
            # step k sees the commands of step k - 1
            event = int(self._queue[0][0] / self._dt) + 1 if self._queue else last
            if event <= self._step:
                self._data.ctrl[:] = self._mean_of_last_step()
                self._changed = self._step
                self._take_step()
            elif self._resting():
                self._rest_until(min(event, last))
            else:
                self._data.ctrl[:] = self._goal
                self._take_step()

    def _take_step(self) -> None:
        mujoco.mj_step(self._model, self._data)
        self._step += 1
        self._remember()

    def _remember(self) -> None:
        """Write the present state into the memory; forces and sensors are one step old."""
        row = self._step % _MEMORY_STEPS
        angles, chip = self._angles[row], self._chip[row]
        angles[:] = self._absolute(self._data.qpos[7:])
        self._forces[row] = self._force
        chip[:3], chip[3:] = self._acceleration, self._rate

    def _rest_until(self, until: int) -> None:
        """Let time pass without motion until step `until`."""
        now = self._step % _MEMORY_STEPS
        rows = np.arange(max(self._step, until - _MEMORY_STEPS) + 1, until + 1) % _MEMORY_STEPS
        for memory in (self._angles, self._forces, self._chip):
            memory[rows] = memory[now].copy()
        self._step = until

    def _mean_of_last_step(self) -> NDArray[np.float64]:
        """Mean of the commands over the step before the present one; takes them off the queue."""
        since, stop = (self._step - 1) * self._dt, self._step * self._dt
        mean = self._goal.copy()
        while self._queue and self._queue[0][0] < stop:
            at, index, goal = self._queue.popleft()
            share = (stop - max(at, since)) / self._dt
            mean[index] += share * (goal - self._goal[index])
            self._goal[index] = goal
        return mean

    def _resting(self) -> bool:
        """Whether another step would change nothing visible."""
        return (
            self._step - self._changed > self._settled_after
            and np.abs(self._data.qvel).max() < _STILL_RAD_S
            and np.abs(self._data.qacc).max() < _STILL_RAD_S2
        )


def body_joint_map(body: Body) -> JointMap:
    """Joint map of an emulated robot: one direct servo of 4,096 counts a turn on each joint.

    Counts are in the middle between a joint's limits; the Mini Pupper's map is that of its robot.
    """
    if body.is_mini_pupper:
        return load_joint_map("mini_pupper_2")
    counts, source = 4096, f"emulated {body.name}"
    entries = {
        name: JointEntry(
            id=i, sign=1, neutral_rad=float(low + high) / 2, counts_per_rad=counts / (2 * np.pi),
            offset_counts=0, limits_counts=(0, counts - 1),
            limits_rad=(float(low), float(high)), source=source,
        )
        for i, (name, low, high) in enumerate(
            zip(body.joints, body.low, body.high, strict=True)
        )
    }  # fmt: skip
    # not validated: names of joints are those of the MJCF, and none of its servos is a real one
    file = JointMapFile.model_construct(
        schema_=SCHEMA, schema_version=SCHEMA_VERSION, name=source, frame="raw", counts=counts,
        servo=None, linkage="none", source=source, joints=entries,
    )  # fmt: skip
    return JointMap(file, body.joints)


def _model(body: Body, servos: dict[str, DelayedPDParameters]) -> Any:
    """The robot on flat ground, compiled, with an IMU."""
    if body.is_mini_pupper:
        return mujoco.MjModel.from_xml_string(robot_xml(servos, PHYSICS_STEP_S))
    ground = make_ground("flat", np.random.default_rng(0))
    spec = mujoco.MjSpec.from_string(body.xml(servos, PHYSICS_STEP_S, ground, "evaluation"))
    # mounted as the Mini Pupper's chip (`hardware.imu`): x and y exchanged, z down
    spec.body(body.trunk).add_site(name=_IMU, xyaxes=[0, 1, 0, 1, 0, 0])
    for name, kind in (
        ("gyro", mujoco.mjtSensor.mjSENS_GYRO),
        ("accelerometer", mujoco.mjtSensor.mjSENS_ACCELEROMETER),
    ):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=_IMU)
    return spec.compile()


def calibrated_robot(
    servos: ServoRanges, rng: np.random.Generator, body: Body | None = None
) -> EmulatedRobot:
    """An emulated robot with the servos of a calibration or preset.

    Its servos have the calibration's values and lag; the shortest dead time that can be emulated is
    2 ms. The bus polls all of them with the median of their periods and losses. Counts, offsets of
    the readings and the host's timing are those of `draw_robot`; another robot than the Mini Pupper
    2 reads as fine as the calibration's servos.
    """
    feedback = servos.feedback
    spec = RobotSpec(
        poll_period_s=float(np.median([servo.poll_period_s for servo in feedback])),
        loss=float(np.median([servo.loss for servo in feedback])),
        command_jitter_s=servos.command_jitter_s,
    )
    layout = None
    if body is not None and not body.is_mini_pupper:
        layout = body_joint_map(body)
        quantum = float(np.median([servo.quantum_rad for servo in feedback]))
        spec = replace(spec, quantum_rad=quantum, reading_noise_rad=quantum / 2)
    drawn = draw_robot(rng, spec, layout)
    parameters = servos.in_steps_of(PHYSICS_STEP_S).nominal()
    emulated = []
    for servo in drawn.servos:
        values = {name: float(np.asarray(x)) for name, x in asdict(parameters[servo.joint]).items()}
        # an emulated servo's dead time is without the mean latency of commands
        late = values["dead_time_s"] - spec.command_jitter_s
        values["dead_time_s"] = max(late, SHORTEST_DELAY_S)
        emulated.append(replace(servo, actuator=DelayedPDParameters(**values)))
    return replace(drawn, servos=tuple(emulated))


class WalkingBus:
    """A `hardware.bus.ServoBus` with an IMU (`hardware.imu.Imu`) of an emulated robot that walks.

    Commands and readings are in joint coordinates (a calf relative to its thigh;
    `hardware.joint_map`) and pass through `EmulatedBus`: quantisation, polls in turn, lost polls,
    offset, noise. The calf's reading is that of two servos, polled at different times. `truth` are
    the servos and their feedback; `rng` decides lost polls, noise and timing. Time is virtual, or
    the host's. `robot` is the robot behind the bus.
    """

    name = "emulated"

    def __init__(
        self,
        truth: EmulatedRobot,
        rng: np.random.Generator,
        real_time: bool = False,
        body: Body | None = None,
    ):
        self.joint_names: tuple[str, ...] = truth.joint_names
        self.robot = WalkingRobot(truth, rng.spawn(1)[0], body=body)
        self._bus = EmulatedBus(truth, rng, real_time, self.robot, keep_log=False)
        self._map = body_joint_map(self.robot.body)
        self._servo_map = self._map.per_servo()
        self.limits = self._map.position_limits()
        about = {"kind": "emulated walking robot", "coordinates": "joint"}
        self.metadata: dict[str, Any] = self._bus.metadata | about

    def now(self) -> float:
        """Time of the bus's clock [s], from 0 at construction."""
        return self._bus.now()

    def sleep_until(self, time_s: float) -> None:
        """Return when `now()` has reached `time_s`; in virtual time only the physics costs."""
        self._bus.sleep_until(time_s)

    def write(self, position_rad: NDArray[np.float64]) -> Sent:
        """Send commands of the joints [rad], shape (12,)."""
        goal = finite_angles(position_rad, len(self.joint_names), self.name)
        sent = self._bus.write(self._servo_map.to_angles(self._map.to_counts(goal)))
        return Sent(sent.time_s, goal)

    def read(self) -> BusSample:
        """Read all joints once: the values of the last successful poll of each servo."""
        sample = self._bus.read()
        joints = self._map.to_angles(self._servo_map.to_counts(sample.position_rad))
        return replace(sample, position_rad=joints)

    def imu(self) -> ImuSample | None:
        """Latest sample of the IMU."""
        now = self.now()
        sample = self.robot.imu(now)
        return None if sample is None else replace(sample, time_s=now)

    def torque(self, on: bool) -> bool:
        """Hold the present pose, or switch the torque off."""
        return self._bus.torque(on)

    def close(self) -> None:
        """Release the bus."""
        self._bus.close()
