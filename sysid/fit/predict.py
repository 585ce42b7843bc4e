"""Predict what a bus would have shown of a calibrated servo: on each run, by one rule for all.

Every trial is a run of its own (`sysid.fit.run`): it starts at rest where the joint rested, and the
servo moves freely under its commands, at its gain and load, with the torque off where it was. What
a calibration predicts comes from what it says; the readings that score it choose nothing but the
offset, which is a property of the recording (its zero, or its joint map's): the median of reading
minus prediction. Where the load is known no offset is taken out: command and reading share the
encoder's zero, and droop is the model's to predict.

Readings on a polled bus are old. A joint's readings are

* `live`: measured at their read;
* `own dates`: the recording shows its poll lattice, which dates each reading;
* `expected`: it does not (a slow loop hides the poll), but the calibration knows period and loss of
  the poll. The phase is unknown, so the prediction is the mean over the ages that a reading may
  have: uniform within a period, and a period more for each lost poll;
* `as logged`: nothing is known of the poll; the age of the readings counts as an error.

The rounding of readings to counts of size q adds q/√12 to the error, and nothing to the prediction,
as long as the error is larger than half a count.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import Result
from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import NO_SPEED_LIMIT_RAD_S
from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.servo_models.kernel import COLUMNS
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters
from pupper_sysid.servo_models.step_size import CONTINUOUS_S, at_step
from pupper_sysid.sysid.doctor.checks import joint_rng
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice
from pupper_sysid.sysid.fit.run import (
    SHORTEST_STEP_S,
    Run,
    at_steps,
    prepare,
    simulate,
    with_voltage,
)
from pupper_sysid.sysid.fit.scores import known
from pupper_sysid.sysid.fit.structure import loaded_columns
from pupper_sysid.sysid.recordings.recording import Recording, Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NO_LIMIT_NM = 1e9  # of the torque of a model without an effort limit
_BLOCK_S = 0.5
_INSTANTS = 48  # of an expectation: 0.05 mrad from the integral for motions of 10 rad/s


@dataclass(frozen=True, kw_only=True)
class ReadingRule(Result):
    """When the readings of one joint were measured.

    Attributes
    ----------
    rule : {"live", "own dates", "expected", "as logged"}
    source : str
        Recording or calibration that the numbers are of.
    poll_period_s, loss, mean_age_s : float
        Of the bus; NaN where unknown.
    """

    rule: str
    source: str
    poll_period_s: float = math.nan
    loss: float = math.nan
    mean_age_s: float = math.nan


def in_words(rules: Mapping[str, ReadingRule]) -> list[str]:
    """How the readings of all joints are predicted, one sentence per rule and source."""
    grouped: dict[tuple[str, str], list[str]] = {}
    for joint, rule in rules.items():
        grouped.setdefault((rule.rule, rule.source), []).append(joint)
    return [
        f"{', '.join(joints)}: {_sentence(*key, [rules[j] for j in joints])}."
        for key, joints in grouped.items()
    ]


def _sentence(rule: str, source: str, rules: Sequence[ReadingRule]) -> str:
    parts = {"poll": ("poll_period_s", 1e3, 1, " ms"), "loss": ("loss", 1, 2, ""),
             "mean age": ("mean_age_s", 1e3, 1, " ms")}  # fmt: skip
    known = [
        f"{what} {_span(values, digits)}{unit}"
        for what, (key, scale, digits, unit) in parts.items()
        if (values := [scale * v for r in rules if math.isfinite(v := getattr(r, key))])
    ]
    poll = ", ".join(known)
    return {
        "live": f"the readings of {source} are live and predicted at their read",
        "own dates": f"predicted at the dates of {source}'s own poll schedule ({poll})",
        "expected": (
            "the recording does not show its poll; predicted in the mean over the phase and the "
            f"losses of {source} ({poll})"
        ),
        "as logged": (
            "nothing is known of the poll, so the age of readings counts as an error; a "
            "calibration of a sweep on the same bus knows it"
        ),
    }[rule]


def _span(values: Sequence[float], digits: int) -> str:
    """One number, or the smallest and the largest."""
    ends = list(dict.fromkeys(f"{x:.{digits}f}" for x in (min(values), max(values))))
    return "–".join(ends)


def rule_of(
    joint: str,
    lattice: PollLattice,
    source: str,
    calibrations: Mapping[str, Calibration] | None = None,
) -> ReadingRule:
    """When the readings of a joint were measured.

    `lattice`: of the recordings. `source`: names of the recordings. `calibrations`: of the same
    bus, by name: the poll of the first that knows it is used where the recordings do not show
    theirs.
    """
    if lattice.kind == "every read":
        return ReadingRule(rule="live", source=source, poll_period_s=0.0, loss=0.0, mean_age_s=0.0)
    if lattice.kind == "lattice":
        return ReadingRule(
            rule="own dates", source=source, poll_period_s=lattice.poll_period_s,
            loss=lattice.loss, mean_age_s=lattice.mean_age_s,
        )  # fmt: skip
    for name, calibration in (calibrations or {}).items():
        if joint not in calibration.joint_names:
            continue
        poll = calibration.held_feedback(joint)
        if poll.poll_period_s > 0:
            return ReadingRule(
                rule="expected", source=name, poll_period_s=poll.poll_period_s, loss=poll.loss,
                mean_age_s=poll.mean_age_s,
            )  # fmt: skip
    return ReadingRule(rule="as logged", source=source)


def ages(poll_period_s: float, loss: float, count: int = _INSTANTS) -> NDArray[np.float64]:
    """Equally probable ages of a reading at a random phase of the poll [s], shape (count,).

    The age is uniform within a period, plus k periods with probability (1 - loss) lossᵏ; these are
    the middles of `count` quantiles, moved together so that their mean is that of `HeldFeedback`.

    Examples
    --------
    >>> ages(0.02, 0.0, 4).round(4).tolist()
    [0.0025, 0.0075, 0.0125, 0.0175]
    """
    chance = (np.arange(count) + 0.5) / count
    # 1 - lossᵏ: the age is at most k periods with this probability
    k = np.zeros(count) if loss <= 0 else np.floor(np.log1p(-chance) / math.log(loss))
    within = (chance - (1 - loss**k)) / ((1 - loss) * loss**k)
    ages_s = poll_period_s * (k + within)
    return ages_s * (HeldFeedback(poll_period_s, loss).mean_age_s / ages_s.mean())


@dataclass(frozen=True)
class ComparedRun:
    """One trial to compare on.

    Attributes
    ----------
    trial : Trial
    run : Run
    recording : int
        Place of its recording.
    offset_known : bool
        Whether readings and commands share their zero.
    """

    trial: Trial
    run: Run
    recording: int
    offset_known: bool


def compared_runs(
    recordings: Sequence[Recording], joint: str, lattice: PollLattice
) -> list[ComparedRun]:
    """Runs of a joint in all recordings.

    Raises InputError if there are no readings.
    """
    runs = [
        ComparedRun(trial, run, place, trial.load is not None)
        for place, recording in enumerate(recordings)
        for trial in recording.trials(joint)
        if np.isfinite((run := prepare(trial, lattice, step_s=SHORTEST_STEP_S)).row_rad).any()
    ]
    if not runs:
        raise InputError(f"{joint}: no readings to compare with. Record it again.")
    return runs


def poll_of(
    recordings: Sequence[Recording], joint: str, seed: int,
    lattices: Mapping[str, PollLattice] | None,
) -> PollLattice:  # fmt: skip
    """Poll of a joint's readings, searched for unless it is known."""
    trials = tuple(t for r in recordings for t in r.trials(joint))
    return (lattices or {}).get(joint) or find_poll_lattice(trials, joint_rng(seed, joint))


