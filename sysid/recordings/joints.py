"""Work per joint over one or several recordings: pooled trials, seeds, processes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import TypeVar
from zlib import crc32

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES, in_order, select_joints
from pupper_sysid.common.processes.workers import Workers, prepare
from pupper_sysid.sysid.doctor.checks import refuse_unusable
from pupper_sysid.sysid.recordings.excitation import named_tones, without_bad_readings
from pupper_sysid.sysid.recordings.recording import Recording, Trial

Recordings = Recording | Sequence[Recording]
"""One recording, or several whose trials are pooled per joint."""

Joints = str | Sequence[str] | None
"""Names of joints; a text as `common.joints.select_joints` reads it; None for all."""

Found = TypeVar("Found")


def as_sequence(recordings: Recordings) -> Sequence[Recording]:
    """The recordings as a sequence."""
    whole = isinstance(recordings, str | PurePath | Mapping) or not isinstance(recordings, Iterable)
    several = [recordings] if whole or _is_frame(recordings) else list(recordings)
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
    """All trials of `joint` as they were recorded, renumbered."""
    trials = [trial for recording in as_sequence(recordings) for trial in recording.trials(joint)]
    return tuple(replace(trial, number=n) for n, trial in enumerate(trials))


def joint_trials(recordings: Recordings, joint: str) -> tuple[Trial, ...]:
    """All trials of `joint` without bad readings, each tone of a command as its own, renumbered."""
    trials = named_tones([without_bad_readings(t) for t in recorded_trials(recordings, joint)])
    return tuple(replace(trial, number=n) for n, trial in enumerate(trials))


def usable_trials(recordings: Recordings, joints: Joints = None) -> dict[str, tuple[Trial, ...]]:
    """All trials by joint, in joint order.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
    joints : str or sequence of str, optional
        Which joints; by default all that were recorded.
    """
    chosen = chosen_joints(recordings, joints)
    refuse_unusable({j: recorded_trials(recordings, j) for j in chosen})
    return {j: joint_trials(recordings, j) for j in chosen}


def joint_rng(seed: int, joint: str) -> np.random.Generator:
    """Generator of one joint: repeatable whatever other joints are computed."""
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

    Parameters
    ----------
    work : callable
        Must be picklable if there are several workers.
    recordings : Recording or sequence of Recording
    joints : str or sequence of str, optional
        Which joints; by default all that were recorded.
    workers : int
        Processes.
    progress : callable, optional
        Called with a joint's name when it is done.
    """
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
    """`work(joint, task)` of every joint, in the order of `tasks`; parameters as for `each_joint`.

    Parameters
    ----------
    work : callable
        Must be picklable if there are several workers.
    tasks : dict of joint to what `work` takes
    workers : int
        Processes.
    progress : callable, optional
        Called with a joint's name when it is done.
    """
    results: dict[str, Found] = {}
    with Workers(workers) as pool:
        for joint, task in tasks.items():
            pool.submit(joint, work, joint, task)
        for joint, result in pool.results():
            results[joint] = result
            if progress:
                progress(joint)
    return {joint: results[joint] for joint in tasks}
