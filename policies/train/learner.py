"""PPO of rsl_rl, with additions in thin subclasses, and the environment as it expects one.

- Noise of the actions persists (`policies.network.actor_critic`); its size is scheduled.
- After each update the KL divergence and the share of clipped ratios are measured at the first step
  of its data; the policy's learning rate follows the former, and a policy that went much too far is
  taken back. The critic has another rate.
- The policy that is judged and saved has the mean of the last updates' weights.
- At a time-out the value of the state reached is added, not that of the state before it; where a
  new command or a push follows a step, the value of the state without them counts.
- A checkpoint holds everything that an exact continuation needs: networks, optimiser, learning
  rate, random numbers, recurrent state, environments with their delay lines, the last observation
  and the counters. It is written atomically and read with `weights_only`; a teacher's is also read
  by the runs that learn from it.
- Several processes, which `torchrun` starts, each with other environments, exchange gradients
  through gloo, on processors, as the physics.
- Every sample can be learned from as its mirror image, left for right, too. The robot, its task and
  its ground look the same in a mirror: an observation and an action whose left and right are
  exchanged are as true as those that were collected, with the same reward. With both in every
  minibatch the policy cannot limp, and sees twice the data for no physics (Mittal et al., Symmetry
  Considerations for Learning Task Symmetric Robot Policies, ICRA 2024).
"""

from __future__ import annotations

import copy
import io
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rsl_rl.algorithms import PPO
from rsl_rl.extensions import Symmetry
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from pupper_sysid.common.border import read_bytes, refuse_other_version
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import write_bytes
from pupper_sysid.common.reading.content import LARGEST_CHECKPOINT, refuse_bomb
from pupper_sysid.policies.network.actor_critic import ActionNoise, build
from pupper_sysid.policies.train.run_file import Architecture, Hyperparameters
from pupper_sysid.sim.robot.body import Body, mini_pupper
from pupper_sysid.sim.robot.trot import stance
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.step import observation_of, privileged_parts


