"""A camera that is recorded while its frames are used; afterwards it is the log of its recording."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatbot.camera import Camera
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs.bag import BagLog
from splatbot.logs.base import Log, LogBase
from splatbot.logs.mcap import McapFile, write_frame
from splatbot.logs.ros_frames import to_nanoseconds
from splatbot.protocols import FrameSource
from splatbot.trajectory import Trajectory

_LATE_S = 10.0  # time of frames whose stamps do not increase, after which the clock of the camera was set back

_log = logging.getLogger(__name__)


class RecordedCamera(LogBase):
    """The frames of a camera, each of which is written into an MCAP file.

    A thread records every frame that the camera delivers, but for those whose stamps do not increase. :meth:`arrivals`
    yields the newest one, so that a slow reader misses frames but the recording does not. Frames have the numbers and
    stamps, to the nanosecond, of the recording. When it ended, the object is the log of the recording.

    Args:
        camera: the camera; it is opened here.
        path: file of the recording.
        max_frames: end after this number of frames; None for no end.
        seconds: end after this time [s]; None for no end.
        overwrite: replace the file if it exists, when the recording is complete.

    Raises:
        DeviceError: there is no such camera, or it delivers no frame.
        LogError: the file exists or cannot be written.
    """

    def __init__(
        self,
        camera: FrameSource,
        path: str | Path,
        *,
        max_frames: int | None = None,
        seconds: float | None = None,
        overwrite: bool = False,
    ) -> None:
        self.name, self.uri = camera.name, str(path)
        self._camera, self._max_frames, self._seconds = camera, max_frames, seconds
        self._changed = threading.Condition()
        self._count = 0
        self._newest: tuple[int, Frame] | None = None
        self._ended = False
        self._failure: Exception | None = None
        self._recording: Log | None = None
        self._frames = iter(camera)
        first = next(self._frames, None)
        if first is None:
            raise LogError("ended before its first frame.", file=camera.uri, field="camera", hint="start it again")
        self._first = first
        self._file = McapFile(path, overwrite=overwrite)
        self._thread = threading.Thread(target=self._record, name="recording", daemon=True)
        self._timer = None if seconds is None else threading.Timer(seconds, self.end)  # a camera may be silent
        if self._timer is not None:
            self._timer.daemon = True
            self._timer.start()
        self._thread.start()

    @property
    def camera(self) -> Camera:
        """See :class:`Log`."""
        return self._first.camera

    @property
    def ground_truth(self) -> Trajectory | None:
        """Return None, since a camera has no reference."""
        return None

    @property
    def missed(self) -> int:
        """Return the number of frames that the camera lost before they were recorded."""
        return self._camera.dropped

    def __len__(self) -> int:
        return self._count

    def arrivals(self) -> Iterator[tuple[int, Frame]]:
        """Yield number and frame of the newest frame that was not yielded yet, and close the recording at the end.

        Raises:
            DeviceError: the camera is gone.
            LogError: the recording cannot be written, or the camera changed its images.
        """
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._ended or self._newest is not None)
                    newest, self._newest = self._newest, None
                if newest is None:
                    break
                yield newest
            if self._failure is not None:
                raise self._failure
        finally:
            self.close()

    def end(self) -> None:
        """End the stream; :meth:`arrivals` ends by itself."""
        self._camera.close()

    def close(self) -> None:
        """End the stream and complete the file, which is then read for the frames.

        Raises:
            LogError: the file cannot be completed; its frames are recovered as the message describes.
        """
        self.end()
        self._thread.join()
        if self._timer is not None:
            self._timer.cancel()
        if self._recording is not None:
            return
        try:
            self._file.close()
        except OSError as error:
            hint = f"free space on the disk; recording to {self.uri} again recovers the frames first"
            raise LogError(f"cannot be written ({error.strerror}).", file=self.uri, hint=hint) from error
        self._recording = BagLog(self.uri)

    def _record(self) -> None:
        begun, last = time.monotonic(), -np.inf
        late_since: float | None = None  # [s] of the monotonic clock, while stamps do not exceed the last one
        frame: Frame | None = self._first
        try:
            while frame is not None:
                if frame.camera != self._first.camera:
                    raise LogError("changed its images.", file=self.name, field="camera", hint="record two logs")
                stamp = to_nanoseconds(frame.stamp) / 10**9
                if stamp > last:
                    last, late_since = stamp, None
                    delay = to_nanoseconds(frame.stamp + frame.depth_delay) / 10**9 - stamp
                    self._publish(replace(frame, index=self._count, stamp=stamp, depth_delay=delay))
                else:
                    late_since = self._left_out(stamp, last, late_since)
                if self._count == self._max_frames:
                    break
                if self._seconds is not None and time.monotonic() - begun >= self._seconds:
                    break
                frame = next(self._frames, None)
        except OSError as error:
            hint = "free space on the disk"
            self._failure = LogError(f"cannot be written ({error.strerror}).", file=self.uri, hint=hint)
        except Exception as error:  # raised again in the reader
            self._failure = error
        finally:
            self._camera.close()
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _publish(self, frame: Frame) -> None:
        """Write a frame, and keep it for the reader as the recording has it."""
        write_frame(self._file, frame)
        with self._changed:
            self._newest = self._count, frame
            self._count += 1
            self._changed.notify_all()

    def _left_out(self, stamp: float, last: float, since: float | None) -> float:
        """Report a frame whose stamp does not exceed the last one; return the time of the first in a row.

        Raises:
            LogError: there were no others for 10 s.
        """
        now = time.monotonic()
        if since is None:
            text = "%s: frames from %.6f s on are left out, since one at %.6f s is recorded"
            _log.warning(text, self.name, stamp, last)
            return now
        if now - since > _LATE_S:
            problem = f"has a clock that went back by {last - stamp:.3f} s."
            raise LogError(problem, file=self.name, field="camera", hint="start another recording")
        return since

    def _decode(self, index: int) -> Frame:
        if self._recording is None:
            hint = "close the camera first"
            raise LogError("is still being recorded.", file=self.uri, field=f"frame {index}", hint=hint)
        return self._recording.read(index)
