"""RobotBatch: many robots in `mujoco.batch`, each with its own servos, friction and payload.

The physics of `sim.walking.env` without its task: draw robots, place them, step them, read their
state. Arrays are (environments, …) NumPy; joint angles are in the order of `Body.joints`, absolute.
Servo delay, gains, limits and friction are MuJoCo's own, so a control step of ten physics steps is
one call (`Batch.rollout`) without Python inside.

With several threads, many robots are stepped in two parts, one after the other, in a thread that
holds no lock: while the second part moves, the caller works on the first. The state of each robot
is the same as in one part, whatever the number of threads.

`Moved` is what the physics did in one control step.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.networks import JointArrays, same_rate
from pupper_sysid.sim.robot import servo_mjcf
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.terrain import Ground
from pupper_sysid.sim.walking.config import Randomisation, Walking
from pupper_sysid.sim.walking.draws import Bodies
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Moved:
    """One control step of some robots, k of them. Arrays are overwritten by the next step."""

    rows: slice
    """Which robots."""
    start: Array
    """Joint angles before [rad]; shape (k, 12)."""
    qpos: Array
    """MuJoCo's, after each physics step; joint angles last; shape (k, physics steps, 19)."""
    load: Array
    """Servo torques in each physics step [N·m]; shape (k, physics steps, 12)."""
    touch: Array
    """Largest force on each foot in the last 6 ms [N]; shape (k, 4)."""
    feet: Array
    """Places of the feet in the world before each physics step [m]; on a Warp device only the last;
    shape (k, physics steps, 4, 3)."""


def gravity_direction(qpos: Array) -> Array:
    """Direction of gravity in the trunk's frame, shape (n, 3), from MuJoCo's positions."""
    w, x, y, z = qpos[:, 3:7].T.copy()
    gravity = np.empty((len(qpos), 3))
    gravity[:, 0] = 2 * (w * y - x * z)
    gravity[:, 1] = -2 * (y * z + w * x)
    gravity[:, 2] = 2 * (x * x + y * y) - 1
    return gravity


def trunk_velocity(qpos: Array, qvel: Array) -> Array:
    """Velocity of the trunk in its own frame [m/s], shape (n, 3), from MuJoCo's state."""
    w, x, y, z = qpos[:, 3:7].T.copy()
    a, b, c = qvel[:, :3].T.copy()
    # rotate by the inverse: v + w t + t × q with t = 2 (v × q), by hand: np.cross is slow
    t, u, v = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
    velocity = np.empty((len(qpos), 3))
    velocity[:, 0] = a + w * t + u * z - v * y
    velocity[:, 1] = b + w * u + v * x - t * z
    velocity[:, 2] = c + w * v + t * y - u * x
    return velocity


def planar(velocity: Array, qvel: Array) -> Array:
    """Forward and sideways speed [m/s] and turn rate [rad/s], shape (n, 3).

    `velocity` is that of `trunk_velocity`.
    """
    return np.column_stack([velocity[:, :2], qvel[:, 5]])


_TOUCH_S = 0.006  # a foot is down if it was so in the last milliseconds: contacts flicker
_RECORD = ("qpos", "actuator_force", "sensordata", "site_xpos")
_MANY = 256  # robots from which parts are worth a second call of every NumPy function
_LATEST = 4.0  # longest latency of a command, in means
_FIRST_PART = 0.625  # while the rest moves, there is time for what follows on the first part


