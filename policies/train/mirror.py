"""The robot's mirror image: every sample also teaches what its image, left for right, would.

The robot, its task and its ground look the same in a mirror. So an observation and an action whose
left and right are exchanged are as true as those that were collected, with the same reward. With
both in every minibatch the policy cannot limp, and sees twice the data for no physics (Mittal et
al., Symmetry Considerations for Learning Task Symmetric Robot Policies, ICRA 2024).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from rsl_rl.extensions import Symmetry
from tensordict import TensorDict

from pupper_sysid.common.errors import InputError
from pupper_sysid.sim.robot.body import Body, mini_pupper
from pupper_sysid.sim.walking.observation import observation_of, privileged_parts

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
            own, sign = known.get(name, (list(range(size)), [1.0] * size))
            order += [first + i for i in own]
            signs += sign
        return torch.tensor(order), torch.tensor(signs)

    return {
        "policy": image([(name, size) for name, size, _ in observation_of(len(joints))]),
        "privileged": image(list(privileged_parts(len(joints), len(legs)))),
        "noise": image([("last_action", len(joints))]),
    }


def mirrored(values: torch.Tensor, group: str = "noise", body: Body | None = None) -> torch.Tensor:
    """Mirror image of a group of observations, or of actions.

    Parameters
    ----------
    values : Tensor, shape (…, size of the group)
    group : str
        `policy`, `privileged`, `noise` (as actions), or `actions`, of which there are several.
    body : Body, optional
        The Mini Pupper by default.
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
