"""Calibrate the servos of a robot: `calibrate`, from recordings to a calibration file.

    calibrated = calibrate(load("sweep.csv"))
    calibrated.save("calibrated.yaml")

Each joint is fitted by `sysid.identify.joint_fit`; `sysid.identify.calibration_file` turns the fits
into the `Calibration` that simulators read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pupper_sysid.common.joints import STALL_TORQUE_NM, STALL_TORQUE_SOURCE
from pupper_sysid.common.results import JointResults
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.sysid.identify.calibration_file import preset_parameters, to_calibration
from pupper_sysid.sysid.identify.joint_fit import JointCalibrationResult, fit_joint
from pupper_sysid.sysid.recordings.joints import Joints, Recordings, as_sequence, each_joint

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
        from pupper_sysid.sysid.report.figures import overlay_figure

        return overlay_figure(next(iter(self.values())))


def calibrate(
    recordings: Recordings,
    joints: Joints = None,
    seed: int = 0,
    stall_torque_nm: float = STALL_TORQUE_NM,
    source: str = STALL_TORQUE_SOURCE,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
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
    stall_torque_nm : float
        Torque anchor [N·m]: the servo's torque at zero speed.
    source : str
        Where the anchor comes from.
    workers : int
        Processes; joints are independent.
    progress : callable, optional
        Called with a joint's name when it is done.

    Returns
    -------
    CalibrationResult
        Fits by joint, and the calibration.

    Raises
    ------
    InputError
        If a joint has too little motion.
    """
    work = partial(fit_joint, seed=seed, presets=preset_parameters())
    fits = each_joint(work, recordings, joints, workers, progress)
    made = to_calibration(fits, as_sequence(recordings), seed, stall_torque_nm, source)
    return CalibrationResult(joints=fits, calibration=made)
