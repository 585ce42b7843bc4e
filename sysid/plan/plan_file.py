"""Plans as files, and recording until an interval is narrow.

A plan file has the trials of a sweep that `plan` proposes and `sweep --plan` executes, as YAML:

    save_plan(proposal, Path("plan.yaml"))
    executable(load_plan(path), path, joints, …)      # what the recorder takes

`sweep --until` fits what there is, plans what narrows it most, and records that:

    goal = parse_goal("dead_time:2ms")
    outcome = record_until(goal, paths, joints, fit, record_next, most_seconds=120.0)

A goal is reached by a joint when half of its dead time's 90 % interval, (high - low) / 2, is at
most the goal's width. Joints that have reached it, or cannot, are not recorded again.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from pupper_sysid.common.border import read_own, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256, versions, write_text
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.joints import strange_joint
from pupper_sysid.common.reading.dialect import decimal
from pupper_sysid.common.results import Result, derived, plain
from pupper_sysid.common.strict_yaml import dump
from pupper_sysid.servo_models.calibration.calibration import utc_now
from pupper_sysid.sysid.doctor.checks import joint_trials
from pupper_sysid.sysid.fit.results import JointCalibrationResult
from pupper_sysid.sysid.plan.planner import (
    DEAD_TIME,
    LEAST_HALF_WIDTH_S,
    SHORTEST_S,
    Ends,
    PlannedTrial,
    trial_seconds,
)
from pupper_sysid.sysid.plan.proposal import SweepPlan, plan_from_fits, recorded_s
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.sweep.excitation import Plan, plan

SCHEMA = "pupper-sysid plan"
SCHEMA_VERSION = 1

_HEADER = """\
# Plan of a sweep, written by `pupper-sysid plan`; `pupper-sysid sweep --plan` executes it.
#
# `trials` may be edited: excursions from the start pose in radians, durations in seconds without
# the lead-in at rest. `predictions` are the 90 % intervals now and those to expect afterwards.
"""


class PlanFile(SweepPlan):
    """The whole file."""

    schema_name: Annotated[Literal["pupper-sysid plan"], Field(alias="schema")]
    """Kind of the file."""
    schema_version: Literal[1]
    """Version of the file's format."""
    created: str
    """Time of the plan, in UTC and ISO 8601."""
    versions: dict[str, str] = Field(default_factory=dict)
    """Versions of this project and of the libraries that shape its numbers."""

    @field_validator("trials")
    @classmethod
    def _check_joints(cls, trials: tuple[PlannedTrial, ...]) -> tuple[PlannedTrial, ...]:
        if strange := strange_joint(t.joint for t in trials):
            raise ValueError(f"{strange[0]} is no joint; {strange[1].rstrip('.?')}")
        return trials


def save_plan(proposal: SweepPlan, path: Path, force: bool = False) -> None:
    """Write a plan file, in one atomic step."""
    head = {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, "created": utc_now()}
    data = head | {"versions": versions()} | plain(proposal)
    write_text(path, f"{_HEADER}\n{dump(data)}", force)


def load_plan(path: Path) -> SweepPlan:
    """Read a plan file."""
    remedy = "Give a file that `pupper-sysid plan` wrote."
    data, lines = read_own(path, SCHEMA, SCHEMA_VERSION, remedy)
    file = validated(PlanFile, data, path, lines)
    return SweepPlan(**{name: getattr(file, name) for name in SweepPlan.model_fields})


def executable(
    proposal: SweepPlan,
    path: Path,
    joints: Sequence[str],
    margin_rad: Mapping[str, float],
    start_pose_rad: Mapping[str, float],
    speed_limit_rad_s: float,
    acceleration_limit_rad_s2: float = math.inf,
) -> Plan:
    """The plan in the form that the recorder executes, within the limits of a bus.

    Name and hash of its file, `path`, go into the recording's header. `joints` are those of the
    plan that move, `margin_rad` the largest excursion of each to either side of its start pose.
    """
    chosen = [t for t in proposal.trials if t.joint in joints]
    parts = [
        plan(
            t.kind, [t.joint], [t.frequency_hz], t.amplitude_rad, t.duration_s,
            proposal.loop_period_s, min(proposal.speed_limit_rad_s, speed_limit_rad_s),
            proposal.poll_rate_hz, margin_rad, start_pose_rad, acceleration_limit_rad_s2,
        )
        for t in chosen
    ]  # fmt: skip
    remarks = (f"{t.joint}: {w}" for t, p in zip(chosen, parts, strict=True) for w in p.warnings)
    changes = tuple(dict.fromkeys(remarks))
    description = {
        "kind": "plan", "file": path.name, "sha256": sha256(path), "joints": list(joints),
        "made_from": plain(proposal.made_from), "lead_in_s": parts[0].description["lead_in_s"],
        "speed_limit_rad_s": speed_limit_rad_s, "warnings": list(changes),
    }  # fmt: skip
    trials = tuple(t for p in parts for t in p.trials)
    return Plan(trials, dict(start_pose_rad), description, changes)


ROUND_S = 20.0  # most recorded seconds per joint between two fits

_QUANTITIES = ("dead_time",)
_UNITS = {"ms": 1e-3, "s": 1.0}
_GOAL = re.compile(r"([a-z_]+):([0-9.eE+-]+) ?([a-z]*)")
_PROGRESS = 0.97  # of the width before: more, twice in a row, is none
_EXPECTED = 0.98  # of the present width: a plan that promises more promises nothing


@dataclass(frozen=True)
class Goal:
    """A quantity, and half the width that its 90 % interval may have."""

    quantity: str
    half_width_s: float

    def reached(self, interval: Interval) -> bool:
        """Whether an interval is narrow enough."""
        return half_width(interval) <= self.half_width_s + 1e-9  # a nanosecond, for rounding


