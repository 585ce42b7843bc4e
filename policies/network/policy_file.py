"""Policy files: a folder with weights (safetensors) and a contract (JSON); nothing is unpickled.

The contract defines a policy's inputs and outputs: names and order of the observation, scales,
default pose, joint order, rates, and the commands, servos and feedback of its training.
`load_policy` refuses other files. Every policy passes the gate `refuse_bad` before `write_policy`
writes it: no NaN, right shapes, and actions that depend on the observation.

A walk is learnt for servos with some gains, dead times and readings. So that another robot can be
compared with these long after the calibration has gone, the contract holds them whole
(`TrainedServo`): the identity of the actuator, and for each joint the plausible range of every
number of the simulated servo, the jitter of commands and the feedback, in full precision, with a
separate schema version.

Files of `export_policy` (ONNX, TorchScript) map observation and state to action and next state,
under rsl_rl's names (`obs`, `h_in`, `c_in` → `actions`, `h_out`, `c_out`); a Transformer's state is
its context. The contract is in the metadata, under one key, as JSON.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable
from copy import copy
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import torch
from pydantic import AliasChoices, ConfigDict, Field, model_validator
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save

from pupper_sysid.common.border import (
    Part,
    read_bytes,
    read_json,
    refuse_other_kind,
    refuse_other_version,
    validated,
)
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import (
    as_path,
    sha256,
    versions,
    write_bytes,
    write_text,
)
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.common.reading.content import refuse_large_header
from pupper_sysid.policies.network.policy_network import PolicyNetwork
from pupper_sysid.policies.train.run_file import Kind
from pupper_sysid.policies.train.run_file import Run as TrainingRun
from pupper_sysid.servo_models.calibration.parts import PARAMETER_KEYS
from pupper_sysid.servo_models.servo_file import WEIGHTS as SERVO_WEIGHTS
from pupper_sysid.sim.walking.config import Commands, Walking
from pupper_sysid.sim.walking.draws import OF_UNIT
from pupper_sysid.sim.walking.servo_ranges import IDEAL, ServoRanges, is_servo_model
from pupper_sysid.sim.walking.step import VELOCITY_STEPS, observation_of
from pupper_sysid.sysid.export import Run, export_module

SCHEMA, VERSION = "pupper-policy", 4
SERVO_SCHEMA, SERVO_VERSION = "pupper-policy-servo", 1
CONTRACT, WEIGHTS = "contract.json", "weights.safetensors"
_LARGEST_BYTES = 200_000_000
_AGAIN = "Copy the whole folder again."

_Number = Annotated[float, Field(ge=0, le=1e9)]
_Seconds = Annotated[float, Field(ge=0, le=10)]
_Angle = Annotated[float, Field(ge=-2 * np.pi, le=2 * np.pi)]
_Sha = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_Path = Annotated[str, Field(max_length=4096)]


class Range(Part):
    """Plausible range of a number."""

    low: _Number
    value: _Number
    high: _Number

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low <= self.value <= self.high:
            raise ValueError("low, value and high must not fall")
        return self

    def times(self, factor: float) -> Interval:
        """The range times a positive `factor`."""
        return Interval(factor * self.value, factor * self.low, factor * self.high)


class DeadTimeRange(Range):
    """Plausible range of a dead time [s]."""

    low: _Seconds
    value: _Seconds
    high: _Seconds


class ServoFeedback(Part):
    """Readings of one servo, see `servo_models.held_feedback`."""

    poll_period_s: _Seconds
    loss: Annotated[float, Field(ge=0, lt=1)]
    quantum_rad: Annotated[float, Field(ge=0, le=2 * np.pi)]
    offset_rad: _Angle


class ServoNumbers(Part):
    """One servo: the numbers of `servo_models.delayed_pd`, and its readings.

    A term that older policies lack is a range besides.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Range]  # pyright: ignore[reportIncompatibleVariableOverride]

    stiffness: Range
    """Torque per angle [N·m/rad]."""
    damping: Range
    """Torque per speed [N·m s/rad]."""
    friction_loss: Range
    """Dry friction [N·m]."""
    armature: Range
    """Reflected inertia [kg m²]."""
    effort_limit: Range
    """Largest torque [N·m]."""
    velocity_limit: Range
    """Largest speed of the set-point [rad/s]."""
    back_emf: Range
    """Torque lost per speed [N·m s/rad]."""
    dead_time_s: DeadTimeRange
    feedback: ServoFeedback

    @model_validator(mode="after")
    def _known(self) -> Self:
        if unknown := set(self.__pydantic_extra__) - set(PARAMETER_KEYS):
            raise ValueError(f"{min(unknown)} is no number of a servo")
        return self


