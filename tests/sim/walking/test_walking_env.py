"""The walking environment: what is seen, what delays, what resets, and that it can walk."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES, LEGS
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.servo_models.networks import CommandNetwork
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import (
    default_pose,
    foot_position,
    joint_angles,
    limits,
)
from pupper_sysid.sim.walking.config import (
    PRESETS,
    Commands,
    Curriculum,
    Observation,
    Randomisation,
    Rewards,
    Walking,
)
from pupper_sysid.sim.walking.env import PupperEnv, make_env
from pupper_sysid.sim.walking.rewards import TERMS, progress
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_ranges
from pupper_sysid.sim.walking.step import OBSERVATION, StepResult
from pupper_sysid.sim.walking.step import OBSERVATION_PARTS as PARTS
from support.refusals import assert_each_refused
from support.robot_in_air import error_in_air, lags_in_air
from support.walks import STILL

MEASURED = "data/samples/calibrated.yaml"
ACTUATORS = (MEASURED, "ideal")
H, SPAN = 0.002, 0.02
SEEN = Observation(noise=False, base_velocity="true")
QUIET = Walking(randomisation=STILL, observation=SEEN)
FULL = dict.fromkeys((part.name for part in fields(Curriculum)), 1.0)


def make(
    actuator: str | ServoRanges = "ideal", config: Walking = QUIET, count: int = 4, **options
) -> PupperEnv:
    servos = actuator if isinstance(actuator, ServoRanges) else servo_ranges(actuator)
    return PupperEnv(config, servos, count, **{"seed": 0, "threads": 1, **options})


def still(env: PupperEnv) -> np.ndarray:
    return np.zeros((env.environments, 12))


def walk_about(env: PupperEnv, steps: int, seed: int = 5) -> list[StepResult]:
    """Small random actions."""
    rng = np.random.default_rng(seed)
    return [env.step(rng.uniform(-0.3, 0.3, (env.environments, 12))) for _ in range(steps)]


def only(**given: Any) -> Rewards:
    """No reward term but these."""
    none: dict[str, Any] = dict.fromkeys(TERMS, 0.0)
    return Rewards(**(none | given))


def lift(env: PupperEnv) -> None:
    """Into free fall, where joints feel no weight."""
    env.robots.qpos[:, 2] = 1.0


def with_delay(low: float, high: float) -> ServoRanges:
    """The paper's servos without friction, and with other delays."""
    paper = servo_ranges("paper")
    none = {"friction_loss": np.zeros(12)}
    delay = {"low": low, "value": (low + high) / 2, "high": high}
    return replace(
        paper,
        **{
            name: getattr(paper, name) | none | {"dead_time_s": np.full(12, seconds)}
            for name, seconds in delay.items()
        },
    )


def throw(env: PupperEnv, ids) -> None:
    """On their backs."""
    env.robots.qpos[ids, 3:7] = 0.0, 1.0, 0.0, 0.0


def time_out(env: PupperEnv, ids) -> None:
    env.episode_step[ids] = env.config.episode_steps - 1


def make_nan(env: PupperEnv, ids) -> None:
    env.robots.qvel[ids, 7] = np.nan


ENDS = {"fall": throw, "time-out": time_out, "NaN": make_nan}


# --------------------------------------------------------------------------------- the open loop


def published_trot(cycles: float, amplitude_m: float, lift_m: float) -> np.ndarray:
    """Joint targets of facts/training.md section 6: a cosine fore and aft, half a sine up."""
    joints = []
    for i, (leg, behind) in enumerate(zip(LEGS, (0.0, 0.5, 0.5, 0.0), strict=True)):
        phase = 2 * np.pi * (cycles + behind)
        path = np.array([amplitude_m * np.cos(phase), 0.0, lift_m * max(-np.sin(phase), 0.0)])
        neutral = foot_position(leg, *default_pose()[3 * i : 3 * i + 3])
        joints.append(joint_angles(leg, (neutral + path)[None])[0])
    return np.concatenate(joints)


