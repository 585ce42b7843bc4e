"""What a calibration reports of one joint: candidate models with intervals, and the choice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result, flat, internal
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice
from pupper_sysid.sysid.fit.goodness import overall
from pupper_sysid.sysid.fit.run import Run
from pupper_sysid.sysid.fit.scores import Scores
from pupper_sysid.sysid.lag.lag_budget import LagBudget

UNTOLD = "the data do not separate a set-point of limited rate from back-EMF"
TELLING_NATS = 5.0
"""Difference of the log-likelihoods of two structures that tells them apart."""


RATIO_SOURCES = {
    "stiffness_per_s2": ("stiffness_nm_per_rad", "stiffness"),
    "damping_per_s": ("duty_s_per_rad", "damping"),
    "friction_rad_s2": ("friction_loss", "friction_loss"),
    "effort_rad_s2": ("effort_limit", "effort_limit"),
    "back_emf_per_s": ("back_emf", "back_emf"),
}
"""Numbers per inertia of DelayedPD: where `LoadedFit.numbers` has their interval, and the field."""


@dataclass(frozen=True, kw_only=True)
class CandidateFit(Result):
    """One candidate model, fitted to one joint.

    Attributes
    ----------
    model : str
        Its name in `sysid.fit.structure`.
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
class StructureFit(Result):
    """One structure, fitted to one joint.

    Attributes
    ----------
    name : str
    parameters : dict of str to float
        Fitted numbers by name.
    mae_rad, rmse_rad : float
        Free run against the readings that count, of all runs.
    mae_unseen_rad : float
        The same on runs that were left out of the fit; NaN where it was not compared.
    nats : float
        By how much its log-likelihood is below that of the best; NaN where it was not compared.
    """

    name: str
    parameters: dict[str, float]
    mae_rad: float
    rmse_rad: float
    mae_unseen_rad: float
    nats: float


@dataclass(frozen=True, kw_only=True)
class LoadedFit(Result):
    """A servo under load.

    Attributes
    ----------
    joint : str
    structure : str
        The chosen one.
    known_load : bool
        Whether torques are in N·m; otherwise they are per inertia, and the armature is 1.
    p_gain : float
        Reference P gain; 1 where the recordings do not say it.
    p_gains : tuple of float
        Those of the runs, in order.
    loads : tuple of tuple
        Inertia [kg·m²] and gravity [N·m] of the loads, without repetitions.
    reference_voltage_v : float
        Supply voltage that the stall torque is for; NaN where torques do not depend on it.
    numbers : dict of str to Interval
        Fields of `LoadedServoParameters` that the structure has, and `gravity_nm`, `hanging_rad`,
        `offset_rad`, `stiffness_nm_per_rad` and `damping_nm_s_per_rad` at the reference gain.
    undecided : dict of str to str
        Numbers that the data do not identify, each with the reason.
    structures : tuple of StructureFit
    folds : tuple of str
        What was left out, in words.
    mae_by_run_rad : dict of str to float
    motor_torque_nm : float
        Typical torque of the motor in these runs.
    temperature : float
        How many readings count as one.
    """

    joint: str
    structure: str
    known_load: bool
    p_gain: float
    p_gains: tuple[float, ...]
    loads: tuple[tuple[float, float], ...]
    reference_voltage_v: float
    numbers: dict[str, Interval]
    undecided: dict[str, str]
    structures: tuple[StructureFit, ...]
    folds: tuple[str, ...]
    mae_by_run_rad: dict[str, float]
    motor_torque_nm: float
    temperature: float
    lattice: PollLattice = internal()
    servo: LoadedServoParameters = internal()
    runs: tuple[Run, ...] = internal()

    def relative(self, source: str, value: float) -> Interval:
        """`value` with the relative interval of the number `source` that it follows from."""
        reference = self.numbers.get(source)
        if reference is None or reference.value <= 0:
            return Interval(value, value, value)
        return Interval(
            value, value * reference.low / reference.value, value * reference.high / reference.value
        )


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
    goodness : dict of str to float
        Residual of the model over the noise of readings, by motion: 1 where it explains the servo.
        Of several recordings, that of the one which is described least.
    r_hat, effective_draws : float
        R̂ of the draws behind the intervals, and how many independent ones they are worth.
    between_recordings : dict of str to float
        Standard deviation between several recordings of the logarithm of a fitted number.
    differences : tuple of str
        Recordings that differ from the others, and in which number, in sentences.
    loaded : LoadedFit or None
        The servo at any gain and load, where the recordings tell of a load or several gains.
    runs : tuple of Run
        What was fitted to.
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
    goodness: dict[str, float] = field(default_factory=dict)
    r_hat: float = float("nan")
    effective_draws: float = float("nan")
    between_recordings: dict[str, float] = field(default_factory=dict)
    differences: tuple[str, ...] = ()
    loaded: LoadedFit | None = None
    runs: tuple[Run, ...] = internal(default=())

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

    def __str__(self) -> str:
        scores, model, unseen = self.delayed_pd.scores, "DelayedPD", "unseen frequencies"
        if np.isfinite(scores.rmse_unseen_runs_rad):
            unseen = "runs left out of the fit"
        ratio = overall(self.goodness)
        noise = f" ({ratio:.1f} times their noise)" if np.isfinite(ratio) else ""
        if self.loaded is not None:
            model = f"servo under load ({self.loaded.structure})"
        return (
            f"{model} with {1e3 * self.dead_time_s.value:.1f} ms dead time, free-run error "
            f"{1e3 * scores.rmse_fresh_rad:.1f} mrad on fresh readings{noise}, "
            f"{1e3 * scores.rmse_unseen_rad:.1f} mrad on {unseen}"
        )

    def rows(self) -> list[dict[str, Any]]:
        """One row per candidate model."""
        return [
            {"chosen": name == self.model} | flat(fit.to_dict())
            for name, fit in self.candidate_models.items()
        ]


def plausible(structure_nats: Mapping[str, float]) -> list[str]:
    """Structures that the data do not tell from the best."""
    return [name for name, nats in structure_nats.items() if nats <= TELLING_NATS]
