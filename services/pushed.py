"""Frames that clients push, as a source that a mapper reads."""

from __future__ import annotations

import logging
import math
import queue
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

from splatbot.config import CameraConfig
from splatbot.errors import InputError, SplatbotError
from splatbot.frame import Frame
from splatbot.services.problems import BusyError
from splatbot.slam import FrameResult

MAX_STAMP_S = 1e11  # in the year 5138; larger numbers are not seconds
MAX_PAUSE_S = 86_400.0  # [s] between two frames
MAX_BEFORE_S = 0.002  # [s] by which a frame of a carried camera may be older than that of the first camera
MAX_AFTER_S = 0.1  # [s] by which it may be newer, and at most twice the interval of the first camera: extrapolation
_MAX_INTERVAL_S = 0.1  # [s] largest time in the map between the frames before and after a jump of the clock
_log = logging.getLogger(__name__)
_RESYNC = "if the clock was set, POST /v1/maps/ID/resync first"


class StreamEndedError(InputError):
    """The map takes no more frames."""

    http_status = 409


class FirstCameraElsewhereError(InputError):
    """The pose of the first camera at the time of a frame of a carried camera is not known."""

    http_status = 409


@dataclass(frozen=True, order=True)
class _Waiting:
    """A frame that waits, or the end of the stream; the earliest stamp is first, and the end is last."""

    stamp: float  # [s] in the time of the map
    index: int
    frame: Frame | None = field(compare=False)


