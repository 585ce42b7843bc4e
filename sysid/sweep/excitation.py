"""Excitations: the trials of a recording, each a smooth, bounded motion from rest.

`plan` makes them from a kind ("sine", "chirp", "multisine", "steps", "square"), and
`sysid.sweep.recorder` from a file of recorded commands; `sysid.sweep.recorder` executes them.

Every trial begins with a short rest at the start pose: the onset from rest separates dead time from
dynamics. Amplitudes are reduced where the servo could not follow, and tones are moved off the
frequencies that the loop or the poll samples at a few phases only; `Plan.warnings` names every
change.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import gcd
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import DEFAULT_POSE
from pupper_sysid.common.reading.dialect import decimal
from pupper_sysid.hardware.loop import minimum_jerk, raised_cosine

Offset = Callable[[NDArray[np.float64]], NDArray[np.float64]]

SPEED_MARGIN = 0.9  # largest speed and acceleration of an excitation, as a share of their limits


@dataclass(frozen=True)
class Pace:
    """How fast a servo can follow: its own speed, and the ramp of its set-point by its registers.

    A ramp that cannot follow turns back late and anywhere: no model predicts what it does then.
    """

    speed_rad_s: float
    acceleration_rad_s2: float = np.inf

    def largest_rad(self, frequency_hz: ArrayLike) -> NDArray[np.float64]:
        """Largest amplitude of a tone that the servo follows [rad]."""
        omega = 2 * np.pi * np.asarray(frequency_hz, float)
        return SPEED_MARGIN * np.minimum(
            self.speed_rad_s / omega, self.acceleration_rad_s2 / omega**2
        )


PRBS_CLOCK_S = 0.11  # time between possible changes of a pseudo-random binary sequence [s]

FASTEST_OF_MINIMUM_JERK = 1.875
"""Highest speed of a minimum-jerk motion, as a multiple of its mean speed."""


def after(lead_in_s: float, offset: Offset) -> Offset:
    """`offset` after a rest."""

    def shifted(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        time_s = np.asarray(time_s, float) - lead_in_s
        return np.where(time_s > 0, offset(np.maximum(time_s, 0.0)), 0.0)

    return shifted


def sine(frequency_hz: float, amplitude: float) -> Offset:
    """Tone that grows over its first half period."""
    # full amplitude after half a period: smooth, and still an onset that excites the dynamics
    return lambda t: (
        amplitude * raised_cosine(2 * frequency_hz * t) * np.sin(2 * np.pi * frequency_hz * t)
    )


def square(frequency_hz: float, amplitude: float) -> Offset:
    """Square wave."""
    return lambda t: amplitude * np.where((t * frequency_hz) % 1.0 < 0.5, 1.0, -1.0)


def chirp(
    low: float, high: float, duration_s: float, amplitude: float, pace: Pace | None = None
) -> Offset:
    """Logarithmic chirp from `low` to `high` Hz, slow enough for the servo."""
    pace = pace or Pace(np.inf)

    def offset(t: NDArray[np.float64]) -> NDArray[np.float64]:
        rate = np.log(high / low) / duration_s
        grown = np.exp(rate * t)
        cycles = low * t if rate == 0 else low * (grown - 1) / rate
        bounded = np.minimum(amplitude, pace.largest_rad(low * grown))
        return bounded * raised_cosine(2 * low * t) * np.sin(2 * np.pi * cycles)

    return offset


def multisine(frequencies: Sequence[float]) -> Offset:
    """Equal amplitudes, Schroeder phases (IEEE Trans. Inf. Theory 16, 1970): a low crest factor."""
    f = np.array(frequencies)
    k = np.arange(1, len(f) + 1)
    phase = -np.pi * k * (k - 1) / len(f)

    def offset(t: NDArray[np.float64]) -> NDArray[np.float64]:
        tones = np.sin(2 * np.pi * f * np.asarray(t)[:, None] + phase)
        return raised_cosine(2 * f.min() * np.asarray(t)) * tones.sum(axis=-1)

    return offset


def steps(amplitude: float) -> tuple[Offset, float]:
    """Steps up and down in three sizes, and the duration of one pass [s]."""
    levels = amplitude * np.array([1, 0, -1, 0, 2, 0, -2, 0, 3, 0, -3, 3, -3, 0]) / 3
    # golden-ratio holds of 0.45 to 0.75 s: edges meet loop and poll at ever different phases
    holds = 0.45 + 0.3 * ((np.arange(len(levels)) * (np.sqrt(5) - 1) / 2) % 1.0)
    edges = np.concatenate([[0.0], np.cumsum(holds)])

    def offset(t: NDArray[np.float64]) -> NDArray[np.float64]:
        index = np.searchsorted(edges, np.asarray(t) % edges[-1], side="right") - 1
        return levels[index]

    return offset, float(edges[-1])


def prbs(amplitude: float) -> Offset:
    """Pseudo-random binary sequence of 127 bits (x⁷ + x⁶ + 1), after a start at rest."""
    state, bits = 0x5A, []
    for _ in range(127):
        bits.append(state & 1)
        state = state >> 1 | ((state ^ state >> 1) & 1) << 6
    levels = amplitude * (2.0 * np.array(bits) - 1.0)

    def offset(t: NDArray[np.float64]) -> NDArray[np.float64]:
        return levels[(np.asarray(t) / PRBS_CLOCK_S).astype(int) % len(levels)]

    return offset


def strokes(amplitude: float, speeds_rad_s: Sequence[float], times: int) -> tuple[Offset, float]:
    """Triangles between ± `amplitude`, `times` at each speed, and their duration [s].

    They begin and end at 0.
    """
    corners, at = [(0.0, 0.0)], 0.0
    for speed in speeds_rad_s:
        for level in [amplitude, -amplitude] * times:
            at += abs(level - corners[-1][1]) / speed
            corners.append((at, level))
    at += amplitude / speeds_rad_s[-1]
    corners.append((at, 0.0))
    time, level = np.array(corners).T
    return (lambda t: np.interp(t, time, level)), float(at)


def lift(height: float, duration_s: float) -> Offset:
    """Minimum-jerk motion to `height` within `duration_s`, held there."""
    return lambda t: height * minimum_jerk(np.asarray(t, float) / duration_s)


Kind = Literal["sine", "chirp", "multisine", "steps", "square", "prbs", "bench", "drop", "reversal"]
"""Shapes of a sweep's motion; the last three are those of a bench (`sysid.sweep.bench`)."""
KINDS = get_args(Kind)[:6]

