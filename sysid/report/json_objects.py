"""The JSON objects that other programs read: keys are a contract, see the README."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from pupper_sysid.common.interval import Interval
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice
from pupper_sysid.sysid.identify.calibrate import DeadTime, JointCalibrationResult, RungResult
from pupper_sysid.sysid.identify.search import PREFERRED


def delay_json(found: dict[str, DeadTime]) -> dict[str, Any]:
    """Object of `delay --json`; times end in their unit.

    Parameters
    ----------
    found : dict of joint to DeadTime
        From `sysid.identify.calibrate.dead_times`.
    """
    return {"joints": {name: _delay(d) for name, d in found.items()}}


def _delay(found: DeadTime) -> dict[str, Any]:
    budget, dead_time = found.budget, found.dead_time
    return {
        "naive_lag_ms": 1e3 * budget.naive.value,
        "naive_lag_ci_ms": _ci_ms(budget.naive),
        "fresh_lag_ms": 1e3 * budget.fresh.value,
        "fresh_lag_ci_ms": _ci_ms(budget.fresh),
        "lag_ms": 1e3 * budget.lag.value,
        "lag_ci_ms": _ci_ms(budget.lag),
        "dead_time_ms": 1e3 * dead_time.value,
        "dead_time_ci_ms": _ci_ms(dead_time),
        "dynamics_ms": 1e3 * (budget.lag.value - dead_time.value),
        "feedback_age_ms": 1e3 * budget.feedback_age_s,
        "command_hold_ms": 1e3 * budget.command_hold_s,
        "feedback": feedback_json(budget.lattice, found.offset_rad, found.quantum_rad),
        "by_frequency": [
            {
                "frequency_hz": f.frequency_hz,
                "gain": f.gain,
                "phase_deg": f.phase_deg,
                "lag_ms": 1e3 * f.lag.value,
                "lag_ci_ms": _ci_ms(f.lag),
                "naive_lag_ms": 1e3 * f.naive_lag_s,
                "naive_gain": f.naive_gain,
            }
            for f in budget.by_frequency
        ],
        "estimators_ms": {name: 1e3 * value for name, value in budget.estimators.items()},
        "warnings": list(budget.warnings),
    }


def feedback_json(lattice: PollLattice, offset_rad: float, quantum_rad: float) -> dict[str, Any]:
    """What is known of one joint's feedback."""
    return {
        "kind": lattice.kind,
        "poll_period_ms": 1e3 * lattice.period_s,
        "poll_period_sd_ms": 1e3 * lattice.period_sd_s,
        "loss": lattice.loss,
        "loss_sd": lattice.loss_sd,
        "mean_age_ms": 1e3 * lattice.mean_age_s,
        "quantum_rad": quantum_rad,
        "offset_rad": offset_rad,
    }


def calibrate_json(
    results: dict[str, JointCalibrationResult], calibration: Calibration, elapsed_s: float
) -> dict[str, Any]:
    """Object of `calibrate --json`.

    Scores and parameters are those of the chosen `model`; `delay_*` and `actuator` are those of
    DelayedPD, which simulators run; `ladder` has all models.
    """
    joints = {name: _calibrated(r) for name, r in results.items()}
    for name, entry in joints.items():
        actuator = calibration.joint(name).actuator
        entry["actuator"] = actuator.model_dump()
    return {"joints": joints, "elapsed_s": elapsed_s}


def _calibrated(result: JointCalibrationResult) -> dict[str, Any]:
    chosen = result.rungs[result.chosen]
    return {
        "model": result.chosen,
        "parameters": chosen.values,
        **_scores(chosen),
        "dead_time_s": result.dead_time.value,
        "delay_ci_s": [result.dead_time.low, result.dead_time.high],
        "delay_steps": list(result.delay_steps),
        PREFERRED: {
            "parameters": result.rungs[PREFERRED].values,
            "undecided": result.rungs[PREFERRED].undecided,
            **_scores(result.rungs[PREFERRED]),
        },
        "ladder": {name: _scores(r) for name, r in result.rungs.items()},
        "presets": {
            name: {"rmse_fresh_rad": s.fresh, "rmse_held_rad": s.held, "rmse_naive_rad": s.naive}
            for name, s in result.presets.items()
        },
        "lag_s": asdict(result.budget.lag),
        "warnings": list(result.warnings),
    }


def _scores(rung: RungResult) -> dict[str, Any]:
    s = rung.scores
    return {
        "rmse_fresh_rad": s.fresh,
        "rmse_held_rad": s.held,
        "rmse_naive_rad": s.naive,
        "rmse_one_step_rad": s.one_step,
        "rmse_leave_one_frequency_out_rad": s.leave_one_out,
        "rmse_by_left_out_frequency_rad": {
            f"{f:g}": e for f, e in s.leave_one_out_by_frequency.items()
        },
        "fit_percent": s.fit_percent,
    }


def _ci_ms(interval: Interval) -> list[float]:
    return [1e3 * interval.low, 1e3 * interval.high]
