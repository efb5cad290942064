"""Registration of depth to colour: the offset between depth edges and intensity edges."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.frame import Frame


@dataclass(frozen=True)
class RegistrationConstants:
    """Constants of the offset between depth and colour images.

    Args:
        search_range: [share of width] largest offset in each direction.
        depth_jump: relative depth step at an edge.
        max_gradient: [grey value/px] the clamp keeps few strong edges from dominating.
        peak_radius: [share of search range] offsets this near the maximum belong to its peak.
        min_edges: [px] least number of edge pixels over all frames.
        max_disagreement: [px] largest difference between the offset of all frames and that of every second frame.
        peak_ratio: peak to second peak; repeated textures and depth without colour edges stay below it.
    """

    search_range: float = 0.02
    depth_jump: float = 0.06
    max_gradient: float = 8.0
    peak_radius: float = 0.4
    min_edges: int = 500
    max_disagreement: int = 2
    peak_ratio: float = 1.25


CONSTANTS = RegistrationConstants()


def depth_offset(frames: Iterable[Frame]) -> tuple[int, int] | None:
    """Estimate the offset (u, v) [px] by which depth images must be shifted to align with colour.

    The mask of near sides of depth edges is cross-correlated with the gradient magnitude of the grey image. Offsets up
    to 2 % of the image width are searched, and the maximum of the mean over all frames is returned. It measures an
    offset common to all pixels, such as that of a wrong camera matrix or extrinsic. Depth sensors themselves widen near
    objects by one or two pixels.

    Returns:
        The offset. It is None if the estimate is not reliable: few edges, no distinct peak, or a disagreement between
        even and odd frames.
    """
    radius, edges, halves = 0, 0, [np.zeros(0), np.zeros(0)]
    for k, frame in enumerate(frames):
        radius = radius or _search_radius(frame)
        part, count = edge_correlation(frame, radius)
        edges += count
        halves[k % 2] = halves[k % 2] + part if k > 1 else part
    if edges < CONSTANTS.min_edges or not halves[1].size:
        return None
    total = halves[0] + halves[1]
    peak, first, second = (np.array(np.unravel_index(values.argmax(), values.shape)) for values in (total, *halves))
    if np.abs([first - peak, second - peak]).max() > CONSTANTS.max_disagreement:
        return None
    rows, columns = np.indices(total.shape)
    others = total[np.hypot(rows - peak[0], columns - peak[1]) > CONSTANTS.peak_radius * radius]
    v, u = (peak - radius).tolist()
    return (u, v) if total.max() > CONSTANTS.peak_ratio * max(float(others.max()), 0.0) else None


def edge_correlation(frame: Frame, radius: int) -> tuple[NDArray[np.float64], int]:
    """Correlate near sides of depth edges, shifted by -R..R rows and columns, with the gradient magnitude of grey.

    Args:
        frame: the frame.
        radius: largest shift R [px].

    Returns:
        The correlation (2R + 1, 2R + 1), and the number of edge pixels.
    """
    near = _near_sides(frame, radius)
    return _correlation(near, _gradient_magnitude(frame.rgb), radius), int(near.sum())


def _search_radius(frame: Frame) -> int:
    """Return the search radius [px], limited by the image size."""
    height, width = frame.depth.shape
    return min(max(2, round(CONSTANTS.search_range * width)), (min(height, width) - 1) // 2)


def _near_sides(frame: Frame, margin: int) -> NDArray[np.bool_]:
    """Return the mask (H, W) of near sides of depth edges, at least ``margin`` pixels inside the image."""
    window = np.ones((3, 3), np.uint8)
    depth = frame.depth if frame.mask is None else np.where(frame.mask, frame.depth, np.float32(0))
    near = (cv2.erode(depth, window) > 0) & (cv2.dilate(depth, window) > (1 + CONSTANTS.depth_jump) * depth)
    inside = np.zeros_like(near)
    inside[margin:-margin, margin:-margin] = near[margin:-margin, margin:-margin]
    return inside


def _gradient_magnitude(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Compute the clamped gradient magnitude (H, W) of the grey image, normalized to mean 0 and deviation 1."""
    gray = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    gradient = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)) / 8
    gradient = np.minimum(gradient, np.float32(CONSTANTS.max_gradient))
    centered: NDArray[np.float32] = gradient - gradient.mean()
    return centered / max(float(centered.std()), 1e-6)


def _correlation(mask: NDArray[np.bool_], image: NDArray[np.float32], radius: int) -> NDArray[np.float64]:
    """Correlate ``mask``, shifted by -R..R rows and columns, with ``image``: (2R + 1, 2R + 1), R = ``radius``."""
    product = np.fft.rfft2(mask.astype(np.float64)).conj() * np.fft.rfft2(image.astype(np.float64))
    shifts = np.arange(-radius, radius + 1)
    return np.fft.irfft2(product, s=mask.shape)[np.ix_(shifts, shifts)]
