"""Evaluation of a policy: falls and tracking errors over whole episodes.

Every episode lasts 20 s, with its own servos, friction and payload, commands drawn anew every few
seconds, and the measured feedback by default. Beside the policy, in the same batch, the same robots
walk under the same conditions by an open-loop trot, which sees nothing and has a clock, and others
stand: what a policy has learnt is what it does better than these. Errors are given at every control
step, start included, and of the mean velocity over a stride, since within a stride every trot
sways; a robot that fell counts as one that stands still until the end of its episode.

Episodes under all conditions run together (`policies.walks.together`). Episode k of every condition
has the same robot, so that rows differ by their conditions, not by their robots. Robots and terrain
are others than those of a training with the same seed.

The battery holds conditions that make walking robots fall. Usual conditions separate nothing: an
open-loop trot falls under none of them. These go on until it does: pushes, slopes, stairs, loads
off centre, a weak leg, missed control ticks, late and jittered servos, slippery ground, and all
that typically differs between a robot and its model (`sim.walking.draws.TYPICAL`). All are
walked under random commands.

`Figures` are the numbers of a row: falls, errors, speed, drift of the heading, feet, and effort of
servos.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from statistics import mode
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from pupper_sysid.common.interval import LEVEL, Interval, mean_of
from pupper_sysid.common.results import Result
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks.rollouts import (
    ERRORS,
    STRIDE_ERRORS,
    counted,
    heading,
    stride_errors,
    tracking_errors,
)
from pupper_sysid.policies.walks.together import (
    DIRECTIONS,
    Condition,
    Handicap,
    Moment,
    StepRecorder,
    Walker,
    evaluation_task,
    walk_together,
    within,
)
from pupper_sysid.sim.robot.mini_pupper import MASS_KG
from pupper_sysid.sim.robot.terrain import STAIRS_M, Terrain
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.draws import TYPICAL, Differences
from pupper_sysid.sim.walking.rewards import LOW_SWING_M, by_kind
from pupper_sysid.sim.walking.servo_ranges import ServoRanges
from pupper_sysid.sim.walking.step import FALLEN_TILT

Array = NDArray[np.float64]

START_S = 1.0
"""Time in which a robot starts to move, without which mean speeds are given [s]."""


@dataclass(frozen=True)
class Walk:
    """Episodes of one or more robots under one condition; zeros after a robot's last step."""

    step_s: float
    kinds: tuple[str, ...]
    """Of joints (`Body.kinds`)."""
    fell: NDArray[np.bool_]
    """Shape (episodes,)."""
    command: Array
    """Forward and sideways speed [m/s], turn rate [rad/s]; shape (steps, episodes, 3)."""
    velocity: Array
    contact: NDArray[np.bool_]
    """Feet on the ground; shape (steps, episodes, 4)."""
    alive: NDArray[np.bool_]
    """Shape (steps, episodes)."""
    gravity: Array
    """The ground's normal, downwards, in the trunk's frame; shape (steps, episodes, 3)."""
    heading: Array
    """Continuous [rad], shape (steps, episodes)."""
    slip_m_s: Array
    """Speed of the feet on the ground, summed over those; shape (steps, episodes)."""
    swing_s: Array
    """Length of the swings that ended, summed; shape (steps, episodes)."""
    swings: NDArray[np.int_]
    """How many ended; shape (steps, episodes)."""
    clearance_m: NDArray[np.float32]
    """Of the swings that ended, NaN of other feet; shape (steps, episodes, 4)."""
    saturated: NDArray[np.float32]
    """Share of the time at the torque limit by kind of joint; shape (steps, episodes, 3)."""
    torque_square: NDArray[np.float32]
    """Mean square of torque over limit by kind of joint; shape (steps, episodes, 3)."""
    work_j: Array
    """Positive work of all servos; shape (steps, episodes)."""
    carried_j: Array
    """Weight times distance; shape (steps, episodes)."""

    @property
    def error(self) -> Array:
        """Mean absolute errors at every control step, shape (episodes, 3)."""
        return tracking_errors(self.velocity, self.command, self.alive, self.fell)

    @property
    def stride_error(self) -> Array:
        """Mean absolute errors of the mean velocity over a stride, shape (episodes, 3)."""
        with np.errstate(divide="ignore"):
            stride_s = 1.0 / self.stride_hz
        return stride_errors(
            self.velocity, self.command, self.alive, self.fell, stride_s, self.step_s
        )

    @property
    def stride_hz(self) -> Array:
        """Strides per second of each robot while it was up, shape (episodes,)."""
        feet = self.contact.shape[-1]
        up_s = self.step_s * np.maximum(self.alive.sum(axis=0), 1)
        return self.swings.sum(axis=0) / feet / up_s

    @property
    def mean_velocity(self) -> Array:
        """Mean velocity after the first second, with falls as standing; shape (episodes, 3)."""
        velocity, counts = counted(self.velocity, self.alive, self.fell)
        first = min(round(START_S / self.step_s), len(velocity) // 2)
        weights = counts[first:, :, None]
        return (weights * velocity[first:]).sum(axis=0) / np.maximum(weights.sum(axis=0), 1)

    @property
    def drift_deg(self) -> Array:
        """Size of the change of heading over the episode; NaN of robots that did not finish it."""
        change = np.degrees(np.abs(self.heading[-1] - self.heading[0]))
        return np.where(self.alive[-1], change, np.nan)


@dataclass(frozen=True, kw_only=True)
class Figures(Result):
    """Figures of a number of episodes."""

    episodes: int
    fall_rate: float
    mae_vx_m_s: float
    """Of every control step, as the other two; see `policies.walks.rollouts`."""
    mae_vy_m_s: float
    mae_yaw_rad_s: float
    stride_mae_vx_m_s: float
    """Of the mean velocity over a stride, as the other two."""
    stride_mae_vy_m_s: float
    stride_mae_yaw_rad_s: float
    speed_share: float
    """Mean speed along the command over the commanded one after the first second, 0 after a fall;
    NaN for random commands and for standing."""
    mean_velocity: tuple[float, ...]
    """Forward, sideways, turning, after the first second; 0 after a fall."""
    heading_drift_deg: float
    """Mean size of the change of heading over the episode, of robots that finished it; NaN where
    the command turns."""
    duty: tuple[float, ...]
    """Share of time that each foot stands."""
    stride_hz: float
    """Strides per second."""
    swing_s: float
    """Mean length of a swing."""
    foot_slip_m_s: float
    """Mean speed of feet on the ground."""
    clearance_p10_m: float
    """Tenth percentile of the clearance over all swings: the largest height of the sole over the
    ground in a swing (`sim.walking.rewards`); NaN without a swing, as the next two."""
    clearance_p50_m: float
    """Its median."""
    low_swing_share: float
    """Share of the swings whose clearance is below 2 mm."""
    torque_saturated_share: dict[str, float]
    """Share of the time in which a servo is at its torque limit, by kind of joint (`hip`, `thigh`,
    `calf`)."""
    rms_torque_share: dict[str, float]
    """Root mean square of torque over its limit, by kind of joint."""
    mechanical_power_w: float
    """Mean positive work of all servos over time."""
    cost_of_transport: float
    """Positive work over weight times distance, of the mean motion over a stride; NaN where the
    command is to stay in place."""
    intervals: dict[str, Interval]
    """90 % intervals over episodes, of the share that fell by Clopper and Pearson, of the errors,
    the share of the speed and the drift by Student's t."""


class Recorder(StepRecorder[Walk]):
    """What figures are made of, for the robots of one environment."""

    def arrays(self, now: Moment) -> dict[str, NDArray]:
        """Columns of a `Walk`."""
        facts, step_s = now.facts, self.env.config.control_step_s
        standing = facts.contact & now.alive[:, None]
        ended = facts.swing_ended & now.alive[:, None]
        # of the mean motion over a stride
        travelled = step_s * np.linalg.norm(facts.stride_velocity[:, :2], axis=1)
        # before the first step a foot may have been elsewhere: its speed is not known
        slip = facts.foot_speed_m_s * standing if self.steps else np.zeros(standing.shape)
        return {
            "velocity": facts.planar_velocity, "contact": facts.contact, "alive": now.alive,
            "gravity": facts.gravity.astype(np.float32),
            "heading": heading(self.env.robots.qpos), "slip_m_s": slip.sum(axis=1),
            "swing_s": (facts.last_air_s * ended).sum(axis=1), "swings": ended.sum(axis=1),
            "clearance_m": np.where(ended, facts.clearance_m, np.nan).astype(np.float32),
            "saturated": by_kind(facts.body, facts.saturated).astype(np.float32),
            "torque_square": by_kind(facts.body, facts.torque_square).astype(np.float32),
            "work_j": step_s * facts.power_w, "carried_j": facts.weight_n * travelled,
        }  # fmt: skip

    def of(self, condition: Condition, robots: slice, steps: int, commands: Array) -> Walk:
        """The walk of a condition's robots."""
        arrays = self.stacked(robots, steps)
        arrays["heading"] = np.unwrap(arrays["heading"], axis=0)
        missing_steps = len(commands) - steps
        padded = {
            name: np.concatenate([x, np.zeros((missing_steps, *x.shape[1:]), x.dtype)])
            for name, x in arrays.items()
        }
        step_s, kinds = condition.task.control_step_s, tuple(self.env.body.kinds)
        return Walk(step_s, kinds, self.fell[robots], commands, **padded)


def figures_of(walk: Walk, command: tuple[float, float, float] | None = None) -> Figures:
    """Figures of a number of episodes; `command` is the fixed one, None for random ones."""
    alive = walk.alive
    standing, swings = (walk.contact & alive[..., None]).sum(), walk.swings.sum()
    values_of = dict(zip(ERRORS, walk.error.T, strict=True))
    values_of |= dict(zip(STRIDE_ERRORS, walk.stride_error.T, strict=True))
    nothing = np.full(len(walk.fell), np.nan)
    size = 0.0 if command is None else float(np.dot(command, command))
    values_of["speed_share"] = walk.mean_velocity @ np.array(command) / size if size else nothing
    drifts = command is not None and command[2] == 0
    values_of["heading_drift_deg"] = walk.drift_deg if drifts else nothing
    intervals = {name: mean_of(values) for name, values in values_of.items()}
    return Figures(
        episodes=len(walk.fell),
        fall_rate=float(walk.fell.mean()),
        **{name: interval.value for name, interval in intervals.items()},
        mean_velocity=tuple(walk.mean_velocity.mean(axis=0).tolist()),
        duty=tuple(walk.contact[alive].mean(axis=0).tolist()),
        stride_hz=float(walk.stride_hz.mean()),
        swing_s=float(walk.swing_s.sum() / swings) if swings else float("nan"),
        foot_slip_m_s=float(walk.slip_m_s.sum() / max(standing, 1)),
        **_effort(walk, command is None or any(command[:2])),
        intervals={"fall_rate": share_interval(int(walk.fell.sum()), len(walk.fell)), **intervals},
    )


def _effort(walk: Walk, travels: bool) -> dict[str, Any]:
    """Clearance of the swings and effort of the servos, by the names of `Figures`."""
    alive, nothing = walk.alive, float("nan")
    clearance = walk.clearance_m[alive]
    clearance = clearance[np.isfinite(clearance)]
    low, middle = np.quantile(clearance, (0.1, 0.5)) if len(clearance) else (nothing, nothing)
    up_s = walk.step_s * alive.sum()
    work, carried = walk.work_j[alive].sum(), walk.carried_j[alive].sum()

    def named(data: NDArray) -> dict[str, float]:
        means = data[alive].mean(axis=0, dtype=float) if up_s else np.full(len(walk.kinds), nothing)
        return dict(zip(walk.kinds, means.tolist(), strict=True))

    return {
        "clearance_p10_m": float(low),
        "clearance_p50_m": float(middle),
        "low_swing_share": float((clearance < LOW_SWING_M).mean()) if len(clearance) else nothing,
        "torque_saturated_share": named(walk.saturated),
        "rms_torque_share": {k: v**0.5 for k, v in named(walk.torque_square).items()},
        "mechanical_power_w": float(work / up_s) if up_s else nothing,
        "cost_of_transport": float(work / carried) if travels and carried else nothing,
    }


def share_interval(count: int, total: int) -> Interval:
    """Share with its interval by Clopper and Pearson."""
    tail = (1 - LEVEL) / 2
    low = float(beta.ppf(tail, count, total - count + 1)) if count else 0.0
    high = float(beta.ppf(1 - tail, count + 1, total - count)) if count < total else 1.0
    return Interval(count / total, low, high)


BEFORE_S = 0.2
"""How long before a fall the tilt is taken [s]."""

Direction = Literal["forward", "backward", "left", "right"]


@dataclass(frozen=True, kw_only=True)
class Fall(Result):
    """One fall."""

    row: str
    """Name of the condition."""
    walker: Walker
    episode: int
    time_s: float
    """Since the start of the episode."""
    tilt_before_deg: float
    """Between the trunk and the ground, 0.2 s before the fall."""
    tilt_deg: float
    """At the fall."""
    toward: Direction
    """To which side the trunk tilts at the fall."""
    tipped: bool
    """Whether it tipped over; otherwise trunk, hips or thighs touched the ground."""
    command: tuple[float, float, float]
    """Forward and sideways speed [m/s], turn rate [rad/s], at the fall."""
    since_push_s: float | None
    """Time since the last push; null without one."""


def falls_of(
    row: str, condition: Condition, fell: NDArray[np.bool_], alive: NDArray[np.bool_],
    gravity: Array, command: Array,
) -> list[Fall]:  # fmt: skip
    """Falls of the robots of a condition.

    `fell` has the shape (n,), `alive` (steps, n), `command` (steps, n, 3), and so has `gravity`,
    the ground's normal, downwards, in the trunk's frame.
    """
    step_s = condition.task.control_step_s
    before = round(BEFORE_S / step_s)
    falls = []
    for i in np.flatnonzero(fell).tolist():
        at = int(alive[:, i].sum())
        x, y, down = gravity[at, i]
        # the trunk tilts to the side of gravity in its frame
        toward: Direction = "forward" if x > 0 else "backward"
        if abs(y) > abs(x):
            toward = "left" if y > 0 else "right"
        time_s = (at + 1) * step_s
        falls.append(
            Fall(
                row=row, walker=condition.walker, episode=i, time_s=time_s,
                tilt_before_deg=_tilt_deg(gravity[max(at - before, 0), i]),
                tilt_deg=_tilt_deg(gravity[at, i]), toward=toward,
                tipped=bool(down > -FALLEN_TILT), command=tuple(command[at, i].tolist()),
                since_push_s=condition.handicap.since_push_s(time_s),
            )
        )  # fmt: skip
    return falls


def _tilt_deg(gravity: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(-gravity[2], -1.0, 1.0))))


