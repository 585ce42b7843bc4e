"""Deployment stacks: what stands between a policy and the servos.

A stack says what the policy is told about its joints (`observer`), how its actions are smoothed
before they are sent, and how fast the loop runs. `closed-loop` shows it the servos' own readings,
held as they are, as in this project's simulator. The two others are the published ones, which show
it a prediction instead: `lstm-servo` of learned servo models, `mlp-observer` of a simulated PD.
"""

from __future__ import annotations

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
    """What the policy is told about its joints: the servos' readings, a learned servo model's
    prediction, that of a PD with the calibration's numbers, that of the paper's PD, or that they
    rest at the default pose."""
    lowpass_hz: float | None = None
    """Cut-off of the Butterworth filter on what is sent; none by default: its lag (19 to 27 ms at
    8 Hz) is not in the training."""
    fade_in_s: float = 1.0
    """Over which what is sent grows from the standing pose to the policy's."""
    scale_rad: float | None = None
    """Radians per unit of action of what is sent; by default as trained. It replaces the trained
    scale, it does not multiply it."""
    rate_hz: float | None = None
    """Of the loop; by default the policy's own. At another rate its time runs faster or slower."""

    def __post_init__(self):
        for name in ("lowpass_hz", "scale_rad", "rate_hz"):
            value = getattr(self, name)
            if value is not None and not 0 < value < 1e4:
                raise InputError(f"{name} is {value}; it must be a positive number.")
        if not 0 <= self.fade_in_s < 1e3:
            raise InputError(f"fade_in_s is {self.fade_in_s}; it must be 0 or more.")


STACKS: dict[StackName, Stack] = {
    "closed-loop": Stack(),
    "lstm-servo": Stack("servo-model", lowpass_hz=8.0, fade_in_s=4.0),
    "mlp-observer": Stack("synthetic-pd", lowpass_hz=10.0, fade_in_s=4.0),
}


def suited(contract: Contract) -> StackName:
    """The stack whose joint observations are of the kind that a policy was trained with."""
    if contract.feedback != "ideal":
        return "closed-loop"
    return "mlp-observer" if contract.kind in ("mlp", "mlp-actions") else "lstm-servo"
