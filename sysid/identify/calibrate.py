"""From recordings to a servo model per joint: fit the ladder, choose, and say what is known.

For each joint the rungs of `sysid.identify.models` are fitted to fresh readings by output error,
from seeded global starts, and judged by leaving one frequency out: the model that predicts tones it
has not seen is chosen (`DelayedPD` where it is within 5 % of the best, because that is the model
training runs). The dead time's interval is a profile likelihood: how much worse does the best fit
become when the delay is held elsewhere? Residuals of a real servo are not white, so the likelihood
is counted in effective, not in nominal, samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any
from zlib import crc32

import numpy as np
from scipy.special import ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.joints import JOINT_NAMES, in_order
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPDParameters, whole_steps
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice, quantum, readings
from pupper_sysid.sysid.identify.models import LADDER, Rung, rung
from pupper_sysid.sysid.identify.output_error import Fit, TrialData, positions, prepare
from pupper_sysid.sysid.identify.scores import Scores, rms, score
from pupper_sysid.sysid.identify.search import (
    PREFERRED,
    dead_time_profile,
    fit_with_folds,
    fresh_residuals,
    integrated_autocorrelation_time,
    leave_one_out_folds,
)
from pupper_sysid.sysid.lag.lag_budget import LagBudget, lag_budget
from pupper_sysid.sysid.recordings.recording import Recording, Trial

_PREFERENCE = 1.05


@dataclass(frozen=True)
class RungResult:
    """One model of the ladder, fitted to one joint."""

    name: str
    values: dict[str, float]
    intervals: dict[str, Interval]
    undecided: dict[str, str]
    """Parameters the data do not settle, each with the reason."""
    scores: Scores


@dataclass(frozen=True)
class JointCalibrationResult:
    """Everything found about one joint.

    Attributes
    ----------
    chosen : str
        Name of the rung that predicts unseen frequencies best.
    rungs : dict of str to RungResult
    dead_time : Interval
        Delay of DelayedPD with its profile-likelihood interval [s].
    budget : LagBudget
    quantum_rad, offset_rad : float
    presets : dict of str to Scores
        Published settings, scored the same way.
    trials : tuple of TrialData
        What the fit saw; for pictures.
    """

    joint: str
    chosen: str
    rungs: dict[str, RungResult]
    dead_time: Interval
    budget: LagBudget
    quantum_rad: float
    offset_rad: Interval
    presets: dict[str, Scores]
    trials: tuple[TrialData, ...]
    warnings: tuple[str, ...]

    @property
    def delay_steps(self) -> tuple[int, int]:
        """Dead-time interval in whole physics steps, rounded outward."""
        return whole_steps(self.dead_time.low, self.dead_time.high, TIME_STEP_S)


@dataclass(frozen=True)
class DeadTime:
    """The lag budget of one joint and the part of it that is dead time."""

    budget: LagBudget
    dead_time: Interval
    quantum_rad: float
    offset_rad: float


@dataclass(frozen=True)
class _Task:
    joint: str
    trials: tuple[Trial, ...]
    seed: int
    presets: dict[str, DelayedPDParameters]


def calibrate(
    recordings: Sequence[Recording],
    joints: Sequence[str] | None = None,
    seed: int = 0,
    presets: dict[str, dict[str, DelayedPDParameters]] | None = None,
    workers: int = 2,
    progress: Callable[[str], None] | None = None,
) -> dict[str, JointCalibrationResult]:
    """Calibrate every joint of the recordings.

    Parameters
    ----------
    recordings : sequence of Recording
        Trials of one joint are pooled over all of them.
    joints : sequence of str, optional
        Which joints; by default all that were recorded.
    seed : int
        Results of a joint depend on the seed and its name alone, not on the other joints.
    presets : dict of str to (dict of joint to DelayedPDParameters), optional
        Published settings to score beside the fit.
    workers : int
        Processes; joints are independent.
    progress : callable, optional
        Called with a joint's name when it is done.

    Raises
    ------
    InputError
        If a joint has too little motion to say anything.
    """
    return _each_joint(_calibrate_joint, recordings, joints, seed, presets, workers, progress)


def dead_times(
    recordings: Sequence[Recording],
    joints: Sequence[str] | None = None,
    seed: int = 0,
    workers: int = 2,
    progress: Callable[[str], None] | None = None,
) -> dict[str, DeadTime]:
    """Lag budget and dead time of every joint, without the rest of the ladder.

    Parameters and errors as for `calibrate`.
    """
    return _each_joint(_dead_time, recordings, joints, seed, None, workers, progress)


def prepare_joints(
    recordings: Sequence[Recording],
    joints: Sequence[str] | None = None,
    seed: int = 0,
    workers: int = 2,
) -> dict[str, PreparedJoint]:
    """Every joint's trials on the physics clock, and the noise of its readings; nothing fitted.

    Parameters and errors as for `calibrate`.
    """
    return _each_joint(_prepare, recordings, joints, seed, None, workers, None)


def _each_joint(
    work: Callable[[_Task], Any],
    recordings: Sequence[Recording],
    joints: Sequence[str] | None,
    seed: int,
    presets: dict[str, dict[str, DelayedPDParameters]] | None,
    workers: int,
    progress: Callable[[str], None] | None,
) -> dict[str, Any]:
    """`work` on each joint, in processes; results in joint order."""
    chosen = in_order(j for r in recordings for j in r.joints if joints is None or j in joints)
    tasks = []
    for joint in chosen:
        own = {name: table[joint] for name, table in (presets or {}).items() if joint in table}
        tasks.append(_Task(joint, joint_trials(recordings, joint), seed, own))
    found: dict[str, Any] = {}
    if workers <= 1 or len(tasks) <= 1:
        for task in tasks:
            found[task.joint] = work(task)
            if progress:
                progress(task.joint)
    else:
        with ProcessPoolExecutor(min(workers, len(tasks))) as pool:
            futures = {pool.submit(work, task): task.joint for task in tasks}
            for future in as_completed(futures):
                found[futures[future]] = future.result()
                if progress:
                    progress(futures[future])
    return {joint: found[joint] for joint in chosen}


def joint_trials(recordings: Sequence[Recording], joint: str) -> tuple[Trial, ...]:
    """All trials of `joint`, renumbered."""
    trials = [trial for recording in recordings for trial in recording.trials(joint)]
    return tuple(replace(trial, number=n) for n, trial in enumerate(trials))


def joint_rng(seed: int, joint: str) -> np.random.Generator:
    """Generator of one joint: repeatable whatever other joints are computed."""
    place = JOINT_NAMES.index(joint) if joint in JOINT_NAMES else crc32(joint.encode())
    return np.random.default_rng([seed, place])


@dataclass(frozen=True)
class PreparedJoint:
    """One joint, measured and ready to fit."""

    rng: np.random.Generator
    budget: LagBudget
    data: tuple[TrialData, ...]
    quantum_rad: float
    noise_rad: float

    def fit_rng(self) -> np.random.Generator:
        """The same generator for every fit, so that a fit does not depend on those before it."""
        return deepcopy(self.rng)


def _prepare(task: _Task) -> PreparedJoint:
    rng = joint_rng(task.seed, task.joint)
    lattice = find_poll_lattice(task.trials, rng.spawn(1)[0])
    budget = lag_budget(task.joint, task.trials, rng, lattice)
    data = tuple(prepare(t, readings(t, lattice)) for t in task.trials)
    data = tuple(d for d in data if len(d.sample_step))
    step = quantum(task.trials)
    # fits of a noise-free servo still meet rounding: a third of a count
    noise = max(budget.noise_rad, step / 3, 1e-4) if np.isfinite(budget.noise_rad) else 0.012
    return PreparedJoint(rng, budget, data, step, noise)


def _dead_time(task: _Task) -> DeadTime:
    ready, model = _prepare(task), rung(PREFERRED)
    (best,) = fit_with_folds(model, ready.data, {}, ready.noise_rad, ready.fit_rng(), {})
    dead_time, best = dead_time_profile(model, ready.data, ready.noise_rad, best)
    return DeadTime(ready.budget, dead_time, ready.quantum_rad, float(best.values[-1]))


def _calibrate_joint(task: _Task) -> JointCalibrationResult:
    ready = _prepare(task)
    data, noise, folds = ready.data, ready.noise_rad, leave_one_out_folds(ready.data)
    rungs: dict[str, RungResult] = {}
    best: dict[str, list[Fit]] = {}
    dead_time = Interval(*[float("nan")] * 3)
    for model in LADDER:
        best[model.name] = fit_with_folds(model, data, folds, noise, ready.fit_rng(), best)
        if model.name == PREFERRED:
            dead_time, best[PREFERRED][0] = dead_time_profile(
                model, data, noise, best[PREFERRED][0]
            )
        rungs[model.name] = _result(model, best[model.name], data, folds, noise)
    chosen = _choose(rungs)
    pd = rungs[PREFERRED]
    presets = {
        name: _score_preset(p, data, pd.values["offset_rad"]) for name, p in task.presets.items()
    }
    warnings = [*ready.budget.warnings, *_warnings(task.joint, rungs, chosen)]
    return JointCalibrationResult(
        task.joint, chosen, rungs, dead_time, ready.budget, ready.quantum_rad,
        pd.intervals["offset_rad"], presets, data, tuple(warnings),
    )  # fmt: skip


# ------------------------------------------------------------------------------- scoring


def _score_preset(
    parameters: DelayedPDParameters, data: tuple[TrialData, ...], offset_rad: float
) -> Scores:
    one = parameters.per_inertia()
    parts = (one.dead_time_s, one.stiffness, one.damping, one.friction_loss, one.effort_limit,
             one.velocity_limit, offset_rad)  # fmt: skip
    values = np.array([np.asarray(part, float).item() for part in parts])
    return score(positions(rung(PREFERRED), [(values[None], data)])[0][:, 0], data, {})


def _result(
    model: Rung,
    fits: list[Fit],
    data: tuple[TrialData, ...],
    folds: dict[float, tuple[bool, ...]],
    noise: float,
) -> RungResult:
    best = fits[0]
    held_out = {}
    for (name, use), fold in zip(folds.items(), fits[1:], strict=True):
        left = tuple(d for d, used in zip(data, use, strict=True) if not used)
        held_out[name] = np.concatenate(fresh_residuals(model, fold.values, left))
    residual = fresh_residuals(model, best.values, data)
    # soft-L1 works in units of the noise; its covariance is for residuals of that size
    inflation = integrated_autocorrelation_time(residual) * max(1.0, rms(residual) ** 2 / noise**2)
    sd = np.sqrt(np.maximum(np.diag(best.covariance) * inflation, 0.0))
    z = ndtri((1 + LEVEL) / 2)
    speed = max(_command_speed(d) for d in data)
    values, intervals, undecided = {}, {}, {}
    for j, p in enumerate(model.parameters):
        value = float(best.values[j])
        centre = float(p.encode(value))
        around = np.clip(
            [centre - z * sd[j], centre + z * sd[j]], p.encode(p.low), p.encode(p.high)
        )
        ends = [float(p.decode(c)) for c in around]
        values[p.name] = value
        intervals[p.name] = Interval(value, ends[0], ends[1])
        if (
            p.name.endswith("_rad_s")
            and p.name != "natural_frequency_rad_s"
            and speed < 0.8 * value
        ):
            undecided[p.name] = (
                f"commands reach {speed:.1f} rad/s only, so it was never felt in full"
            )
        elif p.logarithmic and (value <= p.low * 1.01 or value >= p.high / 1.01):
            undecided[p.name] = (
                f"it sits on its bound {p.low if value <= p.low * 1.01 else p.high:g}"
            )
        elif np.sqrt(best.covariance[j, j]) > 0.7 * p.prior_sd:
            undecided[p.name] = "these recordings do not excite it; the value is the prior's"
        elif p.logarithmic and sd[j] > 0.5:
            undecided[p.name] = "its interval is wider than a factor of two"
    scores = score(positions(model, [(best.values[None], data)])[0][:, 0], data, held_out)
    return RungResult(model.name, values, intervals, undecided, scores)


def _choose(rungs: dict[str, RungResult]) -> str:
    """The rung with the smallest leave-one-out error; DelayedPD where it is as good."""
    errors = {name: r.scores.leave_one_out for name, r in rungs.items()}
    if not np.isfinite(list(errors.values())).all():
        return PREFERRED  # nothing to judge by: the model that training runs
    best = min(errors, key=lambda name: errors[name])
    return PREFERRED if errors[PREFERRED] <= _PREFERENCE * errors[best] else best


def _warnings(joint: str, rungs: dict[str, RungResult], chosen: str) -> list[str]:
    pd = rungs[PREFERRED]
    said = []
    if "velocity_limit_rad_s" in pd.undecided:
        said.append(
            f"{joint}: the speed limit was not excited: "
            f"{pd.undecided['velocity_limit_rad_s']}. Record a faster tone or a step."
        )
    for name in ("effort_rad_s2", "friction_rad_s2", "stiffness_per_s2", "damping_per_s"):
        if name in pd.undecided:
            said.append(f"{joint}: {name.split('_')[0]} is not identified: {pd.undecided[name]}.")
    if chosen != PREFERRED:
        ours, theirs = pd.scores.leave_one_out, rungs[chosen].scores.leave_one_out
        said.append(
            f"{joint}: {chosen} predicts unseen frequencies better ({1e3 * theirs:.1f} against "
            f"{1e3 * ours:.1f} mrad); simulators still get DelayedPD, the model they can run."
        )
    if not np.isfinite(pd.scores.leave_one_out):
        said.append(
            f"{joint}: one frequency only, so no model could be tested on motion it had not seen."
        )
    return said


def _command_speed(trial: TrialData) -> float:
    """Peak rate of the command [rad/s], over windows longer than a control loop."""
    window = 25
    if len(trial.command) <= window:
        return 0.0
    moved = trial.command[window:] - trial.command[:-window]
    return float(np.max(np.abs(moved)) / (window * TIME_STEP_S))