class TrainedServo(Part):
    """Servos of a training."""

    schema_name: Annotated[Literal["pupper-policy-servo"], Field(alias="schema")]
    schema_version: Literal[1]
    kind: Literal["calibration", "ideal", "learned"]
    """`learned`: a servo model predicted the positions, and there are no joints."""
    actuator: _Path
    """Name of the calibration, preset or folder."""
    actuator_sha256: _Sha | None
    """Of the calibration, or of the learned model's weights; null for presets."""
    feedback: _Path
    """`held`, `ideal` or the name of another calibration."""
    command_jitter_s: DeadTimeRange
    """Standard deviation of the latency of commands; 0 without."""
    torque_scale: Range
    """Factor on all torques and the armature, drawn for each robot."""
    voltage_scale: Range
    """Factor on stiffness, effort limit and speed limit, drawn for each robot."""
    poll_scale: Range
    """Factor on the poll period, drawn for each robot."""
    joints: dict[str, ServoNumbers] | None

    @model_validator(mode="after")
    def _joints_suit_kind(self) -> Self:
        if (self.joints is None) != (self.kind == "learned"):
            raise ValueError("joints must be null if, and only if, kind is learned")
        return self

    @property
    def dead_times_s(self) -> tuple[float, float] | None:
        """Shortest and longest dead time; None of a learned model."""
        if self.joints is None:
            return None
        dead_times = [joint.dead_time_s for joint in self.joints.values()]
        return min(r.low for r in dead_times), max(r.high for r in dead_times)


def trained_servo(actuator: str, feedback: str, task: Walking, servos: ServoRanges) -> TrainedServo:
    """The servos of a training, for its policy's file.

    Actuator and feedback have the names that the run gives them. What the task draws is part of the
    ranges.
    """
    source = Path(actuator)
    learned = is_servo_model(actuator)
    hashed = source / SERVO_WEIGHTS if learned else source
    differences, torque = task.differences, task.randomisation.torque_scale
    jitter = servos.command_jitter_s
    return TrainedServo.model_validate(
        {
            "schema": SERVO_SCHEMA, "schema_version": SERVO_VERSION,
            "kind": "learned" if learned else "ideal" if actuator == IDEAL else "calibration",
            "actuator": source.name if source.exists() else actuator,
            "actuator_sha256": sha256(hashed) if hashed.is_file() else None,
            "feedback": Path(feedback).name if Path(feedback).exists() else feedback,
            "command_jitter_s": _scaled(jitter, differences.command_jitter),
            "torque_scale": _scaled(1.0, torque),
            "voltage_scale": _scaled(1.0, differences.battery),
            "poll_scale": _scaled(1.0, differences.poll_period),
            "joints": None if learned else joints_of(servos, differences.servo_spread),
        }
    )  # fmt: skip


def joints_of(servos: ServoRanges, spread: float = 0.0) -> dict[str, ServoNumbers]:
    """The numbers of each joint's servo, wider by a share `spread` where units differ."""
    factors = {"low": 1.0 - spread, "value": 1.0, "high": 1.0 + spread}
    return {
        name: ServoNumbers.model_validate(
            {
                field: {
                    k: float(getattr(servos, k)[field][i] * (factor if field in OF_UNIT else 1.0))
                    for k, factor in factors.items()
                }
                for field in servos.value
            }
            | {"feedback": {k: float(getattr(reading, k)) for k in ServoFeedback.model_fields}}
        )
        for i, (name, reading) in enumerate(zip(servos.joints, servos.feedback, strict=True))
    }


def _scaled(value: float, ends: tuple[float, float]) -> dict[str, float]:
    """A range around a value, which is one end if it is outside."""
    low, high = (float(value * end) for end in ends)
    return {"low": low, "value": float(min(max(value, low), high)), "high": high}