def test_the_open_loop_trot_walks_after_every_kind_of_reset():
    for actuator in ACTUATORS:
        start = Randomisation(push_m_s=0.0)
        if actuator == "ideal":
            # no limit on its torque: a robot that snaps into the trot from far away is thrown
            start = replace(start, joint_rad=0.1, on_the_move=0.0, friction=(0.8, 0.8))
        config = Walking(randomisation=start)
        env = make(actuator, config, 8)
        command = np.array([0.2, 0.0, 0.0])  # strokes of 20 mm to either side
        walk_about(env, 2)
        # robots 0 and 1 walk on from their initial reset
        for i, end in enumerate(ENDS.values()):
            end(env, [2 * i + 2, 2 * i + 3])
        ended = env.step(still(env)).done
        np.testing.assert_array_equal(ended, [False, False, True, True, True, True, True, True])
        assert env.nan_resets == 2
        speed, height = [], []
        for i in range(80):
            env.set_command(command)
            target = np.tile(published_trot(2.5 * SPAN * i, 0.020, 0.020), (8, 1))
            result = env.step((target - env.default) / config.action_scale)
            assert not result.done.any(), f"fell at step {i}"
            if i >= 40:
                speed.append(result.facts.linear_velocity[:, 0])
                height.append(env.robots.qpos[:, 2].copy())
            assert result.facts.gravity[:, 2].max() < -0.8  # within 37 degrees of upright
        speed, height = np.mean(speed, axis=0), np.array(height)
        assert 0.1 < speed.mean() < 0.25, speed
        assert (speed > 0.05).all() and (speed < 0.30).all(), (
            speed
        )  # each slips, and bounces, its own way
        assert (height.mean(axis=0) > 0.070).all() and (height.mean(axis=0) < 0.090).all()


# --------------------------------------------------------------------------------- learned servos


def proportional(gain: float | np.ndarray) -> CommandNetwork:
    """A servo model that goes to `gain` times the command's distance from the default pose."""
    ones, pose = np.ones(12), default_pose()
    return CommandNetwork(
        JOINT_NAMES, SPAN,
        {
            "command_center": pose, "command_scale": ones, "position_center": pose,
            "position_scale": ones, "bound": np.full(12, np.inf), "fir_bias": 0 * ones,
            "fir": (gain * ones)[:, None],
        },
    )  # fmt: skip


def test_a_servo_model_speaks_of_servos_not_of_joints():
    """The third servo of a leg sets thigh + calf; it was fitted while the thigh stood still."""
    env = make("ideal", QUIET, 1, servo_model=proportional(np.tile([1.0, 0.0, 1.0], 4)))
    for _ in range(40):
        env.step(np.tile([0.0, 0.2, 0.0], (1, 4)))
    moved = (env.robots.joints - default_pose())[0].reshape(4, 3)
    # the thighs' servos do not move; the calves' command was to hold the calf against them
    np.testing.assert_allclose(moved, np.tile([0.0, 0.0, 0.1], (4, 1)), atol=0.01)


# ----------------------------------------------------------------------------- what the policy sees


def test_an_observation_is_sixty_named_numbers_in_the_published_order():
    # facts/paper.md 1.1: index ranges and half widths of the noise
    assert [(n, PARTS[n].start, PARTS[n].stop, w) for n, _, w in OBSERVATION] == [
        ("base_linear_velocity", 0, 3, 0.1), ("base_angular_velocity", 3, 6, 0.2),
        ("projected_gravity", 6, 9, 0.05), ("command", 9, 12, 0.0),
        ("joint_position_relative", 12, 24, 0.01), ("joint_velocity", 24, 36, 1.5),
        ("joint_effort", 36, 48, 0.1), ("last_action", 48, 60, 0.0),
    ]  # fmt: skip
    env = make()
    observation, privileged = env.reset()
    assert observation.shape == (4, 60) and observation.dtype == np.float32
    assert privileged.shape == (4, 106) and privileged.dtype == np.float32
    level = np.tile([0, 0, -1.0], (4, 1))
    np.testing.assert_allclose(observation[:, PARTS["projected_gravity"]], level, atol=1e-6)
    # in the order of the project's joints
    assert [env.robots.model.joint(i + 1).name for i in range(12)] == list(JOINT_NAMES)


