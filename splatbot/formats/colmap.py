"""The files of a COLMAP model: cameras, images and points3D, as binary and as text.

The layouts are those of https://colmap.github.io/format.html. Each count is compared with the size of the file before
anything is allocated.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import FormatError

CAMERA_MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "FOV": (),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": (),
}
"""Parameters of the camera models, in the order of their numbers; empty for models that are not supported."""

_AGAIN = "copy the model again, or write it again with `colmap model_converter`"
_LEAST_CAMERA, _LEAST_IMAGE, _LEAST_POINT = 48, 73, 51  # [B] of an entry


class CameraRow(NamedTuple):
    """Camera of a model: size [px], and the parameters of its type."""

    camera_id: int
    model: str
    size: tuple[int, int]
    params: dict[str, float]


class ImageRow(NamedTuple):
    """Image of a model: quaternion wxyz and translation of T_camera_world, camera and file name."""

    quat: tuple[float, ...]
    translation: tuple[float, ...]
    camera_id: int
    name: str


class PointRow(NamedTuple):
    """Point of a model, with its colour RGB."""

    position: tuple[float, ...]
    color: tuple[int, ...]


def read_cameras(file: Path) -> list[CameraRow]:
    """Read `cameras.bin` or `cameras.txt`.

    Raises:
        FormatError: the file is missing or damaged, or a camera model is not supported.
    """
    return list(_binary_cameras(file) if file.suffix == ".bin" else _text_cameras(file))


def read_images(file: Path) -> list[ImageRow]:
    """Read `images.bin` or `images.txt`; the 2D points are skipped.

    Raises:
        FormatError: the file is missing or damaged.
    """
    return list(_binary_images(file) if file.suffix == ".bin" else _text_images(file))


def read_points(file: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Read the points (M, 3) and their colours (M, 3) RGB of `points3D.bin` or `points3D.txt`.

    Raises:
        FormatError: the file is missing or damaged, or a value is NaN or infinite.
    """
    rows = list(_binary_points(file) if file.suffix == ".bin" else _text_points(file))
    points = np.array([row.position for row in rows], np.float64).reshape(-1, 3)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise FormatError(
            f"{int((~finite).sum())} of {len(rows)} points hold NaN or infinity.",
            file=file,
            field=f"point {int(np.argmin(finite))} XYZ",
            hint=_AGAIN,
        )
    return points, np.array([row.color for row in rows], np.uint8).reshape(-1, 3)


class ModelBytes:
    """The bytes of a binary file, unpacked in order.

    Raises:
        FormatError: the file cannot be read; each method raises it if the file ends early.
    """

    def __init__(self, file: Path) -> None:
        self._file, self._at = file, 0
        try:
            self._data = file.read_bytes()
        except OSError as error:
            raise _unreadable(file, error) from error

    def unpack(self, layout: str, field: str) -> tuple[int | float, ...]:
        """Unpack little-endian values by a layout of :mod:`struct`."""
        start = self._at
        self.skip(struct.calcsize("<" + layout), field)
        return struct.unpack_from("<" + layout, self._data, start)

    def count(self, least: int, field: str) -> int:
        """Unpack a count of entries, each of at least ``least`` bytes."""
        (count,) = self.unpack("Q", field)
        left = len(self._data) - self._at
        if count * least > left:
            raise FormatError(f"is {count}, but only {left} bytes follow.", file=self._file, field=field, hint=_AGAIN)
        return int(count)

    def text(self, field: str) -> str:
        """Unpack a text that ends with a zero byte."""
        start, end = self._at, self._data.find(b"\0", self._at)
        if end < 0:
            raise FormatError("has no end.", file=self._file, field=field, hint=_AGAIN)
        self._at = end + 1
        try:
            return self._data[start:end].decode()
        except UnicodeDecodeError as error:
            raise FormatError("is not UTF-8.", file=self._file, field=field, hint="rename the images") from error

    def skip(self, size: int, field: str) -> None:
        """Skip ``size`` bytes."""
        if size > len(self._data) - self._at:
            raise FormatError("is cut off: the file ends early.", file=self._file, field=field, hint=_AGAIN)
        self._at += size

    def end(self) -> None:
        """Check that all bytes are unpacked."""
        left = len(self._data) - self._at
        if left:
            raise FormatError(f"has {left} bytes after its last entry.", file=self._file, field="count", hint=_AGAIN)


