"""Photographs as images of a pinhole camera: reading, undistortion and scaling."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, FormatError, LogError
from splatbot.logs import undistort
from splatbot.logs.image_size import image_size
from splatbot.logs.images import read_color
from splatbot.training.datasets.base import TrainingView

MAX_PIXELS = 64_000_000
"""Largest number of pixels of an image."""

Image = NDArray[np.uint8]
Pixels = NDArray[np.integer[Any] | np.floating[Any]]  # as OpenCV's functions take

_PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # OpenCV's order
_FISHEYE = ("k1", "k2", "k3", "k4")
_PNG_WITH_ALPHA = (3, 4, 6)  # colour types: palette (perhaps), grey and RGB


@dataclass(frozen=True)
class Lens:
    """A camera as it recorded its images.

    Args:
        camera: intrinsics with distortion.
    """

    camera: Camera

    @property
    def pinhole(self) -> Camera:
        """The camera of the undistorted images: the same intrinsic matrix and size."""
        return self.camera.pinhole

    @property
    def distorts(self) -> bool:
        """True if the recorded images differ from those of the pinhole camera."""
        return bool(self.camera.distortion)

    def resized(self, size: tuple[int, int]) -> Lens:
        """Return the same lens with images of another width and height [px]."""
        return Lens(self.camera.resized(*size))


def make_lens(
    file: Path, field: str, size: tuple[int, int], values: Mapping[str, float], *, fisheye: bool = False
) -> Lens:
    """Build a lens from the intrinsics of a file.

    Args:
        file: the file, for messages.
        field: the camera in the file, for messages.
        size: width and height [px].
        values: fx, fy, cx, cy [px] with pixel centres at +0.5, and coefficients k1 to k6, p1, p2 that are not 0.
        fisheye: whether k1 to k4 belong to the equidistant fisheye model.

    Raises:
        FormatError: a value is not finite or not plausible, or the images exceed 64 megapixels.
    """
    bad = next((name for name, value in values.items() if not np.isfinite(value)), None)
    if bad is not None:
        raise FormatError(f"is {values[bad]}.", file=file, field=f"{field} {bad}", hint="give a finite value")
    _check_pixels(file, field, size)
    distortion = tuple(float(values.get(name, 0.0)) for name in (_FISHEYE if fisheye else _PERSPECTIVE))
    if not fisheye:
        distortion = _shortened(distortion)
    try:
        camera = Camera(values["fx"], values["fy"], values["cx"] - 0.5, values["cy"] - 0.5, *size, distortion, fisheye)
        camera.check_plausible()
    except CameraError as error:
        raise FormatError(error.message, file=file, field=f"{field} {error.field}", hint=error.hint) from error
    return Lens(camera)


@dataclass(frozen=True)
class PhotoFile:
    """A photograph in a file.

    Args:
        file: the image file.
        lens: of the image in the file.
        size: width and height [px] of the image that is read, undistorted and scaled.
    """

    file: Path
    lens: Lens
    size: tuple[int, int]

    def view(self, name: str, T_world_camera: NDArray[np.float64], camera_name: str = "") -> TrainingView:
        """Return the photograph as a view with a pose (4, 4) and the name of its camera."""
        camera = self.lens.pinhole.resized(*self.size)
        read_mask = self.read_mask if self.lens.distorts else None
        return TrainingView(name, camera, T_world_camera, self.read, read_mask=read_mask, camera_name=camera_name)

    def read(self) -> Image:
        """Read the image (H, W, 3) RGB or (H, W, 4) RGBA of the pinhole camera.

        Raises:
            LogError: the file is missing, damaged or not of the size of the lens.
            FormatError: the image is larger than 64 megapixels.
        """
        image = read_photo(self.file)
        _check_size(self.file, (image.shape[1], image.shape[0]), self.lens)
        if not self.lens.distorts and self.size == (image.shape[1], image.shape[0]):
            return image
        return resample(image, self._undistorted_and_scaled)

    def read_mask(self) -> NDArray[np.bool_]:
        """Return the mask (H, W) of pixels that the photograph does not show."""
        return scaled_mask(unseen(self.lens), self.size)

    def _undistorted_and_scaled(self, image: Pixels) -> Pixels:
        if self.lens.distorts:
            u, v = _source_pixels(self.lens)
            image = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return scaled(image, self.size)


def open_photo(file: Path, lens: Lens, scale: int) -> PhotoFile:
    """Check the header of a photograph that is to be read at 1/scale of its size.

    Raises:
        LogError: the file is missing, damaged or not of the size of the lens.
        FormatError: the image is larger than 64 megapixels.
    """
    _check_size(file, photo_size(file), lens)
    return PhotoFile(file, lens, scaled_size(lens.camera, scale))


def read_photo(file: Path) -> Image:
    """Read a photograph (H, W, 3) RGB, or (H, W, 4) RGBA if it is a PNG with alpha; EXIF orientation is ignored.

    Raises:
        LogError: the file is missing or damaged.
        FormatError: the image is larger than 64 megapixels.
    """
    first = _header(file)[1]
    rgb = read_color(file)
    if not (first.startswith(b"\x89PNG") and first[25] in _PNG_WITH_ALPHA):
        return rgb
    whole = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if whole is None or whole.ndim != 3 or whole.shape[2] != 4:
        return rgb
    alpha = whole[..., 3] / (1 if whole.dtype == np.uint8 else 257)  # else 16 bits
    return np.dstack([rgb, np.rint(alpha).astype(np.uint8)])


def photo_size(file: Path) -> tuple[int, int]:
    """Return width and height [px] of a photograph; only other formats than PNG and JPEG are decoded.

    Raises:
        LogError: the file is missing or damaged.
        FormatError: the image is larger than 64 megapixels.
    """
    size = _header(file)[0]
    if size is not None:
        return size
    height, width = read_color(file).shape[:2]
    return width, height


def is_image(file: Path) -> bool:
    """Return whether a path names a file; False for names that no file can have."""
    try:
        return file.is_file()
    except OSError:  # too long
        return False


def scaled_size(camera: Camera, scale: int) -> tuple[int, int]:
    """Return width and height [px] of the images of a camera after division by ``scale``."""
    return max(1, round(camera.width / scale)), max(1, round(camera.height / scale))


def scaled(image: Pixels, size: tuple[int, int]) -> Pixels:
    """Scale an image to width and height [px] by the mean over pixel areas."""
    if (image.shape[1], image.shape[0]) == size:
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def scaled_depth(depth: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Scale a depth image to width and height [px]; keeps nearest pixels, since means across edges are no surface."""
    return np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT))


