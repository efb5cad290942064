"""Frames that clients push, as a source that a mapper reads."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace

from splatbot.errors import InputError, SplatbotError
from splatbot.frame import Frame
from splatbot.services.problems import BusyError
from splatbot.slam import FrameResult

MAX_STAMP_S = 1e11  # in the year 5138; larger numbers are not seconds
MAX_PAUSE_S = 86_400.0  # [s] between two frames
_MAX_INTERVAL_S = 0.1  # [s] largest time in the map between the frames before and after a jump of the clock
_log = logging.getLogger(__name__)
_RESYNC = "if the clock was set, POST /v1/maps/ID/resync first"


class StreamEndedError(InputError):
    """The map takes no more frames."""

    http_status = 409


class PushedFrames:
    """A bounded queue of frames: pushed by any thread, iterated by one, which answers each by :meth:`answer`.

    Args:
        capacity: frames that may wait.
        mask: masks the robot in each frame; a frame that it refuses is not mapped.
    """

    def __init__(self, capacity: int = 4, mask: Callable[[Frame], Frame] | None = None) -> None:
        self._frames: queue.Queue[tuple[Frame, int, float] | None] = queue.Queue()
        self._mask = mask
        self._capacity = capacity
        self._lock = threading.Lock()
        self._answers: dict[int, Future[FrameResult]] = {}
        self._count = 0
        self._last: float | None = None
        self._interval = _MAX_INTERVAL_S
        self._offset = 0.0  # [s] from the clock of the frames to the time of the map
        self._resync = False
        self._size: tuple[int, int] | None = None
        self._ended: str | None = None

    def push(self, frame: Frame) -> Future[FrameResult]:
        """Queue a frame and set its ``index`` to its place in the stream; the future receives its result.

        Raises:
            BusyError: as many frames wait as may; this one is dropped.
            StreamEndedError: the stream has ended.
            InputError: the frame is of another size than those before, not after them, or its stamp or intrinsics
                cannot be right; only this frame is refused.
        """
        with self._lock:
            self._check_open()
            if len(self._answers) >= self._capacity:
                raise BusyError(f"{self._capacity} frames wait to be mapped.", hint="send fewer, or smaller ones")
            self._check(frame)
            index, self._count = self._count, self._count + 1
            self._size = frame.camera.width, frame.camera.height
            stamp = self._in_time_of_map(frame.stamp)
            answer: Future[FrameResult] = Future()
            self._answers[index] = answer
            self._frames.put((frame, index, stamp))
        return answer

    def resync(self) -> None:
        """Accept any stamp of the next frame: its clock was set. In the map, time goes on and never back.

        Raises:
            StreamEndedError: the stream has ended.
        """
        with self._lock:
            self._check_open()
            self._resync = True

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

    def refuse(self, index: int, error: SplatbotError) -> None:
        """Report the error of a frame, which is not in the map, to the request that pushed it."""
        with self._lock:
            waiting = self._answers.pop(index, None)
        if waiting is not None and waiting.set_running_or_notify_cancel():
            waiting.set_exception(error)

    def abandon(self, why: str) -> None:
        """End the stream and fail all waiting requests."""
        self.end(why)
        with self._lock:
            waiting, self._answers = list(self._answers.values()), {}
        for future in waiting:
            if future.set_running_or_notify_cancel():
                future.set_exception(StreamEndedError(f"the frame was not mapped: {why}."))

    def __iter__(self) -> Iterator[Frame]:
        while (pushed := self._frames.get()) is not None:
            frame, index, stamp = pushed
            try:
                masked = frame if self._mask is None else self._mask(frame)  # by the stamps of the camera's clock
            except SplatbotError as error:
                self.refuse(index, error)
                continue
            except Exception:  # a defect: the other frames are mapped all the same
                _log.exception("the robot in frame %d cannot be masked", index)
                self.refuse(index, InputError("the robot in the frame cannot be masked.", field="joints"))
                continue
            yield replace(masked, index=index, stamp=stamp)

    def _check_open(self) -> None:
        if self._ended is not None:
            raise StreamEndedError(f"the map takes no more frames: {self._ended}.", hint="create another map")

    def _check(self, frame: Frame) -> None:
        frame.camera.check_plausible()
        size = frame.camera.width, frame.camera.height
        if self._size is not None and size != self._size:
            hint = "push frames of one size to one map"
            raise InputError(
                f"is {size[0]} x {size[1]}, frames before are {self._size[0]} x {self._size[1]}.",
                field="camera",
                hint=hint,
            )
        if not 0.0 <= frame.stamp <= MAX_STAMP_S:
            hint = "give seconds since 1970, or since the start"
            raise InputError(f"{frame.stamp:.6g} s is not within 0..{MAX_STAMP_S:.0e} s.", field="stamp", hint=hint)
        if self._last is None or self._resync:
            return
        stamp = frame.stamp + self._offset
        if stamp <= self._last:
            hint = f"push frames in the order of their stamps; {_RESYNC}"
            before = self._last - self._offset
            raise InputError(f"{frame.stamp:.6f} s is not after {before:.6f} s.", field="stamp", hint=hint)
        if stamp - self._last > MAX_PAUSE_S:
            raise InputError(
                f"{frame.stamp:.6f} s is more than {MAX_PAUSE_S:.0f} s after the frame before.",
                field="stamp",
                hint=_RESYNC,
            )

    def _in_time_of_map(self, stamp: float) -> float:
        """Return a stamp in the time of the map, which increases when the clock of the frames is set back."""
        if self._resync and self._last is not None:
            self._offset = max(0.0, self._last + self._interval - stamp)
        self._resync = False
        stamp += self._offset
        if self._last is not None:
            self._interval = min(stamp - self._last, _MAX_INTERVAL_S)
        self._last = stamp
        return stamp
