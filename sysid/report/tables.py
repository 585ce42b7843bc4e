"""Tables of the report: full numbers for CSV, rounded ones for the page.

Each function turns results into a `Table`. The rows hold the results' own fields under their names,
in SI units; the columns say which of them the page shows, and in which unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from pupper_sysid.common.page import Column, Row, Table
from pupper_sysid.common.results import flat, plain
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import NO_SPEED_LIMIT_RAD_S
from pupper_sysid.servo_models.calibration.quantity import Quantity, unit_of, words_of
from pupper_sysid.sysid.fit.results import JointCalibrationResult
from pupper_sysid.sysid.lag.frequency_response import FrequencyResponse

MODEL_NAMES = {
    "pure_delay": "pure delay",
    "fopdt": "first order + delay",
    "sopdt": "second order + delay",
    "dc_servo": "DC servo",
    "delayed_pd": "DelayedPD",
    "delayed_pd_back_emf": "DelayedPD, back-EMF",
    "delayed_pd_backlash": "DelayedPD + backlash",
}

_LEVEL = "(90\N{NO-BREAK SPACE}%)"
KEY = Column("joint", lambda row: row["joint"], "key")
_MS = 1e3
_DELAY = ("dead time", "delay of the form")


def lag_table(results: Mapping[str, JointCalibrationResult]) -> Table:
    """The lag budget per joint."""
    rows = tuple(row for result in results.values() for row in result.lag.rows())
    columns = (
        KEY,
        number("raw, ms", "raw_lag_s", 1, _MS),
        number("= stale readings", "stale_lag_s", 1, _MS),
        number("+ command hold", "command_hold_s", 1, _MS),
        _ranged(f"+ servo lag {_LEVEL}", "lag_s", 1, _MS),
        _ranged(f"of it dead time {_LEVEL}", "dead_time_s", 1, _MS),
        number("and dynamics", "dynamics_s", 1, _MS),
        number("poll, ms", "feedback_poll_period_s", 2, _MS),
        number("lost polls, %", "feedback_loss", 0, 100.0),
        number("mean feedback age, ms", "feedback_mean_age_s", 1, _MS),
    )
    return Table("lag_budget", "Lag budget", columns, rows)


def estimator_table(results: Mapping[str, JointCalibrationResult]) -> Table:
    """The lag by every estimator, the usual ones first; a column per joint."""
    names = list(dict.fromkeys(name for r in results.values() for name in r.lag.estimators_s))
    rows = tuple(
        {"estimator": name}
        | {f"{j}_lag_s": r.lag.estimators_s.get(name, math.nan) for j, r in results.items()}
        for name in names
    )
    columns = (
        text("lag in ms by", "estimator"),
        *(number(joint, f"{joint}_lag_s", 1, _MS) for joint in results),
    )
    return Table("estimators", "The same lag, by other estimators", columns, rows)


def frequency_table(results: Mapping[str, JointCalibrationResult]) -> Table:
    """Gain, phase and lag per tone."""
    rows = [
        {"joint": joint} | flat(plain(f))
        for joint, result in results.items()
        for f in sorted(result.lag.by_frequency, key=lambda f: f.frequency_hz)
    ]
    columns = (
        KEY,
        number("Hz", "frequency_hz", 2),
        number("gain", "gain", 2),
        number("phase, °", "phase_deg", 0),
        _ranged(f"lag, ms {_LEVEL}", "lag_s", 1, _MS),
        number("raw gain", "raw_gain", 2),
        number("raw lag, ms", "raw_lag_s", 1, _MS),
    )
    return Table("by_frequency", "Frequency by frequency", columns, tuple(rows))


def transfer_table(responses: Mapping[str, FrequencyResponse]) -> Table:
    """Parameters of the fitted transfer functions."""
    rows = [
        {"joint": joint, "transfer_function": fit.name, "parameter": name}
        | flat(plain(p))
        | {
            "chi2_per_dof": fit.chi2_per_dof,
            "unit": unit_of(name),
            "at_bound": name in fit.at_bound,
        }
        for joint, response in responses.items()
        for fit in response.transfer_functions.values()
        for name, p in fit.parameters.items()
    ]
    columns = (
        KEY,
        text("form", "transfer_function"),
        # a form's delay is not the servo's dead time
        Column("parameter", lambda r: words_of(r["parameter"]).replace(*_DELAY), "words"),
        Column(f"value {_LEVEL}", _value_cell),
        text("unit", "unit"),
        number("misfit, χ²/dof", "chi2_per_dof"),
    )
    return Table("transfer_functions", "Fitted transfer functions", columns, tuple(rows))


def model_table(results: Mapping[str, JointCalibrationResult]) -> Table:
    """Candidate models and presets, scored the same way."""
    rows = []
    for joint, result in results.items():
        fitted = {
            n: ("fitted", len(r.values), r.scores) for n, r in result.candidate_models.items()
        }
        presets = {n: ("preset", None, scores) for n, scores in result.presets.items()}
        for name, (kind, count, scores) in (fitted | presets).items():
            chosen = name == result.model
            numbers = plain(scores).items()
            rows.append(
                {"joint": joint, "model": name, "kind": "chosen" if chosen else kind}
                | {"is_chosen": chosen, "parameter_count": count}
                | {key: number for key, number in numbers if not isinstance(number, dict)}
                | {"rmse_unseen_rad": scores.rmse_unseen_rad}
            )
    columns = (
        KEY,
        Column(
            "model",
            lambda r: model_name(r["model"]) + (", chosen" if r["is_chosen"] else ""),
            "words",
        ),
        number("parameters fitted", "parameter_count", 0),
        number("fresh, mrad", "rmse_fresh_rad", 1, 1e3),
        number("unseen frequency (under load: run), mrad", "rmse_unseen_rad", 1, 1e3),
        number("held, mrad", "rmse_held_rad", 1, 1e3),
        number("one step, mrad", "rmse_one_step_rad", 1, 1e3),
        number("fit, %", "fit_percent"),
        number("positions against rows as logged, mrad (misleads)", "rmse_raw_rad", 1, 1e3),
    )
    title = "Candidate models, simplest first"
    return Table("candidate_models", title, columns, tuple(rows), "is_chosen")


def model_name(name: str) -> str:
    """A candidate model or a preset, in words."""
    return MODEL_NAMES.get(name, f"preset “{name}”")


def parameter_table(calibration: Calibration, joints: Sequence[str]) -> Table:
    """Parameters of the calibration with their intervals and whether the data identified them."""
    rows = []
    for joint in joints:
        known = calibration.joint(joint)
        parts = {
            "actuator": known.actuator,
            "ratios to armature": known.actuator.ratios_to_armature,
            "feedback": known.feedback,
        }
        for part, values in parts.items():
            rows += [
                {"joint": joint, "part": part, "parameter": name, "unit": unit_of(name)}
                | plain(quantity)
                for name, quantity in values
                if isinstance(quantity, Quantity)
            ]
    columns = (
        KEY,
        Column("parameter", lambda row: _readable(row["parameter"], row["part"]), "words"),
        Column(f"value {_LEVEL}", _value_cell),
        text("unit", "unit"),
        text("identified", "identified"),
        Column("why", lambda row: row["why"] or "", "prose"),
    )
    return Table("parameters", "Parameters", columns, tuple(rows))


def parameter_matrix(parameters: Table) -> Table:
    """`parameter_table` with a row per parameter and a column per joint; it has no file."""

    def cell(row: Row) -> str:
        factor, _ = _SMALL_UNITS.get(row["unit"], (1.0, row["unit"]))
        value, _, more = _value_cell(row, factor).replace(",", " (").partition(" (")
        shown = Markup("{}<small>{}</small>").format(value, more.rstrip(")").strip())
        if row["identified"] == "no":
            shown = Markup('<span class="undecided" title="{}">{}</span>').format(row["why"], shown)
        return shown

    def name(row: Row) -> str:
        _, unit = _SMALL_UNITS.get(row["unit"], (1.0, row["unit"]))
        return f"{_readable(row['parameter'], row['part'])} [{unit}]"

    return _matrix(f"Parameters {_LEVEL}", "parameter", parameters.rows, name, cell)


_SMALL_UNITS = {"s": (1e3, "ms"), "rad": (1e3, "mrad"), "kg·m²": (1e7, "g·cm²"), "1": (100.0, "%")}


def model_matrix(models: Table) -> Table:
    """Error on unseen motion (fresh readings) per model and joint; it has no file."""

    def cell(row: Row) -> str:
        unseen = _digits(row["rmse_unseen_rad"], 1, 1e3)
        fresh = _digits(row["rmse_fresh_rad"], 1, 1e3)
        chosen = "<b>{}</b><small>{}</small>" if row["is_chosen"] else "{}<small>{}</small>"
        return Markup(chosen).format(unseen, fresh)

    title = (
        "RMS error on unseen frequencies (under load: runs), below it on fresh readings of the fit "
        "[mrad]; the chosen model is bold"
    )
    return _matrix(title, "model", models.rows, lambda row: model_name(row["model"]), cell)


def _matrix(
    title: str,
    heading: str,
    rows: Sequence[Row],
    name: Callable[[Row], str],
    cell: Callable[[Row], str],
) -> Table:
    """Rows of several joints side by side, one column per joint."""
    joints = list(dict.fromkeys(row["joint"] for row in rows))
    lines: dict[str, Row] = {}
    for row in rows:
        lines.setdefault(name(row), {})[row["joint"]] = cell(row)
    columns = (
        Column(heading, lambda row: row[heading], "key"),
        *(Column(joint, lambda row, joint=joint: row.get(joint, "–")) for joint in joints),
    )
    made = tuple({heading: line} | cells for line, cells in lines.items())
    return Table("", title, columns, made)


def _readable(name: str, part: str) -> str:
    """A parameter's name without its unit, in words."""
    return words_of(name) + (" / armature" if part == "ratios to armature" else "")


