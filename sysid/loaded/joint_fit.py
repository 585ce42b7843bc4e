"""Fit a servo under load to all runs of one joint, and choose its structure.

Every structure of `sysid.loaded.structures` is fitted by output error to the runs of all gains and
loads, and scored on runs of gains (or loads, or trials) that it has not seen. The simplest one
within a few percent of the smallest such error is carried. The intervals of its numbers are
quantiles of their posterior, tempered because residuals are correlated, over all structures that
the data do not tell from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.results import Result, internal
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice, quantum
from pupper_sysid.sysid.identify.posterior import STEPPING_SD_S
from pupper_sysid.sysid.loaded import search
from pupper_sysid.sysid.loaded.kernel import OFFSET
from pupper_sysid.sysid.loaded.runs import Run, at_steps, free_run, prepare, residuals
from pupper_sysid.sysid.loaded.search import Fit, Problem
from pupper_sysid.sysid.loaded.structures import Scales, Structure
from pupper_sysid.sysid.recordings.joints import joint_rng
from pupper_sysid.sysid.recordings.recording import Trial

LADDER = (
    (),
    ("stribeck",),
    ("load friction",),
    ("load friction", "static"),
    ("load friction", "quadratic"),
    ("load friction", "torque limit"),
    ("load friction", "quadratic", "static"),
    ("load friction", "quadratic", "torque limit"),
)
"""Structures that are tried, simplest first; then `ADDITIONS` to the best of them."""
PLAIN = ("load friction",)
ADDITIONS = ("acceleration", "damping", "dead zone", "start duty")

_FIRST_NOISE_RAD = 0.02
_LEAST_NOISE_RAD = 3e-4
_NOISE_RATIO = 1.5  # of the noise of a run to that of the others
_PREFERENCE = 1.02
"""Error on unseen runs, over the smallest, up to which a simpler structure is preferred."""
_TELLING_NATS = 5.0
_RUN_FOLDS = 4
_MOST_COMPARED = 3
_SEARCHED_S = 250.0
"""Duration of all runs together that the search uses; the final fit uses all."""
_REMEMBERED_S = 0.5
_STEPPING_SHARE = 0.006
"""Relative error that physics steps leave, whatever the number of readings: standard deviation over
random emulated servos that move in other steps (`benchmarks/loaded_pendulum.py`)."""
_SHARP_DEAD_TIME_S = 0.015
_RIPPLE = 0.7  # autocorrelation below which a logged voltage is ripple, not the supply


@dataclass(frozen=True, kw_only=True)
class StructureFit(Result):
    """One structure, fitted to one joint.

    Attributes
    ----------
    name : str
    parameters : dict of str to float
        Fitted numbers by name.
    mae_rad, rmse_rad : float
        Free run against the readings that count, of all runs.
    mae_unseen_rad : float
        The same on runs that were left out of the fit, mean over runs; NaN without any.
    nats : float
        By how much its log-likelihood is below that of the best; NaN where it was not compared.
    """

    name: str
    parameters: dict[str, float]
    mae_rad: float
    rmse_rad: float
    mae_unseen_rad: float
    nats: float


@dataclass(frozen=True, kw_only=True)
class LoadedFit(Result):
    """A servo under load.

    Attributes
    ----------
    joint : str
    structure : str
        The chosen one.
    known_load : bool
        Whether torques are in N·m; otherwise they are per inertia, and the armature is 1.
    p_gain : float
        Reference P gain; 1 where the recordings do not say it.
    p_gains : tuple of float
        Those of the runs, in order.
    loads : tuple of tuple
        Inertia [kg·m²] and gravity [N·m] of the loads, without repetitions.
    reference_voltage_v : float
        Supply voltage that the stall torque is for; NaN where torques do not depend on it.
    numbers : dict of str to Interval
        Fields of `LoadedServoParameters` that the structure has, and `gravity_nm`, `hanging_rad`,
        `offset_rad`, `stiffness_nm_per_rad` and `damping_nm_s_per_rad` at the reference gain.
    undecided : dict of str to str
        Numbers that the data do not identify, each with the reason.
    structures : tuple of StructureFit
    folds : tuple of str
        What was left out, in words.
    mae_by_run_rad : dict of str to float
    motor_torque_nm : float
        Typical torque of the motor in these runs.
    temperature : float
        How many readings count as one.
    lattice, servo, runs, unread : internal
    """

    joint: str
    structure: str
    known_load: bool
    p_gain: float
    p_gains: tuple[float, ...]
    loads: tuple[tuple[float, float], ...]
    reference_voltage_v: float
    numbers: dict[str, Interval]
    undecided: dict[str, str]
    structures: tuple[StructureFit, ...]
    folds: tuple[str, ...]
    mae_by_run_rad: dict[str, float]
    motor_torque_nm: float
    temperature: float
    lattice: PollLattice = internal()
    servo: LoadedServoParameters = internal()
    runs: tuple[Run, ...] = internal()
    errors: dict[str, float] = internal()
    """RMS errors [rad]: `fresh`, `held`, `raw` and `unseen`."""


def fit_loaded_joint(
    joint: str, trials: Sequence[Trial], seed: int = 0, lattice: PollLattice | None = None
) -> LoadedFit:
    """Fit one joint.

    Parameters
    ----------
    joint : str
    trials : sequence of Trial
        Of all gains and loads.
    seed : int
    lattice : PollLattice, optional
        When readings were measured, if that is known.

    Raises
    ------
    InputError
        If there are no readings.
    """
    rng = joint_rng(seed, joint)
    lattice = lattice or find_poll_lattice(tuple(trials), rng.spawn(1)[0])
    volts = _reference_voltage(trials)
    runs = _prepared(trials, lattice, volts)
    if not runs:
        raise InputError(f"{joint}: no readings; record again.")
    scales = _scales(trials, runs)
    least = max(quantum(tuple(trials)) / 3, _LEAST_NOISE_RAD)
    short = _shortened(runs)
    noise = (max(_FIRST_NOISE_RAD, least),) * len(runs)
    for _ in range(2):
        structure = Structure(("load friction",), scales)
        rough = search.search(Problem(structure, short, noise), rng)[0]
        noise = _noise(structure, rough, short, least)
    tried: dict[tuple[str, ...], Fit] = {}
    for features in LADDER:
        tried[features] = _whole(features, scales, short, noise, rng, tried)
    best = min(tried, key=lambda f: tried[f].cost)
    for feature in ADDITIONS:
        structure = Structure((*best, feature), scales)
        problem = Problem(structure, short, noise)
        start = structure.adopt(Structure(best, scales), tried[best].point[None])
        found = search.refine(problem, start)
        tried[structure.features] = search.evolve(problem, [found], rng, short=True)
        if feature == "acceleration":  # a set-point that lags looks like many other things
            again = (*PLAIN, feature)
            tried[again] = _whole(again, scales, short, noise, rng, tried)
            best = min(tried, key=lambda f: tried[f].cost)
    best = min(tried, key=lambda f: tried[f].cost)
    temperature = _correlation(Structure(best, scales), tried[best], short, noise)
    nats = _nats(tried, temperature)
    likely = sorted(nats, key=lambda f: nats[f])[:_MOST_COMPARED]
    likely = [f for f in tried if f in likely and nats[f] <= _TELLING_NATS]
    folds = _folds(short)
    left_out = {}
    for features in likely:
        left_out[features] = _left_out(Structure(features, scales), short, noise, folds, rng)
    unseen = {f: _unseen(Structure(f, scales), fits, short, folds) for f, fits in left_out.items()}
    lowest = min(unseen.values())
    # without folds the most likely
    features = min(nats, key=lambda f: nats[f])
    if np.isfinite(lowest):
        features = next(f for f in likely if unseen[f] <= _PREFERENCE * lowest)
    chosen = Structure(features, scales)
    own = tried[features]
    for _ in range(2):
        noise = _noise(chosen, own, runs, least)
        own = search.refine(Problem(chosen, runs, noise), own.point[None])
    temperature = _correlation(chosen, own, runs, noise)
    spread = {}
    for f in likely:
        structure = Structure(f, scales)
        problem = Problem(structure, short, noise)
        start = own if f == features else search.refine(problem, tried[f].point[None])
        points, _ = search.sample(problem, start, temperature, rng)
        spread[f] = _numbers(structure, structure.decode(points))
    values = chosen.decode(own.point)
    found = {k: float(v[0]) for k, v in _numbers(chosen, values[None]).items()}
    numbers, undecided = {}, {}
    for name, value in found.items():
        own_draws = spread[features][name]
        ends = [Interval.of_draws(value, d[name]) for d in spread.values() if name in d]
        low, high = (f(x) for f, x in ((min, [e.low for e in ends]), (max, [e.high for e in ends])))
        numbers[name] = _stepped(name, Interval(value, min(low, value), max(high, value)))
        if why := _why_unidentified(name, numbers[name], own_draws, chosen):
            undecided[name] = why
    doubt = _doubt(trials) + lattice.time_doubt_s
    numbers["dead_time_s"] = _grained(numbers["dead_time_s"], doubt)
    if lattice.time_doubt_s > 0:
        undecided["dead_time_s"] = "it is not known when readings were measured"
    per_run = _mean_errors(chosen, own, runs)
    labels = [r.label for r in runs]
    return LoadedFit(
        joint=joint,
        structure=chosen.name,
        known_load=scales.known_load,
        p_gain=scales.p_gain,
        p_gains=tuple(sorted({r.p_gain for r in runs})),
        loads=tuple(sorted({(float(r.load[0]), float(r.load[1])) for r in runs})),
        reference_voltage_v=volts,
        numbers=numbers,
        undecided=undecided,
        structures=tuple(
            _summary(Structure(f, scales), fit, short, nats[f], unseen.get(f, float("nan")))
            for f, fit in tried.items()
        ),
        folds=tuple(folds),
        mae_by_run_rad={
            label: float(np.mean([e for e, x in zip(per_run, labels, strict=True) if x == label]))
            for label in dict.fromkeys(labels)
        },
        motor_torque_nm=_typical_torque(chosen, values, runs),
        temperature=temperature,
        lattice=lattice,
        servo=chosen.servo(values),
        runs=runs,
        errors=_errors(chosen, values, left_out[features], runs, folds),
    )


def _whole(
    features: tuple[str, ...],
    scales: Scales,
    runs: tuple[Run, ...],
    noise: tuple[float, ...],
    rng: np.random.Generator,
    tried: dict[tuple[str, ...], Fit],
) -> Fit:
    """The best fit of a structure to all runs; structures within it are among its starts."""
    structure = Structure(features, scales)
    problem = Problem(structure, runs, noise)
    within = [f for f in tried if set(f) < set(features)]
    more = None
    if within:
        adopted = [structure.adopt(Structure(f, scales), tried[f].point) for f in within]
        more = np.array(adopted)
    return search.evolve(problem, search.search(problem, rng, more), rng)


def _nats(tried: dict[tuple[str, ...], Fit], temperature: float) -> dict[tuple[str, ...], float]:
    """Log-likelihood below the best, one more per feature (Akaike's price of a parameter)."""
    found = {f: fit.cost / temperature + len(f) for f, fit in tried.items()}
    lowest = min(found.values())
    return {f: value - lowest for f, value in found.items()}


def _left_out(
    structure: Structure,
    runs: tuple[Run, ...],
    noise: tuple[float, ...],
    folds: dict[str, NDArray[np.bool_]],
    rng: np.random.Generator,
) -> list[Fit]:
    """Fits without the runs of each fold, from starts of their own."""
    found = []
    for left in folds.values():
        kept = [i for i in range(len(runs)) if not left[i]]
        problem = Problem(structure, tuple(runs[i] for i in kept), tuple(noise[i] for i in kept))
        found.append(search.evolve(problem, search.search(problem, rng), rng, short=True))
    return found


def _unseen(
    structure: Structure,
    fits: Sequence[Fit],
    runs: Sequence[Run],
    folds: dict[str, NDArray[np.bool_]],
) -> float:
    """Mean absolute error on left-out runs, mean over folds [rad]; NaN without folds."""
    errors = []
    for left, fit in zip(folds.values(), fits, strict=True):
        out = [r for r, gone in zip(runs, left, strict=True) if gone]
        errors.append(np.mean(_mean_errors(structure, fit, out)))
    return float(np.mean(errors)) if errors else float("nan")


def _prepared(trials: Sequence[Trial], lattice: PollLattice, volts: float) -> tuple[Run, ...]:
    found = (prepare(t, lattice, volts) for t in trials)
    return tuple(r for r in found if r is not None and len(r.sample_step) > 20)


def _reference_voltage(trials: Sequence[Trial]) -> float:
    """Median of the logged or nominal voltages; NaN where torques cannot follow them."""
    found, ripple = [], []
    for t in trials:
        logged = t.voltage_v
        if logged is not None and np.isfinite(logged).sum() > 10:
            known = logged[np.isfinite(logged)]
            found.append(float(np.median(known)))
            if known.std() > 0:
                ripple.append(float(np.corrcoef(known[1:], known[:-1])[0, 1]))
        elif t.servo.supply_voltage_v is not None:
            found.append(t.servo.supply_voltage_v)
        else:
            return float("nan")
    # a voltage that jumps from reading to reading is the ripple of the pulse width
    if ripple and np.median(ripple) < _RIPPLE:
        return float("nan")
    return float(np.median(found))


def _doubt(trials: Sequence[Trial]) -> float:
    return max(t.read_time_doubt_s for t in trials)


def _scales(trials: Sequence[Trial], runs: Sequence[Run]) -> Scales:
    known = all(t.load is not None for t in trials) and any(r.load[0] > 0 for r in runs)
    gains = sorted(r.p_gain for r in runs)
    middle = gains[len(gains) // 2]
    off = any((r.held[1] < 1).any() for r in runs)
    if not known:
        return Scales(100.0, 1.0, middle, False, off, True)
    inertia = max(float(r.load[0]) for r in runs)
    # without gravity the scale is a torque that would reach 10 rad/s within 0.1 s
    torque = max(max(float(r.load[1]) for r in runs), 100.0 * inertia)
    return Scales(torque, inertia, middle, True, off, False)


def _shortened(runs: tuple[Run, ...]) -> tuple[Run, ...]:
    """The runs with fewer readings at their ends, together no longer than the search needs."""
    total = sum((r.held.shape[1] - r.rest) * r.step_s for r in runs)
    if total <= _SEARCHED_S:
        return runs
    share = _SEARCHED_S / total
    return tuple(_until(r, share) for r in runs)


def _until(run: Run, share: float) -> Run:
    last = share * (run.held.shape[1] - run.rest)
    use = run.sample_step <= last
    return replace(run, sample_step=run.sample_step[use], sample_rad=run.sample_rad[use])


def _folds(runs: Sequence[Run]) -> dict[str, NDArray[np.bool_]]:
    """Which runs are left out: all of a gain between others, and some of every gain and load."""
    labels = [r.label for r in runs]
    count = min(_RUN_FOLDS, len(runs))
    if len(runs) < 2:
        return {}
    names = list(dict.fromkeys(labels))
    turn = [labels[:n].count(x) + names.index(x) for n, x in enumerate(labels)]
    found = {
        f"part {k + 1} of {count}": np.array([t % count == k for t in turn]) for k in range(count)
    }
    gains = sorted({r.p_gain for r in runs})
    for gain in gains[1:-1][:2]:
        found[f"P {gain:g}"] = np.array([r.p_gain == gain for r in runs])
    return {name: left for name, left in found.items() if left.any() and not left.all()}


def _noise(
    structure: Structure, fit: Fit, runs: tuple[Run, ...], least: float
) -> tuple[float, ...]:
    """Size of the residuals of each run, none far from that of the others [rad]."""
    found = []
    for r in residuals(structure, structure.decode(fit.point)[None], runs):
        scale = 1.4826 * np.median(np.abs(r[0]))
        found.append(float(np.sqrt(np.mean(np.minimum(r[0] ** 2, (4 * scale) ** 2 + 1e-12)))))
    middle = max(float(np.median(found)), least)
    return tuple(float(np.clip(x, middle / _NOISE_RATIO, middle * _NOISE_RATIO)) for x in found)


def _mean_errors(structure: Structure, fit: Fit, runs: Sequence[Run]) -> list[float]:
    """Mean absolute error of each run [rad]."""
    found = residuals(structure, structure.decode(fit.point)[None], runs)
    return [float(np.mean(np.abs(r))) for r in found]


def _correlation(
    structure: Structure, fit: Fit, runs: Sequence[Run], noise: Sequence[float]
) -> float:
    """Readings per independent one: 1 + 2 Σ ρ(k), up to where the autocorrelation ρ vanishes.

    No further than half a second: what friction leaves for longer hardly moves with a parameter.
    """
    found = residuals(structure, structure.decode(fit.point)[None], runs)
    apart = float(np.median(np.concatenate([np.diff(r.sample_step) * r.step_s for r in runs])))
    longest = int(min(_REMEMBERED_S / max(apart, 1e-4), min(r.shape[1] for r in found) - 1))
    total, lagged = 0.0, np.zeros(longest)
    for r, s in zip(found, noise, strict=True):
        x = np.clip(r[0] / s, -4, 4)
        total += float(x @ x)
        for lag in range(1, longest + 1):
            lagged[lag - 1] += float(x[lag:] @ x[:-lag])
    rho = lagged / max(total, 1e-18)
    positive = np.cumprod(rho > 0.05)
    return float(max(1.0, 1.0 + 2.0 * np.sum(rho * positive)))


def _numbers(structure: Structure, values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """What a fit says, (draws,) each, under the names of `LoadedServoParameters`."""
    from pupper_sysid.servo_models.loaded_servo import COLUMNS

    columns = structure.columns(values)
    fitted = set(structure.names)
    shown = {"dead_time_s": values[:, 0]}
    also = {"duty_per_rad", "stall_torque", "back_emf", "friction_loss"}
    also |= {"armature"} if structure.scales.known_load else set()
    also |= {"off_brake"} if structure.scales.torque_off else set()
    for column, name in (("stribeck_speed", "stribeck_speed_rad_s"), ("duty_s_per_rad", "damping"),
                         ("torque_limit", "torque_limit_share")):  # fmt: skip
        also |= {column} if name in fitted else set()
    for j, name in enumerate(COLUMNS):
        if name in also or name in fitted:
            shown[name] = columns[:, j]
    gain = structure.scales.p_gain
    shown["stiffness_nm_per_rad"] = columns[:, 0] * gain * columns[:, 2]
    shown["no_load_speed_rad_s"] = columns[:, 2] / columns[:, 3]
    if structure.scales.gravity:
        shown["gravity_nm"] = columns[:, OFFSET - 2]
    shown["hanging_rad"] = columns[:, OFFSET - 1]
    shown["offset_rad"] = columns[:, OFFSET]
    return shown


def _why_unidentified(
    name: str, interval: Interval, draws: NDArray[np.float64], structure: Structure
) -> str | None:
    if name in ("hanging_rad", "offset_rad"):
        return None
    if name == "dead_time_s" and interval.high - interval.low < _SHARP_DEAD_TIME_S:
        return None  # a short one may well be close to none
    if interval.low > 0 and interval.high > 4 * interval.low:
        return "its interval is wider than a factor of 4"
    if interval.low <= 0 and name not in ("off_brake",):
        return "it cannot be told from none"
    for p in structure.parameters:
        if p.name == name and p.logarithmic and np.std(np.log(draws)) > 0.7 * p.prior_sd:
            return "these recordings do not excite it; the value is the prior's"
    return None


def _stepped(name: str, interval: Interval) -> Interval:
    """A torque, inertia or ratio with the error of a model that moves in steps."""
    if name in ("dead_time_s", "hanging_rad", "offset_rad") or interval.value <= 0:
        return interval
    grain = float(ndtri(0.5 + LEVEL / 2)) * _STEPPING_SHARE * interval.value
    low, high = interval.value - interval.low, interval.high - interval.value
    return Interval(
        interval.value,
        max(interval.value - float(np.hypot(low, grain)), 0.0),
        interval.value + float(np.hypot(high, grain)),
    )


def _grained(interval: Interval, doubt_s: float) -> Interval:
    """A dead time with the error that physics steps and doubtful dates leave."""
    grain = float(ndtri(0.5 + LEVEL / 2)) * STEPPING_SD_S
    low = interval.value - float(np.hypot(interval.value - interval.low, grain)) - doubt_s
    high = interval.value + float(np.hypot(interval.high - interval.value, grain)) + doubt_s
    return Interval(interval.value, max(low, 0.0), high)


def _summary(
    structure: Structure, fit: Fit, runs: tuple[Run, ...], nats: float, unseen: float
) -> StructureFit:
    values = structure.decode(fit.point)
    found = residuals(structure, values[None], runs)
    every = np.concatenate([r[0] for r in found])
    return StructureFit(
        name=structure.name,
        parameters={n: float(v) for n, v in zip(structure.names, values, strict=True)},
        mae_rad=float(np.mean([np.mean(np.abs(r)) for r in found])),
        rmse_rad=float(np.sqrt(np.mean(every**2))),
        mae_unseen_rad=unseen,
        nats=nats,
    )


def _typical_torque(
    structure: Structure, values: NDArray[np.float64], runs: Sequence[Run]
) -> float:
    """Median torque of the motor while its torque is on."""
    servo = structure.servo(values)
    found = []
    for run, track in zip(runs, free_run(structure, values, runs), strict=True):
        speed = np.gradient(track, run.step_s)[:-1]
        command = run.held[0, run.rest :]
        duty = np.asarray(servo.duty_per_rad) * run.p_gain * (command - track[:-1])
        torque = np.asarray(servo.stall_torque) * np.clip(duty, -1, 1)
        torque = torque - np.asarray(servo.back_emf) * speed
        found.append(np.abs(torque)[run.held[1, run.rest :] > 0.5])
    return float(np.median(np.concatenate(found)))


def _errors(
    structure: Structure,
    values: NDArray[np.float64],
    left_out: Sequence[Fit],
    runs: tuple[Run, ...],
    folds: dict[str, NDArray[np.bool_]],
) -> dict[str, float]:
    """RMS errors on fresh readings, on all rows held and raw, and on unseen runs [rad]."""
    fresh, held, raw, unseen = [], [], [], []
    for run, track in zip(runs, free_run(structure, values, runs), strict=True):
        fresh.append(at_steps(track, run.sample_step) - run.sample_rad)
        held.append(at_steps(track, run.held_step) - run.row_rad)
        raw.append(at_steps(track, run.row_step) - run.row_rad)
    for left, fit in zip(folds.values(), left_out, strict=True):
        out = [r for r, gone in zip(runs, left, strict=True) if gone]
        unseen += [r[0] for r in residuals(structure, structure.decode(fit.point)[None], out)]

    def rms(parts: list[NDArray]) -> float:
        every = np.concatenate([np.empty(0), *parts])
        every = every[np.isfinite(every)]
        return float(np.sqrt(np.mean(every**2))) if len(every) else float("nan")

    return {"fresh": rms(fresh), "held": rms(held), "raw": rms(raw), "unseen": rms(unseen)}
