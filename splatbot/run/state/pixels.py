"""Arrays as bytes: images with lossless compression, other arrays as in memory."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

_FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]

Array = NDArray[Any]


class Packed(NamedTuple):
    """The bytes of an array, with packing, type and shape."""

    data: bytes
    packing: str
    dtype: str
    shape: list[int]


def pack(array: Array, *, compress: bool) -> Packed:
    """Pack an array (any shape); with ``compress``, color (H, W, 3) uint8 and images (H, W) float32 become PNG.

    The four bytes of a float become the four channels of an image: neighbors differ in the low bytes only, and PNG
    encodes differences. All bits are preserved, including NaN.
    """
    dtype, shape = array.dtype.str, list(array.shape)
    array = np.ascontiguousarray(array)  # which has one dimension at least
    if compress and array.dtype == np.uint8 and array.ndim == 3 and array.shape[2] == 3 and array.size:
        return Packed(_png(array), "png", dtype, shape)
    if compress and array.dtype == np.float32 and array.ndim == 2 and array.size:
        return Packed(_png(array.view(np.uint8).reshape(*array.shape, 4)), "png of floats", dtype, shape)
    return Packed(array.tobytes(), "raw", dtype, shape)


def unpack(packed: Packed) -> Array:
    """Unpack an array, bit for bit.

    Raises:
        ValueError: The bytes are not such an array.
    """
    if packed.packing == "raw":
        return np.frombuffer(packed.data, np.dtype(packed.dtype)).reshape(packed.shape).copy()
    if packed.packing not in ("png", "png of floats"):
        raise ValueError(f"unknown packing {packed.packing!r}")
    image = cv2.imdecode(np.frombuffer(packed.data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("no PNG")
    whole = np.ascontiguousarray(image)
    return whole.view(np.dtype(packed.dtype)).reshape(packed.shape)


def _png(image: Array) -> bytes:
    ok, data = cv2.imencode(".png", image, _FAST)
    if not ok:
        raise ValueError(f"OpenCV could not encode an image of {image.shape}")
    return bytes(data)
