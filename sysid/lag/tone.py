"""Response of a servo to one tone: phasors of command and position, with their uncertainty.

A tone `offset + Re(P exp(2πj f t))`, with a third harmonic for the flat tops that friction makes,
is fitted by least squares to readings at irregular times; a bootstrap over its periods gives the
uncertainty (`common.tones`).

`ripple_draws` is the staircase's ripple in tones that are read at one phase of the loop. Between
two commands a servo moves in ripples of the loop's rate. Readings at one phase of the loop see the
ripple as part of the tone: the staircase's images at multiples of the loop rate f_s, plus and minus
the tone f, are sampled down onto it, the strongest with an amplitude of f / (f_s - f) of the
tone's, damped by the servo. At 30 Hz that is up to some milliseconds of lag.

The ripple is computed from the recording's own staircase and read times for every servo of a grid
of dead times, natural frequencies and damping ratios, finer where servos are likely, each weighted
by how well it predicts the tones as they were read, ripple included. What the tones leave open
becomes the draws' spread.

Lags follow from phases (`slope`): whole periods settled, tones weighted, one lag for a joint.

`line_responses` fits the tones that a log names or that are found in its command, one after the
other, and else the lines of a multisine. Those lines are
found in the command: the strongest is fitted and subtracted until next to nothing is left. A chirp,
steps or a walk leave too much and are no multisine. Enough lines fit any motion within its own
time, so those of a multisine must also predict each half of the command from the other half, and
the motion of the joint must be at these frequencies. All lines are then fitted to the fresh
readings together, because sines at irregular times are not orthogonal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.signals import rms
from pupper_sysid.common.tones import block_bootstrap, least_squares, phasors, sine_design
from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.lag.step_response import LONGEST_S, HeldCommand, past_bins, past_tones
from pupper_sysid.sysid.recordings.excitation import split_tones
from pupper_sysid.sysid.recordings.recording import Trial

_TONE_DRAWS = 1000  # of sweeps and of multisines alike: they stand in one array
_ALIASED = 30.0  # condition number beyond which a harmonic looks like the tone or the offset
_GRID_S = 5e-4
_SETTLE_S = 0.2  # after the tone is at full amplitude: several times the servo's slowest pole


@dataclass(frozen=True)
class ToneResponse:
    """Phasors of one trial's tone, of `Re(P exp(2πj f t))`."""

    trial: int
    frequency_hz: float
    """Of the command as it was sent, fitted."""
    command_rows: complex
    command_held: complex
    """`command_rows` and `command_held`: command at the rows' send times, and as the bus holds it
    between them."""
    raw: complex
    """Position of all rows, each at its row's send time."""
    fresh: complex
    """Position of fresh rows at the times they were measured."""
    raw_draws: NDArray[np.complex128]
    fresh_draws: NDArray[np.complex128]
    """`raw_draws` and `fresh_draws`: the same under random weights of the periods, shape
    (draws,)."""
    fresh_count: int
    """Fresh rows in the window."""
    residual_rad: float
    """RMS of the fresh rows about the fitted tone."""
    time_sd_s: float
    """Standard error of a shift common to all times of measurement."""
    start_s: float
    stop_s: float
    steady_s: float
    """`start_s`, `stop_s` and `steady_s`: window of the fit, and since when the command is this
    tone."""
    ripple: complex = 0j
    """Part of `fresh` that is ripple of the staircase (`sysid.lag.tone`); 0 if it was not
    computed."""
    ripple_draws: NDArray[np.complex128] | complex = 0j
    """Shape (draws,)."""

    @property
    def response(self) -> complex:
        """Frequency response from the held command to the measured motion."""
        return (self.fresh - self.ripple) / self.command_held

    @property
    def response_draws(self) -> NDArray[np.complex128]:
        """Bootstrap draws of `response`."""
        return (self.fresh_draws - self.ripple_draws) / self.command_held

    @property
    def lag_variance_s2(self) -> float:
        """Cramér-Rao bound of one tone's time shift, 2 s² / (N A² ω²), plus the common shift [s²].

        A and ω are the tone's; its N fresh rows scatter by s.
        """
        speed = abs(self.command_held) * 2 * np.pi * self.frequency_hz
        return 2 * (self.residual_rad / speed) ** 2 / self.fresh_count + self.time_sd_s**2


