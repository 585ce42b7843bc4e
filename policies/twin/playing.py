"""From a recording to the simulated robot, and back: commands per physics step, tracks per joint.

Runs of a recording that begin together are one sequence of commands for the whole robot; a joint
without a run in it is held where it begins elsewhere. `Sequences` is what `play` lets copies of the
robot do, in the air and on the ground.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sim.robot.replay import Replayed, replay
from pupper_sysid.sim.walking.config import Randomisation
from pupper_sysid.sysid.servo_fit.data import Run, ServoData
from pupper_sysid.sysid.servo_fit.readings import on_ticks, received
from pupper_sysid.sysid.servo_fit.scores import Tracks

if TYPE_CHECKING:
    from pupper_sysid.sim.robot.servo_robot import ServoRobot

Array = NDArray[np.float64]

_PAYLOAD = 0.1
"""Share of its mass by which a robot on the ground is lighter or heavier than its model."""
_MOST_BYTES = 1 << 30  # of the motion of the copies that are simulated at a time


@dataclass(frozen=True)
class Sequences:
    """Commands of a recording for the whole robot.

    Attributes
    ----------
    runs : tuple of dict of str to int
        Of each sequence, by joint, the place of its run in `ServoData.runs`.
    commands : ndarray, shape (sequences, steps + 1, joints)
        Set-points [rad] as `sim.robot.replay` takes them.
    reach : ndarray, shape (rows, joints)
        Angles at which the robot was [rad].
    """

    runs: tuple[dict[str, int], ...]
    commands: Array
    reach: Array


def sequences(data: ServoData, robot: ServoRobot) -> Sequences:
    """Commands of the recorded joints for the whole robot.

    Parameters
    ----------
    data : ServoData
    robot : ServoRobot
        Has all joints of `data`.
    """
    found: dict[tuple, dict[str, int]] = {}
    for joint in data.joints:
        for place, run in enumerate(data.runs[joint]):
            begins = round(float(run.trial.send_time_s[0]) / data.period_s)
            key = (run.recording, int(run.number[0]), begins)
            found.setdefault(key, {})[joint] = place
    idle = robot.rest_rad.copy()
    for joint in data.joints:
        idle[robot.joints.index(joint)] = _start(data.runs[joint][0])
    arrived = [
        {j: received(data.runs[j][place], data.period_s) for j, place in own.items()}
        for own in found.values()
    ]
    steps = max(len(command) for own in arrived for command in own.values())
    if 8.0 * len(found) * steps * len(idle) > _MOST_BYTES:
        raise _too_much(len(found), steps)
    commands = np.tile(idle, (len(found), steps + 1, 1))
    reach = [idle[None]]
    for sequence, (own, places) in enumerate(zip(arrived, found.values(), strict=True)):
        rows = max(len(data.runs[j][place].command_rad) for j, place in places.items())
        been = np.tile(idle, (rows, 1))
        for joint, command in own.items():
            n, run = robot.joints.index(joint), data.runs[joint][places[joint]]
            commands[sequence, 0, n] = _start(run)
            commands[sequence, 1 : 1 + len(command), n] = command
            commands[sequence, 1 + len(command) :, n] = command[-1]
            seen = run.trial.position_rad - _shift(run)
            been[: len(seen), n] = np.where(np.isfinite(seen), seen, idle[n])
        reach.append(been)
    return Sequences(tuple(found.values()), commands, np.concatenate(reach))


@dataclass(frozen=True)
class Played:
    """Motion of the copies with one actuator.

    Attributes
    ----------
    tracks : Tracks
        Of the servos, in the mean over the copies that stayed up; over all where none did.
    copies, upright : int
        How many there were, over all sequences, and how many of them stayed up.
    first_fall_s : float
        When the first of them fell [s]; infinite if none did.
    gyro : tuple of ndarray, shape (samples, 3)
        Rates [rad/s] of each that stayed up, during the first sequence.
    """

    tracks: Tracks
    copies: int
    upright: int
    first_fall_s: float
    gyro: tuple[Array, ...]


def play(
    robot: ServoRobot,
    fixed: bool,
    servos: Sequence[Mapping[str, Array]],
    given: Sequences,
    data: ServoData,
    copies: int,
    seed: int,
    threads: int,
    progress: Callable[[float], None] = lambda share: None,
) -> list[Played]:
    """Let copies of the robot do what was commanded, with each of several actuators.

    Parameters
    ----------
    robot : ServoRobot
    fixed : bool
        In the air, where one copy per actuator is enough: nothing is drawn.
    servos : sequence of mapping of str to ndarray, shape (joints,)
        Of each actuator, by field of `DelayedPDParameters`.
    given : Sequences
    data : ServoData
    copies : int
        On the ground; each with a friction and a payload of its own, the same for every actuator.
    seed, threads : int
    progress : callable
        Called with the share that is done.
    """
    count, rng = 1 if fixed else copies, np.random.default_rng(seed)
    friction = rng.uniform(*Randomisation().friction, count)
    payload = rng.uniform(-_PAYLOAD, _PAYLOAD, count) * (not fixed)
    total = len(given.runs) * count
    _, steps, joints = given.commands.shape
    together = int(_MOST_BYTES / (4.0 * total * steps * joints))
    if not together:
        raise _too_much(total, steps)
    which = np.repeat(np.arange(len(given.runs)), count)
    found: list[Played] = []
    for at in range(0, len(servos), together):
        own = servos[at : at + together]
        values = {
            name: np.repeat(np.stack([s[name] for s in own]), total, axis=0) for name in own[0]
        }
        done, part = at / len(servos), len(own) / len(servos)
        moved = replay(
            robot, fixed, values, given.commands, np.tile(which, len(own)), given.reach,
            np.tile(friction, total // count * len(own)),
            np.tile(payload, total // count * len(own)), threads,
            lambda share, done=done, part=part: progress(done + part * share),
        )  # fmt: skip
        for k in range(len(own)):
            rows = slice(k * total, (k + 1) * total)
            one = Replayed(moved.servo_rad[rows], moved.fell_s[rows], moved.gyro_rad_s[rows])
            found.append(_played(one, robot, given, data, count, fixed))
    return found


def _played(
    moved: Replayed, robot: ServoRobot, given: Sequences, data: ServoData, count: int, fixed: bool
) -> Played:
    tracks: Tracks = {j: [np.empty(0)] * len(runs) for j, runs in data.runs.items()}
    for sequence, places in enumerate(given.runs):
        rows = slice(sequence * count, (sequence + 1) * count)
        up = ~np.isfinite(moved.fell_s[rows])
        mean = moved.servo_rad[rows][up if up.any() else slice(None)].mean(axis=0, dtype=float)
        for joint, place in places.items():
            angle = mean[:, robot.joints.index(joint)]
            tracks[joint][place] = on_ticks(angle, data.runs[joint][place], data.period_s)
    upright = ~np.isfinite(moved.fell_s)
    gyro = () if fixed else tuple(moved.gyro_rad_s[:count][upright[:count]])
    return Played(
        tracks, len(upright), int(upright.sum()), float(moved.fell_s.min()), gyro
    )  # fmt: skip


def _too_much(robots: int, steps: int) -> InputError:
    return InputError(
        f"{robots} robots over {steps * TIME_STEP_S:.0f} s do not fit the memory. Take fewer "
        "`robots`, or a part of the recording."
    )


def _start(run: Run) -> float:
    """Set-point before the first command [rad]; where it is not known, the first reading's."""
    return run.initial_rad if run.rest_known else run.initial_rad - _shift(run)


def _shift(run: Run) -> float:
    """Median of reading minus command [rad]: the recording's zero, and the servos' sag."""
    apart = run.trial.position_rad - run.command_rad
    return float(np.nanmedian(apart)) if np.isfinite(apart).any() else 0.0