class ObservationPart(Part):
    """One part of the observation, in order."""

    name: str
    size: Annotated[int, Field(gt=0, le=10_000)]
    unit: str


_Ends = Annotated[list[Annotated[float, Field(ge=-100, le=100)]], Field(min_length=2, max_length=2)]


class CommandRanges(Part):
    """Commands of a training: lowest and highest of each part."""

    forward_m_s: _Ends
    sideways_m_s: _Ends
    """To the left."""
    yaw_rad_s: _Ends
    """Turn rate to the left."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not all(low <= high for low, high in self._ends):
            raise ValueError("the lower end of a range must come first")
        return self

    @classmethod
    def of(cls, commands: Commands, share: float = 1.0) -> Self:
        """The ranges of a task, or a `share` of them."""
        ends = {name: [share * end for end in getattr(commands, name)] for name in cls.model_fields}
        return cls(**ends)

    @property
    def _ends(self) -> list[list[float]]:
        return [self.forward_m_s, self.sideways_m_s, self.yaw_rad_s]

    def clip(self, commands: np.ndarray) -> np.ndarray:
        """The nearest commands within the ranges, each part by itself, shape (..., 3)."""
        low, high = np.array(self._ends).T
        return np.clip(commands, low, high)

    def clipped(self, commands: np.ndarray, say: Callable[[str], None]) -> np.ndarray:
        """`clip`, with one sentence if that changes anything.

        The sentence goes to `say`; commands have the shape (k, 3).
        """
        within = self.clip(commands)
        changed = np.flatnonzero((within != commands).any(axis=1))
        if len(changed):
            first = (" ".join(f"{v:.3g}" for v in x[changed[0]]) for x in (commands, within))
            which = "The command {} was clipped to {},".format(*first)
            if len(commands) > 1:
                which = f"{len(changed)} of {len(commands)} commands were clipped to"
            say(f"{which} what the policy was trained for ({self}).")
        return within

    def __str__(self) -> str:
        axes = zip(("forward", "left", "turn"), self._ends, ("m/s", "m/s", "rad/s"), strict=True)
        return ", ".join(
            f"{name} {low:.3g} to {high:.3g} {unit}" for name, (low, high), unit in axes
        )


class RobotReference(Part):
    """The robot of a training that is not the Mini Pupper 2: its files and their hashes."""

    name: _Path
    mjcf: _Path
    mjcf_sha256: _Sha
    config: _Path | None
    config_sha256: _Sha | None


class Contract(Part):
    """Inputs, outputs and training of a policy."""

    schema_name: Annotated[Literal["pupper-policy"], Field(alias="schema")]
    schema_version: Literal[1, 2, 3, 4]
    kind: Kind
    hidden: Annotated[list[Annotated[int, Field(gt=0, le=8192)]], Field(max_length=16)]
    memory: Annotated[int, Field(gt=0, le=8192)]
    normalise: bool
    observation: Annotated[list[ObservationPart], Field(min_length=1, max_length=32)]
    base_velocity: Literal["zero", "true"]
    """Whether the trunk's speed is zeros or the true one."""
    velocity_steps: Annotated[int, Field(gt=0, le=1000)]
    """Control steps between the two readings of a joint velocity."""
    action_history: Annotated[int, Field(ge=0, le=1000)]
    """Number of past actions in the observation, newest first."""
    action_scale_rad: Annotated[float, Field(gt=0, le=10)]
    default_pose_rad: dict[str, _Angle]
    """Target = default pose + scale · action, in this order of joints."""
    robot: RobotReference | None = None
    """Null of the Mini Pupper 2."""
    control_step_s: Annotated[float, Field(ge=1e-3, le=1)]
    physics_step_s: Annotated[float, Field(ge=1e-5, le=1)]
    knee: Literal["linkage", "serial"]
    actuator: str
    actuator_sha256: str | None
    feedback: str
    dead_time_s: Annotated[
        list[Annotated[float, Field(ge=0, le=10)]],
        Field(min_length=2, max_length=2, validation_alias=AliasChoices("dead_time_s", "delay_s")),
    ]
    """Shortest and longest dead time it was trained with; `delay_s` in version 1."""
    servo: TrainedServo | None = None
    """The servos it was trained with, whole; null is no evidence of any. From version 3 on."""
    commands: CommandRanges | None = None
    """Commands it was trained for; null where the file does not say. From version 4 on."""
    training: dict[str, Any]
    versions: dict[str, str]
    weights_sha256: _Sha

    @model_validator(mode="after")
    def _one_servo(self) -> Self:
        servo = self.servo
        if servo is None:
            return self
        if servo.dead_times_s is not None and servo.dead_times_s != tuple(self.dead_time_s):
            raise ValueError("dead_time_s is not that of the servo")
        if servo.joints is not None and list(servo.joints) != list(self.default_pose_rad):
            raise ValueError("default_pose_rad must name the servo's joints, in their order")
        if servo.actuator != self.actuator or servo.feedback != self.feedback:
            raise ValueError("actuator and feedback are not those of the servo")
        if self.actuator_sha256 is not None and servo.actuator_sha256 != self.actuator_sha256:
            raise ValueError("actuator_sha256 is not that of the servo")
        return self

    @property
    def observation_size(self) -> int:
        """Length of the observation, past actions included."""
        return sum(p.size for p in self.observation) + self.actions * self.action_history

    @property
    def actions(self) -> int:
        """Joints with a servo."""
        return len(self.default_pose_rad)


