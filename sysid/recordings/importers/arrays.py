"""Arrays by name, of shape (rows,) or (rows, joints): NumPy's, torch's `.pt` and MATLAB's `.mat`.

    np.savez("log.npz", time=t, command=commands, position=positions, joint_names=["knee", "ankle"])
    torch.save({"time": t, "dof_pos": positions, "des_dof_pos": commands}, "run.pt")     # PACE
    save("run.mat", "t", "cmd", "pos", "-v7")

An array of a `.npy` file has columns without names. Objects (pickles) are never loaded.
"""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_bomb, refuse_more
from pupper_sysid.common.reading.csv_table import MOST_CELLS, MOST_COLUMNS, distinct
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.columns import has_time, time_columns
from pupper_sysid.sysid.recordings.importers.log import (
    LARGEST_BYTES,
    MOST_JOINTS,
    Log,
    Table,
    expanded,
)
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from pupper_sysid.sysid.recordings.importers.refusals import missing
from pupper_sysid.sysid.recordings.importers.tables import read_numbered, read_table
from pupper_sysid.sysid.recordings.importers.times import drive_in, stated_rate, units_in

ZIP, NPY, MAT = b"PK\x03\x04", b"\x93NUMPY", b"MATLAB 5.0"

_NAMES = ("joint_names", "joints", "names", "motor_names", "dof_names")
_DEEPEST = 3  # of dictionaries in a torch file


def read_arrays(path: Path, data: bytes, options: LogOptions) -> Log:
    """The arrays of a file as rows."""
    if data.startswith(NPY):
        values, layout = _loaded(path, data), "NumPy array"
        if values.dtype.kind in "biuf" and values.ndim == 2:
            return read_numbered(path, values, options, layout)
        arrays = {name: values[name].ravel() for name in values.dtype.names or ()}
        if not arrays:
            raise InputError(
                f"{path} holds an array of shape {values.shape}; a log has a row per time and a "
                "column per quantity. Save time, command and position with numpy.savez."
            )
    elif data.startswith(MAT):
        arrays, layout = _mat_arrays(path, data), "MATLAB file"
    else:
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                inside = archive.infolist()
        except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError) as error:
            raise InputError(_damaged(path)) from error
        if any(member.filename.endswith("/data.pkl") for member in inside):
            arrays, layout = _torch_arrays(path, data), "torch file"
        else:
            size = sum(member.file_size for member in inside)
            refuse_more(f"{path}, unpacked,", len(inside), MOST_COLUMNS, "arrays", "Split it.")
            refuse_more(f"{path}, unpacked,", size, LARGEST_BYTES, "bytes", "Split it.")
            arrays, layout = _loaded(path, data), "NumPy archive"
    named = next((k for k in _NAMES if k in arrays and arrays[k].dtype.kind in "US"), None)
    names = list(options.joints)
    if named is not None:
        refuse_more(f"{path}, array {named}", arrays[named].size, MOST_JOINTS, "joints")
        names = [str(n) for n in arrays[named].ravel().astype(str)]
    numeric = {k: v.astype(float) for k, v in arrays.items() if v.dtype.kind in "biuf" and v.ndim}
    for key, values in numeric.items():
        if values.ndim > 1 and values.size == max(values.shape) and "time" in key.lower():
            numeric[key] = values.ravel()
    rows = next((len(v) for k, v in numeric.items() if v.ndim == 1 and time_columns([k])), 0)
    for key, values in numeric.items():
        if values.ndim == 3 and 1 in values.shape[:2]:  # of one robot of many
            values = values[0] if len(values) == 1 else values[:, 0]
        if values.ndim == 2 and values.shape[1] == rows != len(values):
            values = values.T
        numeric[key] = values
    several = next((k for k, v in numeric.items() if v.ndim == 3), None)
    numeric = {k: v for k, v in numeric.items() if v.ndim < 3}
    table = _with_names(path, numeric, arrays) or expanded(path, numeric, names, named)
    if several is not None and missing(table.names):
        shape = " × ".join(map(str, arrays[several].shape))
        raise InputError(
            f"{path}: {several} has {shape} values, of several robots. Save those of one, such as "
            f"{several}[:, 0]."
        )
    if len(numeric) == 1 and missing(table.names):  # Simulink's rows
        (values,) = numeric.values()
        wide = values.ndim == 2 and len(values) < values.shape[1]
        return read_numbered(path, np.atleast_2d(values.T if wide else values), options, layout)
    scalars = {k: float(v) for k, v in arrays.items() if v.dtype.kind in "iuf" and not v.ndim}
    remarks = "\n".join(
        f"{k}: {v}" for k, v in arrays.items() if v.dtype.kind == "U" and v.size == 1
    )
    table = replace(
        table, rate=stated_rate(scalars), units=units_in(remarks[:4000], table.names),
        drive=drive_in(remarks[:4000]),
    )  # fmt: skip
    return read_table(path, table, options, layout)


def _with_names(
    path: Path, numeric: Mapping[str, NDArray[np.float64]], arrays: Mapping[str, NDArray[Any]]
) -> Table | None:
    """The columns of one array that another array names, time included; None without them."""
    for key, values in numeric.items():
        for names in arrays.values():
            if values.ndim == 2 and names.dtype.kind in "US" and names.size == values.shape[1]:
                listed = [str(n) for n in names.ravel()]
                if has_time(listed):
                    distinct(f"{path}, the names of {key}", listed)
                    return Table(dict(zip(listed, values.T, strict=True)))
    return None