class RobotBatch:
    """Robots on one piece of ground.

    `threads` are 0 for all cores; `servo_model` is that of `sim.walking.env.PupperEnv`;
    `extra_dead_time_s` and `extra_jitter_s`, shape (n,), are added to the dead times and to the
    command jitter of each robot [s].

    `qpos`, shape (n, 19), and `qvel`, (n, 18), are MuJoCo's, live: root first, then the joints.
    `drawn` holds the servos of each robot, shape (n, 12), by field of `DelayedPDParameters`;
    `friction` that of the feet on the ground and `payload_kg` what is added to the trunk, shape
    (n,); `bodies` what else differs from the model; `linked` the servos that turn their joint and
    the one before it.
    """

    def __init__(
        self,
        config: Walking,
        servos: ServoRanges,
        ground: Ground,
        environments: int,
        threads: int,
        servo_model: JointArrays | None,
        extra_dead_time_s: float | Array = 0.0,
        extra_jitter_s: Array | None = None,
    ):
        servos = servos.in_steps_of(config.physics_step_s)
        self.config, self.servos, self.ground = config, servos, ground
        body = self.body = config.body
        joints = len(body.joints)
        if servos.joints != body.joints:
            raise InputError(
                f"The servos are those of {len(servos.joints)} joints ({servos.joints[0]}, …), the "
                f"robot is {body.name}. Give `servo_ranges` its body."
            )
        self.servo_model, self.environments = servo_model, environments
        if servo_model is not None:
            self._check_servo_model(servo_model)
            servo_model.reset(np.zeros((environments, joints)))
        self._extra_s = np.broadcast_to(extra_dead_time_s, environments)
        # with an extra jitter of 0, too, robots draw what they draw beside others that have some
        self._added_jitter = extra_jitter_s is not None
        self._jitter_s = np.zeros(environments) + servos.command_jitter_s
        if extra_jitter_s is not None:
            self._jitter_s += extra_jitter_s
        longest_s = servos.longest_dead_time_s + float(self._extra_s.max())
        longest_s += _LATEST * float(self._jitter_s.max()) * config.differences.command_jitter[1]
        # every buffer holds the longest delay that can be drawn
        longest = {
            name: replace(servo, dead_time_s=np.array(longest_s))
            for name, servo in servos.nominal().items()
        }
        xml = body.xml(longest, config.physics_step_s, ground, config.physics)
        self.model = mujoco.MjModel.from_xml_string(xml)
        self._hash = hashlib.sha256(xml.encode()).hexdigest()
        ground.fill(self.model)
        buffer = self.model.actuator_history[:, 0].min() * config.physics_step_s
        if longest_s > buffer:
            raise InputError(f"A dead time of {longest_s} s does not fit the buffer of {buffer} s.")
        from mujoco.batch import Batch  # needs mujoco 4; its message names the module

        self.batch = Batch(self.model, environments, threads)
        self.linked = body.linked
        self._dof_of = {i: 6 + i for i in range(joints) if i not in self.linked}
        self._tendon_of = {i: k for k, i in enumerate(self.linked)}
        self._after, self._before = np.array(self.linked, int), np.array(self.linked, int) - 1
        names = (*servo_mjcf.BATCH_FIELDS, "geom_friction", "body_mass", "body_ipos")
        names += servo_mjcf.TENDON_FIELDS if self.linked else ()
        self._fields = {name: self.batch.expand(name) for name in names}
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._control, self._activation = self.batch.bind("ctrl"), self.batch.bind("act")
        self._history = self.batch.bind("history")
        self._site_position = self.batch.bind("site_xpos")
        self._empty_lines = servo_mjcf.empty_delay_lines(self.model)
        self._feet_geoms = np.array([self.model.geom(name).id for name in body.foot_geoms])
        self._touch = np.array([self.model.sensor(f"{foot}_touch").adr[0] for foot in body.feet])
        self._touch_steps = max(round(_TOUCH_S / config.physics_step_s), 1)
        self._feet_sites = np.array([self.model.site(foot).id for foot in body.feet])
        self._trunk = self.model.body(body.trunk).id
        # a servo model is fitted in servo coordinates (`hardware.joint_map`): thighs at neutral
        self._bend = self.to_servo(body.pose) - body.pose
        self._warnings = self.batch.warning.copy()
        self.drawn = {f: np.zeros((environments, joints)) for f in servos.value}
        self.friction, self.payload_kg = np.zeros(environments), np.zeros(environments)
        self.bodies = Bodies(config.differences, environments, body)
        cut = round(_FIRST_PART * environments)
        undivided = self.batch.nthread == 1 or environments < _MANY
        ends = (0, environments) if undivided else (0, cut, environments)
        self._parts = [slice(*pair) for pair in pairwise(ends)]
        everyone = np.arange(environments, dtype=np.int32)
        self._ids = [None if undivided else everyone[part] for part in self._parts]
        self._records: list[dict[Any, Array]] = [{} for _ in self._parts]
        self._worker = None if undivided else ThreadPoolExecutor(1, "physics")

    # ------------------------------------------------------------------------- reading

    @property
    def joints(self) -> Array:
        """Joint angles [rad], live, shape (n, 12)."""
        return self.qpos[:, 7:]

    @property
    def joint_velocity(self) -> Array:
        """Joint velocities [rad/s], live, shape (n, 12)."""
        return self.qvel[:, 6:]

    def feet(self, rows: slice | NDArray[np.intp] = slice(None)) -> tuple[Array, Array]:
        """Feet along the ground, (k, 4, 2), and heights of the soles, (k, 4) [m]; one step old."""
        at = self._site_position[rows][:, self._feet_sites]
        return at[..., :2], self.sole_heights(at)

    def sole_heights(self, feet: Array) -> Array:
        """Heights of the soles above the ground under them [m], (...), of feet at (..., 3)."""
        return feet[..., 2] - self.body.sole_m - self.ground.height(feet[..., 0], feet[..., 1])

    def to_servo(self, joints: Array) -> Array:
        """Servo angles of joint angles (..., joints): some servos hold the sum of two."""
        if not self.linked:
            return joints
        servo = joints.copy()
        servo[..., self._after] += joints[..., self._before]
        return servo

    def from_servo(self, servo: Array) -> Array:
        """Joint angles of servo angles; the inverse of `to_servo`."""
        if not self.linked:
            return servo
        joints = servo.copy()
        joints[..., self._after] -= servo[..., self._before]
        return joints

    # ------------------------------------------------------------------------- stepping

    def draw_latency(self, rng: np.random.Generator) -> None:
        """Draw how late each robot's next commands are; nothing is drawn without jitter.

        One latency per robot: a frame carries the commands of all its servos. Its mean is in the
        dead time. With an added jitter, no servo goes back to a command before its latest.
        """
        if self._added_jitter or self.servos.command_jitter_s > 0:
            late = np.minimum(rng.exponential(1.0, self.environments), _LATEST) - 1.0
            late *= self._jitter_s * self.bodies.jitter
            delay = np.maximum(self.drawn["dead_time_s"] + late[:, None], 0.0)
            now = self._fields["actuator_delay"]
            if self._added_jitter:
                delay = np.minimum(delay, now + self.config.control_step_s)
            now[:] = delay

    def step(self, target: Array) -> Iterator[Moved]:
        """Let one control step pass under joint set-points [rad], shape (n, 12).

        The physics runs from this call on; parts of the robots are given as they are done, and must
        all be taken before anything else is called here. The state of those given can be read and
        written meanwhile.
        """
        start, control = self.joints.copy(), None
        if self.servo_model is None:
            self._control[:] = self.to_servo(target) + self.bodies.zero_rad
        else:
            control = self._predicted(self.servo_model, target)
        if self._worker is None:
            return iter([self._rollout(0, start, control)])
        jobs = [
            self._worker.submit(self._rollout, i, start, control) for i in range(len(self._parts))
        ]
        return _results(jobs)

    def _rollout(self, part: int, start: Array, control: Array | None) -> Moved:
        """The physics of one part."""
        rows, records = self._parts[part], self._records[part]
        part_control = None if control is None else control[rows]
        rows_out = self._records[part] = self.batch.rollout(
            self.config.substeps, part_control, record=_RECORD, ids=self._ids[part], out=records
        )
        touch = rows_out["sensordata"][:, -self._touch_steps :, self._touch].max(axis=1)
        feet = rows_out["site_xpos"][:, :, self._feet_sites]
        return Moved(rows, start[rows], rows_out["qpos"], rows_out["actuator_force"], touch, feet)

    def _predicted(self, model: JointArrays, target: Array) -> Array:
        """Controls of each physics step, from the positions that a servo model predicts."""
        before, steps = self._control.copy(), self.config.substeps
        servo = self.to_servo(target) + self.bodies.zero_rad
        predicted = np.asarray(model.step(servo - self._bend), float)
        joints = self.from_servo(predicted + self._bend)
        after = self.to_servo(np.clip(joints, self.body.low, self.body.high))
        share = np.arange(1, steps + 1)[:, None] / steps
        return before[:, None] + share * (after - before)[:, None]

    def broken(self) -> NDArray[np.bool_]:
        """Robots that MuJoCo has reset since the last call, because they became NaN."""
        now = self.batch.warning
        raised = (now != self._warnings).reshape(self.environments, -1).any(axis=1)
        raised |= ~np.isfinite(self.qpos.sum(axis=1) + self.qvel.sum(axis=1))
        self._warnings = now.copy()
        return raised

    # ------------------------------------------------------------------------- a new robot

    def field(self, name: str) -> Array:
        """Live values of a field of `mujoco.MjModel` for each robot, shape (n, …).

        After writing masses or inertias, call `batch.set_const`. A new episode draws friction,
        servos and the trunk's mass anew.
        """
        if name not in self._fields:
            self._fields[name] = self.batch.expand(name)
        return self._fields[name]

    def move(self, ids: NDArray[np.intp], place: Array) -> None:
        """Move robots, as they stand, to places x, y on the ground [m], shape (len(ids), 2)."""
        rise = self._highest_under(place) - self._highest_under(self.qpos[ids, :2])
        self.qpos[ids, :2] = place
        self.qpos[ids, 2] += rise
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_POS.value)

    def draw(self, ids: NDArray[np.intp], rng: np.random.Generator) -> None:
        """Draw servos, friction and payload of some robots."""
        random = self.config.randomisation
        drawn = self.servos.draw(len(ids), random.torque_scale, rng)
        drawn["dead_time_s"] += self._extra_s[ids, None]
        self.bodies.draw(ids, drawn, rng)
        for name, value in drawn.items():
            self.drawn[name][ids] = value
        self.friction[ids] = rng.uniform(*random.friction, len(ids))
        self.payload_kg[ids] = rng.uniform(*random.payload_kg, len(ids))
        self.write(ids)

    def write(self, ids: NDArray[np.intp]) -> None:
        """Give some robots what `drawn`, `friction`, `payload_kg` and `bodies` hold for them."""
        drawn, fields = {k: v[ids] for k, v in self.drawn.items()}, self._fields
        servo_mjcf.write_servos(fields, ids, drawn, self._dof_of, self._tendon_of)
        fields["geom_friction"][ids[:, None], self._feet_geoms, 0] = self.friction[ids, None]
        mass = self.model.body_mass[self._trunk] + self.payload_kg[ids]
        fields["body_mass"][ids, self._trunk] = mass
        centre = self.model.body_ipos[self._trunk] + self.bodies.centre_m[ids]
        fields["body_ipos"][ids, self._trunk] = centre
        self.batch.set_const(ids)

    def place(
        self,
        ids: NDArray[np.intp],
        joints: Array,
        joint_velocity: Array,
        margin_m: float,
        rng: np.random.Generator,
    ) -> None:
        """Place some robots at random, with `joints` as their command for long.

        Joints and their velocities have the shape (len(ids), 12); `margin_m` is the least distance
        from the ground's edge.
        """
        random: Randomisation = self.config.randomisation
        n = len(ids)
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._warnings[ids] = self.batch.warning[ids]  # a reset clears the counters of warnings
        reach = self.ground.half_size_m - margin_m
        place = rng.uniform(-1, 1, (n, 2)) * (reach if np.isfinite(reach) else 0.5)
        yaw = rng.uniform(-np.pi, np.pi, n)
        self.qpos[ids, :2] = place
        self.qpos[ids, 2] = self._highest_under(place) + self.body.standing_height_m + 0.002
        self.qpos[ids, 3:7] = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=1)
        self.qpos[ids, 7:] = joints
        linear = rng.uniform(-1, 1, (n, 3)) * random.base_velocity_m_s
        # the root's velocity is in the world's frame, its rate in its own
        c, s = np.cos(yaw), np.sin(yaw)
        self.qvel[ids, 0] = c * linear[:, 0] - s * linear[:, 1]
        self.qvel[ids, 1] = s * linear[:, 0] + c * linear[:, 1]
        self.qvel[ids, 2] = linear[:, 2]
        self.qvel[ids, 3:6] = rng.uniform(-1, 1, (n, 3)) * random.base_rate_rad_s
        self.qvel[ids, 6:] = joint_velocity
        held = self.to_servo(joints)
        self._control[ids] = self._activation[ids] = held
        # MuJoCo empties delay lines to zeros, which would throw the robot on its back
        self._history[ids] = servo_mjcf.delay_lines(self._empty_lines, held)
        if self.servo_model is not None:
            self.servo_model.reset_some(ids, held - self._bend)
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_POS.value)

    def push(self, ids: NDArray[np.intp], velocity: Array) -> None:
        """Give the trunks of some robots a horizontal velocity [m/s], shape (len(ids), 2)."""
        self.qvel[ids, :2] = velocity

    # ------------------------------------------------------------------------- state

    @property
    def state(self) -> dict[str, Any]:
        """Everything that changes, as copies, for an exact restart."""
        state: dict[str, Any] = {f"drawn.{k}": v.copy() for k, v in self.drawn.items()}
        state |= {"friction": self.friction.copy(), "payload_kg": self.payload_kg.copy()}
        state |= {f"bodies.{k}": v.copy() for k, v in self.bodies.state.items()}
        state |= {"batch.state": self.batch.state.copy()}
        state |= {"robot": self._hash, "knee": self.config.knee}
        if self.servo_model is not None:
            state |= {f"servo.{k}": v.copy() for k, v in self.servo_model.memory.items()}
        return state

    def restore(self, state: dict[str, Any]) -> bool:
        """Go back to a `state` of as many such robots; whether what follows is exactly the same.

        It is not where the state is of another model of the robot, from an older version.
        """
        shape, expected = state["batch.state"].shape, self.batch.state.shape
        if shape != expected or state["knee"] != self.config.knee:
            raise InputError(
                f"The saved environments have a knee with {state['knee']} and state {shape}, these "
                f"{self.config.knee} and {expected}. Resume with the settings of the run."
            )
        for k, v in self.drawn.items():
            v[:] = state[f"drawn.{k}"]
        self.friction[:], self.payload_kg[:] = state["friction"], state["payload_kg"]
        for k, v in self.bodies.state.items():
            v[:] = state[f"bodies.{k}"]
        self.write(np.arange(self.environments))
        self.batch.state[:] = state["batch.state"]
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS.value)
        # forward changes what warm-starts the solver
        self.batch.state[:] = state["batch.state"]
        if self.servo_model is not None:
            for k, v in self.servo_model.memory.items():
                v[:] = state[f"servo.{k}"]
        self._warnings = self.batch.warning.copy()
        return state["robot"] == self._hash

    def _check_servo_model(self, model: JointArrays) -> None:
        if tuple(model.joints) != self.body.joints:
            raise InputError(
                f"The servo model must have all {len(self.body.joints)} joints, in order."
            )
        span = self.config.control_step_s
        if not same_rate(model.time_step_s, span):
            raise InputError(
                f"The servo model steps every {model.time_step_s} s, the policy every {span} s. "
                "Refit it at this rate, or change `control_step_s`."
            )

    def _highest_under(self, place: Array) -> Array:
        """Highest ground under a robot at `place`, shape (n,) [m]."""
        x, y = np.meshgrid(*[self.body.scale * np.array([-0.1, 0.0, 0.1])] * 2)
        return self.ground.height(place[:, :1] + x.ravel(), place[:, 1:] + y.ravel()).max(axis=1)


def _results(jobs: list[Future[Moved]]) -> Iterator[Moved]:
    """Results in order; waits for all, also if the caller gives up."""
    try:
        for job in jobs:
            yield job.result()
    finally:
        wait(jobs)
