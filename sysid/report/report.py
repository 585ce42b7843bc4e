"""Report: all findings about a robot's servos as one page that opens anywhere.

`write_report` examines and calibrates recordings and makes a folder with `report.html`, its figures
as PNG and SVG, and its tables as CSV (`common.page`). `write_findings` makes the page of findings
that were computed elsewhere.

Results of a calibration are read from its file, without fitting again. The file holds each
candidate model's numbers, and the intervals of those that simulators run. The readings are dated
with the calibrated motion, so free runs and scores come out as they did.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.page import WrittenPage, write_page
from pupper_sysid.servo_models.calibration.calibration import Calibration, is_shipped
from pupper_sysid.servo_models.calibration.parts import CandidateModel, JointCalibration
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.sysid.doctor import checks
from pupper_sysid.sysid.doctor.checks import Joints, Recordings
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.fit.calibration_file import preset_parameters
from pupper_sysid.sysid.fit.joint_fit import score_preset
from pupper_sysid.sysid.fit.preparation import PreparedJoint, prepare_joint
from pupper_sysid.sysid.fit.results import CandidateFit, JointCalibrationResult
from pupper_sysid.sysid.fit.run import free_run
from pupper_sysid.sysid.fit.scores import Scores, score
from pupper_sysid.sysid.fit.structure import SIMULATED
from pupper_sysid.sysid.fit.structure import candidate as structure
from pupper_sysid.sysid.lag.frequency_response import joint_response
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.report.sections import Findings, sections

if TYPE_CHECKING:
    from pupper_sysid.sysid.servo_fit.fit import ServoFit

PAGE = "report.html"


def write_report(
    recordings: Recordings,
    folder: Path | str,
    *,
    joints: Joints = None,
    calibration: Calibration | None = None,
    models: Sequence[str | Path | Calibration | ServoFit] = (),
    seed: int = 0,
    workers: int = 1,
    force: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> WrittenPage:
    """Examine and calibrate recordings, and write all findings as a page.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Pooled per joint.
    folder : Path or str
        Made if missing; gets `report.html`, `figures/*.png`, `figures/*.svg` and `tables/*.csv`.
    joints : str or sequence of str, optional
        By default all that were recorded, and are in the calibration if one is given.
    calibration : Calibration, optional
        Made from these recordings: its numbers are shown and its seed is used, and nothing is
        fitted again but joints under load, whose fits the file does not hold. By default the
        recordings are calibrated.
    models : sequence of str, Path, Calibration or ServoFit
        Servo models to compare on the recordings, as in `sysid.compare.compare`.
    seed : int
        Of the bootstrap and of the models' global starts.
    workers : int
        Processes that calibrate.
    force : bool
        Replace files that exist.
    progress : callable, optional
        Called with the name of the present work and the share of it that is done.

    Returns
    -------
    WrittenPage
        Names of the files.

    Raises
    ------
    InputError
        If one of the files exists and `force` is not given (nothing has been written then), if one
        cannot be written, or if the calibration was made from other recordings.
    """
    from pupper_sysid.sysid.doctor.examination import examine

    refuse_overwrite(Path(folder) / PAGE, force)  # before the work, not after it
    recordings, names = checks.as_sequence(recordings), checks.chosen_joints(recordings, joints)
    if calibration is not None:
        if joints in (None, "all"):
            names = [name for name in names if name in calibration.joints] or names
        if {i.sha256 for i in calibration.inputs} != {r.sha256 for r in recordings}:
            made_from = ", ".join(i.name for i in calibration.inputs) or "no recording"
            raise InputError(
                f"The calibration was made from {made_from}, which is not, byte for byte, "
                f"{', '.join(r.name for r in recordings)}. Give its own recordings, or leave "
                "`calibration` out."
            )
        for name in names:
            calibration.joint(name)  # refuses one that it does not have
        seed = seed if calibration.seed is None else calibration.seed
    steps, done = 2 * len(names), 0

    def advance(what: str) -> None:
        nonlocal done
        done += 1
        if progress:
            progress(what, done / steps)

    for model in models:  # before the work, not after it
        named = isinstance(model, str | Path) and not is_shipped(model)
        if named and not Path(str(model)).exists():
            raise InputError(f"`servo` is {model}: there is no such servo model, file or folder.")
    results: dict[str, JointCalibrationResult] = {}
    if calibration is not None:
        if known := [name for name in names if can_recall(calibration.joint(name))]:
            results = recall(calibration, recordings, known, advance)
    if missing := [name for name in names if name not in results]:
        fitted = calibrate(recordings, missing, seed, workers=workers, progress=advance)
        calibration = calibration or fitted.calibration
        results |= fitted.joints
    assert calibration is not None
    results = {name: results[name] for name in names}
    responses = {}
    lags = {joint: result.lag for joint, result in results.items()}
    examined = examine(recordings, names, seed=seed, lags=lags)
    for joint, result in results.items():
        if result.lag.by_frequency:
            trials, rng = checks.joint_trials(recordings, joint), checks.joint_rng(seed, joint)
            responses[joint] = joint_response(joint, trials, rng, result.lag.feedback)
        advance(joint)
    comparison = None
    if models:
        from pupper_sysid.sysid.compare.compare import compare  # brings torch

        lattices = {joint: lag.feedback for joint, lag in lags.items()}
        comparison = compare(recordings, models, names, seed=seed, lattices=lattices)
    findings = Findings(
        recordings=recordings, results=results, calibration=calibration, responses=responses,
        examinations=((examined.recording, examined),), comparison=comparison,
    )  # fmt: skip
    return write_findings(findings, Path(folder), force)


def write_findings(findings: Findings, folder: Path, force: bool = False) -> WrittenPage:
    """Write the page of findings, its figures and its tables; errors as for `write_page`."""
    more = len(findings.recordings) - 1
    title = f"Servo report: {findings.recordings[0].name}" + (f" and {more} more" if more else "")
    calibration = findings.calibration
    subtitle = f"{calibration.robot} · {', '.join(findings.results)} · {calibration.created}"
    return write_page(folder / PAGE, title, subtitle, sections(findings), force)


def can_recall(joint: JointCalibration) -> bool:
    """Whether the file holds all of a joint's fits: those of servos under load it does not."""
    return joint.servo is None and _carried(joint) in {
        candidate.model for candidate in joint.selection.candidate_models
    }


