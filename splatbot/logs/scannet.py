"""ScanNet's .sens recordings, version 4 (ScanNet, SensReader): one file of compressed frames without an index."""

from __future__ import annotations

import logging
import os
import struct
import zlib
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, LogError
from splatbot.frame import Frame
from splatbot.logs.base import StampedLog
from splatbot.logs.calibration import Calibration
from splatbot.logs.image_folder import scannet_camera, scannet_transform
from splatbot.logs.image_size import image_size
from splatbot.logs.images import decode_color, depth_in_metres
from splatbot.logs.pairs import RATE
from splatbot.logs.poses import reference, rigid_pose
from splatbot.logs.registration import ColorRegistration
from splatbot.logs.rgbd import ReaderLog, RgbdReader
from splatbot.trajectory import Trajectory

_VERSION = 4
_RAW_COLOR, _PNG, _JPEG = 0, 1, 2
_RAW_DEPTH, _ZLIB = 0, 1
_NO_DEPTH = 65_535
_MAX_NAME = 2**16  # bytes of the name of the sensor
_MAX_FRAMES = 2**20
_AGAIN = "copy or download the recording again"

_START = struct.Struct("<IQ")  # version, length of the name
_CAMERAS = struct.Struct("<64f")  # intrinsic and extrinsic of colour, then of depth
_IMAGES = struct.Struct("<iiIIIIfQ")  # compressions, sizes, units per metre, number of frames
_FRAME = struct.Struct("<16fQQQQ")  # T_world_camera, stamps [us] and bytes of colour and depth

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _FramePlace:
    """Place of one frame in the file."""

    T_world_camera: NDArray[np.float64] | None
    microseconds: int
    at: int
    color_bytes: int
    depth_bytes: int