@dataclass(frozen=True)
class Prediction:
    """A calibrated servo on the runs of a joint.

    Attributes
    ----------
    runs : tuple of ComparedRun
    rule : ReadingRule
    tracks : list of ndarray, shape (steps + 1,) each
        Readings at step edges, were they live [rad].
    offset_rad : float
        Mean over recordings.
    count_all : bool
        Whether all rows count, not the fresh ones alone.
    """

    runs: tuple[ComparedRun, ...]
    rule: ReadingRule
    tracks: list[NDArray[np.float64]]
    offset_rad: float
    count_all: bool

    def errors(self) -> dict[str, NDArray[np.float64]]:
        """Prediction minus reading [rad]: `counted` readings, all rows `raw` and `held`."""
        parts: dict[str, list[NDArray[np.float64]]] = {"counted": [], "raw": [], "held": []}
        for compared, track in zip(self.runs, self.tracks, strict=True):
            run = compared.run
            parts["raw"].append(known(_shown(track, run, self.rule)[0] - run.row_rad))
            held = at_steps(track, run.held_step) - run.row_rad
            parts["held"].append(parts["raw"][-1] if self._undated else known(held))
            parts["counted"].append(self._counted(track, run))
        return {name: np.concatenate(each) for name, each in parts.items()}

    def one_step(self) -> NDArray[np.float64]:
        """The model's move from reading to reading, less the readings' own [rad]."""
        return np.concatenate([
            np.diff(self._counted(track, compared.run))
            for compared, track in zip(self.runs, self.tracks, strict=True)
        ])  # fmt: skip

    def blocks(self) -> list[tuple[str, int, int]]:
        """Stretch of time of each counted reading, for a bootstrap."""
        blocks = []
        for n, compared in enumerate(self.runs):
            run = compared.run
            step = run.row_step[np.isfinite(run.row_rad)] if self.count_all else run.sample_step
            blocks += [("", n, int(s * run.step_s / _BLOCK_S)) for s in step]
        return blocks

    def age_spread_rad(self) -> float:
        """Error that a perfect model would have, because the age of readings is unknown [rad].

        The root mean square over rows of the spread of positions over the instants at which a
        reading may have been measured; 0 where the instants are known.
        """
        spread = [
            _shown(track, compared.run, self.rule)[1]
            for compared, track in zip(self.runs, self.tracks, strict=True)
        ]
        return float(np.sqrt(np.nanmean(np.concatenate(spread) ** 2)))

    @property
    def _undated(self) -> bool:
        return self.rule.rule in ("expected", "as logged")

    def _counted(self, track: NDArray, run: Run) -> NDArray[np.float64]:
        if self.count_all:
            return known(_shown(track, run, self.rule)[0] - run.row_rad)
        return at_steps(track, run.sample_step) - run.sample_rad


