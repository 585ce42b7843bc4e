"""The robot's mirror image: every sample also teaches what its image, left for right, would.

The robot, its task and its ground look the same in a mirror. So an observation and an action whose
left and right are exchanged are as true as those that were collected, with the same reward. With
both in every minibatch the policy cannot limp, and sees twice the data for no physics (Mittal et
al., Symmetry Considerations for Learning Task Symmetric Robot Policies, ICRA 2024).
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.extensions import Symmetry
from tensordict import TensorDict

from pupper_sysid.common.joints import JOINT_NAMES, LEGS
from pupper_sysid.sim.walking.observation import OBSERVATION, PRIVILEGED

_OTHER = {"L": "R", "R": "L"}
_LEGS = [LEGS.index(_OTHER[leg[0]] + leg[1:]) for leg in LEGS]
_JOINTS = [JOINT_NAMES.index(_OTHER[name[0]] + name[1:]) for name in JOINT_NAMES]
# hips turn about the forward axis, thighs and calves about the axis from side to side
_TURNS = [-1.0 if name.endswith("hip") else 1.0 for name in JOINT_NAMES]

_PLAIN, _JOINT_SIZES = [1.0], (_JOINTS, [1.0] * 12)
_POLAR, _AXIAL = ([0, 1, 2], [1.0, -1.0, 1.0]), ([0, 1, 2], [-1.0, 1.0, -1.0])
_COMMAND, _ANGLES, _FEET = ([0, 1, 2], [1.0, -1.0, -1.0]), (_JOINTS, _TURNS), (_LEGS, [1.0] * 4)
_IMAGES: dict[str, tuple[list[int], list[float]]] = {
    "base_linear_velocity": _POLAR, "base_angular_velocity": _AXIAL, "projected_gravity": _POLAR,
    "command": _COMMAND, "joint_position_relative": _ANGLES, "joint_velocity": _ANGLES,
    "joint_effort": _ANGLES, "last_action": _ANGLES, "air_s": _FEET, "contact_s": _FEET,
    "dead_time_s": _JOINT_SIZES, "centre_of_mass": _POLAR, "leg_strength": _FEET,
    "joint_zero": _ANGLES, "imu_mounting": _AXIAL, "gyro_bias": _AXIAL,
    "true_angular_velocity": _AXIAL, "true_gravity": _POLAR, "stride_velocity": _COMMAND,
    "earlier_action": _ANGLES, "clock": ([0, 1, 2], [-1.0, -1.0, 1.0]),
}  # fmt: skip
"""Image of a quantity: whose value each element has, and its sign; others stay as they are."""


def _image(parts: list[tuple[str, int]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Order and signs of a row of named parts in the mirror."""
    order: list[int] = []
    signs: list[float] = []
    for name, size in parts:
        first = len(order)
        own, sign = _IMAGES.get(name, (list(range(size)), _PLAIN * size))
        order += [first + i for i in own]
        signs += sign
    return torch.tensor(order), torch.tensor(signs)


_OF_ACTION = _image([("last_action", len(JOINT_NAMES))])
_OF_GROUP = {
    "policy": _image([(name, size) for name, size, _ in OBSERVATION]),
    "privileged": _image(list(PRIVILEGED)),
    "noise": _OF_ACTION,
}


def mirrored(values: torch.Tensor, group: str = "noise") -> torch.Tensor:
    """Mirror image of a group of observations, or of actions.

    Parameters
    ----------
    values : Tensor, shape (…, size of the group)
    group : str
        `policy`, `privileged`, `noise` (as actions), or `actions`, of which there are several.
    """
    if group == "actions":
        several = values.unflatten(-1, (-1, len(JOINT_NAMES)))
        return mirrored(several).flatten(-2)
    order, signs = _OF_GROUP[group]
    return values[..., order] * signs.to(values.device)


class MirrorImages(Symmetry):
    """Appends the mirror image of every sample to a minibatch."""

    def __init__(self):
        super().__init__(None, self._both, use_data_augmentation=True)  # pyright: ignore

    @staticmethod
    def _both(env: Any, obs: TensorDict, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor]:
        names = [str(name) for name in obs.keys()]
        image = TensorDict({n: mirrored(obs[n], n) for n in names}, obs.batch_size)
        return torch.cat([obs, image]), torch.cat([actions, mirrored(actions)])  # pyright: ignore

    def compute_loss(self, actor, batch, original_batch_size: int) -> torch.Tensor:
        """No loss besides; the samples suffice."""
        return torch.zeros((), device=next(actor.parameters()).device)
