"""A camera that is recorded while its frames are used; afterwards it is the log of its recording."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from splatbot.camera import Camera
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs.address import PAIR_WITHIN
from splatbot.logs.bag import BagLog
from splatbot.logs.base import Log, LogBase
from splatbot.logs.mcap import McapFile, write_frame
from splatbot.protocols import FrameSource
from splatbot.trajectory import Trajectory

_log = logging.getLogger(__name__)


class RecordedCamera(LogBase):
    """The frames of a camera, each of which is written into an MCAP file.

    A thread records every frame that the camera delivers, but for those whose stamps do not increase. :meth:`arrivals`
    yields the newest one, so that a slow reader misses frames but the recording does not. When it ended, the object is
    the log of the recording.

    Args:
        camera: the camera; it is opened here.
        path: file of the recording.
        max_frames: end after this number of frames; None for no end.
        seconds: end after this time [s]; None for no end.
        overwrite: replace the file if it exists, once the camera has delivered a frame.

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
        if overwrite:
            Path(path).unlink(missing_ok=True)
        self._file = McapFile(path)
        self._thread = threading.Thread(target=self._record, name="recording", daemon=True)
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
    def ended(self) -> bool:
        """Return whether the camera delivers no further frame."""
        return self._ended

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

    def close(self) -> None:
        """End the stream and complete the file, which is then read for the frames."""
        self._camera.close()
        self._thread.join()
        if self._recording is None:
            self._file.close()
            self._recording = BagLog(self.uri, options={PAIR_WITHIN: "10"})

    def _record(self) -> None:
        begun, last = time.monotonic(), -np.inf
        frame: Frame | None = self._first
        try:
            while frame is not None:
                if frame.stamp <= last:
                    text = "%s: a frame at %.6f s follows one at %.6f s; it is left out"
                    _log.warning(text, self.name, frame.stamp, last)
                    frame = next(self._frames, None)
                    continue
                last = frame.stamp
                if frame.camera != self._first.camera:
                    raise LogError("changed its images.", file=self.name, field="camera", hint="record two logs")
                write_frame(self._file, frame)
                with self._changed:
                    self._newest = self._count, frame
                    self._count += 1
                    self._changed.notify_all()
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

    def _decode(self, index: int) -> Frame:
        if self._recording is None:
            hint = "close the camera first"
            raise LogError("is still being recorded.", file=self.uri, field=f"frame {index}", hint=hint)
        return self._recording.read(index)