class WalkingVecEnv:
    """`env`, a `PupperEnv`, with the contract that rsl_rl's learner expects.

    Observation groups: `policy` is the observation of 60 numbers, `privileged` the true state for
    the critic, `noise` that of the last action, and `actions` the last `action_history` actions,
    newest first: with them the delayed system is Markov again (the paper's augmented state); 0
    leaves the group out. Tensors, on the learner's `device`, are copies, since the learner keeps
    them. `noise`, shape (n, 12), is to be set before `step`; an episode begins with none.
    """

    def __init__(self, env: PupperEnv, action_history: int = 0, device: str = "cpu"):
        self.env, self.device = env, device
        self.num_envs, self.num_actions = env.environments, len(env.default)
        self.max_episode_length = env.config.episode_steps
        self.cfg: dict[str, Any] = {}
        self._past = np.zeros((env.environments, action_history, self.num_actions))
        self._past[:] = env.action[:, None]
        self.noise = torch.zeros(env.environments, self.num_actions, device=device)

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps of each episode so far."""
        return torch.from_numpy(self.env.episode_step.copy())

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self.env.episode_step[:] = steps.cpu().numpy()

    def get_observations(self) -> TensorDict:
        """Observations of the present state, without a step."""
        return self._groups(*self.env.observe(), self._past, self.noise)

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """One control step: observations, rewards, dones and extras; see `PupperEnv.step`.

        `extras` has `terminal_ids` and `terminal_observations` of the environments whose time was
        up, `unforeseen_ids` and `unforeseen_observations` (see `StepResult.unforeseen`), `terms`,
        the reward terms, and `facts`, what happened.
        """
        result = self.env.step(actions.detach().cpu().numpy())
        ended = self._past
        if self._past.shape[1]:
            # after a missed tick the last action stays
            ended = np.concatenate([result.facts.action[:, None], self._past[:, :-1]], axis=1)
            self._past = ended.copy()
            self._past[result.done] = self.env.action[result.done][:, None]
        late, noise = result.terminal["ids"], self.noise
        self.noise = noise * self.tensor(~result.done)[:, None]
        ids, surprised = self.tensor(late), result.unforeseen["ids"]
        extras: dict[str, Any] = {
            "terms": result.terms, "facts": result.facts, "terminal_ids": ids,
            "unforeseen_ids": self.tensor(surprised),
        }  # fmt: skip
        if len(late):
            extras["terminal_observations"] = self._groups(
                result.terminal["observation"], result.terminal["privileged"], ended[late],
                noise[ids],
            )  # fmt: skip
        if len(surprised):
            extras["unforeseen_observations"] = self._groups(
                result.unforeseen["observation"], result.unforeseen["privileged"],
                self._past[surprised], self.noise[extras["unforeseen_ids"]],
            )  # fmt: skip
        return (
            self._groups(result.observation, result.privileged, self._past, self.noise),
            self.tensor(result.reward.astype(np.float32)),
            self.tensor(result.done),
            extras,
        )

    @property
    def state(self) -> dict[str, Any]:
        """The whole state, for `restore`."""
        return self.env.state | {
            "past_actions": self._past.copy(), "noise": self.noise.cpu().numpy().copy(),
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> bool:
        """Go back to a `state`; whether exactly, see `PupperEnv.restore`."""
        env_state = dict(state)
        past = env_state.pop("past_actions", self._past)
        noise = env_state.pop("noise", self.noise.cpu().numpy())
        exact = self.env.restore(env_state)
        self._past[:], self.noise = past, self.tensor(np.array(noise, np.float32))
        return exact

    def tensor(self, values: NDArray) -> torch.Tensor:
        """An array as a tensor on the learner's device."""
        return torch.from_numpy(values).to(self.device)

    def _groups(self, observation, privileged, past, noise: torch.Tensor) -> TensorDict:
        groups = {"policy": observation, "privileged": privileged}
        if past.shape[1]:
            groups["actions"] = past.reshape(len(past), -1).astype(np.float32)
        tensors = {k: self.tensor(v) for k, v in groups.items()}
        return TensorDict(tensors | {"noise": noise}, batch_size=[len(observation)])


_POLAR, _AXIAL = ([0, 1, 2], [1.0, -1.0, 1.0]), ([0, 1, 2], [-1.0, 1.0, -1.0])
_COMMAND = [0, 1, 2], [1.0, -1.0, -1.0]