def predict(
    calibration: Calibration,
    joint: str,
    runs: Sequence[ComparedRun],
    rule: ReadingRule,
    readings: str = "auto",
) -> Prediction:
    """Predict the readings of each run.

    `readings`: which readings count; `auto`: those that are dated, else all rows.
    """
    servo = _Servo.of(calibration, joint)
    runs = tuple(_at_voltage(compared, servo.reference_voltage_v) for compared in runs)
    count_all = readings == "all" or (readings == "auto" and rule.rule in ("expected", "as logged"))
    offset = dict.fromkeys((compared.recording for compared in runs), 0.0)
    free = {compared.recording for compared in runs if not compared.offset_known}
    for place in free:  # near enough to begin with: reading less command
        apart = [o.run.row_rad - o.trial.command_rad for o in runs if o.recording == place]
        offset[place] = float(np.nanmedian(np.concatenate(apart)))
    tracks = [servo.track(compared.run, offset[compared.recording]) for compared in runs]
    for _ in range(3 if free else 0):  # the offset moves the start, and with it a little itself
        prediction = Prediction(runs, rule, tracks, 0.0, count_all)
        for place in free:
            errors = [
                prediction._counted(track, compared.run)
                for compared, track in zip(runs, tracks, strict=True)
                if compared.recording == place
            ]
            every = np.concatenate(errors)
            offset[place] -= float(np.median(every)) if len(every) else 0.0
        tracks = [servo.track(compared.run, offset[compared.recording]) for compared in runs]
    return Prediction(runs, rule, tracks, float(np.mean(list(offset.values()))), count_all)


