"""From a trained network to files: a policy folder, ONNX, TorchScript, each checked.

Exported files take the observation and the state and give the action and the next state, under
rsl_rl's names (`obs`, `h_in`, `c_in` → `actions`, `h_out`, `c_out`); a Transformer's state is its
context. The contract travels as metadata. A file whose actions differ from the policy's by more
than 1e-5 over a few steps is not written.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pupper_sysid.common.errors import InputError, PupperError
from pupper_sysid.common.files import refuse_overwrite, sha256, write_bytes
from pupper_sysid.policies.network.policy_file import (
    ObservationPart,
    Policy,
    default_pose,
    save_policy,
)
from pupper_sysid.policies.network.policy_network import PolicyNetwork
from pupper_sysid.policies.train.run_file import Run
from pupper_sysid.sim.walking.env import OBSERVATION, OBSERVATION_SIZE, VELOCITY_STEPS
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

CLOSE = 1e-5
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
    run: Run,
    servos: ServoRanges,
    action_history: int,
    training: dict[str, Any],
    force: bool = True,
) -> None:
    """Write the policy folder of an rsl_rl actor's weights.

    Raises
    ------
    InputError
        If the gate refuses the policy; see `policies.network.policy_file.refuse_bad`.
    """
    shape, task = run.architecture, run.task
    size = OBSERVATION_SIZE + 12 * action_history
    network = PolicyNetwork(shape.kind, size, shape.hidden, shape.memory, run.learner.normalise)
    network.take(weights)
    source = Path(run.actuator)
    delays = np.concatenate([servos.low["dead_time_s"], servos.high["dead_time_s"]])
    about = {
        "kind": shape.kind,
        "hidden": list(shape.hidden),
        "memory": shape.memory,
        "normalise": run.learner.normalise,
        "observation": [
            ObservationPart(name=name, size=n, unit=_UNITS[name]) for name, n, _ in OBSERVATION
        ],
        "base_velocity": task.observation.base_velocity,
        "velocity_steps": VELOCITY_STEPS,
        "action_history": action_history,
        "action_scale_rad": task.action_scale,
        "default_pose_rad": default_pose(),
        "control_step_s": task.control_step_s,
        "physics_step_s": task.physics_step_s,
        "knee": task.knee,
        "actuator": source.name if source.exists() else run.actuator,
        "actuator_sha256": sha256(source) if source.is_file() else None,
        "feedback": run.feedback,
        "dead_time_s": [float(delays.min()), float(delays.max())],
        "training": training,
    }
    save_policy(folder, network, about, force)


def export_policy(policy: Policy, to: str, path: Path, force: bool = False) -> float:
    """Write a policy as one file that others can run; the largest difference found.

    Parameters
    ----------
    policy : Policy
    to : {"onnx", "torchscript"}
    path : Path
    force : bool

    Raises
    ------
    InputError
        If the file exists, or the `onnx` package is not installed.
    PupperError
        If the file's actions differ from the policy's.
    """
    refuse_overwrite(path, force)
    network = policy.network
    inputs = (torch.zeros(1, network.observation_size), *network.initial_state(1))
    if to == "torchscript":
        data, run = _torchscript(network, inputs)
    else:
        data, run = _onnx(policy, inputs)
    worst = _largest_difference(network, run)
    if not worst <= CLOSE:
        raise PupperError(
            f"The {to} file differs from the policy by {worst:.1e}; it was not written."
        )
    write_bytes(path, data, force)
    return worst


def _largest_difference(network: PolicyNetwork, run) -> float:
    generator = torch.Generator().manual_seed(0)
    state = network.initial_state(1)
    theirs: tuple[torch.Tensor, ...] = state
    worst = 0.0
    for _ in range(_STEPS):
        seen = torch.randn(1, network.observation_size, generator=generator)
        with torch.inference_mode():
            action, *now = network(seen, *state)
        other, *next_ = run(seen, *theirs)
        worst = max(worst, float((action - other).abs().max()))
        state, theirs = tuple(now), tuple(next_)
    return worst


def _torchscript(network: PolicyNetwork, inputs: tuple[torch.Tensor, ...]):
    with torch.inference_mode():
        traced = torch.jit.trace(network, inputs)
    buffer = io.BytesIO()
    torch.jit.save(traced, buffer)
    loaded = torch.jit.load(io.BytesIO(buffer.getvalue()))

    def run(*given: torch.Tensor) -> tuple[torch.Tensor, ...]:
        with torch.inference_mode():
            return loaded(*given)

    return buffer.getvalue(), run


def _onnx(policy: Policy, inputs: tuple[torch.Tensor, ...]):
    try:
        import onnx
        from onnx.reference import ReferenceEvaluator
    except ImportError as error:
        raise InputError(
            "Writing ONNX needs the package onnx: pip install 'pupper-sysid[onnx]'."
        ) from error
    network = policy.network
    names = network.state_names
    ins = ["obs", *(f"{n}_in" for n in names)]
    outs = ["actions", *(f"{n}_out" for n in names)]
    buffer = io.BytesIO()
    export: Any = torch.onnx.export  # its types know no buffer, its code does
    export(
        network, inputs, buffer, input_names=ins, output_names=outs, opset_version=18, dynamo=False
    )
    model = onnx.load_from_string(buffer.getvalue())
    entry = model.metadata_props.add()
    entry.key = "contract"
    entry.value = json.dumps(policy.contract.model_dump(mode="json", by_alias=True))
    evaluator = ReferenceEvaluator(model)

    def run(*given: torch.Tensor) -> list[torch.Tensor]:
        found = evaluator.run(None, {n: g.numpy() for n, g in zip(ins, given, strict=True)})
        return [torch.from_numpy(np.asarray(f)) for f in found]

    return model.SerializeToString(), run
