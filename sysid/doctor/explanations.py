"""How well a position servo explains a joint's position by its command: fits for `hypotheses`.

Each trial's position is regressed on its held command, passed through a second-order low-pass (or
none) and shifted by every lag from early to late. `explain` pools the trials; `Explanation.best`
is the best servo of a sign and a range of lags. Its score is in nats: half the effective readings
times the logarithm of the unexplained share, a floor beneath it because no servo is linear, and
what gains and lags that servos seldom have cost. A gain is that of the low-pass at rest, read from
the response at the frequencies that the command has: a command without a constant part has no
constant response.

The model is a crude one on purpose: it takes milliseconds and knows nothing of poll, friction or
limits. It judges a recording; it measures nothing that is printed as a servo's.

`echo` and `crossed` name what is no servo: a position that is the command itself, or that
follows another joint's command.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from pupper_sysid.common.filters import filtered
from pupper_sysid.sysid.doctor.findings import REFUSE, Finding
from pupper_sysid.sysid.doctor.signals import COARSEST_RAD, clock_findings
from pupper_sysid.sysid.feedback.staleness import fresh_rows, quantum, staleness
from pupper_sysid.sysid.recordings.excitation import remembered
from pupper_sysid.sysid.recordings.recording import Trial

LATEST_S, EARLIEST_S = 0.8, -0.6

FILTERS: tuple[tuple[float, float], ...] = ((0.0, 1.0), *(
    (hz, damping) for hz in (1.5, 2.5, 4.0, 6.5, 10.0, 16.0, 25.0) for damping in (0.5, 1.0)
))  # fmt: skip
"""Natural frequency [Hz], 0 for none, and damping ratio."""
_GRID_S, _FINEST_S = 0.005, 0.001
_MOST_POINTS = 1 << 14
_OVERLAP = 0.5  # of the readings must have a command at a lag
_CORRELATED_ROWS = 4.0  # rows whose errors count as one
_MOST_ROWS = 150.0  # the model's own errors do not shrink with more rows
_NOT_LINEAR = 0.006  # of the variance
_USUAL_LAG_S, _LAG_SCALE_S = 0.06, 0.05  # dead time with the age of a reading: usual, and beyond
_USUAL_GAIN, _MOST_GAIN_NATS = 0.3, 12.0  # of the logarithm

_HELD_S, _BY_CHANCE = 0.12, 0.01  # rest; probability that lost reads alone hold a value for longer


@dataclass(frozen=True)
class Servo:
    """The best servo of a region of gains and lags."""

    nats: float
    """Its score, the less the better."""
    unexplained: float
    """Share of the position's variance that it leaves."""
    gain: float
    """Of its low-pass at rest, with its sign."""
    lag_s: float
    """Its delay beside the low-pass."""
    total_s: float
    """Delay and low-pass together."""
    filter: int
    """Number of its low-pass."""


@dataclass(frozen=True)
class Samples:
    """Readings of one trial, and the staircase of its command on a grid of time."""

    time_s: NDArray[np.float64]
    position_rad: NDArray[np.float64]
    command_rad: NDArray[np.float64]
    start_s: float
    rest_rad: float
    grid_s: float


