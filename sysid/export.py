"""Networks as ONNX and TorchScript files, checked before they are written.

`export_module` is used for servo models and for policies. The file is loaded again, and the caller
compares what it computes with the model it came from; a file that differs is not written.

`ServoStep` is one step of a servo network (`servo_models.networks`) as such a module.

`export_servo_model` writes a learned servo model so, and the numbers of any as CSV. A simulator or
a robot that has no pupper-sysid can then run the model. The exported network holds no state: it
maps one step's inputs to its outputs, all joints and any number N of environments at once, in
radians, with the normalisation inside:

    command_history_rad (N, joints, taps), newest first     -> position_rad_next (N, joints)
    position_rad (N, joints), predicted last, if `feedback`
    hidden, cell (N, joints, members, units), if LSTM       -> hidden_next, cell_next

The caller shifts the history and feeds the outputs back. Both formats carry the contract and the
order of joints and inputs; this project reads neither.

Physical models (delayed-pd, sindy) integrate physics between commands and are no such map; they
are exported as a table of numbers only.
"""

from __future__ import annotations

import inspect
import io
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from pupper_sysid.common.errors import InputError, PupperError
from pupper_sysid.common.files import refuse_overwrite, versions, write_bytes, write_text
from pupper_sysid.servo_models.networks import CommandNetwork, RecurrentNetwork
from pupper_sysid.servo_models.servo_file import SavedModel
from pupper_sysid.sysid.recordings.table import comments

CLOSE = 1e-5  # largest difference between a file's outputs and the model's [unit of the output]

Run = Callable[..., Sequence[Tensor]]
"""The exported file, loaded: tensors in the order of its inputs to tensors of its outputs."""


def export_module(
    module: nn.Module,
    example_inputs: Sequence[Tensor],
    names: tuple[Sequence[str], Sequence[str]],
    path: Path,
    to: Literal["onnx", "torchscript"],
    *,
    difference: Callable[[Run], float],
    metadata: Mapping[str, str] | None = None,
    batch: str | None = None,
    opset: int = 18,
    force: bool = False,
) -> float:
    """Write a module as one file that other runtimes read, and return its largest difference.

    The module returns a tensor or a tuple of tensors. It is traced with `example_inputs`: its
    control flow must not depend on their values. `names` are of inputs and outputs; inputs are
    passed by name if `forward` has parameters of these names, else by position. `difference`
    compares the loaded file (`Run`) with the model's outputs. `metadata` becomes properties of the
    ONNX file; in TorchScript, the extra files `metadata.json` (all) and `contract.json` (the entry
    `contract`). `batch` names the first axis if its size is free (ONNX); `opset` is ONNX's operator
    set.
    """
    refuse_overwrite(path, force)
    module = module.eval()
    example: dict[str, Any] = {"args": tuple(example_inputs), "kwargs": {}}
    if set(names[0]) <= set(inspect.signature(module.forward).parameters):
        example = {"args": (), "kwargs": dict(zip(names[0], example_inputs, strict=True))}
    with warnings.catch_warnings(), torch.inference_mode():
        # both are deprecated in favour of torch.export, whose files older runtimes cannot load
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        warnings.filterwarnings("ignore", category=FutureWarning)
        make = _onnx if to == "onnx" else _torchscript
        data, run = make(module, example, names, dict(metadata or {}), batch, opset)
    worst = difference(run)
    if not worst <= CLOSE:
        raise PupperError(
            f"The {to} file differs from the model by {worst:.1e}; it was not written."
        )
    write_bytes(path, data, force)
    return worst


def _torchscript(module, example, names, metadata, batch, opset) -> tuple[bytes, Run]:
    by_name = {"example_kwarg_inputs": example["kwargs"]} if example["kwargs"] else {}
    traced: Any = torch.jit.trace(module, example["args"] or None, **by_name)
    extra = {"metadata.json": json.dumps(metadata, ensure_ascii=False)} if metadata else {}
    extra |= {"contract.json": metadata["contract"]} if "contract" in metadata else {}
    buffer = io.BytesIO()
    torch.jit.save(traced, buffer, _extra_files=extra)
    loaded = torch.jit.load(io.BytesIO(buffer.getvalue()))

    def run(*inputs: Tensor) -> Sequence[Tensor]:
        with torch.inference_mode():
            outputs = loaded(*inputs)
        return outputs if isinstance(outputs, tuple) else (outputs,)

    return buffer.getvalue(), run


