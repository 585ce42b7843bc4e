"""Trials on the physics clock, and free runs of candidate models on them.

`prepare` gives a trial the form that a simulation needs. The functions below simulate any number of
candidates, which are parameter vectors of one model, from rest under the commands as the servo
received them; `sysid.identify.candidates.kernel` does the arithmetic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.delayed_pd import FRICTION_IMPEDANCE, TIME_STEP_S
from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.identify.candidates import kernel
from pupper_sysid.sysid.identify.candidates.models import CandidateModel
from pupper_sysid.sysid.recordings.recording import Trial

LONGEST_DEAD_TIME_S = 0.4


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
        Per row: when the value it shows was measured (NaN if before the trial or not known), and
        when it was sent.
    row_rad : ndarray, shape (rows,)
        Position of each row relative to rest [rad], NaN where missing.
    step_s : float
        Length of a physics step [s].
    """

    frequency_hz: float
    rest_rad: float
    command: NDArray[np.float64]
    sample_step: NDArray[np.float64]
    sample_rad: NDArray[np.float64]
    held_step: NDArray[np.float64]
    row_step: NDArray[np.float64]
    row_rad: NDArray[np.float64]
    step_s: float = TIME_STEP_S

    def in_half_steps(self) -> TrialData:
        """The same trial in physics steps of half the length."""
        return replace(
            self, command=np.repeat(self.command, 2), step_s=0.5 * self.step_s,
            sample_step=2 * self.sample_step, held_step=2 * self.held_step,
            row_step=2 * self.row_step,
        )  # fmt: skip


_WHOLE_COUNT = {
    "up": lambda count: np.ceil(count - 1e-6),
    "down": lambda count: np.floor(count + 1e-6),
    "nearest": np.rint,
}


def prepare(trial: Trial, reading: Readings) -> TrialData:
    """Put one trial on the physics clock."""
    rest, start = trial.initial_command_rad, trial.send_time_s[0]
    stop = max(trial.read_time_s[-1], trial.send_time_s[-1]) - start
    steps = int(np.ceil(stop / TIME_STEP_S)) + 2
    average = _averaged(trial.send_time_s - start, whole_counts(trial) - rest, steps, TIME_STEP_S)

    def to_step(time: NDArray) -> NDArray[np.float64]:
        return np.clip((time - start) / TIME_STEP_S, 0.0, steps)

    inside = reading.time_s >= start
    return TrialData(
        trial.frequency_hz, rest, average,
        to_step(reading.time_s[inside]), reading.position_rad[inside] - rest,
        to_step(np.where(reading.held_time_s >= start, reading.held_time_s, np.nan)),
        to_step(trial.send_time_s), trial.position_rad - rest,
    )  # fmt: skip


def _averaged(sent_s: NDArray, command: NDArray, steps: int, step_s: float) -> NDArray[np.float64]:
    """Mean of a held command over each physics step; 0, the rest, before the first."""
    edges = step_s * np.arange(steps + 1)
    sent = np.append(sent_s, max(edges[-1], sent_s[-1]) + 1.0)
    area = np.concatenate([[0.0], np.cumsum(command * np.diff(sent))])
    return np.diff(np.interp(edges, sent, area)) / step_s


def with_late_commands(
    data: TrialData, trial: Trial, jitter_s: float, rng: np.random.Generator
) -> TrialData:
    """The trial with every command late or early at random, with a mean of 0.

    Parameters
    ----------
    data : TrialData
    trial : Trial
        The same, as recorded.
    jitter_s : float
        Standard deviation of the latency [s], which is exponential: most commands come a little
        early, few much too late. None overtakes another.
    rng : numpy.random.Generator
    """
    late = jitter_s * (rng.exponential(1.0, len(trial.send_time_s)) - 1.0)
    sent = np.maximum.accumulate(np.maximum(trial.send_time_s - trial.send_time_s[0] + late, 0.0))
    command = whole_counts(trial) - trial.initial_command_rad
    return replace(data, command=_averaged(sent, command, len(data.command), data.step_s))


