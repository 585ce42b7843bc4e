"""All checks of a joint's recording before anything is fitted to it, and what follows from them.

`findings` has them all; `refuse_unusable` ends a computation with the sentence of what makes every
number wrong, and `cautions` are the sentences that go with its result. The commands and functions
that compute from recordings call these two, so that all of them judge as `doctor` does.

`setup_findings` reads `ServoSetup` alone: with a finite acceleration or goal speed a Feetech servo
ramps its set-point, so what is identified is the ramp, and no motor model explains it.

`joint_trials` pools the checked trials of each joint over recordings, and `map_joints` computes
each joint in a process of its own, with its own seed.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import Any, TypeVar
from zlib import crc32

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES, in_order, select_joints
from pupper_sysid.common.processes.workers import Workers, prepare
from pupper_sysid.sysid.doctor.explanations import crossed
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, USE, Finding
from pupper_sysid.sysid.doctor.hypotheses import (
    encoder_findings,
    held_findings,
    hypothesis_findings,
    speed_findings,
    stepwise_findings,
)
from pupper_sysid.sysid.doctor.signals import (
    clock_findings,
    frozen_findings,
    interpolation_findings,
    motion_findings,
    offset_findings,
    start_findings,
    tone_findings,
    unit_findings,
)
from pupper_sysid.sysid.feedback.staleness import fresh_rows, quantum
from pupper_sysid.sysid.recordings.excitation import (
    content_of,
    named_tones,
    remembered,
    without_bad_readings,
)
from pupper_sysid.sysid.recordings.recording import Recording, Trial
from pupper_sysid.sysid.recordings.servo_setup import ServoSetup

LEAST_ROWS = 3
"""Rows of a trial; fewer have no rate of change."""

_FEW_MISSING, _MANY_MISSING = 0.02, 0.5
_LEAST_FRESH = 16
_MANY_BAD = 0.05  # share of the readings
_LEAST_LAG_S = 0.002
_SERVO_RAD_S = 7.5  # no servo of this size follows a faster set-point
_OVER_S = 0.1


def setup_findings(setup: ServoSetup, speed_rad_s: float = _SERVO_RAD_S) -> list[Finding]:
    """Registers of `setup` that shape the motion, each with its cure.

    A set-point that must be able to stop on the command follows a speed v at a distance of v² over
    twice its acceleration limit, which is a lag of v over twice the limit.

    `speed_rad_s`: speed of the fast parts of the motion [rad/s].
    """
    shaping, registers = [], setup.registers
    dynamixel = "profile_velocity" in registers
    limit = setup.set_point_acceleration_rad_s2
    if limit is not None and (lag_s := speed_rad_s / (2 * limit)) > _LEAST_LAG_S:
        said = f"{limit:.1f} rad/s², a lag of up to {1e3 * lag_s:.0f} ms at {speed_rad_s:.1f} rad/s"
        name = "profile_acceleration" if dynamixel else "acceleration"
        shaping.append(_shaped(name, registers.get(name, 0), said, "0"))
    speed = setup.set_point_speed_rad_s
    if speed is not None and speed < _SERVO_RAD_S:
        name = "profile_velocity" if dynamixel else "goal_speed"
        shaping.append(_shaped(name, registers.get(name, 0), f"{speed:.2f} rad/s", "0"))
    if duration_s := setup.set_point_duration_s:
        name = "profile_velocity" if dynamixel else "goal_time"
        said = f"{1e3 * duration_s:.0f} ms for each command"
        shaping.append(_shaped(name, registers.get(name, 0), said, "0"))
    return shaping


def register_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """`setup_findings` of all trials, each once."""
    speed = max((_speed(trial) for trial in trials), default=0.0)
    return list(dict.fromkeys(f for trial in trials for f in setup_findings(trial.servo, speed)))


def _speed(trial: Trial) -> float:
    """Speed of the fast parts of a trial [rad/s], from readings a tenth of a second apart."""
    read = np.isfinite(trial.position_rad) & np.isfinite(trial.read_time_s)
    time, position = trial.read_time_s[read], trial.position_rad[read]
    if len(time) < 2 or time[-1] - time[0] < _OVER_S:
        return 0.0
    grid = np.arange(time[0], time[-1], _OVER_S)
    return float(np.percentile(np.abs(np.diff(np.interp(grid, time, position))), 95) / _OVER_S)


def _shaped(register: str, value: int, limit: str, cure: str) -> Finding:
    return Finding(
        "own_trajectory", CARE, {"register": register, "value": value, "limit": limit, "cure": cure}
    )


_CHECKS = (
    motion_findings, tone_findings, speed_findings, encoder_findings, unit_findings, held_findings,
    frozen_findings, offset_findings, hypothesis_findings, start_findings, interpolation_findings,
    register_findings,
)  # fmt: skip
_SERVOS_ALONE = (frozen_findings, hypothesis_findings)  # a joint held by friction is explained
_OF_ONE_SERVO = (held_findings, hypothesis_findings)
"""Checks that compare all trials with one servo: with another P gain or load it is another one."""


def long_enough(trials: Sequence[Trial]) -> list[Trial]:
    """The trials that have rows enough to be looked at, where their torque is on."""
    powered = [t.powered() for t in trials]
    return [t for t in powered if len(t.send_time_s) >= LEAST_ROWS]


@remembered(64)
def findings(recorded: Sequence[Trial]) -> list[Finding]:
    """Find what is wrong with one joint's trials.

    All that asks for care, or the first fault that makes every number wrong.
    """
    cleaned = [without_bad_readings(t) for t in recorded]
    trials = long_enough(cleaned)
    if not trials:
        return [Finding("too_short", REFUSE, {"rows": LEAST_ROWS})]
    faults = [*_missing(recorded, len(recorded) - len(trials)), *clock_findings(trials)]
    faults += _bad_readings(recorded, cleaned)
    step = -1.0
    for check in (stepwise_findings, *_CHECKS[:1], _few_fresh, *_CHECKS[1:]):
        if any(f.verdict == REFUSE for f in faults):
            break
        if check in _SERVOS_ALONE and any(f.code == "held_by_friction" for f in faults):
            continue
        step = quantum(trials) if step < 0 else step
        if check in _OF_ONE_SERVO:
            by_code: dict[str, Finding] = {}
            for point in _operating_points(trials):
                for finding in check(point, step):
                    by_code.setdefault(finding.code, finding)
            faults += by_code.values()
        else:
            faults += check(trials, step)
    return faults


def _operating_points(trials: Sequence[Trial]) -> list[list[Trial]]:
    """The trials in groups of one P gain and one load."""
    points: dict[str, list[Trial]] = {}
    for trial in trials:
        points.setdefault(f"{trial.p_gain}, {trial.load}", []).append(trial)
    return [*points.values()]


def refuse_unusable(trials_by_joint: Mapping[str, Sequence[Trial]]) -> None:
    """Refuse to compute from recordings whose verdict is "do not use"."""
    others = " Or leave the joint out of `joints`." if len(trials_by_joint) > 1 else ""
    for joint, trials in trials_by_joint.items():
        for fault in findings(trials):
            if fault.verdict == REFUSE:
                raise InputError(f"{joint}: {fault.text}{others}")
    for joint, fault in crossed({j: long_enough(t) for j, t in trials_by_joint.items()}).items():
        raise InputError(f"{joint}: {fault.text}{others}")


_RECORDED: OrderedDict[bytes, tuple[Trial, ...]] = OrderedDict()
"""What was recorded, by the tones that `usable_trials` took it apart into: it is judged whole.

