"""Plan the next sweep: from recordings, from a calibration, or for a servo that is unknown.

proposal = plan_from_recordings([load("sweep.csv")])
save_plan(proposal, "plan.yaml")                  # sysid.plan.plan_file
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.common.results import Result
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.sysid.fit.joint_fit import fit_joint
from pupper_sysid.sysid.fit.results import JointCalibrationResult
from pupper_sysid.sysid.plan.candidates import LARGEST_RAD, Setup
from pupper_sysid.sysid.plan.planner import JointPlan, PlannedTrial, Prediction, propose
from pupper_sysid.sysid.plan.servos import (
    calibrated_servo,
    calibrated_setup,
    feedback_setup,
    fitted_servo,
    unknown_servos,
)
from pupper_sysid.sysid.recordings.joints import each_joint, joint_trials
from pupper_sysid.sysid.recordings.recording import Recording, Trial
from pupper_sysid.sysid.sweep.excitation import LEAST_MARGIN_RAD, LOOP_PERIOD_S, PLANS_S

SECONDS = 20.0
"""Recorded seconds per joint of a plan without a recording to go by."""

_SPEED_LIMIT_RAD_S = 7.5

Margins = Mapping[str, float]
"""Largest excursion of each joint to either side of its start pose [rad]."""


@dataclass(frozen=True, kw_only=True)
class Source(Result):
    """A file that a plan was made from.

    Attributes
    ----------
    name, sha256 : str
    """

    name: str
    sha256: str


@dataclass(frozen=True, kw_only=True)
class SweepPlan(Result):
    """What to record next.

    Attributes
    ----------
    made_from : tuple of Source
        Empty for an unknown servo.
    seed : int
    loop_period_s, poll_rate_hz, speed_limit_rad_s : float
        What the trials were chosen for.
    trials : tuple of PlannedTrial
        One joint after the other.
    predictions : tuple of Prediction
        Empty for an unknown servo.
    notes : tuple of str
        What no trial within the limits can show.
    """

    made_from: tuple[Source, ...]
    seed: int
    loop_period_s: float
    poll_rate_hz: float
    speed_limit_rad_s: float
    trials: tuple[PlannedTrial, ...]
    predictions: tuple[Prediction, ...]
    notes: tuple[str, ...]

    @property
    def joints(self) -> list[str]:
        """The joints that move, in order."""
        return list(dict.fromkeys(trial.joint for trial in self.trials))


def plan_from_recordings(
    recordings: Sequence[Recording],
    joints: Sequence[str],
    *,
    seconds: float | None = None,
    margins: Margins | None = None,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> SweepPlan:
    """Fit the joints of recordings, and plan what narrows their intervals most.

    Parameters
    ----------
    recordings : sequence of Recording
        Trials of one joint are pooled.
    joints : sequence of str
    seconds : float, optional
        Recorded time per joint [s]; by default as long as the recordings.
    margins : mapping of joint to float, optional
        Largest excursions [rad]; by default those of the recordings.
    seed : int
    workers : int
        Processes.
    progress : callable, optional
        Called with a joint's name when it is done.

    Raises
    ------
    InputError
        If a joint has too little motion, or `seconds` is out of range.
    """
    if seconds is not None:
        _checked(seconds)  # before the work, not after it
    work = partial(fit_joint, seed=seed)
    fits = each_joint(work, recordings, list(joints), workers, progress)
    return plan_from_fits(recordings, fits, seconds=seconds, margins=margins, seed=seed)


def plan_from_fits(
    recordings: Sequence[Recording],
    fits: Mapping[str, JointCalibrationResult],
    *,
    seconds: float | None = None,
    margins: Margins | None = None,
    seed: int = 0,
) -> SweepPlan:
    """Plan what narrows the intervals of fitted joints most; parameters as above.

    Parameters
    ----------
    recordings : sequence of Recording
        The fits' own.
    fits : mapping of joint to JointCalibrationResult
    seconds : float, optional
        Recorded time per joint [s]; by default as long as the recordings.
    margins : mapping of joint to float, optional
        Largest excursions [rad]; by default those of the recordings.
    seed : int

    Raises
    ------
    InputError
        If `seconds` is out of range.
    """
    base = Setup(
        loop_period_s=round(float(np.median([r.loop_period_s for r in recordings])), 6),
        speed_limit_rad_s=_speed_limit(recordings),
    )
    plans, polls = [], []
    for joint, fit in fits.items():
        trials = joint_trials(recordings, joint)
        setup = feedback_setup(fit.lag, _within(base, joint, margins, _excursion(trials)))
        length = min(recorded_s(trials), PLANS_S[1]) if seconds is None else _checked(seconds)
        plans.append(propose(joint, [fitted_servo(fit)], setup, length))
        polls.append(setup.poll_rate_hz)
    sources = tuple(
        Source(name=r.path.name if r.path else r.name, sha256=r.sha256) for r in recordings
    )
    return _pooled(plans, sources, seed, replace(base, poll_period_s=_period(polls)))


def plan_from_calibration(
    calibration: Calibration,
    source: Source,
    joints: Sequence[str],
    *,
    seconds: float = SECONDS,
    loop_period_s: float = LOOP_PERIOD_S,
    margins: Margins | None = None,
    seed: int = 0,
) -> SweepPlan:
    """Plan what narrows the intervals of a calibration most.

    A calibration holds no readings: what it knows is taken from its intervals, as if they were
    independent.

    Parameters
    ----------
    calibration : Calibration
    source : Source
        Its file.
    joints : sequence of str
    seconds : float
        Recorded time per joint [s].
    loop_period_s : float
    margins : mapping of joint to float, optional
        Largest excursions [rad].
    seed : int

    Raises
    ------
    InputError
        If it lacks a joint, or `seconds` is out of range.
    """
    base = Setup(loop_period_s=loop_period_s)
    plans, polls = [], []
    for joint in joints:
        own = calibration.joint(joint)
        setup = calibrated_setup(own, _within(base, joint, margins, LARGEST_RAD))
        plans.append(propose(joint, [calibrated_servo(own)], setup, _checked(seconds)))
        polls.append(setup.poll_rate_hz)
    return _pooled(plans, (source,), seed, replace(base, poll_period_s=_period(polls)))


def plan_first_sweep(
    joints: Sequence[str],
    *,
    setup: Setup,
    seconds: float = SECONDS,
    margins: Margins | None = None,
    seed: int = 0,
) -> SweepPlan:
    """Plan a first sweep of servos of which nothing is known.

    The trials are the best on average over servos drawn from the prior of
    `sysid.fit.structure`.

    Parameters
    ----------
    joints : sequence of str
    setup : Setup
        Of the bus.
    seconds : float
        Recorded time per joint [s].
    margins : mapping of joint to float, optional
        Largest excursions [rad].
    seed : int

    Raises
    ------
    InputError
        If `seconds` is out of range.
    """
    servos, made, plans = unknown_servos(seed), dict[float, JointPlan](), []
    for joint in joints:
        own = _within(setup, joint, margins, LARGEST_RAD)
        reach = min(own.margin_rad, LARGEST_RAD)
        if reach not in made:  # joints with the same margin get the same trials
            made[reach] = propose(joint, servos, own, _checked(seconds))
        trials = tuple(replace(t, joint=joint) for t in made[reach].trials)
        plans.append(replace(made[reach], trials=trials))
    return _pooled(plans, (), seed, setup)


def _pooled(
    plans: Sequence[JointPlan], sources: tuple[Source, ...], seed: int, setup: Setup
) -> SweepPlan:
    return SweepPlan(
        made_from=sources,
        seed=seed,
        loop_period_s=setup.loop_period_s,
        poll_rate_hz=round(setup.poll_rate_hz, 3),
        speed_limit_rad_s=setup.speed_limit_rad_s,
        trials=tuple(t for p in plans for t in p.trials),
        predictions=tuple(x for p in plans for x in p.predictions),
        notes=tuple(n for p in plans for n in p.notes),
    )


def _period(rates_hz: Sequence[float]) -> float:
    """Poll period of a bus from those found at its joints [s]; 0 if most are live."""
    middle = float(np.median(rates_hz))
    return 1 / middle if middle > 0 else 0.0


def _within(setup: Setup, joint: str, margins: Margins | None, usual_rad: float) -> Setup:
    """`setup` with the joint's margin."""
    margin = usual_rad if margins is None or joint not in margins else margins[joint]
    if margin < LEAST_MARGIN_RAD:
        raise InputError(
            f"{joint} has a margin of {margin:.3f} rad on either side of its start pose, too "
            "little for a measurement. Check its limits in the joint map."
        )
    return replace(setup, margin_rad=margin)


def _checked(seconds: float) -> float:
    refuse_outside("`seconds`", seconds, *PLANS_S, "s")
    return seconds


def recorded_s(trials: Sequence[Trial]) -> float:
    """Recorded time of all trials [s]."""
    return float(sum(t.send_time_s[-1] - t.send_time_s[0] for t in trials))


def _excursion(trials: Sequence[Trial]) -> float:
    return max(float(np.max(np.abs(t.command_rad - t.initial_command_rad))) for t in trials)


def _speed_limit(recordings: Sequence[Recording]) -> float:
    found = [(r.metadata.get("bus") or {}).get("speed_limit_rad_s") for r in recordings]
    return float(min([x for x in found if x] or [_SPEED_LIMIT_RAD_S]))
