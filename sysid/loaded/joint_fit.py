"""Fit a servo under load to all runs of one joint, and choose its structure.

Every structure of `sysid.loaded.structures` is fitted by output error to the runs of all gains and
loads, and scored on runs of gains (or loads, or trials) that it has not seen. The simplest one
within a few percent of the smallest such error is carried. The intervals of its numbers are
quantiles of their posterior, tempered because residuals are correlated, over all structures that
the data do not tell from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result, internal
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice, quantum
from pupper_sysid.sysid.loaded import search
from pupper_sysid.sysid.loaded.errors import (
    correlation,
    errors_of,
    mean_errors,
    noise_of,
    typical_torque,
)
from pupper_sysid.sysid.loaded.numbers import grained, numbers_of, stepped, why_unidentified
from pupper_sysid.sysid.loaded.preparation import (
    folds_of,
    prepared_runs,
    read_time_doubt,
    reference_voltage,
    scales_of,
    shortened,
)
from pupper_sysid.sysid.loaded.ramps import settled
from pupper_sysid.sysid.loaded.runs import Run, residuals
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
_PREFERENCE = 1.02
"""Error on unseen runs, over the smallest, up to which a simpler structure is preferred."""
_TELLING_NATS = 5.0
_MOST_COMPARED = 3


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
    volts = reference_voltage(trials)
    runs = prepared_runs(trials, lattice, volts)
    if not runs:
        raise InputError(f"{joint}: no readings; record again.")
    scales = scales_of(trials, runs)
    least = max(quantum(tuple(trials)) / 3, _LEAST_NOISE_RAD)
    short = shortened(runs)
    noise = (max(_FIRST_NOISE_RAD, least),) * len(runs)
    structure = Structure(PLAIN, scales)
    rough = search.search(Problem(structure, short, noise), rng)[0]
    noise = noise_of(structure, rough, short, least)
    rough = search.search(Problem(structure, short, noise), rng)[0]
    noise = noise_of(structure, rough, short, least)
    scales, runs, noise = settled(rough, structure, runs, noise, least, rng)
    ramp: tuple[str, ...] = ()
    if np.isfinite(scales.acceleration_rad_s2):
        ramp, short = ("acceleration",), runs  # what shows the limit may be at the end of a run
    tried: dict[tuple[str, ...], Fit] = {}
    for features in ((*f, *ramp) for f in LADDER):
        tried[features] = _whole(features, scales, short, noise, rng, tried)
    best = min(tried, key=lambda f: tried[f].cost)
    for feature in (f for f in ADDITIONS if f not in ramp):
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
    temperature = correlation(Structure(best, scales), tried[best], short, noise)
    nats = _nats(tried, temperature)
    likely = sorted(nats, key=lambda f: nats[f])[:_MOST_COMPARED]
    likely = [f for f in tried if f in likely and nats[f] <= _TELLING_NATS]
    folds = folds_of(short)
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
        noise = noise_of(chosen, own, runs, least)
        own = search.refine(Problem(chosen, runs, noise), own.point[None])
    temperature = correlation(chosen, own, runs, noise)
    spread = {}
    for f in likely:
        structure = Structure(f, scales)
        problem = Problem(structure, short, noise)
        start = own if f == features else search.refine(problem, tried[f].point[None])
        points, _ = search.sample(problem, start, temperature, rng)
        spread[f] = numbers_of(structure, structure.decode(points))
    values = chosen.decode(own.point)
    found = {k: float(v[0]) for k, v in numbers_of(chosen, values[None]).items()}
    numbers, undecided = {}, {}
    for name, value in found.items():
        own_draws = spread[features][name]
        ends = [Interval.of_draws(value, d[name]) for d in spread.values() if name in d]
        low, high = (f(x) for f, x in ((min, [e.low for e in ends]), (max, [e.high for e in ends])))
        numbers[name] = stepped(name, Interval(value, min(low, value), max(high, value)))
        if why := why_unidentified(name, numbers[name], own_draws, chosen):
            undecided[name] = why
    doubt = read_time_doubt(trials) + lattice.time_doubt_s
    numbers["dead_time_s"] = grained(numbers["dead_time_s"], doubt)
    if lattice.time_doubt_s > 0:
        undecided["dead_time_s"] = "it is not known when readings were measured"
    per_run = mean_errors(chosen, own, runs)
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
        motor_torque_nm=typical_torque(chosen, values, runs),
        temperature=temperature,
        lattice=lattice,
        servo=chosen.servo(values),
        runs=runs,
        errors=errors_of(chosen, values, left_out[features], runs, folds),
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
        errors.append(np.mean(mean_errors(structure, fit, out)))
    return float(np.mean(errors)) if errors else float("nan")


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
