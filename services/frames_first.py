"""Answers wait while a frame is mapped: a camera cannot wait, a question can, a little."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class FramesFirst:
    """Gives mapping priority over queries: a query waits for frames in progress, at most ``patience_s`` [s]."""

    def __init__(self, patience_s: float = 0.1) -> None:
        self.patience_s = patience_s
        self._changed = threading.Condition()
        self._mapped = 0

    @contextmanager
    def mapping(self) -> Iterator[None]:
        """Enter while a frame is being mapped."""
        with self._changed:
            self._mapped += 1
        try:
            yield
        finally:
            with self._changed:
                self._mapped -= 1
                self._changed.notify_all()

    def wait(self) -> bool:
        """Wait until no frame is being mapped; whether that has come, or patience ended."""
        with self._changed:
            return self._changed.wait_for(lambda: self._mapped == 0, self.patience_s)