class ScanNetLog(ReaderLog, StampedLog):
    """A .sens file; opening reads the headers of the frames alone.

    Frames are those of the depth camera, with colour resampled at its pixels. Stamps are those of colour; if these do
    not increase, frame n has the stamp n / 30 s. A file that is cut off keeps the whole frames before the cut. The
    number of the others is ``lost``, and is logged.

    Args:
        path: the file.

    Raises:
        LogError: the header is damaged, the version or a compression is not supported, or no frame is whole.
        CameraError: the intrinsics are not usable.
    """

    def __init__(self, path: str | Path) -> None:
        self.path, self.uri = Path(path), str(path)
        self.name = self.path.stem
        try:
            size = self.path.stat().st_size
            with self.path.open("rb") as file:
                count = self._read_header(file)
                self._entries = _scan(file, min(count, _MAX_FRAMES), size)
        except OSError as error:
            raise self._bad("file", f"cannot be read ({error.strerror})", "check the path") from error
        if not self._entries:
            raise self._bad("frames", f"the log is empty: none of {count} frames is whole", _AGAIN)
        self.lost = count - len(self._entries)
        if self.lost:
            _log.warning("%s: is cut off; the last %d of %d frames are missing", self.uri, self.lost, count)
        self.stamps = self._stamps()

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """Poses T_world_camera of the file; frames whose pose is not finite or not rigid lack one."""
        return reference(self.stamps, (entry.T_world_camera for entry in self._entries))

    def _read_header(self, file: BinaryIO) -> int:
        """Read cameras, sizes and compressions; returns the number of frames that the file announces."""
        version, name_bytes = _START.unpack(self._bytes(file, _START.size))
        if version != _VERSION:
            hint = "convert it with ScanNet's SensReader, or download it again"
            raise self._bad("version", f"is {version}, supported is {_VERSION}", hint)
        if name_bytes > _MAX_NAME:
            raise self._bad("sensor name", f"has {name_bytes} bytes", _AGAIN)
        self._bytes(file, name_bytes)
        matrices = np.array(_CAMERAS.unpack(self._bytes(file, _CAMERAS.size))).reshape(4, 4, 4)
        *values, scale, count = _IMAGES.unpack(self._bytes(file, _IMAGES.size))
        self._color_kind, self._depth_kind, *sizes = values
        if self._color_kind not in (_RAW_COLOR, _PNG, _JPEG) or self._depth_kind not in (_RAW_DEPTH, _ZLIB):
            kinds = f"is {self._color_kind} (colour), {self._depth_kind} (depth)"
            hint = "supported are raw, PNG and JPEG colour (0, 1, 2), raw and zlib depth (0, 1); export it as images"
            raise self._bad("compression", kinds, hint)
        color = scannet_camera(self.path, matrices[0], (sizes[0], sizes[1]))
        depth = scannet_camera(self.path, matrices[2], (sizes[2], sizes[3]))
        self._register(color, depth, scannet_transform(self.path, matrices[1], matrices[3]))
        self._reader = RgbdReader(Calibration(depth, scale, self.uri))
        return int(count)

    def _register(self, color: Camera, depth: Camera, T_color_depth: NDArray[np.float64]) -> None:
        try:
            self._registration = ColorRegistration(color, depth, T_color_depth)
        except CameraError as error:
            raise CameraError(error.message, file=self.path, field=error.field, hint=error.hint) from error

    def _bytes(self, file: BinaryIO, size: int) -> bytes:
        data = file.read(size)
        if len(data) < size:
            raise self._bad("header", "is cut off", _AGAIN)
        return data

    def _stamps(self) -> list[float]:
        stamps = [entry.microseconds / 1e6 for entry in self._entries]
        if all(a < b for a, b in pairwise(stamps)):
            return stamps
        if any(stamps):
            _log.warning("%s: stamps do not increase; frames are taken at %g per second", self.uri, RATE)
        return [index / RATE for index in range(len(stamps))]

    def _decode(self, index: int) -> Frame:
        entry, source = self._entries[index], Path(f"{self.uri} (frame {index})")
        try:
            with self.path.open("rb") as file:
                file.seek(entry.at)
                color, depth = file.read(entry.color_bytes), file.read(entry.depth_bytes)
        except OSError as error:
            raise LogError(f"cannot be read ({error.strerror}).", file=source, field="file", hint=_AGAIN) from error
        z = depth_in_metres(self._depth(depth, source), self.calibration.depth_scale, source, void=_NO_DEPTH)
        rgb, z = self._registration.register(self._color(color, source), z, source)
        return self._reader.frame(index, self.stamps[index], rgb, z, source, source)

    def _color(self, data: bytes, source: Path) -> NDArray[np.uint8]:
        width, height = self._registration.color_size
        if self._color_kind != _RAW_COLOR:
            if image_size(data) != (width, height):  # before OpenCV allocates it
                raise LogError(f"is no image of {width}x{height}.", file=source, field="colour", hint=_AGAIN)
            return decode_color(data, source)
        if len(data) != 3 * width * height:
            raise LogError(f"has {len(data)} bytes for {width}x{height}.", file=source, field="colour", hint=_AGAIN)
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)

    def _depth(self, data: bytes, source: Path) -> NDArray[np.uint16]:
        width, height = self._registration.depth_size
        size = 2 * width * height
        if self._depth_kind == _ZLIB:
            try:
                data = zlib.decompressobj().decompress(data, size + 1)
            except zlib.error as error:
                raise LogError(f"is damaged ({error}).", file=source, field="depth", hint=_AGAIN) from error
        if len(data) != size:
            raise LogError(f"has not the {size} bytes of {width}x{height}.", file=source, field="depth", hint=_AGAIN)
        return np.frombuffer(data, "<u2").reshape(height, width)

    def _bad(self, field: str, problem: str, hint: str) -> LogError:
        return LogError(f"{problem}.", file=self.path, field=field, hint=hint)


def _scan(file: BinaryIO, count: int, size: int) -> list[_FramePlace]:
    """Return the places of the whole frames from the current position of a file of a size [bytes]."""
    entries: list[_FramePlace] = []
    while len(entries) < count:
        head = file.read(_FRAME.size)
        if len(head) < _FRAME.size:
            break
        *matrix, microseconds, _, color_bytes, depth_bytes = _FRAME.unpack(head)
        at = file.tell()
        if at + color_bytes + depth_bytes > size:
            break
        pose = rigid_pose(np.array(matrix).reshape(4, 4))
        entries.append(_FramePlace(pose, microseconds, at, color_bytes, depth_bytes))
        file.seek(color_bytes + depth_bytes, os.SEEK_CUR)
    return entries
