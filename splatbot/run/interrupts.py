"""Ctrl-C without half-written results."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupts:
    """Turns SIGINT and SIGTERM into a request that a long job honours where it is safe.

    While active, a signal only sets :attr:`requested`, so that the work in progress is completed and saved. Inside
    :meth:`interruptible`, around work that may be cut short without loss, it raises KeyboardInterrupt. Outside the
    main thread Python delivers no signals, and this does nothing.
    """

    def __init__(self) -> None:
        self.requested: int | None = None
        self._when_requested: Callable[[], None] | None = None
        self._arrived: list[int] = []
        self._settled = 0  # of them, which are no longer pending
        self._raises_after: int | None = None
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._handle) for number in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    @property
    def when_requested(self) -> Callable[[], None] | None:
        """Called with each signal, and when it is set after one; for example the end of a camera without frames."""
        return self._when_requested

    @when_requested.setter
    def when_requested(self, call: Callable[[], None]) -> None:
        self._when_requested = call
        if self.requested is not None:
            call()

    @contextmanager
    def interruptible(self, *, after: int = 0) -> Iterator[None]:
        """Return a context that raises KeyboardInterrupt once more than ``after`` signals have arrived."""
        self._raises_after = after
        try:
            self._raise_if_requested()
            yield
        finally:
            self._raises_after = None

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Return a context that turns a KeyboardInterrupt in its block into a request."""
        try:
            yield
        except KeyboardInterrupt:
            self.requested = self.requested or signal.SIGINT

    def end_of_camera(self) -> bool:
        """Return whether the only request is Ctrl-C, the normal end of a camera; it is then no longer pending."""
        seen = len(self._arrived)
        if self.requested != signal.SIGINT or seen > 1:
            return False
        self.requested, self._settled = None, seen
        if len(self._arrived) > seen:  # one came meanwhile
            self.requested = self.requested or self._arrived[seen]
        return self.requested is None

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        self._arrived.append(number)
        self.requested = self.requested or number
        if self._when_requested is not None:
            self._when_requested()
        self._raise_if_requested()

    def _raise_if_requested(self) -> None:
        if self._raises_after is not None and len(self._arrived) - self._settled > self._raises_after:
            self._raises_after = None  # the next signal must not interrupt the cleanup
            raise KeyboardInterrupt
