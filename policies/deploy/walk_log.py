"""The log of a deployment: every input and output of the controller, tick by tick, as one CSV file.

Comment lines come first (`# pupper-sysid walk`, then one `# key: JSON` per line: schema, policy and
its hash, stack, bus, start), then one row per tick with all digits, so that `replay` gives the same
actions bit for bit. Rows are on the disk within a second. The last line, `# ended: …`, is the
reason of the end; a log without it was cut short.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from pupper_sysid.common.border import parse_json, read_text, refuse_other_version, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import SyncedText, versions
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.common.reading.csv_table import (
    column_names,
    comments_of,
    one_line_end,
    read_table,
)
from pupper_sysid.policies.deploy.controller import Controller, Decision, Rest, Senses
from pupper_sysid.sim.walking.step import observation_of

TITLE = "# pupper-sysid walk"
SCHEMA_VERSION = 1
_LARGEST_BYTES = 1e9

_AXES = ("x", "y", "z")
_COMMAND = ("forward_m_s", "left_m_s", "turn_rad_s")
_SENSES = ("command", "position", "load", "rate", "acceleration")


def columns_of(joints: Sequence[str] = JOINT_NAMES) -> dict[str, tuple[str, ...]]:
    """Names of a log's columns by part, in order, of a robot's joints."""
    size = sum(size for _, size, _ in observation_of(len(joints)))
    return {
        "elapsed_s": ("elapsed_s",),
        "command": tuple(f"command_{c}" for c in _COMMAND),
        "position": tuple(f"{j}_position_rad" for j in joints),
        "load": tuple(f"{j}_load_nm" for j in joints),
        "rate": tuple(f"rate_{a}_rad_s" for a in _AXES),
        "acceleration": tuple(f"acceleration_{a}_m_s2" for a in _AXES),
        "observation": tuple(f"observation_{i}" for i in range(size)),
        "action": tuple(f"{j}_action" for j in joints),
        "target": tuple(f"{j}_target_rad" for j in joints),
        "sent": tuple(f"{j}_sent_rad" for j in joints),
    }


COLUMNS = tuple(name for names in columns_of().values() for name in names)
"""Columns of the Mini Pupper's logs."""


class WalkLog:
    """Writer of a log; every value of `header` must be JSON."""

    def __init__(
        self,
        path: Path,
        header: dict[str, Any],
        force: bool = False,
        joints: Sequence[str] = JOINT_NAMES,
    ):
        self._file = SyncedText(path, force)
        if tuple(joints) != JOINT_NAMES:
            header = {"joints": list(joints)} | header
        columns = [name for names in columns_of(joints).values() for name in names]
        about = {"schema_version": SCHEMA_VERSION, "versions": versions("torch")} | header
        lines = [f"# {k}: {json.dumps(v, ensure_ascii=False)}" for k, v in about.items()]
        self._file.write([TITLE, *lines, ",".join(columns)])

    def append(self, senses: Senses, decision: Decision, sent: NDArray[np.float64]) -> None:
        """Write one tick: inputs, outputs, and the targets that passed the guard [rad]."""
        numbers = np.concatenate(
            [
                [senses.elapsed_s], *(getattr(senses, name) for name in _SENSES),
                decision.observation, decision.action, decision.target, sent,
            ]
        )  # fmt: skip
        self._file.write([",".join(map(repr, numbers.tolist()))])

    def close(self, reason: str | None = None) -> None:
        """Close; `reason` becomes the last line. May be called twice."""
        self._file.close([f"# ended: {reason}"] if reason else [])


@dataclass(frozen=True)
class Walk:
    """Content of a log."""

    header: dict[str, Any]
    rest: Rest
    """At the start."""
    start: NDArray[np.float64]
    """Joint angles at the start [rad]; shape (12,)."""
    senses: list[Senses]
    observation: NDArray[np.float32]
    """Shape (ticks, 60 or 12)."""
    action: NDArray[np.float32]
    target: NDArray[np.float64]
    sent: NDArray[np.float64]
    ended: str | None
    """Reason of the end; None if the log was cut short."""


_Three = Annotated[list[float], Field(min_length=3, max_length=3)]


class _Rest(BaseModel):
    """The IMU at rest, as a header has it."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)

    gravity: _Three
    bias_rad_s: _Three


class _Start(BaseModel):
    """The part of a header that begins a replay; other keys are kept."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)

    rest: _Rest
    joints: Annotated[
        list[Annotated[str, Field(min_length=1, max_length=200)]],
        Field(min_length=1, max_length=500),
    ] = list(JOINT_NAMES)
    """Only in logs of other robots than the Mini Pupper 2."""
    start_rad: list[float]

    @model_validator(mode="after")
    def _start_of_each_joint(self) -> Self:
        if len(self.start_rad) != len(self.joints):
            raise ValueError(f"start_rad is not {len(self.joints)} numbers, one per joint")
        return self


def start_header(position: NDArray[np.float64], rest: Rest) -> dict[str, Any]:
    """The part of a header that `read_walk` needs."""
    return {
        "start_rad": np.asarray(position, float).tolist(),
        "rest": {"gravity": rest.gravity.tolist(), "bias_rad_s": rest.bias_rad_s.tolist()},
    }


def read_walk(path: Path) -> Walk:
    """Read a log; an incomplete last line is left out."""
    text = one_line_end(read_text(path, _LARGEST_BYTES))
    text = text[: text.rfind("\n") + 1]  # the last line may be cut short
    if text.partition("\n")[0] != TITLE:
        raise InputError(f"{path} is no log of a walk; pupper-deploy writes them.")
    header: dict[str, Any] = {}
    ended = None
    for _, line in comments_of(path, text)[1:]:
        key, colon, value = line.removeprefix("# ").partition(": ")
        if not line.startswith("# ") or not colon:
            continue
        if key == "ended":
            ended = value
            continue
        header[key] = parse_json(value, f"{path}: its header's {key}", "Was it edited?")
    refuse_other_version(path, header.get("schema_version"), SCHEMA_VERSION)
    known = validated(_Start, header, f"{path}, header")
    parts_of = columns_of(known.joints)
    expected = [name for names in parts_of.values() for name in names]
    if column_names(path, text) != expected:
        raise InputError(f"{path}: its columns are not those of a walk. Was it edited?")
    begin = Rest(np.array(known.rest.gravity), np.array(known.rest.bias_rad_s))
    start = np.array(known.start_rad)
    table = read_table(path, text)
    columns = {
        part: np.stack([table.numbers[name] for name in names], axis=-1)
        for part, names in parts_of.items()
    }
    senses = [
        Senses(float(elapsed_s), **{name: columns[name][i] for name in _SENSES})
        for i, (elapsed_s,) in enumerate(columns["elapsed_s"])
    ]
    return Walk(
        header, begin, start, senses, columns["observation"].astype(np.float32),
        columns["action"].astype(np.float32), columns["target"], columns["sent"], ended,
    )  # fmt: skip


def replay(walk: Walk, controller: Controller) -> int | None:
    """Run a controller over a log's inputs; the first tick with another output, or None."""
    controller.reset(walk.start, walk.rest)
    for i, senses in enumerate(walk.senses):
        decision = controller.step(senses)
        same = (
            np.array_equal(decision.observation, walk.observation[i], equal_nan=True)
            and np.array_equal(decision.action, walk.action[i])
            and np.array_equal(decision.target, walk.target[i])
        )
        if not same:
            return i
    return None
