"""Output-error identification: fit a servo model in free run from rest.

One cost serves the fit, the scores and the tests: the model is simulated under the zero-order-held,
truncated commands, looked up at the measurement time of each fresh reading, and compared with it
under a soft-L1 loss (a late poll must not steer the fit). Many fits run at once (joints, left-out
frequencies, starts, points of a likelihood profile) with one simulation call per iteration, which
makes pure NumPy fast enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution

from pupper_sysid.servo_models.delay_line import fractional_shift
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.identify.models import CandidateModel
from pupper_sysid.sysid.recordings.recording import Trial

_PAD = 64  # steps of rest before each trial: the longest delay of the models, 0.12 s
DIFFERENCE = 0.01  # relative step of the Jacobian; smaller ones drown in friction's stick-slip
_WIDE_DIFFERENCE = 0.03  # for the covariance: the slope over a likely error, not of one kink
_DELAY_GRID = 2.0  # steps between the delays tried for a start
_BATCH = 3000  # simulations per call: more would leave the processor's cache


@dataclass(frozen=True)
class TrialData:
    """One trial, ready for simulation.

    Attributes
    ----------
    frequency_hz : float
    rest_rad : float
        Command before the trial; the simulation is relative to it.
    command : ndarray, shape (steps,)
        Held, truncated command averaged over each physics step, relative to rest [rad].
    sample_step, sample_rad : ndarray, shape (samples,)
        Fresh readings: time in physics steps from the start, and position relative to rest.
    held_step, row_step : ndarray, shape (rows,)
        Per row: when the value it shows was measured, and when it was sent.
    row_rad : ndarray, shape (rows,)
        Position of each row relative to rest [rad], NaN where missing.
    """

    frequency_hz: float
    rest_rad: float
    command: NDArray[np.float64]
    sample_step: NDArray[np.float64]
    sample_rad: NDArray[np.float64]
    held_step: NDArray[np.float64]
    row_step: NDArray[np.float64]
    row_rad: NDArray[np.float64]


_WHOLE_COUNT = {
    "up": lambda count: np.ceil(count - 1e-6),
    "down": lambda count: np.floor(count + 1e-6),
    "nearest": np.rint,
}


def prepare(trial: Trial, reading: Readings) -> TrialData:
    """Put one trial on the physics clock."""
    rest, start = trial.initial_command_rad, trial.send_time_s[0]
    command = whole_counts(trial) - rest
    stop = max(trial.read_time_s[-1], trial.send_time_s[-1]) - start
    steps = int(np.ceil(stop / TIME_STEP_S)) + 2
    edges = TIME_STEP_S * np.arange(steps + 1)
    sent = np.append(trial.send_time_s - start, edges[-1] + 1.0)
    area = np.concatenate([[0.0], np.cumsum(command * np.diff(sent))])
    average = np.diff(np.interp(edges, sent, area)) / TIME_STEP_S

    def to_step(time: NDArray) -> NDArray[np.float64]:
        return np.clip((time - start) / TIME_STEP_S, 0.0, steps)

    inside = reading.time_s >= start
    return TrialData(
        trial.frequency_hz, rest, average,
        to_step(reading.time_s[inside]), reading.position_rad[inside] - rest,
        to_step(np.where(np.isfinite(reading.held_time_s), reading.held_time_s, start)),
        to_step(trial.send_time_s), trial.position_rad - rest,
    )  # fmt: skip


def whole_counts(trial: Trial) -> NDArray[np.float64]:
    """Commands as the bus sent them [rad]."""
    cut = trial.truncation
    if cut.quantum_rad <= 0 or cut.rounding not in _WHOLE_COUNT:
        return trial.command_rad
    zero = trial.initial_command_rad if cut.zero_rad is None else cut.zero_rad
    count = (trial.command_rad - zero) / cut.quantum_rad
    return _WHOLE_COUNT[cut.rounding](count) * cut.quantum_rad + zero


@dataclass(frozen=True)
class Problem:
    """One fit: some trials of one joint (`use`), some parameters perhaps frozen.

    Attributes
    ----------
    trials : tuple of TrialData
    use : tuple of bool
        Which trials count in the fit.
    noise_rad : float
        Scale of the residuals: the soft-L1 loss bends here, the prior is weighed against it.
    frozen : dict of str to float
        Parameters held at a value.
    """

    trials: tuple[TrialData, ...]
    use: tuple[bool, ...]
    noise_rad: float
    frozen: dict[str, float]


@dataclass(frozen=True)
class Fit:
    """Result of one problem.

    Attributes
    ----------
    values : ndarray, shape (parameters,)
    cost : float
        Half the sum of robust squared residuals in units of the noise, plus the prior.
    covariance : ndarray, shape (parameters, parameters)
        Of the fitted coordinates (logarithms), for independent residuals of the noise's size.
    """

    values: NDArray[np.float64]
    cost: float
    covariance: NDArray[np.float64]


def positions(
    model: CandidateModel, groups: Sequence[tuple[NDArray, Sequence[TrialData]]]
) -> list[NDArray[np.float64]]:
    """Simulate every parameter vector of a group on every trial of that group, all in one go.

    Parameters
    ----------
    model : CandidateModel
    groups : sequence of (values, trials)
        `values` has shape (candidates, parameters).

    Returns
    -------
    list of ndarray, shape (steps + 1, candidates, trials) each
        Position relative to rest, the offset included, at step edges [rad]; `steps` is that of
        the longest trial of all groups.
    """
    steps = max(len(t.command) for _, trials in groups for t in trials)
    widths = [len(values) * len(trials) for values, trials in groups]
    ends = np.cumsum(widths)
    # Small steps cost a call each, whatever their width: one wide simulation serves all groups.
    track = np.zeros((steps + 1, ends[-1]))
    parameters = np.empty((len(model.parameters) - 2, ends[-1]))
    for (values, trials), end, width in zip(groups, ends, widths, strict=True):
        commands = np.zeros((_PAD + steps, len(trials)))
        for n, trial in enumerate(trials):
            commands[_PAD : _PAD + len(trial.command), n] = trial.command
            commands[_PAD + len(trial.command) :, n] = trial.command[-1]
        delay = np.repeat(values[:, 0] / TIME_STEP_S, len(trials))
        column = np.tile(np.arange(len(trials)), len(values))
        track[1:, end - width : end] = fractional_shift(commands, steps, delay, column)
        parameters[:, end - width : end] = np.repeat(values[:, 1:-1].T, len(trials), axis=1)
    for i in range(0, ends[-1], _BATCH):
        model.simulate(parameters[:, i : i + _BATCH], track[1:, i : i + _BATCH])
    out = []
    for (values, trials), end, width in zip(groups, ends, widths, strict=True):
        own = track[:, end - width : end].reshape(steps + 1, len(values), len(trials))
        own += values[:, -1, None]
        out.append(own)
    return out


def free_run(
    model: CandidateModel, values: NDArray, trials: Sequence[TrialData]
) -> NDArray[np.float64]:
    """One simulation of each trial, shape (steps + 1, trials): see `positions`."""
    return positions(model, [(values[None], trials)])[0][:, 0]


def look_up(track: NDArray, step: NDArray) -> NDArray[np.float64]:
    """Values of `track` (steps, ...) at fractional steps, shape (samples, ...)."""
    whole = np.minimum(step.astype(int), len(track) - 2)
    fraction = (step - whole).reshape(-1, *[1] * (track.ndim - 1))
    return track[whole] + fraction * (track[whole + 1] - track[whole])


@dataclass(frozen=True)
class _Space:
    """A model's fitted coordinates: their bounds and prior, arrays of shape (parameters,)."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    centre: NDArray[np.float64]
    precision: NDArray[np.float64]

    @classmethod
    def of(cls, model: CandidateModel) -> _Space:
        par = model.parameters
        low, high, centre = (
            np.array([float(p.encode(getattr(p, name))) for p in par])
            for name in ("low", "high", "nominal")
        )
        return cls(low, high, centre, np.array([p.prior_sd**-2.0 for p in par]))

    def cost(self, r: NDArray, points: NDArray) -> NDArray[np.float64]:
        """Soft-L1 of residuals in units of the noise, and prior; sums over the last axes."""
        prior = 0.5 * np.sum(self.precision * (points - self.centre) ** 2, axis=-1)
        return np.sum(np.sqrt(1 + r**2) - 1, axis=-1) + prior


