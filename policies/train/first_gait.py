"""A first gait for the servos at hand: the open-loop trot judged on them, and fitted to them.

What a policy imitates, and the rewards it then learns from, suit the servos for which they were
found. So before a training the trot walks on the servos of the run for a few seconds. Where it is
poor, its frequency, duty, lift, crouch, spread and gains are searched by the cross-entropy method
(Rubinstein 1999): 64 candidates × 8 commands walk at once, the best of them give the next
distribution. The gains of a candidate need no search: its speeds say by what they were wrong.

The cost of a gait is the error of its speeds relative to standing, and falls, clearance of the
feet, torque, saturation and sway. The best of each generation are judged again by the walks that
`Judge` uses, in the physics of evaluation, and so is the trot before. Where even the fitted trot is
poor, the same walk on servos without one of their limits says which of them it is.

The fitted trot is what is imitated, and in whose poses episodes begin; its frequency, duty and
stance are those of the clocked teacher's rewards, and its errors widen the rewards for speed, which
have no slope at errors of several widths.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import Result
from pupper_sysid.policies.train.run_file import OWN, TROT, Run
from pupper_sysid.policies.train.selection import COMMANDS, scored
from pupper_sysid.policies.walks.together import evaluation_task, share_of_usual, within
from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.draws import Twins
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.rewards import LOW_SWING_M, by_kind
from pupper_sysid.sim.walking.servo_ranges import ServoRanges, servo_model_of, servo_ranges

Array = NDArray[np.float64]

POOR_SCORE = 0.6
"""Score below which a trot is fitted to the servos ("Other servos" in docs/training.md)."""
FORWARD = (0.9, 1.1)
"""Shares of the commanded forward speed within which a trot need not be fitted."""
LEAST_CLEARANCE_M = 0.005
"""Clearance that nine tenths of the swings must have, else a trot is fitted: of the Mini Pupper, by
their size of other robots, and `LOW_SWING_M` instead of those whose gait sways."""

_FORWARD_M_S, _TURN_RAD_S = 0.15, 0.4
_SEED = 4_000_037  # of robots that neither trainings nor judges nor evaluations have
_SECONDS, _IGNORED_S = 4.0, 1.0
_EACH = 2  # robots per command of the judge
_SEARCH_COMMANDS = np.array(
    [
        [0.15, 0, 0], [0.2, 0, 0], [-0.15, 0, 0], [0, 0.08, 0], [0, -0.08, 0], [0, 0, 0.4],
        [0, 0, -0.4], [0.1, 0.05, 0.3],
    ]
)  # fmt: skip
_CANDIDATES, _ELITE, _GENERATIONS = 64, 10, 5
_SEARCH_S, _SEARCH_IGNORED_S = 2.4, 0.8
_SEARCH_STEP_S = 0.004  # twice that of evaluation, in half of the time
_FINALISTS = 4
_MOST_CORRECTION = 1.6  # of a gain, in one generation

_BOX = {
    "frequency_hz": (1.8, 5.0), "duty": (0.5, 0.85), "lift_m": (0.009, 0.03),
    "crouch_m": (-0.015, 0.03),  # straighter legs need less torque at the knees
    "spread_m": (0.0, 0.015), "gain": (0.5, 2.5), "back_gain": (0.5, 2.0),
    "side_gain": (0.5, 2.0), "turn_gain": (0.4, 2.5),
}  # fmt: skip
_SWAYING = {"lift_m": (0.004, 0.03)}
"""Of robots whose gait sways (`Body.sways`): a foot that is lifted high throws them over."""
_FIRST_WIDTH, _NARROWEST = 0.2, 0.02  # standard deviations, in shares of the box

_CLEARANCE_M = 0.006
_OF_SERVOS = {"torque": 0.2, "saturation": 0.2}
_OF_GAIT = {"speed": 2.0, "clearance": 0.5, "low": 0.2, "sway": 0.1}
_WEIGHTS = _OF_GAIT | _OF_SERVOS
"""Of the parts of the cost beside errors relative to standing and falls, of order 1 each: speed is
what is missing from `FORWARD`."""
_SWAY_RAD_S = 1.0

_LEAST_MINUTES = 5.0
_USUAL = {
    "linear_sigma": 0.0155, "stride_linear_sigma": 0.0032, "angular_sigma": 0.056,
    "stride_angular_sigma": 0.021,
}  # fmt: skip
"""Errors of the trot on the shipped calibration, which the widths of the rewards suit [m/s, rad/s];
the means of four seeds."""
_WIDEST = 3.0

_LIMITS: dict[str, dict[str, float]] = {
    "torque": {"effort_limit": 2.0},
    "friction": {"friction_loss": 0.25},
    "speed": {"velocity_limit": 3.0, "back_emf": 0.2},
    "stiffness": {"stiffness": 1.6, "damping": 1.3},
    "dead time": {"dead_time_s": 0.3},
}
"""Factors on the servos' numbers that take away one of their limits."""
_WORTH = 0.05  # of the cost: less is not what limits a gait


