"""Joint positions of a log in TUM layout: `joints.txt`, lines `stamp q1 q2 ...` [s, rad]."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import LogError

NAME = "joints.txt"
MAX_GAP = 0.1  # [s] to the neighbouring lines beyond which joint positions are not interpolated


class JointRecord:
    """Joint positions over time with linear interpolation: ``stamps`` (N,) [s] and ``joints`` (N, J) [rad].

    Args:
        path: the file.

    Raises:
        LogError: the file cannot be read, a line is malformed or of another length, or the stamps do not increase.
    """

    def __init__(self, path: Path) -> None:
        try:
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise LogError(f"cannot be read ({error}).", file=path, hint="write lines `stamp q1 q2 ...`") from error
        rows: list[list[float]] = []
        for number, line in enumerate(lines, 1):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            try:
                row = [float(word) for word in line.split()]
            except ValueError:
                row = []
            if len(row) < 2 or not np.isfinite(row).all() or (rows and len(row) != len(rows[0])):
                problem = f"{line.strip()[:80]!r} is malformed"
                hint = "write `stamp q1 q2 ...` (seconds, radians), as many joints in every line"
                raise LogError(f"{problem}.", file=path, field=f"line {number}", hint=hint)
            if rows and row[0] <= rows[-1][0]:
                problem = f"stamp {row[0]:.6f} is not after {rows[-1][0]:.6f}"
                raise LogError(f"{problem}.", file=path, field=f"line {number}", hint="sort the lines and drop doubles")
            rows.append(row)
        if not rows:
            raise LogError("is empty.", file=path, hint="write lines `stamp q1 q2 ...`, or remove it")
        table = np.array(rows)
        self.stamps, self.joints = table[:, 0], table[:, 1:]

    def at(self, stamp: float) -> NDArray[np.float64] | None:
        """Interpolate the positions (J,) [rad] at a stamp [s]; None if a neighbouring line is more than 0.1 s away."""
        return interpolate_joints(self.stamps, self.joints, stamp)


def interpolate_joints(
    stamps: NDArray[np.float64], joints: NDArray[np.float64], stamp: float
) -> NDArray[np.float64] | None:
    """Interpolate joint positions (N, J) [rad] at stamps (N,) [s] to one stamp; see :meth:`JointRecord.at`."""
    after = int(np.searchsorted(stamps, stamp))
    neighbours = stamps[max(after - 1, 0) : after + 1]
    gaps = np.abs(neighbours - stamp)
    if gaps.min() > 0 and gaps.max() > MAX_GAP:
        return None
    return np.array([np.interp(stamp, stamps, column) for column in joints.T])


def find_joints(folder: Path) -> JointRecord | None:
    """Read `joints.txt` of a log's folder; None without the file.

    Raises:
        LogError: `joints.txt` is damaged.
    """
    return JointRecord(folder / NAME) if (folder / NAME).exists() else None
