"""ONNX and TorchScript files of a PyTorch module, checked before they are written.

`export_module` is used for servo models and for policies. The file is loaded again, and the caller
compares what it computes with the model it came from; a file that differs is not written.

`ServoStep` is one step of a servo network (`servo_models.networks`) as such a module.
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
from torch import Tensor, nn

from pupper_sysid.common.errors import InputError, PupperError
from pupper_sysid.common.files import refuse_overwrite, write_bytes
from pupper_sysid.servo_models.networks import CommandNetwork, RecurrentNetwork

CLOSE = 1e-5
"""Largest difference between a file's outputs and the model's [unit of the output]."""

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
    """Write a module as one file that other runtimes read.

    Parameters
    ----------
    module : torch.nn.Module
        Returns a tensor or a tuple of tensors.
    example_inputs : sequence of Tensor
        The module is traced with them: its control flow must not depend on their values.
    names : (sequence of str, sequence of str)
        Of inputs and outputs. Inputs are passed by name if `forward` has parameters of these
        names, else by position.
    path : Path
    to : {"onnx", "torchscript"}
    difference : callable
        Given the loaded file (`Run`), returns the largest difference from the model's outputs.
    metadata : mapping of str to str, optional
        Properties of the ONNX file; in TorchScript, the extra files `metadata.json` (all) and
        `contract.json` (the entry `contract`).
    batch : str, optional
        Name of the first axis if its size is free (ONNX); by default it is that of the examples.
    opset : int
        ONNX operator set.
    force : bool
        Replace `path` if it exists.

    Returns
    -------
    float
        The largest difference.
    """
    refuse_overwrite(path, force)
    module = module.eval()
    by_name = set(names[0]) <= set(inspect.signature(module.forward).parameters)
    examples = dict(zip(names[0], example_inputs, strict=True))
    given: dict[str, Any] = {"args": (), "kwargs": examples}
    if not by_name:
        given = {"args": tuple(example_inputs), "kwargs": {}}
    with warnings.catch_warnings(), torch.inference_mode():
        # both are deprecated in favour of torch.export, whose files older runtimes cannot load
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        warnings.filterwarnings("ignore", category=FutureWarning)
        make = _onnx if to == "onnx" else _torchscript
        data, run = make(module, given, names, dict(metadata or {}), batch, opset)
    worst = difference(run)
    if not worst <= CLOSE:
        raise PupperError(
            f"The {to} file differs from the model by {worst:.1e}; it was not written."
        )
    write_bytes(path, data, force)
    return worst


def _torchscript(module, given, names, metadata, batch, opset) -> tuple[bytes, Run]:
    by_name = {"example_kwarg_inputs": given["kwargs"]} if given["kwargs"] else {}
    traced: Any = torch.jit.trace(module, given["args"] or None, **by_name)
    extra = {"metadata.json": json.dumps(metadata, ensure_ascii=False)} if metadata else {}
    extra |= {"contract.json": metadata["contract"]} if "contract" in metadata else {}
    buffer = io.BytesIO()
    torch.jit.save(traced, buffer, _extra_files=extra)
    loaded = torch.jit.load(io.BytesIO(buffer.getvalue()))

    def run(*inputs: Tensor) -> Sequence[Tensor]:
        with torch.inference_mode():
            found = loaded(*inputs)
        return found if isinstance(found, tuple) else (found,)

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


def _onnx(module, given, names, metadata, batch, opset) -> tuple[bytes, Run]:
    onnx = onnx_library()
    ins, outs = names
    buffer = io.BytesIO()
    export: Any = torch.onnx.export  # its annotations lack buffers
    export(
        module, given["args"], buffer, kwargs=given["kwargs"] or None, input_names=list(ins),
        output_names=list(outs), opset_version=opset, dynamo=False,
        dynamic_axes={name: {0: batch} for name in (*ins, *outs)} if batch else None,
    )  # fmt: skip
    made = onnx.load_from_string(buffer.getvalue())
    found = module(*given["args"], **given["kwargs"])
    shown = found if isinstance(found, tuple) else (found,)
    for port, value in zip(made.graph.output, shown, strict=True):
        for axis, size in list(zip(port.type.tensor_type.shape.dim, value.shape, strict=True))[1:]:
            axis.dim_value = size  # the exporter forgets them where the first axis is free
    onnx.helper.set_model_props(made, metadata)
    onnx.checker.check_model(made, full_check=True)
    evaluator = onnx.reference.ReferenceEvaluator(made)

    def run(*inputs: Tensor) -> Sequence[Tensor]:
        found = evaluator.run(None, {n: v.numpy() for n, v in zip(ins, inputs, strict=True)})
        return [torch.from_numpy(np.asarray(f)) for f in found]

    return made.SerializeToString(), run


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
        """One step.

        Parameters
        ----------
        command_history_rad : Tensor, shape (N, joints, taps)
            Newest first [rad].
        hidden, cell : Tensor, shape (N, joints, members, units), optional
            Memory of an LSTM.
        position_rad : Tensor, shape (N, joints), optional
            Position predicted last [rad], of a model with feedback.

        Returns
        -------
        Tensor, shape (N, joints)
            Position after the step [rad]; of an LSTM, followed by the next `hidden` and `cell`.
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
