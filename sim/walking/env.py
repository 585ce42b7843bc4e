"""PupperEnv: many robots on a walking task, stepped together by `mujoco.batch`.

One call steps all physics in C++ (`Batch.rollout`, ten steps of 2 ms). Servo delay, gains, limits
and friction are those of MuJoCo, per environment and joint, drawn per episode from the calibration.
The joint angles that a policy sees have passed through the measured feedback
(`sim.walking.senses`). Arrays are (environments, …) NumPy.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.networks import JointArrays
from pupper_sysid.sim.robot.robot_batch import (
    Moved,
    RobotBatch,
    gravity_direction,
    planar,
    trunk_velocity,
)
from pupper_sysid.sim.robot.terrain import make_ground
from pupper_sysid.sim.walking.config import PRESETS, Rewards, Walking, for_robot, narrowed
from pupper_sysid.sim.walking.draws import Twins, at_rest, draw_commands, draw_pose, generator
from pupper_sysid.sim.walking.rewards import TERMS, EffortMeter, Strides, weighted
from pupper_sysid.sim.walking.senses import Rows, Senses
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_model_of, servo_ranges
from pupper_sysid.sim.walking.step import (
    FALLEN_TILT,
    Step,
    StepResult,
    Unfinished,
    empty_facts,
    noise_of,
    observation_of,
    observed,
    privileged_of,
    privileged_parts,
    unforeseen_of,
)

Array = NDArray[np.float64]
Term = Callable[[Step, Rewards], Array]
Seen = Callable[["PupperEnv", Rows], Array]

_EDGE_M = 0.5
_ARRAYS = (
    "command", "episode_step", "action", "last_action", "earlier_action", "_until_command",
    "_until_push",
)  # fmt: skip


class PupperEnv:
    """Vectorised walking environment of a legged robot: a batch of actions in, a batch out.

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
    extra_jitter_s : ndarray, shape (n,), optional
        Added to the jitter of a robot's commands, a standard deviation [s].
    device : str, optional
        Of the physics by mujoco-warp (extra `gpu`): `cuda`, `cuda:1`, or `cpu` to try it; by
        default MuJoCo steps it on `threads`. Readings and rewards are NumPy either way, from the
        state that comes back after each control step.
    terms : mapping of str to (float, callable), optional
        Rewards of your own beside those of `config.rewards`: a weight per second, and a function of
        a `Step` and the `Rewards` that gives one number per robot.
    observations : mapping of str to callable, optional
        Parts of an observation of your own, after the usual ones: `part(env, rows)` gives values of
        shape (k, size) for some robots. Policy files hold the usual observation only.

    Attributes
    ----------
    command : ndarray, shape (n, 3)
        Forward and sideways speed [m/s] and turn rate [rad/s] that each robot is to follow.
    robots : RobotBatch
        The physics: positions, velocities, the servos that were drawn.
    steps, nan_resets : int
        Control steps since the start; simulations that became NaN, and were drawn anew.
    processes : int
        That train together: the curriculum counts the samples of all.
    level : dict of str to float
        Factors of the curriculum now.

    Raises
    ------
    InputError
        If there is no environment, a servo is not stable in such physics steps, a delay does not
        fit its buffer, the servo model is of other joints or another rate, or the device or its
        extra is not there.

    Notes
    -----
    An action a, shape (n, 12), is the set-point default pose + `action_scale` · a [rad] in the
    order of `JOINT_NAMES`, within the joint limits, held for one control step (20 ms). The
    observation, shape (n, 60), is laid out in `sim.walking.step`.

    Environments that end in a step are reset in it: `StepResult.observation` is the first of the
    new episode, `StepResult.terminal` holds the last one of those whose time was up, whose value a
    learner needs. MuJoCo resets a simulation that becomes NaN and only counts a warning; here its
    episode ends.

    Examples
    --------
    >>> from pupper_sysid.sim.walking.config import PRESETS, Walking
    >>> from pupper_sysid.sim.walking.servo_ranges import servo_ranges
    >>> env = PupperEnv(Walking(), servo_ranges("paper"), environments=4, threads=1)
    >>> observation, privileged = env.reset()
    >>> result = env.step(np.zeros((4, 12)))
    >>> result.observation.shape, result.reward.shape, bool(result.done.any())
    ((4, 60), (4,), False)
    """

    def __repr__(self) -> str:
        step_ms = 1e3 * self.config.control_step_s
        return f"PupperEnv: {self.environments} robots, {step_ms:g} ms between actions"

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
        extra_jitter_s: Array | None = None,
        device: str | None = None,
        terms: Mapping[str, tuple[float, Term]] | None = None,
        observations: Mapping[str, Seen] | None = None,
    ):
        if environments < 1:
            raise InputError(f"There are {environments} environments; at least 1 is needed.")
        self.config, self.servos, self.environments = config, servos, environments
        self.rng = generator(seed, twins)
        # terrain is the same for every run of a seed, whatever the number of environments
        self.ground = make_ground(config.terrain, np.random.default_rng([seed, 1]))
        late = (servo_model, extra_dead_time_s, extra_jitter_s)
        if device is None:
            self.robots = RobotBatch(config, servos, self.ground, environments, threads, *late)
        else:
            from pupper_sysid.sim.gpu.warp_robots import WarpRobots

            self.robots = WarpRobots(config, servos, self.ground, environments, device, *late)
        body = self.body = config.body
        self.default = body.pose
        self.trot = config.trot
        n = environments
        self._user_terms, self._user_parts = dict(terms or {}), dict(observations or {})
        if known := sorted(self._user_terms.keys() & TERMS.keys()):
            raise InputError(
                f"A reward term is called {known[0]} already; give yours another name."
            )
        self._senses = Senses(config, servos, self.robots, n, generator([seed, 2], twins))
        self._strides = Strides(body, n, config.control_step_s, config.rewards)
        self._effort = EffortMeter(self.robots, config.control_step_s)
        self.nan_resets = 0
        self.steps, self.processes = 0, 1
        self.level = config.curriculum.at(0)
        self._rewards = self._narrowed()

        def zeros(*shape: int) -> Array:
            return np.zeros((n, *shape))

        self.command = zeros(3)
        self.episode_step = np.zeros(n, int)
        self.action, self.last_action, self.earlier_action = (
            zeros(len(body.joints)) for _ in range(3)
        )
        self._until_command, self._until_push = zeros(), zeros()
        self._size = sum(size for _, size, _ in observation_of(len(body.joints)))
        self._size += sum(x.shape[1] for x in self._user_observations(slice(None)))
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
        n = self.environments
        return self._observe(
            slice(None), noise_of(self.config.observation, len(self.default), n, self.rng)
        )

    def step(self, action: NDArray[np.floating]) -> StepResult:
        """Let every robot act for one control step.

        Parameters
        ----------
        action : ndarray, shape (n, 12)
            Outputs of the policy: set-point = default pose + scale · action, within joint limits.
        """
        config = self.config
        self.steps += 1
        self.earlier_action, self.last_action = self.last_action, self.action
        self.action = np.array(action, float)
        if config.differences.missed_ticks:
            missed = self.rng.random(self.environments) < config.differences.missed_ticks
            missed &= ~self.robots.bodies.as_calibrated
            self.action[missed] = self.last_action[missed]
        before = self.robots.joint_velocity.copy()
        self.robots.draw_latency(self.rng)
        moving = self.robots.step(self.set_points(self.action))
        # what does not need the new state is done while it is computed
        now = self._begin(before)
        for moved in moving:
            self._take(moved, now)
        broken = self.robots.broken()
        if broken.any():
            self.nan_resets += int(broken.sum())
            for term in now.terms.values():
                term[broken] = 0.0
        reward = np.sum(list(now.terms.values()), axis=0)
        timed_out = self.episode_step >= config.episode_steps
        if np.isfinite(self.ground.half_size_m):
            away = np.abs(self.robots.qpos[:, :2]).max(axis=1)
            timed_out |= away > self.ground.half_size_m - _EDGE_M
        timed_out &= ~(now.fallen | broken)
        done = now.fallen | broken | timed_out
        self._grow()
        late = np.flatnonzero(timed_out)
        terminal: dict[str, NDArray] = {"ids": late}
        if len(late):
            terminal |= {"observation": now.observation[late], "privileged": now.privileged[late]}
        unforeseen = unforeseen_of(now, self.command, done, config.observation.base_velocity)
        over = np.flatnonzero(done)
        if len(over):
            self._restart(over)
            noise = None if now.noise is None else now.noise[over]
            now.observation[over], now.privileged[over] = self._observe(over, noise)
        facts = Step(body=self.body, **now.facts)
        return StepResult(
            now.observation, now.privileged, reward, done, timed_out, now.terms, terminal,
            unforeseen, facts,
        )  # fmt: skip

    def set_points(self, action: Array) -> Array:
        """Joint set-points [rad] of actions, shape (n, 12), within the joint limits."""
        target = action * self.config.action_scale
        target += self.default
        return np.clip(target, self.body.low, self.body.high, out=target)

    def set_command(self, command: NDArray[np.floating]) -> None:
        """Give all robots a command, shape (3,) or (n, 3), until the end of their episodes."""
        self.command[:] = at_rest(self.config.commands, np.atleast_2d(np.asarray(command, float)))
        self._until_command[:] = np.inf

    @property
    def readings(self) -> Array:
        """Joint angles as the bus reports them now [rad], shape (n, 12)."""
        return self._senses.angles(slice(None))

    @property
    def stride_velocity(self) -> Array:
        """Forward and sideways speed [m/s] and turn rate [rad/s] over about a stride, (n, 3)."""
        return self._strides.velocity.copy()

    @property
    def state(self) -> dict[str, Any]:
        """Everything that changes, as arrays and strings; `restore` takes it back exactly."""
        state = self.robots.state | {name: value.copy() for name, value in self._live.items()}
        state["counters"] = np.array([self.nan_resets, self.steps])
        state["rng"] = json.dumps([rng.bit_generator.state for rng in self._rngs])
        return state

    def restore(self, state: dict[str, Any]) -> bool:
        """Go back to a `state` of an environment with the same settings.

        Returns whether what follows is exactly what would have followed; it is not where an older
        version wrote the state, with another model of the robot.

        Raises
        ------
        InputError
            If it is of another number of environments or another robot.
        """
        if differ := sorted(state.keys() ^ self.state.keys()):
            raise InputError(f"they differ in {differ[0]}. Resume with the settings of the run.")
        exact = self.robots.restore(state)
        for name, value in self._live.items():
            value[:] = state[name]
        self.nan_resets, self.steps = (int(x) for x in state["counters"])
        for rng, rng_state in zip(self._rngs, json.loads(state["rng"]), strict=True):
            rng.bit_generator.state = rng_state
        self._grow()
        return exact

    @property
    def _live(self) -> dict[str, NDArray]:
        """All arrays that change, but for those of the physics."""
        senses = self._senses
        owners = {"readings": senses.readings, "imu": senses.imu, "strides": self._strides}
        owners["effort"] = self._effort
        arrays = {f"{name}.{k}": v for name, x in owners.items() for k, v in x.state.items()}
        return arrays | {name: getattr(self, name) for name in _ARRAYS} | {"_seen": senses.recent}

    @property
    def _rngs(self) -> tuple[np.random.Generator, ...]:
        return self.rng, self._senses.readings.rng

    def _grow(self) -> None:
        """Go on to the present level of the curriculum."""
        level = self.config.curriculum.at(self.steps * self.environments * self.processes)
        if level != self.level:
            self.level = level
            self._rewards = self._narrowed()

    def _narrowed(self) -> Rewards:
        level = self.level
        return narrowed(self.config.rewards, level["linear_sigma"], level["angular_sigma"])

    # ------------------------------------------------------------------------- one step

    def _begin(self, velocity_before: Array) -> Unfinished:
        """All of a step that its physics does not decide."""
        n, config, span = self.environments, self.config, self.config.control_step_s
        chances = self._senses.readings.chances(config.substeps)
        actions = (self.action, self.last_action, self.earlier_action)
        facts = empty_facts(self.body, self.command, *actions)
        self.episode_step += 1
        self._until_command -= span
        due = np.flatnonzero(self._until_command <= 0)
        if len(due):
            self._draw_commands(due)
        self._until_push -= span
        pushed = np.flatnonzero(self._until_push <= 0)
        most = self.level["push"] * config.randomisation.push_m_s
        push = np.zeros((0, 2))
        if len(pushed):
            push = self.rng.uniform(-most, most, (len(pushed), 2))
            pause = self.rng.uniform(*config.randomisation.push_every_s, len(pushed))
            self._until_push[pushed] = pause
        joints, feet = len(self.body.joints), len(self.body.feet)
        noise = noise_of(config.observation, joints, n, self.rng)
        return Unfinished(
            velocity_before, chances, noise, pushed if most > 0 else pushed[:0], push, facts, {},
            np.empty((n, self._size), np.float32),
            np.empty((n, sum(size for _, size in privileged_parts(joints, feet))), np.float32),
            np.empty(n, bool),
        )  # fmt: skip

    def _take(self, moved: Moved, now: Unfinished) -> None:
        """What follows from the physics, for the robots that have moved."""
        robots, rows, span = self.robots, moved.rows, self.config.control_step_s
        qpos, qvel = robots.qpos[rows].copy(), robots.qvel[rows].copy()
        self._senses.advance(moved, now.chances, self.steps)
        gravity, velocity = gravity_direction(qpos), trunk_velocity(qpos, qvel)
        fallen = gravity[:, 2] > -FALLEN_TILT
        fallen |= self.body.touches_ground(qpos, gravity, self.ground)
        now.fallen[rows] = fallen
        facts = {name: value[rows] for name, value in now.facts.items()}
        self._strides.advance(rows, moved.touch, robots.feet(rows), planar(velocity, qvel), facts)
        self._effort.advance(moved, facts)
        facts["linear_velocity"][:], facts["gravity"][:] = velocity, gravity
        facts["angular_velocity"][:], facts["torque"][:] = qvel[:, 3:6], moved.load[:, -1]
        np.subtract(qpos[:, 7:], self.default, out=facts["position_relative"])
        facts["velocity"][:] = qvel[:, 6:]
        np.subtract(qvel[:, 6:], now.velocity_before[rows], out=facts["acceleration"])
        facts["acceleration"] /= span
        step = Step(body=self.body, **facts)
        level = self.level
        terms = weighted(
            step, self._rewards, level["penalties"], level["guides"], level["progress"]
        )
        for name, (weight, term) in self._user_terms.items():
            terms[name] = weight * term(step, self._rewards)
        for name, term in terms.items():
            values = now.terms.setdefault(name, np.empty(self.environments))
            np.multiply(term, span, out=values[rows])
        first, last = np.searchsorted(now.pushed, (rows.start, rows.stop))
        if last > first:
            ids = now.pushed[first:last]
            robots.push(ids, now.push[first:last])
            qvel = robots.qvel[rows]
            velocity = trunk_velocity(qpos, qvel)
        self._senses.imu.advance(rows, qvel[:, 3:6], gravity)
        noise = None if now.noise is None else now.noise[rows]
        self._observe(
            rows, noise, now.observation[rows], now.privileged[rows],
            (qpos, qvel, gravity, velocity),
        )  # fmt: skip

    # ------------------------------------------------------------------------- a new episode

    def _restart(self, ids: NDArray[np.intp]) -> None:
        self.robots.draw(ids, self.rng)
        self._draw_commands(ids)
        start, speed = draw_pose(
            self.config.randomisation, self.body, self.trot, self.command[ids], self.rng
        )  # fmt: skip
        self.robots.place(ids, start, speed, 2 * _EDGE_M, self.rng)
        angles = self.robots.to_servo(start)
        qpos, qvel = self.robots.qpos[ids], self.robots.qvel[ids]
        self._senses.reset(ids, angles, qvel[:, 3:6], gravity_direction(qpos), self.rng)
        velocity = planar(trunk_velocity(qpos, qvel), qvel)
        self._strides.reset(ids, self.robots.feet(ids)[0], velocity)
        self._effort.reset(ids)
        self._until_push[ids] = self.rng.uniform(*self.config.randomisation.push_every_s, len(ids))
        self.episode_step[ids] = 0
        command = self.robots.from_servo(angles - self.robots.bodies.zero_rad[ids])
        relative = (command - self.default) / self.config.action_scale
        for action in (self.action, self.last_action, self.earlier_action):
            action[ids] = relative

    def _draw_commands(self, ids: NDArray[np.intp]) -> None:
        commands, n = self.config.commands, len(ids)
        self.command[ids] = draw_commands(commands, n, self.level["commands"], self.rng)
        self._until_command[ids] = self.rng.exponential(commands.every_s, n)

    # ------------------------------------------------------------------------- what is seen

    def _observe(
        self,
        rows: Rows,
        noise: NDArray[np.float32] | None,
        observation: NDArray[np.float32] | None = None,
        privileged: NDArray[np.float32] | None = None,
        state: tuple[Array, Array, Array, Array] | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Write the observation of some robots, and the truth: what a critic may know.

        `state` is qpos, qvel, gravity and velocity, where they are known.
        """
        if state is None:
            qpos, qvel = self.robots.qpos[rows], self.robots.qvel[rows]
            state = qpos, qvel, gravity_direction(qpos), trunk_velocity(qpos, qvel)
        qpos, qvel, gravity, velocity = state
        true, strides = self.config.observation.base_velocity == "true", self._strides
        angle, moved, effort = self._senses.joints(rows, self.steps)
        rate, down = self._senses.imu.read(rows, qvel[:, 3:6], gravity)
        observation = observed(
            [
                velocity if true else np.zeros((len(qpos), 3)), rate, down,
                self.command[rows], angle - self.default, moved, effort, self.action[rows],
                *self._user_observations(rows),
            ],
            noise, observation,
        )  # fmt: skip
        height = qpos[:, 2] - self.ground.height(qpos[:, 0], qpos[:, 1])
        remaining = 1 - self.episode_step[rows] / self.config.episode_steps
        privileged = privileged_of(
            [
                velocity, qpos[:, 7:] - self.default, qvel[:, 6:], height[:, None],
                strides.air_s[rows], strides.stance_s[rows], self.robots.friction[rows, None],
                self.robots.drawn["dead_time_s"][rows], *self._differing(rows),
                qvel[:, 3:6], gravity, strides.velocity[rows], self.last_action[rows],
                strides.clock(rows), remaining[:, None],
            ],
            privileged,
        )  # fmt: skip
        return observation, privileged

    def _user_observations(self, rows: Rows) -> list[Array]:
        """The user's parts of an observation for some robots."""
        return [np.asarray(part(self, rows), float) for part in self._user_parts.values()]

    def _differing(self, rows: Rows) -> list[Array]:
        """What was drawn for robots, as the critic sees it."""
        robots, imu, bodies = self.robots, self._senses.imu, self.robots.bodies
        stiffness = robots.drawn["stiffness"][rows] / self.servos.value["stiffness"]
        speed = robots.drawn["velocity_limit"][rows] / self.servos.value["velocity_limit"]
        return [
            robots.payload_kg[rows, None], bodies.centre_m[rows],
            np.stack([stiffness[:, self.body.leg_of == k].mean(axis=1)
                      for k in range(len(self.body.feet))], axis=1),
            speed.mean(axis=1, keepdims=True), bodies.zero_rad[rows], imu.mounting_rad[rows],
            imu.bias_rad_s[rows],
            np.stack([imu.latency_s[rows], imu.period_s[rows]], axis=1),
            np.stack([bodies.poll[rows], bodies.jitter[rows], bodies.effort[rows]], axis=1),
        ]  # fmt: skip


