"""What a frame is aligned against: points of one keyframe, at each pyramid level."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.tracking.prepare import Image, Level, normals_of

_SCHARR = 32.0  # what its kernel makes of a slope of 1


@dataclass(frozen=True)
class ReferencePoints:
    """Sampled pixels of one level: points (N, 3) [m] and normals (N, 3) in the reference camera, grey (N,) in 0..1.

    ``slope`` (N,) is how steep grey is there, see :func:`slopes_of`: what a pixel has to say of where it is.
    """

    points: Image
    normals: Image
    gray: Image
    slope: Image


@dataclass(frozen=True)
class Reference:
    """A keyframe as seen by alignment; ``levels`` run from fine to coarse."""

    T_world_camera: NDArray[np.float64]
    levels: tuple[ReferencePoints, ...]


def make_reference(levels: tuple[Level, ...], T_world_camera: NDArray[np.float64], n_pixels: int) -> Reference:
    """Sample about ``n_pixels`` pixels of every level, fewer where surface is missing."""
    return Reference(T_world_camera, tuple(sample_level(level, n_pixels) for level in levels))


def sample_level(level: Level, n_pixels: int) -> ReferencePoints:
    """About ``n_pixels`` pixels of a level, see :func:`sampled_pixels`."""
    normals, slopes = normals_of(level.depth, level.camera), slopes_of(level.gray)
    chosen = sampled_pixels(level, normals, slopes, n_pixels)
    points = level.camera.backproject(level.depth)[chosen]
    return ReferencePoints(points, normals[chosen], level.gray[chosen], slopes[chosen])


def slopes_of(gray: Image) -> Image:
    """Length of the gradient (H, W) of grey [1/px] (Scharr); 0 beside pixels that have none."""
    gx, gy = cv2.Scharr(gray, cv2.CV_32F, 1, 0), cv2.Scharr(gray, cv2.CV_32F, 0, 1)
    return np.asarray(np.nan_to_num(np.hypot(gx, gy)) / _SCHARR, dtype=np.float32)


def sampled_pixels(level: Level, normals: Image, slopes: Image, n_pixels: int) -> NDArray[np.bool_]:
    """Pixels (H, W) on smooth surface: half of them the strongest gradient of each tile, half on a regular grid.

    Edges carry the photometric information, the grid the geometric; a pixel needs a normal (H, W, 3), which keeps both
    off occlusion boundaries, where colour belongs to one surface and depth to another. ``slopes`` (H, W) are of grey.
    """
    x, y, z = normals[..., 0], normals[..., 1], normals[..., 2]
    good = (x * x + y * y + z * z > 0.25) & np.isfinite(level.gray)
    strength = np.where(good, slopes, -1.0)
    height, width = level.gray.shape
    tile = max(2, round(float(np.sqrt(2.0 * height * width / n_pixels))))
    rows, columns = height // tile, width // tile
    blocks = strength[: rows * tile, : columns * tile].reshape(rows, tile, columns, tile).transpose(0, 2, 1, 3)
    flat = blocks.reshape(rows, columns, tile * tile)
    best = flat.argmax(-1)
    v = np.arange(rows)[:, None] * tile + best // tile
    u = np.arange(columns)[None, :] * tile + best % tile
    chosen = np.zeros_like(good)
    chosen[v[flat.max(-1) >= 0], u[flat.max(-1) >= 0]] = True
    chosen[tile // 2 :: tile, tile // 2 :: tile] |= good[tile // 2 :: tile, tile // 2 :: tile]
    return chosen
