"""Training runs that are over in a second: few robots, small networks, short episodes."""

from dataclasses import replace

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from pupper_sysid.data import SAMPLES
from pupper_sysid.policies.network.actor_critic import build
from pupper_sysid.policies.train.learner import TerminalPPO
from pupper_sysid.policies.train.run_file import Architecture, Hyperparameters, Imitation, Run
from pupper_sysid.sim.walking.config import Walking

CALIBRATION = str(SAMPLES / "calibrated.yaml")
ALL_KINDS = ("mlp", "mlp-actions", "lstm", "gru", "transformer")
WITH_MEMORY = ("lstm", "gru", "transformer")
PRIVILEGED, HISTORY = 7, 3


def tiny_run(kind: str = "mlp", **changes) -> Run:
    """Four robots, episodes of ten steps, rollouts of six: episodes end inside rollouts."""
    run = Run(
        actuator=CALIBRATION,
        architecture=Architecture(kind, (16,), 8, (16,)),
        task=Walking(episode_s=0.2),
        learner=Hyperparameters(steps_per_environment=6, epochs=2, minibatches=2),
        imitation=Imitation(iterations=2, rollouts=1, epochs=1, minibatches=2),
        environments=4, iterations=3, threads=1,
    )  # fmt: skip
    return replace(run, **changes)


def observations(count: int, generator: torch.Generator) -> TensorDict:
    """Made-up observations of `count` robots, in the groups of `WalkingVecEnv`."""
    sizes = {"policy": 60, "privileged": PRIVILEGED, "actions": 12 * HISTORY, "noise": 12}
    return TensorDict(
        {k: torch.randn(count, size, generator=generator) for k, size in sizes.items()},
        batch_size=[count],
    )


def networks(kind: str, seed: int = 0):
    """Actor and critic whose weights and normalisers are all away from where they start."""
    torch.manual_seed(seed)
    hyper = Hyperparameters()
    actor, critic = build(
        Architecture(kind, (32, 16), 24, (16,)), observations(2, torch.Generator()), hyper
    )
    with torch.no_grad():
        for parameter in (*actor.parameters(), *critic.parameters()):
            parameter += 0.1 * torch.randn_like(parameter)
        for network in (actor, critic):
            normaliser = network.obs_normalizer
            normaliser._mean.normal_()
            normaliser._var.uniform_(0.3, 3.0)
            normaliser._std.copy_(normaliser._var.sqrt())
            normaliser.count.fill_(1000)
    return actor, critic


def ppo(kind: str, robots: int, steps: int) -> TerminalPPO:
    """PPO of such networks."""
    actor, critic = networks(kind)
    example = observations(robots, torch.Generator())
    storage = RolloutStorage("rl", robots, steps, example, [12])
    return TerminalPPO(actor, critic, storage, num_learning_epochs=1, num_mini_batches=2)


def roll(learner: TerminalPPO, dones: torch.Tensor, generator: torch.Generator) -> None:
    """One rollout of made-up observations with these `dones`, shape (steps, robots)."""
    none = torch.zeros(0, dtype=torch.long)
    nothing = {"terminal_ids": none, "unforeseen_ids": none}
    robots = dones.shape[1]
    seen = observations(robots, generator)
    with torch.inference_mode():
        for row in dones:
            learner.act(seen)
            seen = observations(robots, generator)
            learner.process_env_step(seen, torch.randn(robots, generator=generator), row, nothing)
        learner.compute_returns(seen)
