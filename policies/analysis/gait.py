"""Measures of a gait: frequency, regularity, phases and duty factors of feet, jitter, amplitude.

`describe` makes a `GaitReport` of a rollout; the measures themselves are functions of arrays, time
along the first axis, for logs of other origin. Signals are joint angles or targets
[rad], contacts are booleans per foot in the order LF, RF, LB, RB.

A frequency is estimated from at least five seconds, with an interval, not read off a spectrum of
one second, whose bins are 1 Hz apart. A sine's R² is given with that of noise (`null_r2`): the best
of many sines explains a good part of any slow signal.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.optimize import minimize_scalar
from scipy.signal import fftconvolve, lfilter

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import UNKNOWN, Interval, mean_of, t_quantile
from pupper_sysid.common.results import Result
from pupper_sysid.common.signals import rms
from pupper_sysid.common.tones import fit_sine, least_squares, sine_design
from pupper_sysid.policies.walks.rollouts import Rollout

Array = NDArray[np.float64]
Signal = NDArray[np.floating] | NDArray[np.bool_]

SHORTEST_S = 5.0
"""Shortest signal whose frequency is estimated [s]."""

_SLOWEST_HZ = 0.5  # what is slower is drift: a leg of 0.1 m swings freely at 1.6 Hz
STILL = 1e-9
"""Deviation below which a signal does not move, in its own unit."""
_FEWEST_PHASES = 6
_WALKS = np.concatenate([[0.0], np.geomspace(1e-4, 1e3, 29)])


def frequency(signal: Signal, step_s: float) -> Interval:
    """Common gait frequency of several channels: the mean rate of their common phase [Hz].

    The search begins at the best common sine (`sine_frequency`). Every stride then gives one phase,
    by least squares of a sine, a cosine and an offset over all channels, weighted by how well the
    sine fits them and without the second harmonic of the whole signal; the slope of these phases is
    the frequency. The line has two kinds of error: white ones, from noise on the signal, and a
    random walk, since a gait keeps no clock. Their ratio follows from restricted maximum
    likelihood, the line from generalised least squares, its 90 % interval from Student's t.

    Residuals of the sine alone give intervals that cover 20-40 % where the rhythm itself wanders.
    This interval covers 91-98 % for noise on a steady rhythm and 70-88 % for one that wanders,
    which a few seconds hardly show.

    The signal has the shape (steps, channels).
    """
    best = sine_frequency(signal, step_s)
    y = standardised(signal)
    steps, time = len(y), times(len(y), step_s)
    angle = 2 * np.pi * best * time
    design = sine_design(angle, 2 * angle)
    coefficients = least_squares(design, y)
    y = y - design[:, 3:] @ coefficients[3:]
    phasor = coefficients[1] - 1j * coefficients[2]
    strides = max(_FEWEST_PHASES, int(steps * step_s * best))
    chunks = np.array_split(np.arange(steps), strides)
    ahead = np.zeros(strides, complex)
    for k, part in enumerate(chunks):
        # with its own offset, or slow noise would leak into the phases
        ahead[k] = (fit_sine(angle[part], y[part]).phasor * phasor.conj()).sum()
    middle = np.array([time[part].mean() for part in chunks])
    slope, error = _slope(np.unwrap(np.angle(ahead)), middle)
    rate, half = best + slope / (2 * np.pi), t_quantile(strides - 2) * error / (2 * np.pi)
    return Interval(rate, rate - half, rate + half)


def sine_frequency(signal: Signal, step_s: float) -> float:
    """Frequency of the sine that explains most of several channels, each with its own phase [Hz].

    Maximises the mean R² over channels, between 0.5 Hz and a quarter of the sampling rate: the
    highest point of a periodogram padded to eighths of a bin, refined continuously. A gait and its
    harmonics differ by their size only.

    The signal has the shape (steps, channels).
    """
    y = standardised(signal)
    if len(y) < int(SHORTEST_S / step_s + 1e-9):  # whole steps, of any control rate
        raise InputError(
            f"A signal of {len(y) * step_s:.2f} s is too short for a gait's frequency: "
            f"{SHORTEST_S:g} s are needed."
        )
    if not y.any():
        raise InputError("Nothing moves in this signal: it has no frequency.")
    coarse, within = _peak(y, step_s), 0.5 / (len(y) * step_s)
    low, high = max(coarse - within, _SLOWEST_HZ), min(coarse + within, 0.25 / step_s)
    optimum: Any = minimize_scalar(
        lambda f: -sine_fit_r2(y, step_s, f).sum(),
        bounds=(low, high), method="bounded", options={"xatol": 1e-7},
    )  # fmt: skip
    return float(optimum.x)


def sine_fit_r2(signal: Signal, step_s: float, frequency_hz: float) -> Array:
    """R² of the least-squares sine of one frequency, with its own phase and offset per channel.

    The signal has the shape (steps, channels). R² has the shape (channels,); it is 0 for a channel
    that does not move.
    """
    y = standardised(signal)
    design = sine_design(2 * np.pi * frequency_hz * times(len(y), step_s))
    residuals = y - design @ least_squares(design, y)
    moves = np.any(y, axis=0)
    return np.where(moves, 1.0 - (residuals**2).mean(axis=0), 0.0)


def null_r2(signal: Signal, step_s: float, rng: np.random.Generator, draws: int = 200) -> Array:
    """R² of the best common sine in noise like a signal, but without a rhythm.

    The noise is AR(1) with each channel's own autocorrelation at one step, its innovations
    correlated between channels as the channels are.

    The signal has the shape (steps, channels). R² has the shape (draws, channels), each draw at its
    own best frequency.
    """
    y = standardised(signal)
    steps, channels = y.shape
    memory = np.clip((y[1:] * y[:-1]).mean(axis=0), -0.999, 0.999)
    variance, axes = np.linalg.eigh(y.T @ y / steps)
    mix = (axes * np.sqrt(np.clip(variance, 0.0, None))).T
    r2 = np.zeros((draws, channels))
    for row in r2:
        pushes = rng.standard_normal((steps, channels)) @ mix
        # stationary from the first step, or that would look like a slow oscillation
        pushes[0] /= np.sqrt(1.0 - memory**2)
        noise = np.stack(
            [lfilter([1.0], [1.0, -m], x) for m, x in zip(memory, pushes.T, strict=True)], axis=1
        )
        row[:] = sine_fit_r2(noise, step_s, _peak(standardised(noise), step_s))
    return r2


def standardised(signal: Signal) -> Array:
    """Each channel about its mean, in units of its deviation; zeros if it stands still."""
    y = np.asarray(signal, float)
    deviation = y.std(axis=0)
    return (y - y.mean(axis=0)) / np.where(deviation > STILL, deviation, np.inf)


def times(steps: int, step_s: float) -> Array:
    """Times about the middle [s], where offset, phase and frequency hardly correlate."""
    return step_s * (np.arange(steps, dtype=float) - (steps - 1) / 2)


def _peak(y: Array, step_s: float) -> float:
    """Highest point of the periodogram, all channels together [Hz]."""
    size = 1 << (8 * len(y) - 1).bit_length()
    at = np.fft.rfftfreq(size, step_s)
    power = (np.abs(np.fft.rfft(y, size, axis=0)) ** 2).sum(axis=1)
    power[(at < _SLOWEST_HZ) | (at > 0.25 / step_s)] = -1.0
    return float(at[power.argmax()])


def _slope(phase: Array, time: Array) -> tuple[float, float]:
    """Slope of a phase with white errors and a random walk, and its standard error."""
    count = len(phase)
    line = np.stack([np.ones(count), time], axis=1)
    steps = np.arange(count)
    walk = np.minimum.outer(steps, steps).astype(float)
    # restricted likelihood: of what no straight line explains, along axes that both errors share
    free = null_space(line.T)
    spread, axes = np.linalg.eigh(free.T @ walk @ free)
    error = (free @ axes).T @ phase
    scale = 1.0 + _WALKS[:, None] * spread
    misfit = (error**2 / scale).sum(axis=1) + np.finfo(float).tiny
    likelihood = -np.log(scale).sum(axis=1) - len(error) * np.log(misfit)
    best = int(likelihood.argmax())
    factor = np.linalg.cholesky(np.eye(count) + _WALKS[best] * walk)
    white = np.linalg.solve(factor, line)
    covariance = np.linalg.inv(white.T @ white) * misfit[best] / len(error)
    solution = np.linalg.lstsq(white, np.linalg.solve(factor, phase), rcond=None)[0]
    return float(solution[1]), float(np.sqrt(covariance[1, 1]))


SETTLE_S = 2.0
"""From a stand to a steady walk [s]."""
_FALL_S = 0.5  # before a fall is recognised, it is no gait any more
_NULL_DRAWS = 100
_NULL_QUANTILE = 0.95


@dataclass(frozen=True, kw_only=True)
class GaitReport(Result):
    """A gait, as means over robots with 90 % intervals of those means.

    Intervals come from the spread between robots (each with its own servos, friction and payload)
    by Student's t, and hold for this one policy: another training may walk otherwise. With one
    robot there are none but that of the frequency, which is then its own.
    """

    robots: int
    """Robots that walked long enough."""
    left_out: int
    """Robots that fell before."""
    frequency_hz: Interval
    """Of the actions; see `frequency`."""
    rhythmic: float
    """Share of robots whose actions a sine explains better than noise (5 % of noise would pass)."""
    action_r2: Interval
    """R² of the best common sine of the actions, mean over joints."""
    joint_r2: Interval
    """R² of the best common sine of the true joint angles, mean over joints."""
    null_r2: float
    """95 % quantile of `action_r2` in noise like the actions."""
    action_r2_by_joint: tuple[Interval, ...]
    joint_r2_by_joint: tuple[Interval, ...]
    phase: tuple[Interval, ...]
    """Of the four feet, from their contacts; see `phases`."""
    duty: tuple[Interval, ...]
    """Share of time that each foot stands."""
    diagonal: Interval
    """See `diagonal_coordination`."""
    jitter_rad: Interval
    """Of actions; see `jitter` [rad per step²]."""
    fast_share: Interval
    """Of actions; see `fast_share`."""
    half_range_rad: tuple[Interval, ...]
    """Of actions, by joint; see `amplitude` [rad]."""
    deviation_rad: tuple[Interval, ...]
    joint_half_range_rad: tuple[Interval, ...]
    """Of true joint angles."""
    joint_deviation_rad: tuple[Interval, ...]


def steady(rollout: Rollout) -> dict[int, slice]:
    """Steps of each robot that belong to a gait: from `SETTLE_S` to the end or before a fall.

    Robots that fell too soon are left out.
    """
    step_s = rollout.step_s
    start, shortest = round(SETTLE_S / step_s), round(SHORTEST_S / step_s)
    up = rollout.alive.sum(axis=0)
    ends = np.where(rollout.alive[-1], up, up - round(_FALL_S / step_s))
    return {int(i): slice(start, ends[i]) for i in np.flatnonzero(ends - start >= shortest)}


def describe(rollout: Rollout, rng: np.random.Generator) -> GaitReport:
    """Describe the gait in a rollout, from two seconds after its start.

    A robot that fell counts up to half a second before its fall, if enough is left; it is an error
    if no robot walked for long enough.
    """
    step_s = rollout.step_s
    walked = steady(rollout)
    if not walked:
        raise InputError(
            f"No robot walked for {SETTLE_S + SHORTEST_S:g} s: the longest was up for "
            f"{rollout.alive.sum(axis=0).max() * step_s:.1f} s. Collect a longer rollout, or "
            "describe no gait here."
        )
    reports = [
        _describe_one(
            rollout.action_rad[now, i], rollout.joint_position[now, i], rollout.contact[now, i],
            step_s, rng,
        )
        for i, now in walked.items()
    ]  # fmt: skip
    by_name = {name: np.array([f[name] for f in reports]) for name in reports[0]}
    rate, null, phase = (by_name.pop(name) for name in ("frequency_hz", "null_r2", "phase"))
    action_r2, joint_r2 = (by_name[f"{x}_r2_by_joint"].mean(axis=1) for x in ("action", "joint"))
    means: dict[str, Any] = {
        name: mean_of(v) if v.ndim == 1 else tuple(map(mean_of, v.T)) for name, v in by_name.items()
    }
    return GaitReport(
        robots=len(walked),
        left_out=rollout.alive.shape[1] - len(walked),
        frequency_hz=mean_of(rate[:, 0]) if len(walked) > 1 else Interval(*rate[0].tolist()),
        rhythmic=float((action_r2 > null).mean()),
        action_r2=mean_of(action_r2),
        joint_r2=mean_of(joint_r2),
        null_r2=float(null.mean()),
        phase=tuple(_mean_phase(p) for p in phase.T),
        **means,
    )


# --------------------------------------------------------------------------------- feet


def phases(signal: Signal, step_s: float, frequency_hz: float) -> Array:
    """Phase of each channel behind the first, in cycles.

    From the analytic signal in a band about the gait frequency (each channel times exp(-2πj f t),
    averaged over two strides under a Hann window): the angle of its mean product with the first
    channel's. A wandering rhythm moves all channels alike and leaves these phases as they are.

    The signal (steps, channels) is of feet: contacts, or thigh angles. Phases, shape (channels,),
    are from -0.25 up to 0.75, so that neither 0 (together) nor 0.5 (in turn) is at the border; NaN
    where a channel, or the first, does not change.
    """
    y = standardised(signal)
    angle = 2 * np.pi * frequency_hz * times(len(y), step_s)
    window = np.hanning(2 + round(2 / (frequency_hz * step_s)))
    analytic = fftconvolve(y * np.exp(-1j * angle)[:, None], window[:, None], "valid", axes=0)
    product = (analytic * analytic[:, :1].conj()).sum(axis=0)
    moves = np.any(y, axis=0)
    return np.where(moves & moves[0], _wrapped(-np.angle(product) / (2 * np.pi)), np.nan)


def diagonal_coordination(contact: NDArray[np.bool_]) -> float:
    """Coordination of diagonal feet: φ, mean over the two pairs.

    φ is Pearson's r of two booleans: 1 in a trot, 0 if independent, below 0 if they take turns
    (pace, bound). A pronk has 1, too: see `phases`.

    Contacts have the shape (steps, 4). NaN if one of the feet never changes.
    """
    down = standardised(contact)
    together = (down[:, 0] * down[:, 3]).mean(), (down[:, 1] * down[:, 2]).mean()
    return float(np.mean(together)) if np.any(down, axis=0).all() else float("nan")


def intervals(down: NDArray[np.bool_], step_s: float) -> Array:
    """Start and length of each stance of a foot [s], shape (k, 2).

    Stances cut by the ends of the recording have their recorded length. Swings are
    `intervals(~down, …)`.

    `down` is of one foot, shape (steps,).

    Examples
    --------
    >>> intervals(np.array([True, False, False, True, True]), 1.0).tolist()
    [[0.0, 1.0], [3.0, 2.0]]
    """
    edges = np.diff(np.concatenate([[0], np.asarray(down, int), [0]]))
    starts, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    return step_s * np.stack([starts, ends - starts], axis=1).astype(float)


# --------------------------------------------------------------------------------- actions


def jitter(signal: Signal) -> float:
    """Root mean square second difference of a signal (steps, …) [its unit per step²].

    A sine of amplitude A and frequency f has 2√2 A sin²(πf · step): compare gaits of like
    frequency and amplitude only, or look at `fast_share`.
    """
    return rms(np.diff(np.asarray(signal, float), 2, axis=0))


def fast_share(signal: Signal, step_s: float, frequency_hz: float) -> float:
    """Share of the power above the gait's second harmonic.

    The border is at 2.5 times the gait frequency, midway between harmonics.

    The signal has the shape (steps, channels). It is that of the power of all channels; NaN if
    nothing moves.
    """
    y = np.asarray(signal, float)
    away = (y - y.mean(axis=0)) * np.hanning(len(y))[:, None]
    power = (np.abs(np.fft.rfft(away, axis=0)) ** 2).sum(axis=1)
    fast = np.fft.rfftfreq(len(y), step_s) > 2.5 * frequency_hz
    return float(power[fast].sum() / power.sum()) if y.std(axis=0).max() > STILL else float("nan")


def amplitude(signal: Signal) -> tuple[Array, Array]:
    """Half of the range between the 5 % and 95 % quantiles, and standard deviation.

    Of a sine of amplitude A they are 0.988 A and 0.707 A. The signal has the shape (steps, …), both
    results have the shape (…).
    """
    y = np.asarray(signal, float)
    low, high = np.quantile(y, [0.05, 0.95], axis=0)
    return (high - low) / 2, y.std(axis=0)


def correlation(actions_a: Signal, actions_b: Signal) -> float:
    """Similarity of two recordings of a gait: mean over joints (and robots) of Pearson's r.

    A joint that stands still in the second only counts as r = 0; one that stands still in the first
    is left out.

    Both have the shape (steps, 12) or (steps, n, 12).
    """
    a, b = (np.asarray(x, float).reshape(len(x), -1) for x in (actions_a, actions_b))
    if a.shape != b.shape:
        raise InputError(
            f"Actions of shapes {np.shape(actions_a)} and {np.shape(actions_b)} cannot be compared."
        )
    moves = a.std(axis=0) > STILL
    if not moves.any():
        raise InputError("Nothing moves in the actions to compare with: there is no gait in them.")
    return float((standardised(a) * standardised(b)).mean(axis=0)[moves].mean())


# --------------------------------------------------------------------------------- parts


def _describe_one(
    action: Array, joints: Array, contact: NDArray[np.bool_], step_s: float,
    rng: np.random.Generator,
) -> dict[str, Any]:  # fmt: skip
    """All measures of one robot, by name."""
    moves = bool((action.std(axis=0) > STILL).any())
    rate = frequency(action, step_s) if moves else UNKNOWN
    measures: dict[str, Any] = {
        "frequency_hz": astuple(rate),
        "null_r2": float("nan"),
        "duty": contact.mean(axis=0),
        "diagonal": diagonal_coordination(contact),
        "jitter_rad": jitter(action),
        "fast_share": fast_share(action, step_s, rate.value),
        "phase": phases(contact, step_s, rate.value) if moves else np.full(4, np.nan),
    }
    if moves:
        null = null_r2(action, step_s, rng, _NULL_DRAWS).mean(axis=1)
        measures["null_r2"] = float(np.quantile(null, _NULL_QUANTILE))
    for name, prefix, signal in (("action", "", action), ("joint", "joint_", joints)):
        measures[f"{prefix}half_range_rad"], measures[f"{prefix}deviation_rad"] = amplitude(signal)
        best = sine_frequency(signal, step_s) if signal.std(axis=0).max() > STILL else 1.0
        measures[f"{name}_r2_by_joint"] = sine_fit_r2(signal, step_s, best)
    return measures


def _wrapped(cycles: NDArray[np.floating]) -> Array:
    """Shares of a cycle, from -0.25 up to 0.75."""
    return np.asarray((cycles + 0.25) % 1.0 - 0.25, float)


def _mean_phase(cycles: Array) -> Interval:
    """Circular mean over robots of shares of a cycle."""
    known = cycles[np.isfinite(cycles)]
    if not len(known):
        return UNKNOWN
    centre = float(np.angle(np.exp(2j * np.pi * known).mean()) / (2 * np.pi))
    away = mean_of((known - centre + 0.5) % 1.0 - 0.5)
    start = float(_wrapped(np.array(centre)))
    return Interval(*(start + x for x in astuple(away)))