class Policy:
    """A policy that acts for many robots at once and keeps their states.

    Parameters
    ----------
    network : PolicyNetwork
        From observations to actions.
    contract : Contract
        What it was trained for.
    """

    def __init__(self, network: PolicyNetwork, contract: Contract):
        self.network, self.contract = network, contract
        self._run: Callable[..., tuple[torch.Tensor, ...]] = network
        self._state: tuple[torch.Tensor, ...] = ()
        self._past = np.zeros((0, 0, contract.actions), np.float32)

    def __repr__(self) -> str:
        c = self.contract
        return (
            f"Policy ({c.kind}): {c.observation_size} numbers to {c.actions} joints, "
            f"{1e3 * c.control_step_s:g} ms"
        )

    def reset(self, action: np.ndarray) -> None:
        """Start an episode of all robots after their last `action`, shape (n, 12)."""
        self._state = self.network.initial_state(len(action))
        history = self.contract.action_history
        self._past = np.repeat(np.asarray(action, np.float32)[:, None], history, axis=1)

    def for_one(self) -> Policy:
        """A copy with a separate state for one robot: the same bits in half the time."""
        policy = copy(self)
        example = torch.zeros(1, self.contract.observation_size)
        with warnings.catch_warnings(), torch.inference_mode():
            warnings.simplefilter("ignore")  # a trace is of one size, as intended
            state = self.network.initial_state(1)
            traced: Any = torch.jit.trace(self.network.eval(), (example, *state))
            policy._run = torch.jit.freeze(traced)
        return policy

    def act(self, observation: np.ndarray, missed: np.ndarray | None = None) -> np.ndarray:
        """Actions, shape (n, 12), for observations (n, 60).

        The states of `missed` robots, a mask of shape (n,), stay as they are: their control tick
        was missed, and their action is meaningless.
        """
        seen = np.concatenate([observation, self._past.reshape(len(observation), -1)], axis=1)
        with torch.inference_mode():
            action, *state = self._run(torch.from_numpy(seen.astype(np.float32)), *self._state)
        before, past = self._state, self._past
        self._state = tuple(s.clone() for s in state)
        actions = action.numpy()
        if past.shape[1]:
            self._past = np.concatenate([actions[:, None], past[:, :-1]], axis=1)
        if missed is not None and missed.any():
            mask = torch.from_numpy(missed)[:, None]  # states are (layers, n, size)
            pairs = zip(before, self._state, strict=True)
            self._state = tuple(torch.where(mask, old, new) for old, new in pairs)
            self._past = np.where(missed[:, None, None], past, self._past)
        return actions


