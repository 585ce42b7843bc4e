"""Networks of the policies: one result in the trainer, in the update, alone, and in other files."""

import json

import numpy as np
import onnx
import pytest
import torch
from tensordict import TensorDict

from pupper_sysid.common.errors import PupperError
from pupper_sysid.policies.network.actor_critic import build, inputs
from pupper_sysid.policies.network.policy_file import Contract, export_policy, load_policy
from pupper_sysid.policies.network.policy_network import (
    CONTEXT,
    WIDTH,
    CausalAttention,
    PolicyNetwork,
    step,
)
from pupper_sysid.policies.train.run_file import Architecture, Hyperparameters
from pupper_sysid.policies.train.training import action_history
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from pupper_sysid.sim.walking.step import (
    OBSERVATION_PARTS,
    PRIVILEGED_PARTS,
)
from pupper_sysid.sysid import export as network_export
from support.command_line import fresh_python
from support.tiny_training import (
    ALL_KINDS,
    CALIBRATION,
    HISTORY,
    WITH_MEMORY,
    networks,
    observations,
    ppo,
    roll,
    tiny_run,
)

# what torch says while it exports: it will do so otherwise one day, and that it only traces
pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::UserWarning", "ignore::torch.jit.TracerWarning"
)
ROBOTS, STEPS = 4, 24
SINGLE = 1e-5  # some tens of roundings of numbers near 1 in single precision
RATIO = 12 * 1e-6 / 0.015  # twelve means, each off by some roundings, over their deviation


def episode_ends() -> torch.Tensor:
    """Robot 0 never falls; 1 falls early; 2 twice in a row and at the very end; 3 at once."""
    dones = torch.zeros(STEPS, ROBOTS, dtype=torch.bool)
    dones[5, 1] = dones[5, 2] = dones[6, 2] = dones[STEPS - 1, 2] = dones[0, 3] = True
    return dones


def alone(kind: str, actor) -> PolicyNetwork:
    size = 60 + 12 * HISTORY * (kind == "mlp-actions")
    network = PolicyNetwork(kind, size, (32, 16), 24, True)
    network.take(actor.state_dict())
    return network


def test_a_policy_alone_acts_as_the_trainers_actor_does_through_resets():
    for kind in ALL_KINDS:
        actor, _ = networks(kind)
        network = alone(kind, actor)
        generator = torch.Generator().manual_seed(1)
        state = network.initial_state(3)
        with torch.inference_mode():
            for t in range(30):
                seen = observations(3, generator)
                flat = torch.cat([seen[g] for g in actor.obs_groups], dim=-1)
                expected = actor(seen)
                action, *state = network(flat, *state)
                torch.testing.assert_close(action, expected, atol=1e-6, rtol=0, msg=kind)
                ended = torch.tensor([t == 20, t in (7, 8), False])
                actor.reset(ended)
                state = [s.clone() for s in state]
                for part in state:
                    part[:, ended] = 0.0


@pytest.mark.parametrize("kind", ["mlp-actions", *WITH_MEMORY])
def test_the_update_sees_the_very_policy_that_acted(kind):
    """The probability ratio is 1 before anything is learned: fresh, carried over, and relearned."""
    learner = ppo(kind, ROBOTS, STEPS)
    generator = torch.Generator().manual_seed(2)
    for again in ("fresh", "context carried over", "after an update"):
        roll(learner, episode_ends(), generator)
        storage = learner.storage
        batches = (
            storage.recurrent_mini_batch_generator(2, 1)
            if kind in WITH_MEMORY
            else storage.mini_batch_generator(2, 1)
        )
        for batch in batches:
            learner.actor(
                batch.observations, masks=batch.masks, hidden_state=batch.hidden_states[0],
                stochastic_output=True,
            )  # fmt: skip
            (mean, _), (then, _) = (
                learner.actor.output_distribution_params,
                (batch.old_distribution_params),
            )
            torch.testing.assert_close(mean, then, atol=SINGLE, rtol=0, msg=again)
            now = learner.actor.get_output_log_prob(batch.actions)
            ratio = (now - batch.old_actions_log_prob.squeeze(-1)).exp()
            torch.testing.assert_close(ratio, torch.ones_like(ratio), atol=RATIO, rtol=0)
        if again == "context carried over":
            before = learner.actor.mlp[0].weight.clone()
            learner.update()
            assert not torch.equal(before, learner.actor.mlp[0].weight)
        storage.clear()


def attention() -> CausalAttention:
    torch.manual_seed(4)
    made = CausalAttention(5)
    torch.nn.init.normal_(made.age_bias)
    return made


