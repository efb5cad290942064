"""Frames that ROS clients publish, as a map of their own."""

from __future__ import annotations

import logging
from collections.abc import Callable

from splatbot.frame import Frame
from splatbot.services.problems import BusyError
from splatbot.services.pushed import PushedFrames

MAP_ID = "ros"

_log = logging.getLogger(__name__)


class ClientFrames:
    """Gives frames to a map that the first of them begins; those that come too fast are dropped, as by a camera.

    Args:
        open_stream: makes the map of that id and tells where its frames are pushed.
    """

    def __init__(self, open_stream: Callable[[str], PushedFrames]) -> None:
        self._open = open_stream
        self._frames: PushedFrames | None = None
        self.dropped = 0

    def __call__(self, frame: Frame) -> None:
        """Take a frame.

        Raises:
            SplatbotError: it does not follow those before, or the map takes no more.
        """
        if self._frames is None:
            self._frames = self._open(MAP_ID)
            _log.info("map %r is made of the frames that ROS clients publish", MAP_ID)
        try:
            self._frames.push(frame)
        except BusyError:
            self.dropped += 1
