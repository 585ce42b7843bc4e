"""Tables of what recordings show and of what was fitted to them (`common.tables`).

Each function turns results into the `Table` that commands print and the report shows and writes;
`tidy_table` is what `export --to csv` writes.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup
from pydantic import BaseModel

from pupper_sysid.common.files import write_text
from pupper_sysid.common.results import flat, plain
from pupper_sysid.common.tables import Column, Row, Table, ends, rounded
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import NO_SPEED_LIMIT_RAD_S, JointCalibration
from pupper_sysid.servo_models.calibration.quantity import Quantity, unit_of, words_of

if TYPE_CHECKING:
    from pupper_sysid.sysid.compare.compare import Comparison
    from pupper_sysid.sysid.doctor.examination import Examination
    from pupper_sysid.sysid.fit.results import JointCalibrationResult
    from pupper_sysid.sysid.lag.frequency_response import FrequencyResponse
    from pupper_sysid.sysid.lag.lag_budget import LagBudget
    from pupper_sysid.sysid.recordings.recording import Recording
    from pupper_sysid.sysid.servo_fit.scores import ModelScores

MODEL_NAMES = {
    "pure_delay": "pure delay", "fopdt": "first order + delay", "sopdt": "second order + delay",
    "dc_servo": "DC servo", "delayed_pd": "DelayedPD", "delayed_pd_back_emf": "DelayedPD, back-EMF",
    "delayed_pd_backlash": "DelayedPD + backlash",
}  # fmt: skip

_LEVEL = "(90\N{NO-BREAK SPACE}%)"
KEY = Column("joint", "joint", kind="key")
_DELAY = ("dead time", "delay of the form")


def lag_table(budgets: Mapping[str, LagBudget]) -> Table:
    """The lag budget per joint."""
    columns = (
        KEY,
        Column("raw", "raw_lag_s", "ms", short="raw"),
        Column("= stale readings", "stale_lag_s", "ms", short="stale"),
        Column("+ command hold", "command_hold_s", "ms", short="hold"),
        Column(f"+ servo lag {_LEVEL}", "lag_s", "ms", kind="interval", short=f"servo {_LEVEL}"),
        Column(
            f"of it dead time {_LEVEL}", "dead_time_s", "ms", kind="interval",
            short=f"of it dead time {_LEVEL}",
        ),
        Column("and dynamics", "dynamics_s", "ms", detail=True),
        Column("poll", "feedback_poll_period_s", "ms", 2, detail=True),
        Column("lost polls", "feedback_loss", "%", 0, detail=True),
        Column("mean feedback age", "feedback_mean_age_s", "ms", detail=True),
    )  # fmt: skip
    title = "Lag budget, ms: raw = stale readings + command hold + servo lag"
    rows = [row for budget in budgets.values() for row in budget.rows()]
    return Table("lag_budget", title, columns, rows)


def estimator_table(budgets: Mapping[str, LagBudget]) -> Table:
    """The lag by every estimator, the usual ones first; a column per joint."""
    names = dict.fromkeys(name for budget in budgets.values() for name in budget.estimators_s)
    rows = [
        {"estimator": name}
        | {f"{j}_lag_s": budget.estimators_s.get(name) for j, budget in budgets.items()}
        for name in names
    ]
    columns = (
        Column("lag by", "estimator", kind="words"),
        *(Column(joint, f"{joint}_lag_s", "ms", short=joint) for joint in budgets),
    )
    return Table("estimators", "The same lag, by other estimators, ms", columns, rows)


def frequency_table(budgets: Mapping[str, LagBudget]) -> Table:
    """Gain, phase and lag per tone."""
    rows = [
        {"joint": joint} | flat(plain(f))
        for joint, budget in budgets.items()
        for f in sorted(budget.by_frequency, key=lambda f: f.frequency_hz)
    ]
    columns = (
        KEY,
        Column("Hz", "frequency_hz", digits=2),
        Column("gain", "gain", digits=2),
        Column("phase", "phase_deg", "°", 0),
        Column(f"lag {_LEVEL}", "lag_s", "ms", kind="interval", short=f"lag ms {_LEVEL}"),
        Column("raw lag", "raw_lag_s", "ms"),
        Column("raw gain", "raw_gain", digits=2),
    )
    return Table("by_frequency", "Per frequency, fresh readings", columns, rows)


def transfer_table(responses: Mapping[str, FrequencyResponse]) -> Table:
    """Parameters of the fitted transfer functions."""
    rows = [
        {"joint": joint, "transfer_function": fit.name, "parameter": name}
        | flat(plain(p))
        | {"chi2_per_dof": fit.chi2_per_dof, "unit": unit_of(name)}
        | {"at_bound": name in fit.at_bound}
        for joint, response in responses.items()
        for fit in response.transfer_functions.values()
        for name, p in fit.parameters.items()
    ]
    columns = (
        KEY,
        Column("form", "transfer_function", kind="words"),
        # a form's delay is not the servo's dead time
        Column("parameter", "parameter", kind="words",
               show=lambda row: words_of(row["parameter"]).replace(*_DELAY)),
        Column(f"value {_LEVEL}", "value", show=_value_cell),
        Column("unit", "unit", kind="words"),
        Column("misfit, χ²/dof", "chi2_per_dof"),
    )  # fmt: skip
    return Table("transfer_functions", "Fitted transfer functions", columns, rows)


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
            "model", "model", kind="words",
            show=lambda row: model_name(row["model"]) + (", chosen" if row["is_chosen"] else ""),
        ),
        Column("parameters fitted", "parameter_count", digits=0),
        Column("fresh", "rmse_fresh_rad", "mrad"),
        Column("unseen frequency (under load: run)", "rmse_unseen_rad", "mrad"),
        Column("held", "rmse_held_rad", "mrad"),
        Column("one step", "rmse_one_step_rad", "mrad"),
        Column("fit, %", "fit_percent"),
        Column("positions against raw rows (misleads)", "rmse_raw_rad", "mrad"),
    )  # fmt: skip
    title = "Candidate models, simplest first"
    return Table("candidate_models", title, columns, rows, "is_chosen")


def model_name(name: str) -> str:
    """A candidate model or a preset, in words."""
    return MODEL_NAMES.get(name, f"preset “{name}”")


def parameter_table(calibration: Calibration, joints: Sequence[str]) -> Table:
    """Parameters of the calibration with their intervals and whether the data identified them."""
    rows = []
    for joint in joints:
        known = calibration.joint(joint)
        ratios = known.actuator.ratios_to_armature
        parts = {
            "actuator": known.actuator, "ratios to armature": ratios, "feedback": known.feedback
        }  # fmt: skip
        for part, values in parts.items():
            rows += [
                {"joint": joint, "part": part, "parameter": name, "unit": unit_of(name)}
                | plain(quantity)
                for name, quantity in values
                if isinstance(quantity, Quantity)
            ]
    columns = (
        KEY,
        Column("parameter", "parameter", kind="words",
               show=lambda row: _readable(row["parameter"], row["part"])),
        Column(f"value {_LEVEL}", "value", show=_value_cell),
        Column("unit", "unit", kind="words"), Column("identified", "identified", kind="words"),
        Column("why", "why", kind="prose"),
    )  # fmt: skip
    return Table("parameters", "Parameters", columns, rows)


def parameter_matrix(parameters: Table) -> Table:
    """`parameter_table` with a row per parameter and a column per joint; it has no file."""

    def cell(row: Row) -> str:
        factor, _ = _SMALL_UNITS.get(row["unit"], (1.0, row["unit"]))
        value, _, more = _value_cell(row, factor).replace(",", " (").partition(" (")
        text = Markup("{}<small>{}</small>").format(value, more.rstrip(")").strip())
        if row["identified"] == "no":
            text = Markup('<span class="undecided" title="{}">{}</span>').format(row["why"], text)
        return text

    def name(row: Row) -> str:
        _, unit = _SMALL_UNITS.get(row["unit"], (1.0, row["unit"]))
        return f"{_readable(row['parameter'], row['part'])} [{unit}]"

    return _matrix(f"Parameters {_LEVEL}", "parameter", parameters.rows, name, cell)


_SMALL_UNITS = {"s": (1e3, "ms"), "rad": (1e3, "mrad"), "kg·m²": (1e7, "g·cm²"), "1": (100.0, "%")}


def model_matrix(models: Table) -> Table:
    """Error on unseen motion (fresh readings) per model and joint; it has no file."""

    def cell(row: Row) -> str:
        unseen, fresh = (rounded(row[f"rmse_{k}_rad"], 1, 1e3) for k in ("unseen", "fresh"))
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
    lines: dict[str, dict[str, str]] = {}
    for row in rows:
        lines.setdefault(name(row), {})[row["joint"]] = cell(row)
    columns = (
        Column(heading, heading, kind="key"),
        *(
            Column(joint, joint, show=lambda row, joint=joint: row.get(joint, "–"))
            for joint in joints
        ),
    )
    rows = [{heading: line} | cells for line, cells in lines.items()]
    return Table("", title, columns, rows)


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


def doctor_table(
    examinations: Iterable[tuple[str, Examination]],
    joints: Container[str],
    title: str = "The recordings' health",
) -> Table:
    """The doctor's verdict per recording and joint; `examinations` are by its name."""
    rows = [
        {"recording": recording, "joint": joint}
        | flat(plain(examined))
        | {"reasons": " ".join(examined.reasons)}
        for recording, examination in examinations
        for joint, examined in examination.joints.items()
        if joint in joints
    ]
    columns = (
        KEY,
        Column("verdict", "verdict", kind="words"),
        Column("loop", "loop_period_s", "ms", 2),
        Column("loop jitter", "jitter_s", "ms", 2, short="jitter ms"),
        Column("fresh rows", "fresh_fraction", "%", 0, short="fresh %"),
        Column("missing rows", "missing_fraction", "%", 0, detail=True),
        Column("poll", "poll_period_s", "ms", 2),
        Column("lost polls", "loss", digits=2, short="loss"),
        Column("step of readings", "quantum_rad", "mrad", 3, short="step mrad"),
        Column("offset", "reading_minus_command_rad", "mrad"),
        Column("fastest command", "peak_command_rad_s", "rad/s", detail=True),
    )
    return Table("doctor", title, columns, rows)


