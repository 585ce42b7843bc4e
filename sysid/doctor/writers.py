"""A second program that commands the same servo: `second_writer` and `scatter_findings`.

A servo executes whichever command arrived last. What another program writes stands until the next
command, so that the set-point is away for a row or so and the joint is pushed off its path. The
path's residuals (`explanations`) are filtered by a Kalman filter whose state is a servo of the same
low-pass under a small random set-point error: its innovations are white where the servo explains
the motion, and each push is one large innovation. A second program's pushes all go to one place;
what friction does at reversals, or a limit of the speed, does not.

Between polls a push leaves no such mark. There, tones whose readings differ from period to period
by far more than poll and quantisation explain show that something else moves the joint.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pupper_sysid.common.tones import least_squares
from pupper_sysid.sysid.doctor.bends import bends
from pupper_sysid.sysid.doctor.changes import Followed
from pupper_sysid.sysid.doctor.findings import CARE, Finding
from pupper_sysid.sysid.doctor.signals import interpolation_findings
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, quantum, readings
from pupper_sysid.sysid.recordings.recording import Trial

_ROWS_OF_PERIOD = 60.0  # more rows in a natural period are not needed
_ERRORS = np.geomspace(0.01, 10, 6)  # of the set-point, of the residuals
_DATES_S = (0.0, 0.001, 0.004, 0.012)  # standard deviation of a reading's time
_NOISES = (0.3, 1.0, 4.0)  # of a reading's variance, in those of its quantisation or scatter
_FREEDOM = 4.0  # of Student's distribution: pushes do not set the noise
_FAR = 5.0  # of the usual size of innovations
_JUMP, _FEWEST_ROWS = 0.3, 40  # of the command's range in a row
_FEWEST_PUSHES, _HEAVY, _ONE_WAY = 6, 12.0, 0.85
_PLACES = np.linspace(-0.5, 1.5, 41)  # of the command's range
_PARTS, _MOST_IN_PART = 6, 0.6
_BENT = 0.5  # of what a servo leaves

_HIGHEST_HZ, _LEAST_AMPLITUDE_RAD, _LEAST_STEPS = 4.5, 0.1, 20.0
_SCATTER, _SCATTER_S = 0.15, 0.012  # of the amplitude; as an error of the time
_HARMONICS, _FEWEST_READINGS = 3, 25


def second_writer(joint: Followed) -> list[Finding]:
    """Pushes towards one place while the command goes on, unless a bend of the path makes them."""
    if interpolation_findings(joint.trials, joint.step):
        return []
    bent = bends(joint.trials, joint.step)
    if bent and min(b.unexplained for b in bent.values()) < _BENT * bent["linear"].unexplained:
        return []
    pushes = [_pushes(joint, number) for number in range(len(joint.base.samples))]
    times, sizes, wanted = (np.concatenate(each) for each in zip(*pushes, strict=True))
    if len(times) < _FEWEST_PUSHES or not _spread(times, joint):
        return []
    low = min(float(s.command_rad.min()) for s in joint.base.samples)
    high = max(float(s.command_rad.max()) for s in joint.base.samples)
    ways = [np.mean(np.sign(place - wanted) == np.sign(sizes))
            for place in low + (high - low) * _PLACES]  # fmt: skip
    if max(ways) < _ONE_WAY:
        return []
    values = {"times": len(times), "time_s": float(times.min()) - joint.start_s}
    return [Finding("second_writer", CARE, values)]


def _spread(times: NDArray[np.float64], joint: Followed) -> bool:
    """Whether pushes come all along: one tone that is too fast for a servo is in one place."""
    every = np.sort(np.concatenate([s.time_s for s in joint.base.samples]))
    place = np.searchsorted(every, times) / len(every)
    counts = np.histogram(place, _PARTS, (0.0, 1.0))[0]
    return bool((counts > 0).sum() >= _PARTS / 2 and counts.max() <= _MOST_IN_PART * len(times))


def _pushes(joint: Followed, number: int) -> tuple[NDArray[np.float64], ...]:
    """Times, sizes and places [rad of command] of pushes in one trial."""
    none = (np.zeros(0),) * 3
    sample = joint.base.samples[number]
    terms = joint.fit.terms
    path = joint.path_of_trial(number)
    natural, damping = np.exp(terms[:2])
    if len(path) < _FEWEST_ROWS or not (np.diff(sample.time_s) > 0).all():
        return none
    jump = float(np.max(np.abs(np.diff(sample.command_rad)), initial=0.0))
    if jump > _JUMP * float(np.ptp(sample.command_rad)):
        return none  # after a step friction stops a servo on its way, to a place between all
    spacing = 2 * np.pi / natural / _ROWS_OF_PERIOD
    slots = np.floor(sample.time_s / spacing)
    kept = np.concatenate([[0], np.flatnonzero(np.diff(slots)) + 1])
    time, position, path = sample.time_s[kept], sample.position_rad[kept], path[kept]
    if len(time) < _FEWEST_ROWS:
        return none
    rate = np.gradient(path, time)
    design = np.column_stack([np.ones_like(path), path, rate, np.gradient(rate, time)])
    design /= np.maximum(np.abs(design).max(axis=0), 1e-12)
    weight, rest, usual = np.ones_like(path), position, 0.0
    for _ in range(4):
        rest = position - design @ least_squares(design * weight[:, None], position * weight)
        usual = max(_usual(rest), joint.step / 3, 1e-5)
        weight = np.sqrt(1 / np.maximum(1, np.abs(rest) / (2 * usual)))
    best, innovations = np.inf, rest
    scatter = _usual(np.diff(rest, 2)) / np.sqrt(6)  # of white noise
    least = max(joint.step**2 / 12, scatter**2, 1e-9)
    for error in _ERRORS * usual**2 / natural:
        for date_s in _DATES_S:
            for times in _NOISES:
                noise = least * times + (date_s * rate) ** 2
                found, variance = _innovations(time, rest, noise, natural, damping, error)
                scaled = found / np.sqrt(variance)
                nats = np.sum(0.5 * np.log(variance)
                              + 0.5 * (_FREEDOM + 1) * np.log1p(scaled**2 / _FREEDOM))  # fmt: skip
                if nats < best:
                    best, innovations = nats, scaled
    size = innovations / max(_usual(innovations), 1e-9)
    if np.mean(size**4) < _HEAVY:
        return none
    far = np.abs(size) > _FAR
    far[1:] &= ~far[:-1]  # one push shows in the row after it, too
    return time[far], size[far], path[far]


def _usual(values: NDArray[np.float64]) -> float:
    return 1.4826 * float(np.median(np.abs(values)))


@njit(cache=True)
def _innovations(time, rest, noise, natural, damping, error):
    """Innovations and their variances of residuals of a second-order servo.

    Its set-point is in error by white noise of the spectral density `error`, each residual by
    `noise`.
    """
    count = len(time)
    innovation, variance = np.empty(count), np.empty(count)
    place = speed = 0.0
    p00, p01, p11 = 1.0, 0.0, natural * natural
    for k in range(count):
        if k > 0:
            parts = max(1, int(np.ceil((time[k] - time[k - 1]) * natural / 0.2)))
            step = (time[k] - time[k - 1]) / parts
            for _ in range(parts):
                pull, keep = -natural * natural * step, 1 - 2 * damping * natural * step
                a, b = 1 + step * pull, step * keep
                speed = pull * place + keep * speed
                place += step * speed
                q00, q01, q11 = p00, p01, p11
                p00 = a * (a * q00 + b * q01) + b * (a * q01 + b * q11)
                p01 = pull * (a * q00 + b * q01) + keep * (a * q01 + b * q11)
                p11 = pull * (pull * q00 + keep * q01) + keep * (pull * q01 + keep * q11)
                more = error * natural**4 * step
                p00 += more * step * step
                p01 += more * step
                p11 += more
        variance[k] = p00 + noise[k]
        innovation[k] = rest[k] - place
        g0, g1 = p00 / variance[k], p01 / variance[k]
        place += g0 * innovation[k]
        speed += g1 * innovation[k]
        p11 -= g1 * p01
        p01 *= 1 - g0
        p00 *= 1 - g0
    return innovation, variance


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
