"""Ctrl-C without half-written results."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupts:
    """Turns SIGINT and SIGTERM into a request that a long job honours where it is safe.

    While active, a signal only sets :attr:`requested`, so that what is under way is done and saved whole. Inside
    :meth:`interruptible`, around work that may be cut short without loss, it raises KeyboardInterrupt. Outside the
    main thread Python delivers no signals, and this does nothing.
    """

    def __init__(self) -> None:
        self.requested: int | None = None
        self._count = 0
        self._raises_after: int | None = None
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._handle) for number in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    @contextmanager
    def interruptible(self, *, after: int = 0) -> Iterator[None]:
        """A block that KeyboardInterrupt ends, or is not even begun, once more than ``after`` signals have come."""
        self._raises_after = after
        try:
            self._raise_if_asked()
            yield
        finally:
            self._raises_after = None

    @contextmanager
    def noted(self) -> Iterator[None]:
        """A block that KeyboardInterrupt ends as well, whoever raised it, and which makes a request of it."""
        try:
            yield
        except KeyboardInterrupt:
            self.requested = self.requested or signal.SIGINT

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        self._count += 1
        self.requested = self.requested or number
        self._raise_if_asked()

    def _raise_if_asked(self) -> None:
        if self._raises_after is not None and self._count > self._raises_after:
            self._raises_after = None  # at once: the next signal must not cut the cleaning up
            raise KeyboardInterrupt
