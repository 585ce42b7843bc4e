"""Trials of a joint made ready for its fits: readings dated, commands on the physics clock, noise.

A first fit of the simulated models, to readings dated by the poll lattice, gives the expected
motion. With it the lattice is searched for slips and the readings are dated anew, readings behind
commands that never arrived are left out, and each tone gets the noise that its residuals show.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.feedback.poll_lattice import (
    PollLattice,
    find_poll_lattice,
    quantum,
    readings,
    redate,
)
from pupper_sysid.sysid.feedback.slips import Motion
from pupper_sysid.sysid.feedback.upsets import Upset, find_upsets
from pupper_sysid.sysid.identify.candidates.models import CandidateModel, candidate_model
from pupper_sysid.sysid.identify.candidates.simulation import TrialData, free_run, prepare
from pupper_sysid.sysid.identify.noise import noise_by_trial
from pupper_sysid.sysid.identify.output_error import Fit, Problem, fit
from pupper_sysid.sysid.identify.search import SIMULATED, fit_problems, fresh_residuals
from pupper_sysid.sysid.lag.lag_budget import LagBudget, lag_budget
from pupper_sysid.sysid.recordings.joints import joint_rng
from pupper_sysid.sysid.recordings.recording import Trial

_NOISE_RAD = 0.012  # where no lag could be measured, as on the first real joints
_LEAST_NOISE_RAD = 3e-4
_KEEP, _FINAL = 12, 2  # starts of the first fit
_ROUNDS = 3


@dataclass(frozen=True)
class PreparedJoint:
    """One joint's trials on the physics clock.

    Attributes
    ----------
    rng : numpy.random.Generator
    lag : LagBudget
        Without dead time.
    recorded : tuple of Trial
        The trials that `data` is of.
    data : tuple of TrialData
    noise_rad : tuple of float
        Size of ordinary residuals of each trial [rad].
    first : dict of str to Fit
        First fits of the simulated models.
    upsets : tuple of Upset
        Commands that never arrived; the readings that they touch are not in `data`.
    """

    rng: np.random.Generator
    lag: LagBudget
    recorded: tuple[Trial, ...]
    data: tuple[TrialData, ...]
    noise_rad: tuple[float, ...]
    first: dict[str, Fit]
    upsets: tuple[Upset, ...]

    def fit_rng(self) -> np.random.Generator:
        """The same generator for every fit, so that a fit does not depend on those before it."""
        return deepcopy(self.rng)

    def warnings(self, joint: str) -> Iterator[str]:
        """What went wrong on the bus while the joint was recorded, in sentences."""
        tone = {
            t.number: f"at {t.frequency_hz:.3g} Hz" if t.frequency_hz > 0 else f"trial {t.number}"
            for t in self.recorded
        }
        for slip in self.lag.feedback.slips:
            yield (
                f"{joint}: {tone.get(slip.trial, 'somewhere')} the poll slipped by "
                f"{1e3 * slip.jump_s:.0f} ms at {slip.time_s:.2f} s ({slip.nats:.0f} nats); "
                "readings behind it are dated anew."
            )
        for upset in self.upsets:
            lost = "1 command" if upset.commands == 1 else f"{upset.commands} commands"
            yield (
                f"{joint}: {tone[upset.trial]}, {upset.time_s:.2f} s, {lost} never reached the "
                f"servo ({upset.nats:.0f} nats); the {len(upset.readings)} readings that this "
                "touches are left out."
            )


def prepare_joint(
    joint: str,
    trials: tuple[Trial, ...],
    seed: int,
    known: Mapping[str, NDArray[np.float64]] | None = None,
) -> PreparedJoint:
    """Measure the lag of a joint, date its readings, and put its trials on the physics clock.

    Parameters
    ----------
    joint : str
    trials : tuple of Trial
        All of this joint.
    seed : int
    known : dict of str to ndarray, optional
        Values of candidate models by name, from an earlier fit to these trials; nothing is fitted
        then.

    Raises
    ------
    InputError
        If there is too little motion.
    """
    rng = joint_rng(seed, joint)
    lattice = find_poll_lattice(trials, rng.spawn(1)[0])
    lag = lag_budget(joint, trials, rng, lattice)
    recorded, data = _dated(trials, lattice)
    # fits of a noise-free servo still meet rounding: a third of a quantisation step
    least = max(quantum(trials) / 3, _LEAST_NOISE_RAD)
    scale = max(lag.noise_rad, least) if np.isfinite(lag.noise_rad) else _NOISE_RAD
    noise = (scale,) * len(data)
    if known is None:
        first = _first_fits(data, noise, deepcopy(rng))
    else:
        first = {name: Fit(v, 0.0, np.zeros((len(v), len(v)))) for name, v in known.items()}
    upsets: tuple[Upset, ...] = ()
    for _ in range(_ROUNDS):
        best = min(first, key=lambda name: first[name].cost)
        model, values = candidate_model(best), first[best].values
        dated = redate(recorded, lattice, _motions(recorded, data, free_run(model, values, data)))
        if dated is not lattice and dated.phases != lattice.phases:
            lattice = dated
            recorded, data = _dated(trials, lattice)
        noise = noise_by_trial(fresh_residuals(model, values, data), data, least)
        if not upsets:
            upsets = _upsets(recorded, lattice, noise, model, values)
        if upsets:
            recorded, data = _dated(trials, lattice, upsets)
            noise = noise_by_trial(fresh_residuals(model, values, data), data, least)
        if known is None:
            first = {name: refit(name, data, noise, f) for name, f in first.items()}
    if lattice is not lag.feedback:
        lag = lag_budget(joint, trials, rng, lattice)
    return PreparedJoint(rng, lag, recorded, data, noise, first, upsets)


def refit(name: str, data: tuple[TrialData, ...], noise_rad: tuple[float, ...], start: Fit) -> Fit:
    """The candidate `name` fitted to all trials from `start` on."""
    problem = Problem(data, (True,) * len(data), noise_rad, {})
    return fit(candidate_model(name), [problem], start.values[None])[0]


def _upsets(
    recorded: Sequence[Trial],
    lattice: PollLattice,
    noise: Sequence[float],
    model: CandidateModel,
    values: NDArray[np.float64],
) -> tuple[Upset, ...]:
    """Commands that never arrived, in all trials."""

    def of_trial(trial: Trial, scale: float) -> list[Upset]:
        read = readings(trial, lattice)
        time = read.time_s[read.time_s >= trial.send_time_s[0]]

        def simulate(command: NDArray[np.float64]) -> NDArray[np.float64]:
            data = prepare(replace(trial, command_rad=command), read)
            return fresh_residuals(model, values, [data])[0]

        return find_upsets(trial, time, scale, simulate)

    found = [of_trial(t, s) for t, s in zip(recorded, noise, strict=True)]
    return tuple(upset for upsets in found for upset in upsets)


def _dated(
    trials: Sequence[Trial], lattice: PollLattice, upsets: Sequence[Upset] = ()
) -> tuple[tuple[Trial, ...], tuple[TrialData, ...]]:
    """The trials that have fresh readings, as recorded and on the physics clock."""
    touched = {t.number: [k for u in upsets if u.trial == t.number for k in u.readings]
               for t in trials}  # fmt: skip
    both = [(t, _without(prepare(t, readings(t, lattice)), touched[t.number])) for t in trials]
    used = [(t, d) for t, d in both if len(d.sample_step)]
    return tuple(t for t, _ in used), tuple(d for _, d in used)


def _without(data: TrialData, touched: Sequence[int]) -> TrialData:
    """A trial without some fresh readings and the rows that show them."""
    if not touched:
        return data
    left = np.ones(len(data.sample_step), bool)
    left[touched] = False
    shown = np.isin(data.held_step, data.sample_step[~left])
    return replace(
        data, sample_step=data.sample_step[left], sample_rad=data.sample_rad[left],
        row_rad=np.where(shown, np.nan, data.row_rad),
    )  # fmt: skip


def _first_fits(
    data: tuple[TrialData, ...], noise: tuple[float, ...], rng: np.random.Generator
) -> dict[str, Fit]:
    problem = Problem(data, (True,) * len(data), noise, {})
    return {
        name: fit_problems(candidate_model(name), [problem], deepcopy(rng), _KEEP, _FINAL)[0]
        for name in SIMULATED
    }


def _motions(
    recorded: Sequence[Trial], data: Sequence[TrialData], tracks: Sequence[NDArray]
) -> list[Motion]:
    """Simulated positions as functions of time on the recording's clock."""

    def motion(trial: Trial, own: TrialData, track: NDArray) -> Motion:
        edges = trial.send_time_s[0] + own.step_s * np.arange(len(track))
        return lambda time: np.interp(time, edges, track + own.rest_rad)

    return [motion(*parts) for parts in zip(recorded, data, tracks, strict=True)]
