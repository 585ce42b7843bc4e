"""Calibrate the servos of a robot: `calibrate`, from recordings to a calibration file.

    calibrated = calibrate(load("sweep.csv"))
    calibrated.save("calibrated.yaml")

Each joint is fitted by `sysid.identify.joint_fit`; `sysid.identify.calibration_file` turns the fits
into the `Calibration` that simulators read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pupper_sysid.common.errors import refuse_outside
from pupper_sysid.common.joints import STALL_TORQUES_NM
from pupper_sysid.common.processes.workers import Workers, prepare
from pupper_sysid.common.results import JointResults
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.sysid.identify.calibration_file import (
    preset_parameters,
    to_calibration,
    torque_anchors,
)
from pupper_sysid.sysid.identify.joint_fit import (
    Presets,
    StructureFit,
    conclude,
    fit_structure,
)
from pupper_sysid.sysid.identify.preparation import PreparedJoint, prepare_joint
from pupper_sysid.sysid.identify.results import JointCalibrationResult
from pupper_sysid.sysid.identify.search import SIMULATED
from pupper_sysid.sysid.loaded.calibrate import fit_joints, loaded_joints, with_loaded
from pupper_sysid.sysid.recordings.joints import Joints, Recordings, as_sequence, usable_trials
from pupper_sysid.sysid.recordings.recording import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STAGES = ("preparation", *SIMULATED, "choice")
"""Work on one joint: dating its readings, a search, posterior and folds per structure, the rest."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationResult(JointResults[JointCalibrationResult]):
    """Calibration of a robot: the fits by joint, and the file that simulators read.

    Attributes
    ----------
    joints : dict of str to JointCalibrationResult
    calibration : Calibration
        DelayedPD and HeldFeedback per joint.
    """

    calibration: Calibration

    def save(self, path: Path | str, force: bool = False) -> None:
        """Write the calibration file.

        Parameters
        ----------
        path : Path or str
            Ends in `.yaml`.
        force : bool
            Replace an existing file.

        Raises
        ------
        InputError
            If the file exists and `force` is not given, or it cannot be written.
        """
        self.calibration.save(path, force=force)

    def plot(self) -> Figure:
        """Command, DelayedPD and readings of the first joint; `overlay_figure` draws the others."""
        from pupper_sysid.sysid.report.free_run_figures import overlay_figure

        return overlay_figure(next(iter(self.values())))


def calibrate(
    recordings: Recordings,
    joints: Joints = None,
    seed: int = 0,
    stall_torque_nm: float | None = None,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
    staged: Callable[[str, str], None] | None = None,
) -> CalibrationResult:
    """Calibrate every joint of the recordings.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Trials of one joint are pooled.
    joints : str or sequence of str, optional
        Which joints; by default all that were recorded.
    seed : int
        Results of a joint depend on the seed and its name alone, not on the other joints.
    stall_torque_nm : float, optional
        Torque anchor [N·m]: the servo's torque at zero speed; by default that of the recorded
        servo's data sheet, or of the Mini Pupper's servo.
    workers : int
        Processes. Joints are independent, and so are the two structures of a joint.
    progress : callable, optional
        Called with a joint's name when it is done.
    staged : callable, optional
        Called with a joint's name and one of `STAGES` when that is done.

    Returns
    -------
    CalibrationResult
        Fits by joint, and the calibration.

    Raises
    ------
    InputError
        If a joint has too little motion, or `stall_torque_nm` is no servo's.
    """
    if stall_torque_nm is not None:  # before the work, not after it
        refuse_outside("`stall_torque_nm`", stall_torque_nm, *STALL_TORQUES_NM, "N·m")
    if workers > 1:  # imports what it needs beside the look at the recordings
        prepare(__name__)
    every, presets = usable_trials(recordings, joints), preset_parameters()
    loaded = {joint: every[joint] for joint in loaded_joints(every)}
    trials = {joint: own for joint, own in every.items() if joint not in loaded}
    if workers > 1 and len(trials) > 1:  # of one joint, a second process costs what it saves
        fits = side_by_side(trials, seed, presets, workers, progress, staged)
    else:
        fits = {}
        for joint, own in trials.items():
            fits[joint] = _one_by_one(joint, own, seed, presets, staged)
            if progress:
                progress(joint)
    fits |= fit_joints(loaded, seed, workers, progress)
    fits = {joint: fits[joint] for joint in every}
    given = as_sequence(recordings)
    made = to_calibration(fits, given, seed, stall_torque_nm)
    made = with_loaded(made, fits, torque_anchors(list(fits), given, stall_torque_nm))
    return CalibrationResult(joints=fits, calibration=made)


def _one_by_one(
    joint: str,
    trials: tuple[Trial, ...],
    seed: int,
    presets: Presets,
    staged: Callable[[str, str], None] | None,
) -> JointCalibrationResult:
    """`fit_joint`, telling of its stages."""
    done = staged or (lambda joint, stage: None)
    ready, structures = prepare_joint(joint, trials, seed), {}
    done(joint, STAGES[0])
    for name in SIMULATED:
        structures[name] = fit_structure(ready, name)
        done(joint, name)
    made = conclude(joint, ready, structures, presets)
    done(joint, STAGES[-1])
    return made


def side_by_side(
    trials: dict[str, tuple[Trial, ...]],
    seed: int,
    presets: Presets,
    workers: int,
    progress: Callable[[str], None] | None,
    staged: Callable[[str, str], None] | None = None,
) -> dict[str, JointCalibrationResult]:
    """`fit_joint` of every joint, its stages on several processes, so that none waits long.

    Parameters
    ----------
    trials : dict of str to tuple of Trial
        By joint.
    seed : int
    presets : dict
        As for `fit_joint`.
    workers : int
        Processes.
    progress : callable or None
        Called with a joint's name when it is done.
    staged : callable or None
        Called with a joint's name and one of `STAGES` when that is done.

    Raises
    ------
    InputError
        If a joint has too little motion; the others are not waited for.
    """
    ready: dict[str, PreparedJoint] = {}
    structures: dict[str, dict[str, StructureFit]] = {joint: {} for joint in trials}
    results: dict[str, JointCalibrationResult] = {}
    with Workers(workers, __name__) as pool:
        for joint, own in trials.items():
            pool.submit((joint, STAGES[0]), prepare_joint, joint, own, seed)
        for (joint, stage), result in pool.results():
            if staged:
                staged(joint, stage)
            if stage == STAGES[0]:
                ready[joint] = result
                for name in SIMULATED:
                    pool.submit((joint, name), fit_structure, result, name)
            elif stage in SIMULATED:
                fits = structures[joint]
                fits[stage] = result
                if len(fits) == len(SIMULATED):
                    pool.submit((joint, STAGES[-1]), conclude, joint, ready[joint], fits, presets)
            else:
                results[joint] = result
                if progress:
                    progress(joint)
    return {joint: results[joint] for joint in trials}
