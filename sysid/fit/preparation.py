"""Trials of a joint made ready for its fits: readings dated, commands on the physics clock, noise.

A first fit, to readings dated by the poll lattice, gives the expected motion. With it the lattice
is searched for slips and the readings are dated anew, readings behind commands that never arrived
are left out, and each motion gets the noise that its residuals show. Of several recordings the
readings are those of one servo then, without what the recordings differ by (`PreparedJoint.alike`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.data_sheet import no_load_speed
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.joints import JOINT_NAMES, NO_LOAD_SPEED_RAD_S
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.doctor.checks import joint_rng
from pupper_sysid.sysid.feedback.poll_lattice import (
    PollLattice,
    Readings,
    find_poll_lattice,
    quantum,
    readings,
    redate,
)
from pupper_sysid.sysid.feedback.slips import LostCommands, Motion, find_lost_commands
from pupper_sysid.sysid.fit.claimed_load import check_claimed_load
from pupper_sysid.sysid.fit.goodness import (
    DESCRIBED,
    LEAST_NOISE_RAD,
    goodness_of_fit,
    noise_by_run,
    overall,
)
from pupper_sysid.sysid.fit.operating_point import loaded_joints, reference_gain
from pupper_sysid.sysid.fit.posterior import STEPPING_SD_S, STEPPING_SHARE
from pupper_sysid.sysid.fit.repeats import (
    Apart,
    between_recordings,
    fit_apart,
    mean_point,
)
from pupper_sysid.sysid.fit.run import (
    SHORTEST_STEP_S,
    Run,
    free_run,
    fresh_residuals,
    prepare,
    with_commands,
)
from pupper_sysid.sysid.fit.search import Fit, Problem, refine, search_widely
from pupper_sysid.sysid.fit.servo_prior import ServoPrior
from pupper_sysid.sysid.fit.structure import (
    SIMULATED,
    Scales,
    Structure,
    candidate,
    servo_structure,
)
from pupper_sysid.sysid.lag.lag_budget import LagBudget, lag_budget
from pupper_sysid.sysid.recordings.recording import Trial

_NOISE_RAD = 0.02  # of a first fit where no lag could be measured
_ROUNDS = 3
_LEAST_READINGS = 20  # of a run under load: fewer tell nothing that the others do not
_RIPPLE = 0.7  # autocorrelation below which a logged voltage is ripple, not the supply
_STEPS_S = (TIME_STEP_S, 2 * SHORTEST_STEP_S, SHORTEST_STEP_S)
"""Physics steps of a fit, from the usual one to the shortest."""
_MOST_SHIFT = 0.5
"""Of a number's standard deviation: what an error of the step may be; it adds an eighth to it."""
_JACOBIAN_STEP = 0.01
_FITTED_S = 250.0
"""Duration of all runs together that is fitted; scores and the lag are of all."""


