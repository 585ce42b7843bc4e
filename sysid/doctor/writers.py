"""A second program that commands the same servo: `second_writer` and `scatter_findings`.

A servo executes whichever command arrived last. What another program writes stands until the next
command, a loop later at most, and pushes the joint as a pulse of that length on the set-point does:
by the servo's own response, towards one goal, and no farther than from the command to that goal.

What a servo with limits (`changes`) leaves of the readings is whitened by an autoregression, and
so is the response to a pulse at each command, beside a constant for as long. The pulses that stand
out of the noise are taken one after the other, the largest first (matching pursuit). Their sizes
are compared with those of pulses of no direction: all may reach one goal, any part of the way to
it, or go towards it as far as others do.

Between polls a push leaves no such mark. There, tones whose readings differ from period to period
by far more than poll and quantisation explain show that something else moves the joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from pupper_sysid.common.signals import robust_sd
from pupper_sysid.common.tones import least_squares
from pupper_sysid.sysid.doctor.changes import Followed
from pupper_sysid.sysid.doctor.findings import CARE, Finding
from pupper_sysid.sysid.doctor.signals import interpolation_findings
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, quantum, readings
from pupper_sysid.sysid.recordings.recording import Trial

_ORDER, _FEWEST_ROWS, _FINEST_S = 4, 40, 0.005  # of the autoregression; of a trial; of the rows
_JUMP, _RESTS, _SETTLED_S = 0.3, 0.1, 0.15  # of the command's range; of the jump
_STICKS = 0.25  # of the command's range, to and fro
_RESPONSE_S, _TIME_CONSTANTS = 0.4, 6.0  # that a pulse is looked at, at most
_LARGEST = 20.0  # innovation that counts in the noise, of the median
_STANDS_OUT, _MOST_PULSES = 4.5, 150  # of its standard deviation; of a trial
_SHAPE = 0.3  # error of a response, of its size
_ECHO = 3.0  # a pulse beside another so much larger is an error of its response
_SMALLEST, _EXACT, _FARTHEST = 0.06, 0.15, 1.35  # of the command's range; of the way to the goal
_GOALS = np.linspace(-0.5, 1.5, 41)  # of the command's range
_FEWEST, _PLACES = 3, 0.1  # pulses; range of their commands, of the whole
_NATS = 1.3  # advantage, of 189 sound recordings 0.8 at most
_ALIKE, _ELSEWHERE, _MOST_PLACES = 0.1, 0.2, 500  # of the ranks; share of pulses
_BY_CHANCE, _MOST_NATS = (0.05, 0.3), 2.5  # share of pulses that another cause has; of a pulse

_HIGHEST_HZ, _LEAST_AMPLITUDE_RAD, _LEAST_STEPS = 4.5, 0.1, 20.0
_SCATTER, _SCATTER_S = 0.15, 0.012  # of the amplitude; as an error of the time
_HARMONICS, _FEWEST_READINGS = 3, 25


@dataclass(frozen=True)
class Pulses:
    """Pulses of the set-point, a loop long, that readings show beside the command."""

    time_s: NDArray[np.float64]
    """Of the command that they follow."""
    command_rad: NDArray[np.float64]
    size_rad: NDArray[np.float64]
    """Beside the command, had they stood for the whole loop."""
    doubt_rad: NDArray[np.float64]
    """Standard deviation."""
    place: NDArray[np.float64]
    """Ranks, from 0 to 1, of the command, of the speed of the path and of the time since a step
    among those of the trial, shape (pulses, 3)."""

    def part(self, inside: NDArray) -> Pulses:
        """Those that are `inside`, by mask or number."""
        return Pulses(*(getattr(self, f.name)[inside] for f in fields(self)))

    def least(self, joint: Followed) -> NDArray[np.float64]:
        """Sizes from which they count [rad]."""
        return np.maximum(_STANDS_OUT * self.doubt_rad, _SMALLEST * joint.reach)


def _together(parts: Sequence[Pulses]) -> Pulses:
    return Pulses(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Pulses)))


def second_writer(joint: Followed) -> list[Finding]:
    """Pulses towards one goal while the command goes on."""
    loaded = any(t.load is not None for t in joint.trials)  # its swings are not this servo's
    sticks = 2 * joint.friction_rad > _STICKS * joint.reach  # it jumps where friction lets go
    if loaded or sticks or interpolation_findings(joint.trials, joint.step):
        return []
    stays, none = zip(*(pulses(joint, n) for n in range(len(joint.base.samples))), strict=True)
    every, none = _together(stays), _together(none)
    every = every.part(np.abs(every.size_rad) > every.least(joint))
    nats, towards = towards_one_goal(every, none, joint)
    places = float(np.ptp(every.command_rad[towards])) if towards.any() else 0.0
    if nats < _NATS or towards.sum() < _FEWEST or places < _PLACES * joint.reach:
        return []  # at one place only, what a servo does there looks like a goal
    times = every.time_s[towards]
    values = {"times": len(times), "time_s": float(times.min()) - joint.start_s}
    return [joint.rivalled(Finding("second_writer", CARE, values))]  # a bent path pushes as well


def towards_one_goal(
    pulses: Pulses, none: Pulses, joint: Followed
) -> tuple[float, NDArray[np.bool_]]:
    """Advantage of one goal over pulses of no direction [nats], and which go towards it.

    `none`: commands that no pulse follows.
    """
    size, far = pulses.size_rad, np.abs(pulses.size_rad)
    if not len(size):
        return 0.0, np.zeros(0, bool)
    least = pulses.least(joint)
    usual = max(float(np.mean(far - least)), 0.05 * joint.reach)
    chance = 0.5 / usual * np.exp(-(far - least) / usual)
    command = np.concatenate([s.command_rad for s in joint.base.samples])
    low, high = float(command.min()), float(command.max())
    best, at, which = -np.inf, low, np.zeros(len(size), bool)
    for goal in low + (high - low) * _GOALS:
        way = goal - pulses.command_rad
        most = _FARTHEST * np.abs(way) + 2 * pulses.doubt_rad
        within = (np.sign(size) == np.sign(way)) & (far < most)
        spread = np.hypot(_EXACT * way, pulses.doubt_rad)
        whole = np.exp(-0.5 * ((size - way) / spread) ** 2) / (np.sqrt(2 * np.pi) * spread)
        any_part = within / np.maximum(most - least, 0.05 * joint.reach)
        as_others = 2 * chance * within
        for density in (0.95 * whole + 0.05 * as_others, any_part, as_others):
            for share in _BY_CHANCE:
                likely = (1 - share) * density + share * chance
                nats = float(np.minimum(np.log(likely / chance), _MOST_NATS).sum())
                if nats > best:
                    best, at, which = nats, goal, within
    seen = np.clip(1 - none.least(joint) / (np.abs(at - none.command_rad) + 1e-9), _ELSEWHERE, 1)
    best -= 0.5 * float(np.log(len(_GOALS))) + _of_one_place(pulses, none.place, seen)
    return best, which


def _of_one_place(pulses: Pulses, others: NDArray, seen: NDArray[np.float64]) -> float:
    """Advantage of pulses that repeat where the joint moves alike over those at any time [nats].

    What a servo does beyond its model it does again there. `seen`: share of pulses at the `others`
    that would be seen.
    """
    apart = np.abs(pulses.time_s[:, None] - pulses.time_s) > _RESPONSE_S

    def near(ends: NDArray) -> NDArray[np.float64]:
        return np.exp(-0.5 * (((pulses.place[:, None] - ends) / _ALIKE) ** 2).sum(axis=2))

    usual = near(others) @ seen / np.maximum(seen.sum(), 1e-9)
    again = (near(pulses.place) * apart).sum(axis=1) / np.maximum(apart.sum(axis=1), 1)
    nats = np.log(_ELSEWHERE + (1 - _ELSEWHERE) * again / np.maximum(usual, 1e-9))
    return max(float(nats.sum()), 0.0)


def pulses(joint: Followed, number: int) -> tuple[Pulses, Pulses]:
    """Pulses beside the command of a trial that stand out of the noise, and some of no size."""
    nothing = np.zeros(0)
    none = Pulses(nothing, nothing, nothing, nothing, np.zeros((0, 3)))
    sample, gain = joint.base.samples[number], joint.fit.values[0]
    trial = next(t for t in joint.trials if t.send_time_s[0] == sample.start_s)
    time, position, path = sample.time_s, sample.position_rad, joint.path_of_trial(number)
    if len(time) < _FEWEST_ROWS or not (np.diff(time) > 0).all():
        return none, none
    together = max(1, int(_FINEST_S / float(np.median(np.diff(time))) + 1e-9))
    time, position, path = (_means(x, together) for x in (time, position, path))
    if len(time) < _FEWEST_ROWS:
        return none, none
    rest = position - gain * path
    weights, innovations = _autoregression(rest - np.median(rest))
    rate = np.gradient(path, time)
    noise = np.full(len(time), np.inf)
    noise[_ORDER:] = np.maximum(
        _noise(innovations, joint.step, np.abs(rate), np.abs(np.gradient(rate, time))),
        max(joint.step, 1e-6) / np.sqrt(12),
    )
    residuals = np.zeros(len(time))
    residuals[_ORDER:] = innovations / noise[_ORDER:]

    natural, damping, lag = *np.exp(joint.fit.terms[:2]), float(joint.fit.terms[9])
    slowest = min(damping, 1.0) * natural
    loop, gap = (float(np.median(np.diff(t))) for t in (trial.send_time_s, time))
    sent = trial.send_time_s[trial.send_time_s + lag < time[-1]]
    cells = max(1, int(_FINEST_S / loop + 1e-9))
    at, command = (_means(x, cells) for x in (sent, trial.command_rad[: len(sent)]))
    lasts = min(_RESPONSE_S, max(_TIME_CONSTANTS / slowest, 3 * gap))
    rows = np.searchsorted(time, at + lag)[:, None] + np.arange(int(np.ceil(lasts / gap)) + 2)
    recorded = rows < len(time)
    rows = np.minimum(rows, len(time) - 1)
    steps = _steps(trial, joint.reach)
    since_step = _since(steps, time)
    recorded &= (since_step >= lag + max(_SETTLED_S, 4 / slowest))[rows]
    since = time[rows] - at[:, None] - lag
    response = gain * (_step(since, natural, damping) - _step(since - loop, natural, damping))
    white = response.copy()
    for k, weight in enumerate(weights, 1):
        white[:, k:] -= weight * response[:, :-k]
    white = np.where(recorded, white / noise[rows], 0.0)
    constant = np.where(recorded, (1 - weights.sum()) / noise[rows], 0.0)
    share = (white * constant).sum(1) / np.maximum((constant**2).sum(1), 1e-12)
    shape = white - share[:, None] * constant
    power = (shape**2).sum(1)
    seen = power > 0.25 * np.median(power[power > 0]) if (power > 0).any() else power > 0
    power = np.where(seen, power, np.inf)

    doubt = power**-0.5
    numbers, sizes = _pursuit(shape, white, power, rows, residuals)
    place = np.column_stack(
        [command, rate[rows[:, 0]], _since(steps, at) if len(steps) else np.zeros(len(at))]
    )
    place = np.apply_along_axis(_shares_below, 0, place)
    some = np.flatnonzero(seen)[:: 1 + int(seen.sum()) // _MOST_PLACES]
    others = Pulses(at[some], command[some], np.zeros(len(some)), doubt[some], place[some])
    every = Pulses(at[numbers], command[numbers], sizes, doubt[numbers], place[numbers])
    beside = np.abs(every.time_s[:, None] - every.time_s) < lasts
    larger = np.abs(every.size_rad) > _ECHO * np.abs(every.size_rad[:, None])
    return every.part(np.asarray(~(beside & larger).any(axis=1))), others


def _shares_below(values: NDArray) -> NDArray[np.float64]:
    """Ranks from 0 to 1, those of equal values alike."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - 0.5 * counts)[places] / len(values)


