"""Runs: trials on the physics clock, and free runs of servos on them.

A run is one trial with its dated readings, its held command, gain, load and torque state. `prepare`
makes it; every fit, score and comparison reads runs and nothing else. Angles are absolute, because
gravity depends on them. A run starts at rest, where the joint rested. The functions below simulate
any number of candidates, which are parameter vectors of one structure; `servo_models.kernel` does
the arithmetic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models import kernel
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, Readings, readings
from pupper_sysid.sysid.fit.structure import LONGEST_DEAD_TIME_S, Structure
from pupper_sysid.sysid.recordings.recording import Trial

_ACCELERATION = kernel.COLUMNS.index("acceleration_limit")
SHORTEST_STEP_S = TIME_STEP_S / 4
"""Physics step in which servos are nearly those of continuous time [s]: predictions take it, and
fits where longer ones would move a number."""
_LEAST_AT_REST, _SETTLES, _FAR = 8, 3.0, 5.0
"""Readings whose halves can be compared, and the difference [standard errors] of a moving joint."""
_DENSE_S = 0.008
"""Time within which a servo hardly moves [s]: a search takes one reading in it, where there are
twice as many or more."""
_PERIODS = 2.0
"""Of a tone that a search sees at least: those after the first are alike."""
_PART_S, _SETTLED_S, _LONG, _STILL = 3.0, 0.6, 1.5, 0.1
"""Of another motion: length of a part, and of the motion before it in which a servo forgets where
it began [s]; how much longer than its parts it is at least, and the share of a mean part's path
below which the command is still."""
_VOLTAGE_WINDOW_S = 0.1
"""Length of the mean of logged voltages: single ones catch the ripple of the pulse width."""


@dataclass(frozen=True)
class Run:
    """One trial, ready for simulation.

    Attributes
    ----------
    label : str
        For tables: P gain and load in words.
    frequency_hz : float
        Of its tone; NaN without.
    p_gain : float
        1 where no trial says it.
    load : ndarray, shape (3,)
        Inertia [kg·m²], gravity [N·m], hanging position [rad].
    held : ndarray, shape (1 or 3, pad + steps)
        Per step, after a rest longer than any dead time: command [rad], truncated as the bus does
        and averaged over the step; then, where they are not always 1, share of the step for which
        the torque is on and supply voltage over the reference.
    edges : ndarray, shape (2, pad + steps)
        When within a step the command changed (`kernel.edges_of`).
    pad : int
        Steps of rest.
    start_rad : float
        Where the joint rested before the first command (`_rest_rad`).
    sample_step, sample_rad : ndarray, shape (samples,)
        Readings that count: time in physics steps from the first command on, and position [rad].
    row_step, held_step : ndarray, shape (rows,)
        When each row was read, and when its value was measured; NaN where that is unknown.
    row_rad : ndarray, shape (rows,)
        Position of each row [rad], NaN where missing.
    step_s : float
        Length of a physics step [s].
    ramp_share : float
        Limit on the set-point's acceleration over the servo's, where the header states a register:
        1, or inf where it is not limited.
    ramp_known : bool
        Whether the header states it.
    source : str
        Name of its recording, where several are pooled.
    """

    label: str
    frequency_hz: float
    p_gain: float
    load: NDArray[np.float64]
    held: NDArray[np.float64]
    edges: NDArray[np.float64]
    pad: int
    start_rad: float
    sample_step: NDArray[np.float64]
    sample_rad: NDArray[np.float64]
    row_step: NDArray[np.float64]
    held_step: NDArray[np.float64]
    row_rad: NDArray[np.float64]
    step_s: float = TIME_STEP_S
    ramp_share: float = 1.0
    ramp_known: bool = False
    source: str = ""

    @property
    def steps(self) -> int:
        """Physics steps from the first command on."""
        return self.held.shape[1] - self.pad

    @property
    def command(self) -> NDArray[np.float64]:
        """Command of each step [rad], shape (steps,)."""
        return self.held[0, self.pad :]

    @property
    def rest_rad(self) -> float:
        """Command before the first [rad]."""
        return float(self.held[0, 0])

    @property
    def torque_on(self) -> NDArray[np.float64]:
        """Share of each step for which the torque is on, shape (steps,)."""
        return self.held[1, self.pad :] if len(self.held) > 1 else np.ones(self.steps)

    @property
    def tone(self) -> float:
        """Its tone [Hz]; -1 where there is none."""
        return round(self.frequency_hz, 2) if self.frequency_hz > 0 else -1.0

    def in_free_air(self) -> Run:
        """The run at its own gain, whatever that is: stiffness is for the gain of the recording."""
        return replace(self, p_gain=1.0)

    def coarser(self) -> Run:
        """The run in steps of twice the length, for a search: half the work, nearly the motion."""
        even = (self.held.shape[1] - self.pad) // 2 * 2
        pad = self.pad // 2
        use = slice(self.pad - 2 * pad, self.pad + even)
        held = self.held[:, use].reshape(len(self.held), -1, 2).mean(axis=2)
        return replace(
            self, held=held, edges=kernel.edges_of(held[0], self.edges[0, use][1::2]), pad=pad,
            sample_step=np.minimum(self.sample_step, even) / 2, row_step=self.row_step / 2,
            held_step=self.held_step / 2, step_s=2 * self.step_s,
        )  # fmt: skip

    def excerpts(self, seconds: float) -> tuple[Run, ...]:
        """The readings that a search needs, as runs: of a long motion some parts, none too dense.

        A servo does not move within `_DENSE_S`, and a tone repeats itself. `seconds`: how much of
        the motion, if it is that long: the beginning of a tone, and of another motion parts from
        all of it in which the command moves.
        """
        run = self._thinned()
        if not len(run.sample_step):
            return (run,)
        time_s = (run.sample_step - run.sample_step[0]) * self.step_s
        if self.tone > 0:
            count = np.count_nonzero(time_s <= max(seconds, _PERIODS / self.tone))
            return (run,) if count == len(time_s) else (run._part(0, slice(count)),)
        parts = max(int(seconds / _PART_S), 1)
        blocks = [np.flatnonzero(time_s // _PART_S == k) for k in range(int(time_s[-1] // _PART_S))]
        blocks = [block for block in blocks if len(block)]
        if len(blocks) < _LONG * parts:
            return (run,)
        command = self.command[np.minimum(run.sample_step.astype(int), self.steps - 1)]
        paths = np.array([np.abs(np.diff(command[block])).sum() for block in blocks])
        moving = np.flatnonzero(paths >= _STILL * paths.mean())
        chosen = moving[((np.arange(parts) + 0.5) / parts * len(moving)).astype(int)]
        settled = round(_SETTLED_S / self.step_s)
        return tuple(
            run._part(max(int(run.sample_step[blocks[k][0]]) - settled, 0), blocks[k])
            for k in dict.fromkeys(chosen)
        )

    def _thinned(self) -> Run:
        """The run with one reading in `_DENSE_S`, if that leaves at most half of them."""
        apart = np.floor(self.sample_step * (self.step_s / _DENSE_S))
        use = np.unique(apart, return_index=True)[1]
        return self if len(use) > len(apart) // 2 else self._part(0, use)

    def _part(self, first: int, use: slice | NDArray[np.intp]) -> Run:
        """The run from a step on, with some of its readings; the joint rests there before."""
        step, reading = self.sample_step[use], self.sample_rad[use]
        if not first:
            return replace(self, sample_step=step, sample_rad=reading)
        end = self.pad + int(np.ceil(step[-1])) + 2
        return replace(
            self, held=self.held[:, first:end], edges=self.edges[:, first:end],
            start_rad=float(np.interp(first, self.sample_step, self.sample_rad)),
            sample_step=step - first, sample_rad=reading,
        )  # fmt: skip

    def until(self, share: float) -> Run:
        """The run with the readings of its first part only."""
        use = self.sample_step <= share * self.steps
        return replace(self, sample_step=self.sample_step[use], sample_rad=self.sample_rad[use])


_WHOLE_COUNT = {
    "up": lambda count: np.ceil(count - 1e-6),
    "down": lambda count: np.floor(count + 1e-6),
    "nearest": np.rint,
}


def whole_counts(trial: Trial) -> NDArray[np.float64]:
    """Commands as the bus sent them [rad]."""
    cut = trial.truncation
    if cut.quantum_rad <= 0 or cut.rounding not in _WHOLE_COUNT:
        return trial.command_rad
    zero = trial.initial_command_rad if cut.zero_rad is None else cut.zero_rad
    count = (trial.command_rad - zero) / cut.quantum_rad
    return _WHOLE_COUNT[cut.rounding](count) * cut.quantum_rad + zero


def prepare(
    trial: Trial,
    reading: Readings | PollLattice,
    reference_voltage_v: float = float("nan"),
    step_s: float = TIME_STEP_S,
) -> Run:
    """Put one trial on the physics clock.

    `reading`: which readings are fresh, and when they were measured. `reference_voltage_v`: the
    voltage at which the stall torque is defined; NaN where torques do not depend on it. `step_s`:
    length of a physics step [s].
    """
    if isinstance(reading, PollLattice):
        reading = readings(trial, reading)
    start = float(trial.send_time_s[0])
    stop = max(trial.read_time_s[-1], trial.send_time_s[-1]) - start
    steps, pad = int(np.ceil(stop / step_s)) + 2, int(LONGEST_DEAD_TIME_S / step_s) + 4
    sent = trial.send_time_s - start
    held = np.ones((3, pad + steps))
    held[0, :pad] = trial.initial_command_rad
    edges, held[0, pad:] = _commanded(sent, whole_counts(trial), held[0], pad, step_s)
    if trial.torque_enabled is not None:
        on = trial.torque_enabled.astype(float)
        held[1, :pad] = on[0]
        held[1, pad:] = averaged(sent, on, steps, step_s)
    held[2] = _voltage(trial, reference_voltage_v, start, pad, steps, step_s)
    if (held[1:] == 1.0).all():
        held = held[:1]

    def to_step(time: NDArray) -> NDArray[np.float64]:
        return np.clip((time - start) / step_s, 0.0, steps)

    inside = (reading.time_s >= start) & np.isfinite(reading.position_rad)
    load, ramp = trial.load, trial.servo.set_point_acceleration_rad_s2
    return Run(
        label=_label(trial),
        frequency_hz=trial.frequency_hz,
        p_gain=trial.p_gain if np.isfinite(trial.p_gain) else 1.0,
        load=np.zeros(3) if load is None else np.array(
            [load.inertia_kg_m2, load.gravity_nm, load.hanging_rad]
        ),
        held=held,
        edges=edges,
        pad=pad,
        start_rad=_rest_rad(trial),
        sample_step=to_step(reading.time_s[inside]),
        sample_rad=reading.position_rad[inside],
        row_step=to_step(trial.read_time_s),
        held_step=to_step(np.where(reading.held_time_s >= start, reading.held_time_s, np.nan)),
        row_rad=trial.position_rad,
        step_s=step_s,
        ramp_share=1.0 if ramp is None or np.isfinite(ramp) else float("inf"),
        ramp_known=ramp is not None,
        source=trial.source,
    )  # fmt: skip


def _rest_rad(trial: Trial) -> float:
    """Mean of what was read before a command changed; the first reading of a joint that settles.

    Friction keeps a joint where it rests: until it moves, an error of this is one of all readings.
    """
    known = np.isfinite(trial.position_rad)
    if not known.any():
        return trial.initial_command_rad
    changed = np.append(trial.initial_command_rad, trial.command_rad[:-1]) != trial.command_rad
    moved_s = trial.send_time_s[changed.argmax()] if changed.any() else np.inf
    rest = trial.position_rad[known & (trial.read_time_s <= moved_s)]
    if len(rest) < _LEAST_AT_REST:
        return float(trial.position_rad[known][0])
    # without single bad readings, which are away from both of their neighbours
    beside = rest[:1], rest, rest[-1:]
    around = np.lib.stride_tricks.sliding_window_view(np.concatenate(beside), 3)
    away = np.abs(rest - np.median(around, axis=1))
    usual = rms(np.sort(away)[:-1])
    rest = rest[away <= _FAR * max(usual, 1e-9)]
    early, late = np.array_split(rest, 2)
    error = np.std(late) / np.sqrt(len(late))
    settles = abs(early.mean() - late.mean()) > _SETTLES * error
    return float(rest[0] if settles else rest.mean())


def _commanded(
    sent_s: NDArray, command: NDArray, rest: NDArray, pad: int, step_s: float = TIME_STEP_S
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Edges of all steps, and the mean command of those after the rest."""
    mean = averaged(sent_s, command, len(rest) - pad, step_s)
    ends = step_s * (1.0 + np.arange(len(mean)))
    last = np.searchsorted(sent_s, ends, side="left") - 1
    at_edges = np.concatenate([rest[:pad], command[np.maximum(last, 0)]])
    return kernel.edges_of(np.concatenate([rest[:pad], mean]), at_edges), mean


