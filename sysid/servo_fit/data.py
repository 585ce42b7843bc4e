"""Data for fitting servo models: commands by control tick, readings at the time they were taken.

A servo model steps once per command, so its clock is the tick: position `k` is that at which
command `k` is sent, after commands up to `k - 1`. A reading was taken at a fractional tick, where
models are interpolated by a cubic (`look_up`): linear interpolation of a 4 Hz motion between ticks
19 ms apart has an error of several mrad.

Where the feedback is held (more than a fifth of the rows repeat the one before while the servo
moves), only fresh readings count, each at its own time; otherwise every row as logged.

Every row has the instants at which its reading may have been measured (`Run.reading_tick`): the
one found, where the poll lattice is known, else that of the read. `sysid.servo_fit.scores` puts
the instants of a known bus in their place; a predicted reading is the mean of a model over them.

Trials that follow each other without a pause, like the loops of a playback, are one run. Nothing is
carried over a pause. Every reading belongs to a group (its loop, or its tone), so that whole groups
can be held out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.doctor.checks import joint_rng, joint_trials
from pupper_sysid.sysid.feedback.poll_lattice import (
    PollLattice,
    Readings,
    find_poll_lattice,
    fresh_rows,
    readings,
)
from pupper_sysid.sysid.fit.run import Run as PhysicsRun
from pupper_sysid.sysid.fit.run import prepare
from pupper_sysid.sysid.recordings.recording import Recording, Trial

_HELD_FRACTION = 0.2  # the doctor's limit, beyond which raw rows mislead
_PAUSE = 1.5  # in ticks; a longer gap ends a run
_SAME_RATE = 0.05


@dataclass(frozen=True)
class Run:
    """Rows of one joint without a pause; arrays are over its rows unless a shape is given."""

    trial: Trial
    """All rows, merged."""
    readings: Readings
    """Those that count, over `fresh` entries."""
    tick: NDArray[np.float64]
    position_rad: NDArray[np.float64]
    """`tick` and `position_rad`: their times, in ticks, and values [rad], shape (fresh,)."""
    row_tick: NDArray[np.float64]
    held_tick: NDArray[np.float64]
    """`row_tick` and `held_tick`: when each row was read, and when its value was taken (NaN if
    before the run)."""
    reading_tick: NDArray[np.float64]
    """Equally probable instants at which each row's reading was measured, shape (rows,
    instants)."""
    number: NDArray[np.int64]
    group: NDArray[np.int64]
    """`number` and `group`: trial number in its recording; index into `ServoData.groups`, -1 for
    rows of no group."""
    elapsed_s: NDArray[np.float64]
    """Since the first command of the row's trial."""
    recording: int
    """Place of the recording that the run belongs to."""
    rest_known: bool
    """Whether the recording says where the run began; otherwise its first reading is taken."""

    @property
    def command_rad(self) -> NDArray[np.float64]:
        """Commands [rad], one per tick."""
        return self.trial.command_rad

    @property
    def initial_rad(self) -> float:
        """The command before the first, or what is known of it [rad]."""
        return self.trial.initial_command_rad

    @property
    def reading_elapsed_s(self) -> NDArray[np.float64]:
        """Time of each counted reading since the start of its trial [s]."""
        row = self.readings.rows
        start = self.trial.send_time_s[row] - self.elapsed_s[row]
        return self.readings.time_s - start

    def on_physics(self, used: NDArray[np.bool_]) -> PhysicsRun:
        """The run on the clock of physics, with only the readings of `used`, shape (fresh,)."""
        return prepare(self.trial, self.readings.only(used)).in_free_air()


@dataclass(frozen=True)
class ServoData:
    """Runs of some joints, all at one rate."""

    joints: tuple[str, ...]
    period_s: float
    """Time between commands."""
    runs: dict[str, tuple[Run, ...]]
    groups: tuple[str, ...]
    """Groups to hold out: "loop 0", "3 Hz", …"""
    modes: dict[str, str]
    """"fresh" or "all": which readings of the joint count."""
    lattices: dict[str, PollLattice]
    """Poll of each joint's readings, as far as these recordings show it."""


