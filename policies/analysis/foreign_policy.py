"""A policy that others trained, walking in this project's simulator: ONNX file, YAML, MJCF.

A walk takes it in the place of a `Policy`::

    network = OnnxNetwork(Path("walk.onnx"))
    policy = ForeignPolicy.of(network)                 # and walk.yaml beside it, where there is one
    task = policy.task(Path("robot.xml"), Path("robot.yaml"))
    policy.fit(task)
    action = policy.act(observation)

What the file needs to say: joints in the order of the actions, default pose, action scale, time
between two actions, and the observation as a list of named terms. mjlab's exporter (and so
microduck's) writes the first three and the terms into the metadata; the YAML adds what is missing,
and takes precedence over the metadata::

    joints: [left_hip_yaw, …]            # joint_names of the metadata
    default_pose_rad: [0, -0.09, …]      # or by joint; default_joint_pos
    action_scale_rad: 0.5                # one number, or one per joint; action_scale
    control_step_s: 0.02                 # in no metadata
    observation:                         # observation_names, observation_terms_…
      - base_ang_vel
      - {term: joint_vel, scale: 0.05, history: 3}
      - {term: phase, frequency_hz: 1.5}
    clip_actions: 10                     # optional

`TERMS` are the terms there are. A row is `scale · clip(term)`; `history` values of a term lie one
after another, the newest last (`newest: first` for the other way round), the first one repeated at
the start; `age` is how many actions ago a value was current. `frames` stacks whole rows.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from pupper_sysid.common.border import parse_json, read_yaml, refuse_other_version, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.strict_yaml import dump, printable
from pupper_sysid.policies.network.onnx_network import OnnxNetwork
from pupper_sysid.policies.network.policy_file import SCHEMA, VERSION, Contract, Policy
from pupper_sysid.servo_models.calibration.parts import PARAMETER_KEYS
from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.sim.export.foreign import position_servos
from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.robot.robot_file import RobotFile
from pupper_sysid.sim.walking.config import EVALUATION_STEP_S, Walking, for_robot
from pupper_sysid.sim.walking.draws import Differences
from pupper_sysid.sim.walking.servo_ranges import ServoRanges
from pupper_sysid.sim.walking.step import VELOCITY_STEPS, observation_of, places

Array = NDArray[np.float64]
Row = NDArray[np.float32]

_JOINTS = "joints"
_AGAIN = "Export the policy again with `pupper-sysid export`."

TERMS: dict[str, tuple[int | str, str]] = {
    "base_lin_vel": (3, "velocity of the trunk in its own frame [m/s]"),
    "base_ang_vel": (3, "its rate of rotation [rad/s]"),
    "projected_gravity": (3, "direction of gravity in its frame; (0, 0, -1) upright"),
    "command": (3, "forward and sideways speed [m/s], turn rate [rad/s]"),
    "joint_pos_rel": (_JOINTS, "joint angles from the default pose [rad]"),
    "joint_pos_abs": (_JOINTS, "joint angles [rad]"),
    "joint_vel": (_JOINTS, "joint velocities [rad/s], over `steps` actions (1)"),
    "joint_effort": (_JOINTS, "torque readings [N·m]; 0 on buses without"),
    "last_action": (_JOINTS, "the last action as the network gave it"),
    "joint_target": (_JOINTS, "the last set-point [rad]"),
    "phase": (2, "sine and cosine (`waves`) of a clock of `frequency_hz`"),
    "constant": ("values", "numbers that do not change, such as a command that is not used"),
}
"""Terms of an observation: size, and what they are."""

_ALIASES = {
    "joint_pos": "joint_pos_rel", "joint_vel_rel": "joint_vel", "actions": "last_action",
    "action": "last_action", "velocity_commands": "command", "commands": "command",
    "twist": "command", "base_linear_velocity": "base_lin_vel",
    "base_angular_velocity": "base_ang_vel", "joint_position_relative": "joint_pos_rel",
    "joint_velocity": "joint_vel", "gravity": "projected_gravity",
}  # fmt: skip
"""Names that mjlab, Isaac Lab and this project have for the same."""

_NATIVE = {
    "base_lin_vel": "base_linear_velocity", "base_ang_vel": "base_angular_velocity",
    "projected_gravity": "projected_gravity", "command": "command",
    "joint_effort": "joint_effort",
}  # fmt: skip
"""Terms that stand in this project's observation as they are."""