@dataclass(frozen=True, kw_only=True)
class JointOutcome(Result):
    """How far a joint came."""

    dead_time_s: Interval
    recorded_s: float
    """Of all rounds."""
    rounds: int
    """Recordings with this joint."""
    why: str = ""
    """Why its interval is not narrow enough; empty if it is."""

    @derived
    def reached(self) -> bool:
        """Whether the interval is narrow enough."""
        return not self.why


@dataclass(frozen=True, kw_only=True)
class Outcome(Result):
    """All joints and recordings of `record_until`."""

    joints: dict[str, JointOutcome]
    recordings: tuple[Path, ...]

    @derived
    def reached(self) -> bool:
        """Whether every joint has reached the goal."""
        return all(joint.reached for joint in self.joints.values())


Fit = Callable[[Sequence[Recording], list[str]], Mapping[str, JointCalibrationResult]]
"""Fits joints to recordings, pooled (`sysid.fit.joint_fit.fit_joint`)."""

RecordNext = Callable[[SweepPlan, int], Path]
"""Records a plan as the round of this number, from 2, and returns the recording's file."""


def half_width(interval: Interval | Ends) -> float:
    """Half of an interval's width."""
    return (interval.high - interval.low) / 2


def parse_goal(text: str) -> Goal:
    """Goal that `text` names: quantity, colon, half width with its unit.

    Examples
    --------
    >>> parse_goal("dead_time:2ms")
    Goal(quantity='dead_time', half_width_s=0.002)
    """
    form = "write dead_time:2ms for a dead time known within ± 2 ms"
    match = _GOAL.fullmatch(text.strip())
    if match is None or match[1] not in _QUANTITIES:
        raise InputError(f"`until`: '{text}' is not a goal; {form}.")
    if match[3] not in _UNITS:
        raise InputError(f"`until`: '{text}' has no unit of time; {form}.")
    try:
        half = decimal(match[2]) * _UNITS[match[3]]
    except ValueError:
        raise InputError(f"`until`: '{match[2]}' is not a number; {form}.") from None
    if not LEAST_HALF_WIDTH_S < half <= 1:
        raise InputError(
            f"`until`: ± {1e3 * half:g} ms is out of reach. The model's time step alone leaves "
            f"± {1e3 * LEAST_HALF_WIDTH_S:.2g} ms; give a half width above it, up to 1 s."
        )
    return Goal(match[1], half)


def record_until(
    goal: Goal,
    paths: Sequence[Path],
    joints: Sequence[str],
    fit: Fit,
    record_next: RecordNext,
    *,
    most_seconds: float,
    seed: int = 0,
    report: Callable[[dict[str, JointOutcome]], None] | None = None,
) -> Outcome:
    """Fit, plan and record until every joint has reached a goal or cannot.

    `paths` are the recordings that there are: the first sweep, and rounds of an earlier call.
    `most_seconds` is the most recorded time of a joint, the first sweep included [s]. `report` is
    called with the joints' state after every round of fits.
    """
    files, state, widths = list(paths), dict[str, JointOutcome](), dict[str, list[float]]()
    open_joints = list(joints)
    while True:
        recordings = [load(path) for path in files]
        plans: dict[str, SweepPlan] = {}
        for joint, one in fit(recordings, open_joints).items():
            widths.setdefault(joint, []).append(half_width(one.dead_time_s))
            state[joint], plan = _judged(goal, one, recordings, widths[joint], most_seconds, seed)
            if plan is not None:
                plans[joint] = plan
        open_joints = list(plans)
        if report:
            report(state)
        if not open_joints:
            ordered = {joint: state[joint] for joint in joints}
            return Outcome(joints=ordered, recordings=tuple(files))
        joined = {
            name: tuple(entry for p in plans.values() for entry in getattr(p, name))
            for name in ("trials", "predictions", "notes")
        }
        planned = next(iter(plans.values())).model_copy(update=joined)
        files.append(record_next(planned, len(files) + 1))


def _judged(
    goal: Goal,
    fit: JointCalibrationResult,
    recordings: Sequence[Recording],
    widths: Sequence[float],
    most_seconds: float,
    seed: int,
) -> tuple[JointOutcome, SweepPlan | None]:
    """State of a joint, and what to record next if that may help."""
    trials = joint_trials(recordings, fit.joint)
    done = recorded_s(trials)
    rounds = sum(bool(r.trials(fit.joint)) for r in recordings)

    def state(why: str = "") -> JointOutcome:
        return JointOutcome(dead_time_s=fit.dead_time_s, recorded_s=done, rounds=rounds, why=why)

    if goal.reached(fit.dead_time_s):
        return state(), None
    seconds = min(most_seconds - done, ROUND_S)
    if seconds < trial_seconds(SHORTEST_S):
        return state(
            f"{done:.0f} s are recorded and `most_seconds` is {most_seconds:g}; allow more"
        ), None
    plan = plan_from_fits(recordings, {fit.joint: fit}, seconds=seconds, seed=seed)
    notes = " ".join(n.removeprefix(f"{fit.joint}: ") for n in plan.notes if "dead time" in n)
    if len(widths) > 2 and min(widths[-2:]) > _PROGRESS * widths[-3]:
        return state(f"the last two rounds did not narrow it. {notes}".strip().rstrip(".")), None
    (dead,) = (p for p in plan.predictions if p.quantity == DEAD_TIME)
    if half_width(dead.after) > _EXPECTED * half_width(dead.now):
        return state(notes.rstrip(".") or "no trial within the limits would narrow it"), None
    return state("more recordings are needed"), plan
