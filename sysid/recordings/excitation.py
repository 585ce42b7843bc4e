"""What moves a joint: tones, a multisine, a chirp, steps or free motion, found in its command.

A log need not say that its command is a tone, nor give each tone a trial. `segments` cuts a command
where its kind changes; `split_at_rests` and `split_tones` make of one trial as many as it has
tones, each with its frequency, as if the log had named them.

A tone is grown from a seed of two periods between turning points: a sine is fitted, extended for as
long as the command keeps to it, and fitted again. A chirp keeps to no sine for long; a square wave,
a triangle or a gait keeps to none.

Single bad readings lie away from those before and after them. A failed read is logged as 0 or -π, a
bus that mixes up its answers returns another servo's position, a bit flips. Whatever its size, what
goes away and comes back within one sample is no motion: on its way there and back a joint passes
through places between. Such readings are left out of everything that is computed
(`without_bad_readings`), and `doctor` counts and names them.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, fields, replace
from functools import wraps
from hashlib import blake2b
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.signals import rms, robust_sd
from pupper_sysid.common.tones import sine_design
from pupper_sysid.sysid.recordings.recording import Trial

Found = TypeVar("Found")


def remembered(most: int) -> Callable[[Callable[..., Found]], Callable[..., Found]]:
    """Keep the last `most` results of a function of one or several trials, by their content.

    Further arguments are hashable and by position. Results are shared and must not be changed.
    """

    def decorate(compute: Callable[..., Found]) -> Callable[..., Found]:
        results: OrderedDict[Hashable, Found] = OrderedDict()

        @wraps(compute)
        def from_memory(trials: Trial | Sequence[Trial], *arguments: Hashable) -> Found:
            several = [trials] if isinstance(trials, Trial) else trials
            key = (content_of(several), arguments)
            if key not in results:
                results[key] = compute(trials, *arguments)
                if len(results) > most:
                    results.popitem(last=False)
            results.move_to_end(key)
            return results[key]

        return from_memory

    return decorate


def content_of(trials: Sequence[Trial]) -> bytes:
    """Hash of all that trials hold."""
    content = blake2b(digest_size=16)
    for value in (getattr(trial, field.name) for trial in trials for field in fields(trial)):
        array = isinstance(value, np.ndarray)
        content.update(np.ascontiguousarray(value).tobytes() if array else repr(value).encode())
        content.update(b"|")
    return content.digest()


_SEED = 4  # half periods between turning points
_LEAST_PERIODS = 1.9
_TURN = 0.02  # of the command's range; a smaller reversal is no turning point
_IMPURE = 0.006  # of a tone's variance; quantisation to six counts leaves 0.005, a triangle 0.014
_AWAY = 0.15  # of the tone's amplitude: where the command is, it has left the tone
_CLOSE = 0.03  # the same at its ends, where it must not lean on a row of what comes next
_TIMES_LEFT = 3
_CHIRP = 0.015  # of the frequency, by which the two halves of a tone may differ
_COVERED = 0.8  # share of the moving time that tones must take
_SOFT = 0.4  # of a steady tone's time: the longest soft start before it
_SAME_HZ = 0.02
_RESTS_S = 0.15  # a servo may have come to rest
_LEAST_STILL, _STILL = 4, 0.002  # readings at rest; share of the motion within which they are
_LEAD_S, _LEAD = 0.5, 0.4  # rest kept in front of a tone, at most, and as a share of the tone
_ONE_WAY = 0.8  # rank correlation of half periods with their number
_STEPPED = 0.5  # share of rows without a change of command, from which on it moves in steps
_SMALLEST_RAD = 1e-4
_MOST_TURNS = 4000
_MOST_ROWS = 400  # of one sine: more do not change whether it is one


@dataclass(frozen=True)
class Segment:
    """A stretch of a command of one kind."""

    kind: str
    """Steps include random binary ones; "free" is any other motion."""
    first: int
    stop: int
    """`first` and `stop`: its rows, the last one excluded."""
    frequency_hz: float = float("nan")
    """Of a tone; NaN otherwise."""


@remembered(512)
def segments(trial: Trial) -> list[Segment]:
    """Cut the command of `trial` into tones, rests and other motion, in time order.

    Examples
    --------
    >>> time_s = 0.01 * np.arange(900)
    >>> wave = np.where(time_s < 4, np.sin(2 * np.pi * time_s), np.sin(4 * np.pi * time_s))
    >>> wave[time_s > 7] = 0.0
    >>> trial = Trial("hip", 0, float("nan"), time_s, time_s, wave, wave, None, 0.0)
    >>> [(s.kind, round(s.frequency_hz, 3)) for s in segments(trial)][:2]
    [('tone', 1.0), ('tone', 2.0)]
    """
    time, command = trial.send_time_s, trial.command_rad
    if len(time) < 8 or np.ptp(command) < _SMALLEST_RAD:
        return [Segment("rest", 0, len(time))]
    tones = _tones(time, command)
    parts, begin = [], 0
    for tone in [*tones, Segment("", len(time), len(time))]:
        if tone.first > begin:
            parts.append(_other(trial, begin, tone.first))
        if tone.kind:
            parts.append(tone)
        begin = tone.stop
    return parts


def split_tones(trial: Trial, at_rests: bool = False) -> list[Trial]:
    """Trials of one tone each, with their frequencies; `trial` itself if its command is none.

    Rests and other motion between tones are left out, but for a rest in front of each.

    `trial`: one that a frequency is known of is left as it is. `at_rests`: cut only where the joint
    can have come to rest, which a simulation must start from; tones that follow one another
    directly stay together, without a frequency.
    """
    if trial.frequency_hz > 0:
        return [trial]
    motions = segments(trial)
    tones = [s for s in motions if s.kind == "tone"]
    moving = sum(s.stop - s.first for s in motions if s.kind != "rest")
    if not tones or sum(s.stop - s.first for s in tones) < _COVERED * moving:
        return [trial]
    if at_rests and len(tones) > 1:
        tones = _grouped(trial, motions)
        if len(tones) == 1 and not tones[0].frequency_hz > 0:
            return [trial]
    lead_s = trial.send_time_s[tones[0].first] - trial.send_time_s[0]
    if [m.kind for m in motions if m.kind != "rest" or m.first > 0] == [
        "tone"
    ] and lead_s < _LEAD_S:
        return [replace(trial, frequency_hz=tones[0].frequency_hz)]  # as if it had been named
    parts, end = [], 0
    for tone in tones:
        parts.append(_part(trial, tone, end))
        end = tone.stop
    return parts


def named_tones(trials: Sequence[Trial]) -> list[Trial]:
    """All trials, those of several tones cut at rests, each tone with its frequency."""
    return [part for trial in trials for part in split_tones(trial, at_rests=True)]


def describe(trials: Sequence[Trial]) -> dict[str, list[float]]:
    """Kinds of motion in the commands of `trials`, with the frequencies of tones [Hz]."""
    kinds: dict[str, list[float]] = {}
    for trial in trials:
        if trial.frequency_hz > 0:
            kinds.setdefault("tone", []).append(trial.frequency_hz)
            continue
        parts = split_tones(trial)
        if len(parts) > 1 or parts[0].frequency_hz > 0:
            kinds.setdefault("tone", []).extend(p.frequency_hz for p in parts)
            continue
        for segment in segments(trial):
            if segment.kind not in ("rest", "tone"):
                kinds.setdefault(segment.kind, [])
    return kinds


def _grouped(trial: Trial, parts: Sequence[Segment]) -> list[Segment]:
    """Tones, those without a rest between them as one segment of several frequencies."""
    groups: list[Segment] = []
    rested = True
    for s in parts:
        if s.kind == "tone":
            if groups and not rested:
                groups[-1] = Segment("tone", groups[-1].first, s.stop)
            else:
                groups.append(s)
            rested = False
        elif s.kind == "rest":
            stop = min(s.stop, len(trial.send_time_s) - 1)
            long = trial.send_time_s[stop] - trial.send_time_s[s.first] >= _RESTS_S
            rested = long and _at_rest_from(trial, s.first, s.stop) < s.stop
    return groups


def _at_rest_from(trial: Trial, first: int, stop: int) -> int:
    """The row from which on readings of rows `first` to `stop` - 1 stay where they end.

    `stop` where too few do so: the joint still moves.
    """
    position = trial.position_rad[first:stop]
    (seen,) = np.nonzero(np.isfinite(position))
    if len(seen) < 2 * _LEAST_STILL:
        return first  # nothing is known of it
    position, every = position[seen], trial.position_rad[np.isfinite(trial.position_rad)]
    changes = np.abs(np.diff(every))
    quantum = float(np.min(changes[changes > 0], initial=np.inf))
    last = position[-max(_LEAST_STILL, len(seen) // 4) :]
    # of second differences, which a steady motion leaves at zero; their variance is six times as
    # large
    noise = robust_sd(np.diff(last, 2)) / np.sqrt(6.0)
    span = float(np.ptp(every))
    near = max(4.0 * noise, 1.01 * quantum, _STILL * span)
    (moving,) = np.nonzero(np.abs(position - np.median(last)) > near)
    still = int(moving[-1]) + 1 if len(moving) else 0
    return first + int(seen[still]) if len(seen) - still >= _LEAST_STILL else stop


def _part(trial: Trial, tone: Segment, end: int) -> Trial:
    """The rows of one tone and of the rest in front of it."""
    time = trial.send_time_s
    duration = time[tone.stop - 1] - time[tone.first]
    lead = time[tone.first] - min(_LEAD_S, _LEAD * duration)
    first = max(end, int(np.searchsorted(time, lead)))
    still = np.flatnonzero(np.diff(trial.command_rad[first : tone.first + 1]) != 0)
    if len(still) and first + still[0] + 1 < tone.first:
        # motion between two tones is of neither: only the rest right before this one is kept
        constant = np.flatnonzero(np.diff(trial.command_rad[first : tone.first]) != 0)
        first = first + int(constant[-1]) + 1 if len(constant) else first
    at_rest = _at_rest_from(trial, first, tone.first)
    first = at_rest if at_rest < tone.first else first
    return replace(trial.rows(first, tone.stop), frequency_hz=float(tone.frequency_hz))


def _other(trial: Trial, first: int, stop: int) -> Segment:
    """A stretch that is no tone."""
    command = trial.command_rad[first:stop]
    moves = np.abs(np.diff(command))
    if np.ptp(command) < max(0.01 * np.ptp(trial.command_rad), _SMALLEST_RAD):
        return Segment("rest", first, stop)
    if np.mean(moves < 1e-9) > _STEPPED and moves.max() > 0.1 * np.ptp(command):
        return Segment("steps", first, stop)
    turns = _turning_points(command, 0.1 * float(np.ptp(command)))
    if len(turns) > 8:
        half = np.diff(trial.send_time_s[first:stop][turns])
        _, place, count = np.unique(half, return_inverse=True, return_counts=True)
        ranks = (np.cumsum(count) - (count - 1) / 2)[place]  # equal ones share their mean rank
        trend = np.corrcoef(np.arange(len(half)), ranks)[0, 1]
        ends = float(half[: len(half) // 4].mean()), float(half[-(len(half) // 4) :].mean())
        if abs(trend) > _ONE_WAY and max(ends) > 1.5 * min(ends):
            return Segment("chirp", first, stop)
    return Segment("free", first, stop)


def _turning_points(command: NDArray[np.float64], least: float) -> NDArray[np.int64]:
    """Rows of extremes after which the command goes back by `least` or more."""
    rows: list[int] = []
    low = high = 0
    way = 0
    values = command.tolist()
    for k, value in enumerate(values):
        if value > values[high]:
            high = k
        if value < values[low]:
            low = k
        if way >= 0 and value < values[high] - least:
            rows.append(high)
            way, low = -1, k
            high = k
        elif way <= 0 and value > values[low] + least:
            rows.append(low)
            way, high = 1, k
            low = k
    return np.array(rows, np.int64)


def _tones(time: NDArray[np.float64], command: NDArray[np.float64]) -> list[Segment]:
    """Tones of a command, in time order and apart."""
    turns = _turning_points(command, _TURN * float(np.ptp(command)))
    if not _SEED < len(turns) + 1 <= _MOST_TURNS:
        return []
    tones: list[Segment] = []
    k, end = 0, 0
    while k + _SEED < len(turns):
        first, last = int(turns[k]), int(turns[k + _SEED])
        half = np.diff(time[turns[k : k + _SEED + 1]])
        loop = float(np.median(np.diff(time[first : last + 1])))
        even = np.ptp(half) < 0.25 * half.mean() + 2.1 * loop
        tone = _grown(time, command, first, last, end) if even and last - first >= 8 else None
        if tone is None:
            k += 1
            continue
        tones.append(tone)
        end = tone.stop
        k = int(np.searchsorted(turns, tone.stop - 1))
    tones = _joined(tones, time, command)
    return [] if _is_chirp(tones, time) else tones


@dataclass(frozen=True)
class _Sine:
    """The sine that some rows of a command are."""

    clock: NDArray
    command: NDArray
    frequency: float
    solution: NDArray
    amplitude: float

    @classmethod
    def of(
        cls, clock: NDArray, command: NDArray, first: int, stop: int, frequency: float
    ) -> _Sine | None:
        """The sine of about this frequency; None if the rows are none."""
        every = max(1, (stop - first) // _MOST_ROWS)
        t, value = clock[first:stop:every], command[first:stop:every]
        if len(t) < 6:
            return None
        frequency, solution, unexplained = _sine_fit(t, value, frequency)
        amplitude = float(np.hypot(solution[1], solution[2]))
        if not amplitude > _SMALLEST_RAD or unexplained > _IMPURE * amplitude**2 / 2:
            return None
        return cls(clock, command, frequency, solution, amplitude)

    def residual(self, first: int, stop: int) -> NDArray[np.float64]:
        """Command minus sine."""
        phase = 2 * np.pi * self.frequency * self.clock[first:stop]
        return self.command[first:stop] - sine_design(phase) @ self.solution

    def away(self, first: int, stop: int) -> NDArray[np.int64]:
        """Rows at which the command is away from the sine."""
        apart = np.abs(self.residual(first, stop)) > _AWAY * self.amplitude
        return first + np.flatnonzero(apart)


def _grown(time: NDArray, command: NDArray, first: int, last: int, end: int) -> Segment | None:
    """The tone that the rows from `first` to `last` are part of; None if they are of none."""
    clock = time - time[first]
    fit = _Sine.of(clock, command, first, last + 1, _SEED / 2 / float(clock[last]))
    if fit is None:
        return None
    # how often the command left the sine: a frequency that is not exact yet, or its end
    departures = 0
    while departures < _TIMES_LEFT:
        # as far as one doubles the stretch: there the frequency's error shows as a phase
        reach = min(last + max(last - first, 8), len(time) - 1)
        wrong = fit.away(last + 1, reach + 1)
        later = int(wrong[0]) if len(wrong) else reach + 1
        if later == last + 1:
            break
        longer = _Sine.of(clock, command, first, later, fit.frequency)
        if longer is None:
            break
        departures += later <= reach
        last, fit = later - 1, longer
    while first > end:
        reach = max(end, first - max(last - first, 8))
        wrong = fit.away(reach, first)
        earlier = int(wrong[-1]) + 1 if len(wrong) else reach
        if earlier == first:
            break
        first = earlier
    # the first rows of what follows may be close to the sine by chance
    rest = np.abs(fit.residual(first, last + 1))
    close = rest <= max(_CLOSE * fit.amplitude, 4 * rms(rest))
    first, last = first + int(np.argmax(close)), last - int(np.argmax(close[::-1]))
    fit = _Sine.of(clock, command, first, last + 1, fit.frequency)
    if fit is None or clock[last] - clock[first] < _LEAST_PERIODS / fit.frequency:
        return None
    frequency = fit.frequency
    middle = (first + last) // 2
    halves = [
        part.frequency
        for a, b in ((first, middle), (middle, last))
        if (part := _Sine.of(clock, command, a, b, frequency)) is not None
    ]
    coarse = float(np.median(np.diff(clock)) * frequency) ** 2  # a row's share of a period, squared
    if np.ptp(halves or [0.0]) > (_CHIRP + 0.1 * coarse) * frequency:
        return None
    # the motion before a steady tone, after a rest or another tone, is its soft start
    still = np.flatnonzero(np.diff(command[end : first + 1]) == 0)
    begin = end + int(still[-1]) + 1 if len(still) else first
    longest = max(_SOFT * float(clock[last] - clock[first]), 1.0 / frequency)
    begin = begin if clock[first] - clock[begin] <= longest else first
    return Segment("tone", begin, last + 1, frequency)


def _sine_fit(
    time: NDArray, value: NDArray, frequency: float
) -> tuple[float, NDArray[np.float64], float]:
    """Least-squares frequency near a first guess, coefficients as of `sine_design`, variance left.

    Gauss-Newton steps by normal equations, which serve for a few columns over a period or more.
    """
    centred = time - time.mean()
    for _ in range(4):
        design = sine_design(2 * np.pi * frequency * centred)
        _, cosine, sine = _solved(design, value)
        slope = 2 * np.pi * centred * (sine * design[:, 1] - cosine * design[:, 2])
        step = _solved(np.column_stack([design, slope]), value)[3]
        frequency += float(np.clip(step, -0.1 * frequency, 0.1 * frequency))
        if abs(step) < 1e-5 * frequency:
            break
    design = sine_design(2 * np.pi * frequency * time)
    solution = _solved(design, value)
    return frequency, solution, float(np.var(value - design @ solution))


def _solved(design: NDArray[np.float64], value: NDArray[np.float64]) -> NDArray[np.float64]:
    gram = design.T @ design
    regular = gram + np.diag(1e-12 * np.diagonal(gram))
    return np.asarray(np.linalg.solve(regular, design.T @ value), np.float64)


def _joined(tones: list[Segment], time: NDArray, command: NDArray) -> list[Segment]:
    """Neighbouring tones that are one sine, as one."""
    kept: list[Segment] = []
    for tone in tones:
        if kept and abs(tone.frequency_hz - kept[-1].frequency_hz) < _SAME_HZ:
            first = kept[-1].first
            clock = time - time[first]
            fit = _Sine.of(clock, command, first, tone.stop, tone.frequency_hz)
            if fit is not None:
                kept[-1] = Segment("tone", first, tone.stop, fit.frequency)
                continue
        kept.append(tone)
    return kept


def _is_chirp(tones: Sequence[Segment], time: NDArray) -> bool:
    """Many short pieces whose frequency goes one way in small steps are of a chirp."""
    if len(tones) < 3:
        return False
    hz = np.array([s.frequency_hz for s in tones])
    periods = np.array([(time[s.stop - 1] - time[s.first]) * s.frequency_hz for s in tones])
    adjacent = np.array([b.first - a.stop for a, b in itertools.pairwise(tones)]) <= 3
    small = np.abs(np.diff(np.log(hz))) < 0.3
    short = np.median(periods) < 4.5
    return bool(short and np.mean(adjacent & small) > 0.6)


_USUAL, _TIMES = 0.95, 8.0  # quantile of how far readings stand out, and times that
_OF_RANGE = 0.03  # of the trial's motion; less does no harm
_HELD, _OF_RANGE_HELD = 0.3, 0.2  # share of repeats: polls at odd times of the motion
_STEPS = 3.0  # of the smallest step between readings
_RETURNS = 0.7  # of the way away; the neighbours are that near to one another
_LARGE = 0.6  # of the range of motion: no part of what is usual
_BEYOND, _RESTED_S = 0.15, 0.5
_COARSE = 0.3  # of the range of motion, between two samples
_BESIDE = 3.0  # times the motion beside it
_PASSES = 4
_LONGEST_S, _LIVE_ROWS = 0.12, 2  # a held bad reading


@remembered(512)
def bad_rows(trial: Trial) -> NDArray[np.int64]:
    """Rows of `trial` that hold a single bad reading.

    Examples
    --------
    >>> time_s = 0.02 * np.arange(50)
    >>> position = np.round(np.sin(time_s), 3)
    >>> position[20] = -3.0
    >>> trial = Trial("hip", 0, float("nan"), time_s, time_s, position, position, None, 0.0)
    >>> bad_rows(trial).tolist()
    [20]
    """
    position = trial.position_rad.copy()
    bad = np.zeros(0, np.int64)
    for _ in range(_PASSES):  # one hides another beside it
        rows = _standing_out(trial, position, False)
        rows = rows if len(rows) else _standing_out(trial, position, True)
        if not len(rows):
            break
        position[rows] = np.nan
        bad = np.union1d(bad, rows)
    return bad


def _standing_out(trial: Trial, position: NDArray[np.float64], held: bool) -> NDArray[np.int64]:
    """Rows of readings away from their neighbours; of held ones, each value counts once."""
    none = np.zeros(0, np.int64)
    seen = np.flatnonzero(np.isfinite(position))
    value, time = position[seen], trial.read_time_s[seen]
    if len(value) < 8 or not np.abs(value).max() < 1e6:
        return none
    changed = np.flatnonzero(np.diff(value)) + 1 if held else np.arange(1, len(value))
    first = np.concatenate([[0], changed])
    v = value[first]
    if len(v) < 6:
        return none
    padded = np.concatenate([v[2:0:-1], v, v[-2:-4:-1]])
    before2, before, after, after2 = (padded[k : k + len(v)] for k in (0, 1, 3, 4))
    around = np.stack([before2, before, after, after2])
    out = np.maximum(v - around.max(axis=0), around.min(axis=0) - v)
    out = np.maximum(out, 0.0)
    moves = np.abs(np.diff(v))
    span = float(np.ptp(np.quantile(v, (0.05, 0.95))))
    usual = out[out < _LARGE * span]
    least = _STEPS * float(np.min(moves[moves > 1e-9], initial=np.inf))
    limit = max(
        _TIMES * float(np.quantile(usual, _USUAL)) if len(usual) else 0.0, least,
        (_OF_RANGE_HELD if np.mean(np.diff(value) == 0) > _HELD else _OF_RANGE) * span,
    )  # fmt: skip
    beside = np.maximum(np.abs(before - before2), np.abs(after2 - after))
    wrong = (out > limit) & (np.abs(after - before) < _RETURNS * out) & (out > _BESIDE * beside)
    held_log = np.mean(np.diff(value) == 0) > _HELD
    if held_log or np.quantile(moves, 0.8) > _COARSE * span:
        # few samples a period, or polls at odd times of it, go to and fro by themselves: within
        # the reach of the motion they count only while the command rests
        low, high = np.quantile(v, (0.05, 0.95))
        beyond = _BEYOND * span if held_log else _LARGE * span
        inside = (v > low - beyond) & (v < high + beyond)
        wrong &= ~inside | _rests(trial, time[first])
    wrong[[0, -1]] = False  # a log may begin or end anywhere
    stop = np.append(first[1:], len(value))
    lasts = time[np.minimum(stop, len(time) - 1)] - time[first]
    wrong &= (lasts <= _LONGEST_S) | (stop - first <= _LIVE_ROWS)
    rows = [seen[a:b] for a, b in zip(first[wrong], stop[wrong], strict=True)]
    return np.concatenate(rows) if rows else none


def _rests(trial: Trial, time_s: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the command hardly moves for a while before each time."""
    moved = np.abs(np.diff(trial.command_rad, prepend=trial.command_rad[0]))
    travelled = np.cumsum(moved)
    now, then = (
        np.clip(np.searchsorted(trial.send_time_s, time_s - ago, "right") - 1, 0, None)
        for ago in (0.0, _RESTED_S)
    )
    return travelled[now] - travelled[then] < 0.02 * float(np.ptp(trial.command_rad))


def without_bad_readings(trial: Trial) -> Trial:
    """The trial, its single bad readings missing."""
    rows = bad_rows(trial)
    if not len(rows):
        return trial
    position = trial.position_rad.copy()
    position[rows] = np.nan
    count = trial.position_count
    if count is not None:
        count = count.copy()
        count[rows] = -1
    return replace(trial, position_rad=position, position_count=count)
