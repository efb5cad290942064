"""A log whose frames come with the robot's own body masked."""

from __future__ import annotations

from collections.abc import Callable

from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.logs import Log
from splatbot.logs.base import DerivedLog


class MaskedLog(DerivedLog):
    """The frames of a log, each gone through ``mask`` (see ``SelfMask``); otherwise that log.

    A frame that the mask refuses is a damaged frame of the log: reading it raises LogError.

    Args:
        log: the recording.
        mask: gives a frame with its mask narrowed.
    """

    def __init__(self, log: Log, mask: Callable[[Frame], Frame]) -> None:
        super().__init__(log)
        self._mask = mask
        self.stamps: list[float] | None = getattr(log, "stamps", None)
        """Stamps of the frames [s], where the log knows them without decoding."""

    def _decode(self, index: int) -> Frame:
        frame = self._log[index]
        try:
            return self._mask(frame)
        except InputError as error:
            raise LogError(error.message, file=error.file, field=error.field, hint=error.hint) from error
