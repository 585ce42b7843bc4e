"""Export of servo models: a learned model as ONNX or TorchScript, the numbers of any as CSV.

A simulator or a robot that has no pupper-sysid can then run the model. The exported network holds
no state: it maps one step's inputs to its outputs, all joints and any number N of environments at
once, in radians, with the normalisation inside:

    command_history_rad (N, joints, taps), newest first     -> position_rad_next (N, joints)
    position_rad (N, joints), predicted last, if `feedback`
    hidden, cell (N, joints, members, units), if LSTM       -> hidden_next, cell_next

The caller shifts the history and feeds the outputs back. Both formats carry the contract and the
order of joints and inputs; this project reads neither.

Physical models (delayed-pd, sindy) integrate physics between commands and are no such map; they
are exported as a table of numbers only.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import versions, write_text
from pupper_sysid.servo_models.networks import CommandNetwork, RecurrentNetwork
from pupper_sysid.servo_models.servo_file import Contract, SavedModel
from pupper_sysid.sysid.recordings.table import comments

ENDINGS: dict[str, str] = {"csv": ".csv", "onnx": ".onnx", "torchscript": ".pt"}
_ENVIRONMENTS, _STEPS = 3, 20  # of the free run in which a file is compared with its model


def export_servo_model(
    saved: SavedModel, to: Literal["csv", "onnx", "torchscript"], path: Path, force: bool = False
) -> None:
    """Write a servo model in a form that other programs read.

    Parameters
    ----------
    saved : SavedModel
    to : {"csv", "onnx", "torchscript"}
    path : Path
    force : bool
        Replace `path` if it exists.
    """
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
    header = {"versions_when_exported": versions()} | _contract_json(saved.contract)
    return comments("pupper-sysid servo model table", header) + "\n".join(lines) + "\n"


def _contract_json(contract: Contract) -> dict[str, Any]:
    return contract.model_dump(mode="json", by_alias=True)


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
        "contract": json.dumps(_contract_json(contract), ensure_ascii=False),
    }


def _write_network(saved: SavedModel, to: Literal["onnx", "torchscript"], path: Path, force: bool):
    """The model's step as a file, which must repeat a free run of the model."""
    import torch  # slow to import

    from pupper_sysid.sysid.export.network import Run, ServoStep, export_module

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
        found = {"command_history_rad": at[..., None].repeat(1, 1, model.taps)}
        if isinstance(model, RecurrentNetwork):
            zeros = torch.zeros(*rest.shape, *model.parameters["weight_out"].shape[1:])
            found |= {"hidden": zeros, "cell": zeros.clone()}
        return found | ({"position_rad": at} if model.feedback else {})

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