def test_speed_and_gravity_are_seen_in_the_trunks_frame():
    env, rng = make(), np.random.default_rng(0)
    turn = rng.standard_normal((4, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    speed, rate = rng.standard_normal((2, 4, 3))
    env.robots.qpos[:, 3:7] = turn
    env.robots.qvel[:, :3], env.robots.qvel[:, 3:6] = speed, rate
    observation, _ = env.observe()
    for i in range(4):
        back, expected = np.zeros(4), np.zeros(3)
        mujoco.mju_negQuat(back, turn[i])
        mujoco.mju_rotVecQuat(expected, speed[i], back)
        np.testing.assert_allclose(
            observation[i, PARTS["base_linear_velocity"]], expected, atol=1e-6
        )
        mujoco.mju_rotVecQuat(expected, np.array([0.0, 0.0, -1.0]), back)
        np.testing.assert_allclose(observation[i, PARTS["projected_gravity"]], expected, atol=1e-6)
        # a free joint's rate is in its own frame already
        np.testing.assert_allclose(observation[i, PARTS["base_angular_velocity"]], rate[i], 1e-5)


def test_a_robot_that_cannot_measure_its_speed_sees_zeros_without_noise():
    env = make(config=replace(QUIET, observation=Observation(noise=True, base_velocity="zero")))
    env.robots.qvel[:, :3] = 1.0
    assert not env.observe()[0][:, PARTS["base_linear_velocity"]].any()


def test_noise_stays_within_the_published_bounds_and_fills_them():
    env = make(config=replace(QUIET, observation=replace(SEEN, noise=True)), count=16)
    noisy = np.stack([env.observe()[0] for _ in range(40)])
    env.config = QUIET
    noise = noisy - env.observe()[0]
    for name, _, half in OBSERVATION:
        own = np.abs(noise[..., PARTS[name]])
        assert own.max() <= half * (1 + 1e-5) + 1e-6, name
        assert own.max() >= 0.95 * half, name
        assert noise[..., PARTS[name]].mean() == pytest.approx(0.0, abs=0.1 * half + 1e-12), name


def test_with_ideal_feedback_joints_are_seen_as_they_are():
    for knee in ("linkage", "serial"):
        env = make(servo_ranges(MEASURED, "ideal"), replace(QUIET, knee=knee))
        seen, rng = [], np.random.default_rng(0)
        for _ in range(6):
            result = env.step(rng.uniform(-0.3, 0.3, (4, 12)))
            seen.append(env.robots.joints - default_pose())
            part = result.observation[:, PARTS["joint_position_relative"]]
            np.testing.assert_allclose(part, seen[-1], atol=1e-6)
            effort = result.observation[:, PARTS["joint_effort"]]
            np.testing.assert_allclose(effort, result.facts.torque, atol=1e-6)
            if len(seen) > 4:
                velocity = result.observation[:, PARTS["joint_velocity"]]
                np.testing.assert_allclose(velocity, (seen[-1] - seen[-5]) / (4 * SPAN), atol=1e-4)


def test_with_the_measured_feedback_joints_are_seen_late_coarse_and_off():
    env = make(MEASURED)
    result = walk_about(env, 10)[-1]
    truth = env.robots.joints - default_pose()
    error = result.observation[:, PARTS["joint_position_relative"]] - truth
    assert np.abs(error).max() > 0.01
    quantum = servo_ranges(MEASURED).feedback[0].quantum_rad
    hip = result.observation[:, PARTS["joint_position_relative"]][:, 0::3] / quantum
    np.testing.assert_allclose(hip, np.round(hip), atol=1e-3)


# --------------------------------------------------------------------------------- reproducibility


def trajectory(env: PupperEnv) -> np.ndarray:
    return np.stack([r.observation for r in walk_about(env, 6)])


def test_the_same_seed_gives_the_same_trajectories_and_another_seed_others():
    first = trajectory(make(MEASURED, Walking()))
    np.testing.assert_array_equal(trajectory(make(MEASURED, Walking())), first)
    assert (trajectory(make(MEASURED, Walking(), seed=1)) != first).any(axis=(0, 2)).all()


def test_the_number_of_threads_changes_nothing():
    # many enough to be stepped in two parts by several threads; episodes end, pushes come
    push = Randomisation(push_every_s=(0.02, 0.06))
    config = Walking(episode_s=0.08, commands=Commands(every_s=0.1), randomisation=push)
    one, two = (make(MEASURED, config, 260, threads=threads) for threads in (1, 2))
    for a, b in zip(walk_about(one, 6), walk_about(two, 6), strict=True):
        for name in ("observation", "privileged", "reward", "done", "timed_out"):
            np.testing.assert_array_equal(getattr(b, name), getattr(a, name))
        for name, value in vars(a.facts).items():
            np.testing.assert_array_equal(getattr(b.facts, name), value)
    for name, value in one.state.items():
        np.testing.assert_array_equal(two.state[name], value, err_msg=name)


@pytest.mark.parametrize("task", [Walking(), PRESETS["scratch"]], ids=["usual", "all differences"])
def test_a_restored_state_goes_on_bit_by_bit(task):
    # short episodes, frequent commands and pushes: everything random is drawn meanwhile
    config = replace(
        task, episode_s=0.16, commands=replace(task.commands, every_s=0.1),
        randomisation=replace(task.randomisation, push_every_s=(0.04, 0.1)),
    )  # fmt: skip
    env = make(MEASURED, config)
    walk_about(env, 5)
    saved = env.state
    first = walk_about(env, 10)
    assert any(r.timed_out.any() for r in first)
    env.restore(saved)
    again = walk_about(env, 10)
    another = make(MEASURED, config, seed=9)
    another.restore(saved)
    resumed = walk_about(another, 10)
    for a, b, c in zip(first, again, resumed, strict=True):
        for name in ("observation", "privileged", "reward", "done", "timed_out"):
            np.testing.assert_array_equal(getattr(b, name), getattr(a, name))
            np.testing.assert_array_equal(getattr(c, name), getattr(a, name))


def test_a_state_of_another_model_of_the_robot_goes_on_and_says_that_it_is_not_exact():
    env, other = make(MEASURED, Walking()), make(MEASURED, Walking(), seed=3)
    walk_about(env, 7)
    assert env.restore(env.state)
    assert not other.restore(env.state | {"robot": "another model"})
    before, after = env.state, other.state
    for name in before.keys() - {"robot"}:
        if isinstance(before[name], np.ndarray):
            np.testing.assert_allclose(after[name], before[name], atol=1e-12, err_msg=name)
    np.testing.assert_array_equal(other.robots.field("body_mass"), env.robots.field("body_mass"))
    for a, b in zip(walk_about(env, 3), walk_about(other, 3), strict=True):
        np.testing.assert_allclose(b.observation, a.observation, atol=1e-6)


def test_a_state_of_another_number_of_robots_is_refused():
    with pytest.raises(InputError, match="Resume with the settings"):
        make(count=2).restore(make(count=3).state)


# ------------------------------------------------------------------------------------- servos


def test_each_simulated_robot_has_the_servos_that_were_drawn_for_it():
    for knee in ("linkage", "serial"):
        env = make(MEASURED, Walking(knee=knee), 3)
        walk_about(env, 2)
        throw(env, [1])
        env.step(still(env))
        for i in (0, 1):
            drawn = {field: values[i] for field, values in env.robots.drawn.items()}
            servos = [
                DelayedPDParameters(**{field: values[j] for field, values in drawn.items()})
                for j in range(12)
            ]
            error = error_in_air(env.robots.batch.get_model(i), servos)
            np.testing.assert_allclose(error, 0.0, atol=1e-6)
        assert (env.robots.drawn["stiffness"][0] != env.robots.drawn["stiffness"][1]).all()


def test_in_other_physics_steps_servos_lag_as_in_those_they_were_measured_in():
    measured = servo_ranges(MEASURED)
    still_ones = replace(measured, low=measured.value, high=measured.value)
    lags = {}
    for step_s in (H, 0.001, 0.004, 0.005):
        env = make(still_ones, replace(QUIET, physics_step_s=step_s), 1)
        lags[step_s] = lags_in_air(env.robots.batch.get_model(0), SPAN)
        assert (lags[step_s] > 0.03).all()
        # without: 1.2 to 3.1 ms off
        np.testing.assert_allclose(lags[step_s], lags[H], atol=7e-4)


def test_a_command_acts_after_the_delay_that_was_drawn_and_in_part_between_steps():
    env = make(with_delay(0.004, 0.017), count=12)
    lift(env)
    start, saved = env.robots.batch.bind("ctrl").copy(), env.state
    moved = []
    for change in (0.0, 0.01):  # small: neither rate nor torque is limited
        env.restore(saved)
        env.robots.batch.bind("ctrl")[:] = start
        env.robots.batch.bind("ctrl")[:, 0] += change
        moved.append(env.robots.batch.rollout(10, record=("qpos",))["qpos"][:, :, 7])
    effect = moved[1] - moved[0]
    steps = env.robots.drawn["dead_time_s"][:, 0] / H
    assert np.ptp(steps) > 3
    first = (np.abs(effect) > 1e-9).argmax(axis=1)
    np.testing.assert_array_equal(first, np.floor(steps))
    # linear interpolation: the first effect is that share of the change which has arrived
    share = 1 - (steps - np.floor(steps))
    ratio = effect[np.arange(12), first] / share
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-3)
    assert ratio[0] > 0


def test_after_a_reset_nothing_moves_until_the_delay_is_over():
    for end in (None, *ENDS.values()):
        config = replace(QUIET, randomisation=replace(STILL, joint_rad=0.1))
        env = make("paper", config)  # 66 to 86 ms
        if end is not None:
            walk_about(env, 3)
            end(env, slice(None))
            assert env.step(still(env) + 1.0).done.all()
        start = env.robots.joints.copy()
        held = env.robots.to_servo(start)
        np.testing.assert_array_equal(env.robots.batch.bind("ctrl"), held)
        lines = env.robots.batch.bind("history").reshape(4, 12, -1)
        values = (lines.shape[2] - 2) // 2
        np.testing.assert_array_equal(lines[:, :, -values:], np.repeat(held[..., None], values, 2))
        lift(env)
        for _ in range(3):
            env.step(still(env) + 0.5)
            np.testing.assert_allclose(env.robots.joints, start, atol=1e-6)
        for _ in range(3):
            env.step(still(env) + 0.5)
        assert (np.abs(env.robots.joints - start).max(axis=1) > 0.05).all()


def test_the_delay_buffers_hold_the_longest_delay_that_can_be_drawn():
    for actuator, more in ((MEASURED, 0.0005), ("paper", 0.02), ("release", 0.1), ("ideal", 0.0)):
        servos = servo_ranges(actuator).later(more)
        model = make(servos, count=1).robots.model
        assert model.actuator_history[:, 0].min() * H > servos.longest_dead_time_s, actuator


def test_an_action_moves_the_target_by_its_scale_within_the_joint_limits():
    env = make()
    low, high = limits()
    for action in (0.2, 9.0, -9.0):
        env.step(still(env) + action)
        target = np.clip(default_pose() + 0.5 * action, low, high)
        target[2::3] += target[1::3]  # servo 3 holds thigh + calf
        np.testing.assert_allclose(
            env.robots.batch.bind("ctrl"), np.tile(target, (4, 1)), atol=1e-12
        )


# ------------------------------------------------------------------------------------- episodes


def test_a_simulation_that_becomes_nan_ends_without_reward_and_starts_anew():
    env = make(MEASURED)
    walk_about(env, 3)
    make_nan(env, [1, 3])
    result = env.step(still(env))
    np.testing.assert_array_equal(result.done, [False, True, False, True])
    assert not result.timed_out.any()
    assert (result.reward[[1, 3]] == 0.0).all() and (result.reward[[0, 2]] != 0.0).all()
    assert env.nan_resets == 2
    np.testing.assert_array_equal(env.episode_step, [4, 0, 4, 0])
    for _ in range(3):
        assert np.isfinite(env.robots.batch.state).all()
        assert np.isfinite(result.observation).all() and np.isfinite(result.privileged).all()
        result = env.step(still(env))
        assert not result.done.any() and np.isfinite(result.reward).all()
    assert env.nan_resets == 2


def test_a_robot_has_fallen_when_it_tilts_beyond_53_degrees_or_its_trunk_touches_the_ground():
    env = make()
    lift(env)
    half = np.radians([0.0, 50.0, 56.0, 180.0]) / 2
    turn = np.outer(np.cos(half), [1, 0, 0, 0]) + np.outer(np.sin(half), [0, 1, 0, 0])
    env.robots.qpos[:, 3:7] = turn
    result = env.step(still(env))
    np.testing.assert_array_equal(result.done, [False, False, True, True])
    assert not result.timed_out.any()
    env = make()
    qpos, folded = env.robots.qpos, np.tile([0.0, 2.4, -2.18], 4)
    # folded feet reach 26.3 mm down, the trunk 26.75 mm: a little above the ground, it lands on it
    qpos[0, 2], qpos[0, 7:] = 0.028, folded
    qpos[1, 2], qpos[1, 7:] = 1.0, folded
    action = still(env)
    action[:2] = (folded - default_pose()) / 0.5
    done = np.array([env.step(action).done for _ in range(3)]).any(axis=0)
    np.testing.assert_array_equal(done, [True, False, False, False])


def test_a_time_out_hands_over_the_last_observation_of_the_old_episode():
    long, short = replace(QUIET, episode_s=10.0), replace(QUIET, episode_s=0.1)
    expected = walk_about(make(MEASURED, long), 5)[-1]
    result = walk_about(make(MEASURED, short), 5)[-1]
    assert result.timed_out.all() and result.done.all()
    np.testing.assert_array_equal(result.terminal["ids"], np.arange(4))
    np.testing.assert_array_equal(result.terminal["observation"], expected.observation)
    # the critic's last number is the share of the episode that is left
    np.testing.assert_array_equal(
        result.terminal["privileged"][:, :-1], expected.privileged[:, :-1]
    )
    assert (result.terminal["privileged"][:, -1] == 0.0).all()
    assert (result.privileged[:, -1] == 1.0).all()
    assert (result.observation != expected.observation).any(axis=1).all()


def test_what_chance_did_after_a_step_is_handed_over_undone():
    """Robot 0 gets a new command, 1 a push, 2 both and falls, 3 neither."""
    for true in (False, True):
        seen = Observation(noise=False, base_velocity="true" if true else "zero")
        task = replace(QUIET, observation=seen, randomisation=Randomisation(push_m_s=1.0))
        env, twin = make(MEASURED, task), make(MEASURED, task)
        for e in (env, twin):
            e._until_command[:], e._until_push[:] = np.inf, np.inf
            throw(e, [2])
        env._until_command[[0, 2]] = env._until_push[[1, 2]] = 0.0
        found, undone = env.step(still(env)), twin.step(still(twin))
        assert (env.command[0] != twin.command[0]).any() and found.done.tolist()[2]
        assert found.unforeseen["ids"].tolist() == [0, 1]
        assert (found.observation[0] != undone.observation[0]).any()
        assert (found.privileged[1] != undone.privileged[1]).any()
        for name in ("observation", "privileged"):
            np.testing.assert_allclose(
                found.unforeseen[name], getattr(undone, name)[:2], rtol=0, atol=1e-6
            )
        assert undone.unforeseen["ids"].tolist() == []


def test_facts_are_of_the_old_episode_also_where_it_ended():
    env = make(config=replace(QUIET, randomisation=replace(STILL, joint_rad=0.2)))
    env.set_command(np.array([0.1, 0.0, 0.0]))
    walk_about(env, 2)
    throw(env, [0])
    time_out(env, [1])
    facts = env.step(still(env) + 0.25).facts
    np.testing.assert_array_equal(facts.action, 0.25)
    np.testing.assert_array_equal(facts.command, np.tile([0.1, 0.0, 0.0], (4, 1)))
    assert facts.gravity[0, 2] > 0.9
    assert (facts.air_s + facts.contact_s >= SPAN).all()  # a new episode starts with zeros


def test_the_stride_average_forgets_with_its_time_constant_and_at_the_end_of_an_episode():
    env = make()
    lift(env)
    env.robots.qvel[:, :2] = np.random.default_rng(0).uniform(-1, 1, (4, 2))
    velocity = env.observe()[0][:, :2]
    for k in range(1, 4):
        average = env.step(still(env)).facts.stride_velocity[:, :2]
        # a share of 20 ms / 200 ms each step, from a start at rest
        np.testing.assert_allclose(average, velocity * (1 - 0.9**k), atol=1e-4)
    throw(env, slice(None))
    env.step(still(env))
    assert np.abs(env.step(still(env)).facts.stride_velocity).max() < 0.01


def test_leaving_the_field_is_a_time_out():
    env = make(config=replace(QUIET, terrain="rough"))
    qpos = env.robots.qpos
    qpos[:, 0] = 7.4, 7.6, -7.6, 0.0
    qpos[:, 1:3] = 0.0, 1.0
    result = env.step(still(env))
    np.testing.assert_array_equal(result.timed_out, [False, True, True, False])
    assert np.abs(env.robots.qpos[1:3, :2]).max() <= 7.0


# ------------------------------------------------------------------------ commands and randomness


def test_commands_are_redrawn_at_random_times():
    env = make(config=replace(QUIET, commands=Commands(every_s=0.1, standing=0.0)), count=16)
    changes = []
    for _ in range(60):
        before = env.command.copy()
        result = env.step(still(env))
        changes.append((env.command != before).any(axis=1)[~result.done])
    changes = np.concatenate(changes)
    # exponential times with a mean of five steps: a step sees one with 1 - e^(-1/5)
    expected = 1 - np.exp(-SPAN / 0.1)
    error = 5 * np.sqrt(expected * (1 - expected) / len(changes))
    assert changes.mean() == pytest.approx(expected, abs=error)


def test_commands_fill_their_ranges_with_the_given_shares_of_standing_and_single():
    commands = Commands((-0.2, 0.3), (-0.1, 0.1), (-0.5, 0.5), 0.25, 0.4)
    env = make(config=replace(QUIET, commands=commands), count=512)
    ranges = np.array([(-0.2, 0.3), (-0.1, 0.1), (-0.5, 0.5)])
    assert (env.command >= ranges[:, 0]).all() and (env.command <= ranges[:, 1]).all()
    assert (np.ptp(env.command, axis=0) > 0.9 * np.diff(ranges)[:, 0]).all()
    axes = (env.command != 0).sum(axis=1)
    # four standard errors of a share of 512
    assert (axes == 0).mean() == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / 512))
    assert (axes == 1).mean() == pytest.approx(0.75 * 0.4, abs=4 * np.sqrt(0.3 * 0.7 / 512))
    assert not (axes == 2).any()


