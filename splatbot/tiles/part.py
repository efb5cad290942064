"""Gaussians of a map with their rows, and their bytes on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.gaussians import GaussianModel

_INTEGERS = ("observations", "anchors", "misses")


@dataclass(frozen=True, eq=False)
class MapPart:
    """Some Gaussians of a map.

    Args:
        model: M Gaussians.
        rows: (M,) int32, row of each in the map. A merged Gaussian has the first row of its members.
    """

    model: GaussianModel
    rows: Tensor

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return self.model.nbytes + self.rows.numel() * self.rows.element_size()

    def select(self, index: Tensor) -> MapPart:
        """Return the Gaussians that ``index`` (a boolean mask (M,) or indices) names, copied."""
        return MapPart(self.model.select(index), self.rows[index])

    @staticmethod
    def empty(sh_degree: int) -> MapPart:
        """Return a part of no Gaussians."""
        return MapPart(GaussianModel.empty(sh_degree), torch.zeros(0, dtype=torch.int32))

    @staticmethod
    def union(parts: Sequence[MapPart]) -> MapPart:
        """Return the union of one or more parts of one map, in the order of its rows.

        Arrays are joined and sorted one after the other, so that the memory stays below two copies of the union.
        """
        rows = torch.cat([part.rows for part in parts])
        order = torch.argsort(rows, stable=True)
        names = [field.name for field in fields(GaussianModel)]
        columns = {name: torch.cat([getattr(part.model, name) for part in parts])[order] for name in names}
        return MapPart(GaussianModel(**columns), rows[order])


def bytes_each(sh_terms: int) -> int:
    """Return the bytes of a Gaussian with ``sh_terms`` coefficients of harmonics a channel."""
    return sum(kind.itemsize * int(np.prod(shape)) for _, kind, shape in _columns(sh_terms))


def encode(part: MapPart) -> bytes:
    """Return the arrays of a part, one after the other, little-endian float32 and int32."""
    arrays = [getattr(part.model, field.name).detach().numpy() for field in fields(GaussianModel)]
    kinds = [kind for _, kind, _ in _columns(part.model.sh.shape[1])]
    return b"".join(a.astype(kind).tobytes() for a, kind in zip([*arrays, part.rows.numpy()], kinds, strict=True))


def decode(data: bytearray, sh_terms: int) -> MapPart:
    """Return the part of bytes of :func:`encode`; its tensors share their memory."""
    count, start, arrays = len(data) // bytes_each(sh_terms), 0, {}
    for name, kind, shape in _columns(sh_terms):
        size = count * int(np.prod(shape))
        values: NDArray[np.generic] = np.frombuffer(data, kind, size, start).reshape(count, *shape)
        arrays[name] = torch.from_numpy(values)
        start += size * kind.itemsize
    rows = arrays.pop("rows")
    return MapPart(GaussianModel(**arrays), rows)


def _columns(sh_terms: int) -> list[tuple[str, np.dtype[np.generic], tuple[int, ...]]]:
    """Return name, type and shape of the values of a Gaussian."""
    shapes: dict[str, tuple[int, ...]] = {"means": (3,), "quats": (4,), "log_scales": (3,), "sh": (sh_terms, 3)}
    names = [field.name for field in fields(GaussianModel)]
    columns = [(name, np.dtype("<i4" if name in _INTEGERS else "<f4"), shapes.get(name, ())) for name in names]
    return [*columns, ("rows", np.dtype("<i4"), ())]
