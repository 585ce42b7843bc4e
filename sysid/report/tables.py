"""The report's tables: every number once, for the page with few digits, for CSV with all of them.

Each function turns results into a `Table`. Its rows hold plain values under names that end in their
unit, which is what goes to CSV; its columns say which of them the page shows, and how.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.page import Column, Row, Table
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import Quantity, unit_of
from pupper_sysid.sysid.identify.calibrate import JointCalibrationResult
from pupper_sysid.sysid.identify.scores import Scores
from pupper_sysid.sysid.report.figure_data import lag_parts

if TYPE_CHECKING:  # it brings python-control, which a table does not need
    from pupper_sysid.sysid.lag.frequency_response import FrequencyResponse

MODEL_NAMES = {
    "pure_delay": "pure delay",
    "fopdt": "first order + delay",
    "sopdt": "second order + delay",
    "dc_servo": "DC servo",
    "delayed_pd": "DelayedPD",
    "delayed_pd_backlash": "DelayedPD + backlash",
}

_LEVEL = "(90\N{NO-BREAK SPACE}%)"
_KEY = Column("joint", lambda row: row["joint"], "key")


def lag_table(results: Mapping[str, JointCalibrationResult]) -> Table:
    """The lag budget per joint."""
    rows = []
    for joint, result in results.items():
        part, lattice = lag_parts(result), result.budget.lattice
        rows.append(
            {
                "joint": joint,
                **_interval("naive_lag_ms", part.naive_ms),
                "feedback_age_ms": part.feedback_age_ms,
                "command_hold_ms": part.command_hold_ms,
                **_interval("lag_ms", part.lag_ms),
                **_interval("dead_time_ms", part.dead_time_ms),
                "dynamics_ms": part.dynamics_ms,
                "delay_steps_min": result.delay_steps[0],
                "delay_steps_max": result.delay_steps[1],
                "poll_period_ms": 1e3 * lattice.period_s,
                "loss": lattice.loss,
                "mean_age_from_poll_ms": 1e3 * lattice.mean_age_s,
            }
        )
    columns = (
        _KEY,
        _number("naive, ms", "naive_lag_ms"),
        _number("= feedback age", "feedback_age_ms"),
        _number("+ command hold", "command_hold_ms"),
        _ranged(f"+ servo lag {_LEVEL}", "lag_ms"),
        _ranged(f"of it dead time {_LEVEL}", "dead_time_ms"),
        _number("and dynamics", "dynamics_ms"),
        _number("poll, ms", "poll_period_ms", 2),
        _number("lost polls, %", "loss", 0, 100.0),
    )
    return Table("lag_budget", "Lag budget", columns, tuple(rows))


def estimator_table(results: Mapping[str, JointCalibrationResult]) -> Table:
    """What each delay estimator says, the usual ones first; a column per joint."""
    names = list(dict.fromkeys(name for r in results.values() for name in r.budget.estimators))
    rows = tuple(
        {"estimator": name}
        | {
            f"{joint}_lag_ms": 1e3 * r.budget.estimators.get(name, math.nan)
            for joint, r in results.items()
        }
        for name in names
    )
    columns = (
        Column("lag in ms by", lambda row: row["estimator"], "words"),
        *(_number(joint, f"{joint}_lag_ms") for joint in results),
    )
    return Table("estimators", "The same delay, by other estimators", columns, rows)


def frequency_table(results: Mapping[str, JointCalibrationResult]) -> Table:
    """Gain, phase and lag per tone."""
    rows = [
        {
            "joint": joint,
            "trial": f.trial,
            "frequency_hz": f.frequency_hz,
            "gain": f.gain,
            "phase_deg": f.phase_deg,
            **_interval(
                "lag_ms", Interval(*(1e3 * x for x in (f.lag.value, f.lag.low, f.lag.high)))
            ),
            "naive_lag_ms": 1e3 * f.naive_lag_s,
            "naive_gain": f.naive_gain,
        }
        for joint, result in results.items()
        for f in sorted(result.budget.by_frequency, key=lambda f: f.frequency_hz)
    ]
    columns = (
        _KEY,
        _number("Hz", "frequency_hz", 2),
        _number("gain", "gain", 2),
        _number("phase, °", "phase_deg", 0),
        _ranged(f"lag, ms {_LEVEL}", "lag_ms"),
        _number("naive gain", "naive_gain", 2),
        _number("naive lag, ms", "naive_lag_ms"),
    )
    return Table("by_frequency", "Frequency by frequency", columns, tuple(rows))


def transfer_table(responses: Mapping[str, FrequencyResponse]) -> Table:
    """The fitted transfer functions, number by number."""
    rows = [
        {
            "joint": joint,
            "transfer_function": fit.name,
            "parameter": name,
            **_interval("value", p),
            "chi2_per_dof": fit.chi2_per_dof,
        }
        for joint, response in responses.items()
        for fit in response.fits
        for name, p in fit.parameters.items()
    ]
    columns = (
        _KEY,
        _text("form", "transfer_function"),
        Column("number", lambda row: _readable(row["parameter"], ""), "words"),
        Column(
            f"value {_LEVEL}",
            lambda row: _value_cell(row["value"], row["value_low"], row["value_high"]),
        ),
        Column("unit", lambda row: unit_of(row["parameter"]), "words"),
        _number("misfit, χ²/dof", "chi2_per_dof"),
    )
    return Table("transfer_functions", "Fitted transfer functions", columns, tuple(rows))


def ladder_table(results: Mapping[str, JointCalibrationResult]) -> Table:
    """Every model of the ladder and every preset, scored the same way."""
    rows = []
    for joint, result in results.items():
        for name, fitted in result.rungs.items():
            kind = "chosen" if name == result.chosen else "fitted"
            rows.append(_scored(joint, name, kind, len(fitted.values), fitted.scores))
        for name, scores in result.presets.items():
            rows.append(_scored(joint, name, "preset", None, scores))
    columns = (
        _KEY,
        Column("model", _model_cell, "words"),
        _number("numbers fitted", "parameter_count", 0),
        _number("fresh, mrad", "rmse_fresh_mrad"),
        _number("unseen frequency, mrad", "rmse_leave_one_frequency_out_mrad"),
        _number("held, mrad", "rmse_held_mrad"),
        _number("one step, mrad", "rmse_one_step_mrad"),
        _number("fit, %", "fit_percent"),
        _number("naive, mrad (misleads)", "rmse_naive_mrad"),
    )
    return Table("ladder", "Models, simplest first", columns, tuple(rows), "is_chosen")


def _scored(joint: str, model: str, kind: str, count: int | None, s: Scores) -> Row:
    return {
        "joint": joint,
        "model": model,
        "kind": kind,
        "is_chosen": kind == "chosen",
        "parameter_count": count,
        "rmse_fresh_mrad": 1e3 * s.fresh,
        "rmse_leave_one_frequency_out_mrad": 1e3 * s.leave_one_out,
        "rmse_held_mrad": 1e3 * s.held,
        "rmse_one_step_mrad": 1e3 * s.one_step,
        "fit_percent": s.fit_percent,
        "rmse_naive_mrad": 1e3 * s.naive,
    }


def _model_cell(row: Row) -> str:
    return model_name(row["model"]) + (", chosen" if row["kind"] == "chosen" else "")


def model_name(name: str) -> str:
    """A rung of the ladder or a preset, in words."""
    return MODEL_NAMES.get(name, f"preset “{name}”")


def parameter_table(calibration: Calibration, joints: Sequence[str]) -> Table:
    """Every number of the calibration with its interval and whether it was identified."""
    rows = []
    for joint in joints:
        known = calibration.joint(joint)
        parts = {
            "actuator": known.actuator,
            "ratios to armature": known.actuator.ratios_to_armature,
            "feedback": known.feedback,
        }
        for part, values in parts.items():
            for name in type(values).model_fields:
                q = getattr(values, name)
                if isinstance(q, Quantity):
                    rows.append(
                        {
                            "joint": joint,
                            "part": part,
                            "parameter": name,
                            "unit": unit_of(name),
                            "value": q.value,
                            "low": q.low,
                            "high": q.high,
                            "identified": q.identified,
                            "why": q.why or "",
                        }
                    )
    columns = (
        _KEY,
        Column("number", lambda row: _readable(row["parameter"], row["part"]), "words"),
        Column(f"value {_LEVEL}", lambda row: _value_cell(row["value"], row["low"], row["high"])),
        _text("unit", "unit"),
        _text("identified", "identified"),
        Column("why", lambda row: row["why"], "prose"),
    )
    return Table("parameters", "Parameters", columns, tuple(rows))


def _readable(name: str, part: str) -> str:
    """A parameter's name without its unit, in words."""
    for end in ("_nm_s_per_rad", "_nm_per_rad", "_kg_m2", "_rad_s", "_rad", "_nm", "_s"):
        if name.endswith(end):
            name = name[: -len(end)]
            break
    return name.replace("_", " ") + (" / armature" if part == "ratios to armature" else "")