def test_acting_step_by_step_a_transformer_sees_sixteen_observations_as_in_a_sequence():
    made, steps = attention(), 40
    series = torch.randn(steps, 2, 5)

    def walk(series: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        context, latents = torch.zeros(CONTEXT - 1, 2, 6), []
        with torch.inference_mode():
            for row in series:
                latent, context = step(made, torch.nn.Identity(), row, context)
                latents.append(latent)
        return torch.stack(latents, dim=1), context

    walked, context = walk(series)
    assert context.shape == (CONTEXT - 1, 2, 6) and walked.shape == (2, steps, WIDTH)
    with torch.inference_mode():
        whole = made(series.transpose(0, 1), torch.ones(2, steps, dtype=torch.bool), steps)
    torch.testing.assert_close(walked, whole, atol=SINGLE, rtol=0)
    for age, matters in ((0, True), (15, True), (16, False)):
        other = series.clone()
        other[steps - 1 - age] += 1.0
        moved = (walk(other)[0] - walked)[:, -1].abs().max()
        assert bool(moved > 1e-4) is matters, age


# ------------------------------------------------------------------------------ other files


@pytest.mark.slow
def test_a_policy_is_loaded_without_its_trainer(saved_policies):
    code = (
        "import sys; from pathlib import Path\n"
        "from pupper_sysid.policies.network.policy_file import load_policy\n"
        "[load_policy(Path(folder)) for folder in sys.argv[1:]]\n"
        "assert 'rsl_rl' not in sys.modules and 'tensordict' not in sys.modules"
    )
    fresh_python(code, *saved_policies.values())


@pytest.fixture(params=ALL_KINDS)
def policy(request, saved_policies):
    return load_policy(saved_policies[request.param])


INPUTS = {
    "mlp": ["obs"], "mlp-actions": ["obs"], "lstm": ["obs", "h_in", "c_in"],
    "gru": ["obs", "h_in"], "transformer": ["obs", "context_in"],
}  # fmt: skip


def test_an_exported_file_acts_like_the_policy_and_onnx_carries_its_contract(policy, tmp_path):
    scripted, path = tmp_path / "policy.pt", tmp_path / "policy.onnx"
    assert export_policy(policy, "torchscript", scripted) <= 1e-5
    acts_alike(policy, torch.jit.load(scripted))
    assert export_policy(policy, "onnx", path) <= 1e-5
    model = onnx.load(path)
    ins = [i.name for i in model.graph.input]
    assert ins == INPUTS[policy.contract.kind]
    assert [o.name for o in model.graph.output] == [
        "actions", *(name.replace("_in", "_out") for name in ins[1:])
    ]  # fmt: skip
    carried = {entry.key: entry.value for entry in model.metadata_props}
    contract = Contract.model_validate(json.loads(carried["contract"]))
    assert contract == policy.contract and contract.servo is not None
    acts_alike(policy, _onnx_runner(path, ins))


def _onnx_runner(path, ins):
    from onnx.reference import ReferenceEvaluator

    evaluator = ReferenceEvaluator(str(path))

    def run(*given):
        found = evaluator.run(None, {n: g.numpy() for n, g in zip(ins, given, strict=True)})
        return [torch.as_tensor(f) for f in found]

    return run


def acts_alike(policy, run) -> None:
    """Over twenty steps: more than a Transformer's context, more than the export checks."""
    generator = torch.Generator().manual_seed(6)
    mine = theirs = policy.network.initial_state(1)
    for _ in range(20):
        seen = torch.randn(1, policy.network.observation_size, generator=generator)
        with torch.inference_mode():
            action, *mine = policy.network(seen, *mine)
            other, *theirs = run(seen, *theirs)
        torch.testing.assert_close(action, other, atol=1e-5, rtol=0)


def test_a_file_that_acts_otherwise_is_not_written(saved_policies, tmp_path, monkeypatch):
    real = network_export._torchscript

    def off_by_a_little(*given):
        data, run = real(*given)
        return data, lambda *inputs: [run(*inputs)[0] + 2e-5, *run(*inputs)[1:]]

    monkeypatch.setattr(network_export, "_torchscript", off_by_a_little)
    with pytest.raises(PupperError, match="differs from the model"):
        export_policy(load_policy(saved_policies["lstm"]), "torchscript", tmp_path / "policy.pt")
    assert not (tmp_path / "policy.pt").exists()


def test_past_actions_cover_the_longest_delay_and_one_step_more():
    """k = ceil(delay / 20 ms) + 1."""
    servos = servo_ranges(CALIBRATION)
    for dead_time_s, steps in ((0.0, 1), (0.001, 2), (0.020, 2), (0.076, 5), (0.100, 6)):
        late = servos.later(dead_time_s - servos.longest_dead_time_s)
        assert action_history(tiny_run("mlp-actions"), late) == steps
        assert action_history(tiny_run("lstm"), late) == 0


# ------------------------------------------------------------------------------ a teacher


def test_a_teacher_sees_command_imu_and_the_clock_with_its_harmonics_and_nothing_else():
    turns = 0.1
    generator = torch.Generator().manual_seed(0)
    sizes = {"policy": 60, "privileged": 106, "noise": 12}
    seen = TensorDict(
        {k: torch.randn(5, n, generator=generator) for k, n in sizes.items()}, batch_size=[5]
    )
    clock, angles = PRIVILEGED_PARTS["clock"], 2 * np.pi * turns * np.array([1, 2, 3])
    cos, sin = np.cos(angles), np.sin(angles)
    seen["privileged"][:, clock] = torch.tensor([cos[0], sin[0], 0.3]).float()

    shown = inputs(seen)
    assert shown.shape == (5, 34)
    torch.testing.assert_close(shown[:, :9], seen["policy"][:, 3:12])
    np.testing.assert_allclose(shown[0, 9:16], [0.3, *cos, *sin], atol=1e-6)
    strokes = np.multiply.outer(seen["policy"][0, 9:12], [*cos, *sin])
    np.testing.assert_allclose(shown[0, 16:], strokes.flatten(), atol=1e-6)

    architecture = Architecture("mlp", (16,), 8, (16,), privileged_actor=True)
    actor, critic = build(architecture, seen, Hyperparameters())
    actor.update_normalization(seen)
    before, valued = actor(seen), critic(seen)
    other = seen.clone()
    other["policy"][:, OBSERVATION_PARTS["joint_velocity"]] += 1.0
    for name in ("friction", "base_linear_velocity"):
        other["privileged"][:, PRIVILEGED_PARTS[name]] += 1.0
    torch.testing.assert_close(actor(other), before)
    assert not torch.allclose(critic(other), valued)
    other["privileged"][:, clock] *= -1.0
    assert not torch.allclose(actor(other), before)
