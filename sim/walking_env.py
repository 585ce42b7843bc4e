"""PupperEnv: many robots that are told to walk, stepped together by `mujoco.batch`.

`reset` once, then `step(actions)` at 50 Hz. Arrays are (environments, …) NumPy. One call steps all
physics in C++ (`Batch.rollout`, ten steps of 2 ms); servo delay, gains, limits and friction are
MuJoCo's own, per environment and joint, drawn per episode from the calibration. What the policy
sees of its joints has passed through the measured feedback (`sim.held_readings`).

After a step, environments that ended have been reset: `StepResult.observation` is the first of the
new episode, `StepResult.terminal` holds the last one of those whose time was up, whose value a
learner needs. MuJoCo resets a simulation that becomes NaN and only counts a warning; here its
episode ends, `nan_resets` counts it, and its state is drawn anew.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.errors import InputError
from common.joints import JOINT_NAMES, LEGS
from servo_models.joint_arrays import JointArrays
from sim import walking_rewards
from sim.held_readings import HeldReadings
from sim.mini_pupper import (
    CONTACT_BODIES,
    FOOT_RADIUS_M,
    STANDING_HEIGHT_M,
    default_pose,
    limits,
    robot_xml,
)
from sim.servo_mjcf import mujoco
from sim.servo_ranges import ServoRanges
from sim.terrain import make_ground
from sim.walking_config import Walking

Array = NDArray[np.float64]

OBSERVATION = (
    ("base_linear_velocity", 3, 0.1),
    ("base_angular_velocity", 3, 0.2),
    ("projected_gravity", 3, 0.05),
    ("command", 3, 0.0),
    ("joint_position_relative", 12, 0.01),
    ("joint_velocity", 12, 1.5),
    ("joint_effort", 12, 0.1),
    ("last_action", 12, 0.0),
)
"""Name, size and half width of the published uniform noise of each part of an observation."""
OBSERVATION_SIZE = sum(size for _, size, _ in OBSERVATION)

VELOCITY_STEPS = 4
"""Joint velocity is the difference of readings this many control steps apart: polls are too rare
for less."""

_FEET, _BODIES = len(LEGS), len(CONTACT_BODIES)
_TOUCH_N = 1.0
_STRIDE_S = 0.2  # time constant of the average over a stride
_FALLEN_TILT = 0.6  # cosine: 53 degrees
_EDGE_M = 0.5
_THIGHS, _CALVES = np.arange(1, 12, 3), np.arange(2, 12, 3)


@dataclass(frozen=True)
class StepResult:
    """What one step gave.

    Attributes
    ----------
    observation : ndarray of float32, shape (n, 60)
    privileged : ndarray of float32, shape (n, k)
        The truth, for a critic.
    reward : ndarray, shape (n,)
    done, timed_out : ndarray of bool, shape (n,)
        Episode over; over because its time was up.
    terms : dict of str to ndarray, shape (n,)
        Each reward term, weighted and times the control period.
    terminal : dict of str to ndarray
        `ids` of environments whose time was up, and their last `observation` and `privileged`.
    facts : Step
        What happened, before anyone's new episode.
    """

    observation: NDArray[np.float32]
    privileged: NDArray[np.float32]
    reward: Array
    done: NDArray[np.bool_]
    timed_out: NDArray[np.bool_]
    terms: dict[str, Array]
    terminal: dict[str, NDArray]
    facts: walking_rewards.Step


class PupperEnv:
    """Vectorised walking environment.

    Parameters
    ----------
    config : Walking
    servos : ServoRanges
        Actuators and feedback.
    environments : int
    seed : int
    threads : int
        Of the physics; 0 for all cores.
    servo_model : JointArrays, optional
        Stands in for the actuators: a learned model of all twelve joints at the control rate. The
        position it predicts is what stiff, immediate servos are told, moving over the step.

    Raises
    ------
    InputError
        If a delay does not fit its buffer, or the servo model has another rate.
    """

    def __init__(
        self,
        config: Walking,
        servos: ServoRanges,
        environments: int,
        seed: int = 0,
        threads: int = 0,
        servo_model: JointArrays | None = None,
    ):
        if environments < 1:
            raise InputError(f"There are {environments} environments; at least 1 is needed.")
        self.config, self.servos, self.environments = config, servos, environments
        self.rng = np.random.default_rng(seed)
        self._servo_model = servo_model
        if servo_model is not None:
            if servo_model.joints != JOINT_NAMES:
                raise InputError("The servo model must have all twelve joints, in order.")
            servo_model.reset(np.zeros((environments, len(JOINT_NAMES))))
        if servo_model is not None and abs(servo_model.time_step_s - config.control_step_s) > 1e-9:
            raise InputError(
                f"The servo model steps every {servo_model.time_step_s} s, the policy every "
                f"{config.control_step_s} s. Refit it at this rate, or set --task.control-step-s."
            )
        # terrain is the same for every run of a seed, whatever the number of environments
        self.ground = make_ground(config.terrain, np.random.default_rng([seed, 1]))
        # every buffer holds the longest delay that can be drawn
        longest = {
            name: replace(own, delay_s=np.array(servos.longest_delay_s))
            for name, own in servos.nominal().items()
        }
        xml = robot_xml(
            longest, config.physics_step_s, config.knee, self.ground.xml, self.ground.assets
        )
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.ground.fill(self.model)
        self._full_line = _full_delay_lines(self.model)
        room = self.model.actuator_history[:, 0].min() * config.physics_step_s
        if servos.longest_delay_s > room:
            raise InputError(
                f"A delay of {servos.longest_delay_s} s does not fit the buffer of {room} s."
            )
        from mujoco.batch import Batch  # needs mujoco 4; its message names the module

        self.batch = Batch(self.model, environments, threads)
        self.default, (self._low, self._high) = default_pose(), limits()
        self.trot = config.trot
        n = environments
        self._fields = {
            name: self.batch.expand(name)
            for name in (
                "actuator_biasprm", "actuator_dynprm", "actuator_forcerange", "actuator_delay",
                "dof_armature", "dof_frictionloss", "geom_friction", "body_mass",
                *(("tendon_armature", "tendon_frictionloss") if config.knee == "linkage" else ()),
            )
        }  # fmt: skip
        self._feet_geoms = np.array([self.model.geom(f"{leg}_foot").id for leg in LEGS])
        self._feet_sites = np.array([self.model.site(f"{leg}_foot").id for leg in LEGS])
        self._site_position = self.batch.bind("site_xpos")
        self._readings = HeldReadings(
            servos.feedback, n, config.physics_step_s, np.random.default_rng([seed, 2])
        )
        self._warnings = self.batch.warning.copy()
        self.nan_resets = 0
        self.steps = 0
        self.level = config.curriculum.level(0)
        zeros = lambda *shape: np.zeros((n, *shape))  # noqa: E731
        self.command = zeros(3)
        self.episode_step = np.zeros(n, int)
        self.action, self.last_action, self.earlier_action = zeros(12), zeros(12), zeros(12)
        self._until_command, self._until_push = zeros(), zeros()
        self._air, self._contact = zeros(_FEET), zeros(_FEET)
        self._last_air, self._last_contact = zeros(_FEET), zeros(_FEET)
        self._foot_at = zeros(_FEET, 2)
        self._average = zeros(3)  # velocity over about a stride
        self._seen = zeros(VELOCITY_STEPS + 1, 12)  # readings, newest first
        self._drawn = {f: zeros(12) for f in servos.value}
        self._friction = zeros()
        self.reset()

    # ------------------------------------------------------------------------- public

    @property
    def privileged_size(self) -> int:
        """How many numbers the critic sees beside the observation."""
        return self._privileged().shape[1]

    def reset(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Start every episode anew; returns observation and privileged observation."""
        self._restart(np.arange(self.environments))
        return self.observe()

    def observe(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Observation (with noise, if on) and privileged observation, as fresh arrays.

        Draws noise, but does not let time pass.
        """
        return self._observation(), self._privileged()

    def step(self, action: NDArray[np.floating]) -> StepResult:
        """Let every robot act for one control step.

        Parameters
        ----------
        action : ndarray, shape (n, 12)
            Outputs of the policy: target = default pose + scale · action, within joint limits.
        """
        config, span = self.config, self.config.control_step_s
        self.steps += 1
        self.earlier_action, self.last_action = self.last_action, self.action
        self.action = np.asarray(action, float).copy()
        target = np.clip(self.default + self._scale() * self.action, self._low, self._high)
        velocity = self.batch.bind("qvel")[:, 6:].copy()
        position, load, touch = self._physics(target)
        self._readings.advance(self._to_servo(position), load)
        self._seen = np.concatenate([self._read()[:, None], self._seen[:, :-1]], axis=1)
        self.episode_step += 1
        contact, fallen = self._contacts(touch)
        what = self._step_facts(velocity, load[:, -1], contact)
        broken = self._broken()
        terms = walking_rewards.weighted(what, config.rewards, self._easy(self.level))
        terms = {k: np.where(broken, 0.0, v * span) for k, v in terms.items()}
        reward = np.sum(list(terms.values()), axis=0)
        timed_out = (self.episode_step >= config.episode_steps) | self._outside()
        timed_out &= ~(fallen | broken)
        done = fallen | broken | timed_out
        self._tell(span)
        self._push(span)
        self.level = config.curriculum.level(self.steps)
        late = np.flatnonzero(timed_out)
        terminal: dict[str, NDArray] = {"ids": late}
        if len(late):
            observation, privileged = self.observe()
            terminal |= {"observation": observation[late], "privileged": privileged[late]}
        over = np.flatnonzero(done)
        if len(over):
            self._restart(over)
        observation, privileged = self.observe()
        return StepResult(observation, privileged, reward, done, timed_out, terms, terminal, what)

    def set_command(self, command: NDArray[np.floating]) -> None:
        """Tell all robots what to do, shape (3,) or (n, 3), until the end of their episodes."""
        self.command[:] = command
        self._until_command[:] = np.inf

    @property
    def state(self) -> dict[str, Any]:
        """Everything that changes, as arrays and strings; `restore` takes it back exactly."""
        found: dict[str, Any] = {
            f"batch.{name}": np.array(value, copy=True) for name, value in self._fields.items()
        }
        found |= {f"readings.{k}": v.copy() for k, v in self._readings.state.items()}
        found |= {f"drawn.{k}": v.copy() for k, v in self._drawn.items()}
        found |= {name: getattr(self, name).copy() for name in _ARRAYS}
        found["batch.state"] = self.batch.state.copy()
        found["sites"] = self._site_position.copy()
        if self._servo_model is not None:
            found |= {f"servo.{k}": v.copy() for k, v in self._servo_model.memory.items()}
        found["counters"] = np.array([self.nan_resets, self.steps])
        found["rng"] = json.dumps([self.rng.bit_generator.state, self._readings.rng_state])
        return found

    def restore(self, state: dict[str, Any]) -> None:
        """Go back to a `state` of an environment with the same settings.

        Raises
        ------
        InputError
            If it is of another number of environments or another robot.
        """
        if state["batch.state"].shape != self.batch.state.shape:
            raise InputError(
                f"The saved environments have state {state['batch.state'].shape}, these "
                f"{self.batch.state.shape}. Resume with the settings of the run."
            )
        for name, value in self._fields.items():
            value[:] = state[f"batch.{name}"]
        self.batch.set_const()
        self.batch.state[:] = state["batch.state"]
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS.value)
        self.batch.state[:] = state["batch.state"]
        for k, v in self._readings.state.items():
            v[:] = state[f"readings.{k}"]
        for k, v in self._drawn.items():
            v[:] = state[f"drawn.{k}"]
        for name in _ARRAYS:
            getattr(self, name)[:] = state[name]
        if self._servo_model is not None:
            for k, v in self._servo_model.memory.items():
                v[:] = state[f"servo.{k}"]
        self.nan_resets, self.steps = (int(x) for x in state["counters"])
        own, readings = json.loads(state["rng"])
        self.rng.bit_generator.state = own
        self._readings.rng_state = readings
        self._warnings = self.batch.warning.copy()
        self.level = self.config.curriculum.level(self.steps)

    # ------------------------------------------------------------------------- one step

    def _physics(self, target: Array) -> tuple[Array, Array, Array]:
        """Step the batch; joint angles and torques at the start and after each step, touches."""
        config, n = self.config, self.environments
        start = self.batch.bind("qpos")[:, None, 7:].copy()
        told = self._to_servo(target)
        control = None
        if self._servo_model is None:
            self.batch.bind("ctrl")[:] = told
        else:
            before = self.batch.bind("ctrl").copy()
            predicted = np.asarray(self._servo_model.step(target), float)
            after = self._to_servo(np.clip(predicted, self._low, self._high))
            share = np.arange(1, config.substeps + 1)[:, None] / config.substeps
            control = before[:, None] + share * (after - before)[:, None]
        found = self.batch.rollout(
            config.substeps, control, record=("qpos", "actuator_force", "sensordata")
        )
        position = np.concatenate([start, found["qpos"][:, :, 7:]], axis=1)
        force = found["actuator_force"]
        load = np.concatenate([force[:, :1], force], axis=1)
        return (
            position,
            load,
            found["sensordata"][:, -3:, : _FEET + _BODIES].reshape(n, -1, _FEET + _BODIES),
        )

    def _contacts(self, touch: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which feet are on the ground, and which robots have fallen."""
        pressed = touch.max(axis=1) > _TOUCH_N
        contact, touched = pressed[:, :_FEET], pressed[:, _FEET:].any(axis=1)
        span = self.config.control_step_s
        landed, lifted = contact & (self._air > 0), ~contact & (self._contact > 0)
        self._last_air = np.where(landed, self._air, self._last_air)
        self._last_contact = np.where(lifted, self._contact, self._last_contact)
        self._air = np.where(contact, 0.0, self._air + span)
        self._contact = np.where(contact, self._contact + span, 0.0)
        return contact, touched | (self._gravity()[:, 2] > -_FALLEN_TILT)

    def _step_facts(
        self, velocity_before: Array, torque: Array, contact: NDArray[np.bool_]
    ) -> walking_rewards.Step:
        qpos, qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        feet = self._site_position[:, self._feet_sites]
        speed = np.linalg.norm(feet[..., :2] - self._foot_at, axis=-1) / self.config.control_step_s
        self._foot_at = feet[..., :2].copy()
        height = feet[..., 2] - FOOT_RADIUS_M - self.ground.height(feet[..., 0], feet[..., 1])
        velocity = self._velocity()
        now = np.column_stack([velocity[:, :2], qvel[:, 5]])
        share = self.config.control_step_s / _STRIDE_S
        self._average = self._average + share * (now - self._average)
        # copies: whoever ends its episode in this step is moved before anyone looks
        return walking_rewards.Step(
            self.command.copy(), velocity, qvel[:, 3:6].copy(), self._gravity(),
            qpos[:, 7:] - self.default, qvel[:, 6:].copy(),
            (qvel[:, 6:] - velocity_before) / self.config.control_step_s, torque,
            self.action.copy(), self.last_action.copy(), self.earlier_action.copy(), contact,
            self._air.copy(), self._contact.copy(), self._last_air.copy(),
            self._last_contact.copy(), height, speed,
            self._average.copy(),
        )  # fmt: skip

    def _broken(self) -> NDArray[np.bool_]:
        """Simulations that MuJoCo had to reset."""
        now = self.batch.warning
        raised = (now != self._warnings).reshape(self.environments, -1).any(axis=1)
        raised |= ~np.isfinite(self.batch.state).all(axis=1)
        self._warnings = now.copy()
        self.nan_resets += int(raised.sum())
        return raised

    def _outside(self) -> NDArray[np.bool_]:
        away = np.abs(self.batch.bind("qpos")[:, :2]).max(axis=1)
        return away > self.ground.half_size_m - _EDGE_M

    def _tell(self, span: float) -> None:
        self._until_command -= span
        due = np.flatnonzero(self._until_command <= 0)
        if len(due):
            self._draw_commands(due)

    def _push(self, span: float) -> None:
        most = self.config.randomisation.push_m_s
        self._until_push -= span
        due = np.flatnonzero(self._until_push <= 0)
        if len(due) and most > 0:
            self.batch.bind("qvel")[due, :2] = self.rng.uniform(-most, most, (len(due), 2))
        self._until_push[due] = self.rng.uniform(*self.config.randomisation.push_every_s, len(due))

    # ------------------------------------------------------------------------- a new episode

    def _restart(self, ids: NDArray[np.intp]) -> None:
        self._draw_robots(ids)
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._warnings[ids] = self.batch.warning[ids]  # a reset clears them
        self._draw_commands(ids)
        start = self._draw_pose(ids)
        told = self._to_servo(start)
        self.batch.bind("ctrl")[ids] = told
        self.batch.bind("act")[ids] = told
        # MuJoCo empties delay lines to zeros, which would throw the robot on its back
        lines = np.repeat(self._full_line[None], len(ids), axis=0)
        values = (lines.shape[2] - 2) // 2
        lines[:, :, -values:] = told[:, :, None]
        self.batch.bind("history")[ids] = lines.reshape(len(ids), -1)
        if self._servo_model is not None:
            self._servo_model.reset_some(ids, start)
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_POS.value)
        self._readings.reset(ids, told)
        self._seen[ids] = self._read()[ids][:, None]
        self._average[ids] = np.column_stack(
            [self._velocity()[ids, :2], self.batch.bind("qvel")[ids, 5]]
        )
        self._foot_at[ids] = self._site_position[ids][:, self._feet_sites, :2]
        self._until_push[ids] = self.rng.uniform(*self.config.randomisation.push_every_s, len(ids))
        for times in (self._air, self._contact, self._last_air, self._last_contact):
            times[ids] = 0.0
        self.episode_step[ids] = 0
        relative = (start - self.default) / self._scale()
        for action in (self.action, self.last_action, self.earlier_action):
            action[ids] = relative

    def _draw_robots(self, ids: NDArray[np.intp]) -> None:
        """Servos, friction and payload of new episodes."""
        random, f = self.config.randomisation, self._fields
        drawn = self.servos.draw(len(ids), random.torque_scale, self.rng)
        drawn["delay_s"] = drawn["delay_s"] * self._easy(self.level)
        for name, value in drawn.items():
            self._drawn[name][ids] = value
        f["actuator_biasprm"][ids, :, 1] = -drawn["stiffness"]
        f["actuator_biasprm"][ids, :, 2] = -drawn["damping"]
        f["actuator_dynprm"][ids, :, 1] = drawn["velocity_limit"]
        effort = drawn["effort_limit"]
        f["actuator_forcerange"][ids] = np.stack([-effort, effort], axis=-1)
        f["actuator_delay"][ids] = drawn["delay_s"]
        joints = np.arange(len(JOINT_NAMES))
        if self.config.knee == "linkage":
            f["tendon_armature"][ids] = drawn["armature"][:, _CALVES]
            f["tendon_frictionloss"][ids] = drawn["friction_loss"][:, _CALVES]
            joints = np.setdiff1d(joints, _CALVES)
        rows = ids[:, None]
        f["dof_armature"][rows, 6 + joints] = drawn["armature"][:, joints]
        f["dof_frictionloss"][rows, 6 + joints] = drawn["friction_loss"][:, joints]
        self._friction[ids] = self.rng.uniform(*random.friction, len(ids))
        f["geom_friction"][rows, self._feet_geoms, 0] = self._friction[ids, None]
        trunk = self.model.body("trunk").id
        payload = self.rng.uniform(*random.payload_kg, len(ids))
        f["body_mass"][ids, trunk] = self.model.body_mass[trunk] + payload
        self.batch.set_const(ids)

    def _draw_commands(self, ids: NDArray[np.intp]) -> None:
        given, n = self.config.commands, len(ids)
        ranges = np.array([given.forward_m_s, given.sideways_m_s, given.yaw_rad_s])
        command = self.rng.uniform(ranges[:, 0], ranges[:, 1], (n, 3)) * self._easy(self.level)
        alone = self.rng.random(n) < given.single
        command[alone] *= np.eye(3)[self.rng.integers(0, 3, n)][alone]
        command[self.rng.random(n) < given.standing] = 0.0
        self.command[ids] = command
        self._until_command[ids] = self.rng.exponential(given.every_s, n)

    def _draw_pose(self, ids: NDArray[np.intp]) -> Array:
        """Put trunk and joints somewhere; returns the joints, shape (len(ids), 12)."""
        random, n = self.config.randomisation, len(ids)
        near = self.rng.uniform(-random.joint_rad, random.joint_rad, (n, 12))
        start = self.default + near
        speed = self.rng.uniform(-random.joint_rad_s, random.joint_rad_s, (n, 12))
        trotting = self.rng.random(n) < random.on_the_move
        phase = self.rng.uniform(0.0, 2 * np.pi, n)
        start[trotting] = self.trot.joints(phase, self.command[ids])[trotting]
        start = np.clip(start, self._low, self._high)
        qpos, qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        reach = self.ground.half_size_m - 2 * _EDGE_M
        place = self.rng.uniform(-1, 1, (n, 2)) * (reach if np.isfinite(reach) else 0.5)
        yaw = self.rng.uniform(-np.pi, np.pi, n)
        corners = np.stack(
            np.broadcast_arrays(*np.meshgrid([-0.1, 0.0, 0.1], [-0.1, 0.0, 0.1])), axis=-1
        ).reshape(-1, 2)
        under = self.ground.height(place[:, :1] + corners[:, 0], place[:, 1:] + corners[:, 1]).max(
            axis=1
        )
        qpos[ids, :2] = place
        qpos[ids, 2] = under + STANDING_HEIGHT_M + 0.002
        qpos[ids, 3:7] = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=1)
        qpos[ids, 7:] = start
        linear = self.rng.uniform(-1, 1, (n, 3)) * random.base_velocity_m_s
        # the root's velocity is in the world's frame, its rate in its own
        c, s = np.cos(yaw), np.sin(yaw)
        qvel[ids, 0] = c * linear[:, 0] - s * linear[:, 1]
        qvel[ids, 1] = s * linear[:, 0] + c * linear[:, 1]
        qvel[ids, 2] = linear[:, 2]
        qvel[ids, 3:6] = self.rng.uniform(-1, 1, (n, 3)) * random.base_rate_rad_s
        qvel[ids, 6:] = speed * ~trotting[:, None]
        return start

    # ------------------------------------------------------------------------- what is seen

    def _observation(self) -> NDArray[np.float32]:
        config, n = self.config.observation, self.environments
        speed = self._velocity() if config.base_velocity == "true" else np.zeros((n, 3))
        span = VELOCITY_STEPS * self.config.control_step_s
        parts = [
            speed,
            self.batch.bind("qvel")[:, 3:6],
            self._gravity(),
            self.command,
            self._seen[:, 0] - self.default,
            (self._seen[:, 0] - self._seen[:, -1]) / span,
            self._readings.load,
            self.action,
        ]
        whole = np.concatenate(parts, axis=1, dtype=np.float32)
        if config.noise:
            noise = self.rng.random(whole.shape, np.float32)
            noise *= 2
            noise -= 1
            whole += noise * (_NOISE if config.base_velocity == "true" else _NOISE_BLIND)
        return whole

    def _privileged(self) -> NDArray[np.float32]:
        """The truth: what a critic in the simulator may know."""
        qpos, qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        under = self.ground.height(qpos[:, 0], qpos[:, 1])
        left = 1 - self.episode_step / self.config.episode_steps
        return np.concatenate(
            [
                self._velocity(), qpos[:, 7:] - self.default, 0.1 * qvel[:, 6:],
                (qpos[:, 2] - under)[:, None] * 10, self._air, self._contact.clip(0, 1),
                self._friction[:, None], self._drawn["delay_s"] * 10, left[:, None],
            ],
            axis=1, dtype=np.float32,
        )  # fmt: skip

    def _read(self) -> Array:
        """Joint angles as the controller reads them."""
        return self._from_servo(self._readings.position)

    def _rotation(self) -> tuple[Array, ...]:
        w, x, y, z = self.batch.bind("qpos")[:, 3:7].T
        return w, x, y, z

    def _gravity(self) -> Array:
        """Direction of gravity in the trunk's frame, shape (n, 3)."""
        w, x, y, z = self._rotation()
        return -np.stack(
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1
        )

    def _velocity(self) -> Array:
        """Velocity of the trunk in its own frame [m/s], shape (n, 3)."""
        w, x, y, z = self._rotation()
        v = self.batch.bind("qvel")[:, :3]
        q = np.stack([x, y, z], axis=1)
        # rotate by the inverse: v + 2 w (v × q) + 2 q × (q × v), with q's sign turned
        cross = np.cross(v, q)
        return v + 2 * w[:, None] * cross + 2 * np.cross(cross, q)

    def _to_servo(self, joints: Array) -> Array:
        """Servo angles of joint angles (..., 12): servo 3 holds thigh + calf behind a linkage."""
        if self.config.knee == "serial":
            return joints
        servo = joints.copy()
        servo[..., _CALVES] += joints[..., _THIGHS]
        return servo

    def _from_servo(self, servo: Array) -> Array:
        if self.config.knee == "serial":
            return servo
        joints = servo.copy()
        joints[..., _CALVES] -= servo[..., _THIGHS]
        return joints

    def _scale(self) -> float:
        share = self.config.curriculum.action_scale
        return self.config.action_scale * (share + (1 - share) * self.level)

    def _easy(self, level: float) -> float:
        """Share of delay, penalties and commands at a level of the curriculum."""
        easiest = self.config.curriculum.easiest
        return easiest + (1 - easiest) * level


def _full_delay_lines(model: Any) -> Array:
    """Delay lines as they are when a command has been held for long, shape (actuators, length)."""
    data = mujoco.MjData(model)
    for i in range(model.nu):
        samples = int(model.actuator_history[i][0])
        mujoco.mj_initCtrlHistory(model, data, i, None, np.zeros((samples, 1)))
    return data.history.reshape(model.nu, -1).copy()


_NOISE = np.concatenate([np.full(size, half, np.float32) for _, size, half in OBSERVATION])
_NOISE_BLIND = np.where(np.arange(OBSERVATION_SIZE) < 3, np.float32(0), _NOISE)
_ARRAYS = (
    "command", "episode_step", "action", "last_action", "earlier_action", "_until_command",
    "_until_push", "_air", "_contact", "_last_air", "_last_contact", "_foot_at", "_seen",
    "_friction", "_average",
)  # fmt: skip