def test_friction_payload_and_start_are_drawn_within_their_ranges():
    env = make(config=Walking(randomisation=Randomisation(on_the_move=0.0)), count=64)
    feet = [env.robots.model.geom(f"{leg}_foot").id for leg in ("LF", "RF", "LB", "RB")]
    friction = env.robots.field("geom_friction")[:, feet, 0]
    np.testing.assert_array_equal(friction, np.repeat(friction[:, :1], 4, axis=1))
    assert 0.3 <= friction.min() < 0.4 and 0.9 < friction.max() <= 1.0
    trunk = env.robots.model.body("trunk").id
    payload = env.robots.field("body_mass")[:, trunk] - env.robots.model.body_mass[trunk]
    assert -0.05 <= payload.min() < -0.03 and 0.03 < payload.max() <= 0.05
    away = env.robots.joints - default_pose()
    low, _ = limits()
    assert 0.18 < np.abs(away).max() <= 0.2
    assert (away >= low - default_pose() - 1e-12).all()
    observation, _ = PupperEnv(
        Walking(randomisation=Randomisation(on_the_move=0.0), observation=SEEN),
        servo_ranges("ideal"), 64, 0, 1,
    ).observe()  # fmt: skip
    speed = np.abs(observation[:, PARTS["base_linear_velocity"]]).max(axis=0)
    assert (speed <= [0.3, 0.2, 0.1]).all() and (speed > [0.25, 0.15, 0.08]).all()


