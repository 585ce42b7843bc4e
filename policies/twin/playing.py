"""From a recording to the simulated robot, and back: commands per physics step, tracks per joint.

Runs of a recording that begin together are one sequence of commands for the whole robot; a joint
without a run in it is held where it begins elsewhere. `Sequences` is what `play` lets copies of the
robot do, in the air and on the ground.

Evidence on whether the robot was on the ground: the simulated robot predicts readings twice, in the
air (a) and on the ground (g). Two things differ between the two, and each is evidence of its own:

* motion: within a joint, over time. The share of the difference g - a that is found in readings
  less a, by least squares over all joints, each weighted by the variance of its errors: 0 in the
  air, 1 on the ground; and the correlation of the two. Servos that are simulated wrongly leave
  errors, too. A wrong gain, damping, dead time or inertia looks like a and its derivatives, so what
  a constant, a, its speed and its acceleration explain of either is taken out before, joint by
  joint. Intervals resample stretches of time.
* load: between joints, over the whole recording. Legs that carry the robot sag. The share of the
  mean difference of each joint that is found in its offset, by least squares over joints, with
  Student's t. Zeros of joints are unknown, and are the errors of this line. Those that joints of
  one kind (all thighs) have in common can look like a load, so one unknown per kind, in the
  direction of its sags, stands beside the share: only how the sag differs between legs counts.

Torques of an actuator that was measured in free air are known to a factor only, and with them the
size of g - a: of a robot with strong servos the ground shows little. So both shares are taken
twice, with the torques as they are and `STRONGER` times as large. The verdict is that of motion:
"ground" if the interval of its correlation is above 0.08 in one of the two (in the air, wrong
servos alone reach 0.06: `benchmarks/twin_verdicts.py`), and "air" if in both its shares are within
±0.25 and its correlations below 0.06. That is no proof of the air: still stronger servos would hide
the ground. The load is reported beside it and decides nothing: an interval of 90 % lies above 0 in
one of twenty robots in the air.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval, t_quantile
from pupper_sysid.common.results import Result, internal
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sim.robot.replay import Replayed, ServoRobot, replay
from pupper_sysid.sim.walking.config import Randomisation
from pupper_sysid.sysid.servo_fit.data import Run, ServoData
from pupper_sysid.sysid.servo_fit.scores import (
    Errors,
    Tracks,
    block_draws,
    counted_ticks,
    interval,
    on_ticks,
    predicted,
    received,
    steps_per_tick,
)
from pupper_sysid.sysid.servo_fit.windows import Part, chosen

Array = NDArray[np.float64]

_PAYLOAD = 0.1
"""Share of its mass by which a robot on the ground is lighter or heavier than its model."""
_MOST_BYTES = 1 << 30  # of the motion of the copies that are simulated at a time


@dataclass(frozen=True)
class Sequences:
    """Commands of a recording for the whole robot."""

    runs: tuple[dict[str, int], ...]
    """Of each sequence, by joint, the place of its run in `ServoData.runs`."""
    commands: Array
    """Set-points [rad] as `sim.robot.replay` takes them, shape (sequences, steps + 1, joints)."""
    reach: Array
    """Angles at which the robot was [rad], shape (rows, joints)."""


def sequences(data: ServoData, robot: ServoRobot) -> Sequences:
    """Commands of the recorded joints for the whole robot.

    The robot has all joints of `data`.
    """
    by_start: dict[tuple, dict[str, int]] = {}
    for joint in data.joints:
        for place, run in enumerate(data.runs[joint]):
            begins = round(float(run.trial.send_time_s[0]) / data.period_s)
            key = (run.recording, int(run.number[0]), begins)
            by_start.setdefault(key, {})[joint] = place
    idle = robot.rest_rad.copy()
    for joint in data.joints:
        idle[robot.joints.index(joint)] = _start(data.runs[joint][0])
    arrived = [
        {j: received(data.runs[j][place], data.period_s) for j, place in of_joint.items()}
        for of_joint in by_start.values()
    ]
    steps = max(len(command) for of_joint in arrived for command in of_joint.values())
    if 8.0 * len(by_start) * steps * len(idle) > _MOST_BYTES:
        raise _too_much(len(by_start), steps)
    commands = np.tile(idle, (len(by_start), steps + 1, 1))
    reach = [idle[None]]
    for sequence, (of_joint, places) in enumerate(zip(arrived, by_start.values(), strict=True)):
        rows = max(len(data.runs[j][place].command_rad) for j, place in places.items())
        been = np.tile(idle, (rows, 1))
        for joint, command in of_joint.items():
            n, run = robot.joints.index(joint), data.runs[joint][places[joint]]
            commands[sequence, 0, n] = _start(run)
            commands[sequence, 1 : 1 + len(command), n] = command
            commands[sequence, 1 + len(command) :, n] = command[-1]
            seen = run.trial.position_rad - _shift(run)
            been[: len(seen), n] = np.where(np.isfinite(seen), seen, idle[n])
        reach.append(been)
    return Sequences(tuple(by_start.values()), commands, np.concatenate(reach))


@dataclass(frozen=True)
class Played:
    """Motion of the copies with one actuator."""

    tracks: Tracks
    """Of the servos, in the mean over the copies that stayed up; over all where none did."""
    copies: int
    upright: int
    """`copies` and `upright`: how many there were, over all sequences, and how many of them stayed
    up."""
    first_fall_s: float
    """When the first of them fell [s]; infinite if none did."""
    gyro: tuple[Array, ...]
    """Rates [rad/s] of each that stayed up, during the first sequence, shape (samples, 3)."""


def play(
    robot: ServoRobot,
    fixed: bool,
    servos: Sequence[Mapping[str, Array]],
    motions: Sequences,
    data: ServoData,
    copies: int,
    seed: int,
    threads: int,
    progress: Callable[[float], None] = lambda share: None,
) -> list[Played]:
    """Let copies of the robot do what was commanded, with each of several actuators.

    In the air (`fixed`) one copy per actuator is enough: nothing is drawn. On the ground each of
    the `copies` has another friction and payload, the same for every actuator. Servos are by
    field of `DelayedPDParameters`, shape (joints,), of each actuator.
    """
    count, rng = 1 if fixed else copies, np.random.default_rng(seed)
    friction = rng.uniform(*Randomisation().friction, count)
    payload = rng.uniform(-_PAYLOAD, _PAYLOAD, count) * (not fixed)
    total = len(motions.runs) * count
    _, steps, joints = motions.commands.shape
    together = int(_MOST_BYTES / (4.0 * total * steps * joints))
    if not together:
        raise _too_much(total, steps)
    which = np.repeat(np.arange(len(motions.runs)), count)
    results: list[Played] = []
    for at in range(0, len(servos), together):
        group = servos[at : at + together]
        values = {
            name: np.repeat(np.stack([s[name] for s in group]), total, axis=0) for name in group[0]
        }
        done, part = at / len(servos), len(group) / len(servos)
        moved = replay(
            robot, fixed, values, motions.commands, np.tile(which, len(group)), motions.reach,
            np.tile(friction, total // count * len(group)),
            np.tile(payload, total // count * len(group)), threads,
            lambda share, done=done, part=part: progress(done + part * share),
        )  # fmt: skip
        for k in range(len(group)):
            rows = slice(k * total, (k + 1) * total)
            replayed = Replayed(moved.servo_rad[rows], moved.fell_s[rows], moved.gyro_rad_s[rows])
            results.append(_played(replayed, robot, motions, data, count, fixed))
    return results


def _played(
    moved: Replayed, robot: ServoRobot, motions: Sequences, data: ServoData, count: int, fixed: bool
) -> Played:
    tracks: Tracks = {j: [np.empty(0)] * len(runs) for j, runs in data.runs.items()}
    for sequence, places in enumerate(motions.runs):
        rows = slice(sequence * count, (sequence + 1) * count)
        up = ~np.isfinite(moved.fell_s[rows])
        mean = moved.servo_rad[rows][up if up.any() else slice(None)].mean(axis=0, dtype=float)
        for joint, place in places.items():
            angle = mean[:, robot.joints.index(joint)]
            tracks[joint][place] = on_ticks(angle, data.runs[joint][place], data.period_s)
    upright = ~np.isfinite(moved.fell_s)
    gyro = () if fixed else tuple(moved.gyro_rad_s[:count][upright[:count]])
    return Played(tracks, len(upright), int(upright.sum()), float(moved.fell_s.min()), gyro)


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


@dataclass(frozen=True, kw_only=True)
class Gyro(Result):
    """Spectrum of a gyro; each number for x, y and z."""

    deviation_rad_s: tuple[float, ...]
    """Standard deviation; of several robots their mean."""
    peak_hz: tuple[float, ...]
    """Frequency of 0.5 to 10 Hz whose sine explains most; NaN of an axis that does not turn."""
    peak_share: tuple[float, ...]
    """Share of the variance that this sine explains."""


@dataclass(frozen=True, kw_only=True)
class TwinErrors(Result):
    """Errors of the simulated robot on one joint, or their means over joints [rad]."""

    mae_rad: float
    rmse_rad: float
    """`mae_rad` and `rmse_rad`: mean absolute and root mean square error of the readings that
    count: raw rows against predicted readings, or fresh ones where the recording dates
    them."""
    rmse_raw_rad: float
    """Of raw rows."""
    offset_rad: float
    """Reading minus prediction, taken out of all."""


@dataclass(frozen=True, kw_only=True)
class Condition(Result):
    """The simulated robot in the air or on the ground."""

    joints: dict[str, TwinErrors]
    mean: TwinErrors
    """Over joints; of the offset, the mean of its size."""
    rmse_rad: Interval
    """Of the mean."""
    copies: int
    upright: int
    """`copies` and `upright`: simulated robots, and how many of them stayed up."""
    first_fall_s: float | None
    """When the first fell [s]."""
    gyro: Gyro | None
    """Of those that stayed up; None in the air, or of less than seven seconds."""
    errors: dict[str, Errors] = internal()
    tracks: Tracks = internal()


Verdict = Literal["ground", "air", "cannot tell"]

STRONGER = 4.0
"""Factor of the torques in the second case."""

_CORRELATED, _UNCORRELATED, _NONE = 0.08, 0.06, 0.25
_FEWEST_FREE = 3  # degrees of freedom of a load share
_WHY: dict[Verdict, str] = {
    "ground": "The robot was on the ground: its joints deviate as under the simulated load.",
    "air": (
        "The robot was in the air, unless its servos are more than "
        f"{STRONGER:g} times as strong as this actuator's: its joints show nothing of the load."
    ),
    "cannot tell": "The motion of the joints does not separate the ground from the air.",
}


@dataclass(frozen=True, kw_only=True)
class Motion(Result):
    """How much of the difference between ground and air the readings show over time."""

    share: Interval
    correlation: Interval


@dataclass(frozen=True, kw_only=True)
class Evidence(Result):
    """What readings say of where the robot was."""

    verdict: Verdict
    difference_rad: Interval
    """Mean error on the ground less that in the air, with the torques as they are."""
    motion: list[Motion | None]
    """With the torques as they are, and stronger; None where there is nothing to tell it from."""
    load_share: list[Interval | None]
    why: str
    """The verdict's reason, in a sentence."""