def in_short(falls: Sequence[Fall]) -> list[dict[str, Any]]:
    """Falls by condition and walker, in their order.

    Medians of time and tilt, the most frequent side, and how many tipped over and how many came
    within 1 s of a push.
    """
    groups: dict[tuple[str, Walker], list[Fall]] = {}
    for fall in falls:
        groups.setdefault((fall.row, fall.walker), []).append(fall)
    return [
        {
            "row": row, "walker": walker, "falls": len(group),
            "time_s": float(np.median([f.time_s for f in group])),
            "tilt_before_deg": float(np.median([f.tilt_before_deg for f in group])),
            "toward": mode([f.toward for f in group]),
            "tipped": sum(f.tipped for f in group),
            "after_push": sum(f.since_push_s is not None and f.since_push_s <= 1 for f in group),
        }
        for (row, walker), group in groups.items()
    ]  # fmt: skip


Group = Literal[
    "random", "direction", "ground", "dead time", "push", "slope", "stairs", "payload", "leg",
    "ticks", "jitter", "friction", "robot",
]  # fmt: skip
WALKERS: tuple[Walker, ...] = ("policy", "trot", "standing")


@dataclass(frozen=True)
class Case:
    """One row of a table: a condition under which policy, trot and standing robots are compared."""

    group: Group
    name: str
    command: tuple[float, float, float] | None = None
    """Forward and sideways speed [m/s], turn rate [rad/s]; None for random ones."""
    terrain: Terrain = "flat"
    extra_dead_time_s: float = 0.0
    """Added to the dead time of every servo."""
    handicap: Handicap = field(default_factory=Handicap)
    differences: Differences = field(default_factory=Differences)
    """Of the robots from their model."""

    def condition(self, task: Walking, robots: int, walker: Walker) -> Condition:
        """The same for some robots."""
        return Condition(
            replace(task, terrain=self.terrain, differences=self.differences), robots,
            self.command, self.extra_dead_time_s, walker=walker, handicap=self.handicap,
        )  # fmt: skip


