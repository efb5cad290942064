"""Reference poses of logs that store one matrix a frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import LogError
from splatbot.geometry import nearest_rotation
from splatbot.trajectory import Trajectory

_MAX_BYTES = 65_536  # of a file that holds 16 numbers
_MAX_SKEW = 0.01  # largest deviation of a matrix from the nearest rotation


def read_matrix(path: Path) -> NDArray[np.float64]:
    """Read the matrix (4, 4) of a text file, row by row; values may be NaN or infinite, also as Windows prints them.

    Raises:
        LogError: the file is missing, or does not hold 16 numbers.
    """
    try:
        with path.open("rb") as file:
            words = file.read(_MAX_BYTES).decode("utf-8-sig", errors="replace").split()
    except OSError as error:
        raise LogError(
            f"cannot be read ({error.strerror}).", file=path, field="matrix", hint="copy the log again"
        ) from error
    try:
        values = [np.nan if "#" in word else float(word) for word in words]  # 1.#QNAN, -1.#IND
    except ValueError:
        values = []
    if len(values) != 16:
        raise LogError(
            "does not hold the 16 numbers of a matrix.", file=path, field="matrix", hint="write 4 lines of 4 numbers"
        )
    return np.array(values).reshape(4, 4)


def rigid_pose(matrix: ArrayLike) -> NDArray[np.float64] | None:
    """Return the rigid transform (4, 4) of a rounded matrix (4, 4); None if it is not finite or not rigid."""
    T = np.array(matrix, dtype=np.float64)
    if not np.isfinite(T).all() or not np.allclose(T[3], [0, 0, 0, 1], atol=_MAX_SKEW):
        return None
    if not np.abs(T).max() < 1e9:
        return None
    R = nearest_rotation(T[:3, :3])
    if np.abs(R - T[:3, :3]).max() > _MAX_SKEW:
        return None
    T[:3, :3], T[3] = R, (0, 0, 0, 1)
    return T


def reference(stamps: Sequence[float], poses: Iterable[NDArray[np.float64] | None]) -> Trajectory | None:
    """Return the trajectory of the frames that have a pose T_world_camera (4, 4), or None if no frame has one."""
    known = [(stamp, T) for stamp, T in zip(stamps, poses, strict=True) if T is not None]
    return Trajectory(np.array([t for t, _ in known]), np.stack([T for _, T in known])) if known else None
