"""WalkingVecEnv: `sim.walking.env.PupperEnv` with the contract that rsl_rl's learner expects.

Observation groups: `policy` is the observation of 60 numbers, `privileged` the true state for the
critic, `noise` the noise of the last action (`policies.network.actor_critic`), and `actions` the
last `action_history` actions, newest first: with them the delayed system is Markov again (the
paper's augmented state). Tensors are copies, since the learner keeps them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from pupper_sysid.sim.walking.env import PupperEnv


class WalkingVecEnv:
    """Adapter; `env` is the environment itself.

    `action_history` is how many past actions the group `actions` holds, 0 leaves the group out;
    `device` is the torch device of the learner's tensors. `noise`, shape (n, 12), is that
    of the last action, to be set before `step`; an episode begins with none.
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