def fit(
    model: CandidateModel,
    problems: Sequence[Problem],
    starts: NDArray,
    iterations: int = 40,
    difference: float = DIFFERENCE,
) -> list[Fit]:
    """Levenberg-Marquardt on all problems at once.

    Parameters
    ----------
    model : CandidateModel
    problems : sequence of Problem
    starts : ndarray, shape (problems, parameters)
        Values to start from.
    iterations : int
        At most; problems that no longer improve drop out.
    difference : float
        Step of the Jacobian in fitted coordinates: a wide one looks past a rugged cost's dents.

    Returns
    -------
    list of Fit, one per problem
    """
    par, space = model.parameters, _Space.of(model)
    k, low, high = len(par), space.low, space.high
    scale = np.where([p.logarithmic for p in par], 1.0, 0.01)
    z = np.array([[float(p.encode(v)) for p, v in zip(par, row, strict=True)] for row in starts])
    free = np.ones((len(problems), k), bool)
    for i, problem in enumerate(problems):
        for name, value in problem.frozen.items():
            j = model.names.index(name)
            free[i, j], z[i, j] = False, float(par[j].encode(value))
    z = np.where(free, np.clip(z, low, high), z)

    def evaluate(index: NDArray, points: NDArray, difference: float = difference):
        """Cost, gradient and curvature of the problems `index` at `points`."""
        step = difference * scale
        # the offset, last, moves every residual alike: no simulation needed for its column
        cloud = points[:, None, :] + np.concatenate([np.zeros((1, k)), np.diag(step)[:-1]])
        residuals = _residuals(model, [problems[i] for i in index], cloud)
        costs, gradients, curvatures = [], [], []
        for n, i in enumerate(index):
            r = residuals[n] / problems[i].noise_rad
            slopes = (r[1:] - r[0]).T / step[:-1]
            constant = np.full((r.shape[1], 1), 1.0 / problems[i].noise_rad)
            jacobian = np.hstack([slopes, constant]) * free[i]
            weight = 1.0 / np.sqrt(1.0 + r[0] ** 2)
            pull = space.precision * (points[n] - space.centre) * free[i]
            costs.append(space.cost(r[0], points[n]))
            gradients.append(jacobian.T @ (weight * r[0]) + pull)
            curvatures.append((jacobian.T * weight) @ jacobian + np.diag(space.precision * free[i]))
        return np.array(costs), np.array(gradients), np.array(curvatures)

    everyone = np.arange(len(problems))
    cost, gradient, curvature = evaluate(everyone, z)
    damp = np.full(len(problems), 1e-2)
    stalled = np.zeros(len(problems), int)
    for _ in range(iterations):
        active = np.flatnonzero(stalled < 2)
        if not len(active):
            break
        new = z[active].copy()
        for n, i in enumerate(active):
            diagonal = np.diag(curvature[i]) + 1e-9
            # a coordinate pressed against its bound must not hold back the others
            pressed = ((z[i] <= low) & (gradient[i] > 0)) | ((z[i] >= high) & (gradient[i] < 0))
            go = free[i] & ~pressed
            matrix = curvature[i] + np.diag(damp[i] * diagonal)
            step = np.zeros(k)
            step[go] = np.linalg.solve(matrix[np.ix_(go, go)], -gradient[i][go])
            longest = np.max(np.abs(step) / scale)
            new[n] = np.clip(z[i] + step * min(1.0, 1.0 / max(longest, 1e-12)), low, high)
            new[n] = np.where(free[i], new[n], z[i])
        cost_new, gradient_new, curvature_new = evaluate(active, new)
        for n, i in enumerate(active):
            gained = cost[i] - cost_new[n]
            if gained > 0:
                z[i], cost[i] = new[n], cost_new[n]
                gradient[i], curvature[i] = gradient_new[n], curvature_new[n]
                damp[i] = max(damp[i] / 4, 1e-6)
            else:
                damp[i] = min(damp[i] * 6, 1e6)
            # 0.05 of log-likelihood is far below anything an interval would notice
            stalled[i] = stalled[i] + 1 if gained < 0.05 else 0
    fits = []
    curvature = evaluate(everyone, z, _WIDE_DIFFERENCE)[2]
    for i in everyone:
        regular = curvature[i] + np.diag(np.where(free[i], 1e-9, 1.0))
        covariance = np.linalg.pinv(regular) * np.outer(free[i], free[i])
        values = np.array([float(p.decode(v)) for p, v in zip(par, z[i], strict=True)])
        fits.append(Fit(values, float(cost[i]), covariance))
    return fits