def onnx_library() -> Any:
    """The package onnx, an optional one."""
    try:
        import onnx
        import onnx.checker
        import onnx.reference
        import onnx.shape_inference
    except ImportError as error:
        raise InputError(
            "ONNX files need the package onnx, which is not installed: "
            "`pip install 'pupper-sysid[onnx]'`."
        ) from error
    return onnx


def _onnx(module, example, names, metadata, batch, opset) -> tuple[bytes, Run]:
    onnx = onnx_library()
    ins, outs = names
    buffer = io.BytesIO()
    export: Any = torch.onnx.export  # its annotations lack buffers
    export(
        module, example["args"], buffer, kwargs=example["kwargs"] or None, input_names=list(ins),
        output_names=list(outs), opset_version=opset, dynamo=False,
        dynamic_axes={name: {0: batch} for name in (*ins, *outs)} if batch else None,
    )  # fmt: skip
    onnx_model = onnx.load_from_string(buffer.getvalue())
    result = module(*example["args"], **example["kwargs"])
    outputs = result if isinstance(result, tuple) else (result,)
    for port, value in zip(onnx_model.graph.output, outputs, strict=True):
        for axis, size in list(zip(port.type.tensor_type.shape.dim, value.shape, strict=True))[1:]:
            axis.dim_value = size  # the exporter forgets them where the first axis is free
    onnx.helper.set_model_props(onnx_model, metadata)
    onnx.checker.check_model(onnx_model, full_check=True)
    evaluator = onnx.reference.ReferenceEvaluator(onnx_model)

    def run(*inputs: Tensor) -> Sequence[Tensor]:
        outputs = evaluator.run(None, {n: v.numpy() for n, v in zip(ins, inputs, strict=True)})
        return [torch.from_numpy(np.asarray(f)) for f in outputs]

    return onnx_model.SerializeToString(), run


class ServoStep(nn.Module):
    """Position after one time step, of N environments and all joints at once."""

    def __init__(self, model: CommandNetwork | RecurrentNetwork):
        super().__init__()
        self._bounded = not bool(np.isinf(model.parameters["bound"]).all())
        self._depth = sum(f"weight_{n}" in model.parameters for n in range(len(model.parameters)))
        for name, value in model.parameters.items():
            self.register_buffer(name, torch.tensor(value))

    def forward(
        self,
        command_history_rad: Tensor,
        hidden: Tensor | None = None,
        cell: Tensor | None = None,
        position_rad: Tensor | None = None,
    ) -> Tensor | tuple[Tensor, Tensor, Tensor]:
        """Position after the step [rad], (N, joints); of an LSTM also `hidden` and `cell`.

        `command_history_rad` (N, joints, taps) is newest first; `hidden` and `cell` (N, joints,
        members, units) are an LSTM's memory; `position_rad` (N, joints) was predicted last, for a
        model with feedback.
        """
        p = dict(self.named_buffers())
        history = command_history_rad - p["command_center"][:, None]
        history = history / p["command_scale"][:, None]
        normal = (history * p["fir"]).sum(2) + p["fir_bias"]
        seen = history if self._depth else history[:, :, :1]
        if position_rad is not None:
            last = (position_rad - p["position_center"]) / p["position_scale"]
            seen = torch.cat([seen, last[:, :, None]], 2)
        if hidden is not None and cell is not None:
            gates = torch.matmul(seen[:, :, None, None], p["weight_input"])
            gates = gates + torch.matmul(hidden[:, :, :, None], p["weight_hidden"])
            i, f, g, o = (gates.squeeze(3) + p["bias"]).chunk(4, -1)
            cell = torch.sigmoid(f) * cell + torch.sigmoid(i) * torch.tanh(g)
            hidden = torch.sigmoid(o) * torch.tanh(cell)
            out = (hidden * p["weight_out"]).sum(3) + p["bias_out"]
            normal = normal + self._limited(out, p["bound"][:, None]).mean(2)
        elif self._depth:
            h = seen[:, :, None]  # (N, joints, 1, inputs): a matrix per joint
            for n in range(self._depth):
                h = torch.relu(h) if n else h
                h = torch.matmul(h, p[f"weight_{n}"]) + p[f"bias_{n}"][:, None]
            normal = normal + self._limited(h[:, :, 0, 0], p["bound"])
        position = normal * p["position_scale"] + p["position_center"]
        return (position, hidden, cell) if hidden is not None and cell is not None else position

    def _limited(self, value: Tensor, bound: Tensor) -> Tensor:
        return bound * torch.tanh(value / bound) if self._bounded else value


