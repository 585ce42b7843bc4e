"""Hysteresis, dead zone and backlash of a servo from slow strokes up and down.

    pupper-sysid sweep --load pendulum:0.1kg@0.10m --gains 4,8,16 --kind reversal
    measured = backlash(load("recordings/reversal_….csv"))

At low speed and P gain `P` a servo whose encoder sits on its output trails its command by

    command - position = offset + s * a(P) + (G/K) * sin(q - hanging) + (1/w(P)) * dq/dt

with the direction `s`, the stiffness `K ∝ P`, and the lag per speed `1/w = back-EMF / K + dead
time`. Twice `a` is the hysteresis between strokes up and down at no speed: what friction (`F/K`) or
the dead zone hold back, whichever is larger. Friction's part shrinks as `1/P`, a dead zone's does
not, which tells them apart if there are several gains.

Play in the gears opens when the load changes sides: a pendulum does so where it hangs. The motor
then runs through the play alone, and for that time the servo trails its command by more. Whatever
the inertias, the integral of the excess over the crossing is `(back-EMF / K) * backlash`. In free
air the sides change at the reversals, together with friction: there nothing tells backlash from
friction and stiffness, and none is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.results import JointResults, Result, flat, plain
from pupper_sysid.sysid.doctor import checks
from pupper_sysid.sysid.doctor.checks import Joints, Recordings
from pupper_sysid.sysid.recordings.recording import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class GainHysteresis(Result):
    """Hysteresis at one P gain."""

    p_gain: float
    """NaN if the recording does not say it."""
    hysteresis_rad: Interval
    """Command difference between strokes up and down at the same reading and no speed."""
    lag_s: Interval
    """Lag behind a slow ramp: back-EMF over stiffness, and the dead time."""
    strokes: int


@dataclass(frozen=True, kw_only=True)
class JointBacklash(Result):
    """Hysteresis, dead zone and backlash of one joint."""

    gains: tuple[GainHysteresis, ...]
    dead_zone_rad: Interval | None
    """Half of the hysteresis that does not shrink with the gain. Its lower end is 0 where friction
    explains all; None with a single gain."""
    backlash_rad: Interval | None
    """Play between motor and output; None without a load that reveals it."""
    notes: tuple[str, ...] = ()
    """What could not be told apart, and what would."""

    def __str__(self) -> str:
        parts = [f"hysteresis {_degrees(g.hysteresis_rad)} at P {g.p_gain:g}" for g in self.gains]
        for name, value in (("dead zone", self.dead_zone_rad), ("backlash", self.backlash_rad)):
            parts.append(f"{name} {'not determined' if value is None else _degrees(value)}")
        return ", ".join(parts)

    def rows(self) -> list[dict[str, Any]]:
        """One row per P gain; dead zone and backlash, which have no gain, stand in each."""
        return [
            gain.rows()[0]
            | flat(plain({"dead_zone_rad": self.dead_zone_rad, "backlash_rad": self.backlash_rad}))
            for gain in self.gains
        ]


def _degrees(value: Interval) -> str:
    best, low, high = np.degrees(astuple(value))
    return f"{best:.2f}° [{low:.2f}, {high:.2f}]"


FASTEST_RAD_S = 0.5  # faster strokes are no test of hysteresis: inertia counts
LONGEST_DEAD_TIME_S = 0.03  # with a single gain the dead time is taken to be anything up to this
_BEFORE_RAD, _AFTER_RAD = 0.03, 0.12  # of the hanging position: the play opens and closes in here
_SETTLED_RAD = 0.04  # travel after a reversal from which a stroke is steady
_CALM_S = 0.5  # after that: transients of a low gain are over
_PIECE_RAD = 0.03
_COUNT_SHARE = 0.05  # of a count: what rounding in the servo's own loop does to the hysteresis
_DAMPED_SHARE = 0.03  # of the lag per speed, that a D gain makes: it acts on the encoder alone
_LEAST_STROKE_S, _LEAST_STROKES = 1.0, 6
_DRAWS = 600
_Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Backlash(JointResults[JointBacklash]):
    """Hysteresis, dead zone and backlash by joint."""

    def plot(self) -> Figure:
        """Hysteresis over the P gain, a panel per joint: friction falls as 1/P, a dead zone stays.

        The dashed line falls as 1/P from the lowest gain; the shaded band is twice the dead zone.
        """
        from pupper_sysid.sysid.report.figures import hysteresis_figure

        return hysteresis_figure(self)


@dataclass(frozen=True)
class _Stroke:
    """Sums over one stroke: of the regression, and of the crossing of the hanging position."""

    side: float
    speed_rad_s: float
    normal: _Array
    """Of the regressors and the trailing: shape (k + 1, k + 1)."""
    crossing: _Array | None
    """Integrals of sin(q - hanging) and of the trailing beyond their means while steady, in the
    stroke's direction; None if it does not cross."""