@dataclass(frozen=True, kw_only=True)
class GaitScore(Result):
    """How a trot walks on some servos."""

    score: float
    """That of `policies.train.selection.Judge`: 1 without errors, 0 for a robot that stands."""
    falls: float
    forward_share: float
    """Mean forward speed over the commanded `forward_m_s`."""
    turn_share: float
    """Mean turn rate on the spot over the commanded `turn_rad_s`."""
    forward_m_s: float = _FORWARD_M_S
    """Or three quarters of the largest command of the task, where that is less."""
    turn_rad_s: float = _TURN_RAD_S
    """Or four fifths of the largest."""
    speed_error_m_s: float
    """Mean distance of the velocity from the commanded one of robots that are to move."""
    mean_speed_error_m_s: float
    """The same of the velocity averaged over a stride."""
    turn_error_rad_s: float
    mean_turn_error_rad_s: float
    clearance_p10_m: float
    """Tenth percentile of the clearance of the swings."""
    least_clearance_m: float = LEAST_CLEARANCE_M
    """What that must be, by the robot's size."""
    low_swing_share: float
    """Of swings that clear less than 2 mm, on a robot of the Mini Pupper's height."""
    saturated_share: float
    """Share of the time in which thighs and calves are at their torque limit."""
    standing_falls: float = 0.0
    """Share of the robots that are to stand that fell."""

    @property
    def poor(self) -> bool:
        """Whether a better gait is to be searched."""
        fits = FORWARD[0] <= self.forward_share <= FORWARD[1]
        low = self.clearance_p10_m < self.least_clearance_m
        return self.score < POOR_SCORE or not fits or low

    def __str__(self) -> str:
        return (
            f"score {self.score:.2f}, {round(100 * self.forward_share)} % of "
            f"{self.forward_m_s:.3g} m/s forward, {round(100 * self.turn_share)} % of "
            f"{self.turn_rad_s:.3g} rad/s on the spot, {100 * self.falls:.0f} % fell; "
            f"clearance {1e3 * self.clearance_p10_m:.1f} mm (p10), "
            f"{100 * self.low_swing_share:.0f} % of the swings low, thighs and calves at their "
            f"torque limit {100 * self.saturated_share:.0f} % of the time"
        )


@dataclass(frozen=True, kw_only=True)
class FirstGait(Result):
    """A trot before and after it was fitted to servos."""

    before: GaitScore
    trot: Trot
    after: GaitScore
    """The same as `before` where no trot is better."""
    limit: str | None
    """What keeps the servos from walking better; None where the gait is not poor."""


def fits_trots(run: Run) -> bool:
    """Whether a run begins with a gait that may be fitted."""
    taught = run.imitation.iterations and run.imitation.teacher in (TROT, OWN)
    if run.task.robot and run.imitation.teacher != TROT:
        return False  # the teacher finds a gait for its robot
    return bool(taught) and run.first_gait != "keep" and not run.architecture.privileged_actor


def with_first_gait(
    run: Run,
    say: Callable[[str], None] = lambda text: None,
    progress: Callable[[float], None] = lambda share: None,
    ends: Callable[[], bool] = lambda: False,
) -> Run:
    """The run with a first gait for its servos: its own where that walks, else a fitted one.

    `say` is called with sentences about the gait, `progress` with the share of the search that is
    done. The search goes on until `ends`: the best until then is taken.
    """
    servos = servo_ranges(run.actuator, run.feedback, run.task.body)
    name = Path(run.actuator).name
    threads = run.threads or os.cpu_count() or 1
    (usual_score,) = judge_trots([run.task.trot], run.task, servos, run.seed, threads)
    say(f"First gait, the open-loop trot on the servos of {name}: {usual_score}.")
    if run.first_gait == "auto":
        if not usual_score.poor:
            return run
        if run.minutes < _LEAST_MINUTES:
            say(
                f"That is poor, but a search for a better one takes a minute or two of the "
                f"{run.minutes:g} that `minutes` allows, and was left out. `first_gait` fit "
                "searches anyway."
            )
            return run
    say("Searching a better one for these servos takes about a minute on two cores.")
    fitted = fit_trot(run.task, servos, run.seed, threads, progress, ends)
    if fitted.trot == run.task.trot:
        say("Nothing better was found.")
    else:
        t = fitted.trot
        say(
            f"Fitted: {fitted.after}. It has {t.frequency_hz:.1f} Hz, duty {t.duty:.2f}, lift "
            f"{1e3 * t.lift_m:.0f} mm, crouch {1e3 * t.crouch_m:.0f} mm, gain {t.gain:.2f}, "
            f"turning {t.turn_gain:.2f}."
        )
    if ends():
        say("The search was ended before it was complete.")
    elif fitted.after.poor:
        say(_sentence(fitted, run.task))
    return suited(run, fitted)


