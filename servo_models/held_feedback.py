"""HeldFeedback: readings of a polled servo bus are stale, quantised and biased.

The bus polls each servo once per `poll_period_s`. A poll fails with probability `loss` and then
leaves the previous value in place, which the host reads. So a reading is the position at the last
successful poll, plus `offset_rad`, rounded to `quantum_rad`; its age is between zero and many
periods, on average `mean_age_s = poll_period_s * (1/2 + loss / (1 - loss))`.

This is the definition; three modules simulate it. They stay apart because each has a random stream
of its own, which recordings, checkpoints and exports repeat bit for bit, and needs other parts:
`sim.emulator.poll_schedule` gives the poll instants of one robot at any time, with jitter and drift
(the emulated buses measure there); `sim.walking.held_readings` gives readings of many robots, a
control step at a time; `sim.export.held_feedback_torch` is copied into exports and needs only torch
(`tests/sim` holds each to the mean age above).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pupper_sysid.common.errors import InputError


@dataclass(frozen=True)
class HeldFeedback:
    """Feedback of one joint.

    Parameters
    ----------
    poll_period_s : float
        Time between polls [s]; 0 if every reading is fresh.
    loss : float
        Probability that a poll fails silently, 0 <= loss < 1.
    quantum_rad : float
        Quantisation step [rad]; 0 if readings are continuous.
    offset_rad : float
        Reading minus position, constant [rad].
    """

    poll_period_s: float = 0.0
    loss: float = 0.0
    quantum_rad: float = 0.0
    offset_rad: float = 0.0

    def __post_init__(self):
        if not self.poll_period_s >= 0 or not np.isfinite(self.poll_period_s):
            raise InputError(
                f"HeldFeedback: poll_period_s is {self.poll_period_s}; it must be ≥ 0."
            )
        if not 0 <= self.loss < 1:
            raise InputError(f"HeldFeedback: loss is {self.loss}; it must be in [0, 1).")
        if not self.quantum_rad >= 0:
            raise InputError(f"HeldFeedback: quantum_rad is {self.quantum_rad}; it must be ≥ 0.")

    @property
    def mean_age_s(self) -> float:
        """Mean age of a reading at a random instant [s]."""
        return self.poll_period_s * (0.5 + self.loss / (1.0 - self.loss))
