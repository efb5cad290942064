"""Observed and rendered views as small PNGs."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.rasterize.views import colorize, depth_limits

MAX_WIDTH = 360  # [px]; five such images fit side by side
DIFFERENCE_GAIN = 3.0
"""Gain [1] of difference images. Errors of a third of the range are white."""


class CaptionedView(NamedTuple):
    """Colour (H, W, 3) and depth (H, W) [m] of a view, each with its caption."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    rgb_caption: str
    depth_caption: str


def comparison(first: CaptionedView, second: CaptionedView) -> list[tuple[bytes, str]]:
    """Return five images with captions: colours, their difference, and depths over the range of the first depth."""
    span = depth_limits(first.depth)
    return [
        (colour_png(first.rgb), first.rgb_caption),
        (colour_png(second.rgb), second.rgb_caption),
        (difference_png(first.rgb, second.rgb), f"difference, times {DIFFERENCE_GAIN:g}"),
        (depth_png(first.depth, span), f"{first.depth_caption}, {span[0]:.2f} to {span[1]:.2f} m"),
        (depth_png(second.depth, span), second.depth_caption),
    ]


def colour_png(rgb: NDArray[np.uint8]) -> bytes:
    """Encode an image (H, W, 3) uint8, downsampled to at most :data:`MAX_WIDTH`."""
    return _encode(_fit(rgb, cv2.INTER_AREA))


def difference_png(a: NDArray[np.uint8], b: NDArray[np.uint8], *, gain: float = DIFFERENCE_GAIN) -> bytes:
    """Encode |a - b| of two images (H, W, 3), the mean over the channels times ``gain``; dark means equal."""
    mean = np.abs(a.astype(np.float32) - b.astype(np.float32)).mean(axis=2)
    grey = np.clip(gain * mean, 0, 255).astype(np.uint8)
    return _encode(_fit(cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB), cv2.INTER_AREA))


def depth_png(depth: NDArray[np.float32], depth_range: tuple[float, float]) -> bytes:
    """Encode depth (H, W) [m], red (near) to blue (far) over ``depth_range``; missing depth (0) is transparent."""
    rgb = colorize(depth, "depth", depth_range=depth_range)
    opaque = np.where(depth > 0, 255, 0).astype(np.uint8)
    return _encode(_fit(np.dstack([rgb, opaque]), cv2.INTER_NEAREST))


def _fit(image: NDArray[np.uint8], interpolation: int) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    if width <= MAX_WIDTH:
        return image
    size = (MAX_WIDTH, max(round(height * MAX_WIDTH / width), 1))
    return np.asarray(cv2.resize(image, size, interpolation=interpolation), dtype=np.uint8)


def _encode(image: NDArray[np.uint8]) -> bytes:
    code = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    _, data = cv2.imencode(".png", cv2.cvtColor(image, code))
    return bytes(data)