@dataclass(frozen=True)
class PreparedJoint:
    """One joint's trials on the physics clock.

    Attributes
    ----------
    joint : str
    rng : numpy.random.Generator
    lag : LagBudget
        Without dead time.
    scales : Scales
    reference_voltage_v : float
        Supply voltage that the stall torque is for; NaN where torques do not depend on it.
    recorded : tuple of Trial
        The trials that `runs` is of.
    runs : tuple of Run
    noise_rad : tuple of float
        Size of ordinary residuals of each run [rad].
    least_rad : float
        Least noise that a run may have [rad].
    first : dict of str to (Structure, Fit)
        First fits, by the structure's name.
    lost_commands : tuple of LostCommands
        Commands that never arrived; the readings that they touch are not in `runs`.
    load_notes : tuple of str
        What the recordings say against the claimed load, in sentences.
    between_rad : tuple of ndarray
        Of each run, by how far its readings differ from those of the mean servo because of its
        recording (`between_recordings`) [rad]; empty of one recording.
    """

    joint: str
    rng: np.random.Generator
    lag: LagBudget
    scales: Scales
    reference_voltage_v: float
    recorded: tuple[Trial, ...]
    runs: tuple[Run, ...]
    noise_rad: tuple[float, ...]
    least_rad: float
    first: dict[str, tuple[Structure, Fit]]
    lost_commands: tuple[LostCommands, ...]
    load_notes: tuple[str, ...] = ()
    between_rad: tuple[NDArray[np.float64], ...] = ()

    @cached_property
    def alike(self) -> tuple[Run, ...]:
        """The runs with readings as if no recording differed, for every fit and its goodness."""
        if not self.between_rad:
            return self.runs
        return tuple(
            replace(run, sample_rad=run.sample_rad - between)
            for run, between in zip(self.runs, self.between_rad, strict=True)
        )

    @property
    def quantum_rad(self) -> float:
        """Quantisation step of the readings [rad]; 0 where there is none."""
        return self.lag.quantum_rad if np.isfinite(self.lag.quantum_rad) else 0.0

    @property
    def recordings(self) -> tuple[str, ...]:
        """Names of the recordings, if all are of one setup."""
        one_setup = not self.scales.known_load and len({r.p_gain for r in self.runs}) == 1
        return tuple(dict.fromkeys(r.source for r in self.runs)) if one_setup else ()

    def apart(self, structure: Structure, fit: Fit) -> dict[str, Apart]:
        """Fits to the recordings of one setup alone, by name; `fit`: to all of them."""
        if not self.recordings:
            return {}
        problem = Problem(structure, self.runs, self.noise_rad)
        return fit_apart(problem, fit.point, self.least_rad, self.quantum_rad)

    def alike_by(self, structure: Structure, fit: Fit) -> tuple[PreparedJoint, Fit]:
        """The joint with the differences of its recordings by fits to each, and their mean servo.

        `fit`: to all recordings as they were read. The joint itself and `fit` are returned where
        there is one recording, and where the structure does not describe each of them: numbers of
        each would make up for what it lacks.
        """
        apart = self.apart(structure, fit)
        if not apart or any(one.misfit > DESCRIBED for one in apart.values()):
            return self, fit
        points = np.array([mean_point(apart, fit.point), *(one.point for one in apart.values())])
        costs = Problem(structure, self.runs, self.noise_rad).costs(points)
        # of points in one valley the mean is in it, too
        point = points[0] if costs[0] <= costs[1:].max() else fit.point
        between_rad = between_recordings(structure, point, apart, self.runs)
        ready = replace(self, between_rad=between_rad)
        return ready, Fit(point, float(ready.problem(structure).costs(point[None])[0]))

    def without_differences(self) -> PreparedJoint:
        """The joint with its recordings `alike`, and first fits to them."""
        every = [(s, *self.alike_by(s, fit)) for s, fit in self.first.values()]
        structure, ready, mean = min(every, key=lambda one: one[2].cost)
        if not ready.between_rad:
            return self
        residuals = fresh_residuals(structure, structure.decode(mean.point), ready.alike)
        ready = replace(ready, noise_rad=noise_by_run(residuals, ready.runs, ready.least_rad))
        first = {
            s.name: (s, refine(ready.problem(s), np.array([fit.point, of_s.point])))
            for (s, _, of_s), (_, fit) in zip(every, self.first.values(), strict=True)
        }
        return replace(ready, first=first)

    def fit_rng(self) -> np.random.Generator:
        """The same generator for every fit, so that a fit does not depend on those before it."""
        return deepcopy(self.rng)

    def as_any_servo(self) -> PreparedJoint:
        """The same joint as one that may carry an unknown load, with a first fit of such a servo.

        For a joint in free air that DelayedPD does not describe.
        """
        scales = scales_of(self.recorded, self.runs)
        scales = replace(scales, known_load=False, p_gain=1.0, prior=self.scales.prior)
        first = _first_fits(scales, self.alike, self.noise_rad, self.fit_rng())
        return replace(self, scales=scales, first=first, reference_voltage_v=float("nan"))

    def with_noise_of(self, structure: Structure, fit: Fit) -> PreparedJoint:
        """The joint in free air with the noise that a fit leaves, where that is smaller.

        A noise that is many times too large leaves a fit to its prior, and hides what a physics
        step moves.
        """
        ready, fit = self.alike_by(structure, fit)
        residuals = fresh_residuals(structure, structure.decode(fit.point), ready.alike)
        noise = noise_by_run(residuals, self.runs, self.least_rad)
        smaller = tuple(map(min, noise, self.noise_rad))
        problem = replace(ready.problem(structure), noise_rad=smaller)
        dated = self.recorded, self.lag.feedback, self.reference_voltage_v
        step_s = _step_for(problem, fit, *dated)
        runs = self.runs
        if step_s < runs[0].step_s:
            _, runs = _dated(*dated, True, step_s, self.lost_commands)
        return replace(ready, runs=runs, noise_rad=smaller)

    def problem(self, structure: Structure) -> Problem:
        """The fit of a structure to all runs."""
        recordings = len(self.recordings) if self.between_rad else 1
        return Problem(structure, self.alike, self.noise_rad, recordings)

    def bounded(self, structure: Structure) -> Problem:
        """The same without the ends of runs that are very long together."""
        total = sum(r.steps * r.step_s for r in self.runs)
        share = min(_FITTED_S / max(total, 1e-9), 1.0)
        return replace(self.problem(structure), runs=tuple(r.until(share) for r in self.alike))

    def warnings(self) -> Iterator[str]:
        """What went wrong while the joint was recorded, in sentences."""
        yield from self.load_notes
        tone = {
            t.number: f"at {t.frequency_hz:.3g} Hz" if t.frequency_hz > 0 else f"trial {t.number}"
            for t in self.recorded
        }
        for slip in self.lag.feedback.slips:
            yield (
                f"{self.joint}: {tone.get(slip.trial, 'somewhere')} the poll slipped by "
                f"{1e3 * slip.jump_s:.0f} ms at {slip.time_s:.2f} s "
                f"(Δ log-likelihood {slip.nats:.0f}); readings behind it are dated anew."
            )
        for lost in self.lost_commands:
            count = "1 command" if lost.commands == 1 else f"{lost.commands} commands"
            yield (
                f"{self.joint}: {tone[lost.trial]}, {lost.time_s:.2f} s, {count} never reached "
                f"the servo (Δ log-likelihood {lost.nats:.0f}); the {len(lost.readings)} "
                "readings that this touches are left out."
            )


