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

    While active, a first signal only sets :attr:`requested`; a second one raises KeyboardInterrupt at once. Inside
    :meth:`held` no signal raises; one that arrived there raises when the block ends. After :meth:`release` the first
    signal raises too. Outside the main thread Python delivers no signals, and this does nothing.
    """

    def __init__(self) -> None:
        self.requested: int | None = None
        self._at_once = False
        self._holding = False
        self._pending = False
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._handle) for number in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def release(self) -> None:
        """From here on a signal interrupts at once: what matters has been saved."""
        self._at_once = True

    @contextmanager
    def held(self) -> Iterator[None]:
        """A block that no signal interrupts: keep it short."""
        self._holding = True
        try:
            yield
        finally:
            self._holding = False
        if self._pending:
            self._pending = False
            raise KeyboardInterrupt

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        again = self._at_once or self.requested is not None
        self.requested = self.requested or number
        if again and self._holding:
            self._pending = True
        elif again:
            raise KeyboardInterrupt
