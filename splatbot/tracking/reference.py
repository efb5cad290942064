"""Sampled pixels of a keyframe on each pyramid level, to which frames are aligned."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.tracking.prepare import Image, Level, normals_of

_SCHARR_GAIN = 32.0  # response of the Scharr kernel to a slope of 1


@dataclass(frozen=True)
class ReferencePoints:
    """Sampled pixels of one level.

    Args:
        points: (N, 3) [m] in the reference camera.
        normals: (N, 3) unit normals in the reference camera.
        gray: (N,) in 0..1.
        slope: (N,) [1/px] length of the gradient of grey, see :func:`slopes_of`. It determines how well a pixel
            constrains the pose.
    """

    points: Image
    normals: Image
    gray: Image
    slope: Image


@dataclass(frozen=True)
class Reference:
    """Sampled pixels of a keyframe.

    Args:
        T_world_camera: (4, 4) pose of the keyframe.
        levels: samples of each level, finest first.
    """

    T_world_camera: NDArray[np.float64]
    levels: tuple[ReferencePoints, ...]


def make_reference(levels: tuple[Level, ...], T_world_camera: NDArray[np.float64], n_pixels: int) -> Reference:
    """Sample about ``n_pixels`` pixels of each level, or fewer if depth is missing."""
    return Reference(T_world_camera, tuple(sample_level(level, n_pixels) for level in levels))


def sample_level(level: Level, n_pixels: int) -> ReferencePoints:
    """Sample about ``n_pixels`` pixels of a level, see :func:`sampled_pixels`."""
    normals, slopes = normals_of(level.depth, level.camera), slopes_of(level.gray)
    chosen = sampled_pixels(level, normals, slopes, n_pixels)
    points = level.camera.backproject(level.depth)[chosen]
    return ReferencePoints(points, normals[chosen], level.gray[chosen], slopes[chosen])


def slopes_of(gray: Image) -> Image:
    """Compute the length (H, W) of the Scharr gradient of grey [1/px], 0 next to pixels without grey."""
    gx, gy = cv2.Scharr(gray, cv2.CV_32F, 1, 0), cv2.Scharr(gray, cv2.CV_32F, 0, 1)
    return np.asarray(np.nan_to_num(np.hypot(gx, gy)) / _SCHARR_GAIN, dtype=np.float32)


def sampled_pixels(level: Level, normals: Image, slopes: Image, n_pixels: int) -> NDArray[np.bool_]:
    """Select pixels (H, W) on smooth surfaces: the strongest gradient of each tile, and a regular grid.

    Edges carry the photometric information and the grid the geometric information. A selected pixel has a normal, which
    excludes occlusion boundaries: colour and depth of these belong to different surfaces.

    Args:
        level: level of the pyramid.
        normals: (H, W, 3) unit normals, zero if undefined.
        slopes: (H, W) [1/px] length of the gradient of grey.
        n_pixels: approximate number of pixels, half of them from the tiles and half from the grid.
    """
    x, y, z = normals[..., 0], normals[..., 1], normals[..., 2]
    valid = (x * x + y * y + z * z > 0.25) & np.isfinite(level.gray)
    strength = np.where(valid, slopes, -1.0)
    height, width = level.gray.shape
    tile = max(2, round(float(np.sqrt(2.0 * height * width / n_pixels))))
    rows, columns = height // tile, width // tile
    blocks = strength[: rows * tile, : columns * tile].reshape(rows, tile, columns, tile).transpose(0, 2, 1, 3)
    flat = blocks.reshape(rows, columns, tile * tile)
    best = flat.argmax(-1)
    v = np.arange(rows)[:, None] * tile + best // tile
    u = np.arange(columns)[None, :] * tile + best % tile
    chosen = np.zeros_like(valid)
    chosen[v[flat.max(-1) >= 0], u[flat.max(-1) >= 0]] = True
    chosen[tile // 2 :: tile, tile // 2 :: tile] |= valid[tile // 2 :: tile, tile // 2 :: tile]
    return chosen