def evidence(
    cases: Sequence[tuple[Condition, Condition]], data: ServoData, part: Part, seed: int
) -> Evidence:
    """What predictions of the same readings in the air and on the ground say.

    Cases are in the air and on the ground, with the torques as they are, and stronger; `part`
    chooses the readings that count; the seed is the bootstrap's.
    """
    motion = [_motion(air, ground, data, part, seed) for air, ground in cases]
    load = [
        _load_share({j: (e.offset_rad, ground.joints[j].offset_rad) for j, e in air.joints.items()})
        for air, ground in cases
    ]
    in_air, on_ground = cases[0]
    nothing = [
        m is not None and -_NONE < m.share.low and m.share.high < _NONE
        and m.correlation.high < _UNCORRELATED
        for m in motion
    ]  # fmt: skip
    verdict: Verdict = "air" if all(nothing) else "cannot tell"
    if any(m is not None and m.correlation.low > _CORRELATED for m in motion):
        verdict = "ground"
    return Evidence(
        verdict=verdict, motion=motion, load_share=load, why=_WHY[verdict],
        difference_rad=interval(on_ground.errors, seed, in_air.errors),
    )  # fmt: skip


def _motion(
    air: Condition, ground: Condition, data: ServoData, part: Part, seed: int
) -> Motion | None:
    place, draws = block_draws(air.errors, seed)
    sums = np.zeros((3, len(place)))
    for joint, errors in air.errors.items():
        moved, error_rad = _unexplained(air.tracks, ground.tracks, joint, data, part)
        index, weight = [place[b] for b in errors.block], 1.0 / max(float(error_rad.var()), 1e-12)
        for row, product in zip(sums, (error_rad * moved, moved**2, error_rad**2), strict=True):
            row += weight * np.bincount(index, product, len(place))
    if not sums[1].sum() > 1e-12 * len(place):
        return None
    together, moved, error = (np.append(draws @ row, row.sum()) for row in sums)
    moved = np.maximum(moved, 1e-300)
    share, correlation = together / moved, together / np.sqrt(moved * np.maximum(error, 1e-300))
    return Motion(
        share=Interval.of_draws(float(share[-1]), share[:-1]),
        correlation=Interval.of_draws(float(correlation[-1]), correlation[:-1]),
    )