def whole_counts(trial: Trial) -> NDArray[np.float64]:
    """Commands as the bus sent them [rad]."""
    cut = trial.truncation
    if cut.quantum_rad <= 0 or cut.rounding not in _WHOLE_COUNT:
        return trial.command_rad
    zero = trial.initial_command_rad if cut.zero_rad is None else cut.zero_rad
    count = (trial.command_rad - zero) / cut.quantum_rad
    return _WHOLE_COUNT[cut.rounding](count) * cut.quantum_rad + zero


def free_run(
    model: CandidateModel, values: NDArray[np.float64], trials: Sequence[TrialData]
) -> list[NDArray[np.float64]]:
    """Simulate one candidate on each trial.

    Parameters
    ----------
    model : CandidateModel
    values : ndarray, shape (parameters,)
    trials : sequence of TrialData

    Returns
    -------
    list of ndarray, shape (steps + 1,) each
        Position at step edges relative to rest, the offset included [rad].
    """
    kind, own = _candidates(model, values[None])
    tracks = []
    for trial in trials:
        out = np.empty((len(trial.command) + 1, 1))
        kernel.positions(kind, own, values[:1] / trial.step_s, *_stepped(trial), out)
        tracks.append(out[:, 0] + values[-1])
    return tracks


def residuals(
    model: CandidateModel, values: NDArray[np.float64], trials: Sequence[TrialData]
) -> NDArray[np.float64]:
    """Model minus fresh readings, shape (candidates, samples of all trials) [rad].

    Parameters
    ----------
    model : CandidateModel
    values : ndarray, shape (candidates, parameters)
    trials : sequence of TrialData
    """
    offset = np.ascontiguousarray(values[:, -1])
    kind, own = _candidates(model, values)
    parts = [np.empty((len(values), 0))]
    for trial in trials:
        out = np.empty((len(values), len(trial.sample_step)))
        command, rest, step_s, stop = _stepped(trial)
        kernel.residuals(
            kind, own, values[:, 0] / trial.step_s, offset, command, trial.sample_step,
            trial.sample_rad, rest, step_s, stop, out,
        )  # fmt: skip
        parts.append(out)
    return np.concatenate(parts, axis=1)


def moments_if_later(
    model: CandidateModel,
    values: NDArray[np.float64],
    trial: TrialData,
    later: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums of the residuals and of their squares if every candidate had moved later.

    Parameters
    ----------
    model : CandidateModel
    values : ndarray, shape (candidates, parameters)
        Their offsets are not added.
    trial : TrialData
    later : ndarray, shape (delays,)
        In physics steps of the trial.

    Returns
    -------
    total : ndarray, shape (delays, candidates)
        In rad.
    square : ndarray, shape (delays, candidates)
        In rad².
    """
    total, square = np.zeros((2, len(later), len(values)))
    command, rest, step_s, stop = _stepped(trial)
    kernel.moments_if_later(
        *_candidates(model, values), values[:, 0] / trial.step_s, command, trial.sample_step,
        trial.sample_rad, later, rest, step_s, stop, total, square,
    )  # fmt: skip
    return total, square


def _candidates(model: CandidateModel, values: NDArray) -> tuple[int, NDArray]:
    """What the kernel takes of candidates beside dead times: the model's number, parameters."""
    own = values[:, 1:-1] if model.columns is None else model.columns(values[:, 1:-1])
    return kernel.KINDS.index(model.kernel or model.name), np.ascontiguousarray(own)


def _stepped(trial: TrialData) -> tuple[NDArray[np.float64], int, float, float]:
    """The command after a rest longer than any dead time; its length, step and stopping share."""
    rest = int(LONGEST_DEAD_TIME_S / trial.step_s) + 4
    command = np.concatenate([np.zeros(rest), trial.command])
    return command, rest, trial.step_s, -FRICTION_IMPEDANCE


def look_up(track: NDArray, step: NDArray) -> NDArray[np.float64]:
    """Values of `track` (steps, ...) at fractional steps, shape (samples, ...)."""
    whole = np.minimum(step.astype(int), len(track) - 2)
    fraction = (step - whole).reshape(-1, *[1] * (track.ndim - 1))
    return track[whole] + fraction * (track[whole + 1] - track[whole])
