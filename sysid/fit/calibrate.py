"""Calibrate the servos of a robot, from recordings to a file; or measure their lag alone.

    calibrated = calibrate(load("sweep.csv"))
    calibrated.save("calibrated.yaml")
    lags = lag(load("sweep.csv"))

Each joint is fitted by `sysid.fit.joint_fit`; `sysid.fit.calibration_file` turns the fits
into the `Calibration` that simulators read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pupper_sysid.common.errors import refuse_outside
from pupper_sysid.common.joints import STALL_TORQUES_NM
from pupper_sysid.common.processes.workers import Workers, prepare
from pupper_sysid.common.results import JointResults
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.sysid.doctor.checks import (
    Joints,
    Recordings,
    as_sequence,
    chosen_joints,
    each_joint,
    usable_trials,
)
from pupper_sysid.sysid.fit.calibration_file import preset_parameters, to_calibration
from pupper_sysid.sysid.fit.choice import Fitted, fit_structures, stages
from pupper_sysid.sysid.fit.joint_fit import Presets, conclude, joint_lag
from pupper_sysid.sysid.fit.operating_point import (
    loaded_joints,
    reference_gain,
    with_operating_points,
)
from pupper_sysid.sysid.fit.preparation import PreparedJoint, prepare_joint
from pupper_sysid.sysid.fit.results import JointCalibrationResult
from pupper_sysid.sysid.fit.servo_prior import ServoPrior, servo_prior
from pupper_sysid.sysid.fit.structure import SIMULATED
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.recordings.recording import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PREPARATION, CHOICE = "preparation", "choice"
STAGES = (PREPARATION, *SIMULATED, CHOICE)
"""Work on one joint in free air: dating its readings, a search, posterior and folds per structure,
the rest. Under load one stage, all structures, stands for those in the middle."""


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

        `path`: ends in `.yaml`. `force`: replace an existing file. Raises InputError if the file
        exists and `force` is not given, or it cannot be written.
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
    stall_torque_nm: float | None = None,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
    staged: Staged | None = None,
    prior: Calibration | Path | str | None = None,
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
        servo's data sheet, else the prior's, else the Mini Pupper's.
    workers : int
        Processes. Joints are independent, and so are the two structures of a joint.
    progress : callable, optional
        Called with a joint's name when it is done.
    staged : callable, optional
        See `Staged`.
    prior : Calibration, Path or str, optional
        Another unit of the servo: a calibration or a servo card. Its numbers are the prior of each
        joint's, so that a short recording is enough.

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
    workers = min(workers, len(chosen_joints(recordings, joints)))  # to start one takes a second
    if workers > 1:  # imports what it needs beside the look at the recordings
        prepare(__name__)
    every, presets = usable_trials(recordings, joints), preset_parameters()
    loaded = loaded_joints(every)
    free_air = {joint: joint not in loaded for joint in every}
    priors, note = _priors(prior, every)
    if workers > 1:
        fits = side_by_side(every, free_air, seed, presets, workers, progress, staged, priors)
    else:
        fits = {}
        for joint, trials in every.items():
            fits[joint] = _one_by_one(
                joint, trials, free_air[joint], seed, presets, staged, priors.get(joint)
            )
            if progress:
                progress(joint)
    calibration = to_calibration(fits, as_sequence(recordings), seed, stall_torque_nm, priors)
    calibration = with_operating_points(calibration, every)
    if note:
        calibration = calibration.model_copy(update={"notes": (*calibration.notes, note)})
    return CalibrationResult(joints=fits, calibration=calibration)


def _priors(
    prior: Calibration | Path | str | None, every: Mapping[str, Sequence[Trial]]
) -> tuple[dict[str, ServoPrior], str]:
    """The prior of each joint from another unit, and a note for the file."""
    if prior is None:
        return {}, ""
    if isinstance(prior, Calibration):
        other, source = prior, prior.robot
    else:
        other, source = load_calibration(prior), Path(prior).name
    priors = {
        joint: servo_prior(other, source, joint, reference_gain(trials).value)
        for joint, trials in every.items()
    }
    return priors, f"Numbers of {source} ({other.robot}) are the prior of these."


Staged = Callable[[str, str], None]
"""Called with a joint's name and a stage that is done."""


