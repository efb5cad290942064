"""A controller whose arm replays recorded joint positions, independent of the trajectory."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatbot.errors import LogError
from splatbot.protocols import Array
from splatbot.robots.controllers.base import CONSTANTS as CONTROLLER
from splatbot.robots.controllers.base import SteppedController


@dataclass(frozen=True, eq=False)
class JointRecording:
    """Joint positions over time.

    Args:
        stamps: (N,) [s], increasing.
        positions: (N, J) [rad or m].
        source: origin of the recording, for messages.

    Raises:
        LogError: fewer than two samples, stamps that do not increase, or a value that is not finite.
    """

    stamps: Array
    positions: Array
    source: str = "recording"

    def __post_init__(self) -> None:
        good = self.positions.ndim == 2 and len(self.stamps) == len(self.positions) >= 2
        if not good or not (np.isfinite(self.stamps).all() and np.isfinite(self.positions).all()):
            hint = "give two or more rows of finite numbers"
            raise LogError("is no recording of joints.", file=self.source, field="positions", hint=hint)
        if not (np.diff(self.stamps) > 0).all():
            row = int(np.argmin(np.diff(self.stamps) > 0)) + 1
            raise LogError(f"row {row} is not after the one before.", file=self.source, field="time")

    @classmethod
    def load(cls, path: str | Path) -> JointRecording:
        """Load CSV in the format of ``Trajectory.to_csv``: columns ``time`` [s] and ``position.NAME`` of each joint.

        Raises:
            LogError: a column is missing, or a value is no number.
        """
        with Path(path).open(newline="") as file:
            rows = list(csv.reader(file))
        header = rows[0] if rows else []
        columns = [i for i, name in enumerate(header) if name.startswith("position.")]
        if "time" not in header or not columns:
            hint = "give a column time and one position.NAME for each joint"
            raise LogError("lacks columns.", file=path, field="header", hint=hint)
        try:
            table = np.array([[float(row[i]) for i in (header.index("time"), *columns)] for row in rows[1:]])
        except (ValueError, IndexError) as error:
            raise LogError(f"holds a value that is no number ({error}).", file=path, field="rows") from error
        if table.ndim != 2:
            raise LogError("is empty.", file=path, field="rows")
        return cls(table[:, 0] - table[0, 0], table[:, 1:], str(path))

    def at(self, t: float) -> Array:
        """Interpolate the positions (J,) at a time [s] since the start; after the end the last one holds."""
        return np.array([np.interp(t, self.stamps, column) for column in self.positions.T])


class RecordedController(SteppedController):
    """Replays the recorded motion of an arm with its errors, delays and stops.

    Args:
        recording: motion that begins when a trajectory is sent.
        period: control period [s].
        following: see :class:`SteppedController`.
    """

    def __init__(
        self, recording: JointRecording, *, period: float = 1e-3, following: float = CONTROLLER.max_tracking_error
    ) -> None:
        super().__init__(recording.positions[0], period=period, following=following)
        self._recording = recording

    def _moved(self, t: float, desired: Array, velocity: Array) -> Array:
        return self._recording.at(t)
