"""Cameras that are recorded while their frames are used; afterwards they are the log of their recording."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from splatbot.atomic import atomic_write
from splatbot.camera import Camera
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs.bag import BagLog
from splatbot.logs.base import Log, LogBase
from splatbot.logs.mcap import McapFile, recover_mcap, write_frame
from splatbot.logs.rig import RigLog, rig_entries
from splatbot.logs.ros_frames import to_nanoseconds
from splatbot.protocols import FrameSource
from splatbot.trajectory import Trajectory

_IMU_S = 2.0  # time of the samples of frames that the reader misses, which bounds their number
_LATE_S = 10.0  # time of frames whose stamps do not increase, after which the clock of the camera was set back

_log = logging.getLogger(__name__)


def rig_file(path: str | Path) -> Path:
    """Return the file that lists the recordings of several cameras, for the recording of the first one."""
    return Path(path).with_suffix(".yaml")


def further_file(path: str | Path, name: str) -> Path:
    """Return the recording of a further camera, for that of the first one; ``name`` is empty for the first camera."""
    return Path(path).with_stem(f"{Path(path).stem}-{name}") if name else Path(path)


def recover_recording(path: str | Path) -> None:
    """Give the recordings that a killed process left their names, if there are any.

    Raises:
        LogError: another process records into them.
        OSError: the folder cannot be written to.
    """
    recover_mcap(path)
    if rig_file(path).exists():
        for name in list(rig_entries(rig_file(path)))[1:]:
            recover_mcap(further_file(path, name))


class RecordedCamera(LogBase):
    """The frames of a camera, each of which is written into an MCAP file; several cameras have a file each.

    The file of a further camera has its name: a.mcap becomes a-NAME.mcap, and a.yaml lists all of them. A thread
    records every frame that the camera delivers, but for those whose stamps do not increase. :meth:`arrivals` yields
    the newest one of each camera, so that a slow reader misses frames but the recording does not. Frames have the
    numbers and stamps, to the nanosecond, of the recording. When it ended, the object is the log of the recording.

    Args:
        camera: the camera; it is opened here.
        path: file of the recording of the (first) camera.
        cameras: settings of further cameras by their names (:class:`splatbot.logs.rig.RigLog`); ``camera`` yields their
            frames, too, in the order of stamps.
        first_name: name of the first camera, if there are several.
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
        cameras: Mapping[str, Mapping[str, Any]] | None = None,
        first_name: str = "first",
        max_frames: int | None = None,
        seconds: float | None = None,
        overwrite: bool = False,
    ) -> None:
        self._further = dict(cameras or {})
        self._path = Path(path)
        self.name, self.uri = camera.name, str(rig_file(path) if self._further else path)
        self._camera, self._max_frames, self._seconds = camera, max_frames, seconds
        self._changed = threading.Condition()
        self._count = 0
        self._newest: dict[str, tuple[int, Frame]] = {}  # by the name of the camera
        self._images: dict[str, Camera] = {}
        self._ended = False
        self._failure: Exception | None = None
        self._recording: Log | None = None
        self._frames = iter(camera)
        first = next(self._frames, None)
        if first is None:
            raise LogError("ended before its first frame.", file=camera.uri, field="camera", hint="start it again")
        self._first = first
        if self._further and rig_file(path).exists() and not overwrite:
            raise LogError("exists already.", file=rig_file(path), hint="choose another name")
        paths = {name: further_file(path, name) for name in ("", *self._further)}
        self._files = {name: McapFile(own, overwrite=overwrite) for name, own in paths.items()}
        if self._further:
            entries = {name: {"log": paths[name].name, **values} for name, values in self._further.items()}
            listed = {"cameras": {first_name: {"log": paths[""].name}, **entries}}
            with atomic_write(self.uri) as file:
                file.write(yaml.safe_dump(listed, sort_keys=False).encode())
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

    @property
    def cameras(self) -> Mapping[str, Mapping[str, Any]]:
        """See :class:`Log`."""
        return self._further

    def __len__(self) -> int:
        return self._count

    def has_newer(self, frame: Frame) -> bool:
        """Return whether a newer frame of the same camera has arrived."""
        with self._changed:
            return frame.camera_name in self._newest

    def arrivals(self) -> Iterator[tuple[int, Frame]]:
        """Yield number and frame of the newest frames that were not yielded yet, and close the recording at the end.

        Raises:
            DeviceError: the camera is gone.
            LogError: the recording cannot be written, or the camera changed its images.
        """
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._ended or self._newest)
                    if not self._newest:
                        break
                    name = min(self._newest, key=lambda camera: self._newest[camera][0])
                    oldest = self._newest.pop(name)
                yield oldest
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
            for file in self._files.values():
                file.close()
        except OSError as error:
            hint = f"free space on the disk; recording to {self.uri} again recovers the frames first"
            raise LogError(f"cannot be written ({error.strerror}).", file=self.uri, hint=hint) from error
        self._recording = RigLog(self.uri, lambda path, _: BagLog(path)) if self._further else BagLog(self.uri)

    def _record(self) -> None:
        begun, last = time.monotonic(), (-np.inf, 0)
        numbers = {name: number for number, name in enumerate(self._files)}
        late_since: float | None = None  # [s] of the monotonic clock, while stamps do not exceed the last one
        frame: Frame | None = self._first
        try:
            while frame is not None:
                if frame.camera != self._images.setdefault(frame.camera_name, frame.camera):
                    raise LogError("changed its images.", file=self.name, field="camera", hint="record two logs")
                stamp = to_nanoseconds(frame.stamp) / 10**9
                order = stamp, numbers[frame.camera_name]
                if order > last:
                    last, late_since = order, None
                    delay = to_nanoseconds(frame.stamp + frame.depth_delay) / 10**9 - stamp
                    self._publish(replace(frame, index=self._count, stamp=stamp, depth_delay=delay))
                else:
                    late_since = self._left_out(stamp, last[0], late_since)
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
        write_frame(self._files[frame.camera_name], frame)
        with self._changed:
            missed = self._newest.get(frame.camera_name)
            if missed is not None and frame.imu is not None:  # the reader has the samples of the frames that it misses
                frame = replace(frame, imu=frame.imu.joined(missed[1].imu).between(frame.stamp - _IMU_S, frame.stamp))
            self._newest[frame.camera_name] = self._count, frame
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