RANDOM = Case("random", "random commands")
"""The first row of every table."""


@dataclass(frozen=True, kw_only=True)
class Row(Result):
    """Figures under one condition."""

    group: Group
    name: str
    command: tuple[float, float, float] | None
    """None for random ones."""
    policy: Figures
    trot: Figures
    """Of the open-loop trot."""
    standing: Figures
    """Of robots that stand."""


@dataclass(frozen=True, kw_only=True)
class Evaluation(Result):
    """Evaluation of a policy beside an open-loop trot and standing."""

    episode_s: float
    """Length of an episode without a fall."""
    seed: int
    actuator: str
    feedback: str
    conditions: tuple[Row, ...]
    """The first is of random commands on flat ground."""
    falls: tuple[Fall, ...]

    def rows(self) -> list[dict[str, Any]]:
        """One row per condition and walker."""
        return [
            {"group": row.group, "name": row.name, "walker": walker, **figures.rows()[0]}
            for row in self.conditions
            for walker, figures in zip(WALKERS, (row.policy, row.trot, row.standing), strict=True)
        ]


def table(
    grounds: Sequence[Terrain] = ("rough", "slopes", "troughs"),
    extra_delays_ms: Sequence[float] = (40.0, 80.0),
) -> tuple[Case, ...]:
    """Cases of the usual table, after that of random commands.

    Flat ground and no added dead time are those of random commands, and have no other rows.
    """
    return (
        *(Case("direction", name, command) for name, command in DIRECTIONS.items()),
        *(Case("ground", f"ground: {g}", terrain=g) for g in grounds if g != "flat"),
        *(
            Case("dead time", f"dead time +{extra:g} ms", extra_dead_time_s=extra / 1e3)
            for extra in extra_delays_ms
            if extra
        ),
    )


