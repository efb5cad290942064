"""Checks of the inputs of a collision field, with errors that name the row."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from splatbot.errors import InputError

MAX_RADIUS = 1e4  # [m]
MAX_COORDINATE = 1e9  # [m or rad]; squares of larger values, in units of a small Gaussian, overflow in float32


def as_float64(values: ArrayLike | Tensor) -> NDArray[np.float64]:
    """Convert a numpy array or a tensor to a float64 array, without a copy if possible."""
    return np.asarray(values.detach() if isinstance(values, Tensor) else values, dtype=np.float64)


def rows(values: ArrayLike | Tensor, name: str, width: int, meaning: str) -> NDArray[np.float64]:
    """Return ``values`` as finite C-contiguous float64 (P, width).

    Raises:
        InputError: the shape is wrong, or a value is not finite or beyond 1e9; the message names the row.
    """
    array = as_float64(values)
    if array.ndim != 2 or array.shape[1] != width:
        raise InputError(f"is {array.shape}.", field=name, hint=f"give (P, {width}) {meaning}")
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        raise InputError(f"row {int(np.argmax(bad))} is not finite.", field=name, hint=f"give finite {meaning}")
    far = (np.abs(array) > MAX_COORDINATE).any(axis=1)
    if far.any():
        raise InputError(f"row {int(np.argmax(far))} is beyond {MAX_COORDINATE:g}.", field=name, hint=f"give {meaning}")
    return np.ascontiguousarray(array)


def spheres(values: ArrayLike | Tensor) -> tuple[NDArray[np.float64], NDArray[np.float32] | None]:
    """Split points (P, 3) or spheres (P, 4) = (x, y, z, radius) [m] into centres (P, 3) and radii (P,).

    Points have no radii (None). Radii are rounded up to float32.

    Raises:
        InputError: the shape is wrong, a value is not finite, or a radius is not in 0..10 km.
    """
    array = as_float64(values)
    if array.ndim != 2 or array.shape[1] not in (3, 4):
        raise InputError(
            f"is {array.shape}.",
            field="points",
            hint="give (P, 3) world coordinates in metres, or (P, 4) with a radius each",
        )
    array = rows(array, "points", array.shape[1], "world coordinates in metres")
    if array.shape[1] == 3:
        return array, None
    return np.ascontiguousarray(array[:, :3]), radii(array[:, 3])


def radii(values: NDArray[np.float64]) -> NDArray[np.float32]:
    """Round radii (P,) [m] up to float32.

    Raises:
        InputError: a radius is below 0 or above 10 km.
    """
    bad = ~((values >= 0.0) & (values <= MAX_RADIUS))
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"row {row} is {values[row]}.", field="radius", hint=f"give 0..{MAX_RADIUS:g} m")
    rounded = values.astype(np.float32)
    return np.where(rounded < values, np.nextafter(rounded, np.float32(np.inf)), rounded)
