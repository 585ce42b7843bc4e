"""Export of servo models: a learned model as ONNX or TorchScript, the numbers of any as CSV.

A simulator or a robot that has no pupper-sysid can then run the model. The exported network holds
no state: it maps one step's inputs to its outputs, all joints and any number N of environments at
once, in radians, with the normalisation inside:

    command_history_rad (N, joints, taps), newest first     -> position_rad_next (N, joints)
    position_rad (N, joints), predicted last, if `feedback`
    hidden, cell (N, joints, members, units), if LSTM       -> hidden_next, cell_next

The caller shifts the history, and feeds back what comes back. Both formats carry the contract and
the order of joints and inputs; nothing in them is read back by this project.

Physical models (delayed-pd, sindy) step physics between commands and are no such map; they have a
table of numbers only.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, versions, write_bytes
from pupper_sysid.servo_models.command_network import CommandNetwork
from pupper_sysid.servo_models.recurrent_network import RecurrentNetwork
from pupper_sysid.servo_models.servo_file import Contract, SavedModel
from pupper_sysid.sysid.export.tidy_csv import comments

if TYPE_CHECKING:
    from onnx import ModelProto

Format = Literal["onnx", "torchscript", "csv"]
ENDINGS: dict[str, str] = {"onnx": ".onnx", "torchscript": ".pt", "csv": ".csv"}
_OPSET, _IR_VERSION = (
    17,
    8,
)  # the oldest that hold all that is used here: runtimes on robots are old

Learned = CommandNetwork | RecurrentNetwork


def export_servo_model(saved: SavedModel, to: Format, path: Path, force: bool = False) -> None:
    """Write a servo model in a form that other programs read.

    Parameters
    ----------
    saved : SavedModel
    to : {"onnx", "torchscript", "csv"}
    path : Path
    force : bool
        Replace `path` if it exists.

    Raises
    ------
    InputError
        If `path` exists and `force` is not given, if it cannot be written, if a physical model is
        to become a network, or if the package for ONNX is not installed.
    """
    refuse_overwrite(path, force)
    if to == "csv":
        data = parameter_table(saved).encode()
    elif to == "onnx":
        data = to_onnx(saved).SerializeToString()
    else:
        data = to_torchscript(saved)
    write_bytes(path, data, force)


def parameter_table(saved: SavedModel) -> str:
    """Every number of a model as a tidy table with the contract in its comment lines.

    One row per number: `joint`, `parameter`, `index_0`, `index_1`, … (its place in the joint's
    array; empty where the array has fewer axes), `value` (digits that give the same number back).
    """
    names = list(saved.contract.joints)
    axes = max(v.ndim for v in saved.parameters.values()) - 1
    lines = [",".join(("joint", "parameter", *(f"index_{k}" for k in range(axes)), "value"))]
    for j, joint in enumerate(names):
        for name, array in saved.parameters.items():
            for place, value in np.ndenumerate(array[j]):
                cells = [*(str(i) for i in place), *[""] * (axes - len(place))]
                lines.append(",".join((joint, name, *cells, str(value))))
    header = {"versions_when_exported": versions()} | _contract_json(saved.contract)
    return comments("pupper-sysid servo model table", header) + "\n".join(lines) + "\n"


def _contract_json(contract: Contract) -> dict[str, Any]:
    return contract.model_dump(mode="json", by_alias=True)


def _depth(model: CommandNetwork) -> int:
    return sum(name.startswith("weight_") for name in model.parameters)


def _learned(saved: SavedModel, to: str) -> Learned:
    if isinstance(saved.model, Learned):
        return saved.model
    raise InputError(
        f"{saved.path} is a {saved.contract.arch} model, which steps physics between commands and "
        f"cannot become {to}. Give the simulator a calibration instead (`pupper-sysid calibrate`), "
        "or export the model's numbers with `--to csv`."
    )


def _metadata(saved: SavedModel, model: Learned, inputs: list[str]) -> dict[str, str]:
    """What a user of an exported network must know, as text by name."""
    contract = saved.contract
    rest = "Reset: fill command_history_rad with the position of rest"
    rest += ", position_rad with the same" if model.feedback else ""
    if isinstance(model, RecurrentNetwork):
        rest += f", hidden and cell with zeros, then run {model.warm_up} steps, of which only "
        rest += "hidden and cell are kept"
    return {
        "joints": json.dumps(list(contract.joints)),
        "time_step_s": repr(contract.time_step_s),
        "inputs": json.dumps(inputs),
        "input_order": json.dumps(list(contract.inputs)),
        "output": contract.output,
        "units": contract.units,
        "reset": rest + ".",
        "contract": json.dumps(_contract_json(contract), ensure_ascii=False),
    }


# ------------------------------------------------------------------------------- ONNX


class _Graph:
    """Nodes and constants of an ONNX graph, named as they come."""

    def __init__(self, helper: Any, numpy_helper: Any):
        self._helper, self._numpy_helper = helper, numpy_helper
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}

    def constant(self, name: str, value: NDArray) -> str:
        self.constants[name] = self._numpy_helper.from_array(np.ascontiguousarray(value), name)
        return name

    def axes(self, *axes: int) -> str:
        return self.constant("axes_" + "_".join(map(str, axes)), np.array(axes, np.int64))

    def add(self, op: str, *inputs: str, out: str | None = None, **attributes: Any) -> str:
        out = out or f"{op.lower()}_{len(self.nodes)}"
        self.nodes.append(self._helper.make_node(op, list(inputs), [out], out, **attributes))
        return out

    def split(self, value: str, names: Sequence[str]) -> list[str]:
        node = self._helper.make_node("Split", [value], list(names), f"split_{value}", axis=-1)
        self.nodes.append(node)
        return list(names)


def to_onnx(saved: SavedModel) -> ModelProto:
    """A learned model as ONNX (opset 17), checked.

    Raises
    ------
    InputError
        If the model is a physical one, or the package `onnx` is not installed.
    """
    model = _learned(saved, "ONNX")
    try:
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    except ImportError as error:
        raise InputError(
            "ONNX files need the package onnx, which is not installed: "
            "`pip install 'pupper-sysid[onnx]'`."
        ) from error

    graph, p = _Graph(helper, numpy_helper), model.parameters
    for name, value in p.items():
        if name != "bound":
            graph.constant(name, value)
    joints = len(model.joints)

    def port(name: str, *shape: int) -> Any:
        return helper.make_tensor_value_info(
            name, TensorProto.FLOAT, ["environments", joints, *shape]
        )

    inputs = [port("command_history_rad", model.taps)]
    outputs = [port("position_rad_next")]
    graph.constant("command_center_", p["command_center"][:, None])
    graph.constant("command_scale_", p["command_scale"][:, None])
    history = graph.add("Sub", "command_history_rad", "command_center_")
    history = graph.add("Div", history, "command_scale_")
    last = ""
    if model.feedback:
        last = graph.add("Sub", "position_rad", "position_center")
        last = graph.add("Div", last, "position_scale")
        last = graph.add("Unsqueeze", last, graph.axes(2))
    normal = graph.add("Mul", history, "fir")
    normal = graph.add("ReduceSum", normal, graph.axes(2), keepdims=0)
    normal = graph.add("Add", normal, "fir_bias")
    correction = ""
    if isinstance(model, RecurrentNetwork):
        members, units = p["weight_out"].shape[1:]
        inputs += [port("hidden", members, units), port("cell", members, units)]
        outputs += [port("hidden_next", members, units), port("cell_next", members, units)]
        correction = _recurrent_nodes(graph, model, history, last)
    elif "weight_0" in p:
        seen = graph.add("Concat", history, last, axis=2) if model.feedback else history
        correction = _feedforward_nodes(graph, model, seen)
    if correction:
        normal = graph.add("Add", normal, correction)
    if model.feedback:
        inputs.append(port("position_rad"))
    scaled = graph.add("Mul", normal, "position_scale")
    graph.add("Add", scaled, "position_center", out="position_rad_next")
    read = {name for node in graph.nodes for name in node.input}
    made = helper.make_model(
        helper.make_graph(
            graph.nodes, f"servo_{saved.contract.arch}", inputs, outputs,
            [v for k, v in graph.constants.items() if k in read],
        ),
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
        producer_name="pupper-sysid",
    )  # fmt: skip
    helper.set_model_props(made, _metadata(saved, model, [i.name for i in inputs]))
    onnx.checker.check_model(made, full_check=True)
    return made


def _feedforward_nodes(graph: _Graph, model: CommandNetwork, seen: str) -> str:
    """Network of (N, joints, inputs): its correction (N, joints)."""
    depth = _depth(model)
    h = graph.add("Unsqueeze", seen, graph.axes(2))  # (N, joints, 1, inputs): a matrix per joint
    for layer in range(depth):
        bias = graph.constant(f"bias_{layer}_", model.parameters[f"bias_{layer}"][:, None])
        h = graph.add("MatMul", h, f"weight_{layer}")
        h = graph.add("Add", h, bias)
        if layer < depth - 1:
            h = graph.add("Relu", h)
    return _bounded_nodes(
        graph, model.parameters["bound"], graph.add("Squeeze", h, graph.axes(2, 3))
    )


def _recurrent_nodes(graph: _Graph, model: RecurrentNetwork, history: str, last: str) -> str:
    """One step of the memories: the correction (N, joints)."""
    newest = graph.add("Gather", history, graph.constant("first", np.array([0])), axis=2)
    seen = graph.add("Concat", newest, last, axis=2) if model.feedback else newest
    seen = graph.add("Unsqueeze", seen, graph.axes(2, 3))  # (N, joints, 1, 1, inputs)
    hidden = graph.add("Unsqueeze", "hidden", graph.axes(3))
    gates = graph.add(
        "Add",
        graph.add("MatMul", seen, "weight_input"),
        graph.add("MatMul", hidden, "weight_hidden"),
    )
    gates = graph.add("Add", graph.add("Squeeze", gates, graph.axes(3)), "bias")
    i, f, g, o = graph.split(gates, ("gate_i", "gate_f", "gate_g", "gate_o"))
    kept = graph.add("Mul", graph.add("Sigmoid", f), "cell")
    new = graph.add("Mul", graph.add("Sigmoid", i), graph.add("Tanh", g))
    cell = graph.add("Add", kept, new, out="cell_next")
    opened = graph.add("Sigmoid", o)
    hidden = graph.add("Mul", opened, graph.add("Tanh", cell), out="hidden_next")
    out = graph.add("Mul", hidden, "weight_out")
    out = graph.add("ReduceSum", out, graph.axes(3), keepdims=0)
    out = graph.add("Add", out, "bias_out")
    return graph.add(
        "ReduceMean",
        _bounded_nodes(graph, model.parameters["bound"][:, None], out),
        axes=[2],
        keepdims=0,
    )


def _bounded_nodes(graph: _Graph, bound: NDArray, value: str) -> str:
    if np.isinf(bound).all():
        return value
    graph.constant("bound", bound)
    return graph.add("Mul", graph.add("Tanh", graph.add("Div", value, "bound")), "bound")


def to_torchscript(saved: SavedModel) -> bytes:
    """A learned model as a TorchScript archive, for `torch.jit.load` and LibTorch.

    Its extra files are the contract (`contract.json`) and what ONNX has as metadata
    (`metadata.json`).

    Raises
    ------
    InputError
        If the model is a physical one.
    """
    from pupper_sysid.sysid.export.torchscript import archive  # torch is slow to import

    model = _learned(saved, "TorchScript")
    inputs = ["command_history_rad"]
    inputs += ["hidden", "cell"] if isinstance(model, RecurrentNetwork) else []
    inputs += ["position_rad"] if model.feedback else []
    metadata = _metadata(saved, model, inputs)
    extra = {
        "contract.json": metadata["contract"],
        "metadata.json": json.dumps(metadata, ensure_ascii=False),
    }
    return archive(model, extra)
