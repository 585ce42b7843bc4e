"""Deployment stacks: the settings between a policy and the servos.

A stack defines the source of the joint observation (`observer`), the smoothing of actions, and the
rate of the loop. `closed-loop` uses the servos' own held readings, as in this project's simulator.
The two others are the published ones, which use a prediction: `lstm-servo` of learned servo models,
`mlp-observer` of a simulated PD.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from pupper_sysid.common.errors import InputError

if TYPE_CHECKING:
    from pupper_sysid.policies.network.policy_file import Contract

ObserverKind = Literal["readings", "servo-model", "synthetic-pd", "published-pd", "rest"]
StackName = Literal["closed-loop", "lstm-servo", "mlp-observer"]


@dataclass(frozen=True)
class Stack:
    """Settings of a deployment."""

    observer: ObserverKind = "readings"
    """Source of the joint observation: the servos' readings, a learned servo model's prediction,
    that of a PD with the calibration's parameters, that of the paper's PD, or rest at the default
    pose."""
    lowpass_hz: float | None = None
    """Cut-off of the Butterworth filter on the targets; none by default: its lag (19 to 27 ms at
    8 Hz) is not in the training."""
    fade_in_s: float = 1.0
    """Time over which targets grow from the standing pose to the policy's."""
    scale_rad: float | None = None
    """Radians per unit of action, instead of the trained scale (it does not multiply it)."""
    rate_hz: float | None = None
    """Rate of the loop; by default the policy's own. Another rate scales the policy's time."""

    def __post_init__(self):
        for name in ("lowpass_hz", "scale_rad", "rate_hz"):
            value = getattr(self, name)
            if value is not None and not 0 < value < 1e4:
                raise InputError(f"`{name}` is {value:g}; it must be a positive number.")
        if self.scale_rad is not None and self.scale_rad > math.pi:
            raise InputError(
                f"`scale_rad` is {self.scale_rad:g} rad per unit of action, and no joint turns by "
                f"more than half a turn. Write radians: {self.scale_rad:g} degrees are "
                f"{math.radians(self.scale_rad):.2g}."
            )
        if not 0 <= self.fade_in_s < 1e3:
            raise InputError(f"`fade_in_s` is {self.fade_in_s:g}; it must be 0 or more.")

    def period_s(self, contract: Contract) -> float:
        """Time between two actions [s]."""
        return contract.control_step_s if self.rate_hz is None else 1 / self.rate_hz


STACKS: dict[StackName, Stack] = {
    "closed-loop": Stack(),
    "lstm-servo": Stack("servo-model", lowpass_hz=8.0, fade_in_s=4.0),
    "mlp-observer": Stack("synthetic-pd", lowpass_hz=10.0, fade_in_s=4.0),
}


def suited(contract: Contract) -> StackName:
    """The stack with the kind of joint observation that a policy was trained with."""
    if contract.feedback != "ideal":
        return "closed-loop"
    return "mlp-observer" if contract.kind in ("mlp", "mlp-actions") else "lstm-servo"