_Number = Annotated[float, Field(ge=-1e6, le=1e6)]
_Name = Annotated[str, Field(min_length=1, max_length=200)]
_LONGEST_HISTORY = 200


class Term(BaseModel):
    """One term of an observation."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    term: _Name
    """Name of the term."""
    scale: _Number | list[_Number] = 1.0
    """Factor, one or one per number."""
    clip: Annotated[list[_Number], Field(min_length=2, max_length=2)] | None = None
    """Lowest and highest value, before the scale."""
    history: Annotated[int, Field(ge=1, le=_LONGEST_HISTORY)] = 1
    """How many values, one per action."""
    newest: Literal["first", "last"] = "last"
    """Where the newest one stands among them."""
    age: Annotated[int, Field(ge=0, le=_LONGEST_HISTORY)] = 0
    """How many actions ago the newest one was current."""
    joints: list[_Name] | None = None
    """Joints of a term of joints, where they are others or in another order than the actions."""
    steps: Annotated[int, Field(ge=1, le=_LONGEST_HISTORY)] = 1
    """Actions between the two angles of a joint velocity."""
    frequency_hz: Annotated[float, Field(gt=0, le=50)] | None = None
    """Of a phase."""
    waves: list[Literal["sin", "cos"]] = ["sin", "cos"]
    """Of a phase, in order."""
    values: Annotated[list[_Number], Field(max_length=10_000)] | None = None
    """Of a constant."""

    @model_validator(mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """A term without settings is its name."""
        return {"term": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _known(self) -> Self:
        name = _ALIASES.get(self.term, self.term)
        if name not in TERMS:
            raise ValueError(
                f"there is no term '{printable(self.term)[:60]}'; there are {', '.join(TERMS)}. "
                "One that always has the same value in a walk is a `constant` with its `values`"
            )
        self.term = name
        if name == "phase" and self.frequency_hz is None:
            raise ValueError("a phase needs its frequency_hz")
        if name == "constant" and not self.values:
            raise ValueError("a constant needs its values")
        if self.joints is not None and TERMS[name][0] != _JOINTS:
            raise ValueError(f"{name} is no term of joints")
        return self

    def size(self, joints: int) -> int:
        """Numbers at one time."""
        kind = TERMS[self.term][0]
        if kind == _JOINTS:
            return joints if self.joints is None else len(self.joints)
        if self.term == "phase":
            return len(self.waves)
        return len(self.values or ()) if kind == "values" else int(kind)


class PolicyYaml(BaseModel):
    """What the YAML beside a policy can say; see the module."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    joints: Annotated[list[_Name], Field(min_length=1, max_length=500)] | None = None
    """Joints, in the order of the actions."""
    default_pose_rad: list[_Number] | dict[str, _Number] | None = None
    """Set-points of actions of 0, in the order of `joints` or by joint."""
    action_scale_rad: _Number | list[_Number] | dict[str, _Number] | None = None
    """Radians per unit of action, one, or like the pose."""
    control_step_s: Annotated[float, Field(ge=1e-3, le=1)] | None = None
    """Time between two actions."""
    observation: Annotated[list[Term], Field(min_length=1, max_length=200)] | None = None
    """Terms, in order."""
    frames: Annotated[int, Field(ge=1, le=_LONGEST_HISTORY)] = 1
    """How many rows of all terms are stacked, one per action."""
    newest_frame: Literal["first", "last"] = "last"
    """Where the newest one stands among them."""
    clip_actions: Annotated[float, Field(gt=0, le=1e6)] | None = None
    """Largest action; larger ones are clipped, also where the observation has them."""


_KEYS = {
    "joints": ("joint_names", "joints: [names, in the order of the actions]"),
    "default_pose_rad": ("default_joint_pos", "default_pose_rad: [one angle per joint]"),
    "action_scale_rad": ("action_scale", "action_scale_rad: [radians per unit of action]"),
    "control_step_s": ("", "control_step_s: 0.02 (seconds between two actions)"),
    "observation": ("observation_names", "observation: [terms, in their order]"),
}
"""Key of the metadata, and what to put into the YAML."""