def test_pushes_set_the_horizontal_speed_within_their_range_at_their_times():
    push = replace(STILL, push_m_s=0.5, push_every_s=(0.1, 0.1))
    env = make(config=replace(QUIET, randomisation=push), count=16)
    lift(env)
    pushed = []
    for _ in range(10):
        before = env.robots.qvel[:, :2].copy()
        env.step(still(env))
        now = env.robots.qvel[:, :2]
        pushed.append((np.abs(now - before) > 1e-3).any(axis=1).mean())
        assert np.abs(now).max() <= 0.5 + 1e-6
    np.testing.assert_array_equal(pushed, [0, 0, 0, 0, 1, 0, 0, 0, 0, 1])


# ------------------------------------------------------------------------------------ curriculum


def test_a_ramp_is_linear_between_its_ends_over_the_samples_of_all_processes():
    eased = Curriculum(commands=(0.6, 1.0, 1.0, 3.0))
    factors = [eased.at(s)["commands"] for s in (0, 1e6, 2e6, 3e6, 9e6)]
    assert factors == pytest.approx([0.6, 0.6, 0.8, 1, 1])
    assert Curriculum().at(0) == Curriculum().at(1e9) == FULL
    config = replace(QUIET, curriculum=Curriculum(commands=(0.0, 1.0, 0.0, 8e-6)))
    env = make(with_delay(0.0, 0.0), config, 2)
    env.processes = 2
    env.step(still(env))
    assert env.level["commands"] == pytest.approx(0.5)