HIGHEST_HZ = 25.0  # half of the usual 52 Hz command rate: a faster tone cannot be commanded
LEAD_IN_S = 0.2  # rest at the start pose, recorded at the head of every trial [s]

LOOP_PERIOD_S = 0.019
"""Default time between commands [s]: the rate of the recordings this project starts from."""

RATES_HZ = (1.0, 1000.0)  # slowest and fastest control loop [Hz]
TRIAL_S = (0.1, 86_400.0)  # shortest and longest trial [s]
PLANS_S = (0.1, 600.0)  # fewest and most recorded seconds per joint of a plan

LARGEST_AMPLITUDE_RAD = np.pi
"""Largest excursion from a start pose: half a turn to either side. More was meant in degrees."""

MOST_LOOPS = 1000  # largest number of loops of a file of commands, and of times to play it
LOWEST_HZ = 0.01  # slowest tone: five periods take more than eight minutes
POLL_RATE_HZ = 1 / 0.02685  # feedback polls of a Mini Pupper 2 [Hz], assumed before a recording
LEAST_MARGIN_RAD = 0.03  # smallest margin of a joint in which a measurement is worth it

_RATIOS = 12
_NUDGE_STEP_HZ = 0.01


@dataclass(frozen=True)
class TrialPlan:
    """One trial: which joints move, for how long, and where to."""

    joints: tuple[str, ...]
    """All others rest at the start pose."""
    frequency_hz: float
    """NaN if the motion is not a tone."""
    duration_s: float
    """With the lead-in."""
    offset: Offset
    """Command minus start pose [rad] at times since the trial's start [s]: shape (n,) to shape
    (n,), or (n, joints) where joints move differently."""
    p_gain: float = float("nan")
    """P gain of the moving servos, the register's value; NaN leaves it as it is."""
    release_s: float = float("inf")
    """Time since the trial's start from which the torque is off."""

    def command(self, time_s: float, start_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """Commands [rad], shape (joints,), for joints that start at `start_rad`."""
        return start_rad + self.offset(np.array([time_s]))[0]


@dataclass(frozen=True)
class Plan:
    """All trials of a recording, in order."""

    trials: tuple[TrialPlan, ...]
    start_pose_rad: Mapping[str, float] = field(default_factory=lambda: dict(DEFAULT_POSE))
    """Every joint's pose before and between the trials, absolute [rad]."""
    description: Mapping[str, Any] = field(default_factory=dict)
    """Written into the recording's header."""
    warnings: tuple[str, ...] = ()
    """Changes of the requested amplitudes and frequencies."""
    nearest_start_rad: float = float("inf")
    """Largest distance of a moving joint from its start pose at which the plan may begin."""

    @property
    def duration_s(self) -> float:
        """Recorded time of all trials [s]."""
        return sum(trial.duration_s for trial in self.trials)


def plan(
    kind: str,
    joints: Sequence[str],
    frequencies_hz: Sequence[float] = (1.0, 2.0, 3.0, 4.0),
    amplitude_rad: float = 0.3,
    duration_s: float | None = None,
    loop_period_s: float = 0.019,
    speed_limit_rad_s: float = 7.5,
    poll_rate_hz: float = POLL_RATE_HZ,
    margin_rad: Mapping[str, float] | None = None,
    start_pose_rad: Mapping[str, float] | None = None,
    acceleration_limit_rad_s2: float = np.inf,
) -> Plan:
    """The trials of an excitation, one joint after the other.

    The kinds: "sine", one trial per frequency; "chirp", one from the lowest to the highest
    frequency, logarithmic; "multisine", one with all frequencies at once, Schroeder phases;
    "steps", one with steps of a third, two thirds and all of the amplitude; "square", one per
    frequency; "prbs", a pseudo-random binary sequence. The amplitude [rad], the largest excursion
    from the start pose, is not reduced for steps, square waves and PRBS, which are meant to reach
    the speed limit.

    `speed_limit_rad_s` and `acceleration_limit_rad_s2` are those of the servo and of the ramp of
    its set-point. `duration_s` is of each trial without its lead-in; by default for tones 5 s or 5
    periods, whichever is longer; 20 s for a chirp, a multisine or a PRBS; one pass for steps.
    `poll_rate_hz` is 0 if there are no polls. `margin_rad` is the largest excursion of each joint
    to both sides of its start pose, which is by default the Mini Pupper's standing pose.
    """
    if kind not in KINDS:
        raise InputError(f"excitation '{kind}' is unknown; choose from {', '.join(KINDS)}.")
    check_amplitude(amplitude_rad)
    if not joints:
        raise InputError("excitation: no joint was chosen; name at least one.")
    for name, value in (
        ("loop_period_s", loop_period_s),
        ("speed_limit_rad_s", speed_limit_rad_s),
        ("duration_s", 1.0 if duration_s is None else duration_s),
    ):
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"excitation: {name} is {value}; it must be a positive number.")
    if duration_s is not None and duration_s > TRIAL_S[1]:
        raise InputError(f"excitation: duration_s is {duration_s:g}; it must be at most a day.")
    highest = min(HIGHEST_HZ, 0.5 / loop_period_s)
    frequencies = [_checked_frequency(f, highest) for f in frequencies_hz]
    if not frequencies and kind not in ("steps", "prbs"):
        raise InputError("excitation: no frequency was chosen; give at least one, such as 1-10.")
    warnings: list[str] = []
    amplitude_rad = _within(amplitude_rad, joints, margin_rad or {}, warnings)
    pace = Pace(speed_limit_rad_s, acceleration_limit_rad_s2)
    span = 20.0 if duration_s is None else duration_s
    if kind in ("sine", "square"):
        shapes = []
        for wanted in frequencies:
            time = max(5.0, 5.0 / wanted) if duration_s is None else duration_s
            f = off_harmonics(wanted, (1 / loop_period_s, poll_rate_hz), time)
            if f != wanted:
                warnings.append(
                    f"{wanted:g} Hz became {f:g} Hz: the loop ({1 / loop_period_s:.1f} Hz) or the "
                    f"poll ({poll_rate_hz:.1f} Hz) would sample it at a few phases only."
                )
            if kind == "sine":
                amplitude = _bounded(amplitude_rad, pace, f, f"{f:g} Hz", warnings)
                shapes.append((f, time, sine(f, amplitude)))
            else:
                shapes.append((np.nan, time, square(f, amplitude_rad)))
    elif kind == "chirp":
        low, high = min(frequencies), max(frequencies)
        _bounded(amplitude_rad, pace, high, f"chirp at {high:g} Hz", warnings)
        shapes = [(np.nan, span, chirp(low, high, span, amplitude_rad, pace))]
    elif kind == "multisine":
        shape = multisine(frequencies)
        # over 20 of its longest periods, the tone of as high a speed or acceleration
        value = shape(np.arange(0.0, 20.0 / min(frequencies), 0.001))
        peak, speed, bend = (float(np.abs(np.diff(value, n)).max() / 0.001**n) for n in range(3))
        amplitude = amplitude_rad
        for rate, limited in (
            (speed / peak, replace(pace, acceleration_rad_s2=np.inf)),
            (np.sqrt(bend / peak), replace(pace, speed_rad_s=np.inf)),
        ):
            amplitude = _bounded(amplitude, limited, rate / (2 * np.pi), "multisine", warnings)
        shapes = [(np.nan, span, lambda t: amplitude / peak * shape(t))]
    elif kind == "prbs":
        shapes = [(np.nan, span, prbs(amplitude_rad))]
    else:
        offset, one_pass = steps(amplitude_rad)
        shapes = [(np.nan, one_pass if duration_s is None else duration_s, offset)]
    trials = tuple(
        TrialPlan((joint,), float(f), LEAD_IN_S + time, after(LEAD_IN_S, offset))
        for joint in joints
        for f, time, offset in shapes
    )
    description = {
        "kind": kind, "amplitude_rad": amplitude_rad,
        "frequencies_hz": [] if kind in ("steps", "prbs") else frequencies, "lead_in_s": LEAD_IN_S,
        "speed_limit_rad_s": speed_limit_rad_s, "warnings": list(dict.fromkeys(warnings)),
    }  # fmt: skip
    pose = dict(DEFAULT_POSE if start_pose_rad is None else start_pose_rad)
    return Plan(trials, pose, description, tuple(dict.fromkeys(warnings)))


