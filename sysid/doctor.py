"""Is this log usable? Look at a recording as an engineer would, before anything is fitted to it.

Every joint gets a verdict, "use", "use with care" or "do not use", with reasons in sentences that
say what to do about them. Stale feedback alone never spoils a log: the other commands date each
fresh reading, which is what the "with care" of a held log asks for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sysid.calibrate import joint_rng, joint_trials
from sysid.poll_lattice import PollLattice, find_poll_lattice, fresh_rows, moving_rows, quantum
from sysid.recording import Recording, Trial

USE, CARE, REFUSE = "use", "use with care", "do not use"

_MUCH_LOSS = 0.2
_JITTER = 0.2  # of the loop period
_USUAL_SPEED_RAD_S = 7.5  # what small servos reach: below it a speed limit stays unseen


@dataclass(frozen=True)
class JointExamination:
    """What was found about one joint. Numbers are NaN where the log does not say.

    Attributes
    ----------
    verdict : str
    reasons : tuple of str
    loop_period_ms, jitter_ms : float
        Median time between commands, and standard deviation about it.
    fresh_fraction : float
        Share of rows whose value differs from the one before.
    poll_period_ms, loss, z_score, hit_rate : float
        See `sysid.poll_lattice.PollLattice`.
    quantum_rad, offset_rad : float
        Size of a count; mean of position minus mean of command.
    missing_fraction : float
    peak_command_rad_s : float
    hold_histogram : tuple of int
        How many runs of 1, 2, 3, … equal readings there are while the joint must have moved.
    """

    verdict: str
    reasons: tuple[str, ...]
    loop_period_ms: float
    jitter_ms: float
    fresh_fraction: float
    poll_period_ms: float
    loss: float
    z_score: float
    hit_rate: float
    quantum_rad: float
    offset_rad: float
    missing_fraction: float
    peak_command_rad_s: float
    hold_histogram: tuple[int, ...]


@dataclass(frozen=True)
class Examination:
    """What was found about a recording, by joint."""

    recording: str
    warnings: tuple[str, ...]
    joints: dict[str, JointExamination]


def examine(recording: Recording, rng: np.random.Generator | int = 0) -> Examination:
    """Examine every joint of `recording`.

    Parameters
    ----------
    recording : Recording
    rng : numpy.random.Generator or int
        Shuffles rows for the poll's z-score; a seed gives each joint a generator of its own.
    """
    found = {}
    for joint in recording.joints:
        own = joint_rng(rng, joint) if isinstance(rng, int) else rng
        found[joint] = _examine_joint(joint, joint_trials([recording], joint)[0], own)
    return Examination(recording.name, recording.warnings, found)


def to_json(examination: Examination) -> dict[str, Any]:
    """Object of `doctor --json`."""
    return {
        "recording": examination.recording,
        "warnings": list(examination.warnings),
        "joints": {name: asdict(j) for name, j in examination.joints.items()},
    }


def hold_histogram(trials: Sequence[Trial]) -> tuple[int, ...]:
    """How many runs of 1, 2, 3, … rows with one value there are while the joint must move."""
    step = max(quantum(trials), 1e-6)
    lengths: list[int] = []
    for trial in trials:
        fresh, moving = fresh_rows(trial), moving_rows(trial, step)
        for first, last in zip(fresh[:-1], fresh[1:], strict=True):
            if moving[first:last].all():
                lengths.append(int(last - first))
    return tuple(int(n) for n in np.bincount(lengths)[1:]) if lengths else ()


def _examine_joint(
    joint: str, trials: Sequence[Trial], rng: np.random.Generator
) -> JointExamination:
    gaps = np.concatenate([np.diff(t.send_time_s) for t in trials])
    loop = float(np.median(gaps))
    command = np.concatenate([t.command_rad for t in trials])
    position = np.concatenate([t.position_rad for t in trials])
    seen = np.isfinite(position)
    step = quantum(trials)
    lattice = find_poll_lattice(trials, rng)
    speed = _peak_speed(trials)
    verdicts: list[tuple[str, str]] = [
        *_fatal(joint, trials, command, position, step),
        *_timing(gaps, loop),
        *_held(lattice, loop),
        *_coverage(trials, speed),
        *_signals(command, position, step),
    ]
    worst = [verdict for verdict, _ in verdicts]
    return JointExamination(
        verdict=REFUSE if REFUSE in worst else CARE if CARE in worst else USE,
        reasons=tuple(reason for _, reason in verdicts)
        or ("nothing wrong was found: timing is even, readings are new, motion covers its range.",),
        loop_period_ms=1e3 * loop,
        jitter_ms=1e3 * float(np.std(gaps)),
        fresh_fraction=lattice.fresh_fraction,
        poll_period_ms=1e3 * lattice.period_s,
        loss=lattice.loss,
        z_score=lattice.z_score,
        hit_rate=lattice.hit_rate,
        quantum_rad=step,
        offset_rad=float(position[seen].mean() - command[seen].mean()),
        missing_fraction=float(1 - seen.mean()),
        peak_command_rad_s=speed,
        hold_histogram=hold_histogram(trials),
    )


def _fatal(
    joint: str, trials: Sequence[Trial], command: NDArray, position: NDArray, step: float
) -> list[tuple[str, str]]:
    found = []
    seen = np.isfinite(position)
    if seen.mean() < 0.5:
        found.append((REFUSE, f"{100 * (1 - seen.mean()):.0f} % of the readings are missing: check "
                              "wiring and power, then record again."))  # fmt: skip
    if np.ptp(command) < 1e-3:
        found.append((REFUSE, "the command never changes: this joint was not swept. Sweep it with "
                              f"`pupper-sysid sweep --joints {joint}`."))  # fmt: skip
        return found
    if seen.any() and np.ptp(position[seen]) < max(3 * step, 5e-3):
        found.append((REFUSE, "the command moves and the reading does not: torque off, wrong servo "
                              "id, or a servo that no longer answers. Power it again and look at "
                              "it move."))  # fmt: skip
        return found
    if _swapped(trials):
        found.append((REFUSE, "the position moves before the command does: the columns command_rad "
                              "and position_rad look swapped. Swap them back."))  # fmt: skip
    return found


def _timing(gaps: NDArray, loop: float) -> list[tuple[str, str]]:
    found = []
    if np.std(gaps) > _JITTER * loop:
        found.append((CARE, f"the loop is uneven ({1e3 * np.std(gaps):.1f} ms of jitter on "
                            f"{1e3 * loop:.1f} ms); time stamps are used as they are, but record "
                            "on an idle machine."))  # fmt: skip
    late = int(np.sum(gaps > 3 * loop))
    if late:
        found.append((CARE, f"the loop stood still {late} times for more than three periods."))
    return found


def _held(lattice: PollLattice, loop: float) -> list[tuple[str, str]]:
    if lattice.kind == "every read":
        return []
    if lattice.kind == "unresolved":
        return [(CARE, f"only {100 * lattice.fresh_fraction:.0f} % of the rows have a new reading, "
                       "and no poll period explains when; fresh readings are dated to the middle "
                       "between two reads. Record at least four tones of 3 s.")]  # fmt: skip
    age = 1e3 * lattice.mean_age_s
    text = (
        f"the bus reads this servo every {1e3 * lattice.period_s:.2f} ms and "
        f"{100 * lattice.loss:.0f} % of the reads fail silently, so a reading is {age:.0f} ms old "
        "on average. Any lag, gain or error computed on all rows is wrong; `delay`, `bode` and "
        "`calibrate` use fresh readings at the times they were measured."
    )
    return [(CARE if lattice.loss > _MUCH_LOSS or lattice.mean_age_s > 0.5 * loop else USE, text)]


def _coverage(trials: Sequence[Trial], speed: float) -> list[tuple[str, str]]:
    found = []
    tones = sorted({round(t.frequency_hz, 2) for t in trials if t.frequency_hz > 0})
    if len(tones) == 1:
        found.append((CARE, f"one frequency only ({tones[0]:g} Hz): the lag is known up to whole "
                            "periods and no model can be tested. Sweep 1-10 Hz."))  # fmt: skip
    short = [
        t for t in trials
        if t.frequency_hz > 0 and (t.send_time_s[-1] - t.send_time_s[0]) * t.frequency_hz < 2
    ]  # fmt: skip
    if short:
        found.append((CARE, f"{len(short)} tones last less than two periods and are left out of "
                            "phases and gains. Record 3 s or more each."))  # fmt: skip
    if speed < _USUAL_SPEED_RAD_S:
        found.append((USE, f"commands reach {speed:.1f} rad/s; small servos do about "
                           f"{_USUAL_SPEED_RAD_S:g}, so a speed limit may stay unseen. Add "
                           "`sweep --kind steps` to see it."))  # fmt: skip
    return found


def _signals(command: NDArray, position: NDArray, step: float) -> list[tuple[str, str]]:
    found = []
    seen = np.isfinite(position)
    y, u = position[seen], command[seen]
    ratio = np.ptp(y) / max(np.ptp(u), 1e-9)
    if ratio < 0.3 or ratio > 3:
        found.append((CARE, f"the joint moves {ratio:.2f} times as far as it is told: check the "
                            "scale (counts per radian, degrees) and mechanical stops."))  # fmt: skip
    for name, value in (("lowest", y.min()), ("highest", y.max())):
        pinned = np.mean(np.abs(y - value) < 0.5 * max(step, 1e-6))
        if pinned > 0.15 and np.ptp(u) > 10 * max(step, 1e-6):
            found.append((CARE, f"{100 * pinned:.0f} % of the readings sit at the {name} value: a "
                                "limit or a mechanical stop clips the motion. Use a smaller "
                                "amplitude."))  # fmt: skip
    offset = abs(float(np.median(y) - np.median(u)))
    if offset > 0.1:
        found.append((USE, f"readings are offset by {offset:.3f} rad from the commands; the offset "
                           "is fitted, but check the joint's zero."))  # fmt: skip
    return found


def _swapped(trials: Sequence[Trial]) -> bool:
    """Whether the position correlates better with later commands than with earlier ones."""
    lead = lag = 0.0
    for t in trials:
        seen = np.isfinite(t.position_rad)
        y = np.where(seen, t.position_rad, np.nanmean(t.position_rad))
        y, u = y - y.mean(), t.command_rad - t.command_rad.mean()
        reach = max(1, round(0.05 / float(np.median(np.diff(t.send_time_s)))))
        if t.frequency_hz > 0 and t.frequency_hz > 5:  # too close to half a period to tell
            continue
        lag += float(y[reach:] @ u[:-reach])
        lead += float(y[:-reach] @ u[reach:])
    return lead > lag


def _peak_speed(trials: Sequence[Trial]) -> float:
    """Fastest command over a loop period or 20 ms, whichever is longer [rad/s]."""
    peaks = []
    for t in trials:
        width = max(1, round(0.02 / float(np.median(np.diff(t.send_time_s)))))
        rate = np.abs(t.command_rad[width:] - t.command_rad[:-width])
        peaks.append(np.max(rate / (t.send_time_s[width:] - t.send_time_s[:-width]), initial=0.0))
    return float(max(peaks))