def _loaded(path: Path, data: bytes) -> Any:
    """What NumPy loads: an array, or the arrays of an archive by name."""
    try:
        content = np.load(io.BytesIO(data), allow_pickle=False)
        if isinstance(content, np.ndarray):
            return content
        with content:
            distinct(path, content.files, "arrays")
            arrays = {name: content[name] for name in content.files}
            return {name: a for name, a in arrays.items() if isinstance(a, np.ndarray)}
    except InputError:
        raise
    except Exception as error:  # damaged ones raise whatever zlib, zipfile and NumPy do
        objects = f"{path} holds Python objects, which are never loaded. Save arrays of numbers."
        raise InputError(objects if "pickle" in str(error) else _damaged(path)) from error


_MAT_HEADER, _MAT_COMPRESSED, _PIECE = 128, 15, 1 << 20  # of MATLAB 5 MAT-files


_LOAD_MAT = """
import io, sys
import numpy
from scipy.io import loadmat

def flat(name, value, depth):
    if isinstance(value, dict) and depth:
        for key, inside in value.items():
            yield from flat(f"{name}.{key}"[:200], inside, depth - 1)
    elif numpy.asarray(value).dtype.kind in "biufUS":
        yield name, numpy.asarray(value)

loaded = loadmat(io.BytesIO(sys.stdin.buffer.read()), simplify_cells=True)
named = {f"/{name}": value for name, value in loaded.items() if name[:2] != "__"}
out = io.BytesIO()
numpy.savez(out, **dict(pair for name in named for pair in flat(name, named[name], 4)))
sys.stdout.buffer.write(out.getvalue())
"""
"""Program that writes the arrays of a MATLAB 5 file as those of an archive, `/name` for `name`."""


def _mat_arrays(path: Path, data: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of a MATLAB 5 file, those in structures as `structure.field`."""
    order, at, total = ">" if data[126:128] == b"MI" else "<", _MAT_HEADER, 0
    damaged = (
        f"{path} is a damaged MATLAB file. Save it again with save(name, '-v7'), or writematrix."
    )
    try:
        while at + 8 <= len(data):
            kind, size = struct.unpack_from(f"{order}II", data, at)
            rest, unpacker = data[at + 8 : at + 8 + size], zlib.decompressobj()
            while kind == _MAT_COMPRESSED and rest and not unpacker.eof:
                total += len(unpacker.decompress(rest, _PIECE))
                rest = unpacker.unconsumed_tail
                refuse_more(f"{path}, unpacked,", total, LARGEST_BYTES, "bytes", exact=False)
            at += 8 + size
    except zlib.error as error:
        raise InputError(damaged) from error
    # damage can end the process that reads it
    program = [sys.executable, "-I", "-c", _LOAD_MAT]
    reader = subprocess.run(program, input=data, capture_output=True)
    if reader.returncode:
        raise InputError(damaged)
    arrays = _loaded(path, reader.stdout)
    return {name.removeprefix("/"): values for name, values in arrays.items()}


def _flat(path: Path, loaded: Mapping[Any, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the values in dictionaries as `name.key`."""
    count, pending = 0, [(str(name)[:200], value, 0) for name, value in loaded.items()]
    while pending:
        refuse_more(path, count + len(pending), MOST_COLUMNS, "arrays", exact=False)
        name, value, depth = pending.pop(0)
        if isinstance(value, Mapping) and depth < _DEEPEST:
            pending += [(f"{name}.{key}"[:200], inside, depth + 1) for key, inside in value.items()]
        else:
            count += 1
            yield name, value


def _damaged(path: Path) -> str:
    return f"{path} is no NumPy archive, or is damaged. Save it again with numpy.savez."


def _torch_arrays(path: Path, data: bytes) -> dict[str, NDArray[Any]]:
    """The tensors of a torch file, and lists of names, by name."""
    remedy = "Save a dictionary of tensors."
    refuse_bomb(path, data, remedy)
    import torch

    try:
        loaded = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # damaged ones raise whatever pickle and torch do
        first = printable(str(error).strip().split("\n")[0])[:120]
        raise InputError(
            f"{path} is no torch file of tensors alone, or is damaged ({first}). {remedy}"
        ) from error
    if not isinstance(loaded, Mapping):
        raise InputError(f"{path} holds no tensors by name. {remedy}")
    arrays: dict[str, NDArray[Any]] = {}
    for name, value in _flat(path, loaded):
        if isinstance(value, torch.Tensor):
            if value.layout == torch.strided and not value.is_complex():
                refuse_more(f"{path}, {name}", value.numel(), MOST_CELLS, "values", remedy)
                arrays[name] = value.detach().to(torch.float64).numpy()
        elif isinstance(value, int | float):
            arrays[name] = np.array(float(value))
        elif isinstance(value, list | tuple) and 0 < len(value) <= MOST_CELLS:
            if all(isinstance(v, str) for v in value[:MOST_JOINTS]):
                arrays[name] = np.array([str(v)[:200] for v in value[: MOST_JOINTS + 1]])
            elif all(isinstance(v, int | float) for v in value):
                arrays[name] = np.array(value, float)
    return arrays