@cache
def _images(body: Body) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Order and signs of each group of observations, and of actions (`noise`), in the mirror."""
    if body.mirror_joints is None or body.mirror_signs is None or body.mirror_feet is None:
        raise InputError(
            f"{body.name} is not the same in a mirror, so it cannot learn from mirror images. Give "
            "`learner.mirror` as False."
        )
    joints, legs = body.mirror_joints.tolist(), body.mirror_feet.tolist()
    angles, sizes = (joints, body.mirror_signs.tolist()), (joints, [1.0] * len(joints))
    feet = legs, [1.0] * len(legs)
    # whose value each element has, and its sign; other quantities stay as they are
    known: dict[str, tuple[list[int], list[float]]] = {
        "base_linear_velocity": _POLAR, "base_angular_velocity": _AXIAL,
        "projected_gravity": _POLAR, "command": _COMMAND, "joint_position_relative": angles,
        "joint_velocity": angles, "joint_effort": angles, "last_action": angles, "air_s": feet,
        "contact_s": feet, "dead_time_s": sizes, "centre_of_mass": _POLAR, "leg_strength": feet,
        "joint_zero": angles, "imu_mounting": _AXIAL, "gyro_bias": _AXIAL,
        "true_angular_velocity": _AXIAL, "true_gravity": _POLAR, "stride_velocity": _COMMAND,
        "earlier_action": angles, "clock": ([0, 1, 2], [-1.0, -1.0, 1.0]),
    }  # fmt: skip

    def image(parts: list[tuple[str, int]]) -> tuple[torch.Tensor, torch.Tensor]:
        order: list[int] = []
        signs: list[float] = []
        for name, size in parts:
            first = len(order)
            places, sign = known.get(name, (list(range(size)), [1.0] * size))
            order += [first + i for i in places]
            signs += sign
        return torch.tensor(order), torch.tensor(signs)

    return {
        "policy": image([(name, size) for name, size, _ in observation_of(len(joints))]),
        "privileged": image(list(privileged_parts(len(joints), len(legs)))),
        "noise": image([("last_action", len(joints))]),
    }


def mirrored(values: torch.Tensor, group: str = "noise", body: Body | None = None) -> torch.Tensor:
    """Mirror image of a group of observations, or of actions.

    The group is `policy`, `privileged`, `noise` (as actions), or `actions`, of which there are
    several; it is the last axis of `values`. The Mini Pupper is the body by default.
    """
    body = body or mini_pupper()
    if group == "actions":
        several = values.unflatten(-1, (-1, len(body.joints)))
        return mirrored(several, "noise", body).flatten(-2)
    order, signs = _images(body)[group]
    return values[..., order] * signs.to(values.device)


class MirrorImages(Symmetry):
    """Appends the mirror image of every sample to a minibatch."""

    def __init__(self, body: Body):
        super().__init__(None, self._both, use_data_augmentation=True)  # pyright: ignore
        self._body = body
        _images(body)  # refuses one without an image

    def _both(
        self, env: Any, obs: TensorDict, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor]:
        names = [str(name) for name in obs.keys()]
        image = TensorDict({n: mirrored(obs[n], n, self._body) for n in names}, obs.batch_size)
        return torch.cat([obs, image]), torch.cat([actions, mirrored(actions, "noise", self._body)])  # pyright: ignore

    def compute_loss(self, actor, batch, original_batch_size: int) -> torch.Tensor:
        """No loss besides; the samples suffice."""
        return torch.zeros((), device=next(actor.parameters()).device)


CHECKPOINT_SCHEMA = "pupper-checkpoint"
CHECKPOINT_VERSION = 4
_ANOTHER = "Resume from another checkpoint of the run."
_PARTS = (
    "architecture", "actor_state_dict", "critic_state_dict", "optimizer_state_dict",
    "learning_rate", "iteration", "torch_rng", "hidden", "observations", "environment", "more",
)  # fmt: skip
_AVERAGED = "module."  # before the names of weights in `AveragedModel`


def judged_weights(content: dict[str, Any]) -> dict[str, torch.Tensor]:
    """Of the policy that was judged when a checkpoint was written: `Learner.averaged`."""
    average = content.get("average")
    if average is None or not average["n_averaged"]:
        return content["actor_state_dict"]
    averages = {name: value for name, value in average.items() if name.startswith(_AVERAGED)}
    return {name.removeprefix(_AVERAGED): value for name, value in averages.items()}


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Content of a checkpoint, without executing anything in it."""
    if not path.exists():
        raise InputError(f"{path} does not exist. Give the folder of a run that has a checkpoint.")
    data = read_bytes(path, LARGEST_CHECKPOINT, _ANOTHER)
    refuse_bomb(path, data, _ANOTHER)
    try:
        content = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for damaged files
        raise InputError(f"{path} is damaged and cannot be read. {_ANOTHER}") from error
    if not isinstance(content, dict) or content.get("schema") != CHECKPOINT_SCHEMA:
        raise InputError(f"{path} is not a checkpoint of pupper-train.")
    if content.get("schema_version") in (1, 2, 3):
        raise InputError(
            f"{path} is of an older version of pupper-train, whose critic has other inputs, and "
            "cannot be resumed or imitated. Its policies can be played and evaluated; start a new "
            "run."
        )
    refuse_other_version(path, content.get("schema_version"), CHECKPOINT_VERSION)
    missing = [part for part in _PARTS if part not in content]
    if missing:
        raise InputError(f"{path} has no {missing[0]}. {_ANOTHER}")
    average = content.get("average", {"n_averaged": 0})  # older files have none
    if not isinstance(average, dict) or "n_averaged" not in average:
        raise InputError(f"The average in {path} is no set of weights. {_ANOTHER}")
    return content


