"""A device on a pseudo-terminal, and the faults of serial lines."""

from __future__ import annotations

import os
import pty
import select
import threading
import time
import tty
from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np

from splatbot.robots.grippers.line import QUIET


@dataclass
class LineFaults:
    """Faults of the serial line; they may be changed at any time.

    Args:
        drop: fraction of lost bytes in both directions.
        flip: fraction of bytes with one wrong bit.
        half: fraction of responses that end in the middle.
        delay: delay before each response [s].
        silent: True suppresses all responses.
    """

    drop: float = 0.0
    flip: float = 0.0
    half: float = 0.0
    delay: float = 0.0
    silent: bool = False


class FakeLine(ABC):
    """Base of devices that respond on the serial port ``port``; a thread serves it from the construction on.

    Args:
        faults: faults of the line.
        seed: seed of the faults.

    Attributes:
        port: path of the pseudo-terminal.
        requests: complete requests to this device.
        silences: number of silent periods; after two of them, all earlier requests are answered or discarded.
    """

    def __init__(self, faults: LineFaults | None, *, seed: int) -> None:
        self.faults = faults if faults is not None else LineFaults()
        self.requests: list[bytes] = []
        self.silences = 0
        self._rng = np.random.default_rng(seed)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._plugged = True
        self._thread = threading.Thread(target=self._serve, name="fake-line", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.unplug()

    def unplug(self) -> None:
        """Close the port permanently."""
        if self._plugged:
            self._plugged = False
            self._thread.join()
            os.close(self._master)
            os.close(self._slave)

    @abstractmethod
    def _length(self, data: bytes) -> int:
        """Return the length of a request from its first bytes."""

    @abstractmethod
    def _respond(self, request: bytes) -> bytes | None:
        """Execute a request and return the response, or None if there is no response."""

    def _serve(self) -> None:
        data = b""
        while self._plugged:
            ready, _, _ = select.select([self._master], [], [], QUIET)
            if not ready:
                data = b""  # silence ends a frame, whole or not
                self.silences += 1
                continue
            data += self._through(os.read(self._master, 256))
            if len(data) >= self._length(data):
                self._answer_to(data)
                data = b""

    def _answer_to(self, request: bytes) -> None:
        answer = self._respond(request)
        if answer is None:
            return
        time.sleep(self.faults.delay)
        if self.faults.silent:
            return
        if self._rng.random() < self.faults.half:
            answer = answer[: len(answer) // 2]
        os.write(self._master, self._through(answer))

    def _through(self, data: bytes) -> bytes:
        """Apply the faults of the line to bytes."""
        if not (self.faults.drop or self.faults.flip):
            return data
        kept = [byte for byte in data if self._rng.random() >= self.faults.drop]
        return bytes(b ^ 1 << int(self._rng.integers(8)) if self._rng.random() < self.faults.flip else b for b in kept)
