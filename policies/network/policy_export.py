"""Policy folders of trained networks, and their export to ONNX and TorchScript.

Exported files map observation and state to action and next state, under rsl_rl's names (`obs`,
`h_in`, `c_in` → `actions`, `h_out`, `c_out`); a Transformer's state is its context. The contract is
in the metadata, under one key, as JSON: the same as in the policy's folder, with the servos of the
training (`servo`).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from safetensors.torch import save

from pupper_sysid.common.files import refuse_overwrite, sha256, versions, write_bytes, write_text
from pupper_sysid.policies.network.policy_file import (
    CONTRACT,
    SCHEMA,
    VERSION,
    WEIGHTS,
    CommandRanges,
    Contract,
    ObservationPart,
    Policy,
    refuse_bad,
    trained_servo,
)
from pupper_sysid.policies.network.policy_network import PolicyNetwork
from pupper_sysid.policies.train.run_file import Run as TrainingRun
from pupper_sysid.sim.walking.observation import VELOCITY_STEPS, observation_of
from pupper_sysid.sim.walking.servo_ranges import ServoRanges
from pupper_sysid.sysid.export import Run, export_module

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
    force: bool = True,
    command_share: float = 1.0,
) -> None:
    """Write the policy folder of an rsl_rl actor's weights.

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
    refuse_overwrite(folder / CONTRACT, force)
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