def load_policy(folder: Path | str) -> Policy:
    """Read a policy.

    Parameters
    ----------
    folder : Path or str
        With `contract.json` and `weights.safetensors`.

    Returns
    -------
    Policy
        At rest, for any number of robots.

    Raises
    ------
    InputError
        If a file is missing, damaged, of another version, or fails the gate.
    """
    folder = as_path(folder, "The folder of a policy")
    if not (folder / CONTRACT).is_file():
        refuse_other_kind(folder, SCHEMA)
    path, weights = folder / CONTRACT, folder / WEIGHTS
    for file in (path, weights):
        if not file.is_file():
            raise InputError(f"{folder} holds no policy: there is no {file.name} in it.")
    content = read_json(path, remedy=_AGAIN)
    if isinstance(content, dict):
        refuse_other_version(path, content.get("schema_version"), VERSION)
        if isinstance(servo := content.get("servo"), dict):
            refuse_other_version(f"{path}, servo", servo.get("schema_version"), SERVO_VERSION)
    contract = validated(Contract, content, path, remedy="copy the whole folder again")
    contract = contract.model_copy(update={"schema_version": VERSION})
    if contract.robot is None and list(contract.default_pose_rad) != list(JOINT_NAMES):
        raise InputError(f"{path}: default_pose_rad must name the joints in this project's order.")
    data = read_bytes(weights, _LARGEST_BYTES, _AGAIN)
    if hashlib.sha256(data).hexdigest() != contract.weights_sha256:
        raise InputError(f"{weights} is not the file that {path.name} describes. Copy both again.")
    refuse_large_header(weights, data)
    about = (contract.kind, contract.observation_size, tuple(contract.hidden), contract.memory,
             contract.normalise, contract.actions)  # fmt: skip
    with torch.device("meta"):  # shapes only: a contract may ask for any amount of memory
        shapes = {name: value.shape for name, value in PolicyNetwork(*about).state_dict().items()}
    try:
        arrays = load_tensors(data)
        if any(arrays[name].shape != shape for name, shape in shapes.items()):
            raise RuntimeError("a shape is another")
        network = PolicyNetwork(*about)
        network.take(arrays)
    except (SafetensorError, KeyError, RuntimeError) as error:
        raise InputError(
            f"{weights} does not fit {path.name}: weights of another shape."
        ) from error
    refuse_bad(network, str(folder))
    return Policy(network, contract)


def refuse_other_observation(contract: Contract) -> None:
    """Refuse a policy of another observation, which would act wrongly without an error."""
    expected = [(p.name, p.size) for p in contract.observation]
    channels = [(name, size) for name, size, _ in observation_of(contract.actions)]
    if expected != channels or contract.velocity_steps != VELOCITY_STEPS:
        raise InputError(
            "The policy's observation is not the one this version gives "
            f"({', '.join(name for name, _ in channels)}; velocity over {VELOCITY_STEPS} steps). "
            "Use the version that trained it, or train it again."
        )


def refuse_bad(network: PolicyNetwork, name: str) -> None:
    """The gate: refuse a policy that is not finite, or whose output is constant."""
    if not all(torch.isfinite(p).all() for p in network.state_dict().values()):
        raise InputError(f"Weights of {name} are not numbers. Train it again.")
    generator = torch.Generator().manual_seed(0)
    seen = torch.randn(64, network.observation_size, generator=generator)
    with torch.inference_mode():
        action = network(seen, *network.initial_state(64))[0]
    if action.shape != (64, network.actions) or not torch.isfinite(action).all():
        raise InputError(f"Actions of {name} are not {network.actions} numbers. Train it again.")
    if float(action.std(0).max()) < 1e-5:
        raise InputError(
            f"The output of {name} is constant (standard deviation below 1e-5 over 64 random "
            "observations). Train it again."
        )


ENDINGS = {"onnx": ".onnx", "torchscript": ".pt"}
_STEPS = 6
_UNITS = {
    "base_linear_velocity": "m/s", "base_angular_velocity": "rad/s", "projected_gravity": "1",
    "command": "m/s, m/s, rad/s", "joint_position_relative": "rad", "joint_velocity": "rad/s",
    "joint_effort": "N·m", "last_action": "1",
}  # fmt: skip