def backlash(recordings: Recordings, joints: Joints = None, seed: int = 0) -> Backlash:
    """Measure hysteresis, dead zone and backlash from slow strokes.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Of `sweep --kind reversal`, or any slow triangles.
    joints : str or sequence of str, optional
        By default all that were recorded.
    seed : int
        Of the bootstrap over strokes.

    Returns
    -------
    Backlash
        Hysteresis per P gain, dead zone and play, by joint.

    Raises
    ------
    InputError
        If a joint has too few slow strokes.

    Examples
    --------
    >>> from pupper_sysid.sysid.recordings.files import load
    >>> measured = backlash(load("recordings/reversal.csv"))  # doctest: +SKIP
    >>> print(measured)  # doctest: +SKIP
    bench: hysteresis 1.50° [1.48, 1.51] at P 8, …, backlash 1.92° [1.83, 2.00]
    """
    inputs = checks.as_sequence(recordings)
    measured = {
        joint: _measure(joint, checks.recorded_trials(inputs, joint), checks.joint_rng(seed, joint))
        for joint in checks.chosen_joints(inputs, joints)
    }
    return Backlash(joints=measured)


def _measure(joint: str, trials: Sequence[Trial], rng: np.random.Generator) -> JointBacklash:
    groups: dict[float, list[_Stroke]] = {}
    for trial in trials:
        groups.setdefault(trial.p_gain, []).extend(_strokes(trial))
    groups = {
        g: strokes_at_gain
        for g, strokes_at_gain in sorted(groups.items())
        if len(strokes_at_gain) >= _LEAST_STROKES
        and len({round(s.speed_rad_s, 3) for s in strokes_at_gain}) > 1
        and len({s.side for s in strokes_at_gain}) > 1
    }
    if not groups:
        raise InputError(
            f"{joint}: the recording has no slow strokes at two speeds (at least {_LEAST_STROKES} "
            f"below {FASTEST_RAD_S} rad/s, up and down). Record some: a sweep with a load, of the "
            "kind reversal."
        )
    loaded = all(t.load is not None and t.load.gravity_nm > 0 for t in trials)
    fits = {g: _Fit(strokes_at_gain, loaded, rng) for g, strokes_at_gain in groups.items()}
    gains = np.array(list(fits))
    quantum = max(t.truncation.quantum_rad for t in trials)
    notes: list[str] = []
    several = len(gains) > 1 and bool(np.isfinite(gains).all())
    limited = np.ones(len(gains), bool)
    if several:  # where friction, not the dead zone, sets the hysteresis, `a · P` is the same
        product = gains * np.array([f.best[1] for f in fits.values()])
        limited = product < 1.04 * product[0]
    measured = []
    for gain, fit in fits.items():
        width = _interval(2 * fit.best[1], 2 * fit.draws[:, 1], fit.count)
        lag = _interval(fit.best[-1], fit.draws[:, -1], fit.count)
        width = width.widened(_COUNT_SHARE * quantum)
        measured.append(
            GainHysteresis(p_gain=gain, hysteresis_rad=width, lag_s=lag, strokes=fit.count)
        )
    zone = None
    if several:  # from the highest gain, where friction holds back least
        top = measured[-1]
        half = top.hysteresis_rad.times(0.5)
        # the servo moves on when the error exceeds the zone: by up to a whole count
        low, value = max(half.low - quantum, 0.0), max(half.value - quantum / 2, 0.0)
        zone = Interval(value, low, half.high)
        if limited[-1]:
            zone = Interval(0.0, 0.0, half.high)
            notes.append(
                f"the hysteresis shrinks as 1/P up to P {top.p_gain:g}: it is friction over "
                "stiffness, and a dead zone is at most half of what is left there."
            )
    else:
        notes.append(
            "one P gain: friction and dead zone together make the hysteresis. Strokes at two or "
            "more gains, such as 8 and 32, separate them."
        )
    play = None
    if loaded:
        used = {g: f for (g, f), by in zip(fits.items(), limited, strict=True) if by}
        damped = any(t.servo.d_gain != 0 for t in trials)
        play = _play(used, damped, rng, notes)
    else:
        notes.append(
            "no load: where the gears change sides is where the stroke reverses, and backlash "
            "cannot be separated from friction over stiffness. Hang a pendulum on it, such as "
            "pendulum:0.1kg@0.10m."
        )
    return JointBacklash(
        gains=tuple(measured), dead_zone_rad=zone, backlash_rad=play, notes=tuple(notes)
    )


