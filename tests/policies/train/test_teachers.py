"""Teachers of a first gait: the trot, networks that see the truth, and who learns from them."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from pupper_sysid.policies.train import imitation, training
from pupper_sysid.policies.train.imitation import LearnedTeacher, TrotTeacher, imitate
from pupper_sysid.policies.train.learner import Learner, Ranks, WalkingVecEnv, read_checkpoint
from pupper_sysid.policies.train.run_file import (
    Architecture,
    Hyperparameters,
    Imitation,
    check_teacher,
    load_run,
    preset,
    save_run,
    teacher_of,
)
from pupper_sysid.policies.train.training import BEST, LAST, make_env, make_learner, train
from pupper_sysid.sim.walking.config import CLOCK, Rewards, Walking
from pupper_sysid.sim.walking.step import PRIVILEGED_PARTS
from support.checkpoints import different, stop_after
from support.refusals import assert_each_refused
from support.tiny_training import tiny_run

# ------------------------------------------------------------------------------ the trot


def test_the_teacher_goes_on_from_the_last_action_by_one_step_of_the_trot_and_stands_if_told():
    """The phase moves on by 2 π f dt."""
    vec_env = WalkingVecEnv(make_env(tiny_run(environments=3), Ranks()))
    env, teacher = vec_env.env, TrotTeacher(vec_env)
    trot = env.trot
    env.command[:] = [[0.15, 0.0, 0.0], [0.0, 0.08, 0.0], [0.1, 0.0, 0.4]]
    scale, dt = env.config.action_scale, 0.02
    for phase in np.linspace(-3.0, 3.0, 7):
        now, step = np.full(3, phase), 2 * np.pi * trot.frequency_hz * dt
        env.action[:] = (trot.joints(now, env.command) - env.default) / scale
        env.last_action[:] = (trot.joints(now - step, env.command) - env.default) / scale
        expected = trot.joints(now + step, env.command)
        # the phase is read off a grid: 0.03 rad of it move a foot by half a millimetre
        shown = env.default + scale * teacher.actions(vec_env.get_observations()).numpy()
        np.testing.assert_allclose(shown, expected, atol=0.02)
    env.command[:] = 0.0
    standing = TrotTeacher(vec_env).actions(vec_env.get_observations())
    np.testing.assert_allclose(standing.numpy(), 0.0, atol=1e-7)


def test_the_teachers_commands_are_corrected_until_the_policy_walks_at_the_given_ones():
    """A policy that walks at other speeds than its teacher's feet, by gains of its own."""
    rng = np.random.default_rng(3)
    env = make_env(tiny_run(environments=200), Ranks())
    teacher = TrotTeacher(WalkingVecEnv(env))

    def walked(command: np.ndarray) -> np.ndarray:
        x, y, turn = teacher.corrected(command).T
        backward = np.where(x < 0, 0.8, 1.1)
        return np.column_stack(
            [backward * x, y * (0.9 - 1.5 * np.abs(x)), 1.15 * turn - 0.6 * y]
        )  # fmt: skip

    def draw() -> np.ndarray:
        return rng.uniform([-0.2, -0.1, -0.5], [0.2, 0.1, 0.5], (200, 3))

    def error() -> np.ndarray:
        command = draw()
        return np.abs(walked(command) - command).mean(axis=0)

    before = error()
    for _ in range(40):
        env.command[:], env.episode_step[:] = draw(), 1
        for _ in range(80):
            env._strides.velocity[:] = walked(env.command) + rng.normal(
                0, [0.02, 0.02, 0.1], (200, 3)
            )
            teacher.watch()
        teacher.adapt(0.2)
    assert (error() < 0.2 * before).all()


@pytest.mark.slow
def test_imitation_brings_the_policy_nearer_to_the_trot():
    rounds = 6
    run = tiny_run(
        environments=8, task=Walking(),
        learner=Hyperparameters(steps_per_environment=24, minibatches=4),
        imitation=Imitation(rounds, rollouts=2, epochs=5, minibatches=4),
        architecture=Architecture("mlp", (64,), 8, (16,)),
    )  # fmt: skip
    learner = make_learner(run, Ranks())
    begun = difference_when_alone(learner, run)
    teacher = TrotTeacher(learner.env)
    for i in range(rounds):
        reported = imitate(learner, teacher, run.imitation, i)
    ended = difference_when_alone(learner, run)
    # over eight seeds 0.35 to 0.69, and the reported one 0.48 to 0.98 of that when alone
    assert ended < 0.75 * begun
    assert 0.2 * ended < reported < 2 * ended


