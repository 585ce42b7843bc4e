"""The twelve joints of the robot, in the one order that every array of this project has."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from common.errors import InputError

LEGS = ("LF", "RF", "LB", "RB")
KINDS = ("hip", "thigh", "calf")
JOINT_NAMES: tuple[str, ...] = tuple(f"{leg}_{kind}" for leg in LEGS for kind in KINDS)

# Standing pose of the policy and of servo count 512 [rad], facts/hardware.md C5.
DEFAULT_POSE: dict[str, float] = {
    name: {"hip": 0.0, "thigh": 0.785, "calf": -1.57}[name.split("_")[1]] for name in JOINT_NAMES
}


def select_joints(text: str, available: Sequence[str] = JOINT_NAMES) -> list[str]:
    """Joints named by `text`: names, legs (`LF`), kinds (`hip`), mixed with commas, or `all`.

    Parameters
    ----------
    text : str
        For example `"LF_hip"`, `"LF,RB_calf"`, `"hip"`, `"all"`. Case does not matter.
    available : sequence of str
        The joints to choose from; the answer keeps their order.

    Raises
    ------
    InputError
        If a word names no joint; the message proposes the nearest name.

    Examples
    --------
    >>> select_joints("LF")
    ['LF_hip', 'LF_thigh', 'LF_calf']
    """
    chosen: set[str] = set()
    for word in (part.strip() for part in text.split(",")):
        if word.lower() == "all":
            chosen.update(available)
            continue
        found = [n for n in available if word.lower() in (n.lower(), *n.lower().split("_"))]
        if not found:
            known = [*available, *LEGS, *KINDS, "all"]
            near = difflib.get_close_matches(word, known, n=1, cutoff=0.4)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise InputError(
                f"--joints: '{word}' is no joint, leg or kind.{hint} "
                f"Use names ({', '.join(available[:3])}, …), legs (LF, …), kinds (hip, …) or all."
            )
        chosen.update(found)
    return [n for n in available if n in chosen]