The last `_MOST_RECORDED`; tones of others are judged by themselves.
"""
_MOST_RECORDED = 64


def cautions(joint: str, trials: Sequence[Trial]) -> tuple[str, ...]:
    """Warnings that go with every number computed from these trials of `joint`."""
    whole = _RECORDED.get(content_of(trials), trials)
    return tuple(f"{joint}: {f.text}" for f in findings(whole) if f.verdict != USE)


def _few_fresh(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Too few new readings to measure anything."""
    fresh = sum(len(fresh_rows(t)) for t in trials)
    if fresh >= _LEAST_FRESH:
        return []
    return [Finding("few_fresh", REFUSE, {"readings": fresh})]


def _missing(recorded: Sequence[Trial], short: int) -> list[Finding]:
    position = np.concatenate([t.position_rad for t in recorded])
    share = float(np.mean(~np.isfinite(position))) if len(position) else 1.0
    losses = []
    if not len(position) or share > _MANY_MISSING:
        losses.append(Finding("most_missing", REFUSE, {"percent": 100 * share}))
    elif share > _FEW_MISSING:
        losses.append(Finding("some_missing", CARE, {"percent": 100 * share}))
    if short:
        losses.append(Finding("short_trials", CARE, {"trials": short, "rows": LEAST_ROWS}))
    return losses