def difference_when_alone(learner: Learner, run) -> float:
    """Root mean square difference to the teacher of a policy that acts for itself, in a twin."""
    env = WalkingVecEnv(make_env(replace(run, seed=50), Ranks()))
    squares, teacher = [], TrotTeacher(env)
    seen = env.get_observations()
    with torch.inference_mode():
        for _ in range(24):
            action = learner.actor(seen)
            squares.append(float((action - teacher.actions(seen)).square().mean()))
            seen = env.step(action)[0]
    return float(np.sqrt(np.mean(squares)))


# ------------------------------------------------------------------------------ a learned teacher

SEES_ALL = Architecture("mlp", (16,), 8, (16,), privileged_actor=True)


def tiny_teacher(**changes):
    return tiny_run(architecture=SEES_ALL, imitation=Imitation(iterations=0), **changes)


@pytest.fixture(scope="module")
def taught(tmp_path_factory):
    """Folder of a tiny teacher's run."""
    folder = tmp_path_factory.mktemp("taught") / "run"
    train(folder, tiny_teacher())
    return folder


class Circle(torch.nn.Module):
    """A gait: joints follow the clock, each later than the one before, as far as commanded."""

    def forward(self, seen: TensorDict) -> torch.Tensor:
        cos, sin = seen["privileged"][:, PRIVILEGED_PARTS["clock"]][:, :2].T
        return self.at(torch.atan2(sin, cos), seen["policy"][:, 9:10])

    @staticmethod
    def at(phase: torch.Tensor, forward: torch.Tensor) -> torch.Tensor:
        """Actions at phases [rad] and commanded speeds, shape (n, 12)."""
        return (0.2 + forward) * torch.cos(phase[:, None] + 0.3 * torch.arange(12))


def test_a_learned_teacher_continues_its_gait_from_the_last_two_actions():
    env = WalkingVecEnv(make_env(tiny_run(environments=5), Ranks()))
    env.env.command[:] = (0.1, 0.0, 0.0)
    seen = env.get_observations()
    step = 2 * np.pi * env.env.config.rewards.clock_hz * 0.02
    phase = torch.tensor([0.0, 1.0, 2.5, -2.0, -0.3])
    forward = torch.full((5, 1), 0.1)
    rng = np.random.default_rng(0)
    for ago, name in ((0, "action"), (1, "last_action")):
        acted = Circle.at(phase - ago * step, forward).numpy() + 0.005 * rng.normal(size=(5, 12))
        setattr(env.env, name, acted)
    before = seen.clone()
    found = LearnedTeacher(env, Circle()).actions(seen)  # pyright: ignore[reportArgumentType]
    torch.testing.assert_close(found, Circle.at(phase + step, forward), atol=0.01, rtol=0)
    assert all(torch.equal(seen[k], before[k]) for k in seen.keys())