def tone_response(
    trial: Trial, reading: Readings, rng: np.random.Generator, draws: int = _TONE_DRAWS
) -> ToneResponse | None:
    """Fit the tone of `trial`; None if it is no tone or has fewer than two steady periods.

    `reading` says when its fresh rows were measured; `rng` weights the periods.
    """
    if not trial.frequency_hz > 0 or len(reading.rows) < 8:
        return None
    send = trial.send_time_s
    frequency = _command_frequency(trial)
    start = _steady_from(trial, frequency) + _SETTLE_S
    stop = send[-1]
    if (stop - start) * frequency < 1.5:
        return None
    window = (send >= start) & (send <= stop)
    rows = window & np.isfinite(trial.position_rad)
    fresh = (reading.time_s >= start) & (reading.time_s <= stop)
    if rows.sum() < 8 or fresh.sum() < 8:
        return None
    if np.linalg.cond(tone_design(send[rows], frequency)) > _ALIASED:  # two rows per period
        return None

    def fitted(time: NDArray, value: NDArray) -> tuple[complex, NDArray, float]:
        """Phasor, its draws, and the RMS about the fit; blocks are periods."""
        design = tone_design(time, frequency)
        period = np.floor((time - start) * frequency).astype(int)
        # rows that stand alone in a period carry no spread of their own: never fewer than 8 blocks
        fit = block_bootstrap(design, value, period, rng, draws, fewest=8)
        residual = rms(design @ fit.solution - value)
        # the spread of few blocks around their own fit lacks their lost degrees of freedom
        drawn = fit.inflated(np.sqrt(fit.blocks / max(fit.blocks - design.shape[1] / 2, 1.0)))
        return complex(phasors(fit.solution)[0]), phasors(drawn)[:, 0], residual

    raw, raw_draws, _ = fitted(trial.read_time_s[rows], trial.position_rad[rows])
    result, fresh_draws, residual = fitted(reading.time_s[fresh], reading.position_rad[fresh])
    held = _phasor(*HeldCommand.of(trial).levels(start, stop, _GRID_S), frequency)
    sent = _phasor(send[window], trial.command_rad[window], frequency)
    # an error of the poll's phase shifts all times of the trial together
    shift = rng.normal(0.0, reading.time_sd_s, draws)
    fresh_draws = fresh_draws * np.exp(2j * np.pi * frequency * shift)
    return ToneResponse(
        trial.number, frequency, sent, held, raw, result, raw_draws, fresh_draws,
        int(fresh.sum()), residual, reading.time_sd_s, start, stop, start - _SETTLE_S,
    )  # fmt: skip


def tone_design(time_s: NDArray, frequency_hz: float) -> NDArray[np.float64]:
    """Columns for offset, tone and, where the sampling tells it apart, its third harmonic."""
    angle = 2 * np.pi * frequency_hz * time_s
    design = sine_design(angle, 3 * angle)
    return design if np.linalg.cond(design) < _ALIASED else design[:, :3]


def _phasor(time_s: NDArray, value: NDArray, frequency_hz: float) -> complex:
    return complex(phasors(least_squares(tone_design(time_s, frequency_hz), value))[0])


