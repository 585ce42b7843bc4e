"""What a calibration reports of one joint: candidate models with intervals, and the choice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result, derived, flat, internal
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, whole_steps
from pupper_sysid.sysid.identify.candidates.simulation import TrialData
from pupper_sysid.sysid.identify.scores import Scores
from pupper_sysid.sysid.lag.lag_budget import LagBudget

UNTOLD = "the data do not tell a set-point of limited rate from back-EMF"
_TELLING_NATS = 5.0
"""Difference of the log-likelihoods of two structures that tells them apart."""


@dataclass(frozen=True, kw_only=True)
class CandidateFit(Result):
    """One candidate model, fitted to one joint.

    Attributes
    ----------
    model : str
        Its name in `sysid.identify.candidates.models`.
    parameters : dict of str to Interval
        By name, which ends in the unit.
    undecided : dict of str to str
        Parameters that the data do not identify, each with the reason.
    scores : Scores
    """

    model: str
    parameters: dict[str, Interval]
    undecided: dict[str, str]
    scores: Scores

    @property
    def values(self) -> dict[str, float]:
        """The parameters without their intervals."""
        return {name: p.value for name, p in self.parameters.items()}


@dataclass(frozen=True, kw_only=True)
class JointCalibrationResult(Result):
    """Calibration of one joint.

    Attributes
    ----------
    model : str
        The candidate with the smallest error on unseen frequencies.
    simulated_model : str
        Of `SIMULATED`, the one that calibrations carry.
    structure_nats : dict of str to float
        Of those: by how much the log-likelihood of each is below that of the best.
    command_jitter_s : Interval
        Standard deviation of the latency of commands that the noise of fast tones amounts to.
    candidate_models : dict of str to CandidateFit
        Simplest first.
    lag : LagBudget
        With the dead time of DelayedPD.
    presets : dict of str to Scores
        Published settings, scored in the same way.
    warnings : tuple of str
    trials : tuple of TrialData
        The readings of the fit.
    """

    joint: str
    model: str
    simulated_model: str
    structure_nats: dict[str, float]
    command_jitter_s: Interval
    candidate_models: dict[str, CandidateFit]
    lag: LagBudget
    presets: dict[str, Scores]
    warnings: tuple[str, ...]
    trials: tuple[TrialData, ...] = internal()

    @property
    def delayed_pd(self) -> CandidateFit:
        """The fit that simulators run: DelayedPD with the speed limit of `simulated_model`."""
        return self.candidate_models[self.simulated_model]

    @property
    def rival(self) -> CandidateFit | None:
        """The other fit that simulators could run, if the data do not tell the two apart."""
        others = [n for n in plausible(self.structure_nats) if n != self.simulated_model]
        return self.candidate_models[others[0]] if others else None

    @property
    def dead_time_s(self) -> Interval:
        """Dead time [s]; the interval covers every structure that the data allow."""
        assert self.lag.dead_time_s is not None
        return self.lag.dead_time_s

    @derived
    def delay_steps(self) -> tuple[int, int]:
        """Dead-time interval in whole physics steps, rounded outward."""
        return whole_steps(self.dead_time_s.low, self.dead_time_s.high, TIME_STEP_S)

    def __str__(self) -> str:
        scores = self.delayed_pd.scores
        return (
            f"DelayedPD with {1e3 * self.dead_time_s.value:.1f} ms dead time, free-run error "
            f"{1e3 * scores.rmse_fresh_rad:.1f} mrad on fresh readings, "
            f"{1e3 * scores.rmse_leave_one_frequency_out_rad:.1f} mrad on unseen frequencies"
        )

    def rows(self) -> list[dict[str, Any]]:
        """One row per candidate model."""
        return [
            {"chosen": name == self.model} | flat(fit.to_dict())
            for name, fit in self.candidate_models.items()
        ]


def plausible(structure_nats: Mapping[str, float]) -> list[str]:
    """Structures that the data do not tell from the best."""
    return [name for name, nats in structure_nats.items() if nats <= _TELLING_NATS]
