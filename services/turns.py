"""Turns at a mapper: the frames in their order, and between two the thread that needs its whole state."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from splatbot.services.problems import BusyError


class Turns:
    """Gives one thread at a time the mapper.

    A thread that waits between frames comes before the next frame. After its turn, a frame that waits comes first.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._taken = self._frame_first = False
        self._frames = self._between = 0  # that wait

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Enter while a frame is mapped."""
        with self._changed:
            self._frames += 1
            try:
                self._changed.wait_for(lambda: not self._taken and (self._frame_first or not self._between))
                self._taken, self._frame_first = True, False
            finally:
                self._frames -= 1
        try:
            yield
        finally:
            self._leave()

    @contextmanager
    def between_frames(self, timeout_s: float) -> Iterator[None]:
        """Enter once the frame in work is mapped; the next frame waits.

        Raises:
            BusyError: the frame takes longer than ``timeout_s`` [s].
        """
        with self._changed:
            self._between += 1
            try:
                free = self._changed.wait_for(lambda: not self._taken and not self._frame_is_next, timeout_s)
                self._taken = self._taken or free
                self._frame_first = self._frame_first or free
            finally:
                self._between -= 1
                self._changed.notify_all()
        if not free:
            raise BusyError(f"the mapper is at work for {timeout_s:g} s already.", hint="try again later")
        try:
            yield
        finally:
            self._leave()

    @property
    def _frame_is_next(self) -> bool:
        return self._frame_first and self._frames > 0

    def _leave(self) -> None:
        with self._changed:
            self._taken = False
            self._changed.notify_all()
