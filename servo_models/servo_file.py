"""Servo model files: a folder with weights and the contract under which they are valid.

`contract.json` describes the model (joints, inputs and their order, time step, units, training
data, scores, versions); `weights.safetensors` holds its arrays. The contract has the weights' hash,
so that neither can be exchanged alone; nothing in either is code. `load_servo_model` refuses a
model for another rate or joint, and any file that is damaged, changed or of an unknown version.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from pupper_sysid.common.border import (
    Part,
    read_bytes,
    read_json,
    refuse_other_kind,
    refuse_other_version,
    validated,
)
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import as_path, refuse_overwrite, write_bytes, write_text
from pupper_sysid.common.joints import strange_joint
from pupper_sysid.common.processes.stop import held
from pupper_sysid.common.reading.content import refuse_large_header
from pupper_sysid.servo_models.calibration.calibration import InputFile
from pupper_sysid.servo_models.delayed_pd import (
    AtControlRate,
    DelayedPD,
    DelayedPDParameters,
    substeps,
)
from pupper_sysid.servo_models.networks import CommandNetwork, RecurrentNetwork, same_rate
from pupper_sysid.servo_models.sparse_equation import COEFFICIENTS, SparseEquation

SCHEMA = "pupper-servo-model"
SCHEMA_VERSION = 2
CONTRACT, WEIGHTS = "contract.json", "weights.safetensors"
ARCHITECTURES = ("fir", "mlp", "lstm", "delayed-pd", "sindy")
_LARGEST_BYTES = 50_000_000
_AGAIN = "Copy the whole folder again, or fit the model again."
_LONGEST_DELAY_S = 1.0
_MAY_BE_INFINITE = ("effort_limit", "velocity_limit", "saturation_error_rad")

_LINEAR = frozenset(
    "command_center command_scale position_center position_scale bound fir fir_bias".split()
)
_RECURRENT = frozenset(("weight_input", "weight_hidden", "bias", "weight_out", "bias_out"))

Model = CommandNetwork | RecurrentNetwork | AtControlRate


class JointContract(Part):
    """Scores and error of one joint's model."""

    scores: dict[str, float | None]
    """On data the model has not seen, see the README."""
    band_noise_rad: Annotated[float, Field(ge=0)]
    """Standard deviation of the model's error at rest."""
    band_timing_s: Annotated[float, Field(ge=0)]
    """Its growth with speed v: the whole is sqrt(noise² + (timing · v)²)."""
    readings: Annotated[int, Field(ge=0)]
    """Number of readings it was fitted to."""


class Contract(Part):
    """What a saved servo model is, and what it needs."""

    schema_name: Annotated[Literal["pupper-servo-model"], Field(alias="schema")] = SCHEMA
    schema_version: Literal[1, 2] = SCHEMA_VERSION
    arch: Literal["fir", "mlp", "lstm", "delayed-pd", "sindy"]
    preset: str
    created: str
    time_step_s: Annotated[float, Field(ge=1e-4, le=1)]
    """Time between commands; the output is the position one step later."""
    inputs: Annotated[tuple[str, ...], Field(strict=False)]
    """Names of the inputs, in order."""
    output: Literal["position_rad, one time step after the newest command"] = (
        "position_rad, one time step after the newest command"
    )
    units: Literal["radians of the simulator frame, seconds"] = (
        "radians of the simulator frame, seconds"
    )
    feedback: bool
    warm_up: Annotated[int, Field(ge=0, le=1000)] = 0
    """Steps at rest after a reset (LSTM)."""
    joints: Annotated[dict[str, JointContract], Field(min_length=1)]
    """In the order of the arrays' first axis."""
    readings_counted: dict[str, str]
    """"fresh" (each at its own time) or "all" rows, per joint."""
    split: str
    choices: dict[str, float]
    recordings: Annotated[tuple[InputFile, ...], Field(strict=False)]
    seed: int
    versions: dict[str, str]
    notes: Annotated[tuple[str, ...], Field(strict=False)] = ()
    weights_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


@dataclass(frozen=True)
class SavedModel:
    """A model, its arrays and its contract."""

    model: Model
    contract: Contract
    parameters: dict[str, NDArray[np.floating]]
    path: Path

    def __repr__(self) -> str:
        step_ms = 1e3 * self.contract.time_step_s
        joints = ", ".join(self.contract.joints)
        return f"SavedModel {self.path.name}: {joints}; a command every {step_ms:g} ms"


