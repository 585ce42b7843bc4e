"""Twin test: how much the simulated robot moves like the real one.

`twin` gives the commands of a recording to the whole simulated robot, with the servos of one or of
several actuators, in the air (its trunk fixed) and on the ground. Each predicts the readings that
the recording's bus would have shown of it: their age, and an offset per joint
(`sysid.servo_fit.scores`). Errors per joint stand beside the robot's repeatability and persistence,
and readings say whether the robot was on the ground (`policies.twin.playing`).

On the ground several copies move, which differ in friction and payload; the prediction is the mean
of those that stay up. A robot on its back predicts what one in the air does.

A robot's IMU log is compared with the trunk of the simulated robot on the ground. It is a CSV file
with a column of times and one per axis. Both signals get the same estimator, a least-squares
periodogram (Lomb-Scargle with a constant per frequency, J. VanderPlas, "Understanding the
Lomb-Scargle Periodogram", 2018), since a log's rows are not evenly spaced.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import lombscargle

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.figure_style import BLUE, FAINT, GREEN, INK, RED, WIDTH_IN, styled
from pupper_sysid.common.joints import share_sentences
from pupper_sysid.common.reading.content import content
from pupper_sysid.common.reading.csv_table import read_table
from pupper_sysid.common.results import Result, internal
from pupper_sysid.common.signals import rms
from pupper_sysid.policies.twin.drawing import Actuator, stronger
from pupper_sysid.policies.twin.playing import (
    STRONGER,
    Condition,
    Evidence,
    Gyro,
    Played,
    TwinErrors,
    Verdict,
    evidence,
    play,
    sequences,
)
from pupper_sysid.servo_models.calibration.calibration import Calibration, preset_notes
from pupper_sysid.sim.robot.replay import ServoRobot
from pupper_sysid.sysid.doctor.checks import chosen_joints
from pupper_sysid.sysid.fit.predict import ReadingRule, in_words, rule_of
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.report.figures import busiest
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData, servo_data
from pupper_sysid.sysid.servo_fit.scores import (
    mean_known,
    offsets,
    predicted,
    with_ages,
)
from pupper_sysid.sysid.servo_fit.windows import Part, everything

Array = NDArray[np.float64]

_RATES, _ACCELERATIONS = ("gx", "gy", "gz"), ("ax", "ay", "az")
STEP_S = 0.02
"""Between samples of the simulated gyro: the rate at which robots log theirs."""

_TIMES, _MOST_BYTES = ("timestamp", "time_s"), 100e6
_SETTLE_S, _SHORTEST_S = 2.0, 5.0
_LOW_HZ, _HIGH_HZ = 0.5, 10.0
_PER_BIN = 8  # frequencies per 1 / duration


@dataclass(frozen=True)
class ImuLog:
    """Samples of an IMU."""

    time_s: Array
    """From the first sample on, shape (n,)."""
    rate_rad_s: Array
    """Shape (n, 3)."""
    acceleration_m_s2: Array
    """NaN where none was logged, shape (n, 3)."""


def read_imu(path: Path) -> ImuLog:
    """Read the log of an IMU.

    It is a CSV file with the columns `timestamp` or `time_s` [s], `gx`, `gy`, `gz` [rad/s], and
    perhaps `ax`, `ay`, `az` [m/s²].
    """
    data = content(path, _MOST_BYTES, "Give a shorter log.")
    table = read_table(path, data.decode("utf-8", errors="replace"))
    name = next((n for n in _TIMES if n in table.numbers), _TIMES[0])
    needed = (name, *_RATES)
    if missing := [n for n in needed if n not in table.numbers]:
        raise InputError(
            f"{path} has no column {missing[0]}. An IMU log has the columns {', '.join(needed)} "
            "(s and rad/s)."
        )
    values = np.stack([table.numbers[n] for n in needed], axis=1)
    finite = np.isfinite(values).all(axis=1)
    nothing = np.full(len(values), np.nan)
    acceleration = np.stack([table.numbers.get(n, nothing) for n in _ACCELERATIONS], axis=1)
    values, acceleration = values[finite], acceleration[finite]
    time = values[:, 0]
    if (np.diff(time) <= 0).any():
        raise InputError(f"{path}: its times do not increase. Give one log per file.")
    if not len(time) or np.ptp(time) < _SETTLE_S + _SHORTEST_S:
        raise InputError(
            f"{path} is shorter than {_SETTLE_S + _SHORTEST_S:g} s, which a rhythm needs. Give a "
            "longer log."
        )
    return ImuLog(time - time[0], values[:, 1:], acceleration)


def spectrum(time_s: Array, rates_rad_s: Sequence[Array]) -> Gyro | None:
    """Spectrum after the first two seconds; None if less than five are left.

    Rates have the shape (n, 3); spectra of several robots are averaged.
    """
    late = time_s >= _SETTLE_S
    time = time_s[late]
    if not len(rates_rad_s) or len(time) < 2 or np.ptp(time) < _SHORTEST_S - STEP_S:
        return None
    highest = min(_HIGH_HZ, 0.5 / float(np.median(np.diff(time))))
    at = np.arange(_LOW_HZ, highest, 1.0 / (_PER_BIN * float(np.ptp(time))))
    rates = np.stack([rate[late] for rate in rates_rad_s])
    deviation = rates.std(axis=1).mean(axis=0)
    peaks = []
    for axis, turning in enumerate(deviation > 0):
        power = np.zeros(len(at))
        for rate in rates[..., axis] if turning else ():
            power += lombscargle(time, rate, 2 * np.pi * at, normalize=True, floating_mean=True)
        best = int(power.argmax())
        peaks.append((float(at[best]) if turning else float("nan"), power[best] / len(rates)))
    peak_hz, peak_share = zip(*peaks, strict=True)
    return Gyro(
        deviation_rad_s=tuple(map(float, deviation)), peak_hz=peak_hz,
        peak_share=tuple(map(float, peak_share)),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ActuatorTwin(Result):
    """The simulated robot with one actuator."""

    air: Condition
    ground: Condition | None
    evidence: Evidence | None
    """None of a robot that is fixed to the world."""

    @property
    def best_rad(self) -> float:
        """Smaller one of its errors [rad]."""
        return min(c.rmse_rad.value for c in (self.air, self.ground) if c)


@dataclass(frozen=True, kw_only=True)
class Twin(Result):
    """Twin test of a recording."""

    robot: str
    models: dict[str, ActuatorTwin]
    """By actuator."""
    best: str
    """The actuator with the smallest error."""
    verdict: Verdict
    """Where the robot was."""
    judge: str | None
    """The actuator by which: the best of those that were not fitted to this recording, whose
    numbers already hold what the ground did to it. None where all were."""
    scored: str
    """Which rows count."""
    readings: dict[str, ReadingRule]
    """By joint, when its readings were measured."""
    persistence_rmse_rad: dict[str, float]
    repeatability_rad: dict[str, float]
    """`persistence_rmse_rad` and `repeatability_rad`: by joint, on the same rows."""
    time_step_s: float
    """Time between commands."""
    notes: tuple[str, ...]
    data: ServoData = internal()

    @property
    def verdict_in_words(self) -> str:
        """Where the robot was, and why."""
        evidence = self.models[self.judge].evidence if self.judge else None
        if evidence is None:
            return "Nothing here says whether the robot was on the ground."
        return f"{evidence.why} (With {self.judge}.)"


def twin(
    recording: Recording,
    actuators: Mapping[str, Actuator],
    robot: ServoRobot,
    feedback: Mapping[str, Calibration] | None = None,
    test_loops: Sequence[int] = (),
    copies: int = 16,
    seed: int = 0,
    threads: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> Twin:
    """Give a recording's commands to the whole simulated robot and compare the readings.

    Actuators are by name (see `actuator_of`), the robot is that of `robot_for` the recording.
    `feedback` are calibrations of the same bus, by name, whose poll is used where the recording
    does not show its own and no actuator has one. With `test_loops` only these loops are scored,
    with the offsets of the others. `copies` are the robots on the ground per actuator.
    """
    if copies < 1:
        raise InputError(f"{copies} robots; at least 1 is needed.")
    joints = chosen_joints(recording)
    data = servo_data([recording], joints, "auto", seed)
    known = {n: a.calibration for n, a in actuators.items() if a.calibration} | dict(feedback or {})
    rules = {j: rule_of(j, data.lattices[j], recording.name, known) for j in data.joints}
    data = with_ages(data, rules)
    test, rest, scored = _parts(recording, test_loops)
    motions = sequences(data, robot)
    numbers = [a.values for a in actuators.values()]
    if robot.free:
        numbers += [stronger(servos, STRONGER) for servos in numbers]
    conditions: list[list[Condition]] = []
    done, shares = 0.0, [1.0, float(copies)] if robot.free else [1.0]
    for place, share in enumerate(shares):
        part = share / sum(shares)
        played = play(
            robot, place == 0, numbers, motions, data, copies, seed, threads,
            lambda share, done=done, part=part: progress(done + part * share),
        )  # fmt: skip
        conditions.append([_condition(copy, data, test, rest, seed) for copy in played])
        done += part
    models = {
        name: _twin_of([servos[k :: len(actuators)] for servos in conditions], data, test, seed)
        for k, name in enumerate(actuators)
    }
    judges = [
        name for name, actuator in actuators.items()
        if all(source.sha256 != recording.sha256
               for source in (actuator.calibration.inputs if actuator.calibration else []))
    ]  # fmt: skip
    judge = min(judges, key=lambda name: models[name].best_rad, default=None)
    judged = models[judge].evidence if judge else None
    return Twin(
        robot=robot.name, models=models, best=min(models, key=lambda name: models[name].best_rad),
        verdict=judged.verdict if judged else "cannot tell", judge=judge, scored=scored,
        readings=rules, persistence_rmse_rad=scores.persistence(data, test),
        repeatability_rad=scores.repeatability(data, test), time_step_s=data.period_s,
        notes=tuple(_notes(actuators, robot, models, rules)), data=data,
    )  # fmt: skip


def _parts(recording: Recording, test_loops: Sequence[int]) -> tuple[Part, Part, str]:
    """Rows to score, rows of the offsets, and the former in words."""
    if not test_loops:
        return everything, everything, "the whole recording"
    loops = sorted({int(n) for n in recording.table["trial"].unique()})
    if strange := [n for n in test_loops if n not in loops]:
        raise InputError(
            f"{recording.name} has no loop {strange[0]}: its loops are "
            f"{', '.join(map(str, loops))}. Name some of them in `test_loops`."
        )
    if set(test_loops) == set(loops):
        raise InputError(
            f"`test_loops` names all loops of {recording.name}: one must be left to estimate the "
            "offsets from. Leave one out, or give no loops."
        )
    chosen, listed = list(test_loops), ", ".join(map(str, test_loops))
    return (
        lambda number, elapsed, group: np.isin(number, chosen),
        lambda number, elapsed, group: ~np.isin(number, chosen),
        f"loop {listed}, with the offsets of the others",
    )


def _condition(played: Played, data: ServoData, test: Part, rest: Part, seed: int) -> Condition:
    """Scores of one simulated robot."""
    zero = {joint: shift[0] for joint, shift in offsets(played.tracks, data, rest).items()}
    tracks = {joint: [t + zero[joint] for t in played.tracks[joint]] for joint in data.joints}
    errors = scores.errors(None, tracks, data, test)
    joints = {
        joint: TwinErrors(
            mae_rad=float(np.mean(np.abs(e.free_run))), rmse_rad=rms(e.free_run),
            rmse_raw_rad=rms(e.raw), offset_rad=zero[joint],
        )
        for joint, e in errors.items()
    }  # fmt: skip
    names = ("mae_rad", "rmse_rad", "rmse_raw_rad")
    means = {n: scores.mean_known([getattr(j, n) for j in joints.values()]) for n in names}
    offset = float(np.mean(np.abs([j.offset_rad for j in joints.values()])))
    mean = TwinErrors(**means, offset_rad=offset)
    times = STEP_S * np.arange(len(played.gyro[0]) if played.gyro else 0, dtype=float)
    return Condition(
        joints=joints, mean=mean, rmse_rad=scores.interval(errors, seed), copies=played.copies,
        upright=played.upright, gyro=spectrum(times, played.gyro), errors=errors, tracks=tracks,
        first_fall_s=played.first_fall_s if np.isfinite(played.first_fall_s) else None,
    )  # fmt: skip


def _twin_of(
    conditions: Sequence[Sequence[Condition]], data: ServoData, test: Part, seed: int
) -> ActuatorTwin:
    """Conditions of one actuator, its torques as they are and stronger, and what they say."""
    if len(conditions) == 1:
        return ActuatorTwin(air=conditions[0][0], ground=None, evidence=None)
    cases = list(zip(*conditions, strict=True))
    air, ground = cases[0]
    return ActuatorTwin(air=air, ground=ground, evidence=evidence(cases, data, test, seed))


def _notes(
    actuators: Mapping[str, Actuator],
    robot: ServoRobot,
    models: Mapping[str, ActuatorTwin],
    rules: Mapping[str, ReadingRule],
) -> list[str]:
    notes = [*in_words(rules)]
    if not robot.free:
        notes.append(f"{robot.name} is fixed to the world in its model: there is no other ground.")
    for name, servos in actuators.items():
        sources = {joint: [f"{source}'s numbers"] for joint, source in servos.fallbacks.items()}
        notes += [f"{name}: {j} have {sentence}." for j, sentence in share_sentences(sources)]
        ground = models[name].ground
        if ground and not ground.upright:
            notes.append(
                f"{name}: no simulated robot stays up (the first falls after "
                f"{ground.first_fall_s:.1f} s). On its back it moves as in the air, so air "
                "and ground cannot be distinguished."
            )
    return notes + preset_notes(actuators)


PLACES = (("air", BLUE, "in the air"), ("ground", RED, "on the ground"))
_COLUMNS, _SHOWN_S = 3, 2.5
_BAR = 0.36


@styled
def twin_figure(result: Twin) -> Figure:
    """Errors of every actuator; below, two seconds of each joint with the best one."""
    joints = result.data.joints
    columns = min(_COLUMNS, len(joints))
    rows = -(-len(joints) // columns)
    top = 1.1 + 0.42 * len(result.models)
    figure = Figure(figsize=(2 * WIDTH_IN, top + 1.7 * rows), layout="constrained")
    grid = figure.add_gridspec(1 + rows, columns, height_ratios=[top, *[1.7] * rows])
    draw_bars(figure.add_subplot(grid[0, :]), result)
    first = None
    for k, joint in enumerate(joints):
        axes = figure.add_subplot(grid[1 + k // columns, k % columns], sharex=first)
        first = first or axes
        draw_joint(axes, result, joint, result.best)
        if k % columns == 0:
            axes.set_ylabel("rad")
        if k + columns >= len(joints):
            axes.set_xlabel("time [s]")
    lines, labels = figure.axes[1].get_legend_handles_labels()
    figure.legend(
        lines, labels, loc="outside lower center", ncols=len(lines), title=f"with {result.best}"
    )
    return figure


def draw_bars(axes: Axes, result: Twin) -> None:
    """Mean error of every actuator in the air and on the ground, with 90 % intervals."""
    names = list(result.models)
    for place, colour, words in PLACES:
        shift = -_BAR / 2 if place == "air" else _BAR / 2
        for k, name in enumerate(names):
            condition: Condition | None = getattr(result.models[name], place)
            if condition is None:
                continue
            value, low, high = (1e3 * x for x in astuple(condition.rmse_rad))
            axes.barh(
                k + shift, value, _BAR, color=colour, label=words if k == 0 else None,
                xerr=[[value - low], [high - value]], ecolor=INK, capsize=2,
            )  # fmt: skip
    floor = 1e3 * mean_known(list(result.repeatability_rad.values()))
    if np.isfinite(floor):
        axes.axvline(floor, color=GREEN, ls="--", label=f"repeatability {floor:.1f}")
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set(xlabel="RMS error of predicted readings, mean of the joints [mrad]", xlim=(0, None))
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)


def draw_joint(axes: Axes, result: Twin, joint: str, actuator: str) -> None:
    """Readings of a joint where its command moves most, and what an actuator predicts."""
    runs, model = result.data.runs[joint], result.models[actuator]
    place = max(range(len(runs)), key=lambda n: np.std(runs[n].command_rad))
    run = runs[place]
    time = run.trial.send_time_s - run.trial.send_time_s[0]
    rows = busiest(run.command_rad, max(int(_SHOWN_S / result.time_step_s), 2))
    time = time[rows] - time[rows][0]
    axes.step(time, run.command_rad[rows], where="post", color=FAINT, lw=0.9, label="command")
    axes.plot(time, run.trial.position_rad[rows], "o", ms=2.2, color=INK, label="readings")
    for key, colour, words in PLACES:
        condition: Condition | None = getattr(model, key)
        if condition is not None:
            line = predicted(condition.tracks[joint][place], run, run.reading_tick)[rows]
            axes.plot(time, line, color=colour, lw=1.1, label=words)
    axes.set_title(joint)