@dataclass(frozen=True)
class Explanation:
    """All servos of the grid against the trials of one joint."""

    samples: tuple[Samples, ...]
    """Of the trials that move."""
    weight: NDArray[np.float64]
    """Shape (trials,)."""
    rho: NDArray[np.float64]
    gains: NDArray[np.float64]
    """`rho` and `gains`: correlation with the filtered and shifted command, and position per
    command, shape (trials, filters, lags)."""
    lags_s: NDArray[np.float64]
    """Shape (lags,)."""
    rows: float
    """Readings that count as independent."""
    floor: float
    """Unexplained share that any servo leaves."""
    grid_s: float

    @cached_property
    def explained(self) -> float:
        """Share that the command explains with a lag and a sign for each trial by itself."""
        return float(self.weight @ (self.rho**2).max(axis=(1, 2)))

    @cached_property
    def total_s(self) -> NDArray[np.float64]:
        """Delay of low-pass and lag together, shape (filters, lags)."""
        delays = [damping / (np.pi * hz) if hz else 0.0 for hz, damping in FILTERS]
        return self.lags_s + np.array(delays)[:, None]

    def best(self, sign: float, inside: NDArray[np.bool_]) -> Servo:
        """The best servo of a sign, where `inside` of shape (filters, lags) allows it."""
        share = np.tensordot(self.weight, np.maximum(sign * self.rho, 0.0) ** 2, axes=1)
        gain = np.tensordot(self.weight, self.gains, axes=1)
        with np.errstate(divide="ignore"):
            odd = (np.log(np.maximum(np.abs(gain), 1e-9)) / _USUAL_GAIN) ** 2 / 2
        late = np.maximum(np.abs(self.lags_s) - _USUAL_LAG_S, 0.0) / _LAG_SCALE_S
        nats = 0.5 * self.rows * np.log(1 - share + self.floor)
        nats = nats + np.minimum(odd, _MOST_GAIN_NATS) + late
        f, at = np.unravel_index(int(np.argmin(np.where(inside, nats, np.inf))), nats.shape)
        return Servo(
            float(nats[f, at]), float(1 - share[f, at]), float(gain[f, at]),
            float(self.lags_s[at]), float(self.total_s[f, at]), int(f),
        )  # fmt: skip

    def causal(self, latest_s: float = LATEST_S) -> NDArray[np.bool_]:
        """Where a servo is not early and not too late, shape (filters, lags)."""
        inside = (self.lags_s >= -0.5 * self.grid_s) & (self.lags_s <= latest_s)
        return np.broadcast_to(inside, self.total_s.shape)

    def nats(self, unexplained: float) -> float:
        """Score of an unexplained share alone."""
        return 0.5 * self.rows * float(np.log(unexplained + self.floor))


@remembered(8)
def explain(trials: Sequence[Trial], step: float, exchanged: bool = False) -> Explanation | None:
    """Explain the position of one joint by its command.

    `trials`: all of this joint, three rows or more each, with sound time stamps. `step`:
    quantisation step [rad]: trials that move by little more weigh little. `exchanged`: explain the
    command by the position. Returns None if no trial has enough motion of both.
    """
    if exchanged:
        trials = [_exchanged(t) for t in trials if np.isfinite(t.position_rad).sum() > 8]
        if not trials:
            return None
    loop = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in trials])))
    grid = max(min(loop / 4, _GRID_S), _FINEST_S)
    lags = grid * np.arange(round(EARLIEST_S / grid), round(LATEST_S / grid) + 1, dtype=float)
    live = exchanged or staleness(trials).kind == "live"
    samples, maps, spread = [], [], []
    for t in trials:
        sample = _samples(t, live, grid)
        trial_maps = _maps(sample, grid, len(lags))
        if trial_maps is not None:
            samples.append(sample)
            maps.append(trial_maps)
            spread.append(float(np.var(sample.position_rad)))
    if not maps:
        return None
    variance = np.array(spread)
    noise = max(step, 1e-5) ** 2 / 4
    weight = variance * variance / (variance + noise)
    if not weight.sum() > 0:
        return None
    rows = min(sum(len(s.time_s) for s in samples) / _CORRELATED_ROWS, _MOST_ROWS)
    weight = weight / weight.sum()
    floor = _NOT_LINEAR + max(step, 1e-5) ** 2 / 12 / float(weight @ variance)
    return Explanation(
        tuple(samples), weight, np.stack([m[0] for m in maps]), np.stack([m[1] for m in maps]),
        lags, rows, floor, grid,
    )  # fmt: skip


def _exchanged(trial: Trial) -> Trial:
    """The trial with its position for its command, and the other way round."""
    seen = np.isfinite(trial.position_rad)
    position = trial.position_rad[seen]
    return replace(
        trial, send_time_s=trial.read_time_s[seen], read_time_s=trial.send_time_s[seen],
        command_rad=position, position_rad=trial.command_rad[seen], position_count=None,
        initial_command_rad=float(position[0]), torque_enabled=None, voltage_v=None,
    )  # fmt: skip