def input_names(parameters: Mapping[str, NDArray], feedback: bool) -> tuple[str, ...]:
    """Names of a model's inputs, in order: commands newest first, then a predicted position."""
    taps = parameters["fir"].shape[1] if "fir" in parameters else 1
    names = ["command_rad[t]", *(f"command_rad[t-{k}]" for k in range(1, taps))]
    return (*names, "predicted_position_rad[t]") if feedback else tuple(names)


def save_servo_model(
    folder: Path, parameters: Mapping[str, NDArray], contract: dict[str, Any], force: bool = False
) -> Contract:
    """Write a model into a folder, which is created if missing.

    The joints are the first axis of the arrays, in the contract's order; `contract` has the fields
    of `Contract` without the weights' hash.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file; a servo model is a folder. Choose another name.")
    for name in (CONTRACT, WEIGHTS):
        refuse_overwrite(folder / name, force)
    data = save_tensors({k: np.ascontiguousarray(v) for k, v in parameters.items()})
    complete = _validated({**contract, "weights_sha256": hashlib.sha256(data).hexdigest()}, folder)
    _build(complete, parameters, folder)  # check that it can be read back before it is written
    text = json.dumps(complete.model_dump(mode="json", by_alias=True), indent=2, ensure_ascii=False)
    with held():  # both files or none: weights without a contract are no model
        write_bytes(folder / WEIGHTS, data, force)
        write_text(folder / CONTRACT, text + "\n", force)
    return complete


def load_servo_model(
    folder: Path | str, joints: Sequence[str] | None = None, time_step_s: float | None = None
) -> SavedModel:
    """Read a model and build it.

    Parameters
    ----------
    folder : Path or str
        Of the contract and the weights.
    joints : sequence of str, optional
        Joints of the model's batch, in this order; by default all that it has.
    time_step_s : float, optional
        Time between commands in use [s].

    Returns
    -------
    SavedModel
        The model at rest at 0 rad, its arrays and its contract.

    Raises
    ------
    InputError
        If the folder holds no model, or one that is damaged or changed, or is for another joint
        or rate.
    """
    folder = as_path(folder, "The folder of a servo model")
    contract = _read_contract(folder)
    if time_step_s is not None and not same_rate(contract.time_step_s, time_step_s):
        raise InputError(
            f"{folder} is a model for a command every {1e3 * contract.time_step_s:.1f} ms, but "
            f"commands come every {1e3 * time_step_s:.1f} ms. A learned model cannot change its "
            "rate: record at the new one and fit again, or fit the architecture delayed-pd."
        )
    names = list(contract.joints)
    chosen = names if joints is None else list(joints)
    missing = [j for j in chosen if j not in contract.joints]
    if missing:
        raise InputError(
            f"{folder} has no model for {', '.join(missing)}; it has {', '.join(names)}. Servos "
            "differ, so another joint's model is no substitute: fit one of its own."
        )
    data = read_bytes(folder / WEIGHTS, _LARGEST_BYTES, _AGAIN)
    if hashlib.sha256(data).hexdigest() != contract.weights_sha256:
        raise InputError(
            f"{folder / WEIGHTS} is not the file that {CONTRACT} describes (its SHA-256 differs): "
            "it was cut short, changed or exchanged. Copy the whole folder again, or fit again."
        )
    refuse_large_header(folder / WEIGHTS, data)
    try:
        parameters = load_tensors(data)
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder / WEIGHTS} is no safetensors file: {error}.") from error
    if contract.schema_version == 1 and "delay_s" in parameters:
        parameters["dead_time_s"] = parameters.pop("delay_s")  # its name until version 2
    contract = contract.model_copy(update={"schema_version": SCHEMA_VERSION})
    model = _build(contract, parameters, folder)
    if chosen != names:
        index = [names.index(j) for j in chosen]
        parameters = {k: v[index] for k, v in parameters.items()}
        contract = contract.model_copy(update={"joints": {j: contract.joints[j] for j in chosen}})
        model = build(contract, parameters)
    return SavedModel(model, contract, parameters, folder)


def build(contract: Contract, parameters: Mapping[str, NDArray]) -> Model:
    """The model of a contract and its arrays."""
    joints, step = tuple(contract.joints), contract.time_step_s
    _check_names(contract.arch, set(parameters))
    for name, value in parameters.items():
        fits = value.ndim > 0 and value.size > 0 and value.dtype.kind == "f"
        if not fits or len(value) != len(joints):
            raise InputError(
                f"{name} is no array of numbers of {len(joints)} joints (shape {value.shape}, "
                f"type {value.dtype}). Fit again."
            )
    if "fir" in parameters and parameters["fir"].ndim != 2:
        raise InputError(f"fir has shape {parameters['fir'].shape}; it needs 2 axes. Fit again.")
    bound = parameters.get("bound", np.zeros(1))
    if np.isinf(bound).any() and not np.isinf(bound).all() and not np.isnan(bound).any():
        raise InputError("bound is infinite for some joints only. Fit again.")
    if contract.inputs != input_names(parameters, contract.feedback):
        raise InputError(
            f"its arrays take {', '.join(input_names(parameters, contract.feedback))}, but its "
            f"{CONTRACT} says {', '.join(contract.inputs)}. Fit again."
        )
    if contract.arch in ("fir", "mlp", "lstm"):
        if "weight_hidden" in parameters:
            return RecurrentNetwork(joints, step, parameters, contract.feedback, contract.warm_up)
        return CommandNetwork(joints, step, parameters, contract.feedback)
    values = {k: np.asarray(v, float) for k, v in parameters.items()}
    for name, value in values.items():
        if value.shape != (len(joints),):
            raise InputError(f"{name} has shape {value.shape}; it must be one number per joint.")
        if np.isnan(value).any() or (name not in _MAY_BE_INFINITE and np.isinf(value).any()):
            raise InputError(
                f"{name} holds NaN or infinite numbers: its fit failed or the file was damaged."
            )
    if (values["dead_time_s"] > _LONGEST_DELAY_S).any():
        raise InputError(f"dead_time_s is more than {_LONGEST_DELAY_S:g} s. Fit again.")
    return physical_model(contract.arch, values, step)


def physical_model(
    arch: str, parameters: Mapping[str, NDArray], time_step_s: float
) -> AtControlRate:
    """DelayedPD ("delayed-pd") or sparse equation ("sindy"), one step per command.

    Parameters are as in the model's file, each of shape (joints,).
    """
    values, count = dict(parameters), substeps(time_step_s)
    offset, step = values.pop("offset_rad"), time_step_s / count
    if arch == "delayed-pd":
        return AtControlRate(DelayedPD(DelayedPDParameters(**values), step), count, offset)
    dead_time = values.pop("dead_time_s")
    return AtControlRate(SparseEquation(values, dead_time, offset, step), count)


def _build(contract: Contract, parameters: Mapping[str, NDArray], folder: Path) -> Model:
    try:
        return build(contract, parameters)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from error


def _check_names(arch: str, names: set[str]) -> None:
    """Refuse missing arrays, and those of another architecture."""
    required, optional = set(_LINEAR), frozenset[str]()
    if arch == "delayed-pd":
        required = {f.name for f in fields(DelayedPDParameters)} - {"back_emf"} | {"offset_rad"}
        optional = frozenset({"back_emf"})  # not in older files
    elif arch == "sindy":
        required, optional = {"dead_time_s", "offset_rad"}, frozenset(COEFFICIENTS)
    elif arch == "mlp":
        depth = sum(name.startswith("weight_") for name in names)
        required |= {f"{kind}_{n}" for kind in ("weight", "bias") for n in range(depth)}
    elif arch == "lstm" and names != _LINEAR:  # training that was ended at once leaves the filter
        required |= _RECURRENT
    missing, foreign = sorted(required - names), sorted(names - required - optional)
    if missing or foreign:
        what = f"{missing[0]} is missing" if missing else f"{foreign[0]} is none of its arrays"
        raise InputError(f"the weights are not those of a model of type {arch}: {what}. Fit again.")


def _read_contract(folder: Path) -> Contract:
    refuse_other_kind(folder, SCHEMA)
    path = folder / CONTRACT
    if not os.path.exists(path):
        raise InputError(
            f"{folder} holds no servo model ({CONTRACT} is missing). "
            "Make one with `pupper-sysid fit-servo`."
        )
    contract = read_json(path, remedy=_AGAIN)
    if not isinstance(contract, dict) or contract.get("schema") != SCHEMA:
        raise InputError(f"{path} is no servo model's contract. Give a folder of `fit-servo`.")
    refuse_other_version(path, contract.get("schema_version"), SCHEMA_VERSION)
    return _validated(contract, path)


def _validated(content: dict[str, Any], path: Path) -> Contract:
    contract = validated(Contract, content, path, remedy="fit the model again")
    if strange := strange_joint(contract.joints):
        raise InputError(f"{path}: {strange[0]} is no joint; {strange[1]}")
    return contract