def write_policy(
    folder: Path,
    weights: dict[str, torch.Tensor],
    run: TrainingRun,
    servos: ServoRanges,
    action_history: int,
    training: dict[str, Any],
    command_share: float = 1.0,
) -> None:
    """Write the policy folder of an rsl_rl actor's weights, over what is there.

    `command_share` is the share of the task's commands that the curriculum has come to.
    """
    shape, task = run.architecture, run.task
    body = task.body
    joints, parts = len(body.joints), observation_of(len(body.joints))
    size = sum(n for _, n, _ in parts) + joints * action_history
    network = PolicyNetwork(
        shape.kind, size, shape.hidden, shape.memory, run.learner.normalise, joints
    )
    network.take(weights)
    servo = trained_servo(run.actuator, run.feedback, task, servos)
    source = Path(run.actuator)
    delays = np.concatenate([servos.low["dead_time_s"], servos.high["dead_time_s"]])
    robot = None
    if not body.is_mini_pupper:
        robot = {
            "name": body.name, "mjcf": task.robot, "mjcf_sha256": body.hashes["robot"],
            "config": task.robot_config or None,
            "config_sha256": body.hashes.get("robot_config"),
        }  # fmt: skip
    refuse_bad(network, "this policy")
    write_bytes(
        folder / WEIGHTS,
        save({name: value.contiguous() for name, value in network.state_dict().items()}),
        force=True,
    )
    about = {
        "schema": SCHEMA,
        "schema_version": VERSION,
        "kind": shape.kind,
        "hidden": list(shape.hidden),
        "memory": shape.memory,
        "normalise": run.learner.normalise,
        "observation": [
            ObservationPart(name=name, size=n, unit=_UNITS[name]) for name, n, _ in parts
        ],
        "base_velocity": task.observation.base_velocity,
        "velocity_steps": VELOCITY_STEPS,
        "action_history": action_history,
        "action_scale_rad": task.action_scale,
        "default_pose_rad": dict(zip(body.joints, body.pose.tolist(), strict=True)),
        "robot": robot,
        "control_step_s": task.control_step_s,
        "physics_step_s": task.physics_step_s,
        "knee": task.knee,
        "actuator": servo.actuator,
        "actuator_sha256": sha256(source) if source.is_file() else None,
        "feedback": servo.feedback,
        "dead_time_s": [float(delays.min()), float(delays.max())],
        "servo": servo.model_dump(mode="json", by_alias=True),
        "commands": CommandRanges.of(task.commands, command_share).model_dump(mode="json"),
        "training": training,
        "versions": versions("torch", "rsl-rl-lib"),
        "weights_sha256": sha256(folder / WEIGHTS),
    }
    contract = Contract.model_validate(about).model_dump(mode="json", by_alias=True)
    text = json.dumps(contract, indent=2, ensure_ascii=False)
    write_text(folder / CONTRACT, text + "\n", force=True)


def export_policy(
    policy: Policy, to: Literal["onnx", "torchscript"], path: Path, force: bool = False
) -> float:
    """Write a policy as one file for other runtimes, checked against the policy.

    Returns the largest difference of actions.
    """
    network, names = policy.network, policy.network.state_names
    contract = policy.contract.model_dump(mode="json", by_alias=True)
    return export_module(
        network,
        (torch.zeros(1, network.observation_size), *network.initial_state(1)),
        (["obs", *(f"{n}_in" for n in names)], ["actions", *(f"{n}_out" for n in names)]),
        path, to, difference=lambda run: _largest_difference(network, run),
        metadata={"contract": json.dumps(contract)}, force=force,
    )  # fmt: skip


def _largest_difference(network: PolicyNetwork, run: Run) -> float:
    """Largest difference of actions over a few steps, each with its own state."""
    generator = torch.Generator().manual_seed(0)
    state = network.initial_state(1)
    exported_state: tuple[torch.Tensor, ...] = state
    worst = 0.0
    for _ in range(_STEPS):
        seen = torch.randn(1, network.observation_size, generator=generator)
        with torch.inference_mode():
            action, *now = network(seen, *state)
        exported, *next_ = run(seen, *exported_state)
        worst = max(worst, float((action - exported).abs().max()))
        state, exported_state = tuple(now), tuple(next_)
    return worst
