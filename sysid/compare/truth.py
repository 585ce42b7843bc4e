"""Compare a calibration with the true parameters of an emulated robot.

`pupper-sysid sweep --truth` writes them beside the recording (`<recording>.truth.yaml`).
`truth_table` puts each calibrated number with its 90 % interval beside the true one, and says
whether the interval holds it. Torques are compared as ratios to the armature, because a recording
in free air determines no more. The true lag is measured on the true servo's motion under the
recording's own commands, with the weights of the recording's tones.

Both sides have the calibration's definitions (`defined_as`): its P gain, its armature (motor and
gears alone where it was made under a known load, else with the load), and the dead time that gives
the true lag in its physics steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from pupper_sysid.common.border import read_yaml, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import JointCalibration, OperatingPoint
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.servo_models.delayed_pd import TORQUES, DelayedPD, DelayedPDParameters
from pupper_sysid.servo_models.step_size import at_step
from pupper_sysid.sysid.doctor import checks
from pupper_sysid.sysid.doctor.checks import Recordings
from pupper_sysid.sysid.feedback.poll_lattice import Readings, find_poll_lattice, readings
from pupper_sysid.sysid.fit.run import whole_counts
from pupper_sysid.sysid.lag.lag_budget import lag_budget
from pupper_sysid.sysid.lag.tone import tone_lags, tone_response, tone_weights
from pupper_sysid.sysid.recordings.recording import Trial

ENDING = ".truth.yaml"
"""What a recording's name ends in where its true parameters stand, instead of `.csv`."""

_EMULATOR_STEP_S = 0.001
_GRID_S = 0.001
_ROUNDING = 1e-6  # of files: a quantisation step has an interval of no width


class _Joint(BaseModel):
    """True parameters of one joint."""

    model_config = ConfigDict(extra="ignore")

    actuator: dict[str, float]
    """Numbers of the servo: stiffness, damping, friction_loss, armature, dead_time_s, …"""
    feedback: dict[str, float]
    """Numbers of its readings: poll_period_s, loss, quantum_rad, offset_rad, mean_age_s."""
    loaded_servo: dict[str, float] | None = None
    """Of a servo on a bench, its own numbers, without the load, and the load's."""
    registers: dict[str, int] | None = None
    """Registers that `actuator` holds for; `p` is its P gain."""


class _Truth(BaseModel):
    """A file of true parameters."""

    model_config = ConfigDict(extra="ignore")

    joints: Annotated[dict[str, _Joint], Field(min_length=1)]
    """Joints by name."""


@dataclass(frozen=True, kw_only=True)
class TruthRow(Result):
    """One quantity of one joint: found and true."""

    joint: str
    quantity: str
    """`joint` and `quantity`: `stiffness`, `damping`, `friction_loss`, `effort_limit`, `back_emf`
    and, where damping alone is not known, `damping_and_back_emf` are ratios to the armature; the
    other names end in their unit."""
    found: Interval
    """With its 90 % interval; NaN at ends that the calibration does not give."""
    identified: str
    """Whether the calibration calls it determined."""
    truth: float
    held: bool | None
    """Whether the interval holds the truth; None without an interval."""


@dataclass(frozen=True, kw_only=True)
class TruthTable(Result):
    """A calibration beside the truth."""

    quantities: tuple[TruthRow, ...]
    """By joint, in the order of the calibration."""
    definitions: tuple[str, ...] = ()
    """P gain, armature and load that the numbers of both sides are for, a sentence per joint."""
    notes: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[TruthRow]:
        return iter(self.quantities)

    def rows(self) -> list[dict[str, Any]]:
        """One row per joint and quantity."""
        return [row.rows()[0] for row in self.quantities]


_READINGS = ("poll_period_s", "loss", "mean_age_s", "quantum_rad", "offset_rad")


