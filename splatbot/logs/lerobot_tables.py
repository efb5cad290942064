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

_MAX_VALUES = 2**26  # that are read of one file
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
    file = open_parquet(path)
    wanted = (*integers, *numbers, *vectors)
    for names, fits in ((integers, pa.types.is_integer), (numbers, _is_number), (vectors, _is_vector)):
        for name in names:
            kind = column_type(file, path, name)
            check_type(path, name, kind, fits(kind))
    _check_size(file, path, wanted)
    try:
        table = file.read(columns=list(wanted))
        columns = {name: table.column(name).combine_chunks() for name in wanted}
    except DAMAGED as error:
        raise damaged(path, error) from error
    for name in integers:
        if columns[name].null_count:
            raise LogError("has empty cells.", file=path, field=name, hint=_AGAIN)
    found: dict[str, NDArray[Any]] = {name: np.asarray(columns[name], np.int64) for name in integers}
    found |= {name: np.asarray(columns[name], np.float64) for name in numbers}
    return found | {name: _vectors(path, name, columns[name]) for name in vectors}


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


def _check_size(file: pq.ParquetFile, path: Path, names: Sequence[str]) -> None:
    """Check the number of values before they are read: a few bytes can announce millions of equal values."""
    metadata = file.metadata
    roots = tuple(f"{name}." for name in names)
    count = 0
    for number in range(metadata.num_row_groups):
        group = metadata.row_group(number)
        columns = (group.column(index) for index in range(group.num_columns))
        count += sum(c.num_values for c in columns if f"{c.path_in_schema}.".startswith(roots))
    if count > _MAX_VALUES or metadata.num_rows > _MAX_VALUES:
        problem = f"has {max(count, metadata.num_rows)} values, more than {_MAX_VALUES}."
        raise LogError(problem, file=path, field="rows", hint="split the dataset into smaller files")


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