def _unexplained(
    in_air: Tracks, on_ground: Tracks, joint: str, data: ServoData, part: Part
) -> tuple[Array, Array]:
    """Ground less air and reading less air, without what a wrong servo explains, by reading."""
    rows = []
    for n, run in enumerate(data.runs[joint]):
        air, ground = in_air[joint][n], on_ground[joint][n]
        rate = steps_per_tick(air, run) / data.period_s
        speed = np.gradient(air) * rate
        when = counted_ticks(run, data.modes[joint])
        seen = np.stack([predicted(track, run, when) for track in
                         (air, speed, np.gradient(speed) * rate, ground)])  # fmt: skip
        counts = chosen(run, part) & np.isfinite(seen[0] - run.position_rad)  # as `scores.errors`
        rows.append(np.vstack([seen, run.position_rad])[:, counts])
    air, speed, acceleration, ground, reading = np.concatenate(rows, axis=1)
    servo, _ = np.linalg.qr(np.stack([np.ones(len(air)), air, speed, acceleration], axis=1))
    effect, error = ground - air, reading - air
    return effect - servo @ (servo.T @ effect), error - servo @ (servo.T @ error)


def _load_share(offsets: Mapping[str, tuple[float, float]]) -> Interval | None:
    in_air, on_ground = np.array(list(offsets.values())).T
    sag = in_air - on_ground
    kinds = np.array([joint.partition("_")[2] for joint in offsets])
    common = [np.where(kinds == kind, np.sign(sag), 0.0) for kind in sorted(set(kinds))]
    design = np.stack([sag, *common], axis=1)
    free = len(sag) - np.linalg.matrix_rank(design)
    if free < _FEWEST_FREE or np.linalg.matrix_rank(design) < design.shape[1]:
        return None
    solution = np.linalg.lstsq(design, in_air)[0]
    residuals = in_air - design @ solution
    variance = np.linalg.inv(design.T @ design)[0, 0] * float(residuals @ residuals) / free
    half = t_quantile(int(free)) * float(np.sqrt(variance))
    return Interval(float(solution[0]), float(solution[0]) - half, float(solution[0]) + half)
