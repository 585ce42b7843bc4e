"""Report: all findings about a robot's servos as one page that opens anywhere.

`write_report` examines and calibrates recordings and makes a folder with `report.html`, its figures
as PNG and SVG, and its tables as CSV (`common.page`). `write_findings` makes the page of findings
that were computed elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite
from pupper_sysid.common.page import WrittenPage, write_page
from pupper_sysid.servo_models.calibration.calibration import Calibration, is_shipped
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.fit.results import JointCalibrationResult
from pupper_sysid.sysid.recordings.joints import (
    Joints,
    Recordings,
    as_sequence,
    chosen_joints,
    joint_rng,
    joint_trials,
)
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.report.recall import can_recall, recall
from pupper_sysid.sysid.report.sections import Findings, sections

if TYPE_CHECKING:  # they bring libraries that a page does not need
    from pupper_sysid.sysid.servo_fit.result import ServoFit

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
        By default all that were recorded.
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
    from pupper_sysid.sysid.lag.joint_response import joint_response

    refuse_overwrite(Path(folder) / PAGE, force)  # before the work, not after it
    recordings, names = as_sequence(recordings), chosen_joints(recordings, joints)
    if calibration is not None:
        _refuse_foreign(calibration, recordings, names)
        seed = seed if calibration.seed is None else calibration.seed
    steps, done = 2 * len(names), 0

    def advance(what: str) -> None:
        nonlocal done
        done += 1
        if progress:
            progress(what, done / steps)

    for given in models:  # before the work, not after it
        named = isinstance(given, str | Path) and not is_shipped(given)
        if named and not Path(given).exists():
            raise InputError(f"`servo` is {given}: there is no such servo model, file or folder.")
    results: dict[str, JointCalibrationResult] = {}
    if calibration is not None:
        known = [name for name in names if can_recall(calibration.joint(name))]
        results = recall(calibration, recordings, known, advance)
    if left := [name for name in names if name not in results]:
        fitted = calibrate(recordings, left, seed, workers=workers, progress=advance)
        calibration = calibration or fitted.calibration
        results |= fitted.joints
    assert calibration is not None
    results = {name: results[name] for name in names}
    examinations, responses = [], {}
    lags = {joint: result.lag for joint, result in results.items()}
    examined = examine(recordings, names, seed=seed, lags=lags)
    examinations.append((examined.recording, examined))
    for joint, result in results.items():
        if result.lag.by_frequency:
            trials, rng = joint_trials(recordings, joint), joint_rng(seed, joint)
            responses[joint] = joint_response(joint, trials, rng, result.lag.feedback)
        advance(joint)
    comparison = None
    if models:
        from pupper_sysid.sysid.compare.compare import compare  # brings torch

        lattices = {joint: lag.feedback for joint, lag in lags.items()}
        comparison = compare(recordings, models, names, seed=seed, lattices=lattices)
    found = Findings(
        recordings=recordings, results=results, examinations=examinations, responses=responses,
        calibration=calibration, comparison=comparison,
    )  # fmt: skip
    return write_findings(found, Path(folder), force)


def write_findings(found: Findings, folder: Path, force: bool = False) -> WrittenPage:
    """Write the page of findings, its figures and its tables; errors as for `write_page`."""
    more = len(found.recordings) - 1
    title = f"Servo report: {found.recordings[0].name}" + (f" and {more} more" if more else "")
    made = found.calibration
    subtitle = f"{made.robot} · {', '.join(found.results)} · {made.created}"
    return write_page(folder / PAGE, title, subtitle, sections(found), force)


def _refuse_foreign(
    calibration: Calibration, recordings: Sequence[Recording], joints: Sequence[str]
) -> None:
    """Refuse a calibration of other recordings or without one of the joints."""
    if {i.sha256 for i in calibration.inputs} != {r.sha256 for r in recordings}:
        made_from = ", ".join(i.name for i in calibration.inputs) or "no recording"
        raise InputError(
            f"The calibration was made from {made_from}, which is not, byte for byte, "
            f"{', '.join(r.name for r in recordings)}. Give its own recordings, or leave "
            "`calibration` out."
        )
    for joint in joints:
        calibration.joint(joint)