def averaged(
    sent_s: NDArray, held: NDArray, steps: int, step_s: float = TIME_STEP_S
) -> NDArray[np.float64]:
    """Mean of a held value over each physics step."""
    edges = step_s * np.arange(steps + 1)
    sent = np.append(sent_s, max(edges[-1], sent_s[-1]) + 1.0)
    # before the first command nothing is known: its mean starts there
    area = np.concatenate([[0.0], np.cumsum(held * np.diff(sent))])
    return np.diff(np.interp(edges, sent, area)) / step_s


def with_commands(run: Run, trial: Trial) -> Run:
    """The run under the commands of a trial, which is the same but for them."""
    held, sent = run.held.copy(), trial.send_time_s - trial.send_time_s[0]
    edges, held[0, run.pad :] = _commanded(sent, whole_counts(trial), held[0], run.pad, run.step_s)
    return replace(run, held=held, edges=edges)


def with_voltage(run: Run, trial: Trial, reference_voltage_v: float) -> Run:
    """The run with the trial's supply voltage over another reference."""
    held = np.ones((3, run.held.shape[1]))
    held[: len(run.held)] = run.held
    start = float(trial.send_time_s[0])
    held[2] = _voltage(trial, reference_voltage_v, start, run.pad, run.steps, run.step_s)
    return replace(run, held=held)


