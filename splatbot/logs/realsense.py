"""Recordings of librealsense and realsense-viewer."""

from __future__ import annotations

import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, InputError, LogError
from splatbot.frame import Frame
from splatbot.geometry import inverse, nearest_rotation
from splatbot.logs.base import StampedLog
from splatbot.logs.index import associate
from splatbot.logs.realsense_files import BagFile, Images, RealSenseFile, SqliteFile
from splatbot.logs.registration import ColorRegistration
from splatbot.logs.ros_frames import camera_of, color_of, depth_of
from splatbot.logs.undistort import Undistorter, modified_source_pixels
from splatbot.protocols import Array

_PAIR_WITHIN_S = 0.04  # depth and colour of one device run at rates of their own, often 30 Hz without a common trigger
_MODELS = {
    "": "plumb_bob",
    "None": "plumb_bob",
    "Brown Conrady": "plumb_bob",
    "Modified Brown Conrady": "plumb_bob",
    "Inverse Brown Conrady": "plumb_bob",
    "Kannala Brandt4": "equidistant",
}
"""Models of librealsense in ROS, whose coefficients are OpenCV's."""
_MODIFIED = ("Modified Brown Conrady", "Inverse Brown Conrady")  # with other tangential terms than OpenCV's
_ROS_UNITS = 1e-3  # [m] that the decoder of ROS images assumes

_log = logging.getLogger(__name__)


class RealSenseLog(StampedLog):
    """A `.db3` or `.bag` file of librealsense's recorder, with colour resampled at the depth pixels.

    Frames are the depth images with the colour image nearest in time, up to 0.04 s away. Stamps are those of the
    frames' timestamps: Unix time, or the clock of the device if the recording has hardware timestamps.

    Args:
        path: the file.

    Raises:
        LogError: the file is damaged, or has no stream of depth or colour.
        CameraError: the intrinsics are not usable.
    """

    def __init__(self, path: str | Path) -> None:
        self.path, self.uri = Path(path), str(path)
        self.name = self.path.stem
        if not self.path.exists():
            raise LogError("does not exist.", file=self.path, field="log", hint="check the path")
        self._file: RealSenseFile = (SqliteFile if self.path.suffix.lower() == ".db3" else BagFile)(self.path)
        self._color, self._depth = self._stream("Color"), self._stream("Depth")
        units = self._file.depth_units(self._depth)
        if units is not None and not 1e-6 <= units <= 1.0:
            raise self._bad("depth units", f"is {units}", "give metres per unit, as 0.001")
        self._units = _ROS_UNITS if units is None else units
        self._lenses: dict[str, Undistorter] = {}
        color, self.camera = (self._undistorted(stream) for stream in (self._color, self._depth))
        T_color_depth = self._rigid(self._color) @ inverse(self._rigid(self._depth))
        unseen = self._lenses[self._color].unseen if self._color in self._lenses else None
        try:
            self._registration = ColorRegistration(color, self.camera, T_color_depth, unseen=unseen)
        except CameraError as error:
            raise CameraError(error.message, file=self.path, field=error.field, hint=error.hint) from error
        self._pair(self._file.images(self._color), self._file.images(self._depth))

    @property
    def ground_truth(self) -> None:
        """Return None, since a recording of a camera has no reference."""
        return

    def _pair(self, colors: Images, depths: Images) -> None:
        """Pair the images by their stamps; of images with one stamp, the first counts."""
        (a, places_a), (b, places_b) = (_distinct(images) for images in (colors, depths))
        pairs = associate(a, b, _PAIR_WITHIN_S)
        if not pairs:
            hint = "record both streams of one device"
            raise self._bad("stamps", f"{len(a)} images of colour and {len(b)} of depth are not of one time", hint)
        if len(pairs) < max(len(a), len(b)):
            _log.warning("%s: %d of %d depth images have a colour image", self.uri, len(pairs), len(b))
        self._places = [(places_a[i], places_b[j]) for i, j in pairs]
        self._delays = [float(b[j] - a[i]) for i, j in pairs]
        self.stamps = [float(a[i]) for i, _ in pairs]

    def _decode(self, index: int) -> Frame:
        where = f"{self.uri} (frame {index})"
        color, depth = self._places[index]
        try:
            rgb = color_of(self._file.image(self._color, color))
            z = depth_of(self._file.image(self._depth, depth)) * np.float32(self._units / _ROS_UNITS)
        except LogError:
            raise
        except InputError as error:
            raise LogError(error.message, file=where, field=error.field, hint=error.hint) from error
        if self._color in self._lenses:
            rgb = self._lenses[self._color].color(rgb)
        if self._depth in self._lenses:
            z = self._lenses[self._depth].depth(z)
        rgb, z = self._registration.register(rgb, z, where)
        delay = self._delays[index]
        return Frame(self.stamps[index], rgb, z, self.camera, index, source=where, depth_delay=delay)

    def _stream(self, kind: str) -> str:
        found = [stream for stream in self._file.streams() if stream.rpartition("/")[2] == f"{kind}_0"]
        if not found:
            names = ", ".join(stream.rpartition("/")[2] for stream in self._file.streams()) or "no images"
            raise self._bad(kind.lower(), f"is not recorded (streams: {names})", "record depth and colour")
        return found[0]

    def _undistorted(self, stream: str) -> Camera:
        """Return the pinhole camera of a stream, and keep its lens if it has one."""
        info = self._file.camera_info(stream)
        model = info.distortion_model
        k, d = (getattr(info, name, getattr(info, name.upper(), ())) for name in ("k", "d"))  # of ROS 2 or ROS 1
        count = {"None": 0, "Kannala Brandt4": 4}.get(model, len(d))
        size = {"width": info.width, "height": info.height}
        try:
            camera = camera_of(SimpleNamespace(k=k, d=d[:count], distortion_model=_MODELS.get(model, model), **size))
            if camera.distortion:
                self._lenses[stream] = Undistorter(camera, modified_source_pixels if model in _MODIFIED else None)
        except CameraError as error:
            field = f"{stream} {error.field}"
            raise CameraError(error.message, file=self.path, field=field, hint=error.hint) from error
        return camera.pinhole

    def _rigid(self, stream: str) -> Array:
        T = self._file.extrinsics(stream)
        if not np.isfinite(T).all() or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3:
            raise self._bad(f"{stream} extrinsics", "are no rigid transform", "record it again")
        T[:3, :3] = nearest_rotation(T[:3, :3])  # they have six decimals
        return T

    def _bad(self, field: str, problem: str, hint: str) -> LogError:
        return LogError(f"{problem}.", file=self.path, field=field, hint=hint)


def _distinct(images: Images) -> tuple[NDArray[np.float64], list[object]]:
    """Return increasing stamps (N,) [s] and the places of their images."""
    first: dict[float, object] = {}
    for stamp, place in zip(images.stamps, images.places, strict=True):
        if np.isfinite(stamp):
            first.setdefault(stamp, place)
    stamps = sorted(first)
    return np.array(stamps), [first[stamp] for stamp in stamps]