class ForeignPolicy:
    """A policy of another trainer, in the place of a `Policy` in a walk.

    `about` is complete, metadata and YAML together; `notes` are sentences about what was assumed.
    """

    def __init__(self, network: OnnxNetwork, about: PolicyYaml, notes: Sequence[str] = ()):
        self.network, self.about, self.notes = network, about, list(notes)
        assert about.joints is not None and about.observation is not None
        self.joints, self.terms = tuple(about.joints), about.observation
        where = str(network.path)
        if len(set(self.joints)) != len(self.joints):
            raise InputError(f"{where}: a joint is named twice in `joints`.")
        if network.actions != len(self.joints):
            raise InputError(
                f"{where} gives {network.actions} actions, but `joints` names {len(self.joints)} "
                f"({', '.join(self.joints[:4])}, …). List those that it moves, in the order of its "
                "actions, as `joints` in the YAML."
            )
        self.pose = _per_joint(about.default_pose_rad, self.joints, "default_pose_rad", where)
        self.scale = _per_joint(about.action_scale_rad, self.joints, "action_scale_rad", where)
        if not (np.abs(self.pose) <= 2 * np.pi).all() or not (np.abs(self.scale) > 0).all():
            raise InputError(
                f"{where}: default_pose_rad must be radians within ±2π, and no action_scale_rad 0."
            )
        for term in self.terms:
            size = term.size(len(self.joints))
            if isinstance(term.scale, list) and len(term.scale) != size:
                raise InputError(
                    f"{where}: the scale of {term.term} has {len(term.scale)} numbers, the term "
                    f"{size}."
                )
        sizes = [t.size(len(self.joints)) * t.history for t in self.terms]
        if about.frames * sum(sizes) != network.observation_size:
            listed = ", ".join(f"{t.term} {n}" for t, n in zip(self.terms, sizes, strict=True))
            times = f", {about.frames} frames of them" if about.frames > 1 else ""
            raise InputError(
                f"{where} takes {network.observation_size} numbers, but its observation has "
                f"{about.frames * sum(sizes)} ({listed}{times}). Correct `observation` in the YAML "
                "(history, frames, or a `constant` for a command that is not used here)."
            )

    @classmethod
    def of(cls, network: OnnxNetwork, config: Path | None = None) -> ForeignPolicy:
        """The policy of a network, with its YAML: by default the file beside it, if it is there."""
        beside = config or network.path.with_suffix(".yaml")
        stated = PolicyYaml()
        if config is not None or beside.is_file():
            content, lines = read_yaml(beside)
            stated = validated(PolicyYaml, content or {}, beside, lines)
        known, notes = _of_metadata(network, stated)
        values = known | {k: getattr(stated, k) for k in stated.model_fields_set}
        lacking = [k for k in _KEYS if values.get(k) is None]
        if lacking:
            remedies = [
                f"`{_KEYS[k][1]}`" + (f" (metadata key {_KEYS[k][0]})" if _KEYS[k][0] else "")
                for k in lacking
            ]
            raise InputError(
                f"{network.path} does not state {', '.join(lacking)}. Put into {beside.name} "
                f"beside it: {'; '.join(remedies)}."
                + (f" Terms are {', '.join(TERMS)}." if "observation" in lacking else "")
            )
        about = validated(PolicyYaml, values, network.path)
        return cls(network, about, notes)

    # ------------------------------------------------------------------------- the task

    def task(self, robot: Path | None, robot_config: Path | None = None) -> Walking:
        """The walking task of this policy's robot, in its default pose.

        `robot` is its MJCF, None for the Mini Pupper 2; a pose in `robot_config`
        (`sim.robot.robot_file`) goes before the policy's.
        """
        step_s = float(self.about.control_step_s or 0.0)
        substeps = int(np.ceil(step_s / EVALUATION_STEP_S - 1e-6))
        velocity = "true" if any(t.term == "base_lin_vel" for t in self.terms) else "zero"
        base = Walking()
        base = replace(
            base, physics_step_s=step_s / substeps, control_step_s=step_s,
            action_scale=float(np.abs(self.scale).mean()), differences=Differences(),
            observation=replace(base.observation, noise=False, base_velocity=velocity),
        )  # fmt: skip
        if robot is None:
            self._refuse_unknown(base.body, "the Mini Pupper 2, which walks without `robot`,")
            return base
        settings: dict[str, Any] = {}
        if robot_config is not None:
            content, lines = read_yaml(robot_config)
            stated = validated(RobotFile, content or {}, robot_config, lines)
            settings = stated.model_dump(exclude_none=True)
        settings.setdefault("pose", dict(zip(self.joints, self.pose.tolist(), strict=True)))
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "robot.yaml"
            file.write_text(dump(settings), encoding="utf-8")
            try:
                task = for_robot(base, robot, file)
                body = task.body  # read while the file is there, and kept
            except InputError as error:
                stands = f"{self.network.path.name} on {robot.name}"
                raise InputError(str(error).replace(str(file.resolve()), stands)) from error
        self._refuse_unknown(body, robot.name)
        self.notes += body.notes
        return task

    def _refuse_unknown(self, body: Body, name: str) -> None:
        needed = [*self.joints, *(j for t in self.terms for j in t.joints or ())]
        if lost := sorted(set(needed) - set(body.joints)):
            raise InputError(
                f"{self.network.path} moves the joints {', '.join(map(printable, lost[:6]))}"
                f"{', …' if len(lost) > 6 else ''}, but {name} has no such joint with a servo. It "
                f"has {', '.join(body.joints)}. Give the robot's MJCF as `robot`, or the names "
                "in it as `joints` in the policy's YAML."
            )

    def fit(self, task: Walking) -> None:
        """Convert from and to the observations and actions of `task` from now on."""
        body = task.body
        low, high = body.low, body.high
        at = np.array([body.joints.index(j) for j in self.joints])
        beyond = [
            f"{j} ({p:.2f}, limits {low[i]:.2f} to {high[i]:.2f})"
            for j, p, i in zip(self.joints, self.pose, at, strict=True)
            if not low[i] - 1e-3 <= p <= high[i] + 1e-3
        ]
        if beyond:
            raise InputError(
                f"{self.network.path}: the default pose is beyond the limits of "
                f"{', '.join(beyond[:4])}. Is it in radians, and in the order of `joints`?"
            )
        self._at, self._body = at, body
        self._ratio = (self.scale / task.action_scale).astype(np.float32)
        self._shift = ((self.pose - body.pose[at]) / task.action_scale).astype(np.float32)
        self._step_s = task.control_step_s
        self._places = places((name, n) for name, n, _ in observation_of(len(body.joints)))

    # ------------------------------------------------------------------------- walking

    def reset(self, action: NDArray[np.floating]) -> None:
        """Start an episode of all robots after their last `action` in the task's units."""
        moved = np.asarray(action, np.float32)[:, self._at]
        self._action = ((moved - self._shift) / self._ratio).astype(np.float32)
        self._state = [s.numpy() for s in self.network.initial_state(len(action))]
        self._angles: deque[Row] = deque(maxlen=_LONGEST_HISTORY + 1)
        self._histories = [deque[Row](maxlen=t.age + t.history) for t in self.terms]
        self._frames: deque[Row] = deque(maxlen=self.about.frames)
        self._ticks = 0

    def act(
        self, observation: NDArray[np.floating], missed: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float32]:
        """Actions in the task's units, shape (n, its joints), for its observations.

        Joints that the policy does not move stay in the default pose. `missed` is for no walk of a
        foreign policy.
        """
        row = self.observe(observation)
        action, *self._state = self.network.run([row, *self._state])
        if self.about.clip_actions is not None:
            action = np.clip(action, -self.about.clip_actions, self.about.clip_actions)
        self._action = np.asarray(action, np.float32)
        self._ticks += 1
        actions = np.zeros((len(row), len(self._body.joints)), np.float32)
        actions[:, self._at] = self._ratio * self._action + self._shift
        return actions

    def observe(self, observation: NDArray[np.floating]) -> Row:
        """The policy's own observation, shape (n, size); takes the values into the histories."""
        values = {name: observation[:, place] for name, place in self._places.items()}
        self._angles.append(values["joint_position_relative"].astype(np.float32))
        columns = []
        for term, history in zip(self.terms, self._histories, strict=True):
            value = np.asarray(self._value(term, values), np.float32)
            if term.clip is not None:
                value = np.clip(value, *np.array(term.clip, np.float32))
            value = value * np.array(term.scale, np.float32)
            history.extend([value] * (history.maxlen if not history and history.maxlen else 1))
            columns.append(_in_order(list(history)[: term.history], term.newest))
        missing = 1 if self._frames else self.about.frames
        self._frames.extend([np.concatenate(columns, axis=1)] * missing)
        return _in_order(list(self._frames), self.about.newest_frame)

    def _value(self, term: Term, values: Mapping[str, NDArray[np.floating]]) -> NDArray:
        name, count = term.term, len(self._angles[-1])
        if name in ("command", "base_lin_vel", "base_ang_vel", "projected_gravity"):
            return values[_NATIVE[name]]
        if name == "constant":
            return np.tile(np.array(term.values, np.float32), (count, 1))
        if name == "phase":
            angle = 2 * np.pi * float(term.frequency_hz or 0.0) * self._ticks * self._step_s
            waves = {"sin": np.sin(angle), "cos": np.cos(angle)}
            return np.tile([waves[w] for w in term.waves], (count, 1))
        if name in ("last_action", "joint_target"):
            action = self._action
            if name == "joint_target":
                action = self.pose + self.scale * action
            if term.joints is None:
                return action
            return action[:, [self.joints.index(j) for j in term.joints]]
        at = self._at
        if term.joints is not None:
            at = np.array([self._body.joints.index(j) for j in term.joints])
        if name == "joint_vel":
            if term.steps == VELOCITY_STEPS:  # the task's difference, which covers the time before
                return values["joint_velocity"][:, at]
            past = self._angles[max(len(self._angles) - 1 - term.steps, 0)]
            return ((self._angles[-1] - past) / np.float32(term.steps * self._step_s))[:, at]
        if name == "joint_effort":
            return values["joint_effort"][:, at]
        angles = self._angles[-1][:, at]
        away = self._body.pose[at].astype(np.float32)
        if name == "joint_pos_rel":
            poses = dict(zip(self.joints, self.pose.tolist(), strict=True))
            default = [poses.get(self._body.joints[i], self._body.pose[i]) for i in at]
            away = (self._body.pose[at] - default).astype(np.float32)
        return angles + away