def evaluate(
    policy: Policy | None,
    task: Walking,
    servos: ServoRanges,
    cases: Sequence[Case],
    robots: Callable[[Case, Walker], int],
    seed: int,
    threads: int = 0,
    *,
    feedback: str = "held",
    progress: Callable[[float], None] = lambda share: None,
) -> Evaluation:
    """Evaluate a policy, an open-loop trot and standing under random commands and `cases`.

    The ground is that of the cases (see `table` and `BATTERY`), not of the task; `robots` gives the
    episodes of a case and a walker (see `usual_robots`). No policy stands still. `feedback` names
    that of the servos in the result; `progress` is called with the share of the work that is done.
    """
    plain = evaluation_task(task)
    cases = (RANDOM, *cases)
    if task.robot:
        cases = tuple(_for_robot(case, plain) for case in cases)
    conditions = [c.condition(plain, robots(c, w), w) for c in cases for w in WALKERS]
    walks = walk_together(
        policy, servos, conditions, plain.episode_s, seed, threads, Recorder, progress
    )
    rows, falls = [], []
    pairs = list(zip(conditions, walks, strict=True))
    for i, case in enumerate(cases):
        figures = {}
        for condition, walked in pairs[i * len(WALKERS) : (i + 1) * len(WALKERS)]:
            figures[condition.walker] = figures_of(walked, case.command)
            falls += falls_of(
                case.name, condition, walked.fell, walked.alive, walked.gravity, walked.command
            )
        rows.append(Row(group=case.group, name=case.name, command=case.command, **figures))
    return Evaluation(
        episode_s=plain.episode_s, seed=seed, actuator=servos.source, feedback=feedback,
        conditions=tuple(rows), falls=tuple(falls),
    )  # fmt: skip


