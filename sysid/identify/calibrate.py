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
from typing import TYPE_CHECKING, Any

from pupper_sysid.common.errors import refuse_outside
from pupper_sysid.common.joints import STALL_TORQUES_NM
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
from pupper_sysid.sysid.recordings.children import end_with_parent
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
    from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait

    ready: dict[str, PreparedJoint] = {}
    structures: dict[str, dict[str, StructureFit]] = {joint: {} for joint in trials}
    found: dict[str, JointCalibrationResult] = {}
    tasks: dict[Future[Any], tuple[str, str]] = {}
    with ProcessPoolExecutor(workers, initializer=end_with_parent) as pool:

        def start(joint: str, stage: str, *work: Any) -> None:
            tasks[pool.submit(*work)] = (joint, stage)

        try:
            for joint, own in trials.items():
                start(joint, "preparation", prepare_joint, joint, own, seed)
            while tasks:
                for future in wait(tasks, return_when=FIRST_COMPLETED).done:
                    joint, stage = tasks.pop(future)
                    made = future.result()
                    if staged:
                        staged(joint, stage or STAGES[-1])
                    if stage == "preparation":
                        ready[joint] = made
                        for name in SIMULATED:
                            start(joint, name, fit_structure, made, name)
                    elif stage in SIMULATED:
                        own = structures[joint]
                        own[stage] = made
                        if len(own) == len(SIMULATED):
                            start(joint, "", conclude, joint, ready[joint], own, presets)
                    else:
                        found[joint] = made
                        if progress:
                            progress(joint)
        except BaseException:  # an error, Ctrl-C: leaving the block would wait for the rest
            for worker in (pool._processes or {}).values():
                worker.kill()
            raise
    return {joint: found[joint] for joint in trials}