def _pairs(
    joint: JointCalibration, actuator: Mapping[str, float], feedback: Mapping[str, float]
) -> dict[str, tuple[Quantity, float]]:
    """Quantities of a calibration by name, each with the truth's number (NaN where it has none)."""
    a, ratios = joint.actuator, joint.actuator.ratios_to_armature
    inertia = actuator["armature"]
    torques = {n: (getattr(ratios, n), actuator.get(n, 0.0) / inertia) for n in TORQUES}
    both = ratios.damping_and_back_emf
    if both is not None and ratios.damping.identified == "no":
        known = sum(torques[n][1] for n in ("damping", "back_emf"))
        torques["damping_and_back_emf"] = both, known
    return {
        "dead_time_s": (a.dead_time_s, actuator.get("dead_time_s", math.nan)),
        **torques,
        "velocity_limit_rad_s": (a.velocity_limit_rad_s, actuator.get("velocity_limit", math.nan)),
        "command_jitter_s": (a.command_jitter_s, actuator.get("command_jitter_s", math.nan)),
        **{n: (getattr(joint.feedback, n), feedback.get(n, math.nan)) for n in _READINGS},
    }


def truth_table(
    calibration: Calibration,
    truth: Mapping[str, Any],
    recordings: Recordings | None = None,
    joints: Sequence[str] | None = None,
) -> TruthTable:
    """Each quantity of a calibration beside the true one, of all joints that both have, or some.

    `truth` is as `EmulatedRobot.truth()` gives it and `read_truth` reads it. The lag depends on the
    commands: it is compared if the `recordings` are those that the calibration was made from.
    """
    notes: tuple[str, ...] = ()
    made_from = {i.sha256 for i in calibration.inputs}
    if recordings is not None and {r.sha256 for r in checks.as_sequence(recordings)} != made_from:
        recordings = None
        names = ", ".join(i.name for i in calibration.inputs) or "no recording"
        notes = (
            f"The calibration was made from {names}, so its lag, which depends on the commands, is "
            "not compared.",
        )
    both = [j for j in calibration.joint_names if j in truth["joints"]]
    if joints is not None:
        both = [j for j in both if j in joints]
    if not both:
        raise InputError(
            f"The calibration has {', '.join(calibration.joint_names)}, the truth "
            f"{', '.join(truth['joints'])}"
            + (f", and {', '.join(joints)} was asked for" if joints is not None else "")
            + ": no joint in common."
        )
    rows: list[TruthRow] = []
    definitions = []
    for joint in both:
        fitted, true = calibration.joint(joint), truth["joints"][joint]
        feedback, point = true["feedback"], fitted.holds_at
        stepped = defined_as(point, true, fitted.actuator.fitted_step_s)
        definitions.append(f"{joint}: {point}.")
        if recordings is not None and fitted.lag.lag_s is not None:
            trials = checks.joint_trials(recordings, joint)
            moved = true | {"actuator": _at_gain(true, trials[0].p_gain)}
            lag_s = true_lag_s(trials, moved, calibration.seed or 0)
            rows.append(_row(joint, "lag_s", fitted.lag.lag_s, lag_s))
        for name, (quantity, known) in _pairs(fitted, stepped, feedback).items():
            # a part that neither servo has, and a limit that is infinite, are nothing to find
            if np.isfinite(known) and (known or quantity.value):
                rows.append(_row(joint, name, quantity, known))
    return TruthTable(quantities=tuple(rows), definitions=tuple(definitions), notes=notes)


def read_truth(recording: Path, truth: Path | None = None) -> dict[str, Any]:
    """True parameters of an emulated recording: `truth`, or the `.truth.yaml` beside the `.csv`."""
    path = truth or recording
    if not path.name.endswith(ENDING) and truth is None:
        path = recording.with_name(recording.name.removesuffix(".csv") + ENDING)
    if not path.exists():
        raise InputError(
            f"{path} does not exist, so the true parameters of {recording.name} are not known. "
            "Only recordings of an emulated robot have them: `pupper-sysid sweep --truth` writes "
            "them, and `pupper-sysid emulate ... --truth FILE` those of a robot behind a protocol."
        )
    data, lines = read_yaml(path)
    return validated(_Truth, data, path, lines).model_dump(exclude_none=True)


