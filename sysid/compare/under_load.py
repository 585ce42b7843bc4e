"""Compare servo models on runs under load: each run with its own gain, load and torque.

Recordings of a loaded bench differ in rate, P gain and load, so they cannot be laid on one clock of
ticks as `sysid.compare.compare` does. Here every trial is a run of its own. It starts at rest at
its first reading, and each model moves freely under its commands, with the torque off where it was,
to be held against all rows: where their value was measured (held), and as a bus would show it
(raw), which is the same where readings are live or dated.

A calibration with `under_load` predicts the run's P gain; another holds at its own gain, and is
given the run's load. Where the load is known, no offset is taken out: command and reading share the
encoder's zero, and droop is the model's to predict. Elsewhere the offset is that of the recording,
as for `compare`. So is the register that limits the set-point's acceleration: where a recording
does not state it, a model that has such a limit runs with and without, and the better one counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import NO_SPEED_LIMIT_RAD_S
from pupper_sysid.servo_models.loaded_servo import COLUMNS, LoadedServoParameters
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice
from pupper_sysid.sysid.loaded.kernel import OFFSET, WIDTH
from pupper_sysid.sysid.loaded.runs import (
    RAMP_SHARES,
    Run,
    at_steps,
    prepare,
    simulate,
    with_ramp,
    with_voltage,
)
from pupper_sysid.sysid.recordings.joints import joint_rng
from pupper_sysid.sysid.recordings.recording import Recording, Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NO_LIMIT_NM = 1e9  # of the torque of a model without an effort limit
_BLOCK_S = 0.5


@dataclass(frozen=True)
class BenchRun:
    """One trial to compare on.

    Attributes
    ----------
    trial : Trial
    run : Run
    recording : int
    offset_known : bool
        Whether readings and commands share their zero.
    """

    trial: Trial
    run: Run
    recording: int
    offset_known: bool


def needs_runs(
    recordings: Sequence[Recording], joints: Sequence[str], calibrations: Sequence[Calibration]
) -> bool:
    """Whether recordings or models tell of a load, so that each trial is a run of its own."""
    if any(_knows_load(calibration, j) for calibration in calibrations for j in joints):
        return True
    trials = [t for r in recordings for j in joints for t in r.trials(j)]
    if any(t.load is not None or _limp(t) for t in trials):
        return True
    for joint in joints:
        gains = {t.p_gain for r in recordings for t in r.trials(joint) if np.isfinite(t.p_gain)}
        if len(gains) > 1:
            return True
    return False


def _knows_load(calibration: Calibration, joint: str) -> bool:
    try:
        return calibration.joint(joint).under_load is not None  # a card has every joint
    except InputError:
        return False


def _limp(trial: Trial) -> bool:
    return trial.torque_enabled is not None and not trial.torque_enabled.all()


def bench_runs(
    recordings: Sequence[Recording],
    joint: str,
    seed: int,
    lattice: PollLattice | None = None,
) -> list[BenchRun]:
    """Runs of a joint in all recordings.

    Raises
    ------
    InputError
        If there are no readings.
    """
    trials = [t for r in recordings for t in r.trials(joint)]
    lattice = lattice or find_poll_lattice(tuple(trials), joint_rng(seed, joint))
    found = []
    for place, recording in enumerate(recordings):
        for trial in recording.trials(joint):
            run = prepare(trial, lattice)
            if run is not None:
                found.append(BenchRun(trial, run, place, trial.load is not None))
    if not found:
        raise InputError(f"{joint}: no readings to compare with. Record it again.")
    return found


def reference_voltage(calibration: Calibration, joint: str) -> float:
    """Supply voltage that a calibration's torques scale with; NaN if they do not [V]."""
    block = calibration.joint(joint).under_load
    return float("nan") if block is None else block.reference_voltage_v or float("nan")


def at_voltage(runs: Sequence[BenchRun], reference_v: float) -> list[BenchRun]:
    """The runs with their supply voltage over a reference, where torques scale with it."""
    if not np.isfinite(reference_v):
        return list(runs)
    return [
        replace(b, run=replace(b.run, held=with_voltage(b.run, b.trial, reference_v))) for b in runs
    ]


