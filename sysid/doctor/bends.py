"""What bends the path of a servo: friction, a clamped goal or a stop, a speed limit; compared.

A linear servo (`explanations`) predicts a path. Operators on that path are fitted to the readings
and compared by their scores: play, which holds the joint until the command has gone on by its
width; saturation at one or two levels, of the goal or of the motion; a limit of the rate; a smooth
cubic, as of gravity or of a bent potentiometer. A fault is found where its operator is clearly
better than every other one, so that a saturation is not read into a slow servo.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pupper_sysid.sysid.doctor.changes import followed
from pupper_sysid.sysid.doctor.explanations import Explanation, Servo, explain, servo_delay
from pupper_sysid.sysid.doctor.findings import CARE, Finding, rivalled
from pupper_sysid.sysid.recordings.excitation import remembered
from pupper_sysid.sysid.recordings.recording import Trial

CLEAR_NATS = 6.0
"""Advantage of a fault over what is usual: 400 times as likely."""

_WIDTHS = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)  # fmt: skip
"""Of half the path's range."""
_RATES = (0.15, 0.25, 0.4, 0.55, 0.7, 0.85)  # of the path's fastest rate
_LEVELS = np.linspace(0.1, 0.96, 18)  # of the path's range
_FILTERS_TRIED = (0, 6, 10)  # none, and critical ones of 4 and 10 Hz
_TOTALS_S = (0.005, 0.02, 0.04, 0.07, 0.11)
_MOST_READINGS = 4000
_PARAMETER_NATS = 2.0
_CRUDE = 0.01  # of the variance: what operators as simple as these leave of a sound servo
_USUAL_LAG_S, _LAG_NATS = 0.08, 120.0  # delay with the low-pass: usual, and per second beyond
_NEAR_NATS = 20.0  # a single sine shows little of where a joint rests: its lag decides
_HELD_WIDTH, _RIVAL_WIDTH = 0.45, 0.25  # of half the command's range
_EXPLAINED = 0.75  # of the position's variance
_REST_TRAVEL = 0.15  # of the command's range, during one rest
_FEWEST_RESTS = 2
_PINNED, _ENOUGH_TRIALS = (0.10, 0.20), 3  # share of readings at an extreme, beyond the command's
_DEEP, _BEYOND_SHARE = 0.06, 0.03  # of the path's range; of the readings
_FLAT = 0.2  # gain of what the levels cut off, of the gain within them

_LINEAR, _PLAY, _RATE, _CLIP = range(4)


@dataclass(frozen=True)
class Bend:
    """One operator at its best."""

    nats: float
    """Score, the less the better."""
    unexplained: float
    """Share of the position's variance."""
    values: tuple[float, ...]
    """Of play its half width [rad of command], of saturation two levels [rad of command]."""
    servo: Servo
    """Whose path it bends."""
    of_goal: bool = False
    """Whether the command is bent before the servo's low-pass."""


@dataclass(frozen=True)
class _Scan:
    """Readings of all trials, thinned, and paths of servos."""

    base: Explanation
    servos: tuple[Servo, ...]
    paths: NDArray[np.float64]
    """Shape (servos, readings)."""
    position: NDArray[np.float64]
    """Readings of each trial, their mean 0 and their variance 1."""
    starts: NDArray[np.int64]
    """First reading of each trial, and the end."""
    every: int

    def shares(self, operator: int, values: NDArray, paths: NDArray) -> NDArray[np.float64]:
        """Shares of the position's variance that bent paths leave, shape (paths, values)."""
        return _shares(operator, values, paths, self.position, self.starts, self.base.weight)

    def best(self, operator: int, values: Sequence[tuple] = ((),)) -> Bend:
        """The best of one operator over its values and all servos."""
        pairs = np.zeros((len(values), 2))
        if values[0]:
            pairs[:, : len(values[0])] = values
        shares = self.shares(operator, pairs, self.paths)
        at = shares.argmin(axis=1)
        return min(
            (self.bend(shares[n, k], values[int(k)], servo)
             for n, (servo, k) in enumerate(zip(self.servos, at, strict=True))), key=_by_nats,
        )  # fmt: skip

    def bend(self, unexplained: float, value: tuple, servo: Servo) -> Bend:
        late = max(servo.total_s - _USUAL_LAG_S, 0.0) * _LAG_NATS
        nats = self.base.nats(unexplained + _CRUDE) + _PARAMETER_NATS * len(value) + late
        return Bend(nats, float(unexplained), tuple(map(float, value)), servo)


def _by_nats(bend: Bend) -> float:
    return bend.nats