def _one_by_one(
    joint: str,
    trials: tuple[Trial, ...],
    free_air: bool,
    seed: int,
    presets: Presets,
    staged: Staged | None,
    prior: ServoPrior | None = None,
) -> JointCalibrationResult:
    """`fit_joint`, telling of its stages."""
    done = staged or (lambda joint, stage: None)
    ready, fitted = prepare_joint(joint, trials, seed, free_air, prior=prior), {}
    done(joint, PREPARATION)
    for stage in stages(ready):
        fitted[stage] = fit_structures(ready, stage)
        done(joint, stage)
    result = conclude(ready, fitted, presets)
    done(joint, CHOICE)
    return result


def side_by_side(
    trials: dict[str, tuple[Trial, ...]],
    free_air: dict[str, bool],
    seed: int,
    presets: Presets,
    workers: int,
    progress: Callable[[str], None] | None,
    staged: Staged | None = None,
    priors: Mapping[str, ServoPrior] | None = None,
) -> dict[str, JointCalibrationResult]:
    """`fit_joint` of every joint, its stages on several processes, so that none waits long.

    `trials`: by joint. `free_air`: whether each joint carried no load. `presets`: as for
    `fit_joint`. `workers`: processes. `progress`: called with a joint's name when it is done.
    `staged`: see `Staged`. `priors`: numbers of another unit. Raises InputError if a joint has too
    little motion; the others are not waited for.
    """
    ready: dict[str, PreparedJoint] = {}
    fitted: dict[str, dict[str, list[Fitted]]] = {joint: {} for joint in trials}
    results: dict[str, JointCalibrationResult] = {}
    with Workers(workers, __name__) as pool:
        for joint, parts in trials.items():
            prior = None if priors is None else priors.get(joint)
            pool.submit(
                (joint, PREPARATION),
                prepare_joint,
                joint,
                parts,
                seed,
                free_air[joint],
                None,
                prior,
            )
        for (joint, stage), result in pool.results():
            if staged:  # before `progress`, which ends the joint
                staged(joint, stage)
            if stage == PREPARATION:
                ready[joint] = result
                for name in stages(result):
                    pool.submit((joint, name), fit_structures, result, name)
            elif stage == CHOICE:
                results[joint] = result
                if progress:
                    progress(joint)
            else:
                fits = fitted[joint]
                fits[stage] = result
                if len(fits) == len(stages(ready[joint])):
                    # in their order, not in that of their ends
                    fits = {name: fits[name] for name in stages(ready[joint])}
                    pool.submit((joint, CHOICE), conclude, ready[joint], fits, presets)
    return {joint: results[joint] for joint in trials}


@dataclass(frozen=True, kw_only=True, eq=False)
class LagBudgets(JointResults[LagBudget]):
    """Lag budgets by joint."""

    def plot(self) -> Figure:
        """One stacked bar per joint."""
        from pupper_sysid.sysid.report.figures import lag_budget_figure

        return lag_budget_figure(self)


def lag(
    recordings: Recordings,
    joints: Joints = None,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> LagBudgets:
    """Measure the lag of every joint: stale readings, command hold, dead time and dynamics.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Trials of one joint are pooled.
    joints : str or sequence of str, optional
        Which joints; by default all that were recorded.
    seed : int
        Of the bootstrap and of the model's global start.
    workers : int
        Processes.
    progress : callable, optional
        Called with a joint's name when it is done.

    Returns
    -------
    LagBudgets
        Lag budget by joint.

    Raises
    ------
    InputError
        If a joint has too little motion.

    Examples
    --------
    >>> from pupper_sysid.sysid.recordings.files import load
    >>> found = lag(load("data/samples/sweep.csv"), "LF_hip")  # doctest: +SKIP
    >>> found["LF_hip"].dead_time_s  # doctest: +SKIP
    Interval(value=0.0249, low=0.0233, high=0.0263)
    """
    work = partial(joint_lag, seed=seed)
    return LagBudgets(joints=each_joint(work, recordings, joints, workers, progress))
