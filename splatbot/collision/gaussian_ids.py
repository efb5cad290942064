"""Persistent identifiers of Gaussians, which stay equal from field to field while their rows in the model change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from splatbot.errors import InputError


@dataclass(frozen=True, eq=False)
class GaussianIdMap:
    """Bijection between the rows of a model and the identifiers ("names") of its Gaussians.

    As long as rows keep their places, the identifier is the row, and no table exists.

    Args:
        count: number of rows of the model.
        by_row: (count,) int32, identifier of each row. If None, it equals the row.
        by_name: int32, row of each identifier, -1 for a removed Gaussian. If None, it equals the identifier.
    """

    count: int
    by_row: NDArray[np.int32] | None = None
    by_name: NDArray[np.int32] | None = None

    @property
    def nbytes(self) -> int:
        """Memory of the tables [bytes]."""
        return sum(table.nbytes for table in (self.by_row, self.by_name) if table is not None)

    def of(self, rows: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the identifiers (R,) of rows (R,)."""
        return rows.astype(np.int32) if self.by_row is None else self.by_row[rows]

    def rows(self, names: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the rows of identifiers; -1 stays -1."""
        if self.by_name is None:
            return names.astype(np.int64)
        if not len(self.by_name):
            return np.full(names.shape, -1, dtype=np.int64)
        return np.where(names >= 0, self.by_name[names], -1).astype(np.int64)

    def carried(
        self, count: int, previous: ArrayLike | Tensor | None
    ) -> tuple[GaussianIdMap, NDArray[np.int64], NDArray[np.int32]]:
        """Update the identifiers to a later model.

        Args:
            count: number of rows of the later model.
            previous: (count,) row of each Gaussian in this model, -1 for a new one. If None, rows keep their places,
                and further rows are new.

        Returns:
            The identifiers of the later model, its new rows, and the identifiers of removed Gaussians.

        Raises:
            InputError: ``previous`` has a wrong length, or contains a row twice or a row that does not exist.
        """
        if previous is None and self.by_row is None:
            new = np.arange(min(count, self.count), count)
            return GaussianIdMap(count), new, np.arange(count, max(self.count, count), dtype=np.int32)
        before = np.arange(count) if previous is None else self._checked(count, previous)
        before = np.where(before < self.count, before, -1)
        known, fresh = before >= 0, np.flatnonzero(before < 0)
        owned = self.of(np.arange(self.count))
        names = np.empty(count, np.int32)
        names[known] = owned[before[known]]
        taken = int(self.count if self.by_name is None else len(self.by_name))
        names[fresh] = taken + np.arange(len(fresh), dtype=np.int32)
        table = np.full(taken + len(fresh), -1, np.int32)
        table[names] = np.arange(count, dtype=np.int32)
        return GaussianIdMap(count, names, table), fresh, owned[table[owned] < 0]

    def _checked(self, count: int, previous: ArrayLike | Tensor) -> NDArray[np.int64]:
        before = np.asarray(previous).astype(np.int64)
        if before.shape != (count,) or (count and (before.min() < -1 or before.max() >= self.count)):
            hint = f"give ({count},) rows in -1..{self.count - 1}"
            raise InputError("names a row that was not there.", field="previous", hint=hint)
        if count and np.bincount(before[before >= 0], minlength=1).max() > 1:
            raise InputError(
                "names a row twice.", field="previous", hint="give each row of the earlier map at most once"
            )
        return before