def _sentence(fitted: FirstGait, task: Walking) -> str:
    """What keeps servos from walking well."""
    score, limit = fitted.after, fitted.limit
    because = {
        "torque": "their torque: thighs and calves are at its limit "
        f"{100 * score.saturated_share:.0f} % of the time",
        "friction": "their dry friction, in whose dead band small steps get lost",
        "speed": "their speed",
        "stiffness": "their stiffness: feet lag behind what they are commanded under load",
        "dead time": "their dead time",
    }
    why = f" What limits it most is {because[limit]}." if limit else ""
    if score.standing_falls:
        why += (
            " It falls even where it is to stand: its default pose does not balance on its feet, "
            "or these servos do not hold it there."
        )
    slower = " to ".join(f"{end / 2:.2g}" for end in task.commands.forward_m_s)
    return (
        f"No better open-loop gait than this was found for these servos.{why} Training begins with "
        f"it; commands of less speed (`task.commands.forward_m_s` of {slower}) are easier."
    )


def suited(run: Run, fitted: FirstGait) -> Run:
    """The run with a fitted trot, and rewards that suit it."""
    if fitted.trot == run.task.trot and not fitted.after.poor:
        return run
    trot, score, rewards = fitted.trot, fitted.after, run.task.rewards
    errors = {
        "linear_sigma": score.speed_error_m_s, "stride_linear_sigma": score.mean_speed_error_m_s,
        "angular_sigma": score.turn_error_rad_s,
        "stride_angular_sigma": score.mean_turn_error_rad_s,
    }  # fmt: skip
    changes: dict[str, float] = {}
    for name, error in errors.items():
        usual = _USUAL[name] * run.task.body.command_scale[2 if "angular" in name else 0]
        wider = float(min(max(error / usual, 1.0), _WIDEST))
        changes[name] = wider * getattr(rewards, name)
    if run.imitation.teacher == OWN:
        changes |= {
            "clock_hz": trot.frequency_hz,
            "clock_duty": trot.duty,
            "crouch": trot.crouch_m,
            "spread": trot.spread_m,
        }
    return replace(run, task=replace(run.task, trot=trot, rewards=replace(rewards, **changes)))


def judge_trots(
    trots: Sequence[Trot],
    task: Walking,
    servos: ServoRanges,
    seed: int,
    threads: int,
    changes: Sequence[dict[str, float]] = (),
) -> list[GaitScore]:
    """Let trots walk on the same robots under the judge's commands for 4 s.

    `changes` are, for each trot, factors on numbers of its robots' servos, by field of
    `DelayedPDParameters`.
    """
    return [_score(walk) for walk in _judged(trots, task, servos, seed, threads, changes)]


