"""Checkpoints of a training, read without executing anything in them.

`policies.train.learner` writes them; a teacher's is also read by those who learn from it.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch

from pupper_sysid.common.border import read_bytes, refuse_other_version
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import LARGEST_CHECKPOINT, refuse_bomb

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
    whole = {name: value for name, value in average.items() if name.startswith(_AVERAGED)}
    return {name.removeprefix(_AVERAGED): value for name, value in whole.items()}


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