def true_lag_s(trials: Sequence[Trial], truth: Mapping[str, Any], seed: int = 0) -> float:
    """Lag of the true servo's motion behind the held command, under the trials' commands [s].

    `trials` and `truth` are of one joint. The weights of the tones depend on the search for the
    poll, and so on `seed`.
    """
    joint = trials[0].joint
    rng = checks.joint_rng(seed, joint)
    lattice = find_poll_lattice(trials, rng.spawn(1)[0])
    measured, clean, dense = [], [], []
    for trial in trials:
        moved = _true_motion(trial, truth)
        dense.append(moved)
        tone_lag = tone_response(trial, readings(trial, lattice), rng, draws=2)
        everything = Readings(
            np.arange(len(moved.read_time_s)), moved.read_time_s, moved.position_rad,
            moved.read_time_s, 0.0,
        )  # fmt: skip
        true = tone_response(trial, everything, rng, draws=2)
        if tone_lag is not None and true is not None:
            measured.append(tone_lag)
            clean.append(true.response)
    if not measured:
        return lag_budget(joint, dense, rng).lag_s.value
    lags = tone_lags(np.array(clean), np.array([t.frequency_hz for t in measured]))
    return float(np.average(lags, weights=tone_weights(measured)))


def _true_motion(trial: Trial, truth: Mapping[str, Any]) -> Trial:
    """The trial as a host would log it that reads the true position every millisecond."""
    step = truth.get("physics_step_s", _EMULATOR_STEP_S)
    per_row = max(round(_GRID_S / step), 1)
    # on the emulator's own steps: another grid would move it by a fraction of one
    start = float(np.floor(trial.send_time_s[0] / step) * step)
    count = int((trial.send_time_s[-1] - start) / step)
    edges = start + step * np.arange(count + 1)
    sent = np.append(trial.send_time_s, edges[-1] + 1.0)
    received = whole_counts(trial)
    area = np.concatenate([[0.0], np.cumsum(received * np.diff(sent))])
    average = np.diff(np.interp(edges, sent, area)) / step
    servo = DelayedPD(_parameters(truth["actuator"]), step)
    servo.reset(trial.initial_command_rad)
    position: NDArray[np.float64] = np.asarray(servo.rollout(average), float)
    time = edges[1:][::per_row]
    row = np.searchsorted(trial.send_time_s, time, side="right") - 1
    return Trial(
        trial.joint, trial.number, trial.frequency_hz, time, time, trial.command_rad[row],
        position[::per_row], None, trial.initial_command_rad, readings="live",
    )  # fmt: skip


def _parameters(actuator: Mapping[str, float]) -> DelayedPDParameters:
    """The true servo; parameters that the truth's emulator has not are left at their defaults."""
    known = {f.name for f in fields(DelayedPDParameters)}
    return DelayedPDParameters(**{k: v for k, v in actuator.items() if k in known})


def defined_as(
    point: OperatingPoint, truth: Mapping[str, Any], fitted_step_s: float
) -> dict[str, float]:
    """Numbers of the true actuator by the definitions of a calibration, at its operating point.

    They are those with which a servo in the calibration's steps, `fitted_step_s`, moves like the
    emulated one in its own, with the load.
    """
    actuator = _at_gain(truth, math.nan if point.p_gain is None else point.p_gain)
    step = truth.get("physics_step_s", _EMULATOR_STEP_S)
    stepped = at_step(_parameters(actuator), fitted_step_s, step).arrays()
    actuator |= {
        name: float(np.squeeze(stepped[name])) for name in stepped.keys() & actuator.keys()
    }
    bench = truth.get("loaded_servo")
    if bench is not None and point.armature == "servo":
        actuator["armature"] = bench["armature_kg_m2"]
    return actuator


def _at_gain(truth: Mapping[str, Any], p_gain: float) -> dict[str, float]:
    """The true actuator at a P gain; as it is where that is not known, or it has no such register.

    The bench's derivative gain is a register of its own, so its damping does not change.
    """
    actuator = dict(truth["actuator"])
    register_gain = (truth.get("registers") or {}).get("p")
    if register_gain and np.isfinite(p_gain):
        actuator["stiffness"] *= p_gain / register_gain
    return actuator


def _row(joint: str, name: str, fitted: Quantity, truth: float) -> TruthRow:
    low, high = (math.nan if end is None else end for end in (fitted.low, fitted.high))
    known = not math.isnan(low + high)
    rounding = _ROUNDING * abs(truth)
    return TruthRow(
        joint=joint, quantity=name, found=Interval(fitted.value, low, high),
        identified=fitted.identified, truth=float(truth),
        held=bool(low - rounding <= truth <= high + rounding) if known else None,
    )  # fmt: skip