def fit_trot(
    task: Walking,
    servos: ServoRanges,
    seed: int,
    threads: int = 0,
    progress: Callable[[float], None] = lambda share: None,
    ends: Callable[[], bool] = lambda: False,
) -> FirstGait:
    """Search a trot for some servos, beginning with that of a task.

    `progress` is called with the share of the work that is done. What was found until `ends` is
    judged.
    """
    rng = np.random.default_rng([seed, 6])
    quick = _search_task(task, servos)
    box = _box(task.body)
    low, high = np.array(list(box.values())).T
    mean = np.clip([getattr(task.trot, name) for name in box], low, high)
    width = _FIRST_WIDTH * (high - low)
    tried: list[tuple[float, Trot]] = []
    for generation in range(_GENERATIONS):
        drawn = np.clip(rng.normal(mean, width, (_CANDIDATES, len(box))), low, high)
        drawn[0] = mean
        if not generation:  # half of them from the whole box, in strata of each number
            half = _CANDIDATES // 2
            strata = rng.permuted(np.tile(np.arange(half), (len(box), 1)), axis=1).T
            drawn[half:] = low + (strata + rng.random(strata.shape)) / half * (high - low)
        trots = [_trot(task.trot, box, values) for values in drawn]
        walked = _walk(
            trots, quick, servos, within(task, _SEARCH_COMMANDS), _SEARCH_S, _SEARCH_IGNORED_S,
            seed, threads, ends=ends,
        )  # fmt: skip
        if not walked:
            break
        costs = [_cost(walk) for walk in walked]
        order = np.argsort(costs, kind="stable")[:_ELITE]
        elite = [_corrected(trots[i], walked[i]) for i in order]
        tried += [(costs[i], trot) for i, trot in zip(order, elite, strict=True)]
        values = np.array([[getattr(trot, name) for name in box] for trot in elite])
        mean = values.mean(axis=0)
        width = np.maximum(values.std(axis=0), _NARROWEST * (high - low))
        progress((generation + 1) / (_GENERATIONS + 1))
    best = [trot for _, trot in sorted(tried, key=lambda pair: pair[0])[: _FINALISTS - 1]]
    trots = [task.trot, _trot(task.trot, box, mean), *best]
    finalists = list(zip(trots, _judged(trots, task, servos, seed, threads), strict=True))
    before = _score(finalists[0][1])
    for _ in range(2):  # in the physics of evaluation the speeds differ a little
        corrected = [_corrected(trot, walk) for trot, walk in finalists]
        finalists += zip(corrected, _judged(corrected, task, servos, seed, threads), strict=True)
        finalists = [min(finalists, key=lambda finalist: _cost(finalist[1]))]
    ((trot, walk),) = finalists
    after = _score(walk)
    poor = after.poor and not ends()
    limit = _limit(trot, walk, task, servos, seed, threads) if poor else None
    progress(1.0)
    return FirstGait(before=before, trot=trot, after=after, limit=limit)


def _judged(
    trots: Sequence[Trot], task: Walking, servos: ServoRanges, seed: int, threads: int,
    changes: Sequence[dict[str, float]] = (),
) -> list[_Walked]:  # fmt: skip
    command = np.repeat(within(task, COMMANDS), _EACH, axis=0)
    return _walk(
        trots, _evaluated(task, _SECONDS), servos, command, _SECONDS, _IGNORED_S, seed, threads,
        changes,
    )  # fmt: skip


def _evaluated(task: Walking, seconds: float) -> Walking:
    """The task as it is evaluated, on the servos themselves: their scale is not drawn."""
    gentle = evaluation_task(task, 2 * seconds)  # longer, so that no episode ends but by a fall
    random = replace(gentle.randomisation, torque_scale=(1.0, 1.0))
    return replace(gentle, commands=task.commands, randomisation=random)


def _search_task(task: Walking, servos: ServoRanges) -> Walking:
    """The task of the search: as evaluated, but in the physics of training and in longer steps."""
    quick = replace(_evaluated(task, _SEARCH_S), physics="training")
    steps = task.control_step_s / _SEARCH_STEP_S
    if abs(steps - round(steps)) > 1e-6:
        return quick
    longer = replace(quick, physics_step_s=_SEARCH_STEP_S)
    try:
        servos.in_steps_of(longer.physics_step_s)
    except InputError:  # too stiff for them
        return quick
    return longer


def _box(body: Body) -> dict[str, tuple[float, float]]:
    """Ends of what is searched, by Froude scaling of the Mini Pupper's."""
    rate, length = float(body.command_scale[2]), body.scale
    box = _BOX | (_SWAYING if body.sways else {})
    size = {n: rate if n.endswith("_hz") else length if n.endswith("_m") else 1.0 for n in box}
    return {name: (low * size[name], high * size[name]) for name, (low, high) in box.items()}


def _trot(begun: Trot, names: Iterable[str], values: Array) -> Trot:
    return replace(begun, **dict(zip(names, values.tolist(), strict=True)))


@dataclass(frozen=True)
class _Walked:
    """Robots with one trot, those of `command`, without the start."""

    scale: Array
    """Of the commands, over usual ones; shape (3,)."""
    length: float
    """`Body.scale`."""
    least_clearance_m: float
    """Of nine tenths of the swings of a gait that is not poor."""
    command: Array
    velocity: Array
    """Shape (steps, n, 3)."""
    stride_velocity: Array
    up: NDArray[np.bool_]
    """Shape (steps, n)."""
    clearance_m: Array
    """Of all swings of robots that are to move, shape (k,)."""
    saturated: float
    """Of thighs and calves."""
    torque_square: float
    sway_rad_s: float


