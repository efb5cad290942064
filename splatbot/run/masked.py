"""A log whose frames come with the robot's own body masked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from splatbot.camera import Camera
from splatbot.frame import Frame
from splatbot.logs import Log
from splatbot.logs.base import LogBase
from splatbot.logs.calibration import Calibration
from splatbot.trajectory import Trajectory


class MaskedLog(LogBase):
    """The frames of a log, each gone through ``mask`` (see ``SelfMask``); otherwise that log.

    Args:
        log: the recording.
        mask: gives a frame with its mask narrowed.
    """

    def __init__(self, log: Log, mask: Callable[[Frame], Frame]) -> None:
        self._log, self._mask = log, mask
        self.name, self.uri = log.name, log.uri

    @property
    def camera(self) -> Camera:
        """As of the log."""
        return self._log.camera

    @property
    def ground_truth(self) -> Trajectory | None:
        """As of the log."""
        return self._log.ground_truth

    @property
    def effects(self) -> list[dict[str, Any]]:
        """As of the log."""
        return self._log.effects

    @property
    def calibration(self) -> Calibration:
        """As of the log."""
        return self._log.calibration

    def __len__(self) -> int:
        return len(self._log)

    def _decode(self, index: int) -> Frame:
        return self._mask(self._log[index])