def exported_policy(network: OnnxNetwork) -> Policy | None:
    """The policy of a file that this project exported, with its contract; None for others."""
    text = network.metadata.get("contract")
    if text is None:
        return None
    where = f"{network.path}, contract"
    data = parse_json(text, where, _AGAIN)
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        return None
    refuse_other_version(where, data.get("schema_version"), VERSION)
    contract = validated(Contract, data, where, remedy=_AGAIN)
    if (contract.observation_size, contract.actions) != (
        network.observation_size, network.actions
    ):  # fmt: skip
        raise InputError(f"{where}: it is not that of this network. {_AGAIN}")
    return Policy(cast(Any, network), contract)


def servos_of_training(policy: ForeignPolicy, task: Walking, robot: Path | None) -> ServoRanges:
    """Servos that a foreign policy was trained with, as far as its files say.

    Those of the MJCF's position actuators, with the stiffness and damping of the metadata
    (joint_stiffness, joint_damping), where they are there. Readings are exact.
    """
    metadata, body = policy.network.metadata, task.body
    servos = position_servos(robot) if robot is not None else {}
    lacking = [j for j in body.joints if j not in servos]
    if lacking:
        raise InputError(
            f"{policy.network.path} does not say with which servos it was trained, and "
            f"{robot.name if robot else 'the Mini Pupper 2'} has no position actuator on "
            f"{', '.join(lacking[:4])}{', …' if len(lacking) > 4 else ''}. Give them as "
            "`actuator`: a calibration, a servo card, or `ideal`."
        )
    numbers = {
        field: np.array([float(np.asarray(getattr(servos[j].pd.parameters, field)))
                         for j in body.joints])
        for field in PARAMETER_KEYS
    }  # fmt: skip
    at = [body.joints.index(j) for j in policy.joints]
    for key, field in (("joint_stiffness", "stiffness"), ("joint_damping", "damping")):
        stated = _numbers(metadata.get(key, ""), key, policy.network.path)
        if stated is not None and len(stated) == len(at) and (stated >= 0).all():
            numbers[field][at] = stated
    held = (HeldFeedback(),) * len(body.joints)
    source = robot.name if robot is not None else policy.network.path.name
    return ServoRanges(source, numbers, numbers, numbers, held, {}, joints=body.joints)