def scaled_mask(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Scale a mask to width and height [px]; a pixel is True if any part of its area was."""
    return np.asarray(scaled(mask.astype(np.float32), size) > 0)


@lru_cache(maxsize=1)
def unseen(lens: Lens) -> NDArray[np.bool_]:
    """Return the pixels (H, W) of the pinhole camera that a recorded image does not show."""
    return undistort.unseen(lens.camera, _source_pixels(lens))


@lru_cache(maxsize=1)
def _source_pixels(lens: Lens) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the pixels (H, W) u and v of the recorded image for those of the pinhole camera."""
    return undistort.source_pixels(lens.camera)


def resample(image: Image, resampler: Callable[[Pixels], Pixels]) -> Image:
    """Apply a linear resampler; colours with alpha are weighted by it, so hidden colours do not blend in."""
    if image.shape[2] == 3:
        return np.asarray(resampler(image), dtype=np.uint8)
    alpha = image[..., 3:].astype(np.float32) / 255
    mixed = np.asarray(resampler(np.dstack([image[..., :3] * alpha, 255 * alpha])), dtype=np.float32)
    colors = 255 * mixed[..., :3] / np.maximum(mixed[..., 3:], 1e-3)
    return np.rint(np.dstack([colors, mixed[..., 3]])).clip(0, 255).astype(np.uint8)


def _shortened(distortion: tuple[float, ...]) -> tuple[float, ...]:
    """Leave out trailing zeros, down to a number of coefficients that a camera takes."""
    count = next((n for n in (0, 4, 5) if not any(distortion[n:])), 8)
    return distortion[:count]


def _header(file: Path) -> tuple[tuple[int, int] | None, bytes]:
    """Read the size of an image, None for other formats than PNG and JPEG, and the first bytes of its file."""
    try:
        with file.open("rb") as stream:
            size = image_size(stream)
            stream.seek(0)
            first = stream.read(26)
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        reason = getattr(error, "strerror", None) or error
        raise LogError(f"cannot be read ({reason}).", file=file, field="image", hint="restore the file") from error
    if size is not None:
        _check_pixels(file, "size", size)
    return size, first


def _check_size(file: Path, size: tuple[int, int], lens: Lens) -> None:
    expected = (lens.camera.width, lens.camera.height)
    if size != expected:
        raise LogError(
            f"is {size[0]}x{size[1]}, its camera is {expected[0]}x{expected[1]}.",
            file=file,
            field="size",
            hint="give the images whose cameras were estimated, or correct width and height of the camera",
        )


def _check_pixels(file: Path, field: str, size: tuple[int, int]) -> None:
    width, height = size
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        raise FormatError(
            f"is of {width}x{height} px.",
            file=file,
            field=field,
            hint=f"give images of 1 to {MAX_PIXELS // 10**6} megapixels",
        )
