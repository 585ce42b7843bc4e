"""Servo model files: weights that run, and the contract under which they may.

A saved model is a folder: `contract.json` says what the model is (joints, inputs and their order,
time step, units, normalisation, what it was trained on, how well it did, versions) and
`weights.safetensors` holds its arrays. The contract names the weights' hash, so that one cannot be
exchanged without the other; nothing in either is code. A model that is asked to run at another
rate, on another joint, or from a file this version does not know is refused in a sentence.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from common.errors import InputError
from common.files import refuse_overwrite, write_bytes, write_text
from common.joints import JOINT_NAMES
from servo_models.command_network import CommandNetwork
from servo_models.control_rate import AtControlRate, substeps
from servo_models.delayed_pd import DelayedPD, DelayedPDParameters
from servo_models.recurrent_network import RecurrentNetwork
from servo_models.sparse_equation import SparseEquation

SCHEMA_VERSION = 1
CONTRACT, WEIGHTS = "contract.json", "weights.safetensors"
ARCHITECTURES = ("fir", "mlp", "lstm", "delayed-pd", "sindy")
_SAME_RATE = 0.02
_LARGEST_BYTES = 50_000_000

Model = CommandNetwork | RecurrentNetwork | AtControlRate


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class JointContract(_Strict):
    """What is known of one joint's model.

    Attributes
    ----------
    scores : dict of str to float or None
        On data the model has not seen, see the README.
    band_noise_rad, band_timing_s : float
        Standard deviation of its error at speed v: sqrt(noise² + (timing · v)²).
    readings : int
        It was fitted to.
    """

    scores: dict[str, float | None]
    band_noise_rad: Annotated[float, Field(ge=0)]
    band_timing_s: Annotated[float, Field(ge=0)]
    readings: Annotated[int, Field(ge=0)]


class InputRecording(_Strict):
    """A recording the model was fitted to."""

    name: str
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Contract(_Strict):
    """What a saved servo model is, and what it needs.

    Attributes
    ----------
    time_step_s : float
        Time between commands; the model answers where the servo is one step later.
    inputs : tuple of str
        In the order in which the model takes them.
    readings_counted : dict of str to str
        "fresh" (each at its own time) or "all" rows, per joint.
    warm_up : int
        Steps at rest after a reset (LSTM).
    joints : dict of str to JointContract
        In the order of the arrays' first axis.
    weights_sha256 : str
        Of the weights file.
    """

    schema_name: Annotated[Literal["pupper-servo-model"], Field(alias="schema")] = (
        "pupper-servo-model"
    )
    schema_version: Literal[1] = SCHEMA_VERSION
    arch: Literal["fir", "mlp", "lstm", "delayed-pd", "sindy"]
    preset: str
    created: str
    time_step_s: Annotated[float, Field(gt=0, le=1)]
    inputs: Annotated[tuple[str, ...], Field(strict=False)]
    output: str = "position_rad, one time step after the newest command"
    units: str = "radians of the simulator frame, seconds"
    feedback: bool
    warm_up: Annotated[int, Field(ge=0, le=1000)] = 0
    joints: Annotated[dict[str, JointContract], Field(min_length=1)]
    readings_counted: dict[str, str]
    split: str
    choices: dict[str, float]
    recordings: Annotated[tuple[InputRecording, ...], Field(strict=False)]
    seed: int
    versions: dict[str, str]
    notes: Annotated[tuple[str, ...], Field(strict=False)] = ()
    weights_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


@dataclass(frozen=True)
class SavedModel:
    """A model that runs, its arrays, and its contract."""

    model: Model
    contract: Contract
    parameters: dict[str, NDArray[np.floating]]
    path: Path


def input_names(parameters: dict[str, NDArray], feedback: bool) -> tuple[str, ...]:
    """Names of a model's inputs, in order: commands newest first, then a predicted position."""
    taps = parameters["fir"].shape[1] if "fir" in parameters else 1
    names = ["command_rad[t]", *(f"command_rad[t-{k}]" for k in range(1, taps))]
    return (*names, "predicted_position_rad[t]") if feedback else tuple(names)