def comparison_tables(comparison: Comparison) -> list[Table]:
    """Errors of servo models in free run by joint, the means of all errors, and the offsets."""
    models, joints, offsets = comparison.models, list[Row](), list[Row]()
    offset_rad = {name: model.offset_rad for name, model in models.items() if model.offset_rad}
    others = {
        "persistence": comparison.persistence_rmse_rad,
        "repeatability": comparison.repeatability_rad,
    }
    for joint in comparison.data.joints:
        errors = {name: model.joints[joint].rmse_free_run_rad for name, model in models.items()}
        joints.append({"joint": joint} | errors | {k: rmse[joint] for k, rmse in others.items()})
        offsets.append({"joint": joint} | {k: by[joint] for k, by in offset_rad.items()})
    if len(joints) > 1:
        means = {name: model.mean.rmse_free_run_rad for name, model in models.items()}
        joints.append({"joint": "mean", "is_mean": True} | means)

    def columns(names: Iterable[str]) -> list[Column]:
        return [KEY, *(Column(name, name, "mrad", short=name) for name in names)]

    offset_title = "Offset of this recording, mrad"
    return [
        Table("", "RMS error in free run, mrad", columns((*models, *others)), joints, "is_mean"),
        mean_error_table(models, comparison.persistence_rmse_rad),
        Table("", offset_title, columns(offset_rad), offsets if offset_rad else []),
    ]


