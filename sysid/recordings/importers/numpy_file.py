"""NumPy archives (`.npz`): arrays by name, of shape (rows,) or (rows, joints).

    np.savez("log.npz", time=t, command=commands, position=positions, joint_names=["knee", "ankle"])

Objects (pickles) are never loaded.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.budget import refuse_more
from pupper_sysid.common.reading.csv_table import MOST_COLUMNS
from pupper_sysid.common.reading.names import distinct
from pupper_sysid.sysid.recordings.importers.shared.log import LARGEST_BYTES, MOST_JOINTS, Log
from pupper_sysid.sysid.recordings.importers.shared.options import LogOptions
from pupper_sysid.sysid.recordings.importers.wide import expanded, read_table

LAYOUT = "NumPy archive"
MAGIC = b"PK\x03\x04"

_NAMES = ("joint_names", "joints", "names", "motor_names")


def read_npz(path: Path, data: bytes, options: LogOptions) -> Log:
    """The archive's arrays as rows.

    Raises
    ------
    InputError
        If it is no archive, unpacks to too much, holds objects, or lacks columns.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            inside = archive.infolist()
        size = sum(member.file_size for member in inside)
        refuse_more(f"{path}, unpacked,", len(inside), MOST_COLUMNS, "arrays", "Split it.")
        refuse_more(f"{path}, unpacked,", size, LARGEST_BYTES, "bytes", "Split it.")
        with np.load(io.BytesIO(data), allow_pickle=False) as loaded:
            distinct(path, loaded.files, "arrays")
            found = {name: loaded[name] for name in loaded.files}
            arrays = {k: v for k, v in found.items() if isinstance(v, np.ndarray)}
    except InputError:
        raise
    except Exception as error:  # a damaged archive raises whatever zlib, zipfile and NumPy do
        pickled = "pickle" in str(error)
        raise InputError(
            f"{path} holds Python objects, which are never loaded. Save arrays of numbers."
            if pickled
            else f"{path} is no NumPy archive, or is damaged. Save it again with numpy.savez."
        ) from error
    named = next((k for k in _NAMES if k in arrays and arrays[k].dtype.kind in "US"), None)
    names = list(options.joints)
    if named is not None:
        refuse_more(f"{path}, array {named}", arrays[named].size, MOST_JOINTS, "joints")
        names = [str(n) for n in arrays[named].ravel().astype(str)]
    numeric = {
        k: v.astype(float) for k, v in arrays.items() if v.dtype.kind in "biuf" and v.ndim in (1, 2)
    }
    return read_table(path, expanded(path, numeric, names, named), options, LAYOUT)