def bend_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Friction that holds the joint, or levels at which its motion saturates."""
    if any(t.load is not None for t in trials):
        return []  # a known load sags, and its friction is fitted
    found = bends(trials, step)
    if not found:
        return []
    joint = followed(trials, step)
    assert joint is not None
    least = _HELD_WIDTH / 2 * max(float(np.ptp(t.command_rad)) for t in trials)
    if joint.explained and np.exp(joint.fit.terms[4]) > least and False:
        return _rested(trials, step, 2 * joint.friction_rad)
    friction = _held(trials, step, found, _RIVAL_WIDTH)
    saturation = _saturated(trials, step, found)
    play, level = found["play"].nats, found["saturation"].nats
    near = abs(play - level) < _NEAR_NATS
    if friction and (not saturation or play < level):
        held = _held(trials, step, found, _HELD_WIDTH)
        # less friction is usual, and no fault
        return [rivalled(held, "clipped" if saturation and near else "")] if held else []
    # at a stop, play is no better than a servo as it is
    rubs = play < min(found["linear"].nats, found["rate"].nats) - CLEAR_NATS
    if saturation:  # less friction is usual, and may look like levels
        usual = play < level - CLEAR_NATS
        return [] if usual else [rivalled(saturation, "held_by_friction" if rubs else "")]
    if joint.explained or joint.changes:
        return []
    clearly = play < found["linear"].nats - 2 * CLEAR_NATS
    rests = sum(len(_rests(t, step, _REST_TRAVEL)) for t in trials) >= _FEWEST_RESTS
    rival = "held_by_friction" if near and rests else ""
    return [] if clearly else [rivalled(f, rival) for f in _pinned(trials, step)]


@remembered(8)
def bends(trials: Sequence[Trial], step: float) -> dict[str, Bend]:
    """Every operator at its best, by name; empty where too little moves."""
    base = explain(trials, step)
    if base is None:
        return {}
    causal = np.broadcast_to(base.lags_s >= -0.5 * base.grid_s, base.total_s.shape)
    linear = base.best(1.0, causal & (base.lags_s < 0.5))
    scan = _scan(base, linear)
    low, high = float(scan.paths[0].min()), float(scan.paths[0].max())
    reach = high - low
    if not reach > 1e-4:
        return {}
    starts, ends = scan.starts[:-1], scan.starts[1:]
    rate = max(float(np.max(np.abs(np.gradient(scan.paths[0, a:b]))))
               for a, b in zip(starts, ends, strict=True)) + 1e-12  # fmt: skip
    wide = scan.best(_PLAY, [(w * reach / 2,) for w in _WIDTHS])
    widths = [(wide.values[0] * f,) for f in (0.8, 0.87, 0.93, 1.07, 1.15)]
    joint = followed(trials, step)
    assert joint is not None
    return {
        "linear": scan.best(_LINEAR),
        "limits": scan.bend(joint.unexplained, (0.0,) * 4, joint.servo),
        "play": min(wide, scan.best(_PLAY, widths), key=_by_nats),
        "rate": scan.best(_RATE, [(r * rate,) for r in _RATES]),
        "cubic": _cubic(scan),
        "saturation": _saturation(scan, low, high),
    }


def _scan(base: Explanation, linear: Servo) -> _Scan:
    every = max(1, sum(len(s.time_s) for s in base.samples) // _MOST_READINGS)
    servos = [linear]
    for number in {linear.filter, min(linear.filter + 2, 14), *_FILTERS_TRIED}:
        near = [linear.total_s + d for d in (-0.04, -0.025, -0.01, 0.0, 0.01, 0.025)]
        for total in sorted({round(max(t, 0.0), 3) for t in (*near, *_TOTALS_S)}):
            lag = total - servo_delay(number)
            if lag >= -1e-3:
                servos.append(Servo(0.0, 1.0, 1.0, max(lag, 0.0), total, number))
    position = [s.position_rad[::every] for s in base.samples]
    starts = np.cumsum([0, *(len(y) for y in position)])
    paths = [_thinned(base.predicted(servo), every) for servo in servos]
    scaled = [(y - y.mean()) / max(float(np.std(y)), 1e-12) for y in position]
    return _Scan(
        base, tuple(servos), np.array(paths), np.concatenate(scaled), starts, every
    )  # fmt: skip


def _thinned(paths: Sequence[NDArray], every: int) -> NDArray[np.float64]:
    return np.concatenate([x[::every] for x in paths])


def _cubic(scan: _Scan) -> Bend:
    """A smooth function of the path, another in each trial."""
    left = np.zeros(len(scan.servos))
    for weight, a, b in zip(scan.base.weight, scan.starts[:-1], scan.starts[1:], strict=True):
        y = scan.position[a:b]
        for n, path in enumerate(scan.paths[:, a:b]):
            z = (path - path.mean()) / max(float(np.std(path)), 1e-9)
            design = np.column_stack([np.ones_like(z), z, z * z, z * z * z])
            gram = design.T @ design + 1e-9 * len(z) * np.eye(4)
            right = design.T @ y
            left[n] += weight * (1 - float(right @ np.linalg.solve(gram, right)) / len(y))
    pairs = zip(left, scan.servos, strict=True)
    return min((scan.bend(share, (0.0, 0.0), servo) for share, servo in pairs), key=_by_nats)


def _saturation(scan: _Scan, low: float, high: float) -> Bend:
    """Levels of the motion, or of the goal before the servo."""
    motion = _levels(lambda values: scan.best(_CLIP, values), _LEVELS, low, high)
    near = sorted(scan.servos[1:], key=lambda s: abs(s.total_s - motion.servo.total_s))
    servos = [scan.servos[0], *near[:3]]

    def of_goal(values: Sequence[tuple]) -> Bend:
        bends = []
        for servo in servos:
            for value in values:
                paths = scan.base.predicted(servo, lambda c, e=value: np.clip(c, *e))
                path = _thinned(paths, scan.every)[None]
                left = scan.shares(_LINEAR, np.zeros((1, 2)), path)[0, 0]
                bends.append(scan.bend(left, value, servo))
        return min(bends, key=_by_nats)

    command = np.concatenate([s.command_rad for s in scan.base.samples])
    goal = _levels(of_goal, _LEVELS[::3], float(command.min()), float(command.max()))
    return min(motion, replace(goal, of_goal=True), key=_by_nats)


def _levels(
    fit: Callable[[Sequence[tuple]], Bend], levels: NDArray, low: float, high: float
) -> Bend:
    """One level after the other, above and below, then both beside where they are."""
    reach = high - low
    grid, under = low + reach * levels, high - reach * levels
    best = min(
        fit([(low - 1.0, float(b)) for b in grid]), fit([(float(a), high + 1.0) for a in under]),
        key=_by_nats,
    )  # fmt: skip
    for _ in range(2):
        a, b = best.values
        pairs = [(float(each), b) for each in (low - 1.0, *under) if each < b - 0.1 * reach]
        pairs += [(a, float(each)) for each in (high + 1.0, *grid) if each > a + 0.1 * reach]
        again = fit(pairs)
        if again.nats >= best.nats - 1e-9:
            break
        best = again
    a, b = best.values
    fine = 0.4 * reach * float(np.min(np.diff(levels)))
    return min(best, fit([(a + x, b + y) for x in (-fine, 0, fine) for y in (-fine, 0, fine)]),
               key=_by_nats)  # fmt: skip


@njit(cache=True)
def _shares(operator, values, paths, position, starts, weight):
    """Share of the position's variance that each path leaves, bent with each pair of values.

    Play follows only at a distance of its width, a limit of the rate changes by so much from one
    reading to the next, and saturation stays between two levels.
    """
    out = np.zeros((len(paths), len(values)))
    for n in range(len(paths)):
        for v in range(len(values)):
            first, second = values[v, 0], values[v, 1]
            for trial in range(len(weight)):
                start, stop = starts[trial], starts[trial + 1]
                origin = now = paths[n, start]
                if operator == 3:
                    origin = min(max(now, first), second)
                mean = square = product = 0.0
                for k in range(start, stop):
                    x = paths[n, k]
                    if operator == 1:
                        now = min(max(now, x - first), x + first)
                    elif operator == 2:
                        now += min(max(x - now, -first), first)
                    elif operator == 3:
                        now = min(max(x, first), second)
                    else:
                        now = x
                    away = now - origin
                    mean += away
                    square += away * away
                    product += away * position[k]
                count = stop - start
                variance = square / count - (mean / count) ** 2
                rho = 0.0
                if variance > 1e-18:
                    rho = max(product / count / np.sqrt(variance), 0.0)
                out[n, v] += weight[trial] * (1 - rho * rho)
    return out


def _held(
    trials: Sequence[Trial], step: float, found: dict[str, Bend], width: float
) -> Finding | None:
    """A joint that rests while the command moves, and follows at the distance of its friction."""
    play = found["play"]
    reach = float(np.median([np.ptp(t.command_rad) for t in trials if np.ptp(t.command_rad) > 0]))
    if not _explains(play, found) or play.values[0] < width * reach / 2:
        return None
    return next(iter(_rested(trials, step, 2 * play.values[0])), None)


def _rested(trials: Sequence[Trial], step: float, travel: float) -> list[Finding]:
    """The finding of a friction that holds against a `travel` of the command, if it does."""
    rests = [r for t in trials for r in _rests(t, step, _REST_TRAVEL)]
    if len(rests) < _FEWEST_RESTS:
        return []
    values = {"longest_s": max(r.end_s - r.start_s for r in rests), "travel_rad": travel}
    return [Finding("held_by_friction", CARE, values)]


def _explains(bend: Bend, found: dict[str, Bend]) -> bool:
    """Whether a fault is clearly better than a servo and its speed limit, and a curve no better.

    Friction is one of the limits of a servo, and is compared with the others.
    """
    limits = found["limits"].nats if bend is not found["play"] else np.inf
    usual = min(found["linear"].nats, found["rate"].nats, limits) - CLEAR_NATS
    curve = found["cubic"].nats + _NEAR_NATS
    return bend.nats < min(usual, curve) and 1 - bend.unexplained > _EXPLAINED


@dataclass(frozen=True)
class _Rest:
    """A stretch in which the reading stays and the command moves on."""

    start_s: float
    end_s: float
    level_rad: float


def _rests(trial: Trial, step: float, least: float) -> list[_Rest]:
    """Stretches in which the reading stays and the command moves by `least` of its range."""
    seen = np.isfinite(trial.position_rad)
    value, time = trial.position_rad[seen], trial.read_time_s[seen]
    command, found, first = trial.command_rad[seen], [], 0
    near = max(1.5 * step, 0.01 * float(np.ptp(value))) if len(value) else 0.0
    for k in range(1, len(value) + 1):
        if k < len(value) and abs(value[k] - value[first]) <= near:
            continue
        if k - first > 3 and first > 0:
            if np.ptp(command[first:k]) > least * float(np.ptp(command)):
                found.append(_Rest(float(time[first]), float(time[k - 1]), float(value[first])))
        first = k
    return found


def _pinned(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Readings that stay at an extreme of their trial, in every trial or by much.

    Something stands in the way in a part of the recording, such as an object in a gripper, where
    no level explains the whole.
    """
    excess = [_dwell(t, step) for t in trials]
    pinned = [e for e in excess if e > _PINNED[0]]
    often = 2 * len(pinned) > len(excess) >= _ENOUGH_TRIALS
    if not pinned or (max(excess) < _PINNED[1] and not often):
        return []
    values = {"trials": len(pinned), "of": len(trials), "percent": 100 * max(pinned)}
    return [Finding("pinned", CARE, values)]


