"""Sections of the report: findings as sentences, figures and tables, for all joints together.

`advice` finds each joint's gaps (a limit that was not reached, tones too slow to separate dead time
from dynamics, too few tones, too short a recording) and the recording that closes each. Joints with
the same gap share one sentence.

In the section on servo models the curve of error against the amount of data is
`data/servo_data_curve.csv`: the benchmark `benchmarks/servo_data_curve.py` fits every kind of model
to more and more samples of the emulated robot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pupper_sysid.common.figure_style import BLUE, FAINT, GREEN, INK, RED, axes_column, styled
from pupper_sysid.common.files import versions
from pupper_sysid.common.joints import JOINT_NAMES, share_sentences, with_joints
from pupper_sysid.common.page import Fold, Picture, Section
from pupper_sysid.common.tables import Column, Table
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import Actuator
from pupper_sysid.sysid.fit.results import JointCalibrationResult
from pupper_sysid.sysid.fit.structure import PREFERRED
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.report import figures, tables
from pupper_sysid.sysid.report.figures import Track, hold_runs, tracks
from pupper_sysid.sysid.report.tables import MODEL_NAMES
from pupper_sysid.sysid.servo_fit.scores import LINEAR

if TYPE_CHECKING:
    from pupper_sysid.sysid.compare.compare import Comparison
    from pupper_sysid.sysid.doctor.examination import Examination
    from pupper_sysid.sysid.lag.frequency_response import FrequencyResponse


@dataclass(frozen=True, kw_only=True)
class Findings:
    """Results that a report shows."""

    recordings: Sequence[Recording]
    """From which all was computed."""
    results: Mapping[str, JointCalibrationResult]
    calibration: Calibration
    """Has at least the joints of `results`; the parameter table shows its numbers."""
    examinations: Sequence[tuple[str, Examination]] = ()
    """Name of each recording and its examination."""
    responses: Mapping[str, FrequencyResponse] = field(default_factory=dict)
    """Of joints with tones."""
    comparison: Comparison | None = None
    """Of servo models."""


def sections(report: Findings) -> list[Section]:
    """All sections of the page, in order: first what holds for all joints, then joint by joint."""
    results = report.results
    runs = {joint: page for joint, result in results.items() if (page := tracks(result))}
    page = [_summary(results), _lag(results), _doctor(report), _free_runs(results, runs)]
    parameters = tables.parameter_table(report.calibration, list(results))
    page += [_parameters(report, parameters), _models(results), _holds(report), _bode(report)]
    if report.comparison:
        page.append(servo_section(report.comparison))
    next_steps = advice(results, report.calibration, report.examinations)
    page += [
        _joints(report, runs, parameters),
        Section("next", "What to record next", findings=[("", text) for text in next_steps]),
        _provenance(report),
    ]
    return [s for s in page if s.text or s.findings or s.figures or s.tables or s.folds]


def _summary(results: Mapping[str, JointCalibrationResult]) -> Section:
    return Section(
        "found",
        "What was found",
        findings=[
            (joint, text)
            for joint, r in results.items()
            for text in (str(r.lag), *(d.removeprefix(f"{joint}: ") for d in r.differences))
        ],
        notes=[
            "Raw lag: from a command's row to the position's row, as a cross-correlation of the "
            "log measures it. Only the servo's own part belongs to a simulated actuator; stale "
            "feedback belongs to the observation."
        ],
    )


def _lag(results: Mapping[str, JointCalibrationResult]) -> Section:
    budgets = {joint: r.lag for joint, r in results.items()}
    picture = Picture(
        "lag_budget",
        "Lag budget: the time from sending a command to the row in which its motion is read. The "
        "line across each bar is the raw lag, which is the sum.",
        figures.lag_budget_figure(budgets),
    )
    notes = with_joints({joint: r.lag.warnings for joint, r in results.items()})
    if any(r.lag.stale_lag_s < _NEGATIVE_S for r in results.values()):
        notes.append(
            "Stale readings with a negative lag: these positions were read after the time stamp of "
            "their row, so they are younger than the row, not older."
        )
    by_estimator = tables.estimator_table(budgets)
    return Section(
        "lag", "Lag budget", figures=[picture], tables=[tables.lag_table(budgets)],
        folds=[Fold(by_estimator.title, tables=[by_estimator])], files=[by_estimator], notes=notes,
    )  # fmt: skip


_NEGATIVE_S = -5e-5


def _doctor(report: Findings) -> Section:
    by_joint: dict[str, list[str]] = {}
    for _, examination in report.examinations:
        for name, joint in examination.joints.items():
            if name in report.results:
                sentences = (f"{joint.verdict}.", *joint.reasons)
                by_joint.setdefault(name, []).extend(t[:1].upper() + t[1:] for t in sentences)
    texts: dict[str, list[str]] = {}
    for names, sentence in share_sentences(by_joint):
        texts.setdefault(names, []).append(sentence)
    return Section(
        "doctor", "Are the recordings usable?",
        findings=[(names, " ".join(sentences)) for names, sentences in texts.items()],
        tables=[tables.doctor_table(report.examinations, report.results)],
    )  # fmt: skip


def _free_runs(
    results: Mapping[str, JointCalibrationResult], runs: Mapping[str, list[Track]]
) -> Section:
    """Overlays and residuals of DelayedPD, a panel per joint."""
    text = "DelayedPD runs freely from where the joint rested: its input is commands only."
    pictures = []
    if len(runs) == 1:
        ((joint, runs_of),) = runs.items()
        pictures = _of_joint(results[joint], runs_of)
    elif runs:
        pictures = [
            Picture("overlay", _OVERLAY, figures.overlay_grid(runs), wide=True),
            Picture("residuals", _RESIDUALS, figures.residual_grid(runs), wide=True),
        ]
    return Section(
        "overlays", "Command, model, readings", text=[text] if pictures else [],
        toggles=figures.OVERLAY_PARTS if pictures else {}, figures=pictures,
    )  # fmt: skip


_OVERLAY = (
    "The grey steps are the readings as logged; the dots are the fresh readings at the time they "
    "were measured. The model is scored on those."
)
_RESIDUALS = (
    "The error of rows at their own time is proportional to speed: that is the age of stale "
    "readings; fresh rows have no such error."
)


def _of_joint(result: JointCalibrationResult, runs: list[Track]) -> list[Picture]:
    """Overlay and residuals of one joint."""
    joint, over = result.joint, figures.overlay_figure(result, runs)
    words = f"{joint}, above: {_RESIDUALS} Below, the residuals of fresh rows."
    return [
        Picture(f"overlay_{joint}", f"{joint}: {_OVERLAY}", over),
        Picture(f"residuals_{joint}", words, figures.residual_figure(result, runs)),
    ]


def _joints(report: Findings, runs: Mapping[str, list[Track]], parameters: Table) -> Section:
    """Everything about each joint, folded."""
    models = tables.model_table(report.results)
    by_frequency = tables.frequency_table({j: r.lag for j, r in report.results.items()})
    forms = tables.transfer_table(report.responses)
    folds = []
    for joint, result in report.results.items():
        drawn = _of_joint(result, runs[joint]) if joint in runs and len(runs) > 1 else []
        parts = [t.where("joint", joint) for t in (parameters, models, by_frequency, forms)]
        with_rows = [t for t in parts if t.rows]
        folds.append(Fold(joint, drawn, with_rows, opened=len(report.results) == 1))
    return Section(
        "joints", "Joint by joint", folds=folds, files=[models, by_frequency, forms, parameters]
    )


def _holds(report: Findings) -> Section:
    held = {}
    for joint, result in report.results.items():
        if examined := [e.joints[joint] for _, e in report.examinations if joint in e.joints]:
            counts = [e.hold_histogram for e in examined]
            periods_s = [e.loop_period_s for e in examined]
            held[joint] = hold_runs(counts, periods_s, result.lag.feedback)
    pictures = []
    if held:
        text = (
            "For how many rows each reading stayed the same while its joint moved. A sensor that "
            "is read afresh each time has all its runs at 1."
        )
        drawn = figures.hold_histogram_figure(held)
        pictures.append(Picture("holds", text, drawn, wide=len(held) > 3))
    return Section("holds", "How long readings are held", figures=pictures)


def _bode(report: Findings) -> Section:
    pictures = []
    if report.responses:
        text = (
            "Frequency response from the held command to the motion, from fresh readings, with "
            "90 % intervals. Hollow marks: gain of all rows, held ones included, which is too low."
        )
        pictures.append(Picture("bode", text, figures.bode_figure(report.responses)))
    return Section(
        "bode", "Frequency response", figures=pictures,
        findings=share_sentences(
            {
                joint: [f"−3 dB bandwidth {response.bandwidth_text}."]
                for joint, response in report.responses.items()
            }
        ),
        notes=[
            "A transfer function has neither friction nor limits, so the delay of its form is not "
            "the dead time of the servo, which stands under Parameters. The forms stand under each "
            "joint.",
        ] if report.responses else [],
    )  # fmt: skip


def _models(results: Mapping[str, JointCalibrationResult]) -> Section:
    misled: dict[str, list[str]] = {}
    for joint, result in results.items():
        raw = {name: r.scores.rmse_raw_rad for name, r in result.candidate_models.items()}
        raw |= {name: s.rmse_raw_rad for name, s in result.presets.items()}
        if (best := min(raw, key=lambda name: raw[name])) != result.model:
            misled[joint] = [tables.model_name(best)]
    preferred = [f"It prefers {model} on {names}." for names, model in share_sentences(misled)]
    return Section(
        "models",
        "Models",
        text=[
            "Errors are root mean squares of free runs. Fresh: against fresh readings when they "
            "were measured. Unseen frequency: the same on tones left out of the fit; the model "
            f"best at that is chosen ({MODEL_NAMES[PREFERRED]} where it comes within 5 %, because "
            "simulators run it). Presets are published settings, scored the same way."
        ],
        tables=[tables.model_matrix(tables.model_table(results))],
        notes=[
            "The raw score takes every row as measured when it was logged. Held readings then "
            "count as errors, no model can get below them, and a model with too much delay is "
            "best: do not choose by it. " + " ".join(preferred)
        ],
    )


def _parameters(report: Findings, parameters: Table) -> Section:
    scale = report.calibration.joint(next(iter(report.results))).actuator.scale
    return Section(
        "parameters",
        "Parameters",
        text=[
            f"Torques follow from one anchor: {scale.anchor}, {scale.value_nm:g} N·m "
            f"({scale.source}). “Ratio only” means that the recording gives this number divided by "
            "the armature, and the anchor gives the rest. Numbers in italics are not identified; "
            "the reason stands under each joint."
        ],
        tables=[tables.parameter_matrix(parameters)],
        notes=with_joints(
            {
                joint: [w for w in r.warnings if w not in (*r.lag.warnings, *r.differences)]
                for joint, r in report.results.items()
            }
        ),
    )


def _provenance(report: Findings) -> Section:
    recordings, calibration = report.recordings, report.calibration
    rows = [
        {
            "recording": r.path.name if r.path else r.name, "sha256": r.sha256,
            "joints": " ".join(r.joints), "rows": len(r.table), "loop_period_s": r.loop_period_s,
        }
        for r in recordings
    ]  # fmt: skip
    columns = (
        Column("recording", "recording", kind="words"),
        Column("rows", "rows", digits=0),
        Column("loop", "loop_period_s", "ms", 2),
        Column("SHA-256", "sha256", kind="words"),
    )
    library_versions = ", ".join(f"{name} {version}" for name, version in versions().items())
    return Section(
        "provenance",
        "Where this comes from",
        text=[
            f"Calibration of {calibration.robot}, {calibration.created}, seed {calibration.seed}. "
            f"Made with {library_versions}."
        ],
        tables=[Table("recordings", "Recordings", columns, rows)],
        notes=[*(w for r in recordings for w in r.warnings), *calibration.notes],
    )


_FEW_FREQUENCIES = 4
_FAST_HZ = 5.0  # below it a servo of 20 ms dynamics looks like 20 ms more of dead time
_WIDE_MS = 6.0
_FEW_READINGS = 400
_LONG_S = 30.0


def advice(
    results: Mapping[str, JointCalibrationResult],
    calibration: Calibration,
    examinations: Sequence[tuple[str, Any]] = (),
) -> list[str]:
    """What to record next, most useful first; one sentence each.

    The calibration says what was identified; `examinations` has by the recording's name what the
    doctor found.
    """
    again: dict[str, list[str]] = {joint: [] for joint in results}
    for recording, examination in examinations:
        for joint, examined in examination.joints.items():
            if joint in results and examined.verdict == "do not use":
                again[joint].append(
                    f"record {recording} again: the doctor's verdict is not to use it "
                    f"({' '.join(examined.reasons).rstrip('.')})."
                )
    gaps = {
        joint: _gaps(result, calibration.joint(joint).actuator) for joint, result in results.items()
    }
    texts = with_joints(again) + with_joints(gaps)
    if any(calibration.joint(j).actuator.scale.anchor == "stall torque" for j in results):
        texts.append(
            "Torques rest on an assumed stall torque, because a joint that swings in free air "
            "shows only ratios to its inertia. Hang a known mass at a known distance from the "
            "joint and record the same sweep: that gives the scale."
        )
    missing = [j for j in JOINT_NAMES if j not in results]
    if 0 < len(missing) < len(JOINT_NAMES):  # of a Mini Pupper; how many others have is not known
        texts.append(f"Not recorded yet: {', '.join(missing)}. `pupper-sysid sweep` records them.")
    return texts


def _gaps(result: JointCalibrationResult, actuator: Actuator) -> list[str]:
    """Sentences for one joint, without its name."""
    pd, lattice = result.delayed_pd, result.lag.feedback
    tones = sorted({round(t.frequency_hz, 2) for t in result.runs if t.frequency_hz > 0})
    fresh = sum(len(t.sample_step) for t in result.runs)
    width = 1e3 * (result.dead_time_s.high - result.dead_time_s.low)
    gaps = []
    ratios = actuator.ratios_to_armature
    limits = {
        "speed": (actuator.velocity_limit_rad_s, ratios.back_emf), "torque": (ratios.effort_limit,)
    }  # fmt: skip
    unknown = [n for n, parts in limits.items() if all(q.identified == "no" for q in parts)]
    if unknown:
        gaps.append(
            f"the limit of its {' and '.join(unknown)} is not identified. Record steps, or tones "
            "whose peak speed 2π·f·A comes close to the servo's no-load speed."
        )
    if ratios.friction_loss.identified == "no":
        gaps.append(
            "friction is not identified. Record a slow tone (0.2–0.5 Hz): the joint sticks at its "
            "turning points."
        )
    if not tones:
        gaps.append(
            "there are no tones in this recording. Record a sweep of 1 to 10 Hz: it gives gain and "
            "lag per frequency, and a model can be tested on tones left out of its fit."
        )
    elif len(tones) < _FEW_FREQUENCIES:
        gaps.append(
            f"only {len(tones)} frequenc{'y' if len(tones) == 1 else 'ies'} "
            f"({', '.join(f'{f:g}' for f in tones)} Hz), too few to test a model on one left out "
            "of its fit. Record 1 to 10 Hz."
        )
    if tones and (tones[-1] < _FAST_HZ or width > _WIDE_MS):
        gaps.append(
            f"the dead time rests on tones of {tones[-1]:g} Hz and below, where it is hard to "
            "separate from slow dynamics. Record faster tones (up to 10 Hz, at a smaller "
            "amplitude) or steps."
        )
    if fresh < _FEW_READINGS:
        gaps.append(
            f"fewer than {_FEW_READINGS} fresh readings. Hold each tone longer: four times the "
            "time halves every interval."
        )
    if lattice.kind == "unresolved":
        gaps.append(
            "readings are held, but the bus's poll period could not be found. Record a longer "
            f"sweep ({_LONG_S:g} s or more) at full amplitude."
        )
    if not np.isfinite(pd.scores.rmse_unseen_rad) and tones:
        gaps.append("no frequency could be left out, so the model was not tested on new motion.")
    return gaps


def servo_section(comparison: Comparison) -> Section:
    """Section of a comparison of servo models on the report's recordings."""
    pictures = [
        Picture(
            f"servo_{joint}",
            f"{joint}: models in free run, commands only. The shaded band is where the first "
            "model predicts nine readings in ten, from its errors on data held out of its fit; it "
            "widens with speed, because the time of a polled reading is uncertain.",
            comparison.plot([joint]),
        )
        for joint in comparison.data.joints
    ]
    curve = measured()
    samples = curve.add_suffix("_rad").reset_index().to_dict("records")
    by_samples = (
        Column(
            "samples per joint", "samples_per_joint", kind="key",
            show=lambda row: f"{row['samples_per_joint']:,}",
        ),
        *(Column(MODELS[m][0], f"{m}_rad", "mrad") for m in map(str, curve)),
    )  # fmt: skip
    runs = comparison.data.runs.values()
    readings = int(np.median([sum(len(r.readings.rows) for r in joint) for joint in runs]))
    pictures.append(
        Picture(
            "servo_data_curve",
            "How much data a servo model needs, measured on the emulated robot under random "
            "commands of 0.5 to 4 Hz (the emulated servo is a DelayedPD, which therefore needs "
            "least). The line marks the readings per joint of this recording.",
            data_curve_figure(curve, readings),
        )
    )
    return Section(
        "servo",
        "Servo models",
        text=[
            "Error of each model in free run, from commands only. "
            f"“{LINEAR}” predicts each group from a filter fitted to the others; persistence is "
            "the reading before as the prediction of the next."
        ],
        figures=pictures,
        tables=[
            *tables.comparison_tables(comparison),
            Table("servo_data_curve", "Error against samples, emulated robot", by_samples, samples),
        ],
        files=[
            Table("servo_models", "", (), comparison.to_frame().reset_index().to_dict("records"))
        ],
        notes=[*comparison.reading_notes(), *comparison.notes],
    )