def _walk(
    trots: Sequence[Trot], task: Walking, servos: ServoRanges, command: Array, seconds: float,
    ignored_s: float, seed: int, threads: int, changes: Sequence[dict[str, float]] = (),
    ends: Callable[[], bool] = lambda: False,
) -> list[_Walked]:  # fmt: skip
    """Walk with every trot on the same robots, one for each row of `command`.

    Nothing if it `ends` before.
    """
    n, count, scale = len(command), len(trots), share_of_usual(task)
    step_s = task.control_step_s
    steps, first = round(seconds / step_s), round(ignored_s / step_s)
    number = np.tile(np.arange(n), count)
    model = servo_model_of(servos.source, step_s)
    env = PupperEnv(task, servos, n * count, _SEED + seed, threads, model, twins=Twins(number, n))
    for k, factors in enumerate(changes):
        ids = np.arange(k * n, (k + 1) * n)
        for name, factor in factors.items():
            env.robots.drawn[name][ids] *= factor
        env.robots.write(ids)
    env.set_command(np.tile(command, (count, 1)))
    actions = _actions(trots, env, command, steps)
    alive = np.ones(n * count, bool)
    records: dict[str, list[NDArray]] = defaultdict(list)
    for action in actions:
        if ends():
            return []
        result = env.step(action)
        facts, alive = result.facts, alive & ~result.done
        for name, value in (
            ("velocity", facts.followed_velocity), ("stride", facts.stride_velocity),
            ("up", alive), ("clearance", facts.clearance_m),
            ("saturated", by_kind(facts.body, facts.saturated)), ("square", facts.torque_square),
            ("sway", facts.angular_velocity[:, :2]),
        ):  # fmt: skip
            records[name].append(value.copy())
    series = {name: np.stack(values)[first:] for name, values in records.items()}
    moves = command.any(axis=1)
    length = env.body.scale
    least_m = length * (LOW_SWING_M if env.body.sways else LEAST_CLEARANCE_M)
    walked = []
    for k in range(count):
        walk = {name: value[:, k * n : (k + 1) * n] for name, value in series.items()}
        walking = walk["up"] & moves
        clearance = walk["clearance"][walking]
        walked.append(
            _Walked(
                scale, length, least_m, command, walk["velocity"], walk["stride"], walk["up"],
                clearance[np.isfinite(clearance)],
                _mean(walk["saturated"][walking][:, 1:]), _mean(walk["square"][walking]),
                _mean(walk["sway"][walking] ** 2) ** 0.5,
            )
        )  # fmt: skip
    return walked


def _mean(values: Array) -> float:
    return float(values.mean()) if values.size else 1.0


def _actions(trots: Sequence[Trot], env: PupperEnv, command: Array, steps: int) -> Array:
    """Actions of all robots at every step, shape (steps, n, 12)."""
    n, span = len(command), env.config.control_step_s
    time_s: Array = np.repeat(span * np.arange(steps, dtype=float), n)
    commands = np.tile(command, (steps, 1))
    joints = [
        trot.joints(time_s * (2 * np.pi * trot.frequency_hz), commands, env.body).reshape(
            steps, n, -1
        )
        for trot in trots
    ]
    return (np.concatenate(joints, axis=1) - env.default) / env.config.action_scale


def _velocities(walk: _Walked) -> tuple[Array, Array]:
    """Velocities and those over a stride, with falls as standing."""
    up = walk.up[..., None]
    return np.where(up, walk.velocity, 0.0), np.where(up, walk.stride_velocity, 0.0)


def _share(walk: _Walked, chosen: NDArray[np.bool_]) -> float:
    """Mean motion of some robots along their commands, over these: least squares; 1 of none."""
    mean, commanded = _velocities(walk)[0].mean(axis=0)[chosen], walk.command[chosen]
    size = float((commanded**2).sum())
    return float((mean * commanded).sum()) / size if size else 1.0


def _relative(walk: _Walked) -> dict[str, float]:
    """Score of walks as if their commands were usual ones, and their errors in proportion."""
    return scored(walk.velocity / walk.scale, walk.up, walk.command / walk.scale)