def save_servo_model(
    folder: Path, parameters: dict[str, NDArray], contract: dict[str, Any], force: bool = False
) -> Contract:
    """Write a model.

    Parameters
    ----------
    folder : Path
        Made if missing.
    parameters : dict of str to ndarray
        The joints are the first axis, in the contract's order.
    contract : dict
        Fields of `Contract` but the weights' hash.
    force : bool
        Replace a model that is there.

    Raises
    ------
    InputError
        If there is a model already, or it cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file; a servo model is a folder. Choose another --out.")
    for name in (CONTRACT, WEIGHTS):
        refuse_overwrite(folder / name, force)
    data = save_tensors({k: np.ascontiguousarray(v) for k, v in parameters.items()})
    whole = Contract(**contract, weights_sha256=hashlib.sha256(data).hexdigest())
    build(whole, parameters)  # what cannot be read back is not written
    write_bytes(folder / WEIGHTS, data, force)
    text = json.dumps(whole.model_dump(mode="json", by_alias=True), indent=2, ensure_ascii=False)
    write_text(folder / CONTRACT, text + "\n", force)
    return whole


def load_servo_model(
    folder: Path, joints: Sequence[str] | None = None, time_step_s: float | None = None
) -> SavedModel:
    """Read a model and build it.

    Parameters
    ----------
    folder : Path
    joints : sequence of str, optional
        Joints that are needed; the model's batch is then in this order. By default all it has.
    time_step_s : float, optional
        Time between commands where it will run [s].

    Raises
    ------
    InputError
        If the folder holds no model, or one that is damaged, was changed, is for another joint or
        for another rate.
    """
    folder = Path(folder)
    contract = _read_contract(folder)
    if time_step_s is not None and abs(time_step_s / contract.time_step_s - 1) > _SAME_RATE:
        raise InputError(
            f"{folder} is a model for a command every {1e3 * contract.time_step_s:.1f} ms, but "
            f"commands come every {1e3 * time_step_s:.1f} ms. A learned model cannot change its "
            "rate: record at the new one and run `pupper-sysid fit-servo` on that, or use "
            "`--arch delayed-pd`, refitted at it."
        )
    names = list(contract.joints)
    wanted = names if joints is None else list(joints)
    missing = [j for j in wanted if j not in contract.joints]
    if missing:
        raise InputError(
            f"{folder} has no model for {', '.join(missing)}; it has {', '.join(names)}. Servos "
            "differ, so another joint's model is no substitute: fit one with `pupper-sysid "
            f"fit-servo --joints {missing[0]}`."
        )
    data = _read(folder / WEIGHTS)
    if hashlib.sha256(data).hexdigest() != contract.weights_sha256:
        raise InputError(
            f"{folder / WEIGHTS} is not the file that {CONTRACT} describes (its SHA-256 differs): "
            "it was cut short, changed or exchanged. Copy the whole folder again, or fit again."
        )
    try:
        parameters = load_tensors(data)
    except (SafetensorError, KeyError, ValueError) as error:
        raise InputError(f"{folder / WEIGHTS} is no safetensors file: {error}.") from error
    index = [names.index(j) for j in wanted]
    for name, value in parameters.items():
        if value.ndim == 0 or len(value) != len(names) or value.dtype.kind != "f":
            raise InputError(
                f"{folder / WEIGHTS}: {name} is no array of {len(names)} joints' numbers. "
                "Fit again."
            )
    chosen = {k: v[index] for k, v in parameters.items()}
    kept = contract.model_copy(update={"joints": {j: contract.joints[j] for j in wanted}})
    try:
        return SavedModel(build(kept, chosen), kept, chosen, folder)
    except (KeyError, InputError) as error:
        what = f"{error.args[0]} is missing" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{folder}: {what}") from error


def build(contract: Contract, parameters: dict[str, NDArray]) -> Model:
    """The model of a contract and its arrays."""
    joints, step = tuple(contract.joints), contract.time_step_s
    if contract.arch in ("fir", "mlp"):
        return CommandNetwork(joints, step, parameters, contract.feedback)
    if contract.arch == "lstm":
        return RecurrentNetwork(joints, step, parameters, contract.feedback, contract.warm_up)
    count = substeps(step)
    values = {k: np.asarray(v, float) for k, v in parameters.items()}
    for name, value in values.items():
        if np.isnan(value).any():
            raise InputError(f"{name} holds NaN: its fit failed or the file was damaged.")
    if contract.arch == "delayed-pd":
        offset = values.pop("offset_rad")
        return AtControlRate(DelayedPD(DelayedPDParameters(**values), step / count), count, offset)
    delay, offset = values.pop("delay_s"), values.pop("offset_rad")
    return AtControlRate(SparseEquation(values, delay, offset, step / count), count)


def _read_contract(folder: Path) -> Contract:
    path = folder / CONTRACT
    if not path.exists():
        raise InputError(
            f"{folder} holds no servo model ({CONTRACT} is missing). "
            "Make one with `pupper-sysid fit-servo --out NAME`."
        )
    try:
        found = json.loads(_read(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no JSON: {error}. Copy it again, or fit again.") from error
    if not isinstance(found, dict) or found.get("schema") != "pupper-servo-model":
        raise InputError(f"{path} is no servo model's contract. Give a folder of `fit-servo`.")
    version = found.get("schema_version")
    if isinstance(version, int) and version > SCHEMA_VERSION:
        raise InputError(
            f"{path} was written by a newer version of pupper-sysid (schema_version {version}; "
            f"this one reads {SCHEMA_VERSION}). Upgrade pupper-sysid."
        )
    try:
        contract = Contract.model_validate(found)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        place = ".".join(str(p) for p in fault["loc"])
        raise InputError(f"{path}: {place}: {fault['msg']}. Fit the model again.") from error
    unknown = [j for j in contract.joints if j not in JOINT_NAMES]
    if unknown:
        raise InputError(f"{path}: {unknown[0]} is no joint. Use {', '.join(JOINT_NAMES)}.")
    return contract


def _read(path: Path) -> bytes:
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise InputError(f"{path} has more than {_LARGEST_BYTES / 1e6:.0f} MB: no servo model.")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}. Fit the model again.") from None
