"""Set-points and readings that exports compute on torch, and their twin in NumPy."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters, DelayLine
from pupper_sysid.servo_models.held_feedback import HeldFeedback as Feedback
from pupper_sysid.servo_models.step_size import CONTINUOUS_S, Engine, in_loop, nearest_in_loop
from pupper_sysid.sim.export.check import held, walk_commands
from pupper_sysid.sim.export.torch_servos import HeldFeedback, ServoBank, SetPoint

FAST = {"dead_time_s": 0.0137, "jitter_s": 0.0, "velocity_limit_rad_s": np.inf}
SLOW = {"dead_time_s": 0.0301, "jitter_s": 0.0, "velocity_limit_rad_s": 2.0}
PD = {
    "stiffness": 2.0, "damping": 0.1, "back_emf": 0.0, "effort_limit": 5.0, "inertia": 0.01,
    "step_s": CONTINUOUS_S,
}  # fmt: skip
READ = {"poll_period_s": 0.0268, "loss": 0.42, "quantum_rad": 0.0, "offset_rad": 0.0}
AGE_S = 0.0268 * (0.5 + 0.42 / 0.58)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("step_s", [0.002, 0.005, 1 / 240])
def test_a_command_arrives_after_its_dead_time_to_a_fraction_of_a_step(step_s):
    rng = np.random.default_rng(0)
    commands = np.repeat(rng.uniform(-0.9, 0.9, (12, 3, 2)), 4, axis=0)
    set_point = SetPoint({"a": FAST, "b": FAST | {"dead_time_s": 0.03}}, ["a", "b"], 3, step_s)
    set_point.reset(torch.zeros(3, 2))
    there = np.stack([set_point.step(torch.tensor(c).float()).numpy() for c in commands])
    line = DelayLine(np.array([FAST["dead_time_s"], 0.03]), step_s)
    line.reset(np.zeros((3, 2)))
    np.testing.assert_allclose(there, line.shift(commands), atol=1e-5)


def test_a_set_point_moves_at_the_servos_speed():
    set_point = SetPoint({"a": SLOW}, ["a"], 1, 0.005)
    set_point.reset(torch.zeros(1, 1))
    track = np.array([set_point.step(torch.ones(1, 1)).item() for _ in range(60)])
    # 30.1 ms late, then 2 rad/s; a step has the mean over itself
    late = np.clip(0.005 * np.arange(61) - 0.0301, 0, None)
    np.testing.assert_allclose(track, np.diff(late**2) / 0.005, atol=1e-5)


def test_each_command_has_a_latency_of_its_own_and_none_overtakes_another():
    jittery = FAST | {"dead_time_s": 0.03, "jitter_s": 0.008}
    robots, step_s = 4000, 0.001
    set_point = SetPoint({"a": jittery}, ["a"], robots, step_s, generator=generator())
    set_point.reset(torch.zeros(robots, 1))
    track = [set_point.step(torch.full((robots, 1), 1.0)) for _ in range(100)]
    latency = step_s * (100 - torch.stack(track).sum(0))  # the area above a step is its delay
    assert latency.mean().item() == pytest.approx(0.03, abs=5e-4)
    assert latency.std().item() == pytest.approx(0.008, rel=0.05)
    assert latency.min().item() >= 0.022 - 1e-5
    rising = SetPoint({"a": jittery}, ["a"], 200, step_s, generator=generator(1))
    rising.reset(torch.zeros(200, 1))
    track = torch.stack([rising.step(torch.full((200, 1), float(k // 5))) for k in range(200)])
    assert (track.diff(dim=0) >= -1e-5).all()


@pytest.mark.parametrize("step_s", [0.001, 0.005, 0.02])
def test_readings_are_as_old_as_the_servos_say_at_any_physics_step(step_s):
    robots = 3000
    feedback = HeldFeedback({"a": READ}, ["a"], robots, step_s, generator=generator())
    feedback.reset(torch.zeros(robots, 1))
    for k in range(1, round(0.4 / step_s) + 1):
        reading = feedback.step(torch.full((robots, 1), k * step_s))
    ages = (k * step_s - reading).numpy()
    # three standard errors of the mean of so many ages
    assert ages.mean() == pytest.approx(AGE_S, abs=3 * ages.std() / np.sqrt(robots))
    torch.testing.assert_close(feedback.age, k * step_s - reading, atol=2e-5, rtol=0)


@pytest.mark.parametrize("step_s", [0.002, 0.005, 0.04])
def test_readings_in_numpy_are_as_old(step_s):
    feedback = Feedback(poll_period_s=0.0268, loss=0.42)
    feedback.reset(np.zeros(3000), step_s, np.random.default_rng(0))
    for k in range(1, round(0.4 / step_s) + 1):
        reading = feedback.step(np.full(3000, k * step_s))
    ages = k * step_s - reading
    assert ages.mean() == pytest.approx(AGE_S, abs=3 * ages.std() / np.sqrt(3000))
    np.testing.assert_allclose(feedback.age_s, ages, atol=1e-9)


def test_both_read_counts_and_ideal_feedback_is_fresh():
    coarse = Feedback(quantum_rad=0.01, offset_rad=0.003)
    coarse.reset(0.0, 0.005)
    assert coarse.step(0.0179) == pytest.approx(0.02) and coarse.age_s == 0.0
    numbers = READ | {"poll_period_s": 0.0, "quantum_rad": 0.01}
    ideal = HeldFeedback({"a": numbers}, ["a"], 1, 0.005)
    ideal.reset(torch.zeros(1, 1))
    assert ideal.step(torch.full((1, 1), 0.0179)).item() == pytest.approx(0.02)
    with pytest.raises(InputError, match="reset"):
        Feedback().step(0.0)
    with pytest.raises(InputError, match="time_step_s"):
        Feedback().reset(0.0, 0.0)


def test_one_robot_is_reset_and_the_others_go_on():
    bank = ServoBank({"a": FAST | PD}, {"a": READ}, ["a"], 3, 0.005)
    rest, still = torch.tensor([[0.1], [0.2], [0.3]]), torch.zeros(3, 1)
    for _ in range(10):
        torques = bank.efforts(torch.ones(3, 1), rest, still)
        bank.read(rest)
    torch.testing.assert_close(torques, 2 * (1 - rest))
    bank.restart([1])
    moved = torch.tensor([[0.1], [-0.5], [0.3]])
    assert bank.read(moved)[1].item() == pytest.approx(-0.5)
    torques = bank.efforts(torch.ones(3, 1), moved, still)  # the second rests where it is seen
    torch.testing.assert_close(torques[:, 0], torch.tensor([1.8, 0.0, 1.4]))
    before = bank.feedback.age.clone()
    bank.read(moved)
    bank.read(moved)  # no time passes between two readings
    assert (bank.feedback.age - before <= 0.005 + 1e-6).all()


SERVOS = DelayedPDParameters(  # damped, limited in torque, limited in speed, braked by back-EMF
    stiffness=np.array([2500.0, 3000.0, 2500.0, 720.0]),
    damping=np.array([70.0, 40.0, 70.0, 0.0]),
    friction_loss=np.array([4.0, 4.0, 8.0, 2.0]),
    armature=np.ones(4),
    effort_limit=np.array([500.0, 180.0, 300.0, 130.0]),
    velocity_limit=np.array([1000.0, np.inf, 5.0, 5.3]),
    dead_time_s=np.array([0.0123, 0.0087, 0.0214, 0.006]),
    back_emf=np.array([0.0, 4.0, 0.0, 24.0]),
)


def moved_by_torques(commands, step_s: float, fitted_s: float, servos=SERVOS) -> np.ndarray:
    """Positions of joints that a simulator moves by the bank's torques, shape (steps + 1, 4)."""
    names = list("abcd")
    keys = [
        "stiffness", "damping", "back_emf", "effort_limit", "dead_time_s", "velocity_limit_rad_s",
    ]  # fmt: skip
    values = servos.arrays() | {"velocity_limit_rad_s": servos.velocity_limit}
    numbers = {
        name: {key: float(values[key][n]) for key in keys}
        | {"jitter_s": 0.0, "inertia": 1.0, "step_s": fitted_s}
        for n, name in enumerate(names)
    }
    bank = ServoBank(numbers, dict.fromkeys(names, READ), names, 1, step_s)
    position, velocity, track = np.zeros(4), np.zeros(4), [np.zeros(4)]
    for command in held(commands, step_s):
        state = (torch.tensor(x, dtype=torch.float32)[None] for x in (position, velocity))
        torque = bank.efforts(torch.full((1, 4), float(command)), *state)[0].numpy()
        wanted = velocity + step_s * torque
        most = step_s * servos.friction_loss
        velocity = np.sign(wanted) * np.maximum(np.abs(wanted) - most, 0.0)
        position = position + step_s * velocity
        track.append(position)
    return np.array(track)