def servo_data(
    recordings: Sequence[Recording],
    joints: Sequence[str],
    mode: str = "auto",
    seed: int = 0,
    lattices: Mapping[str, PollLattice] | None = None,
) -> ServoData:
    """Arrange recordings for fitting or scoring servo models.

    `mode` ("auto", "fresh" or "all") says which readings count; `auto` decides per joint, as the
    module's text describes. `seed` is of the search for the poll of those joints that `lattices`
    lacks.
    """
    periods = sorted((r.loop_period_s, r.name) for r in recordings)
    (shortest, fast), (longest, slow) = periods[0], periods[-1]
    if not longest / shortest - 1 < _SAME_RATE:
        raise InputError(
            f"Recordings of different rates cannot be pooled: {fast} has a command every "
            f"{1e3 * shortest:.1f} ms, {slow} every {1e3 * longest:.1f} ms. Fit them one by one."
        )
    period = float(np.median([p for p, _ in periods]))
    labels: dict[str, int] = {}
    runs: dict[str, tuple[Run, ...]] = {}
    modes: dict[str, str] = {}
    polls: dict[str, PollLattice] = {}
    for joint in joints:
        known = (lattices or {}).get(joint)
        joint_runs, modes[joint], polls[joint] = _joint_runs(
            recordings, joint, mode, period, labels, seed, known
        )
        if not sum(len(r.tick) for r in joint_runs):
            raise InputError(f"{joint}: no reading changed; a model cannot be fitted.")
        runs[joint] = tuple(joint_runs)
    return ServoData(tuple(joints), period, runs, tuple(labels), modes, polls)


