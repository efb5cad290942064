"""Record3D's .r3d recordings of ARKit: a ZIP file of JPEG colour and LZFSE depth (Record3D, sharing formats)."""

from __future__ import annotations

import json
import lzma
import re
import struct
import zipfile
import zlib
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, LogError
from splatbot.frame import Frame
from splatbot.geometry import pose_from_quat
from splatbot.logs.base import MILLIMETRES, StampedLog
from splatbot.logs.calibration import Calibration, number
from splatbot.logs.image_size import image_size
from splatbot.logs.images import decode_color, depth_in_metres
from splatbot.logs.lzfse import decompress, raw_size, require_lzfse
from splatbot.logs.poses import reference, rigid_pose
from splatbot.logs.registration import ColorRegistration
from splatbot.logs.rgbd import ReaderLog, RgbdReader
from splatbot.trajectory import Trajectory

_METADATA = "metadata"
_MAX_METADATA = 2**26  # bytes
_SPARE = 2**16  # bytes that a compressed image may be larger than its pixels
_DEPTH_SIZES = (
    (192, 256),
    (256, 192),
    (480, 640),
    (640, 480),
    (720, 960),
    (960, 720),
)  # of LiDAR and of the front camera, where metadata lack dw, dh
_FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])  # ARKit: y up, z backwards
_DAMAGED = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error)
_AGAIN = "share the recording again from Record3D"