def _score(walk: _Walked) -> GaitScore:
    command, scores = walk.command, _relative(walk)
    forward, _, turn = walk.scale * [_FORWARD_M_S, 0.0, _TURN_RAD_S]
    moves = command.any(axis=1)
    ahead = np.asarray(moves & np.isclose(command, [forward, 0, 0]).all(axis=1))
    turning = np.asarray(moves & ~command[:, :2].any(axis=1))
    instant, stride = (np.abs(v - command)[:, moves] for v in _velocities(walk))
    planar = [np.linalg.norm(e[..., :2], axis=-1).mean() for e in (instant, stride)]
    clearance = walk.clearance_m
    return GaitScore(
        score=scores["score"], falls=scores["score_falls"], forward_share=_share(walk, ahead),
        turn_share=_share(walk, turning), forward_m_s=float(forward), turn_rad_s=float(turn),
        speed_error_m_s=float(planar[0]), mean_speed_error_m_s=float(planar[1]),
        turn_error_rad_s=float(instant[..., 2].mean()),
        mean_turn_error_rad_s=float(stride[..., 2].mean()),
        clearance_p10_m=float(np.quantile(clearance, 0.1)) if len(clearance) else 0.0,
        least_clearance_m=walk.least_clearance_m,
        low_swing_share=_low(clearance / walk.length), saturated_share=walk.saturated,
        standing_falls=float((~walk.up[-1, ~moves]).mean()) if not moves.all() else 0.0,
    )  # fmt: skip


def _cost(walk: _Walked, weights: dict[str, float] = _WEIGHTS) -> float:
    """Cost of a gait: 1 minus the judge's score, and terms of speed, clearance, torque and sway."""
    clearance_m = walk.clearance_m / walk.length
    lowest_m = float(np.quantile(clearance_m, 0.1)) if len(clearance_m) else 0.0
    share = _share(walk, np.asarray(_alone(walk) & (walk.command[:, 0] > 0)))
    terms = {
        "speed": max(FORWARD[0] - share, share - FORWARD[1], 0.0),
        "clearance": 1.0 - min(lowest_m / _CLEARANCE_M, 1.0), "low": _low(clearance_m),
        "torque": walk.torque_square, "saturation": walk.saturated,
        "sway": walk.sway_rad_s / _SWAY_RAD_S,
    }  # fmt: skip
    # robots that fall later are nearer to a gait
    error = 1.0 - _relative(walk)["score"] + float(1.0 - walk.up.mean())
    return error + sum(weight * terms[name] for name, weight in weights.items())


def _alone(walk: _Walked) -> NDArray[np.bool_]:
    """Robots that are to move along one axis only."""
    return (walk.command != 0).sum(axis=1) == 1


def _low(clearance_m: Array) -> float:
    """Share of low swings; 1 of a robot that does not step."""
    return float((clearance_m < LOW_SWING_M).mean()) if len(clearance_m) else 1.0


def _corrected(trot: Trot, walk: _Walked) -> Trot:
    """The trot with gains by which it would have walked at the commanded speeds."""
    x, y, turn = walk.command.T

    def wrong_by(chosen: Any) -> float:
        share = _share(walk, np.asarray(_alone(walk) & chosen))
        return 1.0 / min(max(share, 1.0 / _MOST_CORRECTION), _MOST_CORRECTION)

    ahead, back, aside = wrong_by(x > 0), wrong_by(x < 0), wrong_by(y != 0)
    values = {
        "gain": trot.gain * ahead, "back_gain": trot.back_gain * back / ahead,
        "side_gain": trot.side_gain * aside / ahead,
        "turn_gain": trot.turn_gain * wrong_by(turn != 0),
    }  # fmt: skip
    return replace(trot, **{name: float(np.clip(v, *_BOX[name])) for name, v in values.items()})


def _limit(
    trot: Trot, walk: _Walked, task: Walking, servos: ServoRanges, seed: int, threads: int
) -> str | None:
    """Which of the servos' limits the trot would walk best without; None if that is of no use."""
    if servo_model_of(servos.source, task.control_step_s) is not None:
        return None  # a learned model has no numbers
    names, changes = list(_LIMITS), list(_LIMITS.values())
    without = _judged([trot] * len(names), task, servos, seed, threads, changes)
    # without the limit servos go farther than the gains expect: correct the gains first
    trots = [_corrected(trot, other) for other in without]
    without = _judged(trots, task, servos, seed, threads, changes)
    # shares of a limit are smaller of a larger one, whatever the gait
    costs = [_cost(other, _OF_GAIT) for other in without]
    best = int(np.argmin(costs))
    return names[best] if costs[best] < _cost(walk, _OF_GAIT) - _WORTH else None