def track_of(
    calibration: Calibration, joint: str, run: Run, offset_rad: float = 0.0
) -> NDArray[np.float64]:
    """Readings that a calibration predicts at the steps of one run, were they live [rad]."""
    return _Servo.of(calibration, joint).track(run, offset_rad)


def persistence(runs: Sequence[ComparedRun]) -> float:
    """RMS of the readings' moves [rad]."""
    return rms(*(np.diff(compared.run.sample_rad) for compared in runs))


def notes(
    calibrations: Mapping[str, Calibration], runs: Mapping[str, Sequence[ComparedRun]]
) -> list[str]:
    """What a reader must know of gains and loads, in sentences."""
    sentences = []
    for name, calibration in calibrations.items():
        for joint, joint_runs in runs.items():
            sentences += _torque_off_notes(name, calibration, joint, joint_runs)
            gains = sorted({b.run.p_gain for b in joint_runs if np.isfinite(b.trial.p_gain)})
            block = calibration.joint(joint).servo
            if block is not None:
                sentences += [
                    f"{name}, {joint}: {tested}"
                    for g in gains
                    if "was recorded" not in (tested := block.how_far_tested(g))
                ]
            elif len(gains) > 1:
                sentences.append(
                    f"{name}, {joint}: holds at one P gain; these runs have "
                    f"{', '.join(f'{g:g}' for g in gains)}."
                )
    return list(dict.fromkeys(sentences))


def _torque_off_notes(
    name: str, calibration: Calibration, joint: str, runs: Sequence[ComparedRun]
) -> list[str]:
    """A sentence if a model is scored with the torque off, though it was never fitted there."""
    off_s = sum(
        np.count_nonzero(compared.run.torque_on < 0.5) * compared.run.step_s for compared in runs
    )
    block = calibration.joint(joint).servo
    if not off_s or (block is not None and block.off_brake is not None):
        return []
    return [
        f"{name}, {joint}: the torque is off for {off_s:.3g} s of these runs, and was never off in "
        "the recordings of the calibration, so how the servo brakes then (`off_brake`) is unknown; "
        "the model turns without back-EMF there. Calibrate with a run in which the torque is "
        "switched off, such as a sweep of the kind `drop`."
    ]