def _strokes(trial: Trial) -> list[_Stroke]:
    """The slow strokes of a trial: stretches of one constant command rate."""
    time, command, position = trial.send_time_s, trial.command_rad, trial.position_rad
    if trial.torque_enabled is not None and not trial.torque_enabled.all():
        return []
    rate = np.diff(command) / np.diff(time)
    edges = np.flatnonzero(np.abs(np.diff(rate)) > 0.1 * np.abs(rate[1:]) + 1e-4) + 1
    bounds = [0, *edges.tolist(), len(rate)]
    strokes = []
    for first, last in pairwise(bounds):
        speed = float(np.median(rate[first:last])) if last > first else 0.0
        if not 0 < abs(speed) <= FASTEST_RAD_S or time[last] - time[first] < _LEAST_STROKE_S:
            continue
        rows = np.arange(first, last + 1)
        rows = rows[np.isfinite(position[rows])]
        if len(rows) > 20:
            strokes.append(_stroke(trial, rows, speed))
    return [stroke for stroke in strokes if stroke is not None]


def _stroke(trial: Trial, rows: NDArray[np.intp], speed: float) -> _Stroke | None:
    """Sums over one stroke; None if it never gets steady."""
    time, side = trial.send_time_s[rows], float(np.sign(speed))
    command, position = trial.command_rad[rows], trial.position_rad[rows]
    trailing = command - position
    hanging = trial.load.hanging_rad if trial.load else 0.0
    way = side * (position - hanging)
    settled = np.flatnonzero(way > way[0] + _SETTLED_RAD)
    if not len(settled):
        return None
    steady = np.arange(len(rows)) >= settled[0]
    per = max(round(_PIECE_RAD / abs(speed) / float(np.median(np.diff(time)))), 4)
    crossing = None
    gravity = np.sin(position - hanging)
    if trial.load is not None:
        inside = np.flatnonzero((way > -_BEFORE_RAD) & steady)
        after = np.flatnonzero(way > _AFTER_RAD)
        begun = len(inside) > 0 and inside[0] > settled[0] + 5
        steady &= (way < -_BEFORE_RAD) | (way > _AFTER_RAD)
        calm = steady & (time > time[settled[0]] + _CALM_S)
        if begun and calm.sum() > 20 and len(after) and after[0] < len(rows) - 1:
            i, k = int(inside[0]), int(after[0])
            dt = np.diff(time)[i:k]
            level = np.array([gravity[calm].mean(), trailing[calm].mean()])
            excess = [np.sum(dt * (x[i:k] - at)) for x, at in
                      zip((gravity, trailing), level, strict=True)]  # fmt: skip
            crossing = side * np.array(excess)
    table = []
    for part in _runs(steady):
        # means over pieces, so that a piece's speed is known far better than a count's worth
        for piece in np.array_split(part, max(len(part) // per, 1)):
            if len(piece) < per // 2:
                continue
            took = time[piece[-1]] - time[piece[0]]
            rate = (position[piece[-1]] - position[piece[0]]) / took
            means = 1.0, side, gravity[piece].mean(), rate, trailing[piece].mean()
            table.append(np.sqrt(took) * np.array(means))
    normal = np.array(table).reshape(-1, 5)
    return _Stroke(side, abs(speed), normal.T @ normal, crossing)


def _runs(flags: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Indices of each unbroken run of true flags."""
    index = np.flatnonzero(flags)
    return np.split(index, np.flatnonzero(np.diff(index) > 1) + 1) if len(index) else []


class _Fit:
    """Regression over the strokes of one gain, and over bootstrap draws of them."""

    def __init__(self, strokes: Sequence[_Stroke], loaded: bool, rng: np.random.Generator):
        self.count = len(strokes)
        self._use = [0, 1, 2, 3] if loaded else [0, 1, 3]
        self._normal = np.stack([s.normal for s in strokes])
        kinds = [(round(s.speed_rad_s, 3), s.side) for s in strokes]
        weights = np.zeros((_DRAWS, self.count))
        for kind in set(kinds):
            of_kind = np.array([k for k, other in enumerate(kinds) if other == kind])
            drawn = rng.integers(0, len(of_kind), (_DRAWS, len(of_kind)))
            for k, stroke in enumerate(of_kind):
                weights[:, stroke] = (drawn == k).sum(axis=1)
        self.weights = weights
        self.best = self._solve(np.ones(self.count))
        self.draws = np.stack([self._solve(w) for w in weights])
        self._crossings = [(k, s.crossing) for k, s in enumerate(strokes) if s.crossing is not None]

    def _solve(self, weights: _Array) -> _Array:
        """Offset, half hysteresis, gravity over stiffness (if loaded), lag."""
        total = np.tensordot(weights, self._normal, 1)
        use = self._use
        return np.asarray(np.linalg.solve(total[np.ix_(use, use)], total[use, -1]), float)

    def play(self, solved: _Array, weights: _Array, dead_time_s: float) -> float:
        """Backlash [rad]; the mean over the crossings."""
        gravity, lag = solved[-2:]
        slope_lag = max(lag - dead_time_s, 1e-4)
        total = least = 0.0
        for k, (sine, trailing) in self._crossings:
            total += weights[k] * (trailing - gravity * sine) / slope_lag
            least += weights[k]
        return total / least if least else np.nan


def _interval(value: float, draws: _Array, count: int) -> Interval:
    """Bootstrap interval, widened for the few strokes that it is drawn from."""
    centre, spread = float(value), float(np.std(draws))
    freedom = max(count // 2 - 4, 2)
    half = float(stdtrit(freedom, (1 + LEVEL) / 2)) * spread * np.sqrt(count / (count - 6))
    return Interval(centre, centre - half, centre + half)


def _play(
    fits: dict[float, _Fit], damped: bool, rng: np.random.Generator, notes: list[str]
) -> Interval | None:
    """Backlash over the gains at which friction sets the hysteresis."""
    gains, fits_by_gain = np.array(list(fits)), list(fits.values())
    if not any(f._crossings for f in fits_by_gain):
        notes.append("no stroke passes the hanging position far enough to show backlash.")
        return None
    if len(fits_by_gain) > 1:
        inverse = np.stack([np.ones(len(gains)), 1 / gains], axis=1)
        lags = np.stack([np.array([f.best[-1] for f in fits_by_gain]), *(
            np.array([f.draws[d, -1] for f in fits_by_gain]) for d in range(_DRAWS))])  # fmt: skip
        sd = np.maximum(lags[1:].std(axis=0), 1e-4)
        solved = np.linalg.lstsq(inverse / sd[:, None], (lags / sd).T, rcond=None)[0]
        dead = np.clip(solved[0], 0.0, 2 * LONGEST_DEAD_TIME_S)
    else:
        dead = np.r_[LONGEST_DEAD_TIME_S / 2, rng.uniform(0, LONGEST_DEAD_TIME_S, _DRAWS)]
        notes.append(
            "one P gain: the dead time cannot be separated from the motor's lag, and the interval "
            f"of the backlash allows any up to {1e3 * LONGEST_DEAD_TIME_S:.0f} ms."
        )
    values = np.array([f.play(f.best, np.ones(f.count), dead[0]) for f in fits_by_gain])
    draws = np.array(
        [
            [f.play(f.draws[d], f.weights[d], dead[d + 1]) for f in fits_by_gain]
            for d in range(_DRAWS)
        ]
    )
    if damped:
        values *= 1 + _DAMPED_SHARE
        draws *= 1 + _DAMPED_SHARE * rng.uniform(0, 2, (_DRAWS, 1))
    weight = 1 / np.maximum(draws.var(axis=0), 1e-12)
    weight /= weight.sum()
    play = _interval(float(values @ weight), draws @ weight, sum(f.count for f in fits_by_gain))
    return Interval(max(play.value, 0.0), max(play.low, 0.0), max(play.high, 0.0))