def check_amplitude(amplitude_rad: float) -> None:
    """Refuse an amplitude that is no excursion, or was meant in degrees."""
    allowed = f"it must be above 0 and at most {LARGEST_AMPLITUDE_RAD:.3g} rad"
    if not amplitude_rad > 0:
        raise InputError(f"`amplitude_rad` is {amplitude_rad:g} rad; {allowed}.")
    if amplitude_rad > LARGEST_AMPLITUDE_RAD:
        raise InputError(
            f"`amplitude_rad` is {amplitude_rad:g} rad, {amplitude_rad / (2 * np.pi):.2g} turns; "
            f"{allowed}, half a turn. Amplitudes are radians: {amplitude_rad:g} degrees are "
            f"{np.radians(amplitude_rad):.2g}."
        )


def parse_frequencies(text: str) -> list[float]:
    """Frequencies [Hz] that `text` names: `1-10`, `1-10:0.5`, `1,2,4,6.5`, or a mix.

    Examples
    --------
    >>> parse_frequencies("1-3,4-5:0.5")
    [1.0, 2.0, 3.0, 4.0, 4.5, 5.0]
    """
    frequencies: list[float] = []
    for part in (piece.strip() for piece in text.split(",")):
        span, _, step_text = part.partition(":")
        low_text, dash, high_text = span.partition("-")
        try:
            low = decimal(low_text)
            high = decimal(high_text) if dash else low
            step = decimal(step_text) if step_text else 1.0
        except ValueError:
            raise InputError(
                f"`frequencies`: '{part}' is not a frequency in Hz. Write 1-10, 1-10:0.5 or 1,2,4."
            ) from None
        for value in (low, high):
            _checked_frequency(value, HIGHEST_HZ)
        if high < low:
            raise InputError(f"`frequencies`: '{part}' runs backwards; write {high:g}-{low:g}.")
        if not (np.isfinite(step) and step > 0) or (step_text and not dash):
            raise InputError(f"`frequencies`: '{part}' has no usable step; write 1-10:0.5.")
        if (high - low) / step > 1000:
            raise InputError(f"`frequencies`: '{part}' has more than 1000; use a larger step.")
        count = int((high - low) / step + 1e-9) + 1
        frequencies += [round(low + i * step, 9) for i in range(count)]
    return sorted(set(frequencies))


