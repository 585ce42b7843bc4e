"""Report: everything found about a robot's servos, as one page that opens anywhere.

`write_report` makes a folder with `report.html`, the same figures as PNG and SVG, and the same
tables as CSV (`common.page`). Each section is built by one function below, from results that were
computed elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pupper_sysid.common.files import versions
from pupper_sysid.common.page import Column, Picture, Section, Table, WrittenPage, write_page
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.sysid.identify.calibrate import JointCalibrationResult
from pupper_sysid.sysid.identify.search import PREFERRED
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.report import figures, tables
from pupper_sysid.sysid.report.advice import advice
from pupper_sysid.sysid.report.figure_data import Track, hold_runs, lag_parts, tracks
from pupper_sysid.sysid.report.tables import MODEL_NAMES

if TYPE_CHECKING:  # both bring libraries that a page does not need
    from pupper_sysid.sysid.doctor.examination import Examination
    from pupper_sysid.sysid.lag.frequency_response import FrequencyResponse


def write_report(
    folder: Path,
    recordings: Sequence[Recording],
    results: Mapping[str, JointCalibrationResult],
    calibration: Calibration,
    examinations: Sequence[tuple[str, Examination]],
    responses: Mapping[str, FrequencyResponse],
    force: bool = False,
    more: Sequence[Section] = (),
) -> WrittenPage:
    """Write the report's page, figures and tables into `folder`.

    Parameters
    ----------
    folder : Path
        Made if it is missing; gets `report.html`, `figures/*.png`, `figures/*.svg` and
        `tables/*.csv`.
    recordings : sequence of Recording
        What was computed from.
    results : dict of joint to JointCalibrationResult
    calibration : Calibration
        Has at least the joints of `results`; the parameter table shows its numbers.
    examinations : sequence of (str, Examination)
        Name of each recording and what the doctor found in it.
    responses : dict of joint to FrequencyResponse
        Joints without tones are left out.
    force : bool
        Replace files that exist.
    more : sequence of Section
        Placed before what to record next.

    Raises
    ------
    InputError
        If one of the files exists and `force` is not given (nothing has been written then), or if
        one cannot be written.
    """
    page = sections(recordings, results, calibration, examinations, responses)
    page[-2:-2] = more
    return write_page(
        folder / "report.html", _title(recordings), _subtitle(results, calibration), page, force
    )


def sections(
    recordings: Sequence[Recording],
    results: Mapping[str, JointCalibrationResult],
    calibration: Calibration,
    examinations: Sequence[tuple[str, Examination]],
    responses: Mapping[str, FrequencyResponse],
) -> list[Section]:
    """All sections of the page, in order; parameters as for `write_report`."""
    runs = {joint: tracks(result) for joint, result in results.items()}
    made = [
        _summary(results),
        _lag(results),
        _doctor(examinations, results),
        _overlays(results, runs),
        _holds(examinations, results),
        _bode(results, responses),
        _models(results),
        _parameters(results, calibration),
        _residuals(results, runs),
        Section(
            "next", "What to record next", findings=[("", s) for s in advice(results, examinations)]
        ),
        _provenance(recordings, calibration),
    ]
    return [s for s in made if s.text or s.findings or s.figures or s.tables]


# --------------------------------------------------------------------------------- sections


def _summary(results: Mapping[str, JointCalibrationResult]) -> Section:
    return Section(
        "found",
        "What was found",
        findings=[(joint, lag_parts(r).sentence()) for joint, r in results.items()],
        notes=[
            "Naive lag: from a command's row to the position's row, as a cross-correlation of the "
            "log would measure it. Only the servo's own part belongs into a simulated actuator; "
            "stale feedback belongs into the observation.",
        ],
    )


def _lag(results: Mapping[str, JointCalibrationResult]) -> Section:
    notes = [w for r in results.values() for w in r.budget.warnings]
    picture = Picture(
        "lag_budget",
        "Lag budget: what passes between the moment a command is sent and the row in which its "
        "motion is read. The black line is the naive lag, which is the sum.",
        figures.lag_budget_figure(results),
    )
    return Section(
        "lag",
        "Lag budget",
        figures=[picture],
        tables=[tables.lag_table(results), tables.estimator_table(results)],
        notes=notes,
    )


def _doctor(
    examinations: Sequence[tuple[str, Examination]], results: Mapping[str, JointCalibrationResult]
) -> Section:
    findings = [
        (f"{recording}, {joint}", _sentences([f"{found.verdict}.", *found.reasons]))
        for recording, examination in examinations
        for joint, found in examination.joints.items()
        if joint in results
    ]
    return Section(
        "doctor",
        "Are the recordings usable?",
        findings=findings,
        tables=[tables.doctor_table(examinations, list(results))],
    )


def _sentences(texts: Sequence[str]) -> str:
    return " ".join(text[:1].upper() + text[1:] for text in texts)


def _overlays(
    results: Mapping[str, JointCalibrationResult], runs: Mapping[str, list[Track]]
) -> Section:
    pictures = [
        Picture(
            f"overlay_{joint}",
            f"{joint}: the grey steps are the readings as the log has them; the dots are the same "
            "readings at the time they were measured, and the model is judged by those.",
            figures.overlay_figure(result, runs[joint]),
        )
        for joint, result in results.items()
    ]
    return Section(
        "overlays",
        "Command, model, readings",
        text=["DelayedPD runs freely from rest: it is shown commands only, never a reading."],
        figures=pictures,
    )


def _holds(
    examinations: Sequence[tuple[str, Examination]], results: Mapping[str, JointCalibrationResult]
) -> Section:
    found = {}
    for joint, result in results.items():
        examined = [e.joints[joint] for _, e in examinations if joint in e.joints]
        if examined:
            found[joint] = hold_runs(examined, result.budget.lattice)
    if not found:
        return Section("holds", "How long readings are held")
    picture = Picture(
        "holds",
        "For how many rows in a row each reading stayed the same while its joint moved. A sensor "
        "that is read afresh each time would have all its runs at 1.",
        figures.hold_histogram_figure(found),
    )
    return Section("holds", "How long readings are held", figures=[picture])


def _bode(
    results: Mapping[str, JointCalibrationResult], responses: Mapping[str, FrequencyResponse]
) -> Section:
    pictures = []
    if responses:
        pictures.append(
            Picture(
                "bode",
                "Frequency response from the held command to the motion, from fresh readings, with "
                "90 % intervals. Hollow marks: gain of all rows, held ones included, which is too "
                "low.",
                figures.bode_figure(responses),
            )
        )
    findings = [
        (joint, f"−3 dB bandwidth {response.bandwidth_text()}.")
        for joint, response in responses.items()
    ]
    made = [tables.frequency_table(results), tables.transfer_table(responses)]
    return Section(
        "bode", "Frequency response", findings=findings, figures=pictures,
        tables=[t for t in made if t.rows],
    )  # fmt: skip


def _models(results: Mapping[str, JointCalibrationResult]) -> Section:
    misled = [
        f"On {joint} it prefers {tables.model_name(best)}."
        for joint, result in results.items()
        if (best := _best_by_naive_score(result)) != result.chosen
    ]
    return Section(
        "models",
        "Models",
        text=[
            "Errors are root mean squares of free runs. Fresh: against fresh readings when they "
            "were measured. Unseen frequency: the same on tones left out of the fit; the model "
            f"best at that is chosen ({MODEL_NAMES[PREFERRED]} where it comes within 5 %, because "
            "simulators run it). Presets are published settings, scored the same way.",
        ],
        tables=[tables.ladder_table(results)],
        notes=[
            "The naive score takes every row as if it had been measured when it was logged. Held "
            "readings then count as errors, no model can get below them, and a model with too much "
            "delay wins: do not choose by it. " + " ".join(misled),
        ],
    )


def _best_by_naive_score(result: JointCalibrationResult) -> str:
    scores = {name: r.scores.naive for name, r in result.rungs.items()}
    scores |= {name: s.naive for name, s in result.presets.items()}
    return min(scores, key=lambda name: scores[name])


def _parameters(results: Mapping[str, JointCalibrationResult], calibration: Calibration) -> Section:
    scale = calibration.joint(next(iter(results))).actuator.scale
    return Section(
        "parameters",
        "Parameters",
        text=[
            f"Torques follow from one anchor: {scale.anchor}, {scale.value_nm:g} N·m "
            f"({scale.source}). “Ratio only” means that the recording gives this number divided by "
            "the armature, and the anchor gives the rest.",
        ],
        tables=[tables.parameter_table(calibration, list(results))],
        notes=[w for r in results.values() for w in r.warnings if w not in r.budget.warnings],
    )


def _residuals(
    results: Mapping[str, JointCalibrationResult], runs: Mapping[str, list[Track]]
) -> Section:
    pictures = [
        Picture(
            f"residuals_{joint}",
            f"{joint}: above, rows taken at their own time are wrong in proportion to speed, which "
            "is the age of the reading; fresh rows are not. Below, what the model leaves of them.",
            figures.residual_figure(result, runs[joint]),
        )
        for joint, result in results.items()
    ]
    return Section("residuals", "What the model leaves unexplained", figures=pictures)


def _provenance(recordings: Sequence[Recording], calibration: Calibration) -> Section:
    rows = tuple(
        {
            "recording": r.path.name if r.path else r.name,
            "sha256": r.sha256,
            "joints": " ".join(r.joints),
            "rows": len(r.table),
            "loop_period_ms": 1e3 * r.loop_period_s,
        }
        for r in recordings
    )
    columns = (
        Column("recording", lambda row: row["recording"], "words"),
        Column("rows", lambda row: str(row["rows"])),
        Column("loop, ms", lambda row: f"{row['loop_period_ms']:.2f}"),
        Column("SHA-256", lambda row: row["sha256"], "words"),
    )
    made_with = ", ".join(f"{name} {version}" for name, version in versions().items())
    return Section(
        "provenance",
        "Where this comes from",
        text=[
            f"Calibration of {calibration.robot}, {calibration.created}, seed {calibration.seed}. "
            f"Made with {made_with}.",
        ],
        tables=[Table("recordings", "Recordings", columns, rows)],
        notes=[*(w for r in recordings for w in r.warnings), *calibration.notes],
    )


def _title(recordings: Sequence[Recording]) -> str:
    first, more = recordings[0].name, len(recordings) - 1
    return f"Servo report: {first}" + (f" and {more} more" if more else "")


def _subtitle(results: Mapping[str, JointCalibrationResult], calibration: Calibration) -> str:
    return f"{calibration.robot} · {', '.join(results)} · {calibration.created}"
