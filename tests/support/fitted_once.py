"""One fit of a recording for all that is said of it, where the fit itself is not the matter.

`delay` and `calibrate` fit alike, and tests of one process fit the same recordings. That a fit
repeats is held where nothing is kept: by the frozen figures, and by a fleet beside a single robot.
"""

import pickle
from collections.abc import Callable
from typing import Any

import pytest

from pupper_sysid.sysid.fit import calibrate, joint_fit
from pupper_sysid.sysid.fit.joint_fit import fit_structures
from pupper_sysid.sysid.fit.operating_point import loaded_joints
from pupper_sysid.sysid.fit.preparation import PreparedJoint, prepare_joint

_kept: dict[Any, Any] = {}


def _once(key: Any, work: Callable[..., Any], *arguments: Any) -> Any:
    if key not in _kept:
        _kept[key] = work(*arguments)
    return _kept[key]


def _prepared(joint, trials, seed, free_air=None, known=None, prior=None) -> PreparedJoint:
    if free_air is None:
        free_air = not loaded_joints({joint: trials})
    arguments = (joint, tuple(trials), seed, free_air, known, prior)
    return _once(pickle.dumps(arguments), prepare_joint, *arguments)


def _fitted(ready: PreparedJoint, stage: str) -> list[joint_fit.Fitted]:
    return _once((id(ready), stage), fit_structures, ready, stage)


def fit_once(patch: pytest.MonkeyPatch) -> None:
    """Have what was fitted before in this process taken from there."""
    for module in (joint_fit, calibrate):
        patch.setattr(module, "prepare_joint", _prepared)
        patch.setattr(module, "fit_structures", _fitted)