@dataclass(frozen=True)
class Ranks:
    """This process among those that train together."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0

    @classmethod
    def join(cls) -> Ranks:
        """Join the processes that `torchrun` started; alone if it did not."""
        size = int(os.environ.get("WORLD_SIZE", "1"))
        if size == 1:
            return cls()
        ranks = cls(int(os.environ["RANK"]), size, int(os.environ.get("LOCAL_RANK", "0")))
        if not torch.distributed.is_initialized():
            torch.distributed.init_process_group("gloo", rank=ranks.rank, world_size=size)
        return ranks

    def same(self, text: str) -> str:
        """The first process's `text`, in all."""
        texts = [text]
        if self.size > 1:
            torch.distributed.broadcast_object_list(texts, src=0)
        return texts[0]

    def any(self, value: bool) -> bool:
        """Whether it is so in any process; all must decide alike, or they would deadlock."""
        return bool(self._reduced(float(value), "MAX"))

    def mean(self, value: float) -> float:
        """Mean over the processes, the same in all."""
        return self._reduced(value, "SUM") / self.size

    def _reduced(self, value: float, operation: str) -> float:
        if self.size == 1:
            return value
        reduced = torch.tensor(value, dtype=torch.float64)
        torch.distributed.all_reduce(reduced, getattr(torch.distributed.ReduceOp, operation))
        return float(reduced)


_TOO_FAR, _TOO_NEAR, _FACTOR = 2.0, 0.5, 1.3
_LOST, _MUCH = 10.0, 3.0  # beyond so many times the desired KL a policy is taken back


class TerminalPPO(PPO):
    """PPO that takes the values of the states that were reached, whatever chance did then.

    At a time-out it adds the value of the state that was reached. Where a robot is then given a new
    command or a push, the step before is credited with the value of the state without them: no
    action can bring them about, and what they cost was nine tenths of the variance of the
    advantages (measured by repeating steps from the same states with other noise of the actions).
    So a policy learns to recover from a push, but is not paid for standing in a way that makes
    pushes matter less.
    """

    def process_env_step(
        self, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor, extras: dict[str, Any]
    ) -> None:
        """Record one step; `extras` as `WalkingVecEnv.step` gives them."""
        late = extras["terminal_ids"]
        if len(late):
            reached = self.critic(extras["terminal_observations"]).detach()
            rewards = rewards.clone()
            rewards[late] += self.gamma * reached[:, 0]
        ids = extras["unforeseen_ids"]
        if len(ids):
            pairs = extras["unforeseen_observations"], obs[ids]
            values = [self.critic(o).detach() for o in pairs]
            rewards = rewards.clone()
            rewards[ids] += self.gamma * (values[0] - values[1])[:, 0]
        super().process_env_step(obs, rewards, dones, {})


@dataclass(frozen=True)
class _Probe:
    """The first step of an update's data, to compare the policy before and after."""

    observations: TensorDict
    hidden: Any
    actions: torch.Tensor
    log_prob: torch.Tensor
    parameters: tuple[torch.Tensor, ...]

    @classmethod
    def of(cls, ppo: PPO) -> _Probe:
        stored = ppo.storage
        saved = stored.saved_hidden_state_a
        assert stored.distribution_params is not None
        hidden = None if saved is None else tuple(h[0].clone() for h in saved)
        if hidden is not None and len(hidden) == 1:
            hidden = hidden[0]
        return cls(
            stored.observations[0].clone(), hidden, stored.actions[0].clone(),
            stored.actions_log_prob[0, :, 0].clone(),
            tuple(p[0].clone() for p in stored.distribution_params),
        )  # fmt: skip

    @torch.no_grad()
    def compare(self, ppo: PPO) -> dict[str, float]:
        """KL divergence of the policy now from that of the data, and share of clipped ratios."""
        actor = ppo.actor
        hidden = actor.get_hidden_state()
        actor.reset(hidden_state=self.hidden)
        actor(self.observations, stochastic_output=True)
        actor.reset(hidden_state=hidden)
        kl = actor.get_kl_divergence(self.parameters, actor.output_distribution_params)
        ratio = torch.exp(actor.get_output_log_prob(self.actions) - self.log_prob)
        clipped = (ratio - 1.0).abs() > ppo.clip_param
        return {"kl": float(kl.mean()), "clip_fraction": float(clipped.float().mean())}