def mean_error_table(
    models: Mapping[str, ModelScores],
    persistence_rmse_rad: Mapping[str, float],
    title: str = "RMS error, mrad, mean of the joints",
) -> Table:
    """Errors of servo models, mean of the joints, beside persistence."""
    rows: list[Row] = [
        {"model": name} | plain(model.mean) | ends("rmse_free_run_rad", model.rmse_free_run_rad)
        for name, model in models.items()
    ]
    known = [error for error in persistence_rmse_rad.values() if math.isfinite(error)]
    if known:
        rows.append({"model": "persistence", "rmse_one_step_rad": sum(known) / len(known)})
    free_run = f"free run {_LEVEL}"
    columns = (
        Column("model", "model", kind="key"),
        Column(free_run, "rmse_free_run_rad", "mrad", kind="interval", short=free_run),
        Column("held", "rmse_held_rad", "mrad", short="held"),
        Column("raw, predicted readings", "rmse_raw_rad", "mrad", short="raw"),
        Column("one step", "rmse_one_step_rad", "mrad", short="one step"),
    )
    return Table("", title, columns, rows)


def _significant(value: float) -> str:
    """Three significant digits, without powers of ten where they can be avoided."""
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        digits = 2 - math.floor(math.log10(abs(value))) if value else 0
        return rounded(value, max(digits, 0))
    return f"{value:.2e}".replace("-", "−")


