"""Results of a joint, made from numbers: nothing is fitted."""

from dataclasses import replace

import numpy as np

from pupper_sysid.common.interval import Interval
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice
from pupper_sysid.sysid.fit.results import CandidateFit, JointCalibrationResult
from pupper_sysid.sysid.fit.run import Run, at_steps, free_run
from pupper_sysid.sysid.fit.scores import Scores
from pupper_sysid.sysid.fit.structure import CANDIDATES, candidate
from pupper_sysid.sysid.lag.lag_budget import FrequencyLag, LagBudget
from support.runs import run_of

POLL_S, LOOP_S, AGE_S = 0.030, 0.020, 0.025
LATTICE = PollLattice(
    kind="lattice", poll_period_s=POLL_S, poll_period_sd_s=1e-5, loss=0.0, loss_sd=0.01,
    z_score=20.0, hit_rate=1.0, fresh_fraction=2 / 3,
)  # fmt: skip


def interval(value: float) -> Interval:
    return Interval(value, 0.9 * value, 1.1 * value)


def fitted(name: str, scores: Scores, undecided: dict[str, str] | None = None) -> CandidateFit:
    return CandidateFit(
        model=name,
        parameters={p.name: interval(p.nominal) for p in candidate(name).parameters},
        undecided=undecided or {},
        scores=scores,
    )


def run_like(model: CandidateFit, frequency_hz: float) -> Run:
    """A run whose fresh readings are exactly what `model` does; rows show them `AGE_S` late."""
    steps, rest = 1000, 0.5
    command = rest + 0.2 * np.sin(2 * np.pi * frequency_hz * TIME_STEP_S * np.arange(steps))
    row = np.arange(20.0, 980.0, LOOP_S / TIME_STEP_S)
    bare = run_of(command, frequency_hz, rest)
    values = np.array(list(model.values.values()))
    (track,) = free_run(candidate(model.model), values, [bare])
    measured = row - AGE_S / TIME_STEP_S
    reading = at_steps(track, measured)
    return replace(
        bare, sample_step=measured, sample_rad=reading, held_step=measured, row_step=row,
        row_rad=reading,
    )  # fmt: skip


def result_of(joint: str = "LF_thigh", **changes) -> JointCalibrationResult:
    """Two tones that are described by DelayedPD of nominal numbers."""
    scores = Scores(
        rmse_fresh_rad=0.010, rmse_held_rad=0.011, rmse_raw_rad=0.120, rmse_one_step_rad=0.020,
        rmse_leave_one_frequency_out_rad=0.015,
        rmse_by_left_out_frequency_rad={"1": 0.015, "2": 0.015}, fit_percent=95.0,
    )  # fmt: skip
    raw_best = replace(scores, rmse_fresh_rad=0.150, rmse_raw_rad=0.100)
    candidates = {name: fitted(name, scores) for name in CANDIDATES}
    tones = tuple(
        FrequencyLag(
            frequency_hz=f, gain=1.02, phase_deg=-15.0 * f, lag_s=interval(0.042),
            raw_lag_s=0.080, raw_gain=0.88, trial=n,
        )
        for n, f in enumerate((1.0, 2.0))
    )  # fmt: skip
    lag = LagBudget(
        joint=joint, raw_lag_s=interval(0.081), fresh_lag_s=interval(0.0535),
        lag_s=interval(0.044), stale_lag_s=0.0275, command_hold_s=0.0095,
        dead_time_s=Interval(0.024, 0.0205, 0.0275), feedback=LATTICE, quantum_rad=np.pi / 550,
        offset_rad=0.01, by_frequency=tones,
        estimators_s={
            "integer cross-correlation, all rows": 0.076, "hold-aware (default)": 0.044
        },
        noise_rad=0.01, warnings=("Only two frequencies.",),
    )  # fmt: skip
    made = JointCalibrationResult(
        joint=joint, model="delayed_pd", simulated_model="delayed_pd",
        structure_nats={"delayed_pd": 0.0, "delayed_pd_back_emf": 20.0},
        command_jitter_s=Interval(0.0, 0.0, 0.001), candidate_models=candidates, lag=lag,
        presets={"paper": raw_best}, warnings=("Only two frequencies.",),
        runs=tuple(run_like(candidates["delayed_pd"], f) for f in (1.0, 2.0)),
    )  # fmt: skip
    return replace(made, **changes)
