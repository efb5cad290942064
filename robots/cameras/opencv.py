"""Depth cameras that OpenCV's VideoCapture reads: through OpenNI2, or through its own driver of Orbbec cameras."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np

from splatbot.errors import CameraError, InputError
from splatbot.frame import Frame
from splatbot.layouts import OPENCV as PREFIX
from splatbot.logs.calibration import Calibration
from splatbot.logs.presets import find_calibration
from splatbot.robots.cameras.device import CONSTANTS as DEVICE
from splatbot.robots.cameras.device import ImageLens, RgbdDevice
from splatbot.robots.cameras.stream_options import StreamOptions

BACKENDS = {
    "openni2": (cv2.CAP_OPENNI2, cv2.CAP_OPENNI_BGR_IMAGE, cv2.CAP_OPENNI_DEPTH_MAP),
    "obsensor": (cv2.CAP_OBSENSOR, cv2.CAP_OBSENSOR_BGR_IMAGE, cv2.CAP_OBSENSOR_DEPTH_MAP),
}
"""Number of each backend of OpenCV, and its channels of colour and of depth."""

OpenCapture = Callable[[int | str, int], Any]
"""Opens the `cv2.VideoCapture` of an index or a URL by a backend."""


class OpenCvCamera(RgbdDevice):
    """A depth camera of OpenCV as a source of frames; each iteration opens the device.

    OpenCV has no stamps of exposures and no numbers of images: stamps are Unix time when the images have arrived, and
    ``dropped`` stays 0.

    Args:
        place: index of the camera, or a URL.
        calibration: intrinsics of both images, and the unit of depth; OpenCV gives a focal length alone.
        backend: a key of :data:`BACKENDS`.
        open_capture: opens the device. If None, OpenCV does.

    Raises:
        DeviceError: when iterating: OpenCV lacks the backend, there is no device, or it is gone.
    """

    def __init__(
        self,
        place: str,
        calibration: Calibration,
        backend: str = "openni2",
        *,
        open_capture: OpenCapture | None = None,
    ) -> None:
        camera = calibration.camera
        super().__init__(PREFIX, place, StreamOptions(camera.width, camera.height))
        self.name = f"opencv-{backend}"
        self._calibration, self._backend, self._open = calibration, backend, open_capture or cv2.VideoCapture

    @classmethod
    def from_uri(cls, uri: str) -> OpenCvCamera:
        """Return the camera of `opencv://INDEX_OR_URL?camera=FILE&backend=openni2`.

        Raises:
            InputError: an option is unknown, or the camera file is missing.
            CameraError: the camera file is damaged.
        """
        place, _, query = uri.removeprefix(PREFIX).rpartition("?")
        options = dict(pair.partition("=")[::2] for pair in query.split("&") if pair)
        backend = options.get("backend", "openni2")
        if not place or not options.get("camera") or options.keys() - {"camera", "backend"} or backend not in BACKENDS:
            names = " or ".join(BACKENDS)
            hint = f"write {PREFIX}0?camera=camera.json, and &backend={names} (docs/guide/cameras.md)"
            raise InputError("names no camera with its camera file.", file=uri, field="camera", hint=hint)
        return cls(place, find_calibration(options["camera"]), backend)

    def __iter__(self) -> Iterator[Frame]:
        if self._closed.is_set():
            return
        number, color, depth = BACKENDS[self._backend]
        capture = self._open(int(self._serial) if self._serial.isdecimal() else self._serial, number)
        try:
            if not capture.isOpened():
                hint = "check its cable, and that this OpenCV has the backend: cv2.getBuildInformation()"
                raise self._cannot_be_opened(RuntimeError(f"OpenCV's {self._backend} finds no camera"), hint)
            if self._backend == "openni2":
                capture.set(cv2.CAP_PROP_OPENNI_REGISTRATION, 1)

            def wait() -> Any:
                if not capture.isOpened():
                    raise RuntimeError("OpenCV closed it")
                if not capture.grab():
                    time.sleep(DEVICE.poll_s)
                    return None
                stamp = time.time()
                (has_color, bgr), (has_depth, units) = capture.retrieve(None, color), capture.retrieve(None, depth)
                return (stamp, bgr, units) if has_color and has_depth else None

            for stamp, bgr, units in self._pairs(wait, lambda _: 0):
                yield self._frame(stamp, bgr, units)
        finally:
            capture.release()

    def _frame(self, stamp: float, bgr: Any, units: Any) -> Frame:
        """Convert a pair of images.

        Raises:
            DeviceError: depth is not 16-bit.
            CameraError: the images are not of the size of the camera file.
        """
        camera, scale = self._calibration.camera, self._calibration.depth_scale
        if units.dtype != np.uint16 or bgr.dtype != np.uint8:
            raise self._wrong(f"colour is {bgr.dtype}, depth is {units.dtype}")
        size = (camera.height, camera.width)
        if bgr.shape != (*size, 3) or units.shape != size:
            raise CameraError(
                f"is for {camera.width}x{camera.height}, colour is {bgr.shape}, depth {units.shape} (rows, columns).",
                file=self._calibration.file,
                field="width, height",
                hint="give the camera file of these images",
            )
        rgb, metres = np.ascontiguousarray(bgr[..., ::-1]), units.astype(np.float32) / np.float32(scale)
        return self._next_frame(stamp, rgb, metres, (ImageLens(camera), ImageLens(camera)), 0.0)
