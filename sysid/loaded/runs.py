"""Runs of a loaded joint on the physics clock, and free runs of candidate servos on them.

A run is one trial with its P gain, its load, and the stretches where its torque was off. `prepare`
gives it the form that a simulation needs; angles stay absolute, because gravity depends on them. A
run starts at rest at its first reading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.delayed_pd import FRICTION_IMPEDANCE, TIME_STEP_S
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, readings
from pupper_sysid.sysid.identify.candidates.simulation import whole_counts
from pupper_sysid.sysid.loaded import kernel
from pupper_sysid.sysid.loaded.structures import LONGEST_DEAD_TIME_S, Structure
from pupper_sysid.sysid.recordings.recording import Trial

_VOLTAGE_WINDOW_S = 0.1
"""Length of the mean of logged voltages: single ones catch the ripple of the pulse width."""


RAMP_SHARES = (1.0, 2.0, 4.0, 8.0, 16.0, float("inf"))
"""Limits on the set-point's acceleration, over a servo's own, that recordings are tried with."""


@dataclass(frozen=True)
class Run:
    """One trial, ready for simulation.

    Attributes
    ----------
    label : str
        For tables: P gain and load in words.
    p_gain : float
        1 where no trial says it.
    load : ndarray, shape (3,)
        Inertia [kg·m²], gravity [N·m], hanging position [rad].
    held : ndarray, shape (3, rest + steps)
        Per step, after a rest longer than any dead time: command [rad], share of the step for which
        the torque is on, and supply voltage over the reference.
    rest : int
        Steps of rest.
    start_rad : float
        First reading.
    sample_step, sample_rad : ndarray, shape (samples,)
        Readings that count: time in physics steps from the first command on, and position.
    row_step, held_step : ndarray, shape (rows,)
        When each row was read, and when its value was measured; NaN where that is unknown.
    row_rad : ndarray, shape (rows,)
        Position of each row, NaN where missing.
    step_s : float
        Length of a physics step [s].
    ramp_share : float
        Largest acceleration of the set-point over the servo's, one of `RAMP_SHARES`: 1, more where
        it was limited less, inf where it was not limited.
    ramp_known : bool
        Whether the recording states that (the register `acceleration`).
    """

    label: str
    p_gain: float
    load: NDArray[np.float64]
    held: NDArray[np.float64]
    rest: int
    start_rad: float
    sample_step: NDArray[np.float64]
    sample_rad: NDArray[np.float64]
    row_step: NDArray[np.float64]
    held_step: NDArray[np.float64]
    row_rad: NDArray[np.float64]
    step_s: float = TIME_STEP_S
    ramp_share: float = 1.0
    ramp_known: bool = False

    def with_samples(self, reading_rad: NDArray[np.float64]) -> Run:
        """The same run with other readings at the same times."""
        return replace(self, sample_rad=reading_rad)


def prepare(
    trial: Trial, lattice: PollLattice, reference_voltage_v: float = float("nan")
) -> Run | None:
    """Put one trial on the physics clock; None without readings.

    Parameters
    ----------
    trial : Trial
    lattice : PollLattice
        Which readings are fresh, and when they were measured.
    reference_voltage_v : float
        The voltage at which the stall torque is defined; NaN where torques do not depend on it.
    """
    reading = readings(trial, lattice)
    start = float(trial.send_time_s[0])
    inside = (reading.time_s >= start) & np.isfinite(reading.position_rad)
    if not inside.any():
        return None
    stop = max(trial.read_time_s[-1], trial.send_time_s[-1]) - start
    steps = int(np.ceil(stop / TIME_STEP_S)) + 2
    rest = int(LONGEST_DEAD_TIME_S / TIME_STEP_S) + 4
    sent = trial.send_time_s - start
    held = np.ones((3, rest + steps))
    command = whole_counts(trial)
    held[0, :rest] = trial.initial_command_rad
    held[0, rest:] = averaged(sent, command, steps)
    if trial.torque_enabled is not None:
        on = trial.torque_enabled.astype(float)
        held[1, :rest] = on[0]
        held[1, rest:] = averaged(sent, on, steps)
    held[2] = _voltage(trial, reference_voltage_v, start, rest, steps)

    def to_step(time: NDArray) -> NDArray[np.float64]:
        return np.clip((time - start) / TIME_STEP_S, 0.0, steps)

    own = trial.load
    load = [0.0, 0.0, 0.0]
    if own is not None:
        load = [own.inertia_kg_m2, own.gravity_nm, own.hanging_rad]
    gain = trial.p_gain if np.isfinite(trial.p_gain) else 1.0
    first = trial.position_rad[np.isfinite(trial.position_rad)][0]
    ramp = trial.servo.set_point_acceleration_rad_s2
    return Run(
        _label(trial), gain, np.array(load), held, rest, float(first),
        to_step(reading.time_s[inside]), reading.position_rad[inside],
        to_step(trial.read_time_s),
        to_step(np.where(reading.held_time_s >= start, reading.held_time_s, np.nan)),
        trial.position_rad,
        ramp_share=1.0 if ramp is None or np.isfinite(ramp) else float("inf"),
        ramp_known=ramp is not None,
    )  # fmt: skip


def with_ramp(run: Run, share: float) -> Run:
    """The run with another share of the servo's acceleration limit, unless it states its own."""
    return run if run.ramp_known else replace(run, ramp_share=share)