def prepare_joint(
    joint: str,
    trials: Sequence[Trial],
    seed: int,
    free_air: bool | None = None,
    known: Mapping[str, NDArray[np.float64]] | None = None,
    prior: ServoPrior | None = None,
) -> PreparedJoint:
    """Measure the lag of a joint, date its readings, and put its trials on the physics clock.

    `trials`: all of this joint. `free_air`: whether the joint carried no load; by default what its
    trials tell. `known`: values of candidates of free air by name, from an earlier fit to these
    trials; nothing is fitted then. `prior`: numbers of another unit of the servo. Raises InputError
    if there is too little motion, or none of the load that is claimed.
    """
    trials = tuple(trials)
    if free_air is None:
        free_air = not loaded_joints({joint: trials})
    rng = joint_rng(seed, joint)
    lattice = find_poll_lattice(trials, rng.spawn(1)[0])
    lag = _lag(joint, trials, deepcopy(rng), lattice, free_air)
    volts = float("nan") if free_air else reference_voltage(trials)
    recorded, runs = _dated(trials, lattice, volts, free_air)
    if not runs:
        raise InputError(f"{joint}: no readings; record again.")
    scales = _in_free_air(joint, recorded) if free_air else scales_of(recorded, runs)
    scales = replace(scales, prior=prior)
    # fits of a noise-free servo still meet rounding: a third of a quantisation step
    least = max(quantum(trials) / 3, LEAST_NOISE_RAD)
    scale = max(lag.noise_rad, least) if free_air and np.isfinite(lag.noise_rad) else _NOISE_RAD
    noise = (max(scale, least),) * len(runs)
    if known is None:
        first = _first_fits(scales, runs, noise, rng)
    else:
        models = {name: candidate(name, scales) for name in known}
        first = {n: (models[n], Fit(models[n].encode(v), 0.0)) for n, v in known.items()}
    lost_commands: tuple[LostCommands, ...] = ()
    step_s = TIME_STEP_S
    for turn in range(_ROUNDS):
        structure, best = min(first.values(), key=lambda pair: pair[1].cost)
        values = structure.decode(best.point)
        if free_air and known is None and not turn:
            noise = noise_by_run(fresh_residuals(structure, values, runs), runs, least)
            step_s = _step_for(Problem(structure, runs, noise), best, recorded, lattice, volts)
            if step_s < TIME_STEP_S:
                recorded, runs = _dated(trials, lattice, volts, free_air, step_s)
        motions = _motions(recorded, runs, free_run(structure, values, runs))
        dated = redate(recorded, lattice, motions)
        if dated is not lattice and dated.phases != lattice.phases:
            lattice = dated
            recorded, runs = _dated(trials, lattice, volts, free_air, step_s)
        noise = noise_by_run(fresh_residuals(structure, values, runs), runs, least)
        if (
            not lost_commands and free_air
        ):  # under load, friction that the model lacks looks the same
            lost_commands = _lost_commands(recorded, lattice, noise, structure, values, step_s)
        if lost_commands:
            recorded, runs = _dated(trials, lattice, volts, free_air, step_s, lost_commands)
            noise = noise_by_run(fresh_residuals(structure, values, runs), runs, least)
        if known is None:
            first = {
                name: (s, refine(Problem(s, runs, noise), fit.point[None]))
                for name, (s, fit) in first.items()
            }
    if lattice is not lag.feedback:
        lag = _lag(joint, trials, deepcopy(rng), lattice, free_air)
    load_notes: tuple[str, ...] = ()
    if scales.known_load:
        structure, best = next(iter(first.values()))
        load_notes = check_claimed_load(
            joint, recorded, structure, runs, noise, best, least, deepcopy(rng)
        )
    ready = PreparedJoint(
        joint, rng, lag, scales, volts, recorded, runs, noise, least, first, lost_commands,
        load_notes,
    )  # fmt: skip
    return ready.without_differences() if known is None else ready


