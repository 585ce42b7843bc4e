"""Examination of a recording before anything is fitted to it: `examine`.

Every joint gets a verdict, "use", "use with care" or "do not use", with reasons in sentences that
say what to do. Stale feedback alone never makes a recording unusable: the other commands date each
fresh reading. The checks of the signals themselves (units, swapped columns, clipping) are in
`sysid.doctor.checks`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import JointResults, Result, internal
from pupper_sysid.sysid.doctor import checks
from pupper_sysid.sysid.doctor.checks import CARE, REFUSE, USE, Finding
from pupper_sysid.sysid.feedback.poll_lattice import (
    PollLattice,
    find_poll_lattice,
    fresh_rows,
    moving_rows,
    quantum,
)
from pupper_sysid.sysid.lag.lag_budget import lag_budget
from pupper_sysid.sysid.recordings.joints import (
    Joints,
    Recordings,
    as_sequence,
    chosen_joints,
    joint_trials,
)
from pupper_sysid.sysid.recordings.recording import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MUCH_LOSS = 0.2
_MUCH_HOLD = 0.2  # of the raw lag
_UNEVEN = 0.2  # of the loop period
_LEAST_ROWS = 3  # of a trial: fewer have no rate of change
_LEAST_FRESH = 16
_USUAL_SPEED_RAD_S = 7.5  # a Mini Pupper 2's servo, unloaded
_FEW_MISSING = 0.02


@dataclass(frozen=True, kw_only=True)
class JointExamination(Result):
    """Examination of one joint. Numbers that the recording does not give are NaN.

    Attributes
    ----------
    verdict : {"use", "use with care", "do not use"}
    reasons : tuple of str
        Sentences; each says what to do, or what to record instead.
    loop_period_s, jitter_s : float
        Median time between commands, and standard deviation about their mean.
    fresh_fraction : float
        Share of rows whose value differs from the one before.
    poll_period_s, loss, z_score, hit_rate : float
        See `sysid.feedback.poll_lattice.PollLattice`.
    hold_share : float
        Share of the raw lag that is feedback age.
    quantum_rad : float
        Quantisation step; 0 if there is none.
    offset_rad : float
        Mean of the fresh readings minus mean of the command, over the tones if there are any.
    missing_fraction : float
    bad_time_stamps : int
        Rows whose send or read time is not later than the row before.
    amplitude_ratio : float
        Range of the position over range of the command, median over trials.
    peak_command_rad_s, speed_share : float
        Fastest command, and the same as a share of the servo's speed limit.
    hold_histogram : tuple of int
        How many runs of 1, 2, 3, … equal readings there are while the joint must have moved.
    """

    verdict: str
    reasons: tuple[str, ...]
    loop_period_s: float = math.nan
    jitter_s: float = math.nan
    fresh_fraction: float = math.nan
    poll_period_s: float = math.nan
    loss: float = math.nan
    z_score: float = math.nan
    hit_rate: float = math.nan
    hold_share: float = math.nan
    quantum_rad: float = math.nan
    offset_rad: float = math.nan
    missing_fraction: float = math.nan
    bad_time_stamps: int = 0
    amplitude_ratio: float = math.nan
    peak_command_rad_s: float = math.nan
    speed_share: float = math.nan
    hold_histogram: tuple[int, ...] = ()
    feedback: PollLattice | None = internal(default=None)

    def __str__(self) -> str:
        return "\n".join([self.verdict, *(f"  - {reason}" for reason in self.reasons)])


@dataclass(frozen=True, kw_only=True, eq=False)
class Examination(JointResults[JointExamination]):
    """Examination of a recording, by joint.

    Attributes
    ----------
    recording : str
        Its name; of several, all names.
    warnings : tuple of str
        What was repaired when it was read, e.g. repeated time stamps.
    joints : dict of str to JointExamination
    """

    recording: str
    warnings: tuple[str, ...]

    def plot(self) -> Figure:
        """For how many rows each reading stayed the same; joints that can be used."""
        from pupper_sysid.sysid.report.figure_data import hold_runs
        from pupper_sysid.sysid.report.figures import hold_histogram_figure

        return hold_histogram_figure(
            {
                joint: hold_runs([j.hold_histogram], [j.loop_period_s], j.feedback)
                for joint, j in self.items()
                if j.feedback
            }
        )


def examine(
    recordings: Recordings, joints: Joints = None, seed: int | np.random.Generator = 0
) -> Examination:
    """Examine every joint of a recording.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Trials of one joint are pooled.
    joints : str or sequence of str, optional
        Which joints; by default all that were recorded.
    seed : int or numpy.random.Generator
        Shuffles rows for the poll's z-score.

    Returns
    -------
    Examination
        Verdict and numbers by joint.

    Raises
    ------
    InputError
        If a joint is not recorded.
    """
    given = as_sequence(recordings)
    rng = np.random.default_rng(seed)
    limits = [(r.metadata.get("bus") or {}).get("speed_limit_rad_s") for r in given]
    limit = max(float(each or _USUAL_SPEED_RAD_S) for each in limits)
    return Examination(
        recording=", ".join(r.name for r in given),
        warnings=tuple(w for r in given for w in r.warnings),
        joints={
            joint: _examine_joint(joint, joint_trials(given, joint), limit, rng)
            for joint in chosen_joints(given, joints)
        },
    )


def hold_histogram(trials: Sequence[Trial]) -> tuple[int, ...]:
    """How many runs of 1, 2, 3, … rows with one value there are while the joint must move."""
    step = max(quantum(trials), 1e-6)
    lengths: list[int] = []
    for trial in trials:
        fresh, moving = fresh_rows(trial), moving_rows(trial, step)
        for first, last in pairwise(fresh):
            if moving[first:last].all():
                lengths.append(int(last - first))
    return tuple(int(n) for n in np.bincount(lengths)[1:]) if lengths else ()


def _examine_joint(
    joint: str, recorded: Sequence[Trial], limit_rad_s: float, rng: np.random.Generator
) -> JointExamination:
    trials = [t for t in recorded if len(t.send_time_s) >= _LEAST_ROWS]
    if not trials:
        text = f"no trial has {_LEAST_ROWS} rows: the recording was cut short. Record it again."
        return JointExamination(verdict=REFUSE, reasons=(text,))
    gaps = np.concatenate([np.diff(t.send_time_s) for t in trials])
    loop = float(np.median(gaps))
    seen = np.concatenate([np.isfinite(t.position_rad) for t in trials])
    disorder = sum(_disorder(t) for t in trials)
    step = quantum(trials)
    fresh = sum(len(fresh_rows(t)) for t in trials)
    findings = [
        *_missing(float(1 - seen.mean()), len(recorded) - len(trials)),
        *_timing(gaps, loop, disorder),
    ]
    unusable = checks.unusable(joint, trials, step)
    if not unusable and fresh < _LEAST_FRESH:
        unusable = [Finding(REFUSE, f"only {fresh} readings differ from the one before, too few to "
                                  "measure anything. Record for longer, with a larger "
                                  "amplitude.")]  # fmt: skip
    lattice = PollLattice(kind="unresolved", fresh_fraction=fresh / len(seen))
    hold_share = math.nan
    speed = checks.peak_speed(trials)
    if not unusable:
        lattice = find_poll_lattice(trials, rng)
        hold_share = _hold_share(joint, trials, lattice, rng)
        findings += _held(lattice, hold_share)
        findings += _coverage(trials, speed, limit_rad_s)
        findings += checks.doubtful(trials, step)
    findings = sorted([*unusable, *findings], key=lambda f: (REFUSE, CARE, USE).index(f.verdict))
    return JointExamination(
        verdict=findings[0].verdict if findings else USE,
        reasons=tuple(f.text for f in findings)
        or ("nothing wrong was found: timing is even, readings are new, motion covers its range.",),
        loop_period_s=loop,
        jitter_s=float(np.std(gaps)),
        fresh_fraction=lattice.fresh_fraction,
        poll_period_s=lattice.poll_period_s,
        loss=lattice.loss,
        z_score=lattice.z_score,
        hit_rate=lattice.hit_rate,
        hold_share=hold_share,
        quantum_rad=step,
        offset_rad=checks.offset(trials),
        missing_fraction=float(1 - seen.mean()),
        bad_time_stamps=disorder,
        amplitude_ratio=checks.amplitude_ratio(trials),
        peak_command_rad_s=speed,
        speed_share=speed / limit_rad_s,
        hold_histogram=hold_histogram(trials),
        feedback=None if unusable else lattice,
    )


def _disorder(trial: Trial) -> int:
    return int(np.sum((np.diff(trial.send_time_s) <= 0) | (np.diff(trial.read_time_s) <= 0)))


def _missing(share: float, short_trials: int) -> list[Finding]:
    found = []
    if share > 0.5:
        found.append(Finding(REFUSE, f"{100 * share:.0f} % of the readings are missing: check "
                                     "wiring and power, then record again."))  # fmt: skip
    elif share > _FEW_MISSING:
        found.append(Finding(CARE, f"{100 * share:.0f} % of the readings are missing; the rest is "
                                   "used. Check the plugs before the next recording."))  # fmt: skip
    if short_trials:
        found.append(Finding(CARE, f"{short_trials} trials have fewer than {_LEAST_ROWS} rows and "
                                   "are left out. Record them again."))  # fmt: skip
    return found


def _timing(gaps: NDArray[np.float64], loop: float, disorder: int) -> list[Finding]:
    found = []
    if disorder:
        found.append(Finding(CARE, f"{disorder} time stamps repeat or run backwards, so lags are "
                                   "uncertain there. Record with a monotonic clock."))  # fmt: skip
    if np.std(gaps) > _UNEVEN * loop:
        found.append(Finding(CARE, f"the loop is uneven ({1e3 * np.std(gaps):.1f} ms of jitter on "
                                   f"{1e3 * loop:.1f} ms); time stamps are used as they are, but "
                                   "record on an idle machine."))  # fmt: skip
    late = int(np.sum(gaps > 3 * loop))
    if late:
        found.append(Finding(CARE, f"the loop stood still {late} times for more than three "
                                   "periods; record on an idle machine."))  # fmt: skip
    return found


def _hold_share(
    joint: str, trials: Sequence[Trial], lattice: PollLattice, rng: np.random.Generator
) -> float:
    try:
        budget = lag_budget(joint, trials, rng, lattice)
    except InputError:  # too few fresh readings: reported elsewhere
        return math.nan
    raw = budget.raw_lag_s.value
    return budget.feedback_age_s / raw if raw > 0 else math.nan


def _held(lattice: PollLattice, hold_share: float) -> list[Finding]:
    if lattice.kind == "every read":
        return []
    if lattice.kind == "unresolved":
        return [Finding(CARE, f"only {100 * lattice.fresh_fraction:.0f} % of the rows have a new "
                              "reading, and no poll period explains when; fresh readings are dated "
                              "to the middle between two reads. Record at least four tones of "
                              "3 s, with a loop faster than the poll.")]  # fmt: skip
    text = f"the bus reads this servo every {1e3 * lattice.poll_period_s:.2f} ms"
    if math.isfinite(lattice.loss):
        text += (
            f" and {100 * lattice.loss:.0f} % of the reads fail silently, so a reading is "
            f"{1e3 * lattice.mean_age_s:.0f} ms old on average"
        )
    if math.isfinite(hold_share):
        text += f", {100 * hold_share:.0f} % of the lag that all rows show"
    text += (
        ". The recording is usable: `delay`, `bode` and `calibrate` date each fresh reading to the "
        "poll that measured it; do not compute lag, gain or error from all rows."
    )
    care = lattice.loss > _MUCH_LOSS or hold_share > _MUCH_HOLD
    return [Finding(CARE if care else USE, text)]


def _coverage(trials: Sequence[Trial], speed: float, limit: float) -> list[Finding]:
    found = []
    tones = [t for t in trials if t.frequency_hz > 0]
    frequencies = sorted({round(t.frequency_hz, 2) for t in tones})
    if len(frequencies) == 1 and len(tones) == len(trials):
        found.append(Finding(CARE, f"one frequency only ({frequencies[0]:g} Hz): the lag is known "
                                   "up to whole periods and no model can be tested. Record tones "
                                   "of 1 to 10 Hz."))  # fmt: skip
    short = [t for t in tones if (t.send_time_s[-1] - t.send_time_s[0]) * t.frequency_hz < 2]
    if short:
        found.append(Finding(CARE, f"{len(short)} of {len(tones)} tones last less than two periods "
                                   "and are left out of phases and gains. Record 3 s or more "
                                   "each."))  # fmt: skip
    if speed < 0.9 * limit:
        found.append(Finding(USE, f"speed limit not excited: commands reach {speed:.1f} of about "
                                  f"{limit:.1f} rad/s ({100 * speed / limit:.0f} %), so the limit "
                                  "cannot be identified. Record steps as well."))  # fmt: skip
    return found
