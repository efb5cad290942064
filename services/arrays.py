"""Fields of requests that are arrays: lists in JSON, arrays in msgpack and npy, numpy for the code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import GetCoreSchemaHandler
from pydantic_core import PydanticCustomError, core_schema


class Rows:
    """Annotation of an array (N, columns), or (N, any) with ``columns`` None, of float64."""

    def __init__(self, columns: int | None) -> None:
        self.columns = columns

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        number = core_schema.float_schema()
        row = (
            core_schema.list_schema(number, fail_fast=True)
            if self.columns is None
            else core_schema.tuple_schema([number] * self.columns, fail_fast=True)
        )
        rows = core_schema.list_schema(row, fail_fast=True)  # one error, not one for each of a million rows
        return core_schema.with_info_wrap_validator_function(self._read, rows)

    def _read(self, value: Any, listed: Callable[[Any], Any], info: core_schema.ValidationInfo) -> NDArray[np.float64]:
        if isinstance(value, np.ndarray):
            if info.context is not None and value.size > info.context["values"]:
                raise PydanticCustomError("array", "has more than {most} values", {"most": info.context["values"]})
            if value.ndim != 2 or (self.columns is not None and value.shape[1] != self.columns):
                wanted = self.columns if self.columns is not None else "columns"
                context = {"got": str(value.shape), "wanted": wanted}
                raise PydanticCustomError("array", "is {got}, must be (rows, {wanted})", context)
            return value.astype(np.float64)
        rows = listed(value)
        if len({len(row) for row in rows}) > 1:
            raise PydanticCustomError("array", "has rows of different lengths")
        return np.array(rows, dtype=np.float64).reshape(len(rows), -1 if rows else self.columns or 0)


Points = Annotated[Any, Rows(3)]
Configurations = Annotated[Any, Rows(None)]