def predict(
    calibration: Calibration, joint: str, runs: Sequence[BenchRun]
) -> tuple[list[NDArray[np.float64]], float]:
    """Predicted readings at the steps of each run, and the mean offset of recordings [rad].

    Parameters
    ----------
    calibration : Calibration
    joint : str
    runs : sequence of BenchRun
    """
    servo = _Servo.of(calibration, joint)
    offset = dict.fromkeys((b.recording for b in runs), 0.0)
    runs = with_ramps(calibration, joint, runs)
    tracks = [servo.track(b, 0.0) for b in runs]
    if all(b.offset_known for b in runs):
        return tracks, 0.0
    for _ in range(3):  # the offset moves the start, and with it a little itself
        for place in offset:
            own = [(b, t) for b, t in zip(runs, tracks, strict=True) if b.recording == place]
            if own[0][0].offset_known:
                continue
            left = [b.run.sample_rad - at_steps(t, b.run.sample_step) for b, t in own]
            offset[place] += float(np.median(np.concatenate(left)))
        tracks = [servo.track(b, offset[b.recording]) for b in runs]
    return tracks, float(np.mean(list(offset.values())))


def with_ramps(calibration: Calibration, joint: str, runs: Sequence[BenchRun]) -> list[BenchRun]:
    """The runs, with the limit on the set-point's acceleration that suits their readings best.

    For a calibration that limits it; a recording that states its register keeps it.
    """
    servo = _Servo.of(calibration, joint)
    if not np.isfinite(servo.parameters.acceleration_limit):
        return list(runs)
    found = list(runs)
    for place in {b.recording for b in runs}:
        own = [n for n, b in enumerate(runs) if b.recording == place]
        spread = []
        for share in RAMP_SHARES:
            left = []
            for n in own:
                found[n] = b = replace(runs[n], run=with_ramp(runs[n].run, share))
                left.append(b.run.sample_rad - at_steps(servo.track(b, 0.0), b.run.sample_step))
            every = np.concatenate(left)
            spread.append(float(np.mean(np.abs(every - np.median(every)))))
        best = RAMP_SHARES[int(np.argmin(spread))]
        for n in own:
            found[n] = replace(runs[n], run=with_ramp(runs[n].run, best))
    return found


@dataclass(frozen=True)
class _Servo:
    """A calibrated servo as the kernel takes it."""

    parameters: LoadedServoParameters
    p_gain: float | None  # of its own, where it knows no other
    gravity: tuple[float, float]  # of an unknown load: torque [N·m], hanging position [rad]
    velocity_limit: float

    @classmethod
    def of(cls, calibration: Calibration, joint: str) -> _Servo:
        own = calibration.joint(joint)
        dead_time = own.actuator.dead_time_s.value
        block = own.under_load
        if block is not None:
            gravity = block.gravity_nm.value if block.gravity_nm else 0.0
            hanging = block.hanging_rad.value if block.hanging_rad else 0.0
            slowest = own.actuator.velocity_limit_rad_s.value
            limit = slowest if slowest < NO_SPEED_LIMIT_RAD_S else np.inf
            return cls(block.servo(dead_time), None, (gravity, hanging), limit)
        pd = own.actuator.parameters.arrays()
        stall = min(float(pd["effort_limit"]), _NO_LIMIT_NM)
        parameters = LoadedServoParameters(
            duty_per_rad=pd["stiffness"] / stall,
            duty_s_per_rad=pd["damping"] / stall,
            stall_torque=stall,
            back_emf=pd["back_emf"],
            armature=pd["armature"],
            friction_loss=pd["friction_loss"],
            dead_time_s=dead_time,
        )
        return cls(parameters, 1.0, (0.0, 0.0), float(pd["velocity_limit"]))

    def track(self, bench: BenchRun, offset_rad: float) -> NDArray[np.float64]:
        """Predicted readings at the steps of one run [rad]."""
        run = bench.run
        row = np.zeros((1, WIDTH))
        own = self.parameters.arrays()
        row[0, : len(COLUMNS)] = [float(own[name]) for name in COLUMNS]
        gravity, hanging = self.gravity
        if run.load[1] == 0.0:
            row[0, OFFSET - 2] = gravity
        row[0, OFFSET - 1], row[0, OFFSET] = hanging, offset_rad
        gain = run.p_gain if self.p_gain is None else self.p_gain
        held = run.held
        if np.isfinite(self.velocity_limit):
            held = held.copy()
            held[0] = slewed(held[0], self.velocity_limit * run.step_s, run.start_rad - offset_rad)
        changed = replace(run, p_gain=gain, held=held)
        dead_time = np.array([float(own["dead_time_s"])])
        return simulate(row, dead_time, changed)[:, 0]


def slewed(command: NDArray[np.float64], step: float, start: float) -> NDArray[np.float64]:
    """The set-point that follows a command at a limited rate."""
    out, now = np.empty_like(command), start
    for k, wanted in enumerate(command):
        now += min(max(wanted - now, -step), step)
        out[k] = now
    return out


