"""A log whose frames come with the robot's own body masked."""

from __future__ import annotations

from collections.abc import Callable

from splatbot.frame import Frame
from splatbot.logs import Log
from splatbot.logs.base import DerivedLog


class MaskedLog(DerivedLog):
    """The frames of a log, each gone through ``mask`` (see ``SelfMask``); otherwise that log.

    Args:
        log: the recording.
        mask: gives a frame with its mask narrowed.
    """

    def __init__(self, log: Log, mask: Callable[[Frame], Frame]) -> None:
        super().__init__(log)
        self._mask = mask

    def _decode(self, index: int) -> Frame:
        return self._mask(self._log[index])
