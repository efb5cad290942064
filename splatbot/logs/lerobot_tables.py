"""Parquet files of LeRobot datasets: columns of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from splatbot.errors import LogError

_MAX_BYTES = 2**29  # of the numbers that are read of one file
_ROWS = 4096  # that are read at once
_BUFFER = 2**20  # [bytes] of a file that is read in pieces
DAMAGED = (pa.ArrowException, OSError, ValueError, KeyError, NotImplementedError)
_AGAIN = "copy or download the dataset again"


def read_columns(
    path: Path, *, integers: Sequence[str] = (), numbers: Sequence[str] = (), vectors: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Read columns of a file: integers (N,) int64, numbers (N,) float64 and vectors (N, K) float64.

    Raises:
        LogError: the file is missing or damaged, a column is missing or of another type, or there are too many values.
    """
    wanted = (*integers, *numbers, *vectors)
    file = open_parquet(path)
    try:
        for names, fits in ((integers, pa.types.is_integer), (numbers, _is_number), (vectors, _is_vector)):
            for name in names:
                kind = column_type(file, path, name)
                check_type(path, name, kind, fits(kind))
        table = pa.Table.from_batches(_batches(file, path, wanted))
        columns = {name: table.column(name).combine_chunks() for name in wanted}
    except DAMAGED as error:
        raise damaged(path, error) from error
    for name in integers:
        if columns[name].null_count:
            raise LogError("has empty cells.", file=path, field=name, hint=_AGAIN)
    found: dict[str, NDArray[Any]] = {name: np.asarray(columns[name], np.int64) for name in integers}
    found |= {name: np.asarray(columns[name], np.float64) for name in numbers}
    return found | {name: _vectors(path, name, columns[name]) for name in vectors}


def _batches(file: pq.ParquetFile, path: Path, names: Sequence[str]) -> list[pa.RecordBatch]:
    """Read columns while they are small: a few bytes of a file can hold millions of equal values.

    Sizes that the file announces for its columns are not used: pyarrow ends the process if they are damaged.
    """
    found: list[pa.RecordBatch] = []
    size = 0
    for batch in file.iter_batches(_ROWS, columns=list(names)):
        found.append(batch)
        size += batch.nbytes
        if size > _MAX_BYTES:
            problem = f"has over {_MAX_BYTES} bytes of numbers."
            raise LogError(problem, file=path, field="rows", hint="split the dataset into smaller files")
    if not found:
        raise LogError("has no rows.", file=path, field="rows", hint=_AGAIN)
    return found


def open_parquet(path: Path) -> pq.ParquetFile:
    """Open a file; its content is read in pieces.

    Raises:
        LogError: it is missing, or its description is damaged.
    """
    try:
        return pq.ParquetFile(path, buffer_size=_BUFFER)
    except DAMAGED as error:
        raise damaged(path, error) from error


def column_type(file: pq.ParquetFile, path: Path, name: str) -> pa.DataType:
    """Return the type of a column.

    Raises:
        LogError: there is no such column.
    """
    index = file.schema_arrow.get_field_index(name)
    if index < 0:
        raise LogError("has no such column.", file=path, field=name, hint=_AGAIN)
    return file.schema_arrow.field(index).type


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind)


def _is_vector(kind: pa.DataType) -> bool:
    is_list = pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind)
    return _is_number(kind) or (is_list and _is_number(kind.value_type))


def check_type(path: Path, name: str, kind: pa.DataType, fits: bool) -> None:
    """Raise an error about the type of a column unless it ``fits``.

    Raises:
        LogError: it does not.
    """
    if not fits:
        raise LogError(f"is of type {kind}.", file=path, field=name, hint=_AGAIN)


def _vectors(path: Path, name: str, column: Any) -> NDArray[np.float64]:
    """Return a column of lists of one length as (N, K); numbers are lists of one."""
    if _is_number(column.type):
        return np.asarray(column, np.float64)[:, None]
    lengths = np.unique(np.asarray(pc.list_value_length(column), np.float64))
    if len(lengths) != 1 or not lengths[0] > 0:
        raise LogError("has rows of different lengths.", file=path, field=name, hint=_AGAIN)
    return np.asarray(column.flatten(), np.float64).reshape(len(column), -1)


def damaged(path: Path, error: Exception) -> LogError:
    """Return the error of a file that the package of parquet cannot read."""
    problem = "does not exist." if isinstance(error, FileNotFoundError) else f"is no whole parquet file ({error})."
    return LogError(problem, file=path, field="file", hint=_AGAIN)
