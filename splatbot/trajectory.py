"""A camera's path: stamps and poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError


@dataclass(frozen=True, eq=False)
class Trajectory:
    """N poses over time.

    Args:
        stamps: (N,) float64 [s], increasing.
        T_world_camera: (N, 4, 4) float64, translations in [m].

    Raises:
        InputError: shapes do not fit, a value is not finite or the stamps do not increase.
    """

    stamps: NDArray[np.float64]
    T_world_camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps, dtype=np.float64)
        poses = np.asarray(self.T_world_camera, dtype=np.float64)
        if stamps.ndim != 1 or poses.shape != (len(stamps), 4, 4):
            raise InputError(
                f"stamps are {stamps.shape}, poses are {poses.shape}.", field="trajectory", hint="give (N,), (N, 4, 4)"
            )
        for name, values in (("stamps", stamps), ("T_world_camera", poses)):
            bad = ~np.isfinite(values.reshape(len(stamps), -1)).all(axis=1) if len(stamps) else np.zeros(0, bool)
            if bad.any():
                raise InputError(f"row {int(np.argmax(bad))} is not finite.", field=name)
        late = np.diff(stamps) <= 0
        if late.any():
            row = int(np.argmax(late)) + 1
            raise InputError(
                f"row {row} ({stamps[row]:.9g} s) is not after the one before it ({stamps[row - 1]:.9g} s).",
                field="stamps",
                hint="sort the poses by time and drop doubles",
            )
        object.__setattr__(self, "stamps", stamps)
        object.__setattr__(self, "T_world_camera", poses)

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Read a TUM trajectory (see :mod:`splatbot.formats.trajectory`).

        Raises:
            FormatError: the file is missing or damaged.
        """
        from splatbot.formats.trajectory import load_trajectory

        return load_trajectory(path)

    def save(self, path: str | Path) -> None:
        """Write a TUM trajectory."""
        from splatbot.formats.trajectory import save_trajectory

        save_trajectory(self, path)

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def positions(self) -> NDArray[np.float64]:
        """Camera centres (N, 3) [m] in the world frame."""
        return self.T_world_camera[:, :3, 3]

    def select(self, index: ArrayLike) -> Trajectory:
        """Return the poses at ``index``, a mask (N,) or increasing indices."""
        rows = np.asarray(index)
        return Trajectory(self.stamps[rows], self.T_world_camera[rows])
