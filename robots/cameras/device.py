"""Base of drivers of RGB-D devices: waiting for pairs of images, lost frames, lenses, and the loss of the device."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from numpy import float32, uint8
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, DeviceError
from splatbot.frame import Frame
from splatbot.logs.undistort import Undistorter
from splatbot.robots.cameras.stream_options import StreamOptions


@dataclass(frozen=True)
class RgbdDeviceConstants:
    """Constants of drivers.

    Args:
        silence_s: [s] time without a pair of images after which the device counts as gone.
        poll_s: [s] time between two looks at whether the camera was closed.
    """

    silence_s: float = 10.0
    poll_s: float = 0.2


CONSTANTS = RgbdDeviceConstants()


class RgbdDevice:
    """The common part of drivers; a subclass opens the device in each iteration.

    Attributes:
        dropped: images of colour without a pair here: a slow reader or the transfer lost them.

    Args:
        prefix: kind of the address, as "oak://".
        serial: of the device; empty takes the first one.
        options: requested streams.
    """

    def __init__(self, prefix: str, serial: str, options: StreamOptions) -> None:
        self.uri = prefix + serial
        self.name = prefix.removesuffix("://") + (f"-{serial}" if serial else "")
        self.options = options
        self.dropped = 0
        self._serial = serial
        self._closed = threading.Event()
        self._number = 0  # of the next frame
        self._lens: tuple[Camera, Undistorter] | None = None

    def close(self) -> None:
        """End the stream."""
        self._closed.set()

    def _pairs(self, wait: Callable[[], Any], number_of: Callable[[Any], int]) -> Iterator[Any]:
        """Yield pairs of images until the camera is closed, and count the images that were lost between them.

        Args:
            wait: returns the next pair, or None after ``poll_s`` without one; a RuntimeError is the loss of the device.
            number_of: returns the number that the device gave to the colour of a pair.

        Raises:
            DeviceError: the device is gone or silent.
        """
        heard, last = time.monotonic(), None
        while not self._closed.is_set():
            try:
                pair = wait()
            except RuntimeError as error:
                raise self._gone(str(error)) from error
            if pair is not None:
                heard, number = time.monotonic(), number_of(pair)
                self.dropped += 0 if last is None else max(number - last - 1, 0)
                last = number
                yield pair
            elif time.monotonic() - heard > CONSTANTS.silence_s:
                raise self._gone(f"no pair of colour and depth for {CONSTANTS.silence_s:g} s")

    def _next_frame(
        self, stamp: float, rgb: NDArray[uint8], depth: NDArray[float32], camera: Camera, depth_delay: float
    ) -> Frame:
        """Return the next frame, with the distortion of its camera removed."""
        if camera.distortion:
            if self._lens is None or self._lens[0] != camera:
                self._lens = camera, Undistorter(camera)
            undistorter = self._lens[1]
            rgb, depth, camera = undistorter.color(rgb), undistorter.depth(depth), undistorter.camera
        number, self._number = self._number, self._number + 1
        source = f"{self.uri} frame {number}"
        return Frame(stamp, rgb, depth, camera, number, source=source, depth_delay=depth_delay)

    def _camera(self, *intrinsics: float, size: tuple[int, int], distortion: tuple[float, ...]) -> Camera:
        """Return the camera with fx, fy, cx, cy [px].

        Raises:
            DeviceError: they cannot be those of a camera.
        """
        fx, fy, cx, cy = (float(value) for value in intrinsics)
        try:
            camera = Camera(fx, fy, cx, cy, *size, distortion if any(distortion) else ())
            camera.check_plausible()
        except CameraError as error:
            raise self._wrong(f"{error.field} {error.message.rstrip('.')}") from error
        return camera

    def _cannot_be_opened(self, error: Exception, hint: str) -> DeviceError:
        return DeviceError(f"cannot be opened ({error}).", file=self.uri, field="camera", hint=hint)

    def _gone(self, reason: str) -> DeviceError:
        return DeviceError(f"is gone ({reason}).", file=self.uri, field="camera", hint="check its cable and power")

    def _wrong(self, reason: str) -> DeviceError:
        hint = "update its firmware and library, or check the device with the viewer of its maker"
        return DeviceError(f"delivers unexpected images: {reason}.", file=self.uri, field="camera", hint=hint)