def evolve(
    model: CandidateModel,
    problem: Problem,
    starts: NDArray,
    rng: np.random.Generator,
    generations: int,
) -> Fit:
    """The best of a population that starts at `starts` and evolves, fitted to the end.

    Differential evolution finds its way between the local optima of a servo with dry friction,
    where a gradient does not.

    Parameters
    ----------
    model : CandidateModel
    problem : Problem
        Without frozen parameters.
    starts : ndarray, shape (population, parameters)
    rng : numpy.random.Generator
    generations : int
    """
    par, space = model.parameters, _Space.of(model)

    def cost(points: NDArray) -> NDArray:  # (parameters, candidates)
        r = _residuals(model, [problem], points.T[None])[0] / problem.noise_rad
        return space.cost(r, points.T)

    population: Any = np.clip(  # SciPy's annotations know names of methods only
        np.stack([p.encode(column) for p, column in zip(par, starts.T, strict=True)], 1),
        space.low, space.high,
    )  # fmt: skip
    found = differential_evolution(
        cost, list(zip(space.low, space.high, strict=True)), init=population, rng=rng,
        maxiter=generations, mutation=(0.4, 0.9), recombination=0.9, tol=0.0, polish=False,
        vectorized=True, updating="deferred",
    )  # fmt: skip
    values = np.array([float(p.decode(x)) for p, x in zip(par, found.x, strict=True)])
    return fit(model, [problem], values[None])[0]


