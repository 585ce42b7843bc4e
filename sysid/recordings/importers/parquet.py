"""Parquet files within budgets: columns of numbers, or of lists with one number per joint.

A file alone (pandas, polars, one file of a LeRobot dataset) is read as a table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import (
    LONGEST_CELL,
    MOST_CELLS,
    MOST_COLUMNS,
    MOST_ROWS,
    distinct,
)
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.columns import has_time
from pupper_sysid.sysid.recordings.importers.log import (
    LARGEST_BYTES,
    MOST_JOINTS,
    Log,
    expanded,
)
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from pupper_sysid.sysid.recordings.importers.tables import LABELS, read_table

LAYOUT = "parquet table"
MAGIC = b"PAR1"
_INDEX = "__index_level_0__"  # of pandas, without a name


def read_parquet(path: Path, data: bytes, options: LogOptions) -> Log:
    """A file's columns of numbers as rows."""
    pa, file = _open(path, data)
    numeric = [field.name for field in file.schema_arrow if _of_numbers(pa, field.type)]
    arrays = read_columns(path, data, numeric)
    if _INDEX in arrays and not has_time(list(arrays)):
        arrays["time"] = arrays.pop(_INDEX)
    table = replace(expanded(path, arrays, list(options.joints)), texts=_texts(path, data))
    return read_table(path, table, options, LAYOUT)


def _of_numbers(pa: Any, kind: Any) -> bool:
    """Whether a column of this type is of numbers, or of lists of numbers."""
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    tests = pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean, pa.types.is_timestamp
    return any(test(kind) for test in tests)


def read_columns(path: Path, data: bytes, names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Columns of numbers, shape (rows,), or of equally long lists, shape (rows, length)."""
    pa, file = _open(path, data)
    known = file.schema_arrow.names
    lacking = [name for name in names if name not in known]
    if lacking:
        raise InputError(
            f"{path}: column {', '.join(lacking)} is missing; it has {', '.join(known)[:300]}."
        )
    meta = file.metadata
    try:
        groups = [*map(meta.row_group, range(meta.num_row_groups))]
        for g, group in enumerate(groups):
            if group.total_byte_size <= LARGEST_BYTES:
                # a row: damage that raises there ends the process in `column`
                next(file.iter_batches(1, [g], list(names), use_threads=False), None)
        wanted = [c for c in range(meta.num_columns)
                  if file.schema.column(c).path.split(".list.")[0] in names]  # fmt: skip
        chunks = [group.column(c) for group in groups for c in wanted]
        values = sum(c.num_values for c in chunks)
        unpacked = sum(c.total_uncompressed_size for c in chunks)
        refuse_more(path, values, MOST_CELLS, "values", "Split the log.")
        refuse_more(f"{path}, unpacked,", unpacked, LARGEST_BYTES, "bytes", "Split the log.")
        table = file.read(columns=list(names), use_threads=False)
        return {name: _array(path, pa, name, table.column(name)) for name in names}
    except (pa.ArrowException, OSError, ValueError, OverflowError) as error:
        raise _damaged(path, error) from error


def _texts(path: Path, data: bytes) -> dict[str, list[str]]:
    """Columns of text that name joints: each text once, however often a row has it."""
    pa, file = _open(path, data)

    def textual(kind: Any) -> bool:
        kind = kind.value_type if pa.types.is_dictionary(kind) else kind
        return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))

    names = [f.name for f in file.schema_arrow if f.name.lower() in LABELS and textual(f.type)]
    if not names:
        return {}
    refuse_more(path, file.metadata.num_rows, MOST_ROWS, "rows", "Split the log.")
    columns: dict[str, list[str]] = {}
    try:
        table = _open(path, data, names)[1].read(columns=names, use_threads=False)
        for name in names:
            columns[name] = []
            for chunk in table.column(name).chunks:
                refuse_more(f"{path}, column {name}", len(chunk.dictionary), MOST_JOINTS, "joints")
                texts = [*(str(t)[:LONGEST_CELL] for t in chunk.dictionary.to_pylist()), "None"]
                codes = chunk.indices.fill_null(len(texts) - 1).to_numpy()
                columns[name] += [texts[k] for k in codes.tolist()]
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _damaged(path, error) from error
    return columns


def _open(path: Path, data: bytes, texts: Sequence[str] = ()) -> tuple[Any, Any]:
    """pyarrow, and the file; columns named `texts` come as dictionaries."""
    try:
        import pyarrow.parquet
    except ImportError:
        raise InputError(
            f"{path} is a parquet file; reading it needs pyarrow. Install pupper-sysid[logs]."
        ) from None
    pa: Any = pyarrow
    try:
        file = pa.parquet.ParquetFile(pa.BufferReader(data), read_dictionary=list(texts) or None)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _damaged(path, error) from error
    refuse_more(path, len(file.schema_arrow), MOST_COLUMNS, "columns", "Split the log.")
    distinct(path, file.schema_arrow.names)
    return pa, file


def _array(path: Path, pa: Any, name: str, column: Any) -> NDArray[np.float64]:
    """Numbers of a column; an empty cell is NaN."""
    kind = column.type
    if pa.types.is_timestamp(kind):  # seconds from the first, as exact as they are
        ticks = column.cast("int64").to_pandas().to_numpy(float)
        return (ticks - ticks[:1]) / {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}[kind.unit]
    if not (pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind)):
        return np.asarray(column.to_pandas().to_numpy(), float)
    flat = np.asarray(column.combine_chunks().flatten().to_pandas().to_numpy(), float)
    rows = len(column)
    width = len(flat) // rows if rows else 0
    from pyarrow import compute as loaded

    compute: Any = loaded  # its functions are made when it is imported
    if rows and {*compute.unique(compute.list_value_length(column)).to_pylist()} != {width}:
        raise InputError(f"{path}, column {name}: its lists are not equally long. Mend the log.")
    return flat.reshape(rows, width)


def _damaged(path: Path, error: Exception) -> InputError:
    text = printable(str(error).splitlines()[0][:200]) if str(error) else type(error).__name__
    return InputError(
        f"{path} is not a parquet file, or is cut off: {text.strip().rstrip('.')}. Fetch it again."
    )