def reference_voltage(trials: Sequence[Trial]) -> float:
    """Median of the logged or nominal voltages [V]; NaN where torques cannot follow them."""
    medians, ripple = [], []
    for t in trials:
        logged = t.voltage_v
        if logged is not None and np.isfinite(logged).sum() > 10:
            known = logged[np.isfinite(logged)]
            medians.append(float(np.median(known)))
            if known.std() > 0:
                ripple.append(float(np.corrcoef(known[1:], known[:-1])[0, 1]))
        elif t.servo.supply_voltage_v is not None:
            medians.append(t.servo.supply_voltage_v)
        else:
            return float("nan")
    # a voltage that jumps from reading to reading is the ripple of the pulse width
    if ripple and np.median(ripple) < _RIPPLE:
        return float("nan")
    return float(np.median(medians))


def _in_free_air(joint: str, trials: Sequence[Trial]) -> Scales:
    """Scales of free air, with the speed of the servo's model or of a Mini Pupper's joint."""
    model, supply = trials[0].servo.model, trials[0].servo.supply_voltage_v
    speed = no_load_speed(model, supply) if model else None
    if model is None and joint in JOINT_NAMES:
        speed = NO_LOAD_SPEED_RAD_S
    scales = _with_stated_limits(Scales(), trials)
    return scales if speed is None else replace(scales, top_speed_rad_s=speed)


def _with_stated_limits(scales: Scales, trials: Sequence[Trial]) -> Scales:
    """Scales with the limits on the set-point that headers state; NaN if none."""

    def median(limits: Iterable[float | None]) -> float:
        stated = [limit for limit in limits if limit is not None and np.isfinite(limit)]
        return float(np.median(stated)) if stated else float("nan")

    return replace(
        scales,
        acceleration_rad_s2=median(t.servo.set_point_acceleration_rad_s2 for t in trials),
        set_point_speed_rad_s=median(t.servo.set_point_speed_rad_s for t in trials),
    )


