"""Base of drivers of RGB-D devices: waiting for pairs of images, lost frames, lenses, and the loss of the device."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from numpy import float32, uint8
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, DeviceError
from splatbot.frame import Frame
from splatbot.logs.undistort import SourcePixels, Undistorter, check_lens
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

_RECTIFY = "publish rectified images with its ROS driver (docs/guide/ros.md)"


@dataclass(frozen=True)
class ImageLens:
    """The lens through which an image of a device is seen.

    Args:
        camera: camera of the image, without distortion if the device or its library has removed it.
        source: lens model; None for those of OpenCV.
    """

    camera: Camera
    source: SourcePixels | None = None


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
        self._undistorters: dict[ImageLens, Undistorter] = {}

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
        self,
        stamp: float,
        rgb: NDArray[uint8],
        depth: NDArray[float32],
        lenses: tuple[ImageLens, ImageLens],
        depth_delay: float,
    ) -> Frame:
        """Return the next frame, with the distortion of both images removed.

        Args:
            stamp: [s].
            rgb: (H, W, 3).
            depth: (H, W) [m], at the undistorted pixels of colour once its own distortion is removed.
            lenses: of colour and of depth. The libraries of some devices align depth to colour without its distortion.
            depth_delay: [s].
        """
        color_lens, depth_lens = lenses
        if self._undistorters.keys() - lenses:
            self._undistorters.clear()  # the device has changed its images
        if color_lens.camera.distortion:
            rgb = self._undistorter(color_lens).color(rgb)
        if depth_lens.camera.distortion:
            depth = self._undistorter(depth_lens).depth(depth)
        number, self._number = self._number, self._number + 1
        source = f"{self.uri} frame {number}"
        return Frame(stamp, rgb, depth, color_lens.camera.pinhole, number, source=source, depth_delay=depth_delay)

    def _undistorter(self, lens: ImageLens) -> Undistorter:
        if lens not in self._undistorters:
            self._undistorters[lens] = Undistorter(lens.camera, lens.source)
        return self._undistorters[lens]

    def _camera(
        self, *intrinsics: float, size: tuple[int, int], distortion: tuple[float, ...], fisheye: bool = False
    ) -> Camera:
        """Return the camera with fx, fy, cx, cy [px]; coefficients that are all 0 are no distortion.

        Raises:
            DeviceError: they cannot be those of a camera, or a pinhole image cannot show most of its view.
        """
        fx, fy, cx, cy = (float(value) for value in intrinsics)
        try:
            camera = Camera(fx, fy, cx, cy, *size)
            camera.check_plausible()
        except CameraError as error:
            raise self._wrong(f"{error.field} {error.message.rstrip('.')}") from error
        if not any(distortion):
            return camera
        try:
            distorted = replace(camera, distortion=distortion, fisheye=fisheye)
            check_lens(distorted)
        except CameraError as error:
            hint = f"calibrate it with the tool of its maker, or {_RECTIFY}"
            raise DeviceError(f"has a lens that {error.message}", file=self.uri, field="camera", hint=hint) from error
        return distorted

    def _unknown_lens(self, model: str, image: str = "colour") -> DeviceError:
        problem = f"has {image} with a lens of the model {model}, which is not rectified here."
        return DeviceError(problem, file=self.uri, field="camera", hint=_RECTIFY)

    def _cannot_be_opened(self, error: Exception, hint: str) -> DeviceError:
        return DeviceError(f"cannot be opened ({error}).", file=self.uri, field="camera", hint=hint)

    def _gone(self, reason: str) -> DeviceError:
        return DeviceError(f"is gone ({reason}).", file=self.uri, field="camera", hint="check its cable and power")

    def _wrong(self, reason: str) -> DeviceError:
        hint = "update its firmware and library, or check the device with the viewer of its maker"
        return DeviceError(f"delivers unexpected images: {reason}.", file=self.uri, field="camera", hint=hint)
