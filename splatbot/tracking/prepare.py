"""From a raw frame to what tracking works on: a pyramid of grey and depth, without pixels that would mislead it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.config import TrackingConfig
from splatbot.frame import Frame

Image = NDArray[np.float32]

_LEAST_SIDE = 12  # [px] of a level; alignment needs an inside, and a border of one pixel is none


@dataclass(frozen=True)
class Level:
    """One pyramid level: grey (H, W) in 0..1, depth (H, W) [m] with 0 missing, and the camera of that size."""

    gray: Image
    depth: Image
    camera: Camera


@dataclass(frozen=True)
class PreparedFrame:
    """A frame and its pyramid, finest level first."""

    frame: Frame
    levels: tuple[Level, ...]


def prepare(frame: Frame, config: TrackingConfig) -> PreparedFrame:
    """The pyramid of a frame; its finest level is at most ``config.max_width`` pixels wide.

    It has ``config.n_levels`` levels, or fewer where the next would be smaller than 12 pixels.
    """
    depth = valid_depth(frame.depth, config.min_depth, config.max_depth)
    gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0
    level = Level(gray, depth, frame.camera)
    while level.camera.width > config.max_width:
        level = halve(level)
    smooth = np.asarray(cv2.GaussianBlur(level.gray, (0, 0), 0.7), dtype=np.float32)
    level = Level(smooth, level.depth, level.camera)
    levels = [level]
    while len(levels) < config.n_levels and min(levels[-1].gray.shape) >= 2 * _LEAST_SIDE:
        levels.append(halve(levels[-1]))
    return PreparedFrame(frame, tuple(levels))


def valid_depth(depth: Image, near: float, far: float) -> Image:
    """Depth (H, W) [m] with implausible pixels set to 0: out of range, or flying between two surfaces.

    A flying pixel is nearer than one neighbour and farther than the opposite one by more than 3 % of its range;
    a single missing row of neighbours, as registration leaves in upsampled depth, does not count against a pixel.
    """
    z = np.where((depth >= near) & (depth <= far), depth, 0.0).astype(np.float32)
    padded = np.pad(z, 1, mode="edge")
    flying = np.zeros(z.shape, dtype=bool)
    step = 0.03 * z
    for before, after in ((padded[1:-1, :-2], padded[1:-1, 2:]), (padded[:-2, 1:-1], padded[2:, 1:-1])):
        rises = (z - before > step) & (after - z > step) & (before > 0)
        falls = (before - z > step) & (z - after > step) & (after > 0)
        flying |= rises | falls
    z[flying] = 0.0
    return z


def valid_share(prepared: PreparedFrame) -> float:
    """Share of the pixels that have a usable depth."""
    return float((prepared.levels[0].depth > 0).mean())


def halve(level: Level) -> Level:
    """The next coarser level: grey averaged, depth as :func:`halve_depth` has it."""
    height, width = level.gray.shape[0] // 2, level.gray.shape[1] // 2
    crop = level.gray[: 2 * height, : 2 * width]
    gray = np.asarray(cv2.resize(crop, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)
    c = level.camera
    camera = Camera(c.fx / 2, c.fy / 2, (c.cx + 0.5) / 2 - 0.5, (c.cy + 0.5) / 2 - 0.5, width, height)
    return Level(gray, halve_depth(level.depth), camera)


def halve_depth(depth: Image) -> Image:
    """Half the size of a depth image [m]: the mean over the nearest surface of each 2x2 block; 0 where none is."""
    height, width = depth.shape[0] // 2, depth.shape[1] // 2
    corners = [depth[v : 2 * height : 2, u : 2 * width : 2] for v in (0, 1) for u in (0, 1)]
    nearest = np.full((height, width), np.inf, np.float32)
    for corner in corners:
        nearest = np.minimum(nearest, np.where(corner > 0, corner, np.float32(np.inf)))
    total = np.zeros((height, width), np.float32)
    count = np.zeros((height, width), np.float32)
    for corner in corners:
        same = (corner > 0) & (corner <= np.float32(1.05) * nearest)
        total += np.where(same, corner, 0)
        count += same
    return (total / np.maximum(count, 1)).astype(np.float32)


def with_depth(levels: Sequence[Level], depth: Image) -> tuple[Level, ...]:
    """The same pyramid with another depth (H, W) [m] on its finest level, and what follows from it on the others."""
    out = []
    for level in levels:
        out.append(Level(level.gray, depth, level.camera))
        depth = halve_depth(depth)
    return tuple(out)


def normals_of(depth: Image, camera: Camera) -> Image:
    """Unit normals (H, W, 3) towards the camera by central differences; zero where a neighbour is missing or far."""
    points = camera.backproject(depth)
    normals = np.zeros_like(points)
    du = points[1:-1, 2:] - points[1:-1, :-2]
    dv = points[2:, 1:-1] - points[:-2, 1:-1]
    n = np.cross(dv, du)
    length = np.linalg.norm(n, axis=-1)
    z = depth[1:-1, 1:-1]
    neighbours = np.stack([depth[1:-1, 2:], depth[1:-1, :-2], depth[2:, 1:-1], depth[:-2, 1:-1]])
    good = (z > 0) & (neighbours.min(0) > 0) & (np.abs(neighbours - z).max(0) < 0.05 * z) & (length > 0)
    normals[1:-1, 1:-1][good] = n[good] / length[good, None]
    return normals