def look_up_weights(tick: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Tick before each of `tick`, shape (n,), and weights of a Catmull-Rom cubic, shape (n, 4).

    The weights are of the ticks `index - 1` to `index + 2`.
    """
    index = np.floor(tick).astype(int)
    t = tick - index
    weight = np.stack(
        [
            -0.5 * t**3 + t**2 - 0.5 * t,
            1.5 * t**3 - 2.5 * t**2 + 1.0,
            -1.5 * t**3 + 2.0 * t**2 + 0.5 * t,
            0.5 * t**3 - 0.5 * t**2,
        ],
        axis=-1,
    )
    return index, weight


def look_up(track: NDArray[np.floating], tick: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values of `track`, one per tick, at fractional ticks; NaN where the tick is NaN."""
    index, weight = look_up_weights(np.nan_to_num(tick))
    four = np.clip(index[:, None] + np.arange(-1, 3), 0, len(track) - 1)
    return np.where(
        np.isfinite(tick), np.sum(np.asarray(track, float)[four] * weight, axis=1), np.nan
    )


def _joint_runs(
    recordings: Sequence[Recording],
    joint: str,
    mode: str,
    period: float,
    labels: dict[str, int],
    seed: int,
    poll: PollLattice | None,
) -> tuple[list[Run], str, PollLattice]:
    trials = joint_trials(recordings, joint)
    if not trials:
        raise InputError(f"{joint} was not recorded. Leave it out of `joints`.")
    lattice = poll or find_poll_lattice(trials, joint_rng(seed, joint))
    if mode == "auto":
        held = 1 - _fresh_while_moving(trials) > _HELD_FRACTION
        mode = "fresh" if held and lattice.kind != "every read" else "all"
    timed = iter([readings(t, lattice) for t in trials])
    runs = []
    for place, recording in enumerate(recordings):
        trials_here = recording.trials(joint)
        known = joint in (recording.metadata.get("start_pose_rad") or {})
        prefix = f"{recording.name}, " if len(recordings) > 1 else ""
        joined: list[list[_Part]] = []
        for trial in trials_here:
            tone = np.isfinite(trial.frequency_hz) and trial.frequency_hz > 0
            name = f"{trial.frequency_hz:g} Hz" if tone else f"{prefix}loop {trial.number}"
            group = labels.setdefault(name, len(labels))
            counted = next(timed)
            if mode == "all":
                rows = np.flatnonzero(np.isfinite(trial.position_rad))
                time_s, position = trial.read_time_s[rows], trial.position_rad[rows]
                counted = replace(counted, rows=rows, time_s=time_s, position_rad=position)
            if not known:
                first = trial.position_rad[np.isfinite(trial.position_rad)][:1]
                rest = float(first[0]) if len(first) else trial.initial_command_rad
                trial = replace(trial, initial_command_rad=rest)
            for part in _without_pauses(trial, counted, group, period):
                begins = part[0].send_time_s[0]
                gap = begins - joined[-1][-1][0].send_time_s[-1] if joined else np.inf
                if 0 < gap < _PAUSE * period:
                    joined[-1].append(part)
                else:
                    joined.append([part])
        dated = lattice.kind == "lattice"
        runs += [_run(parts, period, place, dated, known) for parts in joined]
    return runs, mode, lattice


def _fresh_while_moving(trials: Sequence[Trial]) -> float:
    """Share of rows whose value changed, among rows while the command moves."""
    changed, moving = 0, 0
    for t in trials:
        move = np.abs(np.diff(t.command_rad, prepend=t.initial_command_rad)) > 0.005
        move = np.convolve(move, np.ones(3))[1:-1] > 0
        move &= np.isfinite(t.position_rad)
        changed, moving = changed + int(move[fresh_rows(t)].sum()), moving + int(move.sum())
    return changed / max(moving, 1)


_ROWS = ("send_time_s", "read_time_s", "command_rad", "position_rad")
_Part = tuple[Trial, Readings, int, float]


def _without_pauses(trial: Trial, r: Readings, group: int, period: float) -> list[_Part]:
    """Parts of a trial between missing rows, each with its group and its trial's start."""
    gaps = np.flatnonzero(np.diff(trial.send_time_s) > _PAUSE * period) + 1
    start = float(trial.send_time_s[0])
    parts, rest = [], trial.initial_command_rad
    for low, high in zip([0, *gaps], [*gaps, len(trial.send_time_s)], strict=True):
        rows = {name: getattr(trial, name)[low:high] for name in _ROWS}
        counted = r.only((r.rows >= low) & (r.rows < high))
        counted = replace(counted, rows=counted.rows - low, held_time_s=r.held_time_s[low:high])
        cut = replace(trial, **rows, position_count=None, initial_command_rad=rest)
        parts.append((cut, counted, group, start))
        rest = float(trial.command_rad[high - 1])
    return parts


def _run(parts: list[_Part], period: float, recording: int, dated: bool, pose_known: bool) -> Run:
    trials = [p[0] for p in parts]
    sizes = [len(t.send_time_s) for t in trials]
    merged = replace(
        trials[0], **{n: np.concatenate([getattr(t, n) for t in trials]) for n in _ROWS}
    )
    shift = np.cumsum([0, *sizes[:-1]])
    r = Readings(
        np.concatenate([p[1].rows + s for p, s in zip(parts, shift, strict=True)]),
        np.concatenate([p[1].time_s for p in parts]),
        np.concatenate([p[1].position_rad for p in parts]),
        np.concatenate([p[1].held_time_s for p in parts]),
        parts[0][1].time_sd_s,
    )
    r = r.only(r.time_s >= merged.send_time_s[0])
    edges = np.append(merged.send_time_s, merged.send_time_s[-1] + period)
    ticks = np.arange(len(edges), dtype=float)

    def to_tick(time: NDArray) -> NDArray[np.float64]:
        return np.where(np.isfinite(time), np.interp(time, edges, ticks), np.nan)

    # after a gap a run begins at the last command
    rest_known = pose_known or bool(merged.send_time_s[0] > parts[0][3])
    held = to_tick(np.where(r.held_time_s >= edges[0], r.held_time_s, np.nan))
    read = to_tick(merged.read_time_s)
    measured = (held if dated else read)[:, None]
    return Run(
        merged, r, to_tick(r.time_s), r.position_rad, read, held, measured,
        np.repeat([t.number for t in trials], sizes), np.repeat([p[2] for p in parts], sizes),
        merged.send_time_s - np.repeat([p[3] for p in parts], sizes), recording, rest_known,
    )  # fmt: skip