class PushedFrames:
    """A bounded queue of frames: pushed by any thread, iterated by one, which answers each by :meth:`answer`.

    The frames of each camera come in the order of their stamps. Across cameras any order is taken, and the earliest
    frame that waits is read first. Fixed and free cameras do not depend on the others. A carried camera moves with the
    first one, and needs its pose and velocity. Its frame is refused more than 2 ms before the newest frame of the first
    one. It is also refused more than 0.1 s, or twice the time between the first one's frames, after it.

    Args:
        capacity: frames of all cameras that may wait.
        mask: masks the robot in each frame; a frame that it refuses is not mapped.
        cameras: further cameras by name.
    """

    def __init__(
        self,
        capacity: int = 4,
        mask: Callable[[Frame], Frame] | None = None,
        cameras: Mapping[str, CameraConfig] | None = None,
    ) -> None:
        self._frames: queue.PriorityQueue[_Waiting] = queue.PriorityQueue()
        self._mask = mask
        self._cameras = dict(cameras or {})
        self._capacity = capacity
        self._lock = threading.Lock()
        self._answers: dict[int, Future[FrameResult]] = {}
        self._count = 0
        self._last: dict[str, float] = {}  # [s] newest stamp of each camera, in the time of the map
        self._first_read: float | None = None  # [s] newest stamp of the first camera that was read
        self._first_interval = 0.0  # [s] between it and the one before
        self._interval = _MAX_INTERVAL_S
        self._offset = 0.0  # [s] from the clock of the frames to the time of the map
        self._resync = False
        self._sizes: dict[str, tuple[int, int]] = {}
        self._ended: str | None = None

    def push(self, frame: Frame) -> Future[FrameResult]:
        """Queue a frame and set its ``index`` to its place in the stream; the future receives its result.

        Raises:
            BusyError: as many frames wait as may; this one is dropped.
            StreamEndedError: the stream has ended.
            InputError: the camera is unknown, or size, stamp or intrinsics of the frame do not fit those of its camera
                before.
        """
        with self._lock:
            self._check_open()
            if len(self._answers) >= self._capacity:
                raise BusyError(f"{self._capacity} frames wait to be mapped.", hint="send fewer, or smaller ones")
            self._check(frame)
            index, self._count = self._count, self._count + 1
            self._sizes[frame.camera_name] = frame.camera.width, frame.camera.height
            stamp = self._in_time_of_map(frame)
            answer: Future[FrameResult] = Future()
            self._answers[index] = answer
            self._frames.put(_Waiting(stamp, index, frame))
        return answer

    def check_camera(self, name: str) -> None:
        """Check that a camera is one of the map; the first one has an empty name.

        Raises:
            InputError: it is not.
        """
        if name and name not in self._cameras:
            hint = f"the further cameras are {', '.join(self._cameras) or 'none'}: create the map with `cameras`"
            raise InputError(f"is {name!r:.40}.", field="camera_name", hint=hint)

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
                self._frames.put(_Waiting(math.inf, self._count, None))

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
        while (waiting := self._frames.get()).frame is not None:
            try:
                masked = waiting.frame if self._mask is None else self._mask(waiting.frame)  # by the camera's clock
                self._check_first_camera(waiting.frame.camera_name, waiting.stamp)
            except SplatbotError as error:
                self.refuse(waiting.index, error)
                continue
            except Exception:  # a defect: the other frames are mapped all the same
                _log.exception("the robot in frame %d cannot be masked", waiting.index)
                self.refuse(waiting.index, InputError("the robot in the frame cannot be masked.", field="joints"))
                continue
            if not waiting.frame.camera_name:
                self._first_interval = 0.0 if self._first_read is None else waiting.stamp - self._first_read
                self._first_read = waiting.stamp
            yield replace(masked, index=waiting.index, stamp=waiting.stamp)

    def _check_first_camera(self, name: str, stamp: float) -> None:
        """Check that the pose of the first camera is known at the time [s] of a frame of a camera that it carries.

        Raises:
            FirstCameraElsewhereError: it is not.
        """
        if not name or self._cameras[name].T_first_camera is None or self._first_read is None:
            return  # before the map begins, no frame of a further camera has a pose
        late = stamp - self._first_read
        if not -MAX_BEFORE_S <= late <= max(MAX_BEFORE_S, min(MAX_AFTER_S, 2 * self._first_interval)):
            order = "after" if late < 0 else "before"
            raise FirstCameraElsewhereError(
                f"the newest frame of the first camera is {abs(late):.3f} s {order} it.",
                field="stamp",
                hint=f"push both cameras in the order of their stamps, the first at {1 / MAX_AFTER_S:.0f} Hz or more",
            )

    def _check_open(self) -> None:
        if self._ended is not None:
            raise StreamEndedError(f"the map takes no more frames: {self._ended}.", hint="create another map")

    def _check(self, frame: Frame) -> None:
        self.check_camera(frame.camera_name)
        frame.camera.check_plausible()
        size = frame.camera.width, frame.camera.height
        known = self._sizes.get(frame.camera_name, size)
        if size != known:
            raise InputError(
                f"is {size[0]} x {size[1]}, frames before are {known[0]} x {known[1]}.",
                field="camera",
                hint="push frames of one size for each camera of a map",
            )
        if not 0.0 <= frame.stamp <= MAX_STAMP_S:
            hint = "give seconds since 1970, or since the start"
            raise InputError(f"{frame.stamp:.6g} s is not within 0..{MAX_STAMP_S:.0e} s.", field="stamp", hint=hint)
        if not self._last or self._resync:
            return
        stamp, last = frame.stamp + self._offset, self._last.get(frame.camera_name, -math.inf)
        if stamp <= last:
            hint = f"push frames in the order of their stamps; {_RESYNC}"
            before = last - self._offset
            raise InputError(f"{frame.stamp:.6f} s is not after {before:.6f} s.", field="stamp", hint=hint)
        if abs(stamp - max(self._last.values())) > MAX_PAUSE_S:
            raise InputError(
                f"{frame.stamp:.6f} s is more than {MAX_PAUSE_S:.0f} s from the newest frame of the map.",
                field="stamp",
                hint=f"stamp all cameras by one clock; {_RESYNC}",
            )

    def _in_time_of_map(self, frame: Frame) -> float:
        """Return the stamp of a frame in the time of the map, which goes on when the clock of frames is set back."""
        if self._resync and self._last:
            self._offset = max(0.0, max(self._last.values()) + self._interval - frame.stamp)
        self._resync = False
        stamp = frame.stamp + self._offset
        last = self._last.get(frame.camera_name)
        if last is not None:
            self._interval = min(stamp - last, _MAX_INTERVAL_S)
        self._last[frame.camera_name] = stamp
        return stamp
