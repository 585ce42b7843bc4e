"""PupperEnv: many robots on a walking task, stepped together by `mujoco.batch`.

One call steps all physics in C++ (`Batch.rollout`, ten steps of 2 ms). Servo delay, gains, limits
and friction are MuJoCo's own, per environment and joint, drawn per episode from the calibration.
The joint angles that a policy sees have passed through the measured feedback
(`sim.walking.held_readings`). Arrays are (environments, …) NumPy.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.joint_arrays import JointArrays
from pupper_sysid.sim.robot.mini_pupper import default_pose, limits
from pupper_sysid.sim.robot.robot_batch import FEET, RobotBatch
from pupper_sysid.sim.robot.terrain import make_ground
from pupper_sysid.sim.walking import rewards as walking_rewards
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.held_readings import HeldReadings
from pupper_sysid.sim.walking.observation import FALLEN_TILT, VELOCITY_STEPS, observed
from pupper_sysid.sim.walking.servo_ranges import ServoRanges
from pupper_sysid.sim.walking.shared_draws import Twins, generator

Array = NDArray[np.float64]

_FOOT_N = 0.25  # a quarter of what a foot carries when this robot stands: 1.1 N
_STRIDE_S = 0.2  # time constant of the average over a stride
_EDGE_M = 0.5
_ARRAYS = (
    "command", "episode_step", "action", "last_action", "earlier_action", "_until_command",
    "_until_push", "_air", "_contact", "_last_air", "_last_contact", "_foot_at", "_seen",
    "_average",
)  # fmt: skip


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
        What happened, before any new episode.
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
    """Vectorised walking environment of the Mini Pupper 2: a batch of actions in, a batch out.

    Parameters
    ----------
    config : Walking
        The task: `Walking()`, or one of `sim.walking.config.PRESETS`.
    servos : ServoRanges
        Actuators and feedback, from `sim.walking.servo_ranges.servo_ranges(calibration)`.
    environments : int
        How many robots, n.
    seed : int
        Of everything random. The terrain of a seed is the same for every number of robots.
    threads : int
        Of the physics; 0 for all cores. Results do not depend on it.
    servo_model : JointArrays, optional
        Stands in for the actuators: a learned model of all twelve joints at the control rate. The
        position it predicts is the command of stiff, immediate servos, moving over the step.
    extra_dead_time_s : float or ndarray, shape (n,)
        Added to every dead time of a robot [s].
    twins : Twins, optional
        Which robots are the same one; by default all differ.

    Attributes
    ----------
    command : ndarray, shape (n, 3)
        Forward and sideways speed [m/s] and turn rate [rad/s] that each robot is to follow.
    robots : RobotBatch
        The physics: positions, velocities, the servos that were drawn.
    steps, nan_resets : int
        Control steps since the start; simulations that became NaN, and were drawn anew.

    Raises
    ------
    InputError
        If there is no environment, a servo is not stable in such physics steps, a delay does not
        fit its buffer, or the servo model is of other joints or another rate.

    Notes
    -----
    An action a, shape (n, 12), is the set-point default pose + `action_scale` · a [rad] in the
    order of `JOINT_NAMES`, within the joint limits, held for one control step (20 ms). The
    observation, shape (n, 60), is laid out in `sim.walking.observation`.

    Environments that end in a step are reset in it: `StepResult.observation` is the first of the
    new episode, `StepResult.terminal` holds the last one of those whose time was up, whose value a
    learner needs. MuJoCo resets a simulation that becomes NaN and only counts a warning; here its
    episode ends.

    Examples
    --------
    >>> from pupper_sysid.sim.walking.config import Walking
    >>> from pupper_sysid.sim.walking.servo_ranges import servo_ranges
    >>> env = PupperEnv(Walking(), servo_ranges("paper"), environments=4, threads=1)
    >>> observation, privileged = env.reset()
    >>> result = env.step(np.zeros((4, 12)))
    >>> result.observation.shape, result.reward.shape, bool(result.done.any())
    ((4, 60), (4,), False)
    """

    def __init__(
        self,
        config: Walking,
        servos: ServoRanges,
        environments: int,
        seed: int = 0,
        threads: int = 0,
        servo_model: JointArrays | None = None,
        extra_dead_time_s: float | Array = 0.0,
        twins: Twins | None = None,
    ):
        if environments < 1:
            raise InputError(f"There are {environments} environments; at least 1 is needed.")
        self.config, self.servos, self.environments = config, servos, environments
        self.rng = generator(seed, twins)
        # terrain is the same for every run of a seed, whatever the number of environments
        self.ground = make_ground(config.terrain, np.random.default_rng([seed, 1]))
        self.robots = RobotBatch(
            config, servos, self.ground, environments, threads, servo_model, extra_dead_time_s
        )
        self.default, (self._low, self._high) = default_pose(), limits()
        self.trot = config.trot
        n = environments
        self._readings = HeldReadings(
            servos.feedback, n, config.physics_step_s, generator([seed, 2], twins)
        )
        self.nan_resets = 0
        self.steps = 0
        self.level = config.curriculum.level(0)

        def zeros(*shape: int) -> Array:
            return np.zeros((n, *shape))

        self.command = zeros(3)
        self.episode_step = np.zeros(n, int)
        self.action, self.last_action, self.earlier_action = zeros(12), zeros(12), zeros(12)
        self._until_command, self._until_push = zeros(), zeros()
        self._air, self._contact = zeros(FEET), zeros(FEET)
        self._last_air, self._last_contact = zeros(FEET), zeros(FEET)
        self._foot_at = zeros(FEET, 2)
        self._average = zeros(3)  # velocity over about a stride
        self._seen = zeros(VELOCITY_STEPS + 1, 12)  # readings, newest first
        self.reset()

    # ------------------------------------------------------------------------- public

    def reset(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Start every episode anew; returns observation and privileged observation."""
        self._restart(np.arange(self.environments))
        return self.observe()

    def observe(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Observation (with noise, if on) and privileged observation, as fresh arrays.

        Draws noise, but does not let time pass.
        """
        config, robots = self.config.observation, self.robots
        blind = np.zeros((self.environments, 3))
        span = VELOCITY_STEPS * self.config.control_step_s
        seen = [
            robots.velocity if config.base_velocity == "true" else blind,
            robots.rate,
            robots.gravity,
            self.command,
            self._seen[:, 0] - self.default,
            (self._seen[:, 0] - self._seen[:, -1]) / span,
            self._readings.load,
            self.action,
        ]
        return observed(config, seen, self.rng), self._privileged()

    def step(self, action: NDArray[np.floating]) -> StepResult:
        """Let every robot act for one control step.

        Parameters
        ----------
        action : ndarray, shape (n, 12)
            Outputs of the policy: set-point = default pose + scale · action, within joint limits.
        """
        config, span = self.config, self.config.control_step_s
        self.steps += 1
        self.earlier_action, self.last_action = self.last_action, self.action
        self.action = np.asarray(action, float).copy()
        target = np.clip(self.default + self._scale() * self.action, self._low, self._high)
        velocity = self.robots.joint_velocity.copy()
        position, load, touch = self.robots.step(target)
        self._readings.advance(self.robots.to_servo(position), load)
        self._seen = np.concatenate([self._read()[:, None], self._seen[:, :-1]], axis=1)
        self.episode_step += 1
        contact, fallen = self._contacts(touch)
        facts = self._step_facts(velocity, load[:, -1], contact)
        broken = self.robots.broken()
        self.nan_resets += int(broken.sum())
        terms = walking_rewards.weighted(facts, config.rewards, self._easy(self.level))
        terms = {k: v * span for k, v in terms.items()}
        if broken.any():
            terms = {k: np.where(broken, 0.0, v) for k, v in terms.items()}
        reward = np.sum(list(terms.values()), axis=0)
        away = np.abs(self.robots.qpos[:, :2]).max(axis=1)
        timed_out = self.episode_step >= config.episode_steps
        timed_out |= away > self.ground.half_size_m - _EDGE_M
        timed_out &= ~(fallen | broken)
        done = fallen | broken | timed_out
        self._until_command -= span
        due = np.flatnonzero(self._until_command <= 0)
        if len(due):
            self._draw_commands(due)
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
        return StepResult(observation, privileged, reward, done, timed_out, terms, terminal, facts)

    def set_command(self, command: NDArray[np.floating]) -> None:
        """Give all robots a command, shape (3,) or (n, 3), until the end of their episodes."""
        self.command[:] = command
        self._until_command[:] = np.inf

    @property
    def state(self) -> dict[str, Any]:
        """Everything that changes, as arrays and strings; `restore` takes it back exactly."""
        found: dict[str, Any] = dict(self.robots.state)
        found |= {f"readings.{k}": v.copy() for k, v in self._readings.state.items()}
        found |= {name: getattr(self, name).copy() for name in _ARRAYS}
        found["counters"] = np.array([self.nan_resets, self.steps])
        rngs = (self.rng, self._readings.rng)
        found["rng"] = json.dumps([rng.bit_generator.state for rng in rngs])
        return found

    def restore(self, state: dict[str, Any]) -> None:
        """Go back to a `state` of an environment with the same settings.

        Raises
        ------
        InputError
            If it is of another number of environments or another robot.
        """
        self.robots.restore(state)
        for k, v in self._readings.state.items():
            v[:] = state[f"readings.{k}"]
        for name in _ARRAYS:
            getattr(self, name)[:] = state[name]
        self.nan_resets, self.steps = (int(x) for x in state["counters"])
        for rng, own in zip((self.rng, self._readings.rng), json.loads(state["rng"]), strict=True):
            rng.bit_generator.state = own
        self.level = self.config.curriculum.level(self.steps)

    # ------------------------------------------------------------------------- one step

    def _contacts(self, touch: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which feet are on the ground, and which robots have fallen."""
        contact = touch > _FOOT_N
        span = self.config.control_step_s
        landed, lifted = contact & (self._air > 0), ~contact & (self._contact > 0)
        self._last_air = np.where(landed, self._air, self._last_air)
        self._last_contact = np.where(lifted, self._contact, self._last_contact)
        self._air = np.where(contact, 0.0, self._air + span)
        self._contact = np.where(contact, self._contact + span, 0.0)
        return contact, self.robots.touching() | (self.robots.gravity[:, 2] > -FALLEN_TILT)

    def _step_facts(
        self, velocity_before: Array, torque: Array, contact: NDArray[np.bool_]
    ) -> walking_rewards.Step:
        robots = self.robots
        at, height = robots.feet()
        speed = np.linalg.norm(at - self._foot_at, axis=-1) / self.config.control_step_s
        self._foot_at = at
        velocity = robots.velocity
        now = np.column_stack([velocity[:, :2], robots.rate[:, 2]])
        share = self.config.control_step_s / _STRIDE_S
        self._average = self._average + share * (now - self._average)
        # copies: robots whose episode ends in this step are moved before the facts are read
        return walking_rewards.Step(
            self.command.copy(), velocity, robots.rate.copy(), robots.gravity,
            robots.joints - self.default, robots.joint_velocity.copy(),
            (robots.joint_velocity - velocity_before) / self.config.control_step_s, torque,
            self.action.copy(), self.last_action.copy(), self.earlier_action.copy(), contact,
            self._air.copy(), self._contact.copy(), self._last_air.copy(),
            self._last_contact.copy(), height, speed, self._average.copy(),
        )  # fmt: skip

    def _push(self, span: float) -> None:
        most = self.config.randomisation.push_m_s
        self._until_push -= span
        due = np.flatnonzero(self._until_push <= 0)
        if len(due) and most > 0:
            self.robots.push(due, self.rng.uniform(-most, most, (len(due), 2)))
        self._until_push[due] = self.rng.uniform(*self.config.randomisation.push_every_s, len(due))

    # ------------------------------------------------------------------------- a new episode

    def _restart(self, ids: NDArray[np.intp]) -> None:
        self.robots.draw(ids, self._easy(self.level), self.rng)
        self._draw_commands(ids)
        start, speed = self._draw_pose(ids)
        self.robots.place(ids, start, speed, 2 * _EDGE_M, self.rng)
        self._readings.reset(ids, self.robots.to_servo(start))
        self._seen[ids] = self._read()[ids][:, None]
        self._average[ids] = np.column_stack(
            [self.robots.velocity[ids, :2], self.robots.rate[ids, 2]]
        )
        self._foot_at[ids] = self.robots.feet()[0][ids]
        self._until_push[ids] = self.rng.uniform(*self.config.randomisation.push_every_s, len(ids))
        for times in (self._air, self._contact, self._last_air, self._last_contact):
            times[ids] = 0.0
        self.episode_step[ids] = 0
        relative = (start - self.default) / self._scale()
        for action in (self.action, self.last_action, self.earlier_action):
            action[ids] = relative

    def _draw_commands(self, ids: NDArray[np.intp]) -> None:
        given, n = self.config.commands, len(ids)
        ranges = np.array([given.forward_m_s, given.sideways_m_s, given.yaw_rad_s])
        command = self.rng.uniform(ranges[:, 0], ranges[:, 1], (n, 3)) * self._easy(self.level)
        alone = self.rng.random(n) < given.single
        command[alone] *= np.eye(3)[self.rng.integers(0, 3, n)][alone]
        command[self.rng.random(n) < given.standing] = 0.0
        self.command[ids] = command
        self._until_command[ids] = self.rng.exponential(given.every_s, n)

    def _draw_pose(self, ids: NDArray[np.intp]) -> tuple[Array, Array]:
        """Joint angles and velocities at the start, each (len(ids), 12)."""
        random, n = self.config.randomisation, len(ids)
        start = self.default + self.rng.uniform(-random.joint_rad, random.joint_rad, (n, 12))
        speed = self.rng.uniform(-random.joint_rad_s, random.joint_rad_s, (n, 12))
        trotting = self.rng.random(n) < random.on_the_move
        phase = self.rng.uniform(0.0, 2 * np.pi, n)
        start[trotting] = self.trot.joints(phase, self.command[ids])[trotting]
        return np.clip(start, self._low, self._high), speed * ~trotting[:, None]

    # ------------------------------------------------------------------------- what is seen

    def _privileged(self) -> NDArray[np.float32]:
        """The truth: what a critic in the simulator may know."""
        robots = self.robots
        x, y, z = robots.qpos[:, :3].T
        left = 1 - self.episode_step / self.config.episode_steps
        return np.concatenate(
            [
                robots.velocity, robots.joints - self.default, 0.1 * robots.joint_velocity,
                (z - self.ground.height(x, y))[:, None] * 10, self._air,
                self._contact.clip(0, 1), robots.friction[:, None],
                robots.drawn["dead_time_s"] * 10, left[:, None],
            ],
            axis=1, dtype=np.float32,
        )  # fmt: skip

    def _read(self) -> Array:
        """Joint angles as the controller reads them."""
        return self.robots.from_servo(self._readings.position)

    def _scale(self) -> float:
        share = self.config.curriculum.action_scale
        return self.config.action_scale * (share + (1 - share) * self.level)

    def _easy(self, level: float) -> float:
        """Share of delay, penalties and commands at a level of the curriculum."""
        easiest = self.config.curriculum.easiest
        return easiest + (1 - easiest) * level
