"""Frames that clients push, as a source that a mapper reads."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.services.problems import BusyError
from splatbot.slam import FrameResult


class StreamEndedError(InputError):
    """The map takes no more frames."""

    http_status = 409


class PushedFrames:
    """A bounded queue of frames: pushed by any thread, iterated by one, which answers each by :meth:`answer`.

    Args:
        capacity: frames that may wait.
    """

    def __init__(self, capacity: int = 4) -> None:
        self._frames: queue.Queue[Frame | None] = queue.Queue()
        self._capacity = capacity
        self._lock = threading.Lock()
        self._answers: dict[int, Future[FrameResult]] = {}
        self._count = 0
        self._last = -float("inf")
        self._size: tuple[int, int] | None = None
        self._ended: str | None = None

    def push(self, frame: Frame) -> Future[FrameResult]:
        """Queue a frame and set its ``index`` to its place in the stream; the future receives its result.

        Raises:
            BusyError: as many frames wait as may; this one is dropped.
            StreamEndedError: the stream has ended.
            InputError: the frame is of another size than those before, or not after them.
        """
        with self._lock:
            if self._ended is not None:
                raise StreamEndedError(f"the map takes no more frames: {self._ended}.", hint="create another map")
            if len(self._answers) >= self._capacity:
                raise BusyError(f"{self._capacity} frames wait to be mapped.", hint="send fewer, or smaller ones")
            self._check(frame)
            index, self._count = self._count, self._count + 1
            self._last = frame.stamp
            answer: Future[FrameResult] = Future()
            self._answers[index] = answer
            self._frames.put(replace(frame, index=index))
        return answer

    def end(self, why: str = "its stream has ended") -> None:
        """Take no more; those that wait are still given to the reader."""
        with self._lock:
            if self._ended is None:
                self._ended = why
                self._frames.put(None)

    def answer(self, result: FrameResult) -> None:
        """Report the result of a frame to the request that pushed it."""
        with self._lock:
            waiting = self._answers.pop(result.index, None)
        if waiting is not None and waiting.set_running_or_notify_cancel():
            waiting.set_result(result)

    def abandon(self, why: str) -> None:
        """End the stream and fail all waiting requests."""
        self.end(why)
        with self._lock:
            waiting, self._answers = list(self._answers.values()), {}
        for future in waiting:
            if future.set_running_or_notify_cancel():
                future.set_exception(StreamEndedError(f"the frame was not mapped: {why}."))

    def __iter__(self) -> Iterator[Frame]:
        while (frame := self._frames.get()) is not None:
            yield frame

    def _check(self, frame: Frame) -> None:
        size = frame.camera.width, frame.camera.height
        if self._size is not None and size != self._size:
            hint = "push frames of one size to one map"
            raise InputError(
                f"is {size[0]} x {size[1]}, frames before are {self._size[0]} x {self._size[1]}.",
                field="camera",
                hint=hint,
            )
        if frame.stamp <= self._last:
            hint = "push frames in the order of their stamps"
            raise InputError(f"{frame.stamp} s is not after {self._last} s.", field="stamp", hint=hint)
        self._size = size