def scales_of(trials: Sequence[Trial], runs: Sequence[Run]) -> Scales:
    """Scales of the parameters under load: from the known load, or per inertia without one."""
    known = all(t.load is not None for t in trials) and any(r.load[0] > 0 for r in runs)
    inertia = max(float(r.load[0]) for r in runs) if known else 1.0
    # without gravity the scale is a torque that would reach 10 rad/s within 0.1 s
    torque = max(max(float(r.load[1]) for r in runs), 100.0 * inertia) if known else 1.0
    scales = Scales(
        torque=torque, inertia=inertia, p_gain=reference_gain(trials).value or 1.0, free_air=False,
        known_load=known, torque_off=any((r.torque_on < 0.5).any() for r in runs),
    )  # fmt: skip
    return _with_stated_limits(scales, trials)


def _lag(
    joint: str, trials: tuple[Trial, ...], rng: np.random.Generator, lattice: PollLattice,
    free_air: bool,
) -> LagBudget:  # fmt: skip
    """The lag in these recordings; under load it is no part of the fit, and may be missing."""
    try:
        budget = lag_budget(joint, trials, rng, lattice)
    except InputError:
        if free_air:
            raise
        nan = float("nan")
        none = Interval(nan, nan, nan)
        return LagBudget(
            joint=joint, raw_lag_s=none, fresh_lag_s=none, lag_s=none, stale_lag_s=nan,
            command_hold_s=nan, feedback=lattice, quantum_rad=quantum(trials),
            by_frequency=(), estimators_s={}, noise_rad=nan, warnings=(),
        )  # fmt: skip
    if free_air:
        return budget
    warnings = tuple(
        w for w in budget.warnings if "mechanical stop clips" not in w
    )  # friction holds it
    gains = {t.p_gain for t in trials if np.isfinite(t.p_gain)}
    if len(gains) > 1 or len({str(t.load) for t in trials}) > 1:
        mean = "the lag is a mean over gains and loads; only the dead time is the servo's own."
        warnings = (*warnings, f"{joint}: {mean}")
    return replace(budget, warnings=warnings)


def _lost_commands(
    recorded: Sequence[Trial],
    lattice: PollLattice,
    noise: Sequence[float],
    structure: Structure,
    values: NDArray[np.float64],
    step_s: float,
) -> tuple[LostCommands, ...]:
    """Commands that never arrived, in all trials; none by a model that errs elsewhere, too."""

    def of_trial(trial: Trial, scale: float) -> list[LostCommands]:
        read = _readings(trial, lattice)
        time = read.time_s[read.time_s >= trial.send_time_s[0]]

        as_sent = prepare(trial, read, step_s=step_s).in_free_air()

        def simulate(command: NDArray[np.float64], readings: int) -> NDArray[np.float64]:
            run = with_commands(as_sent, replace(trial, command_rad=command))
            run = replace(
                run, sample_step=run.sample_step[:readings], sample_rad=run.sample_rad[:readings]
            )
            return fresh_residuals(structure, values, [run])[0]

        return find_lost_commands(trial, time, scale, simulate)

    of_trials = [of_trial(t, s) for t, s in zip(recorded, noise, strict=True)]
    lost_commands = tuple(lost for of_one in of_trials for lost in of_one)
    if lost_commands:
        _, others = _dated(recorded, lattice, float("nan"), True, step_s, lost_commands)
        if overall(goodness_of_fit(structure, values, others, quantum(recorded))) > DESCRIBED:
            return ()
    return lost_commands


def _readings(trial: Trial, lattice: PollLattice) -> Readings:
    """Readings with their dates; of an unresolved poll, those of their reads.

    They may be live, and a dead time less half a loop would be negative then. The fitted dead time
    contains their age: `sysid.fit.joint_fit` takes it off again.
    """
    read = readings(trial, lattice)
    if trial.readings == "live":
        return read
    age = lattice.time_doubt_s
    return replace(read, time_s=read.time_s + age, held_time_s=read.held_time_s + age)