def errors(
    runs: Sequence[BenchRun], tracks: Sequence[NDArray[np.float64]]
) -> dict[str, NDArray[np.float64]]:
    """Model minus reading of all rows [rad], `raw` and `held`, and `fresh` readings alone."""
    found: dict[str, list[NDArray[np.float64]]] = {"raw": [], "held": [], "fresh": []}
    for bench, track in zip(runs, tracks, strict=True):
        run = bench.run
        dated = np.isfinite(run.held_step)
        shown = np.where(dated, run.held_step, run.row_step)
        found["raw"].append(at_steps(track, shown) - run.row_rad)
        found["held"].append(at_steps(track, run.held_step) - run.row_rad)
        found["fresh"].append(at_steps(track, run.sample_step) - run.sample_rad)
    return {name: _known(np.concatenate(parts)) for name, parts in found.items()}


def one_step(
    runs: Sequence[BenchRun], tracks: Sequence[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """The model's move from reading to reading, less the readings' own [rad]."""
    return np.concatenate(
        [
            np.diff(at_steps(t, b.run.sample_step) - b.run.sample_rad)
            for b, t in zip(runs, tracks, strict=True)
        ]
    )


def persistence(runs: Sequence[BenchRun]) -> float:
    """RMS of the readings' moves [rad]."""
    moves = np.concatenate([np.diff(b.run.sample_rad) for b in runs])
    return float(np.sqrt(np.mean(moves**2))) if len(moves) else float("nan")


def blocks(runs: Sequence[BenchRun]) -> list[tuple[str, int, int]]:
    """Stretch of time of each fresh reading, for a bootstrap."""
    return [
        ("", n, int(step * b.run.step_s / _BLOCK_S))
        for n, b in enumerate(runs)
        for step in b.run.sample_step
    ]


def notes(
    calibrations: Mapping[str, Calibration], runs: Mapping[str, Sequence[BenchRun]]
) -> list[str]:
    """What a reader must know of gains and loads, in sentences."""
    made = []
    for name, calibration in calibrations.items():
        for joint, own in runs.items():
            gains = sorted({b.run.p_gain for b in own if np.isfinite(b.trial.p_gain)})
            block = calibration.joint(joint).under_load
            if block is not None:
                made += [
                    f"{name}, {joint}: {said}"
                    for g in gains
                    if "was recorded" not in (said := block.how_far_tested(g))
                ]
            elif len(gains) > 1:
                made.append(
                    f"{name}, {joint}: holds at one P gain; these runs have "
                    f"{', '.join(f'{g:g}' for g in gains)}."
                )
        freed = [
            joint
            for joint, own in runs.items()
            if any(
                b.run.ramp_share > 1 and not b.run.ramp_known
                for b in with_ramps(calibration, joint, own)
            )
        ]
        if freed:
            made.append(
                f"{name}: its limit on the set-point's acceleration is raised or taken out in runs "
                f"of {', '.join(freed)}, which move as if a register had done so."
            )
    return list(dict.fromkeys(made))


def figure(
    runs: Mapping[str, Sequence[BenchRun]],
    tracks: Mapping[str, Mapping[str, Sequence[NDArray[np.float64]]]],
    joints: Sequence[str] | None = None,
) -> Figure:
    """Commands, readings and models in free run, a panel per run.

    Parameters
    ----------
    runs : mapping of joint to runs
    tracks : mapping of model, then joint, to tracks
    joints : sequence of str, optional
        By default all.
    """
    from matplotlib.figure import Figure

    shown = [(j, n) for j in joints or runs for n in range(len(runs[j]))][:16]
    columns = min(len(shown), 2)
    rows = -(-len(shown) // columns)
    drawn = Figure(figsize=(6.4 * columns, 2.6 * rows), layout="constrained")
    axes = np.atleast_1d(drawn.subplots(rows, columns, squeeze=False)).ravel()
    for axis, (joint, n) in zip(axes, shown, strict=False):
        run = runs[joint][n].run
        step = run.step_s
        command = run.held[0, run.rest :]
        axis.plot(step * np.arange(len(command)), command, "0.7", lw=0.8, label="command")
        axis.plot(step * run.row_step, run.row_rad, "k.", ms=1.5, label="reading")
        for name, own in tracks.items():
            track = own[joint][n]
            axis.plot(step * np.arange(len(track)), track, lw=1.0, label=name)
        axis.set_title(f"{joint}, {run.label}", fontsize="small")
        axis.set_xlabel("time [s]")
        axis.set_ylabel("position [rad]")
    axes[0].legend(fontsize="x-small")
    for axis in axes[len(shown) :]:
        axis.set_visible(False)
    return drawn


def _known(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values[np.isfinite(values)]