def test_the_curriculum_changes_commands_penalties_progress_and_widths():
    rewards = only(
        alive=1.0, action_rate=-1.0, progress=2.0, base_linear_velocity=1.0, linear_sigma=0.1,
        tracking_shape="exponential",
    )  # fmt: skip
    eased = (0.25, 1.0, 2e-6, 3e-6)  # from the third sample on as it is
    config = replace(
        QUIET, rewards=rewards,
        commands=Commands((0.2, 0.2), (0.0, 0.0), (0.0, 0.0), 0.0, 0.0),
        curriculum=Curriculum(
            commands=eased, penalties=eased, progress=eased,
            linear_sigma=(2.0, *eased[1:]),
        ),
    )  # fmt: skip
    env = make(with_delay(0.04, 0.04), config, 1)

    def facts() -> tuple[float, float, float]:
        env.reset()
        forward = env.command[0, 0]
        env._strides.velocity[:, 0] = 0.02
        found = env.step(still(env) + 0.1)
        speed = found.facts.linear_velocity[0, :2]
        away = np.hypot(forward - speed[0], speed[1])
        width = -away / np.log(found.terms["base_linear_velocity"][0] / SPAN)
        factor = found.terms["progress"][0] / (SPAN * progress(found.facts, rewards)[0])
        assert factor == pytest.approx(0.5 if env.steps == 1 else 2.0)
        return forward, found.terms["action_rate"][0], width

    full = -1.0 * 12 * 0.1**2 * SPAN
    assert env.level["commands"] == 0.25
    assert facts() == pytest.approx((0.05, 0.25 * full, 0.2))
    env.step(still(env))
    env.step(still(env))
    assert env.level == FULL
    assert facts() == pytest.approx((0.2, full, 0.1))