def make_env(
    actuator: str | Path = "calibrated.yaml",
    *,
    robot: str | Path | None = None,
    robot_config: str | Path | None = None,
    preset: str = "fast",
    feedback: str | Path = "held",
    environments: int = 64,
    seed: int = 0,
    threads: int = 0,
    terms: Mapping[str, tuple[float, Term]] | None = None,
    observations: Mapping[str, Seen] | None = None,
    **task: Any,
) -> PupperEnv:
    """Make many robots with measured servos on a walking task, for a learner of your own.

    Episodes, physics and rewards are those of `pupper-train`.

    Parameters
    ----------
    actuator : str or Path
        As for `pupper-train`: a calibration, a preset, a servo card, `ideal` or a servo model.
    robot : str or Path, optional
        MJCF or URDF of another robot than the Mini Pupper 2.
    robot_config : str or Path, optional
        YAML beside it (`sim.robot.robot_file`).
    preset : {"fast", "scratch", "paper", "release"}
        The task.
    feedback : str or Path
        As for `pupper-train`: `held`, `ideal` or another calibration.
    environments : int
        How many robots.
    seed : int
        Of everything random.
    threads : int
        Of the physics; 0 for all cores.
    terms : mapping of str to (float, callable), optional
        Rewards of your own; see `PupperEnv`.
    observations : mapping of str to callable, optional
        Parts of an observation of your own; see `PupperEnv`.
    **task
        Fields of `Walking` that differ from the preset's, such as `episode_s` or `rewards`.

    Returns
    -------
    PupperEnv
        Reset, so that `observe` gives the first observations.

    Raises
    ------
    InputError
        If the preset is unknown, or a file cannot be read or used.

    Examples
    --------
    >>> def level(step, rewards):
    ...     return step.gravity[:, 2] ** 2
    >>> env = make_env("paper", environments=4, threads=1, terms={"level": (0.5, level)})
    >>> result = env.step(np.zeros((4, 12)))
    >>> result.terms["level"].shape
    (4,)
    """
    if preset not in PRESETS:
        raise InputError(f"There is no preset {preset}. Give one of {', '.join(PRESETS)}.")
    config = PRESETS[preset]
    if robot is not None:
        config = for_robot(config, robot, robot_config)
    config = replace(config, **task)
    servos = servo_ranges(actuator, feedback, config.body)
    model = servo_model_of(actuator, config.control_step_s)
    return PupperEnv(
        config, servos, environments, seed, threads, model, terms=terms, observations=observations
    )