@dataclass(frozen=True)
class _Servo:
    """A calibrated servo as the kernel takes it."""

    parameters: LoadedServoParameters
    p_gain: float | None  # of its own, where it knows no other
    gravity: tuple[float, float]  # of an unknown load: torque [N·m], hanging position [rad]
    velocity_limit: float
    reference_voltage_v: float

    @classmethod
    def of(cls, calibration: Calibration, joint: str) -> _Servo:
        fitted = calibration.joint(joint)
        # the servo's own numbers, of an older file, too
        fitted_step_s = fitted.actuator.fitted_step_s
        numbers = at_step(fitted.actuator.parameters, CONTINUOUS_S, fitted_step_s)
        pd = {name: float(np.squeeze(x)) for name, x in numbers.arrays().items()}
        dead_time = pd["dead_time_s"]
        slowest = fitted.actuator.velocity_limit_rad_s.value
        limit = slowest if slowest < NO_SPEED_LIMIT_RAD_S else np.inf
        block = fitted.servo
        if block is not None:
            gravity = block.gravity_nm.value if block.gravity_nm else 0.0
            hanging = block.hanging_rad.value if block.hanging_rad else 0.0
            volts = block.reference_voltage_v or math.nan
            stated = fitted.actuator.dead_time_s.value  # the numbers of a block are the servo's own
            return cls(block.parameters(stated), None, (gravity, hanging), limit, volts)
        stall = min(pd["effort_limit"], _NO_LIMIT_NM)
        parameters = LoadedServoParameters(
            duty_per_rad=pd["stiffness"] / stall,
            duty_s_per_rad=pd["damping"] / stall,
            stall_torque=stall,
            back_emf=pd["back_emf"],
            armature=pd["armature"],
            friction_loss=pd["friction_loss"],
            dead_time_s=dead_time,
        )
        return cls(parameters, 1.0, (0.0, 0.0), limit, math.nan)

    def track(self, run: Run, offset_rad: float) -> NDArray[np.float64]:
        """Predicted readings at the steps of one run [rad]."""
        columns = loaded_columns(self.parameters)
        gravity, hanging = self.gravity
        also = {
            "hanging_rad": hanging,
            "offset_rad": offset_rad,
            "velocity_limit": self.velocity_limit,
        }
        if run.load[1] == 0.0:
            also["gravity_nm"] = gravity
        for name, value in also.items():
            columns[COLUMNS.index(name)] = value
        gain = run.p_gain if self.p_gain is None else self.p_gain
        dead_time = np.array([float(np.asarray(self.parameters.dead_time_s))])
        return simulate(columns[None], dead_time, replace(run, p_gain=gain))[:, 0]


def _at_voltage(compared: ComparedRun, reference_v: float) -> ComparedRun:
    """The run with its supply voltage over a reference, where torques scale with it."""
    if not np.isfinite(reference_v):
        return compared
    return replace(compared, run=with_voltage(compared.run, compared.trial, reference_v))


def _shown(
    track: NDArray[np.float64], run: Run, rule: ReadingRule
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and spread of what a bus shows in each row [rad], shape (rows,) each."""
    if rule.rule != "expected":
        # a dated value is as old as it is, in whatever row it is shown
        dated = (rule.rule == "own dates") & np.isfinite(run.held_step)
        step = np.where(dated, run.held_step, run.row_step)
        return at_steps(track, step), np.zeros(len(step))
    old = ages(rule.poll_period_s, rule.loss) / run.step_s
    instants = at_steps(track, np.maximum(run.row_step[:, None] - old, 0.0))
    return instants.mean(axis=1), instants.std(axis=1)


def run_figure(
    runs: Mapping[str, Sequence[ComparedRun]],
    tracks: Mapping[str, Mapping[str, Sequence[NDArray[np.float64]]]],
    joints: Sequence[str] | None = None,
) -> Figure:
    """Commands, readings and models in free run, a panel per run.

    `joints`: by default all.
    """
    from matplotlib.figure import Figure

    panels = [(j, n) for j in joints or runs for n in range(len(runs[j]))][:16]
    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    drawn = Figure(figsize=(6.4 * columns, 2.6 * rows), layout="constrained")
    axes = np.atleast_1d(drawn.subplots(rows, columns, squeeze=False)).ravel()
    for axis, (joint, n) in zip(axes, panels, strict=False):
        run = runs[joint][n].run
        step = run.step_s
        command = run.command
        axis.plot(step * np.arange(len(command)), command, "0.7", lw=0.8, label="command")
        axis.plot(step * run.row_step, run.row_rad, "k.", ms=1.5, label="reading")
        for name, model_tracks in tracks.items():
            track = model_tracks[joint][n]
            axis.plot(step * np.arange(len(track)), track, lw=1.0, label=name)
        axis.set_title(f"{joint}, {run.label}", fontsize="small")
        axis.set_xlabel("time [s]")
        axis.set_ylabel("position [rad]")
    axes[0].legend(fontsize="x-small")
    for axis in axes[len(panels) :]:
        axis.set_visible(False)
    return drawn