def _pursuit(
    shape: NDArray, white: NDArray, power: NDArray, rows: NDArray, residuals: NDArray
) -> tuple[list[int], NDArray[np.float64]]:
    """Numbers and sizes of the pulses in `residuals`, the largest first.

    `shape`: responses at their `rows`, of that `power`, beside a constant; `white`: with it.
    """
    numbers, sizes = [], []
    product = (shape * residuals[rows]).sum(1)
    for _ in range(_MOST_PULSES):
        k = int(np.argmax(np.abs(product) / np.sqrt(power)))
        size = product[k] / power[k]
        if not abs(size) * np.sqrt(power[k]) > _STANDS_OUT:
            break
        numbers.append(k)
        sizes.append(size)
        of, explained = rows[k, white[k] != 0], size * white[k, white[k] != 0]
        residuals[of] = (residuals[of] - explained) / np.hypot(1, _SHAPE * explained)
        power[k] = np.inf
        near = np.abs(rows[:, 0] - rows[k, 0]) <= rows.shape[1]
        product[near] = (shape[near] * residuals[rows[near]]).sum(1)
    return numbers, np.array(sizes)


def _means(values: NDArray[np.float64], together: int) -> NDArray[np.float64]:
    return values[: len(values) // together * together].reshape(-1, together).mean(axis=1)


def _steps(trial: Trial, reach: float) -> NDArray[np.float64]:
    """Times of steps of the command [s]: friction and limits stop a servo on its way."""
    move = np.abs(np.diff(trial.command_rad))
    beside = np.maximum(np.append(0.0, move[:-1]), np.append(move[1:], 0.0))
    return trial.send_time_s[1:][(move > _JUMP * reach) & (beside < _RESTS * move)]


def _since(steps: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Time since the last step [s]."""
    return time - np.append(-np.inf, steps)[np.searchsorted(steps, time)]


def _step(time: NDArray, natural: float, damping: float) -> NDArray[np.float64]:
    """Response of a second-order servo to a step."""
    time = np.maximum(time, 0.0)
    root = np.sqrt(complex(damping**2 - 1)) or 1e-4
    fast, slow = natural * (damping + root), natural * (damping - root)
    decay = (fast * np.exp(-slow * time) - slow * np.exp(-fast * time)) / (fast - slow)
    return 1 - decay.real


def _autoregression(rest: NDArray[np.float64]) -> tuple[NDArray, NDArray[np.float64]]:
    """Weights of the rows before each, and what is not by those; pulses do not set the weights."""
    design = np.column_stack([rest[_ORDER - k : len(rest) - k] for k in range(1, _ORDER + 1)])
    wanted, weight = rest[_ORDER:], np.ones(len(rest) - _ORDER)
    weights, innovations = np.zeros(_ORDER), wanted
    for _ in range(4):
        weights = least_squares(design * weight[:, None], wanted * weight)
        innovations = wanted - design @ weights
        usual = robust_sd(innovations) + 1e-12
        weight = np.sqrt(1 / np.maximum(1, np.abs(innovations) / (2 * usual)))
    return weights, innovations


def _noise(innovations: NDArray[np.float64], step: float, *causes: NDArray) -> NDArray[np.float64]:
    """Standard deviation of each, which grows by positive shares of `causes`.

    Dates in doubt go with the speed of the path, friction with its acceleration.
    """
    usual = float(np.median(np.abs(innovations))) + step / 4 + 1e-9
    size = np.minimum(np.abs(innovations), _LARGEST * usual)
    design = np.column_stack([np.ones_like(size), *(c[_ORDER:] for c in causes)])
    design = design / np.maximum(design.mean(axis=0), 1e-12)
    spread = np.full_like(size, usual)
    for _ in range(3):
        weighted = design / spread[:, None]
        spread = np.maximum(design @ nnls(weighted, size / spread)[0], 0.3 * usual)
    return spread * robust_sd(innovations / spread)


def scatter_findings(tones: Sequence[Trial], lattice: PollLattice) -> list[Finding]:
    """Tones whose periods differ by far more than poll and quantisation explain."""
    shares, slow, step = [], 0, quantum(tones)
    if lattice.kind == "unresolved":
        return []
    for tone in tones:
        if not 0 < tone.frequency_hz <= _HIGHEST_HZ or tone.load is not None:
            continue
        read = readings(tone, lattice)
        settled = read.time_s > tone.send_time_s[0] + 1 / tone.frequency_hz + 0.3
        time, position = read.time_s[settled], read.position_rad[settled]
        if len(time) < _FEWEST_READINGS:
            continue
        slow += 1
        angle = np.outer(time, 2 * np.pi * tone.frequency_hz * np.arange(1, _HARMONICS + 1))
        design = np.column_stack([np.ones_like(time), time, np.sin(angle), np.cos(angle)])
        solution = least_squares(design, position)
        amplitude = float(np.hypot(solution[2], solution[2 + _HARMONICS]))
        variance = np.sum((position - design @ solution) ** 2) / (len(time) - design.shape[1])
        speed = np.sqrt(2) * np.pi * tone.frequency_hz * amplitude
        if amplitude < max(_LEAST_AMPLITUDE_RAD, _LEAST_STEPS * step):
            continue
        if np.sqrt(variance) > max(_SCATTER * amplitude, _SCATTER_S * speed):
            shares.append(float(np.sqrt(variance)) / amplitude)
    if len(shares) < 2 or 2 * len(shares) < slow:
        return []
    return [Finding("unrepeatable", CARE, {"percent": 100 * float(np.median(shares))})]