# --------------------------------------------------------------------------------- metadata


def _of_metadata(network: OnnxNetwork, stated: PolicyYaml) -> tuple[dict[str, Any], list[str]]:
    """What the metadata say of the keys that the YAML does not, and what was assumed."""
    metadata, path, notes = network.metadata, network.path, []
    known: dict[str, Any] = {}

    def unstated(key: str) -> str | None:
        return None if getattr(stated, key) is not None else metadata.get(_KEYS[key][0])

    if (text := unstated("joints")) is not None:
        known["joints"] = [n.strip() for n in text.split(",") if n.strip()]
    for key in ("default_pose_rad", "action_scale_rad"):
        if (text := unstated(key)) is not None:
            values = _numbers(text, _KEYS[key][0], path)
            if values is None:
                continue
            single = key == "action_scale_rad" and len(values) == 1
            known[key] = float(values[0]) if single else values.tolist()
    if (text := unstated("observation")) is not None:
        names = [n.strip() for n in text.split(",") if n.strip()]
        known["observation"] = _metadata_terms(network, names)
        if "joint_pos" in names:
            notes.append(
                f"joint_pos of {path.name} is taken for angles from the default pose, as in "
                "mjlab's and Isaac Lab's velocity tasks."
            )
    return known, notes


def _metadata_terms(network: OnnxNetwork, names: list[str]) -> list[dict[str, Any]]:
    """Terms of an observation as mjlab's exporter states them."""
    metadata, path = network.metadata, network.path
    lists = {}
    for key in ("scale", "clip", "history_length", "flatten_history_dim"):
        key_name = f"observation_terms_{key}"
        values = lists[key] = _listed(metadata.get(key_name), key_name, path)
        if values is not None and len(values) != len(names):
            raise InputError(
                f"{path}: its metadata have {len(names)} observation_names and {len(values)} "
                f"values of {key}. State `observation` in the YAML."
            )
    scales, clips, histories, flat = lists.values()
    terms = []
    for i, name in enumerate(names):
        if _ALIASES.get(name, name) not in TERMS:
            raise InputError(
                f"{path}: its observation has the term '{printable(name)[:60]}', which is not "
                f"known here; there are {', '.join(TERMS)}. State all terms as `observation` in "
                f"{path.with_suffix('.yaml').name}; one that always has the same value in a walk "
                "is a {term: constant, values: […]}."
            )
        term: dict[str, Any] = {"term": name}
        if scales is not None:
            term["scale"] = scales[i]
        if histories is not None:
            term["history"] = max(int(np.max(histories[i])), 1)
        ends = None if clips is None else clips[i]
        if isinstance(ends, list) and len(ends) == 2 and np.isfinite(ends).any():
            term["clip"] = np.clip(ends, -1e6, 1e6).tolist()
        if term.get("history", 1) > 1 and flat is not None and not np.any(flat[i]):
            raise InputError(
                f"{path}: the history of {printable(name)} is not flattened, so it is no vector. "
                "State `observation` in the YAML as the network takes it."
            )
        terms.append(term)
    return terms