def _command_frequency(trial: Trial) -> float:
    """Frequency of the command as sent, by Gauss-Newton from the nominal one [Hz]."""
    time, value, frequency = trial.send_time_s, trial.command_rad, trial.frequency_hz
    half = len(time) // 4  # beyond any soft start
    time, value = time[half:], value[half:]
    middle = time.mean()
    for _ in range(4):
        tone = sine_design(2 * np.pi * frequency * (time - middle))
        _, cosine, sine = least_squares(tone, value)
        slope = 2 * np.pi * (time - middle) * (-cosine * tone[:, 2] + sine * tone[:, 1])
        step = least_squares(np.column_stack([tone, slope]), value)[3]
        frequency += float(np.clip(step, -0.02 * frequency, 0.02 * frequency))
    # a command that is no tone at all must not run away
    return frequency if abs(frequency / trial.frequency_hz - 1) < 0.05 else trial.frequency_hz


def _steady_from(trial: Trial, frequency: float) -> float:
    """Time from which the command is the tone at full amplitude [s]."""
    time, value = trial.send_time_s, trial.command_rad
    half = len(time) // 2
    design = tone_design(time, frequency)[:, :3]
    solution = least_squares(design[half:], value[half:])
    wrong = np.abs(design @ solution - value) > 0.05 * np.hypot(solution[1], solution[2])
    last = np.flatnonzero(wrong[:half])
    return float(time[min(last[-1] + 1, len(time) - 1)]) if len(last) else float(time[0])


_PER_LOOP = 10  # bins in a loop period
_FINEST_S = 0.001
_GROWTH = 1.1
_BEYOND_S = 0.1
_TIME_CONSTANTS_S = np.geomspace(0.001, 0.3, 16)
_DAMPING = np.geomspace(0.3, 2.5, 6)
_DEAD_STEP_S, _DEAD_REACH_S = 0.002, 0.04
_SPLIT, _SPLITS = 128, 5  # cells divided at once, and how often
_NOT_LINEAR = 0.01  # of a tone's response: no servo is nearer to a linear one
_DRAWS = 400


def without_ripple(
    trials: Sequence[Trial],
    read: Sequence[Readings],
    tones: Sequence[ToneResponse],
    rng: np.random.Generator,
    near_s: float | None = None,
) -> list[ToneResponse]:
    """The tones with the ripple that `response` leaves out; `near_s` as in `tone_lags`."""
    loop = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in trials])))
    frequency = np.array([t.frequency_hz for t in tones])
    lags = tone_lags(np.array([t.response for t in tones]), frequency, near_s)
    latest = max(float(lags.max()), 0.0) + _BEYOND_S
    edges = past_bins(max(loop / _PER_LOOP, _FINEST_S), latest, _GROWTH)
    servos = _servos(frequency, lags)
    if not len(servos):
        return list(tones)  # a position that precedes its command: the lags as they are
    by_number = {t.number: (t, r) for t, r in zip(trials, read, strict=True)}
    turn = -2j * np.pi * np.outer(frequency, edges)
    step_means = np.diff(np.exp(turn)) / np.diff(turn)
    held_means: dict[tuple[float, ...], NDArray[np.float64]] = {}  # of the tones of one trial

    def row(tone: ToneResponse) -> NDArray[np.complex128]:
        """Phasor that the tone's fit finds in the images, per unit of mass in each bin."""
        trial, reading = by_number[tone.trial]
        window = tone.trial, tone.start_s, tone.stop_s
        time = reading.time_s[(reading.time_s >= tone.start_s) & (reading.time_s <= tone.stop_s)]
        if window not in held_means:
            held_means.clear()
            held_means[window] = HeldCommand.of(trial).means(time, edges)
        one = np.array([tone.frequency_hz]), np.array([tone.command_held])
        images = held_means[window] - past_tones(time, edges, *one)
        # before the tone was steady the command was no tone
        images = np.where(time[:, None] - edges[1:] >= tone.steady_s, images, 0.0)
        return phasors(least_squares(tone_design(time, tone.frequency_hz), images).T)[:, 0]

    ripple = np.stack([row(t) for t in tones])
    held = np.array([t.command_held for t in tones])
    chance, seen = _likely_ripple(servos, edges, ripple, held[:, None] * step_means, tones)
    drawn = seen[rng.choice(len(chance), _DRAWS, p=chance)]
    # of two kinds of servo the likelier one, not what lies between them
    middle = np.median(np.stack([drawn.real, drawn.imag], axis=-1), axis=0)
    picked = [rng.integers(_DRAWS, size=len(t.fresh_draws)) for t in tones]
    return [
        replace(t, ripple=complex(*middle[k]), ripple_draws=drawn[picked[0], k])
        for k, t in enumerate(tones)
    ]


