"""TUM trajectories: one line `stamp tx ty tz qx qy qz qw` per pose.

Quaternions are converted between xyzw (file) and wxyz (memory) only here.


https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError
from splatbot.geometry import pose_from_quat, rotation_to_quat
from splatbot.trajectory import Trajectory

_LAYOUT = "`stamp tx ty tz qx qy qz qw`"


def load_trajectory(path: str | Path, *, unordered: bool = False) -> Trajectory:
    """Read a TUM trajectory; ``#`` starts a comment, quaternions are normalised. Commas may separate the values.

    Args:
        path: the file.
        unordered: sort the poses by time, and keep the first of equal stamps.

    Raises:
        FormatError: the file is missing or has no poses, a line is malformed, or the stamps do not increase.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise FormatError(f"cannot be read ({error.strerror}).", file=path, hint="check the path") from error
    numbered = [(i, line) for i, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]
    if not numbered:
        raise FormatError("has no poses.", file=path, field="trajectory", hint=f"write one line {_LAYOUT} a pose")
    rows = np.array([_parse(path, number, line) for number, line in numbered])
    if unordered:
        rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    late = np.diff(rows[:, 0]) <= 0
    if late.any():
        raise FormatError(
            "the stamp is not after the one before it.",
            file=path,
            field=f"line {numbered[int(np.argmax(late)) + 1][0]}",
            hint="sort the lines by time and drop doubles",
        )
    return Trajectory(rows[:, 0], pose_from_quat(rows[:, 1:4], rows[:, [7, 4, 5, 6]]))


def _parse(path: str | Path, number: int, line: str) -> list[float]:
    try:
        row = [float(word) for word in line.replace(",", " ").split()]
    except ValueError:
        row = []
    if len(row) != 8 or not np.isfinite(row).all() or not np.any(row[4:]):
        raise FormatError(
            f"{line.strip()[:80]!r} is not a pose.",
            file=path,
            field=f"line {number}",
            hint=f"write {_LAYOUT} with finite values and a nonzero quaternion, or remove the line",
        )
    return row


def save_trajectory(trajectory: Trajectory, path: str | Path, *, pose_name: str = "T_world_camera") -> None:
    """Write a TUM trajectory: exact stamps, other values with 12 digits; an empty one has only the heading.

    ``pose_name`` names the poses in the heading.
    """
    quats = rotation_to_quat(trajectory.T_world_camera[:, :3, :3])
    values = np.hstack([trajectory.positions, quats[:, [1, 2, 3, 0]]])
    with atomic_write(path) as file:
        file.write(f"# timestamp tx ty tz qx qy qz qw ({pose_name})\n".encode())
        for stamp, row in zip(trajectory.stamps, values, strict=True):
            file.write(f"{float(stamp)!r} {' '.join(f'{v:.12g}' for v in row)}\n".encode())