def _value_cell(row: Row, factor: float = 1.0) -> str:
    value, low, high = (None if row[k] is None else factor * row[k] for k in _ENDS)
    assert value is not None
    if row.get("at_bound") or (row.get("why") or "").startswith("on its bound"):
        return f"{_significant(value)}, a bound of the fit"
    if low is None or high is None or low == high:
        return _significant(value)
    end = "∞" if row["unit"] == "rad/s" and high >= NO_SPEED_LIMIT_RAD_S else _significant(high)
    return f"{_significant(value)} ({_significant(low)} … {end})"


_ENDS = ("value", "low", "high")


def doctor_table(examinations: Sequence[tuple[str, Any]], joints: Sequence[str]) -> Table:
    """The doctor's verdict per recording and joint; `examinations` are by its name."""
    rows = tuple(
        {"recording": recording, "joint": joint}
        | flat(plain(found))
        | {"reasons": " ".join(found.reasons)}
        for recording, examination in examinations
        for joint, found in examination.joints.items()
        if joint in joints
    )
    columns = (
        KEY,
        text("verdict", "verdict"),
        number("loop, ms", "loop_period_s", 2, _MS),
        number("loop jitter, ms", "jitter_s", 2, _MS),
        number("fresh rows, %", "fresh_fraction", 0, 100.0),
        number("missing rows, %", "missing_fraction", 0, 100.0),
        number("offset, mrad", "reading_minus_command_rad", 1, 1e3),
        number("fastest command, rad/s", "peak_command_rad_s", 1),
    )
    return Table("doctor", "The recordings' health", columns, rows)


def text(heading: str, key: str) -> Column:
    """Column of words."""
    return Column(heading, lambda row: str(row[key]), "words")


def number(heading: str, key: str, digits: int = 1, factor: float = 1.0) -> Column:
    """Column of numbers, times `factor`."""
    return Column(heading, lambda row: _digits(row[key], digits, factor))


def _ranged(heading: str, key: str, digits: int = 1, factor: float = 1.0) -> Column:
    def show(row: Row) -> str:
        numbers = (row[k] for k in (key, f"{key}_low", f"{key}_high"))
        return "{} ({} … {})".format(*(_digits(x, digits, factor) for x in numbers))

    return Column(heading, show)


def _digits(value: float | None, digits: int, factor: float = 1.0) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    shown = f"{value * factor:.{digits}f}"
    return shown.replace("-", "−") if float(shown) != 0 else shown.lstrip("-")


def _significant(value: float) -> str:
    """Three significant digits, without powers of ten where they can be avoided."""
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        digits = 2 - math.floor(math.log10(abs(value))) if value else 0
        return _digits(value, max(digits, 0))
    return f"{value:.2e}".replace("-", "−")