def with_late_commands(run: Run, trial: Trial, jitter_s: float, rng: np.random.Generator) -> Run:
    """The run with every command late or early at random, with a mean of 0.

    `trial`: the same, as recorded. `jitter_s`: standard deviation of the latency [s], which is
    exponential: most commands come a little early, few much too late. None overtakes another.
    """
    late = jitter_s * (rng.exponential(1.0, len(trial.send_time_s)) - 1.0)
    sent = np.maximum.accumulate(np.maximum(trial.send_time_s - trial.send_time_s[0] + late, 0.0))
    # the rest before the first command, which may be late itself
    sent = np.concatenate([[0.0], sent])
    command = np.concatenate([[run.rest_rad], whole_counts(trial)])
    held = run.held.copy()
    edges, held[0, run.pad :] = _commanded(sent, command, held[0], run.pad, run.step_s)
    return replace(run, held=held, edges=edges)


def _voltage(
    trial: Trial, reference_v: float, start: float, pad: int, steps: int, step_s: float
) -> NDArray[np.float64] | float:
    """Supply voltage over the reference, per step; the nominal one where none was logged."""
    if not np.isfinite(reference_v):
        return 1.0
    logged = trial.voltage_v
    if logged is None or not np.isfinite(logged).any():
        nominal = trial.servo.supply_voltage_v
        return 1.0 if nominal is None else nominal / reference_v
    known = np.isfinite(logged)
    time = step_s * (np.arange(pad + steps) - pad)
    volts = np.interp(time, trial.read_time_s[known] - start, logged[known])
    width = int(_VOLTAGE_WINDOW_S / step_s) // 2 * 2 + 1
    padded = np.pad(volts, width // 2, mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), "valid") / reference_v


def _label(trial: Trial) -> str:
    parts = [f"P {trial.p_gain:g}"] if np.isfinite(trial.p_gain) else []
    if trial.load is not None:
        parts.append(f"{trial.load.mass_kg:g} kg at {trial.load.length_m:g} m")
    return ", ".join(parts) or f"trial {trial.number}"


# ------------------------------------------------------------------------------- simulation


def residuals(
    structure: Structure, values: NDArray[np.float64], runs: Sequence[Run]
) -> list[NDArray[np.float64]]:
    """Model minus readings that count, (candidates, samples) for each run [rad].

    `values` of shape (candidates, parameters).
    """
    columns = structure.columns(values)
    return [
        kernel.residuals(
            *_simulated(structure.kind, columns, values[:, 0], run),
            step=run.sample_step, reading=run.sample_rad,
        )
        for run in runs
    ]  # fmt: skip


def costs(
    structure: Structure, columns: NDArray[np.float64], dead_time_s: NDArray[np.float64],
    run: Run, noise_rad: float,
) -> NDArray[np.float64]:  # fmt: skip
    """Soft-L1 cost of candidates on one run, shape (candidates,), without arrays of residuals."""
    return kernel.costs(
        *_simulated(structure.kind, columns, dead_time_s, run),
        step=run.sample_step, reading=run.sample_rad, noise=noise_rad,
    )  # fmt: skip


def moments_if_later(
    structure: Structure, values: NDArray[np.float64], run: Run, later: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums of the residuals and of their squares if every candidate had moved later.

    `values` of shape (candidates, parameters). `later` of shape (delays,): in physics steps of the
    run. Returns both of shape (delays, candidates), in rad and rad².
    """
    return kernel.moments_if_later(
        *_simulated(structure.kind, structure.columns(values), values[:, 0], run),
        step=run.sample_step, reading=run.sample_rad, later=later,
    )  # fmt: skip


def free_run(
    structure: Structure, values: NDArray[np.float64], runs: Sequence[Run]
) -> list[NDArray[np.float64]]:
    """Readings that one servo predicts at the edges of the steps of each run, (steps + 1,) [rad].

    `values` of shape (parameters,).
    """
    columns = structure.columns(values[None])
    return [simulate(columns, values[:1], run, structure.kind)[:, 0] for run in runs]


def simulate(
    columns: NDArray[np.float64], dead_time_s: NDArray[np.float64], run: Run,
    kind: int = kernel.SERVO,
) -> NDArray[np.float64]:  # fmt: skip
    """Readings at the edges of the steps, shape (steps + 1, candidates) [rad]."""
    return kernel.positions(*_simulated(kind, columns, dead_time_s, run))


def fresh_residuals(
    structure: Structure, values: NDArray[np.float64], runs: Sequence[Run]
) -> list[NDArray[np.float64]]:
    """Model minus readings that count of one servo, shape (samples,) for each run [rad]."""
    return [r[0] for r in residuals(structure, values[None], runs)]


def at_steps(track: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """A track at fractional steps, on the kernel's parabola; NaN where the step is."""
    last = len(track) - 1
    inside = np.clip(np.nan_to_num(step), 0.0, last)
    row = np.minimum(inside.astype(int), last - 1)
    part = inside - row
    before, low, high, after = (track[np.clip(row + n, 0, last)] for n in (-1, 0, 1, 2))
    between = low + part * (high - low) - 0.25 * part * (1.0 - part) * (before - low - high + after)
    return np.where(np.isnan(step), np.nan, between)


def _simulated(
    kind: int, columns: NDArray[np.float64], dead_time_s: NDArray[np.float64], run: Run
) -> kernel.Simulated:
    """Candidates on a run, the set-point's acceleration limited as its header says."""
    if run.ramp_share != 1.0 and kind == kernel.SERVO:
        columns = columns.copy()
        columns[:, _ACCELERATION] *= run.ramp_share
    return (
        kind, columns, dead_time_s / run.step_s, run.held, run.edges, run.p_gain, run.load,
        run.start_rad, run.pad, run.step_s,
    )  # fmt: skip
