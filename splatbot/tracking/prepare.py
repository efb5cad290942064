"""From a raw frame to what tracking works on: a pyramid of grey and depth, without pixels that would mislead it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot import _native
from splatbot.camera import Camera
from splatbot.config import TrackingConfig
from splatbot.frame import Frame

Image = NDArray[np.float32]

_FLYING_STEP = 0.03  # share of its depth by which a flying pixel differs from both surfaces
# Where depth jumps by more than this share and this many σ between neighbours, two surfaces meet.
_JUMP_STEP, _JUMP_SIGMAS = 0.02, 8.0  # the bend of three noisy depths has 2.4 times the noise of one
_LEAST_SIDE = 12  # [px] of a level; alignment needs an inside, and a border of one pixel is none


@dataclass(frozen=True)
class Level:
    """One pyramid level: grey (H, W) in 0..1, depth (H, W) [m] with 0 missing, and the camera of that size.

    Grey is NaN where it may not be used: masked, or on the finest level of a frame mixed of two surfaces.
    """

    gray: Image
    depth: Image
    camera: Camera


@dataclass(frozen=True)
class PreparedFrame:
    """A frame, its plausible depth (H, W) [m] at full size, and its pyramid, finest level first.

    What the frame's mask leaves out has no depth, and NaN as its grey. ``started`` is :func:`time.perf_counter` when
    work on the frame began.
    """

    frame: Frame
    depth: Image
    levels: tuple[Level, ...]
    started: float = field(default_factory=time.perf_counter, compare=False)


def prepare(frame: Frame, config: TrackingConfig) -> PreparedFrame:
    """The pyramid of a frame; its finest level is at most ``config.max_width`` pixels wide.

    It has ``config.n_levels`` levels, or fewer where the next would be smaller than 12 pixels. The finest decides the
    pose and has no grey along occluding edges.
    """
    started = time.perf_counter()
    depth = usable_depth(frame, config)
    gray = np.multiply(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.float32(1 / 255), dtype=np.float32)
    if frame.mask is not None:
        gray[~frame.mask] = np.nan  # and so is all that is smoothed or interpolated from it
    level = Level(gray, depth, frame.camera)
    while level.camera.width > config.max_width:
        level = halve(level)
    levels = [Level(smoothed(level.gray), level.depth, level.camera)]
    while len(levels) < config.n_levels and min(levels[-1].gray.shape) >= 2 * _LEAST_SIDE:
        levels.append(halve(levels[-1]))
    levels[0] = Level(gray_of_one_surface(levels[0], config), levels[0].depth, levels[0].camera)
    return PreparedFrame(frame, depth, tuple(levels), started)


def gray_of_one_surface(level: Level, config: TrackingConfig) -> Image:
    """Grey (H, W), NaN along occluding edges: where inverse depth bends from pixel to pixel, more than noise explains.

    Along a plane it is linear, however slanted that is and however few pixels there are.

    Smoothing and interpolation mix the grey of two surfaces there, and from elsewhere others meet. The errors of such
    pixels do not average out: a few per cent of all, they would pull the pose along with the parallax.
    """
    floor, quad = (_JUMP_SIGMAS * sigma for sigma in (config.sensor.sigma_depth_floor, config.sensor.sigma_depth_quad))
    return np.asarray(_native.gray_of_one_surface(level.depth, level.gray, _JUMP_STEP, floor, quad))


def smoothed(gray: Image) -> Image:
    """Grey (H, W) without the finest of its noise, as alignment takes it."""
    return np.asarray(cv2.GaussianBlur(gray, (0, 0), 0.7), dtype=np.float32)


def valid_depth(depth: Image, near: float, far: float) -> Image:
    """Depth (H, W) [m] with implausible pixels set to 0: out of range, or flying between two surfaces.

    A flying pixel is nearer than one neighbour and farther than the opposite one by more than 3 % of its range;
    a single missing row of neighbours, as registration leaves in upsampled depth, does not count against a pixel.
    """
    return np.asarray(_native.valid_depth(np.ascontiguousarray(depth), near, far, _FLYING_STEP))


def usable_depth(frame: Frame, config: TrackingConfig) -> Image:
    """Depth (H, W) [m] of a frame with 0 where it is implausible (see :func:`valid_depth`) or masked."""
    depth = valid_depth(frame.depth, config.sensor.min_depth, config.sensor.max_depth)
    return depth if frame.mask is None else np.where(frame.mask, depth, np.float32(0))


def valid_share(prepared: PreparedFrame) -> float:
    """Share of the pixels that have a usable depth."""
    depth = prepared.levels[0].depth
    return float(np.count_nonzero(depth > 0)) / depth.size


def typical_depth(prepared: PreparedFrame) -> float:
    """Median depth [m] of what is seen; 1 where nothing has a depth."""
    coarse = prepared.levels[-1].depth
    measured = coarse[coarse > 0]
    return float(np.median(measured)) if len(measured) else 1.0


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
    return np.asarray(_native.halve_depth(np.ascontiguousarray(depth)))


def with_depth(levels: Sequence[Level], depth: Image) -> tuple[Level, ...]:
    """The same pyramid with another depth (H, W) [m] on its finest level, and what follows from it on the others."""
    out = []
    for level in levels:
        out.append(Level(level.gray, depth, level.camera))
        depth = halve_depth(depth)
    return tuple(out)


def normals_of(depth: Image, camera: Camera) -> Image:
    """Unit normals (H, W, 3) towards the camera by central differences; zero where a neighbour is missing or far."""
    c = camera
    return np.asarray(_native.normals_of(np.ascontiguousarray(depth, np.float32), c.fx, c.fy, c.cx, c.cy))