def _servos(frequency: NDArray, lags: NDArray) -> NDArray[np.float64]:
    """Second-order servos whose lags may be the ones seen.

    Returns shape (servos, 3): logarithms of time constant [s] and damping ratio, dead time [s].
    """
    constant, damping = (x.ravel() for x in np.meshgrid(_TIME_CONSTANTS_S, _DAMPING))
    s = 2j * np.pi * constant[:, None] * frequency
    dynamics = -np.angle(1 / (s * s + 2 * damping[:, None] * s + 1)) / (2 * np.pi * frequency)
    reach = np.arange(-_DEAD_REACH_S, _DEAD_REACH_S, _DEAD_STEP_S)
    dead_time = np.mean(lags - dynamics, axis=1)[:, None] + reach
    grid = np.broadcast_arrays(np.log(constant)[:, None], np.log(damping)[:, None], dead_time)
    servos = np.stack(grid, axis=-1).reshape(-1, 3)
    return servos[servos[:, 2] >= 0]


def _likely_ripple(
    servos: NDArray, edges: NDArray, ripple: NDArray, tone: NDArray, tones: Sequence[ToneResponse]
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Probabilities of servos and the ripple that each makes in the tones, shape (servos, tones).

    The servos of the grid are the middles of cells. The likeliest cells are divided again and
    again, because the tones say more about a servo than the grid resolves: of its servos alone, a
    resonance at the ripple's rate may fit best, where a servo between two of them fits better.
    `ripple` and `tone` of shape (tones, bins): phasors per unit of mass in each bin.
    """
    half = 0.5 * np.array(
        [*(np.log(x[1] / x[0]) for x in (_TIME_CONSTANTS_S, _DAMPING)), _DEAD_STEP_S]
    )
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)

    def evaluated(cells: NDArray) -> tuple[NDArray, NDArray]:
        masses = _masses(cells, edges)
        misfit, gain = _misfits(masses @ (ripple + tone).T, tones)
        return misfit, gain[:, None] * (masses @ ripple.T)

    def chances(misfit: NDArray, halved: NDArray) -> NDArray[np.float64]:
        scale = max(1.0, float(misfit.min()) / max(2 * len(tones) - 4, 1))
        return 8.0**-halved * np.exp(-0.5 * (misfit - misfit.min()) / scale)

    cells, halved = servos, np.zeros(len(servos))  # how often each was halved
    misfit, seen = evaluated(cells)
    for _ in range(_SPLITS):
        likely = np.argsort(-chances(misfit, halved))[:_SPLIT]
        often = np.repeat(halved[likely] + 1, len(corners))
        apart = corners * half * 2.0 ** -halved[likely, None, None]
        parts = (cells[likely, None] + apart).reshape(-1, 3)
        inside = parts[:, 2] >= 0
        parts, often = parts[inside], often[inside]
        misfit_of_parts, seen_of_parts = evaluated(parts)
        cells = np.concatenate([np.delete(cells, likely, axis=0), parts])
        halved = np.concatenate([np.delete(halved, likely), often])
        misfit = np.concatenate([np.delete(misfit, likely), misfit_of_parts])
        seen = np.concatenate([np.delete(seen, likely, axis=0), seen_of_parts])
    chance = chances(misfit, halved)
    return chance / chance.sum(), seen


def _masses(servos: NDArray, edges: NDArray) -> NDArray[np.float64]:
    """Masses per bin of second-order servos as in `_servos`, shape (servos, bins)."""
    constant, damping = np.exp(servos[:, :1]), np.exp(servos[:, 1:2])
    past = np.maximum(edges - servos[:, 2:], 0.0) / constant
    return np.diff(_second_order(past, damping), axis=1)


def _second_order(past: NDArray, damping: NDArray) -> NDArray[np.float64]:
    """Step response at times in units of 1 / (natural frequency)."""
    damping = np.where(np.abs(damping - 1) < 1e-4, 1.0001, damping)  # two roots, nearly one
    root = np.emath.sqrt(damping**2 - 1)
    slow, fast = -damping + root, -damping - root
    step = 1 + (fast * np.exp(slow * past) - slow * np.exp(fast * past)) / (slow - fast)
    return np.real(step)


def _misfits(
    predicted: NDArray, tones: Sequence[ToneResponse]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Misfit of each servo to the tones as they were read, and the static gain it has with it."""
    seen = np.array([t.fresh for t in tones])
    spread = np.array([np.std(t.fresh_draws) for t in tones])
    weight = 1.0 / (spread**2 + (_NOT_LINEAR * np.abs(seen)) ** 2)
    cross = np.sum(weight * np.real(np.conj(predicted) * seen), axis=1)
    square = np.sum(weight * np.abs(predicted) ** 2, axis=1)
    gain = np.maximum(cross / np.maximum(square, 1e-300), 0.0)
    return np.sum(weight * np.abs(seen - gain[:, None] * predicted) ** 2, axis=1), gain


_ONE_TONE_HZ = 0.05  # closer than that is one tone, twice
FOLLOWS = 0.5  # of the largest gain: below, a tone says nothing about the delay


def slope(tones: Sequence[ToneResponse], pair: str, near_s: float | None = None) -> Interval:
    """Lag common to all tones: the slope of the phase through the origin, with its interval.

    `pair` is "raw_rows" or "fresh_rows" (all rows, or fresh readings, against the rows' commands)
    or "fresh_held" (fresh readings without the staircase's ripple against the held command).
    """
    frequency = np.array([t.frequency_hz for t in tones])
    response, draws = responses(tones, pair)
    weight = tone_weights(tones)
    lags = tone_lags(response, frequency, near_s)
    drawn = lag_near(draws, frequency[:, None], lags[:, None])
    return Interval.of_draws(float(weight @ lags), weight @ drawn)


def responses(
    tones: Sequence[ToneResponse], pair: str
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Responses of all tones and their draws, shapes (tones,) and (tones, draws)."""
    if pair == "fresh_held":
        value, drawn = [t.response for t in tones], [t.response_draws for t in tones]
    elif pair == "fresh_rows":
        value = [t.fresh / t.command_rows for t in tones]
        drawn = [t.fresh_draws / t.command_rows for t in tones]
    else:
        value = [t.raw / t.command_rows for t in tones]
        drawn = [t.raw_draws / t.command_rows for t in tones]
    return np.array(value), np.array(drawn)


def tone_weights(tones: Sequence[ToneResponse]) -> NDArray[np.float64]:
    """Weight of each tone in the joint's lag: inverse variance, 0 where the servo cannot follow.

    Below half of the largest gain the torque or speed limit clips the motion, and its phase is no
    delay.
    """
    gain = np.array([abs(t.response) for t in tones])
    weight = 1.0 / np.array([t.lag_variance_s2 for t in tones])
    weight = np.where(gain >= FOLLOWS * gain.max(), weight, 0.0)
    return weight / weight.sum()


def tone_lags(
    response: NDArray, frequency_hz: NDArray, near_s: float | None = None
) -> NDArray[np.float64]:
    """Lag of every tone [s], the right whole period of each included.

    A phase leaves the lag open to whole periods. The lowest tone has the longest period and settles
    itself below 2 Hz; above, the lag on which all tones agree best settles it. From there each tone
    takes the period nearest to the lag of the tone below it, for a servo's lag changes by far less
    than half a period from one tone to the next.

    `near_s` is the lag as other than phases show it, the start of the motion for one: it settles
    the period of a lowest tone above 2 Hz, and of a lag that is longer than the lowest tone allows.
    """
    order = np.argsort(frequency_hz, kind="stable")
    lowest = frequency_hz[order[0]]
    if lowest > 2.0:
        near = _common_lag(response, frequency_hz, near_s)
    elif near_s is not None and near_s > 0.8 / lowest:
        near = near_s
    else:
        near = 0.4 / lowest  # from a tenth of a period early to nine tenths late
    lags = np.empty(len(order))
    for i in order:
        near = lags[i] = lag_near(response[i], frequency_hz[i], near)
    return lags


def _common_lag(response: NDArray, frequency: NDArray, near_s: float | None) -> float:
    """The lag on which all phases agree best."""
    spacing = np.diff(np.unique(frequency))
    # two trials of one tone differ by the error of their fits only
    spacing = spacing[spacing > _ONE_TONE_HZ]
    # tones repeat their common phase pattern after 1 / (smallest spacing); one tone, after 1 / f
    repeat = 0.95 / (spacing.min() if len(spacing) else frequency[0])
    first, last = 0.0, min(LONGEST_S, repeat)
    if near_s is not None and near_s > 0.8 * repeat:
        first, last = near_s - repeat / 2, near_s + repeat / 2
    lags = np.arange(first, last, 2e-4)
    turned = np.angle(response)[:, None] + 2 * np.pi * frequency[:, None] * lags
    return float(lags[int(np.argmax(np.cos(turned).sum(axis=0)))])


def lag_near(response, frequency, centre):
    """Lag of a phase, in the period around `centre` [s]; arrays broadcast."""
    turned = np.angle(response * np.exp(2j * np.pi * frequency * centre))
    return centre - turned / (2 * np.pi * frequency)


_MOST_LINES = 24
_LEFT_OVER = 0.005  # of the command's variance: quantisation, no signal
_APART = 1.5  # periods over the trial: closer lines are what a random motion looks like
_LEAST_PERIODS = 1.9  # of a line, over the trial
_UNPREDICTED = 0.05  # of the command's variance, in one half from the other
_INCOHERENT = 0.3  # of the readings' variance: motion at other frequencies
_LINES_SETTLE_S = 0.5  # past the soft start: several times the servo's slowest pole
_ROWS_PER_UNKNOWN = 3
_BLOCK_S = 0.5
_LINES_GRID_S = 1e-3


def line_responses(trial: Trial, reading: Readings, rng: np.random.Generator) -> list[ToneResponse]:
    """Response at every frequency that the command of `trial` is made of; may be empty."""
    parts = split_tones(trial)
    if parts[0].frequency_hz > 0:
        tones = [tone_response(part, reading, rng) for part in parts]
        return [tone for tone in tones if tone is not None]
    send = trial.send_time_s  # else the lines of a multisine
    if len(send) < 100 or np.ptp(trial.command_rad) < 1e-3:
        return []
    first = send[0] + 0.15 * (send[-1] - send[0])
    lines = _lines(send[send >= first], trial.command_rad[send >= first])
    if not len(lines):
        return []
    start = first + _LINES_SETTLE_S
    rows = (send >= start) & np.isfinite(trial.position_rad)
    fresh = (reading.time_s >= start) & (reading.time_s <= send[-1])
    unknown = 1 + 2 * len(lines)
    if min(fresh.sum(), rows.sum()) < _ROWS_PER_UNKNOWN * unknown:
        return []
    command_held = _phasors(*HeldCommand.of(trial).levels(start, send[-1], _LINES_GRID_S), lines)
    command_rows = _phasors(send[rows], trial.command_rad[rows], lines)

    def drawn(time: NDArray, value: NDArray) -> tuple[NDArray, NDArray, float]:
        """Phasors at all lines, draws of them, and the RMS about the fit."""
        design = _design(time, lines)
        block = np.floor((time - time[0]) / _BLOCK_S).astype(int)
        fit = block_bootstrap(design, value, block, rng, _TONE_DRAWS)
        # what was fitted away from the residuals is missing from their spread
        inflate = np.sqrt(len(value) / (len(value) - design.shape[1]))
        residual = float(inflate * rms(design @ fit.solution - value))
        return phasors(fit.solution), phasors(fit.inflated(inflate)), residual

    raw = drawn(trial.read_time_s[rows], trial.position_rad[rows])
    measured = drawn(reading.time_s[fresh], reading.position_rad[fresh])
    if measured[2] ** 2 > _INCOHERENT * float(np.var(reading.position_rad[fresh])):
        return []
    shift = rng.normal(0.0, reading.time_sd_s, _TONE_DRAWS)
    return [
        ToneResponse(
            trial.number, float(f), complex(command_rows[k]), complex(command_held[k]),
            complex(raw[0][k]), complex(measured[0][k]), raw[1][:, k],
            measured[1][:, k] * np.exp(2j * np.pi * f * shift),
            int(fresh.sum()), measured[2], reading.time_sd_s, start, send[-1], first,
        )
        for k, f in enumerate(lines)
    ]  # fmt: skip


def _lines(time: NDArray[np.float64], command: NDArray[np.float64]) -> NDArray[np.float64]:
    """Frequencies of the command's lines [Hz], rising; empty if lines do not explain it."""
    loop, span = float(np.median(np.diff(time))), float(time[-1] - time[0])
    even = np.arange(time[0], time[-1], loop)
    spectrum_hz = np.fft.rfftfreq(8 * len(even), loop)
    usable = spectrum_hz > 1.0 / span
    variance = float(np.var(command))
    lines, residuals = np.zeros(0), command - command.mean()
    while np.var(residuals) > _LEFT_OVER * variance:
        if len(lines) == _MOST_LINES:
            return np.zeros(0)
        strength = np.abs(np.fft.rfft(np.interp(even, time, residuals), 8 * len(even)))
        lines = np.append(lines, spectrum_hz[int(np.argmax(strength * usable))])
        lines, residuals = _sharpened(time, command, lines)
        if len(lines) > 1 and np.min(np.diff(np.sort(lines))) < _APART / span:
            return np.zeros(0)
    if np.min(lines, initial=np.inf) < _LEAST_PERIODS / span or not _predicts(time, command, lines):
        return np.zeros(0)
    return np.sort(lines)


def _predicts(time: NDArray, command: NDArray, lines: NDArray) -> bool:
    """Whether the lines as fitted to one half of the command go on in the other half."""
    half = time < 0.5 * (time[0] + time[-1])
    for known, other in ((half, ~half), (~half, half)):
        solution = least_squares(_design(time[known], lines), command[known])
        wrong = command[other] - _design(time[other], lines) @ solution
        if np.mean(wrong**2) > _UNPREDICTED * np.var(command):
            return False
    return True


def _sharpened(
    time: NDArray[np.float64], command: NDArray[np.float64], lines: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lines after two Gauss-Newton steps on their frequencies, and the residual."""
    clock, farthest = time - time.mean(), 0.25 / float(np.ptp(time))
    for _ in range(2):
        turning = _phasors(clock, command, lines) * np.exp(2j * np.pi * np.outer(clock, lines))
        slopes = (2j * np.pi * clock[:, None] * turning).real
        design = np.hstack([_design(clock, lines), slopes])
        step = least_squares(design, command)[1 + 2 * len(lines) :]
        lines = lines + np.clip(step, -farthest, farthest)
    design = _design(clock, lines)
    return lines, command - design @ least_squares(design, command)


def _design(time: NDArray, lines: NDArray) -> NDArray[np.float64]:
    return sine_design(*(2 * np.pi * np.outer(lines, time)))


def _phasors(time: NDArray, value: NDArray, lines: NDArray) -> NDArray[np.complex128]:
    return phasors(least_squares(_design(time, lines), value))