def recall(
    calibration: Calibration,
    recordings: Recordings,
    joints: Sequence[str],
    progress: Callable[[str], None] | None = None,
) -> dict[str, JointCalibrationResult]:
    """Results by joint, as `sysid.fit.calibrate.calibrate` made them from these recordings.

    `can_recall` holds for all `joints`. Intervals are those of the file: of the model that
    simulators run. Errors by left-out frequency are not in the file; the error over all of them is.
    """
    results = {}
    for name, trials in checks.usable_trials(recordings, joints).items():
        results[name] = _joint(name, calibration.joint(name), trials, calibration.seed or 0)
        if progress:
            progress(name)
    return results


def _joint(
    name: str, known: JointCalibration, trials: tuple[Trial, ...], seed: int
) -> JointCalibrationResult:
    values = {
        c.model: np.array([c.parameters[parameter] for parameter in structure(c.model).names])
        for c in known.selection.candidate_models
    }
    exported, a = _carried(known), known.actuator
    ready = prepare_joint(name, trials, seed, True, {exported: values[exported]})
    fits = {
        c.model: _fit(c, values[c.model], ready, known if c.model == exported else None)
        for c in known.selection.candidate_models
    }
    presets = {n: joints[name] for n, joints in preset_parameters().items() if name in joints}
    return JointCalibrationResult(
        joint=name,
        model=known.selection.model,
        simulated_model=exported,
        structure_nats={exported: 0.0},
        command_jitter_s=a.command_jitter_s.interval,
        candidate_models=fits,
        lag=_lag(ready.lag, known),
        presets={n: score_preset(parameters, ready.runs) for n, parameters in presets.items()},
        warnings=known.warnings,
        runs=ready.runs,
    )


def _lag(measured: LagBudget, known: JointCalibration) -> LagBudget:
    """The lag budget with the numbers of the file: other dates move the last digits."""
    stated_lag = known.lag
    lags = {
        name: getattr(measured, name) if (q := getattr(stated_lag, name)) is None else q.interval
        for name in ("lag_s", "raw_lag_s", "fresh_lag_s")
    }
    lattice = measured.feedback
    if lattice.kind == "lattice":
        poll = known.feedback
        loss = math.nan if poll.loss.identified == "no" else poll.loss.value
        lattice = replace(lattice, poll_period_s=poll.poll_period_s.value, loss=loss)
    stated = {getattr(measured, name).value: lag.value for name, lag in lags.items()}
    budget = replace(
        measured,
        **lags,
        estimators_s={n: stated.get(lag, lag) for n, lag in measured.estimators_s.items()},
        stale_lag_s=lags["raw_lag_s"].value - lags["fresh_lag_s"].value,
        command_hold_s=lags["fresh_lag_s"].value - lags["lag_s"].value,
        feedback=lattice,
    )
    dead_time = known.actuator.dead_time_s.interval
    return budget.with_dead_time(dead_time, known.feedback.offset_rad.value)


def _carried(joint: JointCalibration) -> str:
    """The model that simulators run: DelayedPD by either limit of its speed."""
    return SIMULATED[joint.actuator.back_emf_nm_s_per_rad.value > 0]


def _fit(
    candidate: CandidateModel,
    values: np.ndarray,
    ready: PreparedJoint,
    exported: JointCalibration | None,
) -> CandidateFit:
    """One candidate model; `exported` is the joint if simulators run this one."""
    model, quantities = structure(candidate.model), dict[str, Quantity]()
    if exported is not None:
        offset = {"offset_rad": exported.feedback.offset_rad}
        quantities = exported.actuator.per_inertia | offset
    parameters = {
        name: quantities[name].model_copy(update={"value": value}).interval
        if name in quantities
        else Interval(value, value, value)
        for name, value in candidate.parameters.items()
    }
    scores = score(free_run(model, values, ready.runs), ready.runs)
    names = {f.name for f in fields(Scores)} & set(type(candidate).model_fields)
    in_file = {n: math.nan if (x := getattr(candidate, n)) is None else x for n in names}
    undecided = {
        name: quantity.why or ""
        for name, quantity in quantities.items()
        if name in parameters and quantity.identified == "no"
    }
    return CandidateFit(
        model=candidate.model, parameters=parameters, undecided=undecided,
        scores=replace(scores, **in_file),
    )  # fmt: skip