ENDINGS: dict[str, str] = {"csv": ".csv", "onnx": ".onnx", "torchscript": ".pt"}
_ENVIRONMENTS, _STEPS = 3, 20  # of the free run in which a file is compared with its model


def export_servo_model(
    saved: SavedModel, to: Literal["csv", "onnx", "torchscript"], path: Path, force: bool = False
) -> None:
    """Write a servo model in a form that other programs read."""
    if to == "csv":
        write_text(path, parameter_table(saved), force)
    else:
        _write_network(saved, to, path, force)


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
    header = {"versions_when_exported": versions()} | saved.contract.model_dump(
        mode="json", by_alias=True
    )
    return comments("pupper-sysid servo model table", header) + "\n".join(lines) + "\n"


def _metadata(
    saved: SavedModel, model: CommandNetwork | RecurrentNetwork, inputs: list[str]
) -> dict[str, str]:
    """Joints, time step, inputs and reset of an exported network, as text by name."""
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
        "contract": json.dumps(contract.model_dump(mode="json", by_alias=True), ensure_ascii=False),
    }


def _write_network(saved: SavedModel, to: Literal["onnx", "torchscript"], path: Path, force: bool):
    """The model's step as a file, which must repeat a free run of the model."""
    model = saved.model
    if not isinstance(model, CommandNetwork | RecurrentNetwork):
        raise InputError(
            f"{saved.path} is a {saved.contract.arch} model, which integrates physics between "
            f"commands and cannot become {to}. Give the simulator a calibration instead "
            "(`pupper-sysid calibrate`), or export the model's numbers as csv."
        )

    def state(rest: NDArray[np.float32]) -> dict[str, torch.Tensor]:
        """Inputs after a reset at `rest`, shape (environments, joints)."""
        at = torch.from_numpy(rest)
        state_of = {"command_history_rad": at[..., None].repeat(1, 1, model.taps)}
        if isinstance(model, RecurrentNetwork):
            zeros = torch.zeros(*rest.shape, *model.parameters["weight_out"].shape[1:])
            state_of |= {"hidden": zeros, "cell": zeros.clone()}
        return state_of | ({"position_rad": at} if model.feedback else {})

    def difference(run: Run) -> float:
        rng = np.random.default_rng(0)
        size = (_ENVIRONMENTS, len(model.joints))
        rest, steps = rng.normal(size=size) / 2, rng.normal(size=(_STEPS, *size)) / 4
        rest = rest.astype(np.float32)
        model.reset(rest)
        now, worst = state(rest), 0.0
        warm_up = saved.contract.warm_up if "hidden" in now else 0
        for k, command in enumerate([*[rest] * warm_up, *(rest + steps.cumsum(0))]):
            newest = torch.from_numpy(np.float32(command))[..., None]
            history = now["command_history_rad"][..., :-1]
            now["command_history_rad"] = torch.cat([newest, history], -1)
            position, *memory = run(*now.values())
            now |= dict(zip(("hidden", "cell"), memory, strict=False))
            if k >= warm_up:
                apart = np.abs(position.numpy() - model.step(np.float32(command))).max()
                worst = max(worst, float(apart))
                now |= {"position_rad": position} if model.feedback else {}
        return worst

    inputs = state(np.zeros((1, len(model.joints)), np.float32))
    outputs = ["position_rad_next", *(f"{n}_next" for n in ("hidden", "cell") if n in inputs)]
    export_module(
        ServoStep(model), list(inputs.values()), (list(inputs), outputs), path, to,
        difference=difference, metadata=_metadata(saved, model, list(inputs)),
        batch="environments", opset=17, force=force,
    )  # fmt: skip