def _bad_readings(recorded: Sequence[Trial], cleaned: Sequence[Trial]) -> list[Finding]:
    """Single readings that are left out, with the first of them."""
    bad = [
        (t.read_time_s[k] - recorded[0].send_time_s[0], t.position_rad[k])
        for t, c in zip(recorded, cleaned, strict=True)
        for k in np.flatnonzero(np.isfinite(t.position_rad) & ~np.isfinite(c.position_rad))
    ]
    if not bad:
        return []
    share = len(bad) / sum(int(np.isfinite(t.position_rad).sum()) for t in recorded)
    many = share > _MANY_BAD
    values = {"readings": len(bad), "percent": 100 * share, "time_s": bad[0][0],
              "value_rad": bad[0][1]}  # fmt: skip
    return [Finding("many_bad_readings" if many else "bad_readings", REFUSE if many else CARE,
                    values)]  # fmt: skip


Recordings = Recording | Sequence[Recording]
"""One recording, or several whose trials are pooled per joint."""

Joints = str | Sequence[str] | None
"""Names of joints; a text as `common.joints.select_joints` reads it; None for all."""

Found = TypeVar("Found")


def as_sequence(recordings: Recordings) -> Sequence[Recording]:
    """The recordings as a sequence."""
    single = isinstance(recordings, str | PurePath | Mapping) or _is_frame(recordings)
    several: list[Any] = [recordings]
    if isinstance(recordings, Iterable) and not single:
        several = list(recordings)
    for one in several:
        if not isinstance(one, Recording):
            kind = type(one).__name__
            way = f"pupper_sysid.load({one!r})" if isinstance(one, str | PurePath) else (
                "pupper_sysid.Recording.from_frame(table)" if _is_frame(one) else
                "pupper_sysid.load(path), or Recording.from_arrays and from_frame"
            )  # fmt: skip
            raise InputError(f"A recording is needed, not a {kind}. Make one with {way}.")
    if not several:
        raise InputError("A recording is needed, and the list is empty.")
    return several


def _is_frame(value: object) -> bool:
    return hasattr(value, "columns") and hasattr(value, "iloc")


def chosen_joints(recordings: Recordings, joints: Joints = None) -> list[str]:
    """The recorded joints that `joints` names, in joint order."""
    recorded = in_order(joint for r in as_sequence(recordings) for joint in r.joints)
    if joints is None:
        return recorded
    if not isinstance(joints, str) and not (
        isinstance(joints, Iterable) and all(isinstance(j, str) for j in joints)
    ):
        raise InputError(f"`joints` is {joints!r:.40}; name joints, such as {recorded[0]!r}.")
    return select_joints(joints if isinstance(joints, str) else ",".join(joints), recorded)


