"""The plan file: the trials of a sweep that `plan` proposes and `sweep --plan` executes, as YAML.

save_plan(proposal, Path("plan.yaml"))
executable(load_plan(path), path, joints, …)      # what the recorder takes
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from pupper_sysid.common.border import read_yaml, refuse_other_schema, validated
from pupper_sysid.common.file_kinds import refuse_other_kind
from pupper_sysid.common.files import sha256, versions, write_text
from pupper_sysid.common.joints import strange_joint
from pupper_sysid.common.results import plain
from pupper_sysid.common.strict_yaml import dump
from pupper_sysid.servo_models.calibration.calibration import utc_now
from pupper_sysid.sysid.plan.planner import PlannedTrial
from pupper_sysid.sysid.plan.proposal import SweepPlan
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
    refuse_other_kind(path, SCHEMA)
    data, lines = read_yaml(path)
    remedy = "Give a file that `pupper-sysid plan` wrote."
    refuse_other_schema(path, data, "is not a plan", SCHEMA, SCHEMA_VERSION, remedy)
    file = validated(PlanFile, data, path, lines)
    return SweepPlan(**{name: getattr(file, name) for name in SweepPlan.model_fields})


def executable(
    proposal: SweepPlan,
    path: Path,
    joints: Sequence[str],
    margin_rad: Mapping[str, float],
    start_pose_rad: Mapping[str, float],
    speed_limit_rad_s: float,
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
            proposal.poll_rate_hz, margin_rad, start_pose_rad,
        )
        for t in chosen
    ]  # fmt: skip
    changes = tuple(
        dict.fromkeys(
            f"{t.joint}: {w}" for t, p in zip(chosen, parts, strict=True)
            for w in p.warnings
        )
    )  # fmt: skip
    description = {
        "kind": "plan",
        "file": path.name,
        "sha256": sha256(path),
        "joints": list(joints),
        "made_from": plain(proposal.made_from),
        "lead_in_s": parts[0].description["lead_in_s"],
        "speed_limit_rad_s": speed_limit_rad_s,
        "warnings": list(changes),
    }
    trials = tuple(t for p in parts for t in p.trials)
    return Plan(trials, dict(start_pose_rad), description, changes)