CALIBRATION_COLUMNS = (
    "joint", "part", "quantity", "unit", "value", "low", "high", "identified", "why",
)  # fmt: skip


def tidy_table(
    source: Calibration | Recording, path: Path | None = None, force: bool = False
) -> str:
    """A calibration or recording as tidy CSV text, written to `path` if one is given.

    Comment lines (`# key: JSON value`) say where the numbers come from;
    `pandas.read_csv(path, comment="#")` skips them.
    A calibration gives the columns `CALIBRATION_COLUMNS`: `part` is where the quantity stands in
    the calibration file (`actuator`, `feedback`, `lag`, `scores`, …), `low` and `high` are the ends
    of its 90 % interval, and a number that is not a measured quantity (a score, a count of steps)
    leaves the last four empty. What the calibration does not hold has no row. A recording gives its
    rows with the columns of `sysid.recordings.recording`.
    """
    text = _calibration_table(source) if isinstance(source, Calibration) else source.to_csv()
    if path is not None:
        write_text(path, text, force)
    return text


def _calibration_table(calibration: Calibration) -> str:
    from pupper_sysid.sysid.recordings.table import comments  # brings pandas

    header = calibration.model_dump(mode="json", by_alias=True, exclude={"joints"})
    header["operating_points"] = {
        name: joint.holds_at.model_dump(mode="json") for name, joint in calibration.joints.items()
    }
    buffer = io.StringIO()
    buffer.write(comments("pupper-sysid calibration table", header))
    # text is quoted: a '#' in a sentence must not begin a comment
    table = csv.writer(buffer, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n")
    buffer.write(",".join(CALIBRATION_COLUMNS) + "\n")
    for name, joint in calibration.joints.items():
        table.writerows([name, *row] for row in _numbers(joint))
    return buffer.getvalue()


def _numbers(joint: JointCalibration) -> Iterator[list[Any]]:
    """Part, quantity, unit, value, low, high, identified, why of all numbers of one joint."""
    parts: dict[str, BaseModel] = {
        "actuator": joint.actuator,
        "ratios_to_armature": joint.actuator.ratios_to_armature,
        "scale": joint.actuator.scale,
        "feedback": joint.feedback,
        "lag": joint.lag,
        "scores": joint.scores,
    }
    for part, model in parts.items():
        for name, entry in model:
            if isinstance(entry, Quantity):
                numbers = [entry.value, entry.low, entry.high]
                yield [part, name, unit_of(name), *numbers, entry.identified, entry.why]
            elif isinstance(entry, int | float):
                yield [part, name, unit_of(name), entry, "", "", "", ""]
