"""Examination of a recording before anything is fitted to it: `examine`.

Every joint gets a verdict, "use", "use with care" or "do not use", with reasons in sentences that
say what to do. Stale feedback whose poll is found asks for no care: the other commands date each
fresh reading. The checks of times and signals, which those commands make as well, are in
`sysid.doctor.checks`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import JointResults, Result, internal
from pupper_sysid.sysid.doctor.causality import crossed
from pupper_sysid.sysid.doctor.checks import findings, long_enough
from pupper_sysid.sysid.doctor.clock import disorder
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, USE, VERDICTS, Finding
from pupper_sysid.sysid.doctor.signals import amplitude_ratio, offset, peak_speed
from pupper_sysid.sysid.feedback.poll_lattice import (
    PollLattice,
    find_poll_lattice,
    fresh_rows,
    quantum,
)
from pupper_sysid.sysid.feedback.rows import moving_rows
from pupper_sysid.sysid.lag.lag_budget import LagBudget, lag_budget
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

_USUAL_SPEED_RAD_S = 7.5  # a Mini Pupper 2's servo, unloaded
_HELD = (
    "Feedback is held between polls, and the polls are known: `delay`, `bode` and `calibrate` date "
    "each new reading to the poll that measured it. Do not compute lag, gain or error from all "
    "rows."
)


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
        Share of the raw lag that stale readings add.
    quantum_rad : float
        Quantisation step; 0 if there is none.
    reading_minus_command_rad : float
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
    reading_minus_command_rad: float = math.nan
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
    advice : tuple of str
        What follows for all joints together.
    joints : dict of str to JointExamination
    """

    recording: str
    warnings: tuple[str, ...]
    advice: tuple[str, ...] = ()

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
    recordings: Recordings,
    joints: Joints = None,
    seed: int | np.random.Generator = 0,
    lags: Mapping[str, LagBudget] | None = None,
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
    lags : mapping of joint to LagBudget, optional
        Of the same recordings, if they have been measured already: the poll and the lag are theirs.

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
    recorded = {joint: joint_trials(given, joint) for joint in chosen_joints(given, joints)}
    mixed = crossed({joint: long_enough(trials) for joint, trials in recorded.items()})
    found = {
        joint: _examine_joint(joint, trials, mixed.get(joint), limit, rng, (lags or {}).get(joint))
        for joint, trials in recorded.items()
    }
    held = any(j.feedback and j.feedback.kind == "lattice" for j in found.values())
    return Examination(
        recording=", ".join(r.name for r in given),
        warnings=tuple(w for r in given for w in r.warnings),
        advice=(_HELD,) if held else (),
        joints=found,
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
    joint: str,
    recorded: Sequence[Trial],
    mixed: Finding | None,
    limit_rad_s: float,
    rng: np.random.Generator,
    lag: LagBudget | None,
) -> JointExamination:
    found = [*findings(recorded), *([mixed] if mixed else [])]
    trials = long_enough(recorded)
    if not trials:
        return JointExamination(verdict=REFUSE, reasons=tuple(f.text for f in found))
    gaps = np.concatenate([np.diff(t.send_time_s) for t in trials])
    seen = np.concatenate([np.isfinite(t.position_rad) for t in trials])
    fresh = sum(len(fresh_rows(t)) for t in trials)
    usable = all(f.verdict != REFUSE for f in found)
    lattice = PollLattice(kind="unresolved", fresh_fraction=fresh / len(seen))
    hold_share = math.nan
    speed = peak_speed(trials)
    if usable:
        lattice = lag.feedback if lag else find_poll_lattice(trials, rng)
        hold_share = _hold_share(joint, trials, lattice, rng, lag)
        found += [*_held(lattice, hold_share), *_slips(trials, lattice)]
        found += _coverage(trials, speed, limit_rad_s)
    found = sorted(found, key=lambda f: VERDICTS.index(f.verdict))
    return JointExamination(
        verdict=found[0].verdict if found else USE,
        reasons=tuple(f.text for f in found)
        or ("nothing wrong was found: timing is even, readings are new, motion covers its range.",),
        loop_period_s=float(np.median(gaps)),
        jitter_s=float(np.std(gaps)),
        fresh_fraction=lattice.fresh_fraction,
        poll_period_s=lattice.poll_period_s,
        loss=lattice.loss,
        z_score=lattice.z_score,
        hit_rate=lattice.hit_rate,
        hold_share=hold_share,
        quantum_rad=quantum(trials),
        reading_minus_command_rad=offset(trials),
        missing_fraction=float(1 - seen.mean()),
        bad_time_stamps=sum(disorder(t) for t in trials),
        amplitude_ratio=amplitude_ratio(trials),
        peak_command_rad_s=speed,
        speed_share=speed / limit_rad_s,
        hold_histogram=hold_histogram(trials) if usable else (),
        feedback=lattice if usable else None,
    )


def _hold_share(
    joint: str,
    trials: Sequence[Trial],
    lattice: PollLattice,
    rng: np.random.Generator,
    lag: LagBudget | None,
) -> float:
    try:
        budget = lag or lag_budget(joint, trials, rng, lattice)
    except InputError:  # too few fresh readings: reported elsewhere
        return math.nan
    raw = budget.raw_lag_s.value
    return budget.stale_lag_s / raw if raw > 0 else math.nan


def _held(lattice: PollLattice, hold_share: float) -> list[Finding]:
    if lattice.kind == "every read":
        return []
    if lattice.kind == "unresolved":
        return [Finding(CARE, f"{100 * lattice.fresh_fraction:.0f} % of the rows have a new "
                              "reading, and no poll period explains when they were taken: times "
                              f"are in doubt by {1e3 * lattice.time_doubt_s:.0f} ms, which widens "
                              "lags and dead times. Record at least four tones of 3 s, with a "
                              "loop faster than the poll.")]  # fmt: skip
    text = f"the bus reads each servo every {1e3 * lattice.poll_period_s:.2f} ms"
    if math.isfinite(lattice.loss):
        text += (
            f" and {100 * lattice.loss:.0f} % of the reads fail silently, so a reading is "
            f"{1e3 * lattice.mean_age_s:.0f} ms old on average"
        )
    if math.isfinite(hold_share):
        text += f", {100 * hold_share:.0f} % of the lag that all rows show"
    return [Finding(USE, f"{text}.")]


def _slips(trials: Sequence[Trial], lattice: PollLattice) -> list[Finding]:
    """Jumps of the poll's phase, which ask for no care: both sides are dated."""
    found = []
    for slip in lattice.slips:
        tone = next(t.frequency_hz for t in trials if t.number == slip.trial)
        where = f"at {tone:g} Hz" if tone > 0 else f"in trial {slip.trial}"
        found.append(Finding(USE, f"{where} the poll slipped by {1e3 * slip.jump_s:.0f} ms at "
                                  f"{slip.time_s:.2f} s ({slip.nats:.0f} nats); readings before "
                                  "and after it are dated apart."))  # fmt: skip
    return found


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
        found.append(Finding(USE, f"commands reach {speed:.1f} of about {limit:.1f} rad/s "
                                  f"({100 * speed / limit:.0f} %), which may not show the servo's "
                                  "speed limit: `calibrate` says whether it is identified. Steps "
                                  "would show it."))  # fmt: skip
    return found