def _listed(text: str | None, key: str, path: Path) -> list[float | list[float]] | None:
    """Numbers, or lists of numbers, between commas; None where there is no text."""
    if text is None:
        return None
    plain = text.lower()
    for word, number in (("inf", "1e999"), ("true", "1"), ("false", "0"), ("none", "1")):
        plain = plain.replace(word, number)
    # since 1.6 mjlab has lists as 1;2, before as [1, 2]
    plain = re.sub(r"[^,]*;[^,]*", lambda some: f"[{some[0].replace(';', ',')}]", plain)
    try:
        values = json.loads(f"[{plain}]")
        return [[float(x) for x in v] if isinstance(v, list) else float(v) for v in values]
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path}: its metadata '{key}' are no numbers: {printable(text[:60])}."
        ) from error


def _numbers(text: str, key: str, path: Path) -> Array | None:
    """Numbers between commas; None where there are none."""
    if not text.strip():
        return None
    listed = _listed(text.strip().removeprefix("[").removesuffix("]"), key, path) or []
    values = np.array([v if isinstance(v, float) else np.nan for v in listed])
    if not np.isfinite(values).all():
        raise InputError(f"{path}: its metadata '{key}' hold what is no number.")
    return values


def _per_joint(value: Any, joints: Sequence[str], key: str, where: str) -> Array:
    """One number per joint, from one, a list, or a mapping."""
    if isinstance(value, Mapping):
        unknown = sorted(set(value) - set(joints))
        missing = [j for j in joints if j not in value]
        if unknown or missing:
            raise InputError(
                f"{where}: {key} must name each of `joints` once; "
                + (f"{printable(unknown[0])} is none of them." if unknown else "")
                + (f"{printable(missing[0])} is missing." if missing and not unknown else "")
            )
        return np.array([value[j] for j in joints], float)
    if isinstance(value, list) and len(value) != len(joints):
        raise InputError(
            f"{where}: {key} has {len(value)} numbers for {len(joints)} joints "
            f"({', '.join(joints[:4])}, …)."
        )
    return np.broadcast_to(np.array(value, float), len(joints)).copy()


def _in_order(rows: list[Row], newest: str) -> Row:
    """Rows, the oldest first, side by side."""
    return np.concatenate(rows if newest == "last" else rows[::-1], axis=1)
