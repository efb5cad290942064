"""A simulated video of a twin (MP4)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2

from splatbot.errors import InputError
from splatbot.sim.camera import TwinCamera

FPS = 25.0


class Video:
    """Writes the view of the twin's camera at 25 frames per second.

    A frame that the sensor drops repeats the previous one.

    Raises:
        InputError: the file cannot be written.
    """

    def __init__(self, path: Path, camera: TwinCamera) -> None:
        self._camera = camera
        size = (camera.camera.width, camera.camera.height)
        self._file = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), FPS, size)
        if not self._file.isOpened():
            raise InputError("cannot be written.", file=path, field="--video", hint="name a .mp4 in an existing folder")
        self._last: Any = None
        self.frames = 0

    def __call__(self, data: Any, time: float) -> None:
        """Write a frame if the next one is due."""
        if time * FPS < self.frames:
            return
        frame = self._camera.frame(data, self.frames, time)
        self._last = frame.rgb[..., ::-1].copy() if frame is not None else self._last
        if self._last is not None:
            self._file.write(self._last)
        self.frames += 1

    def report(self) -> list[dict[str, Any]]:
        """Return the report of the sensor's effects."""
        return self._camera.report()

    def close(self) -> None:
        """Close the file."""
        self._file.release()
        self._camera.close()