def _binary_cameras(file: Path) -> Iterator[CameraRow]:
    data = ModelBytes(file)
    for row in range(data.count(_LEAST_CAMERA, "count of cameras")):
        camera_id, number, width, height = (int(value) for value in data.unpack("IiQQ", f"camera {row}"))
        model = list(CAMERA_MODELS)[number] if 0 <= number < len(CAMERA_MODELS) else f"number {number}"
        names = _parameter_names(file, f"camera {camera_id}", model)
        params = data.unpack(f"{len(names)}d", f"camera {camera_id} PARAMS")
        yield CameraRow(camera_id, model, (width, height), dict(zip(names, params, strict=True)))
    data.end()


def _binary_images(file: Path) -> Iterator[ImageRow]:
    data = ModelBytes(file)
    for row in range(data.count(_LEAST_IMAGE, "count of images")):
        field = f"image {row}"
        values = data.unpack("I7dI", field)
        name = data.text(f"{field} NAME")
        data.skip(24 * data.count(24, f"{field} count of POINTS2D"), f"{field} POINTS2D")
        yield ImageRow(values[1:5], values[5:8], int(values[8]), name)
    data.end()


def _binary_points(file: Path) -> Iterator[PointRow]:
    data = ModelBytes(file)
    for row in range(data.count(_LEAST_POINT, "count of points")):
        values = data.unpack("Q3d3Bd", f"point {row}")
        data.skip(8 * data.count(8, f"point {row} length of TRACK"), f"point {row} TRACK")
        yield PointRow(values[1:4], tuple(int(value) for value in values[4:7]))
    data.end()


def _text_cameras(file: Path) -> Iterator[CameraRow]:
    for number, line in _entries(_lines(file)):
        words = line.split()
        model = words[1] if len(words) > 1 else ""
        names = _parameter_names(file, f"line {number} MODEL", model)
        try:
            camera_id, width, height = (int(words[column]) for column in (0, 2, 3))
            params = dict(zip(names, map(float, words[4:]), strict=True))
            yield CameraRow(camera_id, model, (width, height), params)
        except (ValueError, IndexError) as error:
            raise _bad_line(file, number, f"CAMERA_ID {model} WIDTH HEIGHT {' '.join(names)}", error) from error


def _text_images(file: Path) -> Iterator[ImageRow]:
    lines = _lines(file)
    for number, line in _entries(lines):
        words = line.split(maxsplit=9)
        try:
            values = [float(word) for word in words[1:8]]
            _, name = int(words[0]), words[9].strip()
            yield ImageRow(tuple(values[:4]), tuple(values[4:]), int(words[8]), name)
        except (ValueError, IndexError) as error:
            raise _bad_line(file, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", error) from error
        next(lines, None)  # the 2D points, which may be an empty line


def _text_points(file: Path) -> Iterator[PointRow]:
    for number, line in _entries(_lines(file)):
        words = line.split(maxsplit=8)
        try:
            color = tuple(int(word) for word in words[4:7])
            if len(words) < 8 or not all(0 <= value <= 255 for value in color):
                raise ValueError("a colour is not in 0..255, or a value is missing")
            yield PointRow(tuple(float(word) for word in words[1:4]), color)
        except ValueError as error:
            raise _bad_line(file, number, "POINT3D_ID X Y Z R G B ERROR TRACK", error) from error


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file with their numbers."""
    try:
        with file.open(encoding="utf-8-sig") as stream:
            yield from enumerate(stream, 1)
    except OSError as error:
        raise _unreadable(file, error) from error
    except UnicodeDecodeError as error:
        raise FormatError(f"is not UTF-8 text ({error.reason}).", file=file, field="text", hint=_AGAIN) from error


def _entries(lines: Iterator[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    """Yield the lines that are neither blank nor comments."""
    return ((number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#"))


def _parameter_names(file: Path, field: str, model: str) -> tuple[str, ...]:
    names = CAMERA_MODELS.get(model, ())
    if not names:
        supported = ", ".join(name for name, found in CAMERA_MODELS.items() if found)
        raise FormatError(
            f"is of the model {model[:40]}; supported are {supported}.",
            file=file,
            field=field,
            hint="run `colmap image_undistorter` and open its output folder",
        )
    return names


def _bad_line(file: Path, number: int, layout: str, error: Exception) -> FormatError:
    return FormatError(f"is damaged ({error}).", file=file, field=f"line {number}", hint=f"write `{layout}`")


def _unreadable(file: Path, error: OSError) -> FormatError:
    return FormatError(
        f"cannot be read ({error.strerror}).",
        file=file,
        field="model",
        hint="copy the three files cameras, images and points3D of the model, with the same suffix",
    )
