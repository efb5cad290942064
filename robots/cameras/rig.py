"""Several live cameras of one scene as one camera: a YAML file lists their addresses."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from splatbot.errors import DeviceError, LogError
from splatbot.frame import Frame
from splatbot.layouts import is_camera
from splatbot.logs.rig import further_settings, rig_entries
from splatbot.protocols import FrameSource

_WAIT_S = 0.2  # [s] that a frame waits for earlier ones of other cameras: a transfer with a repeat
_WAITING = 16  # frames of one camera that wait, at most: 0.5 s at 30 Hz
_FIRST_S = 30.0  # [s] until every camera has delivered a frame: some devices start for 10 s


@dataclass(eq=False)
class _Part:
    """One camera of the rig and its frames that were not yielded yet."""

    name: str  # empty for the first camera
    camera: FrameSource
    time_offset: float
    waiting: deque[tuple[float, Frame]] = field(default_factory=deque)  # with the time of arrival [s]
    ended: bool = False
    failure: BaseException | None = None


class CameraRig:
    """The frames of several cameras in the order of their stamps; one clock stamps all of them.

    A thread reads each camera. A frame is yielded once every other camera has delivered a later one, or after 0.2 s.
    Frames that arrive after a later one was yielded are left out. The loss of one camera ends the stream of all.

    Attributes:
        first_name: name of the first camera in the file.
        dropped: frames that arrived too late or that no reader took in time, with those that the cameras lost.

    Args:
        path: YAML file, as of :class:`splatbot.logs.rig.RigLog`, whose ``log`` are addresses of cameras.
        opener: opens one camera.

    Raises:
        InputError: an address is wrong.
        LogError: the file is damaged, or names recordings.
    """

    def __init__(self, path: str | Path, opener: Callable[[str], FrameSource]) -> None:
        file = Path(path)
        entries = rig_entries(file)
        for name, values in entries.items():
            if not is_camera(values["log"]):
                hint = "name cameras only, or recordings only"
                raise LogError("is no address of a camera.", file=file, field=f"cameras.{name}.log", hint=hint)
            if [other["log"] for other in entries.values()].count(values["log"]) > 1:
                hint = "give each device its serial number, as in oak://SERIAL"
                raise LogError("names a camera twice.", file=file, field=f"cameras.{name}.log", hint=hint)
            if "camera" in values:
                hint = "leave it out: a device knows its intrinsics; replay:LOG has those of the log"
                raise LogError("is for recordings.", file=file, field=f"cameras.{name}.camera", hint=hint)
        self.name, self.uri = file.stem, str(path)
        self.first_name, *others = entries
        self._settings = {name: further_settings(entries[name], {}) for name in others}
        self._parts = [
            _Part("" if name == self.first_name else name, opener(values["log"]), float(values.get("time_offset", 0.0)))
            for name, values in entries.items()
        ]
        self._changed = threading.Condition()
        self._late = 0

    @property
    def cameras(self) -> Mapping[str, Mapping[str, Any]]:
        """Further cameras by their name, in the order of the file; see :class:`splatbot.logs.Log`."""
        return self._settings

    @property
    def dropped(self) -> int:
        """See :class:`FrameSource`."""
        return self._late + sum(part.camera.dropped for part in self._parts)

    def close(self) -> None:
        """End the streams of all cameras."""
        for part in self._parts:
            part.camera.close()

    def __iter__(self) -> Iterator[Frame]:
        for part in self._parts:
            threading.Thread(target=self._read, args=(part,), name=f"rig-{part.name}", daemon=True).start()
        last = (-float("inf"), 0)
        try:
            self._await_first_frames()
            while (released := self._next()) is not None:
                number, frame = released
                if (frame.stamp, number) > last:
                    last = frame.stamp, number
                    yield frame
                else:
                    self._late += 1
        finally:
            self.close()

    def _await_first_frames(self) -> None:
        """Wait until every camera has delivered a frame.

        Raises:
            DeviceError: a camera has delivered none, or is gone.
        """
        with self._changed:
            self._changed.wait_for(lambda: all(part.waiting or part.ended for part in self._parts), _FIRST_S)
            for part in self._parts:
                if not part.waiting:
                    if part.failure is not None:
                        raise part.failure
                    hint = "check its cable and power, or remove it from the file"
                    raise DeviceError("delivers no frame.", file=part.camera.uri, field="camera", hint=hint)

    def _next(self) -> tuple[int, Frame] | None:
        """Wait for the next frame in the order of stamps, with the number of its camera; None at the end.

        Raises:
            DeviceError: a camera is gone, and the frames up to then were returned.
        """
        with self._changed:
            while True:
                ready = [(p.waiting[0][1].stamp, k, p.waiting[0][0]) for k, p in enumerate(self._parts) if p.waiting]
                silent = [part for part in self._parts if not (part.waiting or part.ended)]
                if not ready and not silent:
                    for part in self._parts:
                        if part.failure is not None:
                            raise part.failure
                    return None
                wait = None
                if ready:
                    _, number, arrived = min(ready)
                    wait = arrived + _WAIT_S - time.monotonic()
                    if not silent or wait <= 0:
                        return number, self._parts[number].waiting.popleft()[1]
                self._changed.wait(wait)

    def _read(self, part: _Part) -> None:
        """Collect the frames of one camera; the oldest is dropped when there are too many."""
        try:
            for frame in part.camera:
                named = replace(frame.shifted(part.time_offset), camera_name=part.name)
                with self._changed:
                    if len(part.waiting) == _WAITING:
                        part.waiting.popleft()
                        self._late += 1
                    part.waiting.append((time.monotonic(), named))
                    self._changed.notify_all()
        except Exception as error:  # raised again in the reader
            part.failure = error
            self.close()
        finally:
            with self._changed:
                part.ended = True
                self._changed.notify_all()
