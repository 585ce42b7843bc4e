"""Networks of the policies: one result in the trainer, in the update, alone, and in other files."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import onnx
import pytest
import torch

from pupper_sysid.policies.network.attention import (
    CONTEXT,
    WIDTH,
    CausalAttention,
    empty_context,
    step,
)
from pupper_sysid.policies.network.policy_export import export_policy, write_policy
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.policies.network.policy_network import PolicyNetwork
from pupper_sysid.policies.train.training import action_history
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
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


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_a_policy_alone_acts_as_the_trainers_actor_does_through_resets(kind):
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
            torch.testing.assert_close(action, expected, atol=1e-6, rtol=0)
            ended = torch.tensor([t == 20, t in (7, 8), False])
            actor.reset(ended)
            state = [s.clone() for s in state]
            for part in state:
                part[:, ended] = 0.0


@pytest.mark.parametrize("kind", ALL_KINDS)
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


@pytest.mark.parametrize("kind", WITH_MEMORY)
def test_what_was_before_a_rollout_matters_to_its_first_steps(kind):
    """Or the test above would say nothing about what is carried over."""
    learner = ppo(kind, ROBOTS, STEPS)
    generator = torch.Generator().manual_seed(3)
    for _ in range(2):
        learner.storage.clear()
        roll(learner, episode_ends(), generator)
    batch = next(learner.storage.recurrent_mini_batch_generator(1, 1))
    state = batch.hidden_states[0]
    nothing = tuple(0 * s for s in state) if isinstance(state, tuple) else 0 * state
    now, then = (
        learner.actor(batch.observations, masks=batch.masks, hidden_state=s).detach()
        for s in (state, nothing)
    )
    differ = ((now - then).abs() > 1e-4).any(dim=-1)
    # robot 2's last episode ended with the rollout before
    assert differ[0].tolist() == [True, True, False, True]
    assert not differ[6:, 1].any() and not differ[1:, 3].any()


def attention() -> CausalAttention:
    torch.manual_seed(4)
    made = CausalAttention(5)
    torch.nn.init.normal_(made.age_bias)
    return made


def test_a_changed_observation_changes_the_sixteen_latents_from_it_on_and_no_other():
    made, changed, steps = attention(), 9, 40
    tokens = torch.randn(1, steps, 5)
    other = tokens.clone()
    other[0, changed] += 1.0
    present = torch.ones(1, steps, dtype=torch.bool)
    with torch.inference_mode():
        difference = (made(tokens, present, steps) - made(other, present, steps)).abs().amax(-1)
    moved = (difference[0] > 1e-4).nonzero()[:, 0].tolist()
    assert moved == list(range(changed, changed + 16))
    assert float(difference[0, :changed].max()) < 1e-6
    assert float(difference[0, changed + 16 :].max()) < 1e-6


@pytest.mark.parametrize(("age", "matters"), [(0, True), (15, True), (16, False), (17, False)])
def test_acting_step_by_step_the_window_is_sixteen_observations(age, matters):
    made, steps = attention(), 30
    given = torch.randn(steps, 1, 5)
    other = given.clone()
    other[steps - 1 - age] += 1.0
    latents = []
    for series in (given, other):
        context = empty_context(1, 5, series)
        with torch.inference_mode():
            for row in series:
                latent, context = step(made, torch.nn.Identity(), row, context)
        latents.append(latent)
    assert bool((latents[0] - latents[1]).abs().max() > 1e-4) is matters
    assert context.shape == (CONTEXT - 1, 1, 6) and latents[0].shape == (1, WIDTH)


def test_a_sequence_and_a_walk_step_by_step_give_the_same_latents():
    made, steps = attention(), 40
    given = torch.randn(steps, 2, 5)
    context, walked = empty_context(2, 5, given), []
    with torch.inference_mode():
        for row in given:
            latent, context = step(made, torch.nn.Identity(), row, context)
            walked.append(latent)
        present = torch.ones(2, steps, dtype=torch.bool)
        whole = made(given.transpose(0, 1), present, steps)
    torch.testing.assert_close(torch.stack(walked, dim=1), whole, atol=SINGLE, rtol=0)


def test_a_transformer_remembers_nothing_from_before_its_episode():
    actor, _ = networks("transformer")
    fresh, _ = networks("transformer")
    generator = torch.Generator().manual_seed(5)
    with torch.inference_mode():
        for _ in range(20):
            actor(observations(2, generator))
        actor.reset(torch.tensor([True, False]))
        for _ in range(CONTEXT + 2):
            seen = observations(2, generator)
            new, old = fresh(seen), actor(seen)
            torch.testing.assert_close(old[0], new[0], atol=1e-6, rtol=0)
            fresh_context, old_context = fresh.get_hidden_state(), actor.get_hidden_state()
    torch.testing.assert_close(fresh_context, old_context)  # after sixteen steps robot 1, too


def test_only_the_network_with_past_actions_sees_them():
    for kind in ALL_KINDS:
        actor, critic = networks(kind)
        assert actor.obs_groups == ["policy"] + ["actions"] * (kind == "mlp-actions")
        assert critic.obs_groups == ["policy", "noise", "privileged"]


# ------------------------------------------------------------------------------ other files


@pytest.fixture(scope="module", params=ALL_KINDS)
def folder(request, tmp_path_factory):
    run = tiny_run(request.param)
    run = replace(run, architecture=replace(run.architecture, hidden=(32, 16), memory=24))
    actor, _ = networks(request.param)
    folder = tmp_path_factory.mktemp(request.param) / "policy"
    history = HISTORY if request.param == "mlp-actions" else 0
    write_policy(folder, actor.state_dict(), run, servo_ranges(CALIBRATION), history, {"seed": 0})
    return folder


@pytest.fixture(scope="module")
def policy(folder):
    return load_policy(folder)


INPUTS = {
    "mlp": ["obs"], "mlp-actions": ["obs"], "lstm": ["obs", "h_in", "c_in"],
    "gru": ["obs", "h_in"], "transformer": ["obs", "context_in"],
}  # fmt: skip


def test_a_policy_is_loaded_without_its_trainer(folder):
    code = (
        "import sys; from pathlib import Path\n"
        "from pupper_sysid.policies.network.policy_file import load_policy\n"
        "load_policy(Path(sys.argv[1]))\n"
        "assert 'rsl_rl' not in sys.modules and 'tensordict' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_an_onnx_file_acts_like_the_policy_and_carries_its_contract(policy, tmp_path):
    path = tmp_path / "policy.onnx"
    assert export_policy(policy, "onnx", path) <= 1e-5
    model = onnx.load(path)
    ins = [i.name for i in model.graph.input]
    assert ins == INPUTS[policy.contract.kind]
    assert [o.name for o in model.graph.output] == [
        "actions", *(name.replace("_in", "_out") for name in ins[1:])
    ]  # fmt: skip
    carried = {entry.key: entry.value for entry in model.metadata_props}
    expected = policy.contract.model_dump(mode="json", by_alias=True)
    assert json.loads(carried["contract"]) == expected
    assert acts_alike(policy, _onnx_runner(path, ins))


def test_a_torchscript_file_acts_like_the_policy(policy, tmp_path):
    path = tmp_path / "policy.pt"
    assert export_policy(policy, "torchscript", path) <= 1e-5
    assert acts_alike(policy, torch.jit.load(path))


def _onnx_runner(path, ins):
    from onnx.reference import ReferenceEvaluator

    evaluator = ReferenceEvaluator(str(path))

    def run(*given):
        found = evaluator.run(None, {n: g.numpy() for n, g in zip(ins, given, strict=True)})
        return [torch.as_tensor(f) for f in found]

    return run


def acts_alike(policy, run) -> bool:
    """Over twenty steps: more than a Transformer's context, more than the export checks."""
    generator = torch.Generator().manual_seed(6)
    mine = theirs = policy.network.initial_state(1)
    for _ in range(20):
        seen = torch.randn(1, policy.network.observation_size, generator=generator)
        with torch.inference_mode():
            action, *mine = policy.network(seen, *mine)
            other, *theirs = run(seen, *theirs)
        torch.testing.assert_close(action, other, atol=1e-5, rtol=0)
    return True


def test_a_file_that_acts_otherwise_is_not_written(policy, tmp_path, monkeypatch):
    from pupper_sysid.common.errors import PupperError
    from pupper_sysid.sysid.export import network

    real = network._torchscript

    def off_by_a_little(*given):
        data, run = real(*given)
        return data, lambda *inputs: [run(*inputs)[0] + 2e-5, *run(*inputs)[1:]]

    monkeypatch.setattr(network, "_torchscript", off_by_a_little)
    with pytest.raises(PupperError, match="differs from the model"):
        export_policy(policy, "torchscript", tmp_path / "policy.pt")
    assert not (tmp_path / "policy.pt").exists()


@pytest.mark.parametrize(
    ("dead_time_s", "steps"), [(0.0, 1), (0.001, 2), (0.020, 2), (0.076, 5), (0.100, 6)]
)
def test_past_actions_cover_the_longest_delay_and_one_step_more(dead_time_s, steps):
    """k = ceil(delay / 20 ms) + 1."""
    servos = servo_ranges(CALIBRATION)
    servos = servos.later(dead_time_s - servos.longest_dead_time_s)
    assert action_history(tiny_run("mlp-actions"), servos) == steps
    assert action_history(tiny_run("lstm"), servos) == 0
