"""A calibration for Newton: a servo network per joint, and a module that adds them to a model.

Newton's `DriveNeuralMLP` reads an ONNX file that maps position error and velocity to an effort,
with its contract as metadata. A calibrated PD is exactly such a network with a single layer. Delay
and effort limit are components of their own there (`delay_steps`, `ClampingMaxEffort`), armature,
dry friction and back-EMF, as damping, belong to the joint. Learned servo models cannot be exported:
they predict a servo's position, and Newton needs its effort.

Names are those of Newton 1.8.0; `benchmarks/peers/check_exports.py` holds them against the release.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, write_bytes, write_text
from pupper_sysid.common.interval import Interval
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import Actuator
from pupper_sysid.servo_models.delayed_pd import whole_steps
from pupper_sysid.sim.export.shared import (
    EXPLICIT_PD,
    block,
    delays_at_step,
    docstring,
    feedback_block,
    origin,
    step_note,
)

MODULE = "newton_actuators.py"
_OPSET, _IR_VERSION = 17, 8

_CODE = '''
def add_actuators(builder):
    """Add all servos to a `newton.ModelBuilder` that has one robot; call it before replicating.

    Joints are found by name, the last part of their labels. Position targets (`joint_target_q`)
    are the commands of the servos. The joints' own drives are switched off.
    """
    folder = Path(__file__).resolve().parent
    labels = [label.split("/")[-1] for label in builder.joint_label]
    for name, servo in SERVOS.items():
        if labels.count(name) != 1:
            raise ValueError(f"{labels.count(name)} joints are called {name}; it must be one.")
        joint = labels.index(name)
        dof = builder.joint_qd_start[joint]
        builder.joint_armature[dof] = servo["armature"]
        builder.joint_friction[dof] = servo["friction_loss"]
        builder.joint_damping[dof] = servo["back_emf"]
        builder.joint_target_ke[dof] = builder.joint_target_kd[dof] = 0.0
        builder.add_actuator(
            DriveNeuralMLP,
            index=dof,
            pos_index=builder.joint_q_start[joint],  # a free base has 7 positions and 6 degrees
            model_path=str(folder / servo["model"]),
            delay_steps=servo["delay_steps"],
            clamping=[(ClampingMaxEffort, {"max_effort": servo["effort_limit"]})],
        )
'''


def export_newton(
    calibration: Calibration, physics_step_s: float, folder: Path, force: bool = False
) -> None:
    """Write `<joint>.onnx` of each joint and `newton_actuators.py` into a folder.

    Raises
    ------
    InputError
        If a file exists and `force` is not given, the step is no sensible one, or the package for
        ONNX is not installed.
    """
    delays = delays_at_step(calibration, physics_step_s, EXPLICIT_PD)
    for name in (*(f"{joint}.onnx" for joint in calibration.joint_names), MODULE):
        refuse_overwrite(folder / name, force)
    for name, joint in calibration.joints.items():
        network = servo_network(joint.actuator, delays[name].value, physics_step_s)
        write_bytes(folder / f"{name}.onnx", network, force)
    write_text(folder / MODULE, _module(calibration, delays, physics_step_s), force)


def servo_network(actuator: Actuator, dead_time_s: float, physics_step_s: float) -> bytes:
    """The PD as ONNX: (N, 2) of position error [rad] and velocity [rad/s] to (N, 1) effort [N·m].

    Raises
    ------
    InputError
        If the package for ONNX is not installed.
    """
    try:
        import onnx
        from onnx import helper, numpy_helper
    except ImportError:
        raise InputError(
            "Export to Newton needs the package onnx: pip install 'pupper-sysid[onnx]'."
        ) from None
    gains = [[actuator.stiffness_nm_per_rad.value, -actuator.damping_nm_s_per_rad.value]]
    weights = numpy_helper.from_array(np.array(gains, np.float32), "gains")
    graph = helper.make_graph(
        [helper.make_node("Gemm", ["input", "gains"], ["output"], transB=1)],
        "delayed_pd",
        [helper.make_tensor_value_info("input", onnx.TensorProto.FLOAT, [None, 2])],
        [helper.make_tensor_value_info("output", onnx.TensorProto.FLOAT, [None, 1])],
        [weights],
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION
    )
    contract = {
        "input_order": "pos_vel", "input_idx": [0], "pos_scale": 1.0, "vel_scale": 1.0,
        "effort_scale": 1.0, "sample_dt_s": physics_step_s,
        "effort_limit_nm": actuator.effort_limit_nm.value, "dead_time_s": dead_time_s,
    }  # fmt: skip
    entry = model.metadata_props.add()
    entry.key, entry.value = "metadata", json.dumps(contract)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def _module(calibration: Calibration, delays: dict[str, Interval], physics_step_s: float) -> str:
    servos = []
    for name, joint in calibration.joints.items():
        actuator, delay = joint.actuator, delays[name]
        low, high = whole_steps(delay.low, delay.high, physics_step_s)
        row: dict[str, Any] = {
            "model": f"{name}.onnx",
            "delay_steps": round(delay.value / physics_step_s),
            "delay_steps_min": low,
            "delay_steps_max": high,
            "effort_limit": actuator.effort_limit_nm.value,
            "armature": actuator.armature_kg_m2.value,
            "friction_loss": actuator.friction_loss_nm.value,
            "back_emf": actuator.back_emf_nm_s_per_rad.value,
        }
        servos.append(f'"{name}": {json.dumps(row)},')
    notes = (
        *origin(calibration),
        f"Delays are whole physics steps of {1e3 * physics_step_s:g} ms: the nearest one, and the "
        "interval rounded outward.",
        *step_note(calibration, delays, physics_step_s),
        "Not carried over: the limit on the set-point's speed, parts of a step, and the feedback, "
        "which is no part of an actuator: readings are stale, lost at times, quantised and biased. "
        "See FEEDBACK, and the HeldFeedback that the export to Isaac Lab writes.",
    )
    return (
        f"{docstring('Servos for Newton.', notes)}\n"
        "from pathlib import Path\n\n"
        "from newton.actuators import ClampingMaxEffort, DriveNeuralMLP\n\n"
        + block("SERVOS", servos)
        + '"""Units: N·m, N·m·s/rad, kg·m², physics steps."""\n\n'
        + feedback_block(calibration)
        + '"""What makes each joint\'s readings stale, quantised and biased."""\n\n'
        + _CODE
    )