def with_voltage(run: Run, trial: Trial, reference_voltage_v: float) -> NDArray[np.float64]:
    """`run.held` with the trial's supply voltage over another reference."""
    held = run.held.copy()
    steps = held.shape[1] - run.rest
    held[2] = _voltage(trial, reference_voltage_v, float(trial.send_time_s[0]), run.rest, steps)
    return held


def averaged(sent_s: NDArray, held: NDArray, steps: int) -> NDArray[np.float64]:
    """Mean of a held value over each physics step."""
    edges = TIME_STEP_S * np.arange(steps + 1)
    sent = np.append(sent_s, max(edges[-1], sent_s[-1]) + 1.0)
    area = np.concatenate([[0.0], np.cumsum(held * np.diff(sent))])
    return np.diff(np.interp(edges, sent, area)) / TIME_STEP_S


def _voltage(
    trial: Trial, reference_v: float, start: float, rest: int, steps: int
) -> NDArray[np.float64] | float:
    """Supply voltage over the reference, per step; the nominal one where none was logged."""
    if not np.isfinite(reference_v):
        return 1.0
    logged = trial.voltage_v
    if logged is None or not np.isfinite(logged).any():
        nominal = trial.servo.supply_voltage_v
        return 1.0 if nominal is None else nominal / reference_v
    known = np.isfinite(logged)
    time = TIME_STEP_S * (np.arange(rest + steps) - rest)
    volts = np.interp(time, trial.read_time_s[known] - start, logged[known])
    width = int(_VOLTAGE_WINDOW_S / TIME_STEP_S) // 2 * 2 + 1
    padded = np.pad(volts, width // 2, mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), "valid") / reference_v


def _label(trial: Trial) -> str:
    parts = [f"P {trial.p_gain:g}"] if np.isfinite(trial.p_gain) else []
    if trial.load is not None:
        parts.append(f"{trial.load.mass_kg:g} kg at {trial.load.length_m:g} m")
    return ", ".join(parts) or f"trial {trial.number}"


def residuals(
    structure: Structure, values: NDArray[np.float64], runs: Sequence[Run]
) -> list[NDArray[np.float64]]:
    """Model minus readings that count, (candidates, samples) for each run [rad].

    Parameters
    ----------
    structure : Structure
    values : ndarray, shape (candidates, parameters)
    runs : sequence of Run
    """
    columns = structure.columns(values)
    found = []
    for run in runs:
        out = np.empty((len(values), len(run.sample_step)))
        kernel.residuals(
            columns, values[:, 0] / run.step_s, run.held, run.p_gain, run.load, run.ramp_share,
            run.start_rad, run.sample_step, run.sample_rad, run.rest, run.step_s,
            -FRICTION_IMPEDANCE, out,
        )  # fmt: skip
        found.append(out)
    return found


def costs(
    columns: NDArray[np.float64], dead_time_s: NDArray[np.float64], run: Run, noise_rad: float
) -> NDArray[np.float64]:
    """Soft-L1 cost of candidates on one run, shape (candidates,), without arrays of residuals."""
    out = np.empty(len(columns))
    kernel.costs(
        columns, dead_time_s / run.step_s, run.held, run.p_gain, run.load, run.ramp_share,
        run.start_rad, run.sample_step, run.sample_rad, noise_rad, run.rest, run.step_s,
        -FRICTION_IMPEDANCE, out,
    )  # fmt: skip
    return out


def free_run(
    structure: Structure, values: NDArray[np.float64], runs: Sequence[Run]
) -> list[NDArray[np.float64]]:
    """Readings that one servo predicts at the edges of the steps of each run, (steps + 1,) [rad].

    Parameters
    ----------
    structure : Structure
    values : ndarray, shape (parameters,)
    runs : sequence of Run
    """
    columns = structure.columns(values[None])
    return [simulate(columns, values[:1], run)[:, 0] for run in runs]


def simulate(
    columns: NDArray[np.float64], dead_time_s: NDArray[np.float64], run: Run
) -> NDArray[np.float64]:
    """Readings at the edges of the steps, shape (steps + 1, candidates) [rad]."""
    out = np.empty((run.held.shape[1] - run.rest + 1, len(columns)))
    kernel.positions(
        columns, dead_time_s / run.step_s, run.held, run.p_gain, run.load, run.ramp_share,
        run.start_rad, run.rest, run.step_s, -FRICTION_IMPEDANCE, out,
    )  # fmt: skip
    return out


def at_steps(track: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """A track at fractional steps; NaN where the step is."""
    return np.where(
        np.isnan(step), np.nan, np.interp(np.nan_to_num(step), np.arange(len(track)), track)
    )