def recorded_trials(recordings: Recordings, joint: str) -> tuple[Trial, ...]:
    """All trials of `joint` as they were recorded, renumbered.

    Raises InputError where two recordings hold the same trial, whose readings would count twice.
    """
    several = as_sequence(recordings)
    names = _distinct_names([recording.name for recording in several])
    trials: list[Trial] = []
    for name, recording in zip(names, several, strict=True):
        for trial in recording.trials(joint):
            if same := next((t for t in trials if t.source != name and _same(t, trial)), None):
                raise InputError(
                    f"{joint}: {same.source} and {name} hold the same readings, which would count "
                    "twice. Give each recording once."
                )
            trials.append(replace(trial, source=name))
    return tuple(replace(trial, number=n) for n, trial in enumerate(trials))


def _same(one: Trial, other: Trial) -> bool:
    return np.array_equal(one.command_rad, other.command_rad) and np.array_equal(
        one.position_rad, other.position_rad, equal_nan=True
    )


def _distinct_names(names: Sequence[str]) -> list[str]:
    """Names of recordings, those that are alike with a number."""
    places = [names[: k + 1].count(name) for k, name in enumerate(names)]
    several = [names.count(name) > 1 for name in names]
    return [f"{n} ({k})" if more else n for n, k, more in zip(names, places, several, strict=True)]


def joint_trials(recordings: Recordings, joint: str) -> tuple[Trial, ...]:
    """All trials of `joint` without bad readings, each tone of a command as its own, renumbered."""
    trials = named_tones([without_bad_readings(t) for t in recorded_trials(recordings, joint)])
    return tuple(replace(trial, number=n) for n, trial in enumerate(trials))


def usable_trials(recordings: Recordings, joints: Joints = None) -> dict[str, tuple[Trial, ...]]:
    """All trials by joint, in joint order.

    `joints`: which joints; by default all that were recorded.
    """
    chosen = chosen_joints(recordings, joints)
    recorded = {j: recorded_trials(recordings, j) for j in chosen}
    refuse_unusable(recorded)
    trials = {j: joint_trials(recordings, j) for j in chosen}
    for joint, parts in trials.items():
        _RECORDED[content_of(parts)] = recorded[joint]
    while len(_RECORDED) > _MOST_RECORDED:
        _RECORDED.popitem(last=False)
    return trials


def joint_rng(seed: int, joint: str) -> np.random.Generator:
    """Generator of one joint: repeatable whatever other joints are computed."""
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError(f"`seed` is {seed!r}; give a whole number from 0 on.")
    place = JOINT_NAMES.index(joint) if joint in JOINT_NAMES else crc32(joint.encode())
    return np.random.default_rng([seed, place])


def each_joint(
    work: Callable[[str, tuple[Trial, ...]], Found],
    recordings: Recordings,
    joints: Joints = None,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Found]:
    """`work(joint, trials)` of every joint, in joint order; none if one cannot be used.

    `work`: must be picklable if there are several workers. `joints`: which joints; by default all
    that were recorded. `workers`: processes. `progress`: called with a joint's name when it is
    done.
    """
    workers = min(workers, len(chosen_joints(recordings, joints)))  # to start one takes a second
    if workers > 1:  # imports what it needs beside the look at the recordings
        prepare(getattr(work, "func", work).__module__)
    return map_joints(work, usable_trials(recordings, joints), workers, progress)


Task = TypeVar("Task")


def map_joints(
    work: Callable[[str, Task], Found],
    tasks: dict[str, Task],
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Found]:
    """`work(joint, task)` of every joint, in the order of `tasks`; see `each_joint`."""
    results: dict[str, Found] = {}
    with Workers(workers) as pool:
        for joint, task in tasks.items():
            pool.submit(joint, work, joint, task)
        for joint, result in pool.results():
            results[joint] = result
            if progress:
                progress(joint)
    return {joint: results[joint] for joint in tasks}