def _value_cell(value: float, low: float | None, high: float | None) -> str:
    if low is None or high is None or low == high:
        return _significant(value)
    return f"{_significant(value)} ({_significant(low)} … {_significant(high)})"


def doctor_table(examinations: Sequence[tuple[str, Any]], joints: Sequence[str]) -> Table:
    """The doctor's verdict per recording and joint.

    Parameters
    ----------
    examinations : sequence of (str, pupper_sysid.sysid.doctor.examination.Examination)
        Name of the recording and what the doctor found.
    joints : sequence of str
        Which joints to show.
    """
    rows = []
    for recording, examination in examinations:
        for joint, j in examination.joints.items():
            if joint in joints:
                rows.append(
                    {
                        "recording": recording,
                        "joint": joint,
                        "verdict": j.verdict,
                        "loop_period_ms": j.loop_period_ms,
                        "jitter_ms": j.jitter_ms,
                        "fresh_fraction": j.fresh_fraction,
                        "poll_period_ms": j.poll_period_ms,
                        "loss": j.loss,
                        "quantum_rad": j.quantum_rad,
                        "offset_rad": j.offset_rad,
                        "reasons": " ".join(j.reasons),
                    }
                )
    columns = (
        _KEY,
        _text("verdict", "verdict"),
        _number("loop, ms", "loop_period_ms", 2),
        _number("jitter, ms", "jitter_ms", 2),
        _number("fresh rows, %", "fresh_fraction", 0, 100.0),
        _number("poll, ms", "poll_period_ms", 2),
        _number("lost polls, %", "loss", 0, 100.0),
        _number("count, mrad", "quantum_rad", 3, 1e3),
        _number("offset, mrad", "offset_rad", 1, 1e3),
        _text("recording", "recording"),
    )
    return Table("doctor", "The recordings' health", columns, tuple(rows))


# ------------------------------------------------------------------------------ how to show


def _text(heading: str, key: str) -> Column:
    return Column(heading, lambda row: str(row[key]), "words")


def _number(heading: str, key: str, digits: int = 1, factor: float = 1.0) -> Column:
    return Column(heading, lambda row: _digits(row[key], digits, factor))


def _ranged(heading: str, key: str, digits: int = 1) -> Column:
    def show(row: Row) -> str:
        low, high = _digits(row[f"{key}_low"], digits), _digits(row[f"{key}_high"], digits)
        return f"{_digits(row[key], digits)} ({low} … {high})"

    return Column(heading, show)


def _interval(name: str, interval: Interval) -> Row:
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}


def _digits(value: float | None, digits: int, factor: float = 1.0) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    text = f"{value * factor:.{digits}f}"
    return text.replace("-", "−") if float(text) != 0 else text.lstrip("-")


def _significant(value: float) -> str:
    """Three significant digits, without powers of ten where they can be avoided."""
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        digits = 2 - math.floor(math.log10(abs(value))) if value else 0
        return _digits(value, max(digits, 0))
    return f"{value:.2e}".replace("-", "−")