def _for_robot(case: Case, task: Walking) -> Case:
    """A case of another robot than the Mini Pupper, as hard for it by its size and weight.

    Commands are as far within its ranges as usual ones are within theirs.
    """
    body, handicap, name = task.body, case.handicap, case.name
    if case.command is not None:
        command = within(task, np.array(case.command)).tolist()
        case = replace(case, command=(command[0], command[1], command[2]))
    push_m_s = handicap.push_m_s * float(body.command_scale[0])
    payload_kg = handicap.payload_kg * body.mass_kg / MASS_KG
    ahead_m, left_m = (body.scale * at for at in handicap.payload_at_m)
    if push_m_s:
        name = f"pushes of {push_m_s:.2g} m/s"
    if payload_kg:
        side = f"{100 * left_m:.0f} cm left" if left_m else f"{-100 * ahead_m:.0f} cm behind"
        name = f"{1e3 * payload_kg:.0f} g, {side}"
    scaled = replace(
        handicap, push_m_s=push_m_s, payload_kg=payload_kg, payload_at_m=(ahead_m, left_m)
    )
    return replace(case, name=name, handicap=scaled)


def usual_robots(episodes: int) -> Callable[[Case, Walker], int]:
    """Episodes of each case: `episodes` of random commands, an eighth of all others.

    Half of them for the trot, a sixth for standing, at least 2 each.
    """

    def count(case: Case, walker: Walker) -> int:
        most = episodes if case is RANDOM else max(episodes // 8, 1)
        return {"policy": most, "trot": max(most // 2, 2), "standing": max(most // 6, 2)}[walker]

    return count


def _handicapped(group: Group, name: str, per_unit: float, **values: Sequence[float]) -> list[Case]:
    """Cases of one handicap, named by its values times `shown`."""
    ((handicap, sizes),) = values.items()
    return [
        Case(group, name.format(per_unit * size), handicap=replace(Handicap(), **{handicap: size}))
        for size in sizes
    ]


BATTERY: tuple[Case, ...] = (
    *_handicapped("push", "pushes of {:g} m/s", 1, push_m_s=(0.4, 0.8, 1.2)),
    *_handicapped("slope", "slope of {:g}°", 1, slope_deg=(10.0, 15.0, 20.0)),
    *(
        replace(case, terrain="stairs")
        for case in _handicapped("stairs", "steps of {:g} mm", 1e3, riser_m=tuple(STAIRS_M))
    ),
    *(
        Case("payload", f"150 g, {where}", handicap=Handicap(payload_kg=0.15, payload_at_m=at))
        for where, at in {"4 cm left": (0.0, 0.04), "8 cm behind": (-0.08, 0.0)}.items()
    ),
    *_handicapped("leg", "one leg at {:g} %", 100, weak_leg=(0.5, 0.25)),
    *_handicapped("ticks", "{:g} % ticks missed", 100, missed_ticks=(0.1, 0.3)),
    *(
        Case("dead time", f"dead time +{1e3 * extra:g} ms", extra_dead_time_s=extra)
        for extra in (0.04, 0.08)
    ),
    *_handicapped("jitter", "jitter +{:g} ms", 1e3, extra_jitter_s=(0.01, 0.02)),
    *_handicapped("friction", "friction of {:g}", 1, friction=(0.15,)),
    Case("robot", "unlike its model", differences=TYPICAL),
)
"""Rows of the battery, after that of random commands."""


def battery_robots(episodes: int) -> Callable[[Case, Walker], int]:
    """Episodes of each case and walker: equally many."""
    return lambda case, walker: episodes