class Learner:
    """An environment, a policy, a critic and PPO.

    `exact` says whether a loaded checkpoint goes on exactly (`PupperEnv.restore`), `taken_back`
    whether the last update was undone, because it changed the actions too much.
    """

    def __init__(
        self,
        env: WalkingVecEnv,
        architecture: Architecture,
        hyper: Hyperparameters,
        seed: int,
        ranks: Ranks | None = None,
    ):
        self.env, self.architecture, self.hyper = env, architecture, hyper
        self.ranks = ranks or Ranks()
        self.iteration, self.exact, self.taken_back = 0, True, False
        # the networks of all ranks start alike; their samples must differ
        torch.manual_seed(seed)
        # at different steps, so that not all episodes end in the same update
        env.episode_length_buf = torch.randint(0, env.max_episode_length, (env.num_envs,))
        self.observations = env.get_observations()
        task = env.env.config
        first = None
        if task.rewards.stance:
            target = stance(task.body, task.rewards.crouch, task.rewards.spread) - env.env.default
            first = torch.from_numpy(target / task.action_scale)
        actor, critic = build(architecture, self.observations, hyper, first)
        # a recurrent policy's minibatches are whole environments
        if actor.is_recurrent and env.num_envs < hyper.minibatches:
            raise InputError(
                f"{env.num_envs} environments cannot be split into {hyper.minibatches} "
                "minibatches. Give more `environments` or fewer `minibatches`."
            )
        storage = RolloutStorage(
            "rl", env.num_envs, hyper.steps_per_environment, self.observations,
            [env.num_actions], env.device,
        )  # fmt: skip
        group = None
        if self.ranks.size > 1:
            group = {
                "global_rank": self.ranks.rank, "local_rank": self.ranks.local_rank,
                "world_size": self.ranks.size,
            }  # fmt: skip
        self.ppo = TerminalPPO(
            actor, critic, storage, num_learning_epochs=hyper.epochs,
            num_mini_batches=hyper.minibatches, clip_param=hyper.clip, gamma=hyper.discount,
            lam=hyper.gae_lambda, value_loss_coef=hyper.value_weight, entropy_coef=hyper.entropy,
            learning_rate=hyper.learning_rate, max_grad_norm=hyper.gradient_norm,
            schedule="fixed", use_mixed_precision=hyper.mixed_precision, multi_gpu_cfg=group,
            device=env.device,
        )  # fmt: skip
        if hyper.mirror:
            if actor.is_recurrent:
                raise InputError(
                    f"A policy of kind {architecture.kind} cannot learn from mirror images. Give "
                    "`learner.mirror` as False."
                )
            self.ppo.symmetry = MirrorImages(env.env.body)
        self.fresh_optimiser()
        env.env.processes = self.ranks.size
        share = torch.ones(env.num_actions)
        if hyper.exploration.by_dead_band:
            share = torch.from_numpy(env.env.servos.dead_band_share).float()
        if hyper.mirror:  # or an image would have another likelihood than its original
            share = 0.5 * (share + mirrored(share, "noise", env.env.body).abs())
        self._joint_share = share.to(env.device)
        self._explore()
        if group:
            self.ppo.broadcast_parameters()
            torch.manual_seed(seed + 1000 * self.ranks.rank)
        keep = get_ema_multi_avg_fn(1.0 - 1.0 / hyper.averaging)
        self._average = AveragedModel(actor, multi_avg_fn=keep)

    @property
    def actor(self) -> MLPModel:
        """The policy's network."""
        return self.ppo.actor

    @property
    def averaged(self) -> MLPModel:
        """The policy to judge and to save: its weights are means over the last updates."""
        # until PPO has changed the policy there is nothing to average
        average = self._average.module if self._average.n_averaged else self.actor
        assert isinstance(average, MLPModel)
        return average

    @property
    def samples(self) -> int:
        """Control steps of all robots of all processes in PPO so far."""
        return self.iteration * self.hyper.steps_per_environment * self._robots

    @property
    def _robots(self) -> int:
        return self.env.num_envs * self.ranks.size

    @property
    def std(self) -> float:
        """Mean standard deviation of the actions' noise."""
        return float(self._noise.whole_std.detach().mean())

    @property
    def _noise(self) -> ActionNoise:
        noise = self.actor.distribution
        assert isinstance(noise, ActionNoise)
        return noise

    def fresh_optimiser(self) -> None:
        """Begin with PPO's learning rates, without memory of earlier gradients."""
        hyper, ppo = self.hyper, self.ppo
        ppo.optimizer = torch.optim.Adam(
            [
                {"params": list(ppo.actor.parameters()), "lr": hyper.learning_rate},
                {"params": list(ppo.critic.parameters()), "lr": hyper.critic_learning_rate},
            ]
        )
        ppo.learning_rate = hyper.learning_rate

    def _explore(self) -> None:
        """Set the noise's size where it is scheduled."""
        explore = self.hyper.exploration
        if not explore.learned:
            self._noise.set_std(explore.std_at(self.samples) * self._joint_share)

    def act(self) -> torch.Tensor:
        """Actions with noise on the last observation, for one step of the environment."""
        actions = self.ppo.act(self.observations)
        self.env.noise = actions - self._noise.centre
        return actions

    def rollout(self, watch=None) -> None:
        """Act for the steps of one update; `watch(rewards, dones, extras)` is called for each."""
        self._explore()
        with torch.inference_mode():
            for _ in range(self.hyper.steps_per_environment):
                self.observations, rewards, dones, extras = self.env.step(self.act())
                self.ppo.process_env_step(self.observations, rewards, dones, extras)
                if watch:
                    watch(rewards, dones, extras)
            self.ppo.compute_returns(self.observations)

    def update(self) -> dict[str, float]:
        """Update policy and critic on the data of `rollout`.

        Gives mean losses, `kl` and `clip_fraction`.
        """
        ppo, hyper = self.ppo, self.hyper
        actor_learns = self.iteration >= hyper.critic_warmup
        fixed = None if hyper.exploration.learned else self._noise.log_std_param
        for parameter in ppo.actor.parameters():
            parameter.requires_grad_(actor_learns and parameter is not fixed)
        if hyper.freeze_normaliser:
            for network in (ppo.actor, ppo.critic):
                network.obs_normalizer.until = 0  # pyright: ignore[reportArgumentType]
        probe = _Probe.of(ppo)
        before = [parameter.detach().clone() for parameter in ppo.actor.parameters()]
        moments = [copy.deepcopy(ppo.optimizer.state.get(p, {})) for p in ppo.actor.parameters()]
        losses = ppo.update()
        self.iteration += 1
        measures = {name: self.ranks.mean(value) for name, value in probe.compare(ppo).items()}
        self.taken_back = actor_learns and measures["kl"] > _LOST * self.hyper.desired_kl
        if actor_learns:
            self._adapt(measures["kl"])
            # Adam's first steps are as long as its rate, whatever the gradient
            if self.taken_back:
                with torch.no_grad():
                    for parameter, value in zip(ppo.actor.parameters(), before, strict=True):
                        parameter.copy_(value)
                # keep the moments of Adam's first update: without them the next would be as long
                for parameter, state in zip(ppo.actor.parameters(), moments, strict=True):
                    if state:
                        ppo.optimizer.state[parameter] = state
            self._average.update_parameters(ppo.actor)
        return losses | measures

    def _adapt(self, kl: float) -> None:
        """Let the policy's learning rate follow the divergence of an update."""
        ppo, (least, most) = self.ppo, self.hyper.learning_rates
        if kl > _TOO_FAR * self.hyper.desired_kl:
            factor = _MUCH if kl > _LOST * self.hyper.desired_kl else _FACTOR
            ppo.learning_rate = max(ppo.learning_rate / factor, least)
        elif kl < _TOO_NEAR * self.hyper.desired_kl:
            ppo.learning_rate = min(ppo.learning_rate * _FACTOR, most)
        ppo.optimizer.param_groups[0]["lr"] = ppo.learning_rate

    # ------------------------------------------------------------------------- checkpoints

    def networks(self) -> dict[str, Any]:
        """A copy of networks, optimiser and learning rate, for `take_back`."""
        return copy.deepcopy(self.ppo.save() | {"average": self._average.state_dict()}) | {
            "learning_rate": self.ppo.learning_rate, "iteration": self.iteration,
        }  # fmt: skip

    def take_back(self, networks: dict[str, Any]) -> None:
        """Return to `networks`; the environments stay as they are."""
        self.ppo.load(networks, None, True)
        if "average" in networks:  # a checkpoint of an older version has none
            self._average.load_state_dict(networks["average"])
        self.ppo.learning_rate = networks["learning_rate"]
        self.iteration = networks["iteration"]

    @property
    def finite(self) -> bool:
        """Whether networks, observations and recurrent state are all numbers."""
        hidden = self.actor.get_hidden_state()
        states = hidden if isinstance(hidden, tuple) else (hidden,)
        tensors: list[Any] = [
            *self.ppo.actor.state_dict().values(), *self.ppo.critic.state_dict().values(),
            *self.observations.values(), *(s for s in states if s is not None),
        ]  # fmt: skip
        return all(bool(torch.isfinite(t).all()) for t in tensors)

    def save(self, path: Path, more: dict[str, Any]) -> None:
        """Write a checkpoint in one atomic step; the one before survives if that fails."""
        hidden = self.actor.get_hidden_state()
        content = {
            "schema": CHECKPOINT_SCHEMA,
            "schema_version": CHECKPOINT_VERSION,
            "architecture": self.architecture.kind,
            **self.ppo.save(),
            "average": self._average.state_dict(),
            "learning_rate": self.ppo.learning_rate,
            "iteration": self.iteration,
            "torch_rng": torch.get_rng_state(),
            "hidden": list(hidden) if isinstance(hidden, tuple) else hidden,
            "observations": dict(self.observations.items()),
            "environment": {
                k: torch.from_numpy(v) if isinstance(v, np.ndarray) else v
                for k, v in self.env.state.items()
            },
            "more": more,
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        write_bytes(path, buffer.getvalue(), force=True)

    def load(self, path: Path) -> dict[str, Any]:
        """Return to a checkpoint exactly; returns the `more` of `save`."""
        content = read_checkpoint(path)
        if content["architecture"] != self.architecture.kind:
            raise InputError(
                f"{path} holds a policy of kind {content['architecture']}, but the run says "
                f"{self.architecture.kind}. Resume without `policy`, or start a new run."
            )
        try:
            self.take_back(content)
        except (RuntimeError, KeyError, ValueError) as error:
            raise InputError(
                f"{path} does not fit this run's networks: it was trained with other settings, or "
                "by a version of pupper-train whose networks differ. Resume with the settings of "
                "the run, or start a new one."
            ) from error
        state = {
            k: v.numpy() if isinstance(v, torch.Tensor) else v
            for k, v in content["environment"].items()
        }
        try:
            self.exact = self.env.restore(state)
        except InputError as error:
            raise InputError(f"{path} does not fit this run's environments: {error}") from error
        hidden, device = content["hidden"], self.env.device
        if isinstance(hidden, list):
            hidden = tuple(state.to(device) for state in hidden)
        elif hidden is not None:
            hidden = hidden.to(device)
        self.actor.reset(hidden_state=hidden)
        observations = TensorDict(content["observations"], batch_size=[self.env.num_envs])
        self.observations = observations.to(device)
        torch.set_rng_state(content["torch_rng"])
        return content["more"]