def off_harmonics(frequency_hz: float, rates_hz: Sequence[float], duration_s: float) -> float:
    """The nearest frequency, in steps of 0.01 Hz, that is sampled all around its period.

    A tone at `p/q` of a sampling rate is seen at `q` phases only. Within `duration_s` the phases
    drift apart by `1/q` of a period, and so cover it, if the tone is `1 / (q * duration_s)` away.
    Ratios with `q` up to 12 are avoided; more phases than that are as good as all.

    Examples
    --------
    >>> off_harmonics(5.0, (50.0,), 5.0), off_harmonics(1.0, (50.0,), 5.0)
    (5.02, 1.0)
    """

    def clear(f: float) -> bool:
        return all(
            abs(f - p / q * rate) >= 1 / (q * duration_s) - 1e-9
            for rate in rates_hz
            for q in range(1, _RATIOS + 1)
            for p in range(1, q + 1)
            if gcd(p, q) == 1
        )

    # at most a few tenths of a hertz: further off it would be another measurement
    for k in range(round(0.5 / _NUDGE_STEP_HZ)):
        for f in (frequency_hz + k * _NUDGE_STEP_HZ, frequency_hz - k * _NUDGE_STEP_HZ):
            if f > 0 and clear(f):
                return round(f, 6)
    return frequency_hz


