"""A second program that commands the same servo: `second_writer` and `scatter_findings`.

A servo executes whichever command arrived last. What another program writes stands until the next
command, so that the set-point is away for a row or so and the joint is pushed off its path, the
more the farther its place is. What a servo with limits (`changes`) leaves is whitened by an
autoregression, and the size of what remains is regressed on the speed and the acceleration of the
path: dates in doubt and friction go with these. A second program's pushes go with the distance from
one place as well, and the large ones towards it.

Between polls a push leaves no such mark. There, tones whose readings differ from period to period
by far more than poll and quantisation explain show that something else moves the joint.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from pupper_sysid.common.tones import least_squares
from pupper_sysid.sysid.doctor.changes import Followed
from pupper_sysid.sysid.doctor.findings import CARE, Finding
from pupper_sysid.sysid.doctor.signals import interpolation_findings
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, quantum, readings
from pupper_sysid.sysid.recordings.recording import Trial

_ORDER, _FEWEST_ROWS = 4, 40  # of the autoregression; of a trial
_PLACES = np.linspace(-0.5, 1.5, 15)  # of the path's range
_JUMP, _STICKS = 0.3, 0.25  # of the command's range: in a row, to and fro
_LARGEST = 20.0  # innovation that counts, of the median
_FAR = 4.0  # innovation that shows its direction, of the usual size
_PUSHED_NATS, _ONE_WAY_NATS = 13.0, 3.0  # of 48 sound recordings the most is 6

_HIGHEST_HZ, _LEAST_AMPLITUDE_RAD, _LEAST_STEPS = 4.5, 0.1, 20.0
_SCATTER, _SCATTER_S = 0.15, 0.012  # of the amplitude; as an error of the time
_HARMONICS, _FEWEST_READINGS = 3, 25


def second_writer(joint: Followed) -> list[Finding]:
    """Pushes towards one place while the command goes on."""
    loaded = any(t.load is not None for t in joint.trials)  # its swings are not this servo's
    sticks = 2 * joint.friction_rad > _STICKS * joint.reach  # it jumps where friction lets go
    if loaded or sticks or interpolation_findings(joint.trials, joint.step):
        return []
    nats, times = pushes(joint)
    if nats < _PUSHED_NATS or not len(times):
        return []
    values = {"times": len(times), "time_s": float(times.min()) - joint.start_s}
    return [joint.rivalled(Finding("second_writer", CARE, values))]  # a bent path pushes as well


def pushes(joint: Followed) -> tuple[float, NDArray[np.float64]]:
    """Advantage of pushes towards one place over none [nats], and times of the largest."""
    parts = []
    for number, sample in enumerate(joint.base.samples):
        time, rises = sample.time_s, np.diff(sample.time_s) > 0
        jump = float(np.max(np.abs(np.diff(sample.command_rad)), initial=0.0))
        if len(time) < _FEWEST_ROWS or not rises.all() or jump > _JUMP * joint.reach:
            continue  # after a step friction stops a servo on its way, to a place between all
        path = joint.path_of_trial(number)
        rate = np.gradient(path, time)
        rest = sample.position_rad - joint.fit.values[0] * path
        parts.append(
            (time[_ORDER:], path[_ORDER:], np.abs(rate[_ORDER:]),
             np.abs(np.gradient(rate, time)[_ORDER:]), _innovations(rest - np.median(rest)))
        )  # fmt: skip
    if not parts:
        return 0.0, np.zeros(0)
    time, path, rate, bend, innovations = (np.concatenate(p) for p in zip(*parts, strict=True))
    usual = float(np.median(np.abs(innovations))) + joint.step / 4 + 1e-9
    size = np.minimum(np.abs(innovations), _LARGEST * usual)
    plain, spread = _spread(size, usual, rate, bend)
    scaled = size / spread
    far = scaled > _FAR / 0.6745 * float(np.median(scaled))
    far[1:] &= ~far[:-1]  # one push shows in the row after it, too
    away = scaled - scaled.mean()
    along = float(np.clip(away[1:] @ away[:-1] / max(away @ away, 1e-12), 0.0, 0.95))
    best = 0.0
    low, high = float(path.min()), float(path.max())
    for place in low + (high - low) * _PLACES:
        likelier = (_spread(size, usual, rate, bend, np.abs(path - place))[0] - plain) * (
            (1 - along) / (1 + along)
        )
        towards = np.sign(place - path[far]) == np.sign(innovations[far])
        one_way = _one_way(int(towards.sum()), len(towards))
        if one_way > _ONE_WAY_NATS:  # size alone goes with a load or the place of friction, too
            best = max(best, likelier + one_way)
    return best, time[far]


def _innovations(rest: NDArray[np.float64]) -> NDArray[np.float64]:
    """What residuals are not by those before them; pushes do not set the autoregression."""
    design = np.column_stack([rest[_ORDER - k : len(rest) - k] for k in range(1, _ORDER + 1)])
    wanted, weight = rest[_ORDER:], np.ones(len(rest) - _ORDER)
    left = wanted
    for _ in range(4):
        left = wanted - design @ least_squares(design * weight[:, None], wanted * weight)
        usual = 1.4826 * float(np.median(np.abs(left))) + 1e-12
        weight = np.sqrt(1 / np.maximum(1, np.abs(left) / (2 * usual)))
    return left


def _spread(size: NDArray, usual: float, *causes: NDArray) -> tuple[float, NDArray[np.float64]]:
    """Log-likelihood of sizes whose mean is a sum of positive shares of `causes`, and that mean."""
    spread = likely_spread(size, usual, causes)
    return -float(np.sum(np.log(spread) + size / spread)), spread


def likely_spread(size: NDArray, usual: float, causes: Sequence[NDArray]) -> NDArray[np.float64]:
    """Mean of exponential sizes as a sum of positive shares of 1 and `causes`, by some `rows`."""
    design = np.column_stack([np.ones_like(size), *causes])
    design = design / np.maximum(design.mean(axis=0), 1e-12)
    spread = np.full_like(size, usual)
    for _ in range(3):
        weighted = design / spread[:, None]
        spread = np.maximum(design @ nnls(weighted, size / spread)[0], 0.3 * usual)
    return spread


def _one_way(towards: int, of: int) -> float:
    """Likelihood of a direction of its own over chance [nats]; 0 if most go away."""
    share = towards / max(of, 1)
    if share <= 0.5:
        return 0.0
    rest = of - towards
    return towards * np.log(2 * share) + (rest * np.log(2 * (1 - share)) if rest else 0.0)


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
        left = np.sum((position - design @ solution) ** 2) / (len(time) - design.shape[1])
        speed = np.sqrt(2) * np.pi * tone.frequency_hz * amplitude
        if amplitude < max(_LEAST_AMPLITUDE_RAD, _LEAST_STEPS * step):
            continue
        if np.sqrt(left) > max(_SCATTER * amplitude, _SCATTER_S * speed):
            shares.append(float(np.sqrt(left)) / amplitude)
    if len(shares) < 2 or 2 * len(shares) < slow:
        return []
    return [Finding("unrepeatable", CARE, {"percent": 100 * float(np.median(shares))})]