def _dwell(trial: Trial, step: float) -> float:
    """Share of readings at an extreme of the trial, beyond the share of the command at its own."""
    position = trial.position_rad[np.isfinite(trial.position_rad)]
    if len(position) < 20 or np.ptp(position) < 10 * max(step, 1e-6):
        return 0.0
    near = max(1.5 * step, 0.01 * float(np.ptp(position)))

    def shares(value: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([np.mean(value < value.min() + near), np.mean(value > value.max() - near)])

    return float(np.max(shares(position) - shares(trial.command_rad)))


def _two_levels(command: NDArray[np.float64]) -> bool:
    """Whether a command is a binary one, which at other levels is another binary one."""
    near = 0.02 * float(np.ptp(command))
    return bool(np.mean((command < command.min() + near) | (command > command.max() - near)) > 0.9)


def _saturated(trials: Sequence[Trial], step: float, found: dict[str, Bend]) -> Finding | None:
    """Readings that stay at a level while the command goes beyond."""
    bend, base = found["saturation"], explain(trials, step)
    assert base is not None
    if not _explains(bend, found) or all(_two_levels(s.command_rad) for s in base.samples):
        return None
    if found["play"].nats < bend.nats - 2 * CLEAR_NATS:
        return None
    paths = base.predicted(bend.servo)
    lowest, highest = bend.values
    bent = [np.clip(x, lowest, highest) for x in paths]
    if bend.of_goal:
        bent = base.predicted(bend.servo, lambda c: np.clip(c, lowest, highest))
    # the readings follow the bent path, and what the levels cut off moves them no further
    along = np.concatenate([x - x.mean() for x in bent])
    cut = np.concatenate([x - y - np.mean(x - y) for x, y in zip(paths, bent, strict=True)])
    position = np.concatenate([s.position_rad - s.position_rad.mean() for s in base.samples])
    gram = np.array([[along @ along, along @ cut], [along @ cut, cut @ cut]])
    gain, further = np.linalg.solve(gram + 1e-12 * np.eye(2), (along @ position, cut @ position))
    every = np.concatenate(paths)
    low, high = float(every.min()), float(every.max())
    best: tuple[float, float] | None = None
    for top in (False, True):
        depth = high - highest if top else lowest - low
        beyond = every > highest if top else every < lowest
        share = float(np.mean(beyond))
        if depth > _DEEP * (high - low) and share > max(_BEYOND_SHARE, best[0] if best else 0.0):
            readings = np.concatenate([s.position_rad for s in base.samples])[beyond]
            best = share, float(np.median(readings))
    if best is None or not further < _FLAT * gain:
        return None
    return Finding("clipped", CARE, {"level_rad": best[1], "percent": 100 * best[0]})