FILE = "servo_data_curve.csv"
MODELS = {
    "fir": ("linear", INK, "o", "-"),
    "delayed-pd": ("DelayedPD", GREEN, "s", "-"),
    "mlp": ("MLP", BLUE, "^", "-"),
    "lstm": ("LSTM", RED, "D", "-"),
    "mlp paper": ("MLP, as published", BLUE, "v", ":"),
    "lstm paper": ("LSTM, as published", RED, ">", ":"),
}
"""Title, colour, marker and line of each model of the curve."""


def measured() -> pd.DataFrame:
    """Error in free run [rad] by samples per joint (rows) and model of `MODELS` (columns)."""
    with (resources.files("pupper_sysid.sysid.report") / "data" / FILE).open() as file:
        table = pd.read_csv(file)
    curve = table.pivot(index="samples_per_joint", columns="model", values="rmse_free_run_rad")
    return curve.sort_index().reindex(columns=[m for m in MODELS if m in curve])


@styled
def data_curve_figure(curve: pd.DataFrame, readings: int) -> Figure:
    """Error against samples, a line per model; `readings` marks a recording's own number."""
    figure, (axes,) = axes_column(1, 3.6)
    for model, errors in curve.items():
        title, colour, marker, line = MODELS[str(model)]
        axes.loglog(curve.index, 1e3 * errors, marker=marker, color=colour, ls=line, label=title)
    axes.axvline(readings, color=FAINT, lw=1.5, zorder=0)
    axes.text(
        readings, 0.98, " this recording", transform=axes.get_xaxis_transform(), va="top",
        fontsize=8,
    )  # fmt: skip
    axes.set_xlabel("samples per joint")
    axes.set_ylabel("error in free run [mrad]")
    axes.set_xticks(list(curve.index), [f"{samples:,}" for samples in curve.index])
    axes.set_yticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"])
    axes.minorticks_off()
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize=7.5)
    figure.set_figwidth(8.0)
    return figure