# -------------------------------------------------------------------------------------- refusals


def test_impossible_settings_are_refused_by_name():
    assert_each_refused(
        [
            ({"control_step_s": 0.005}, "whole multiple"),
            ({"physics_step_s": 0.0}, "whole multiple"),
            ({"episode_s": 0.01}, "at least one step"),
            ({"commands": Commands(standing=1.5)}, "commands.standing"),
            ({"commands": Commands(single=-0.1)}, "commands.single"),
        ],
        lambda settings: Walking(**settings),
    )
    assert_each_refused([(0, "at least 1")], lambda count: make(count=count))


def test_commands_come_late_at_random_where_the_calibration_has_jitter():
    servos = replace(servo_ranges("paper"), command_jitter_s=0.003)
    env = PupperEnv(Walking(), servos, 32, threads=1)
    delays = []
    for _ in range(25):
        env.step(still(env))
        own = env.robots.field("actuator_delay") - env.robots.drawn["dead_time_s"]
        assert np.ptp(own, axis=1).max() < 1e-12  # one frame for all servos of a robot
        delays.append(own[:, 0].copy())
    late = np.array(delays)
    assert late.min() >= -0.003 - 1e-12
    assert late.mean() == pytest.approx(0.0, abs=3e-4)
    assert late.std() == pytest.approx(0.003, rel=0.15)


def test_rewards_and_observations_of_a_users_own_come_beside_the_usual_ones():
    def level(step, rewards):
        return -step.gravity[:, 2]

    def height(env, rows):
        return env.robots.qpos[rows, 2:3]

    env = make_env(
        "paper", environments=3, seed=1, threads=1,
        terms={"level": (2.0, level)}, observations={"height": height},
    )  # fmt: skip
    result = env.step(env.action)
    np.testing.assert_allclose(
        result.terms["level"], -2.0 * env.config.control_step_s * result.facts.gravity[:, 2]
    )
    assert result.observation.shape == (3, 61)
    np.testing.assert_allclose(result.observation[:, -1], env.robots.qpos[:, 2], rtol=1e-6)
    plain = make_env("paper", environments=3, seed=1, threads=1)
    usual = plain.step(plain.action)
    np.testing.assert_array_equal(result.observation[:, :-1], usual.observation)
    np.testing.assert_allclose(result.reward - result.terms["level"], usual.reward, atol=1e-12)
    with pytest.raises(InputError, match="called alive already"):
        make_env("paper", environments=1, terms={"alive": (1.0, level)})