def _checked_frequency(value: float, highest_hz: float) -> float:
    if not LOWEST_HZ <= value <= highest_hz:
        raise InputError(
            f"frequency {value:g} Hz: it must be at least {LOWEST_HZ:g} Hz and at most "
            f"{highest_hz:g} Hz, half the rate at which commands are sent."
        )
    return float(value)


def _within(
    amplitude: float, joints: Sequence[str], margin: Mapping[str, float], warnings: list[str]
) -> float:
    """`amplitude`, or the smallest margin of the joints with a warning."""
    tight = min((j for j in joints if j in margin), key=lambda j: margin[j], default=None)
    if tight is None or margin[tight] >= amplitude:
        return amplitude
    if margin[tight] < LEAST_MARGIN_RAD:
        raise InputError(
            f"excitation: {tight} has a margin of {margin[tight]:.3f} rad on either side of its "
            "start pose, too little for a measurement. Check its limits in the joint map."
        )
    warnings.append(
        f"amplitude reduced from {amplitude:g} to {margin[tight]:.3f} rad, the margin within the "
        f"joint map's limits of {tight}."
    )
    return margin[tight]


def _bounded(
    amplitude: float, pace: Pace, frequency_hz: float, what: str, warnings: list[str]
) -> float:
    """`amplitude`, or with a warning the largest that the servo follows at a frequency."""
    reduced = float(pace.largest_rad(frequency_hz))
    if amplitude <= reduced:
        return amplitude
    omega = 2 * np.pi * frequency_hz
    stays = (
        f"speed stays at {reduced * omega:.2f} rad/s"
        if pace.speed_rad_s < pace.acceleration_rad_s2 / omega
        else f"acceleration stays at {reduced * omega**2:.1f} rad/s²: the servo's registers ramp "
        "its set-point"
    )
    warnings.append(
        f"{what}: amplitude reduced from {amplitude:g} to {reduced:.3f} rad, so that the {stays}."
    )
    return reduced