def global_starts(
    model: CandidateModel,
    problems: Sequence[Problem],
    rng: np.random.Generator,
    candidates: int,
    keep: int,
) -> NDArray[np.float64]:
    """The `keep` best of `candidates` quasi-random parameter vectors, per problem.

    The vectors fill the box of fitted coordinates, within two standard deviations of the prior
    where there is one. Each gets its best delay and offset: a delay only shifts the motion in time,
    so that one simulation serves all delays and the most rugged coordinate is not searched.

    Returns
    -------
    ndarray, shape (problems, keep, parameters)
    """
    par = model.parameters
    from scipy.stats import qmc  # half a second to import

    unit = qmc.Sobol(len(par), rng=rng).random(candidates)
    columns = []
    for p, u in zip(par, unit.T, strict=True):
        low, high = float(p.encode(p.low)), float(p.encode(p.high))
        if np.isfinite(p.prior_sd):
            middle = float(p.encode(p.nominal))
            low, high = max(low, middle - 2 * p.prior_sd), min(high, middle + 2 * p.prior_sd)
        elif p.name == "offset_rad":
            low = high = 0.0
        columns.append(low + u * (high - low))
    cloud = np.stack(columns, axis=1)
    cloud[0] = [float(p.encode(p.nominal)) for p in par]
    values = np.stack([p.decode(c) for p, c in zip(par, cloud.T, strict=True)], axis=-1)
    values[:, 0] = par[0].low
    later = np.arange(0.0, (par[0].high - par[0].low) / TIME_STEP_S, _DELAY_GRID)
    every = {id(problem.trials): problem.trials for problem in problems}
    tracks = positions(model, [(values, trials) for trials in every.values()])
    errors = {
        key: [_errors_if_later(track[:, :, n], t, later) for n, t in enumerate(trials)]
        for (key, trials), track in zip(every.items(), tracks, strict=True)
    }
    best = []
    for problem in problems:
        own = [e for e, use in zip(errors[id(problem.trials)], problem.use, strict=True) if use]
        count = sum(e.shape[-1] for e in own)
        mean = sum(e.sum(axis=-1) for e in own) / count
        spread = sum(np.square(e).sum(axis=-1) for e in own) / count - mean**2
        at = np.argmin(spread, axis=0)
        r = np.concatenate([e[at, np.arange(candidates)] for e in own], axis=-1)
        offset = -np.median(r, axis=1)
        robust = np.sqrt(1 + ((r + offset[:, None]) / problem.noise_rad) ** 2).sum(axis=1)
        order = np.argsort(robust)[:keep]
        chosen = values[order].copy()
        chosen[:, 0] += TIME_STEP_S * later[at[order]]
        chosen[:, -1] += offset[order]
        best.append(chosen)
    return np.array(best)


def _errors_if_later(track: NDArray, trial: TrialData, later: NDArray) -> NDArray[np.float64]:
    """Model minus fresh reading if the model had moved `later` steps later.

    `track` has shape (steps, candidates), the result (later, candidates, samples).
    """
    moments = np.maximum(trial.sample_step - later[:, None], 0.0)
    looked = look_up(track, moments.reshape(-1)).reshape(len(later), len(trial.sample_step), -1)
    return looked.transpose(0, 2, 1) - trial.sample_rad


def _residuals(
    model: CandidateModel, problems: Sequence[Problem], points: NDArray
) -> list[NDArray]:
    """Model minus fresh reading of each problem's used trials, (candidates, samples) each."""
    values = np.stack([p.decode(points[..., j]) for j, p in enumerate(model.parameters)], axis=-1)
    groups: dict[tuple[int, tuple[bool, ...]], list[int]] = {}
    for i, problem in enumerate(problems):  # fits to the same trials are one simulation
        groups.setdefault((id(problem.trials), problem.use), []).append(i)
    used = {
        key: [t for t, use in zip(problems[members[0]].trials, key[1], strict=True) if use]
        for key, members in groups.items()
    }
    tracks = positions(
        model, [(values[m].reshape(-1, values.shape[-1]), used[key]) for key, m in groups.items()]
    )
    found: dict[int, NDArray] = {}
    for (key, members), track in zip(groups.items(), tracks, strict=True):
        parts = [
            look_up(track[:, :, n], t.sample_step).T - t.sample_rad for n, t in enumerate(used[key])
        ]
        each = np.concatenate(parts, axis=1).reshape(len(members), points.shape[1], -1)
        found.update(zip(members, each, strict=True))
    return [found[i] for i in range(len(problems))]