def _dated(
    trials: Sequence[Trial], lattice: PollLattice, volts: float, free_air: bool,
    step_s: float = TIME_STEP_S, lost_commands: Sequence[LostCommands] = (),
) -> tuple[tuple[Trial, ...], tuple[Run, ...]]:  # fmt: skip
    """The trials that have readings that count, as recorded and on the physics clock."""
    touched = {
        t.number: [k for u in lost_commands if u.trial == t.number for k in u.readings]
        for t in trials
    }
    least = 1 if free_air else _LEAST_READINGS + 1
    runs = [prepare(t, _readings(t, lattice), volts, step_s) for t in trials]
    pairs = [(t, _without(r, touched[t.number])) for t, r in zip(trials, runs, strict=True)]
    if free_air:
        pairs = [(t, run.in_free_air()) for t, run in pairs]
    used = [(t, r) for t, r in pairs if len(r.sample_step) >= least]
    return tuple(t for t, _ in used), tuple(r for _, r in used)


def _step_for(
    problem: Problem, fit: Fit, recorded: Sequence[Trial], lattice: PollLattice, volts: float
) -> float:
    """The longest physics step that moves no number by much of what is uncertain about it [s].

    A step in which a torque reaches its limit is simulated with an error of its square; where
    readings are exact and the motion is at its limits, that is many times the noise. The shift of
    the numbers that it makes is that of the linearised fit, from the motion in much shorter steps.
    """
    structure = problem.structure

    def shorter(step_s: float) -> Problem:
        dated = ((t, _readings(t, lattice)) for t in recorded)
        runs = tuple(prepare(t, read, volts, step_s).in_free_air() for t, read in dated)
        return replace(problem, runs=runs)

    low, high = structure.box
    away = np.where(fit.point + _JACOBIAN_STEP * structure.scale > high, -1.0, 1.0)
    away = away * _JACOBIAN_STEP * structure.scale
    cloud = np.concatenate([fit.point[None], fit.point + np.diag(away)])
    tracks = shorter(_STEPS_S[-1] / 2).scaled(np.clip(cloud, low, high))
    jacobian = (tracks[1:] - tracks[0]) / away[:, None]
    covariance = np.linalg.pinv(jacobian @ jacobian.T + structure.prior_precision)
    floor = np.where(structure.logarithmic, STEPPING_SHARE, 0.0)
    floor[0] = STEPPING_SD_S / float(structure.decode(fit.point)[0])
    most = _MOST_SHIFT * np.hypot(np.sqrt(np.diag(covariance)), floor)
    for step_s in _STEPS_S[:-1]:
        error = shorter(step_s).scaled(fit.point[None])[0] - tracks[0]
        if (np.abs(covariance @ (jacobian @ error)) <= most).all():
            return step_s
    return _STEPS_S[-1]


def _without(run: Run, touched: Sequence[int]) -> Run:
    """A run without some fresh readings and the rows that show them."""
    if not touched:
        return run
    kept = np.ones(len(run.sample_step), bool)
    kept[touched] = False
    dropped = np.isin(run.held_step, run.sample_step[~kept])
    return replace(
        run, sample_step=run.sample_step[kept], sample_rad=run.sample_rad[kept],
        row_rad=np.where(dropped, np.nan, run.row_rad),
    )  # fmt: skip


def _first_fits(
    scales: Scales, runs: tuple[Run, ...], noise: tuple[float, ...], rng: np.random.Generator
) -> dict[str, tuple[Structure, Fit]]:
    structures = (
        [candidate(name, scales) for name in ("dc_servo", *SIMULATED)]
        if scales.free_air
        else [servo_structure(("back-EMF", "load friction"), scales)]
    )
    first: dict[str, tuple[Structure, Fit]] = {}
    for s in structures:
        problem, generator = Problem(s, runs, noise), deepcopy(rng)
        near = [s.adopt(t, fit.point) for t, fit in first.values() if s.contains(t)]
        # the noise follows from this fit, and with it which fits count as equally good
        first[s.name] = s, search_widely(problem, generator, np.array(near), short=True)
    return first


def _motions(
    recorded: Sequence[Trial], runs: Sequence[Run], tracks: Sequence[NDArray]
) -> list[Motion]:
    """Simulated positions as functions of time on the recording's clock."""

    def motion(trial: Trial, run: Run, track: NDArray) -> Motion:
        edges = trial.send_time_s[0] + run.step_s * np.arange(len(track))
        return lambda time: np.interp(time, edges, track)

    return [motion(*parts) for parts in zip(recorded, runs, tracks, strict=True)]