@pytest.mark.slow
def test_a_run_from_nothing_trains_its_teacher_first_and_resumes_in_the_midst_of_it(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(
        training, "teacher_of", lambda run: tiny_teacher(seed=run.seed, minutes=0.6 * run.minutes)
    )
    run = tiny_run(imitation=replace(tiny_run().imitation, teacher="own"))
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    phases: list[str] = []
    train(whole, run, lambda now: phases.append(now.phase))
    assert phases == ["teacher"] * 3 + ["imitation"] * 2 + ["ppo"] * 3
    assert load_run(whole / "teacher").architecture.privileged_actor
    assert (whole / "policy_best").is_dir()
    assert not list((whole / "teacher").glob("policy_*")), "a teacher is no policy for a robot"
    for where in (("teacher", 2), ("imitation", 1), ("ppo", 1)):
        resumed = (parts / "run.yaml").exists()
        train(parts, None if resumed else run, stop_after(*where))
        assert (parts / "policy_last").is_dir()
    train(parts, None)
    for name in ("teacher/last.pt", LAST):
        assert different(read_checkpoint(whole / name), read_checkpoint(parts / name)) == []
    run_s, teacher_s = (
        read_checkpoint(whole / name)["more"]["elapsed_s"] for name in (LAST, f"teacher/{LAST}")
    )
    assert run_s > teacher_s > 0, "the time of a teacher is part of its run's"


def test_a_teacher_of_a_runs_own_has_its_robot_seed_actions_and_clock(tmp_path):
    run = replace(preset("fast", "lstm", "scratch"), actuator="paper", seed=5, threads=1)
    rewards = replace(run.task.rewards, clock_hz=3.0)
    task = replace(run.task, action_scale=0.4, knee="serial", rewards=rewards)
    run = replace(run, task=task)
    own = teacher_of(run)
    assert (own.actuator, own.seed, own.threads) == ("paper", 5, 1)
    assert own.minutes < run.minutes
    assert own.architecture.kind == "mlp" and own.architecture.privileged_actor
    for name in ("action_scale", "control_step_s", "knee"):
        assert getattr(own.task, name) == getattr(task, name)
    for name in CLOCK:
        assert getattr(own.task.rewards, name) == getattr(rewards, name)
    save_run(tmp_path, own)
    assert check_teacher(tmp_path, run) == own
    # 0.025 s are no whole number of the teacher's steps of 4 ms
    slower = replace(run, task=replace(task, control_step_s=0.025, physics_step_s=0.0025))
    assert teacher_of(slower).task.physics_step_s == 0.0025


@pytest.mark.slow
def test_what_cannot_teach_a_run_is_refused_and_leaves_its_name_free(tmp_path, taught):
    train(tmp_path / "policy", tiny_run(imitation=Imitation(iterations=0), iterations=1))
    broken, other = (Path(shutil.copytree(taught, tmp_path / name)) for name in ("broken", "other"))
    (broken / BEST).write_bytes(b"not a checkpoint")
    content = torch.load(other / BEST, weights_only=True)
    first = content["actor_state_dict"]["mlp.0.weight"]
    content["actor_state_dict"]["mlp.0.weight"] = torch.cat([first, first[:, :3]], dim=1)
    torch.save(content, other / BEST)

    def learn(case):
        folder, task = case
        changes = {"task": task} if task else {}
        teacher = Imitation(iterations=1, rollouts=1, teacher=str(folder))
        train(tmp_path / "run", tiny_run(imitation=teacher, **changes))

    cases = [
        ((tmp_path / "policy", None), "is not a teacher"),
        ((tmp_path / "policy", None), "--start teacher"),
        ((broken, None), "damaged"),
        ((other, None), "see something else. Train one with this version"),
        ((taught, Walking(action_scale=0.25)), "task.action_scale 0.5"),
        ((taught, Walking(rewards=Rewards(clock_hz=3.0))), "clock_hz 3.6"),
    ]
    assert_each_refused(cases, learn)
    assert not (tmp_path / "run").exists()


# ------------------------------------------------------------------------------ optimiser


@pytest.mark.parametrize("shape", [(24, 60), (64, 16), (12, 12)])
def test_muon_in_float32_steps_like_torchs_in_bfloat16(shape):
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(shape, generator=generator)
    ours, theirs = (torch.nn.Parameter(start.clone()) for _ in range(2))
    pair = (
        imitation.Float32Muon([ours]),
        torch.optim.Muon([theirs], weight_decay=0.0, adjust_lr_fn="match_rms_adamw"),
    )
    for _ in range(3):
        ours.grad = theirs.grad = torch.randn(shape, generator=generator)
        for optimiser in pair:
            optimiser.param_groups[0]["lr"] = 1e-2
            optimiser.step()
    moved, expected = (ours - start).detach(), (theirs - start).detach()
    # bfloat16 has eight bits, and errors of singular values near 0 grow by 3.4 an iteration
    assert float((moved - expected).norm() / expected.norm()) < 0.1
    values = torch.linalg.svdvals(imitation.orthogonal_factor(ours.grad))
    assert 0.6 < float(values.median()) and float(values.max()) < 1.3
