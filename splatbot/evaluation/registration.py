"""Whether depth lies on its colour: edges of the one against edges of the other."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.frame import Frame

_RANGE = 0.02  # of the width, each way, that is searched
_JUMP = 0.06  # share of its depth by which what is behind an edge is farther
_STRONG = 8.0  # [grey value/px]: stronger edges of grey count alike, or a few would decide
_NEAR = 0.4  # of the range: what is as near to the highest peak belongs to it
_LEAST_EDGES = 500  # [px] of all frames
_AGREE = 2  # [px] between what all frames find and what every second one does
_CLEAR = 1.25  # times any other offset; textures that repeat, and depth without edges in its colour, give no such peak


def depth_offset(frames: Iterable[Frame]) -> tuple[int, int] | None:
    """Pixels (u, v) by which depth images are to be shifted so that their edges lie on those of colour.

    The near sides of jumps in depth are laid over how steep grey is, at every offset up to 2 % of the width, and the
    one counts at which grey is steepest in the mean over all frames. It tells what is amiss for all pixels alike, as a
    camera matrix or an extrinsic that is off; sensors widen near things by a pixel or two.

    Returns:
        None where it can not be told: few edges, no offset clearly better than all others, or every second frame
        finds another than the rest.
    """
    reach, edges, halves = 0, 0, [np.zeros(0), np.zeros(0)]
    for k, frame in enumerate(frames):
        reach = reach or _reach(frame)
        near = _near_sides(frame, reach)
        edges += int(near.sum())
        part = _correlation(near, _steepness(frame.rgb), reach)
        halves[k % 2] = halves[k % 2] + part if k > 1 else part
    if edges < _LEAST_EDGES or not halves[1].size:
        return None
    total = halves[0] + halves[1]
    peak, first, second = (np.array(np.unravel_index(values.argmax(), values.shape)) for values in (total, *halves))
    if np.abs([first - peak, second - peak]).max() > _AGREE:
        return None
    rows, columns = np.indices(total.shape)
    others = total[np.hypot(rows - peak[0], columns - peak[1]) > _NEAR * reach]
    v, u = (peak - reach).tolist()
    return (u, v) if total.max() > _CLEAR * max(float(others.max()), 0.0) else None


def _reach(frame: Frame) -> int:
    """How far is searched [px]; no farther than the image is, however low."""
    height, width = frame.depth.shape
    return min(max(2, round(_RANGE * width)), (min(height, width) - 1) // 2)


def _near_sides(frame: Frame, margin: int) -> NDArray[np.bool_]:
    """(H, W): has a depth, as all around it have, and one of those is farther; not within ``margin`` of the border."""
    window = np.ones((3, 3), np.uint8)
    depth = frame.depth if frame.mask is None else np.where(frame.mask, frame.depth, np.float32(0))
    near = (cv2.erode(depth, window) > 0) & (cv2.dilate(depth, window) > (1 + _JUMP) * depth)
    inside = np.zeros_like(near)
    inside[margin:-margin, margin:-margin] = near[margin:-margin, margin:-margin]
    return inside


def _steepness(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H, W): length of grey's gradient, up to a limit; of mean 0 and, unless all is of one grey, of deviation 1."""
    gray = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    steep = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)) / 8
    steep = np.minimum(steep, np.float32(_STRONG))
    centered: NDArray[np.float32] = steep - steep.mean()
    return centered / max(float(centered.std()), 1e-6)


def _correlation(mask: NDArray[np.bool_], image: NDArray[np.float32], reach: int) -> NDArray[np.float64]:
    """(2R + 1, 2R + 1): sums of ``image`` over ``mask`` shifted by -R..R rows and columns, R being ``reach``."""
    product = np.fft.rfft2(mask.astype(np.float64)).conj() * np.fft.rfft2(image.astype(np.float64))
    shifts = np.arange(-reach, reach + 1)
    return np.fft.irfft2(product, s=mask.shape)[np.ix_(shifts, shifts)]
