"""Examination of a recording before anything is fitted to it: `examine`.

Every joint gets a verdict, "use", "use with care" or "do not use", with reasons in sentences that
say what to do. Stale feedback whose poll is found asks for no care: the other commands date each
fresh reading. The checks of times and signals, which those commands make as well, are in
`sysid.doctor.checks`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES, NO_LOAD_SPEED_RAD_S
from pupper_sysid.common.results import JointResults, Result, internal
from pupper_sysid.sysid.doctor.checks import (
    Joints,
    Recordings,
    as_sequence,
    chosen_joints,
    findings,
    long_enough,
    recorded_trials,
)
from pupper_sysid.sysid.doctor.explanations import crossed
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, USE, VERDICTS, Finding
from pupper_sysid.sysid.doctor.signals import amplitude_ratio, disorder, offset, peak_speed
from pupper_sysid.sysid.doctor.writers import scatter_findings
from pupper_sysid.sysid.feedback.poll_lattice import (
    PollLattice,
    find_poll_lattice,
    fresh_rows,
    quantum,
)
from pupper_sysid.sysid.feedback.staleness import moving_rows
from pupper_sysid.sysid.lag.lag_budget import LagBudget, raw_and_fresh_lag
from pupper_sysid.sysid.recordings.excitation import describe, named_tones, without_bad_readings
from pupper_sysid.sysid.recordings.recording import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HELD = (
    "Feedback is held between polls, and the polls are known: `delay`, `bode` and `calibrate` date "
    "each new reading to the poll that measured it. Do not compute lag, gain or error from all "
    "rows."
)


@dataclass(frozen=True, kw_only=True)
class JointExamination(Result):
    """Examination of one joint. Numbers that the recording does not give are NaN."""

    verdict: str
    """One of `findings.VERDICTS`: use, use with care, do not use."""
    reasons: tuple[str, ...]
    """Sentences; each says what to do, or what to record instead."""
    findings: tuple[Finding, ...] = ()
    """The same by code and numbers."""
    loop_period_s: float = math.nan
    jitter_s: float = math.nan
    """`loop_period_s` and `jitter_s`: median time between commands, and standard deviation about
    their mean."""
    fresh_fraction: float = math.nan
    """Share of rows whose value differs from the one before."""
    poll_period_s: float = math.nan
    loss: float = math.nan
    z_score: float = math.nan
    hit_rate: float = math.nan
    """`poll_period_s`, `loss`, `z_score` and `hit_rate`: see
    `sysid.feedback.poll_lattice.PollLattice`."""
    hold_share: float = math.nan
    """Share of the raw lag that stale readings add; NaN where no poll is found."""
    quantum_rad: float = math.nan
    """Quantisation step; 0 if there is none."""
    reading_minus_command_rad: float = math.nan
    """Mean of the fresh readings minus mean of the command, over the tones if there are any."""
    missing_fraction: float = math.nan
    bad_time_stamps: int = 0
    """Rows whose send or read time is not later than the row before."""
    amplitude_ratio: float = math.nan
    """Range of the position over range of the command, median over trials."""
    peak_command_rad_s: float = math.nan
    speed_share: float = math.nan
    """`peak_command_rad_s` and `speed_share`: fastest command, and the same as a share of the
    servo's speed limit; NaN where that is not known."""
    hold_histogram: tuple[int, ...] = ()
    """How many runs of 1, 2, 3, … equal readings there are while the joint must have moved."""
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
        from pupper_sysid.sysid.report.figures import hold_histogram_figure, hold_runs

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
    sequence = as_sequence(recordings)
    rng = np.random.default_rng(seed)
    limits = [(r.metadata.get("bus") or {}).get("speed_limit_rad_s") for r in sequence]
    known = [float(limit) for limit in limits if limit]
    recorded = {
        joint: recorded_trials(sequence, joint) for joint in chosen_joints(sequence, joints)
    }
    mixed = crossed({joint: long_enough(trials) for joint, trials in recorded.items()})
    examinations = {
        joint: _examine_joint(joint, trials, mixed.get(joint), known, rng, (lags or {}).get(joint))
        for joint, trials in recorded.items()
    }
    held = any(j.feedback and j.feedback.kind == "lattice" for j in examinations.values())
    return Examination(
        recording=", ".join(r.name for r in sequence),
        warnings=tuple(w for r in sequence for w in r.warnings),
        advice=(_HELD,) if held else (),
        joints=examinations,
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
    stated_rad_s: Sequence[float],
    rng: np.random.Generator,
    lag: LagBudget | None,
) -> JointExamination:
    unstated = NO_LOAD_SPEED_RAD_S if joint in JOINT_NAMES else math.nan
    limit_rad_s = max(stated_rad_s, default=unstated)
    joint_findings = [*findings(recorded), *([mixed] if mixed else [])]
    recorded = [without_bad_readings(t) for t in recorded]
    trials = long_enough(recorded)
    if not trials:
        return JointExamination(
            verdict=REFUSE,
            reasons=tuple(f.text for f in joint_findings),
            findings=tuple(joint_findings),
        )
    gaps = np.concatenate([np.diff(t.send_time_s) for t in trials])
    seen = np.concatenate([np.isfinite(t.position_rad) for t in trials])
    fresh = sum(len(fresh_rows(t)) for t in trials)
    usable = all(f.verdict != REFUSE for f in joint_findings)
    tones = [replace(t, number=n) for n, t in enumerate(named_tones(recorded))]
    tones = long_enough(tones)
    lattice = PollLattice(kind="unresolved", fresh_fraction=fresh / len(seen))
    hold_share = math.nan
    speed = peak_speed(trials)
    if usable:
        lattice = lag.feedback if lag else find_poll_lattice(tones, rng)
        hold_share = _hold_share(joint, tones, lattice, rng, lag)
        joint_findings += [*_held(lattice, hold_share), *_slips(tones, lattice)]
        joint_findings += scatter_findings(tones, lattice)
        joint_findings += [*_excitation(trials), *_coverage(tones, speed, limit_rad_s)]
    joint_findings = [replace(f, joint=joint) for f in joint_findings]
    joint_findings.sort(key=lambda f: VERDICTS.index(f.verdict))
    return JointExamination(
        verdict=joint_findings[0].verdict if joint_findings else USE,
        reasons=tuple(f.text for f in joint_findings) or (Finding("nothing_wrong", USE).text,),
        findings=tuple(joint_findings),
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
    if lattice.kind != "lattice":  # without a poll that is known nothing tells how old readings are
        return 0.0 if lattice.kind == "every read" else math.nan
    try:
        raw_s, fresh_s = (
            (lag.raw_lag_s.value, lag.fresh_lag_s.value)
            if lag
            else raw_and_fresh_lag(joint, trials, rng, lattice)
        )
    except InputError:  # too few fresh readings: reported elsewhere
        return math.nan
    return (raw_s - fresh_s) / raw_s if raw_s > 0 else math.nan


def _held(lattice: PollLattice, hold_share: float) -> list[Finding]:
    if lattice.kind == "every read":
        return []
    if lattice.kind == "unresolved":
        values = {"percent": 100 * lattice.fresh_fraction, "doubt_ms": 1e3 * lattice.time_doubt_s}
        return [Finding("poll_unresolved", CARE, values)]
    code, values = "polled", {"period_ms": 1e3 * lattice.poll_period_s}
    if math.isfinite(lattice.loss):
        code += "_loss"
        values |= {"loss_percent": 100 * lattice.loss, "age_ms": 1e3 * lattice.mean_age_s}
    if math.isfinite(hold_share):
        code += "_share"
        values["share_percent"] = 100 * hold_share
    return [Finding(code, USE, values)]


def _slips(trials: Sequence[Trial], lattice: PollLattice) -> list[Finding]:
    """Jumps of the poll's phase, which ask for no care: both sides are dated."""
    slips = []
    for slip in lattice.slips:
        tone = next(t.frequency_hz for t in trials if t.number == slip.trial)
        where = f"at {tone:g} Hz" if tone > 0 else f"in trial {slip.trial}"
        values = {"where": where, "jump_ms": 1e3 * slip.jump_s, "time_s": slip.time_s,
                  "nats": slip.nats}  # fmt: skip
        slips.append(Finding("poll_slipped", USE, values))
    return slips


def _excitation(trials: Sequence[Trial]) -> list[Finding]:
    """What was found in commands that the log does not name."""
    if all(t.frequency_hz > 0 for t in trials):
        return []
    kinds = describe([t for t in trials if not t.frequency_hz > 0])
    hz = sorted({float(f"{f:.3g}") for f in kinds.get("tone", ())})
    listed = ", ".join(f"{f:g}" for f in hz)
    return [Finding("tones_found", USE, {"listed": listed})] if hz else []


def _coverage(trials: Sequence[Trial], speed: float, limit: float) -> list[Finding]:
    shortcomings = []
    tones = [t for t in trials if t.frequency_hz > 0]
    frequencies = sorted({round(t.frequency_hz, 2) for t in tones})
    if len(frequencies) == 1 and len(tones) == len(trials):
        shortcomings.append(Finding("one_frequency", CARE, {"frequency_hz": frequencies[0]}))
    short = [t for t in tones if (t.send_time_s[-1] - t.send_time_s[0]) * t.frequency_hz < 2]
    if short:
        shortcomings.append(Finding("short_tones", CARE, {"tones": len(short), "of": len(tones)}))
    if speed < 0.9 * limit:
        values = {"speed_rad_s": speed, "limit_rad_s": limit, "percent": 100 * speed / limit}
        shortcomings.append(Finding("slow_commands", USE, values))
    return shortcomings