def _samples(trial: Trial, live: bool, grid: float) -> Samples:
    begin, end = trial.send_time_s[0], max(trial.send_time_s[-1], trial.read_time_s[-1])
    points = min(int((end - begin) / grid) + 1, _MOST_POINTS)
    row = np.searchsorted(trial.send_time_s, begin + grid * np.arange(points) + 1e-9, "right") - 1
    command = trial.command_rad[np.maximum(row, 0)].astype(np.float64)
    if live:
        rows = np.flatnonzero(np.isfinite(trial.position_rad))
        time = trial.read_time_s[rows]
    else:
        rows = fresh_rows(trial)
        rows = rows[rows > 0]
        time = 0.5 * (trial.read_time_s[rows] + trial.read_time_s[rows - 1])
        resting = _resting(trial, rows)
        time = np.concatenate([time, trial.read_time_s[resting]])
        order = np.argsort(time, kind="stable")
        rows, time = np.concatenate([rows, resting])[order], time[order]
    inside = (time >= begin) & (time <= begin + grid * (points - 1))
    rest, first = trial.initial_command_rad, float(trial.command_rad[0])
    # a rest of the header far from the first command is another session's
    rest = rest if abs(rest - first) <= np.ptp(trial.command_rad) + 0.1 else first
    return Samples(time[inside], trial.position_rad[rows[inside]], command, begin, rest, grid)