@pytest.mark.parametrize("fitted_s", [CONTINUOUS_S, 0.002])
def test_torques_of_steps_move_a_joint_as_its_servo_in_the_steps_of_its_fit(fitted_s):
    commands, step_s = walk_commands(), 0.005
    at, own = in_loop(SERVOS, fitted_s, commands)

    def apart_rad(times, there):
        wanted = np.stack([np.interp(times, at, track) for track in own.T], axis=1)
        return np.sqrt(np.mean((there - wanted) ** 2, axis=0))

    there = moved_by_torques(commands, step_s, fitted_s)
    errors = apart_rad(step_s * np.arange(len(there)), there)
    explicit = Engine(implicit=False)  # a PD from before each step, delayed as is best for it
    usual = nearest_in_loop(SERVOS, step_s, fitted_s, explicit)
    before = apart_rad(*in_loop(usual, step_s, commands, explicit))
    assert (errors < 0.5 * before).all(), (1e3 * errors, 1e3 * before)


@pytest.mark.parametrize("step_s", [0.001, 0.002])
def test_a_dead_time_shorter_than_the_lead_of_its_steps_costs_a_running_set_point_nothing(step_s):
    commands = walk_commands()
    servos = replace(SERVOS, dead_time_s=np.full(4, 0.001))
    at, own = in_loop(servos, 0.002, commands)
    there = moved_by_torques(commands, step_s, 0.002, servos)
    times = step_s * np.arange(len(there))
    error = there[:, 3] - np.interp(times, at, own[:, 3])
    assert np.sqrt(np.mean(error**2)) < 0.3e-3


def test_torques_hold_a_load_with_the_whole_stiffness():
    bank = ServoBank({"a": FAST | PD}, {"a": READ}, ["a"], 1, 0.005)
    at, still = torch.zeros(1, 1), torch.zeros(1, 1)
    bank.read(at)
    torques = [bank.efforts(torch.full((1, 1), 0.4), at, still).item() for _ in range(20)]
    assert torques[-1] == pytest.approx(0.8)  # 2 N·m/rad times 0.4 rad, held fast