class Record3dLog(ReaderLog, StampedLog):
    """A .r3d file; frames are those of its depth image, with colour resampled at its pixels.

    Depth of confidence 0 is missing. Stamps are `frameTimestamps` where these increase, else frame n has n / fps
    seconds. Intrinsics of single frames (`perFrameIntrinsicCoeffs`) are resampled to those of `K`.

    Args:
        path: the file.

    Raises:
        LogError: the file is damaged or empty, or the package pyliblzfse is missing.
        CameraError: the intrinsics are not usable.
    """

    def __init__(self, path: str | Path) -> None:
        self.path, self.uri = Path(path), str(path)
        self.name = self.path.stem
        require_lzfse(self.path)
        try:
            self._zip = zipfile.ZipFile(self.path)
        except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError) as error:
            raise self._bad("file", f"is no ZIP file that can be read ({error})", _AGAIN) from error
        self._values = self._read_metadata()
        colors, depths = self._numbers("jpg"), self._numbers("depth")
        self._frames = sorted(colors & depths)
        self.unpaired = len(colors ^ depths)
        if not self._frames:
            raise self._bad("rgbd", "the log is empty: no frame has colour and depth", _AGAIN)
        self._poses, self._coefficients = self._rows("poses", 7), self._rows("perFrameIntrinsicCoeffs", 4)
        self._color = self._camera(self._values.get("K"))
        depth = self._color.resized(*self._depth_size())
        self._registration = self._register(self._color, depth)
        self._reader = RgbdReader(Calibration(depth, MILLIMETRES, self.uri))
        self.stamps = self._stamps()

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """Poses T_world_camera of ARKit, in camera axes of OpenCV."""
        return reference(self.stamps, (self._pose(n) for n in self._frames))

    def _read_metadata(self) -> dict[str, Any]:
        try:
            values = json.loads(self._entry(_METADATA, _MAX_METADATA, self.path))
        except (ValueError, RecursionError) as error:
            raise self._bad(_METADATA, f"is not JSON ({error})", _AGAIN) from error
        if not isinstance(values, dict):
            raise self._bad(_METADATA, "is no JSON object", _AGAIN)
        return values

    def _numbers(self, suffix: str) -> set[int]:
        pattern = re.compile(rf"rgbd/(0|[1-9]\d{{0,8}})\.{suffix}", re.ASCII)
        return {int(match[1]) for match in map(pattern.fullmatch, self._zip.namelist()) if match}

    def _rows(self, key: str, size: int) -> NDArray[np.float64]:
        """Return a list of the metadata as (N, size); N is 0 without it, and values that are no numbers are NaN."""
        rows = self._values.get(key) or []
        try:
            return np.array(rows, dtype=np.float64).reshape(len(rows), size)
        except (TypeError, ValueError, OverflowError) as error:
            raise self._bad(key, f"is no list of rows of {size} numbers", _AGAIN) from error

    def _camera(self, matrix: Any) -> Camera:
        if not isinstance(matrix, list) or len(matrix) != 9:
            raise self._bad("K", "is no list of 9 numbers", _AGAIN)
        named = {"fx": matrix[0], "fy": matrix[4], "cx": matrix[6], "cy": matrix[7]}
        values = {**self._values, **named}
        fx, fy, cx, cy, width, height = (number(self.path, values, key) for key in (*named, "w", "h"))
        return self._checked(fx, fy, cx, cy, width, height)

    def _checked(self, fx: float, fy: float, cx: float, cy: float, width: float, height: float) -> Camera:
        try:
            return Camera(fx, fy, cx, cy, int(width), int(height))
        except (CameraError, ValueError, OverflowError) as error:
            message = error.message if isinstance(error, CameraError) else f"is no size ({error})."
            raise CameraError(message, file=self.path, field="K, w, h", hint=_AGAIN) from error

    def _depth_size(self) -> tuple[int, int]:
        if "dw" in self._values:
            width, height = (number(self.path, self._values, key) for key in ("dw", "dh"))
            if not (1 <= width < 2**15 and 1 <= height < 2**15):
                raise self._bad("dw, dh", f"are {width:g}, {height:g}", _AGAIN)
            return int(width), int(height)
        first = self._entry(
            f"rgbd/{self._frames[0]}.depth", max(4 * w * h for w, h in _DEPTH_SIZES) + _SPARE, self.path
        )
        upright = self._color.width <= self._color.height
        for width, height in _DEPTH_SIZES:
            if raw_size(first) == 4 * width * height and upright == (width <= height):
                return width, height
        raise self._bad("dw, dh", "are missing, and the first depth image has no known size", _AGAIN)

    def _register(self, color: Camera, depth: Camera) -> ColorRegistration:
        try:
            return ColorRegistration(color, depth)
        except CameraError as error:
            raise CameraError(error.message, file=self.path, field="w, h, dw, dh", hint=_AGAIN) from error

    def _stamps(self) -> list[float]:
        given = self._values.get("frameTimestamps")
        if isinstance(given, list) and len(given) > self._frames[-1]:
            stamps = [given[n] for n in self._frames]
            if all(isinstance(t, int | float) and abs(t) < 1e12 for t in stamps) and (np.diff(stamps) > 0).all():
                return [float(t) for t in stamps]
        rate = number(self.path, self._values, "fps")
        if not 1e-3 < rate < 1e6:
            raise self._bad("fps", f"is {rate:g}", _AGAIN)
        return [n / rate for n in self._frames]

    def _pose(self, frame: int) -> NDArray[np.float64] | None:
        if frame >= len(self._poses):
            return None
        x, y, z, w, *translation = self._poses[frame]
        try:
            return rigid_pose(pose_from_quat(translation, [w, x, y, z]) @ _FLIP_YZ)
        except ValueError:  # a quaternion of zeros or NaN
            return None

    def _decode(self, index: int) -> Frame:
        frame = self._frames[index]
        color, depth = (Path(f"{self.uri} (rgbd/{frame}.{suffix})") for suffix in ("jpg", "depth"))
        width, height = self._registration.color_size
        data = self._entry(f"rgbd/{frame}.jpg", 3 * width * height + _SPARE, color)
        if image_size(data) != (width, height):  # before OpenCV allocates it
            raise LogError(f"is no image of {width}x{height}.", file=color, field="colour", hint=_AGAIN)
        z = depth_in_metres(self._depth(frame, depth), MILLIMETRES, depth)
        rgb, z = self._aligned(frame, decode_color(data, color), z, color)
        return self._reader.frame(index, self.stamps[index], rgb, z, color, depth)

    def _depth(self, frame: int, source: Path) -> NDArray[np.float32]:
        """Return depth (H, W) [m] of a frame, 0 where its confidence is 0."""
        z = self._unpacked(f"rgbd/{frame}.depth", np.dtype("<f4"), source)
        name = f"rgbd/{frame}.conf"
        if name in self._zip.NameToInfo:
            z = np.where(self._unpacked(name, np.dtype(np.uint8), source) == 0, np.float32(0), z)
        return z.astype(np.float32)

    def _aligned(
        self, frame: int, rgb: NDArray[np.uint8], z: NDArray[np.float32], source: Path
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colour and depth at the pixels of the log's camera; the frame may have intrinsics of its own."""
        if frame >= len(self._coefficients):
            return self._registration.register(rgb, z, source)
        width, height = self._registration.color_size
        fx, fy, cx, cy = self._coefficients[frame].tolist()
        color = self._checked(fx, fy, cx, cy, width, height)
        own, log = color.resized(*self._registration.depth_size), self.camera
        pixels = own.K @ np.linalg.inv(log.K)
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        z = np.asarray(cv2.warpAffine(z, pixels[:2], self._registration.depth_size, flags=flags), np.float32)
        return self._register(color, log).register(rgb, z, source)

    def _unpacked(self, name: str, kind: np.dtype[Any], source: Path) -> NDArray[Any]:
        width, height = self._registration.depth_size
        size = kind.itemsize * width * height
        data = decompress(self._entry(name, size + _SPARE, source), size, source, name.rpartition(".")[2])
        return np.frombuffer(data, kind).reshape(height, width)

    def _entry(self, name: str, limit: int, source: Path) -> bytes:
        """Read a file of the archive of at most ``limit`` bytes."""
        try:
            with self._zip.open(name) as file:
                data = file.read(limit + 1)
        except (*_DAMAGED, KeyError, OSError, EOFError, RuntimeError, ValueError) as error:
            raise LogError(f"cannot be read ({error}).", file=source, field=name, hint=_AGAIN) from error
        if len(data) > limit:
            raise LogError(f"has more than {limit} bytes.", file=source, field=name, hint=_AGAIN)
        return data

    def _bad(self, field: str, problem: str, hint: str) -> LogError:
        return LogError(f"{problem}.", file=self.path, field=field, hint=hint)