def _resting(trial: Trial, fresh: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows in which the joint rests: their value has stayed for longer than any poll holds one.

    Each read is lost with one probability, so that the tail of the holds is exponential: half of
    the longer ones are over after each further `half_life`, which is the usual hold at most.
    """
    seen = np.flatnonzero(np.isfinite(trial.position_rad))
    time = trial.read_time_s
    if len(fresh) < 3 or not len(seen):
        return np.zeros(0, np.int64)
    usual, longer = np.quantile(np.diff(time[fresh]), [0.5, 0.75])
    half_life = min(max(longer - usual, 0.5 * usual), usual)  # rests are among the longer ones
    held = max(_HELD_S, usual + half_life * float(np.log2(len(fresh) / _BY_CHANCE)))
    last = np.searchsorted(fresh, seen, "right") - 1
    since = time[seen] - time[fresh[np.maximum(last, 0)]]
    return seen[(last >= 0) & (since > held)]


def _low_pass(command: NDArray, hz: float, damping: float, grid: float) -> NDArray[np.float64]:
    """Command behind a second-order low-pass; before it, its first value."""
    if hz <= 0:
        return command
    # bilinear, with the natural frequency in its place
    k = np.tan(np.pi * min(hz * grid, 0.4))
    scale = 1 + 2 * damping * k + k * k
    top = k * k / scale
    below = np.array([1.0, 2 * (k * k - 1) / scale, (1 - 2 * damping * k + k * k) / scale])
    return filtered(np.array([top, 2 * top, top]), below, command - command[0]) + command[0]


def _maps(
    samples: Samples, grid: float, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Correlation and gain per filter and lag; None without motion."""
    command, points = samples.command_rad, len(samples.command_rad)
    place = np.round((samples.time_s - samples.start_s) / grid).astype(np.int64)
    mask = np.bincount(place, minlength=points).astype(np.float64)
    if mask.sum() < 8 or np.ptp(command) < 1e-6:
        return None
    value = samples.position_rad - samples.position_rad.mean()
    y = np.bincount(place, value, points)
    square = np.bincount(place, value**2, points)
    if square.sum() < 1e-12:
        return None
    before = round(LATEST_S / grid)  # rows of rest that precede the command
    ahead = count - 1 - before
    size = 1 << int(np.ceil(np.log2(points + before + count)))
    # lag m (from -ahead to before) looks at command row i - m, stored at i - m + before
    shift = before - np.arange(-ahead, before + 1)

    def transform(a: NDArray) -> NDArray[np.complex128]:
        return np.fft.rfft(a, size)

    def correlate(a: NDArray, b: NDArray) -> NDArray[np.float64]:
        """Of transforms; the first is conjugate."""
        return np.fft.irfft(a * b, size)[shift]

    of_mask, of_y, of_square = (np.conj(transform(a)) for a in (mask, y, square))
    of_there = transform(np.ones(before + points))
    n, sy, syy = (correlate(a, of_there) for a in (of_mask, of_y, of_square))
    n = np.maximum(n, 1e-9)
    rho, gain = np.zeros((2, len(FILTERS), count))
    held = np.concatenate([np.full(before, samples.rest_rad), command])
    enough = n >= _OVERLAP * mask.sum()
    for k, (hz, damping) in enumerate(FILTERS):
        u = _low_pass(held, hz, damping, grid) - command.mean()
        of_u = transform(u)
        su, suy = correlate(of_mask, of_u), correlate(of_y, of_u)
        suu = correlate(of_mask, transform(u * u))
        covariance, inputs = suy - sy * su / n, suu - su**2 / n
        outputs = syy - sy**2 / n
        known = enough & (inputs > 1e-12 * len(u)) & (outputs > 0)
        rho[k] = np.where(known, covariance / np.sqrt(np.maximum(inputs * outputs, 1e-300)), 0.0)
        gain[k] = np.where(known, covariance / np.maximum(inputs, 1e-300), 0.0)
    return np.clip(rho, -1.0, 1.0), gain


_ECHO_ROWS, _ECHO_SHARE = 30, 0.99
_ECHO_STEPS, _ECHO_PAST_ROWS = 2.0, 5  # half steps that the command moves within so many rows
_ECHO_OF_ROW = 0.01  # of the command's motion in a row: no servo is as precise in time
_ECHO_TRAVEL = 8.0  # steps: within fewer any lag looks like an echo
_SLOW_ECHO_S, _FASTEST_HZ, _SERVO_GRID_S = 0.02, 30.0, 1e-3
"""From so late on an echo may be a servo of that natural frequency, faster than hobby servos are,
which follows a smooth command to within the quantisation step."""
_DELAYED_STEPS = 10.0  # per row: then a lag that changes by a tenth of a row shows
_LONGEST_ECHO_S, _MOST_SHIFTS = 0.6, 60
_MUCH_BETTER = 0.5


def crossed(trials_by_joint: Mapping[str, Sequence[Trial]]) -> dict[str, Finding]:
    """Joints whose position follows the command of another one, recorded at the same time."""
    crossed_joints = {}
    for joint, trials in trials_by_joint.items():
        others = {
            name: theirs
            for name, theirs in trials_by_joint.items()
            if name != joint and trials and _simultaneous(trials, theirs)
        }
        if not others or any(f.verdict == REFUSE for f in clock_findings(trials)):
            continue
        step = quantum(trials)
        servo = _servo(trials, step)
        if servo is None or servo.unexplained < _MUCH_BETTER / 4:
            continue
        for other, theirs in others.items():
            instead = [
                replace(t, command_rad=o.command_rad, initial_command_rad=o.initial_command_rad)
                for t, o in zip(trials, theirs, strict=True)
            ]
            theirs_instead = _servo(instead, step)
            if theirs_instead and theirs_instead.unexplained < _MUCH_BETTER * servo.unexplained:
                crossed_joints[joint] = Finding("other_joint", REFUSE, {"other": other}, joint)
                break
    return crossed_joints


def _servo(trials: Sequence[Trial], step: float) -> Servo | None:
    """The best servo of positive gain; None where too little moves."""
    base = explain(trials, step)
    return base.best(1.0, base.causal()) if base else None


def _simultaneous(one: Sequence[Trial], other: Sequence[Trial]) -> bool:
    return len(one) == len(other) and all(
        len(a.send_time_s) == len(b.send_time_s)
        and abs(a.send_time_s[0] - b.send_time_s[0]) < 1.0
        and np.ptp(b.command_rad) > 1e-3
        for a, b in zip(one, other, strict=True)
    )


def echo(trials: Sequence[Trial], step: float) -> Finding | None:
    """The position is the command itself, some rows late, to within a quantisation step.

    Nearly all rows must agree to within half a step while the command moves: however coarse the
    steps, a servo's inertia and friction carry its readings over some of them earlier or later.
    """
    loop = float(np.median(np.concatenate([np.diff(t.send_time_s) for t in trials])))
    moves = np.concatenate([np.abs(np.diff(t.command_rad)) for t in trials])
    usual = float(np.median(moves[moves > 0])) if (moves > 0).any() else 0.0
    step = step if step < COARSEST_RAD else 0.0  # of few commands, and of no encoder
    near = max(0.55 * step + 1e-5, _ECHO_OF_ROW * usual)  # the step may not have been found
    least = _ECHO_STEPS * near
    travels = [np.cumsum(np.abs(np.diff(t.command_rad, prepend=t.command_rad[0]))) for t in trials]
    if max(float(np.ptp(t.command_rad)) for t in trials) < _ECHO_TRAVEL * step:
        return None
    new = [np.isin(np.arange(len(t.send_time_s)), fresh_rows(t)) for t in trials]
    for shift in range(min(round(_LONGEST_ECHO_S / max(loop, 1e-4)), _MOST_SHIFTS) + 1):
        parts = []
        for t, travel, fresh in zip(trials, travels, new, strict=True):
            # a servo's way from one command to the next lies in the rows before and after a motion
            row = np.arange(max(len(travel) - shift, 0))
            moves = travel[row + shift] - travel[np.maximum(row - _ECHO_PAST_ROWS, 0)] > least
            sent = row[moves]
            # where each row has another command, those that a poll has yet to see may be left out
            steady = (np.diff(travel, prepend=-1.0) > 0) & (np.diff(travel, append=np.inf) > 0)
            away = t.position_rad[sent + shift] - t.command_rad[sent]
            parts.append(np.array([away, fresh[sent + shift] & steady[sent]]))
        away, seen = np.concatenate([np.zeros((2, 0)), *parts], axis=1)
        if np.isfinite(away).sum() < _ECHO_ROWS:
            break
        for each in (away[np.isfinite(away)], away[np.isfinite(away) & (seen > 0)]):
            if len(each) < _ECHO_ROWS:
                continue
            middle = 0.5 * float(np.sum(np.quantile(each, (0.01, 0.99))))
            agrees = np.mean(np.abs(each - middle) <= near) >= _ECHO_SHARE
            if agrees and (shift * loop < _SLOW_ECHO_S or _servo_would_show(trials, near)):
                late = (
                    f"{shift} row{'s' if shift != 1 else ''} late" if shift else "in the same row"
                )
                return Finding("echo", REFUSE, {"late": late})
    return _delayed(trials, near, loop)


def _servo_would_show(trials: Sequence[Trial], near: float) -> bool:
    """Whether even a fast servo would leave these commands by more than `near`."""
    lag_s, away = 1.0 / (np.pi * _FASTEST_HZ), []
    for t in trials:
        time = np.arange(t.send_time_s[0], t.send_time_s[-1], _SERVO_GRID_S)
        held = t.command_rad[np.searchsorted(t.send_time_s, time, side="right") - 1]
        path = _low_pass(held, _FASTEST_HZ, 1.0, _SERVO_GRID_S)
        within = t.send_time_s + lag_s <= time[-1]
        away.append(np.interp(t.send_time_s + lag_s, time, path)[within] - t.command_rad[within])
    distance = np.concatenate(away)
    return bool(np.mean(np.abs(distance - np.median(distance)) > near) > 2 * (1 - _ECHO_SHARE))


def _delayed(trials: Sequence[Trial], near: float, loop: float) -> Finding | None:
    """The position is the command at a constant time before, between rows as well."""
    # as many as the longest lag takes: the way from one command to the next is among them
    count = round(_LONGEST_ECHO_S / 2 / max(loop, 1e-4)) + _ECHO_PAST_ROWS
    rows = [_rows_after_motion(t, _DELAYED_STEPS * near, count) for t in trials]
    if sum(map(len, rows)) < _ECHO_ROWS:
        return None

    def residuals(lag: float) -> NDArray[np.float64]:
        parts = [
            t.position_rad[r] - np.interp(t.read_time_s[r] - lag, t.send_time_s, t.command_rad)
            for t, r in zip(trials, rows, strict=True)
        ]
        away = np.concatenate(parts)
        return away - 0.5 * float(np.sum(np.quantile(away, (0.01, 0.99))))

    def spread(lag: float) -> float:
        return float(np.mean(residuals(lag) ** 2))

    coarse = min(np.arange(-loop, _LONGEST_ECHO_S / 2, loop / 2), key=spread)
    around = (coarse - loop / 2, coarse + loop / 2)
    fine: Any = minimize_scalar(spread, bounds=around, method="bounded")
    late = float(fine.x)
    if np.mean(np.abs(residuals(late)) <= near) < _ECHO_SHARE:
        return None
    return Finding("echo_between_rows", REFUSE, {"late_ms": 1e3 * late})


def _rows_after_motion(trial: Trial, least: float, count: int) -> NDArray[np.int64]:
    """Rows up to `count` after the command moved by more than `least` in one."""
    moved = np.abs(np.diff(trial.command_rad, prepend=trial.command_rad[0])) > least
    total = np.cumsum(moved)
    before = np.concatenate([np.zeros(min(count, len(total)), np.int64), total[:-count]])
    return np.flatnonzero(np.isfinite(trial.position_rad) & (total > before[: len(total)]))
