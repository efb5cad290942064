"""Pyramid of grey and depth of a frame, without pixels that would bias the pose."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot import _native
from splatbot.camera import Camera
from splatbot.config import SensorConfig, TrackingConfig
from splatbot.frame import Frame
from splatbot.tracking.rectify import rectify, row_displacement

Image = NDArray[np.float32]

_AT_REST = np.zeros(6)
MIN_DISPLACEMENT = 0.3  # [px] by which another velocity moves pixels, below which a frame is not rectified again


@dataclass(frozen=True)
class PrepareConstants:
    """Empirical constants of the preparation."""

    flying_step: float = 0.03
    """Relative difference of depth [1] by which a flying pixel differs from both of its neighbours. A smaller value
    removes more pixels of slanted surfaces."""
    jump_step: float = 0.02
    """Relative difference of depth [1] between neighbours at an occluding edge. A smaller value masks more grey."""
    jump_sigmas: float = 8.0
    """The same difference [σ]. The second difference of three noisy depths has 2.4 times the noise of one."""
    min_side: int = 12
    """Smallest side [px] of a level. Alignment needs an interior, and the border is one pixel wide."""
    smoothing: float = 0.7
    """σ [px] of the Gaussian that removes the noise of grey. A larger value blurs edges."""


CONSTANTS = PrepareConstants()


@dataclass(frozen=True)
class Level:
    """One pyramid level: grey (H, W) in 0..1, depth (H, W) [m] with 0 missing, and the camera of that size.

    Grey is NaN if it is masked, or if it mixes two surfaces on the finest level of a frame.
    """

    gray: Image
    depth: Image
    camera: Camera


@dataclass(frozen=True)
class PreparedFrame:
    """A frame with its plausible depth and its pyramid; masked pixels have no depth, and their grey is NaN.

    Args:
        frame: the frame, of one instant.
        depth: (H, W) [m] plausible depth at full size, 0 if missing.
        levels: the pyramid, finest level first.
        recorded: the frame as the sensor delivered it.
        twist: (6,) [m/s, rad/s] velocity of the camera with which the frame was rectified, in its own frame.
        started: :func:`time.perf_counter` when work on the frame began.
    """

    frame: Frame
    depth: Image
    levels: tuple[Level, ...]
    recorded: Frame
    twist: NDArray[np.float64]
    started: float = field(default_factory=time.perf_counter, compare=False)


def prepare(recorded: Frame, config: TrackingConfig, twist: NDArray[np.float64] = _AT_REST) -> PreparedFrame:
    """Compute the pyramid of the rectified frame, whose finest level is at most ``config.max_width`` pixels wide.

    It has ``config.n_levels`` levels, or fewer if the next would be smaller than 12 pixels. The finest level determines
    the pose, and has no grey along occluding edges.

    Args:
        recorded: the frame as the sensor delivers it.
        config: settings of tracking.
        twist: (6,) [m/s, rad/s] velocity of the camera in its own frame, see
            :func:`splatbot.tracking.rectify.rectify`.
    """
    started = time.perf_counter()
    frame = rectify(recorded, twist, config.sensor)
    depth = usable_depth(frame, config)
    gray = np.multiply(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.float32(1 / 255), dtype=np.float32)
    if frame.mask is not None:
        gray[~frame.mask] = np.nan  # smoothing and interpolation propagate it
    level = Level(gray, depth, frame.camera)
    while level.camera.width > config.max_width:
        level = halve(level)
    levels = [Level(smoothed(level.gray), level.depth, level.camera)]
    while len(levels) < config.n_levels and min(levels[-1].gray.shape) >= 2 * CONSTANTS.min_side:
        levels.append(halve(levels[-1]))
    levels[0] = Level(gray_of_one_surface(levels[0], config), levels[0].depth, levels[0].camera)
    return PreparedFrame(frame, depth, tuple(levels), recorded, twist, started)


def displacement(prepared: PreparedFrame, twist: NDArray[np.float64], sensor: SensorConfig) -> float:
    """Compute by how much [px] rectification with another twist (6,) moves pixels of colour or depth at most."""
    seconds = sensor.readout + 2 * abs(sensor.depth_delay + prepared.recorded.depth_delay)
    if not seconds:
        return 0.0
    return row_displacement(twist - prepared.twist, typical_depth(prepared), prepared.frame.camera, seconds)


def gray_of_one_surface(level: Level, config: TrackingConfig) -> Image:
    """Return grey (H, W) with NaN along occluding edges.

    An edge is a second difference of inverse depth that noise does not explain. Along a plane, inverse depth is linear
    in the pixel coordinates for any slant.

    At an edge, smoothing and interpolation mix the grey of two surfaces, and other surfaces meet there in other views.
    These pixels are a few percent of the image. Their errors do not average out, and would bias the pose with the
    parallax.
    """
    p, sensor = CONSTANTS, config.sensor
    floor, quad = p.jump_sigmas * sensor.sigma_depth_floor, p.jump_sigmas * sensor.sigma_depth_quad
    return np.asarray(_native.gray_of_one_surface(level.depth, level.gray, p.jump_step, floor, quad))


def smoothed(gray: Image) -> Image:
    """Smooth grey (H, W) for alignment by a Gaussian."""
    return np.asarray(cv2.GaussianBlur(gray, (0, 0), CONSTANTS.smoothing), dtype=np.float32)


def valid_depth(depth: Image, near: float, far: float) -> Image:
    """Set implausible depth (H, W) [m] to 0: out of range, or flying between two surfaces.

    A flying pixel is nearer than one neighbour and farther than the opposite one by more than 3 % of its range. A
    single missing row of neighbours, which registration leaves in upsampled depth, does not invalidate a pixel.
    """
    return np.asarray(_native.valid_depth(np.ascontiguousarray(depth), near, far, CONSTANTS.flying_step))


def usable_depth(frame: Frame, config: TrackingConfig) -> Image:
    """Return the depth (H, W) [m] of a frame, 0 if it is implausible (see :func:`valid_depth`) or masked."""
    depth = valid_depth(frame.depth, config.sensor.min_depth, config.sensor.max_depth)
    return depth if frame.mask is None else np.where(frame.mask, depth, np.float32(0))


def valid_share(prepared: PreparedFrame) -> float:
    """Return the share of the pixels with a usable depth."""
    depth = prepared.levels[0].depth
    return float(np.count_nonzero(depth > 0)) / depth.size


def typical_depth(prepared: PreparedFrame) -> float:
    """Return the median depth [m] of the coarsest level, or 1 if no pixel has a depth."""
    coarse = prepared.levels[-1].depth
    measured = coarse[coarse > 0]
    return float(np.median(measured)) if len(measured) else 1.0


def halve(level: Level) -> Level:
    """Compute the next coarser level: the mean of grey, and depth by :func:`halve_depth`."""
    height, width = level.gray.shape[0] // 2, level.gray.shape[1] // 2
    crop = level.gray[: 2 * height, : 2 * width]
    gray = np.asarray(cv2.resize(crop, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)
    c = level.camera
    camera = Camera(c.fx / 2, c.fy / 2, (c.cx + 0.5) / 2 - 0.5, (c.cy + 0.5) / 2 - 0.5, width, height)
    return Level(gray, halve_depth(level.depth), camera)


def halve_depth(depth: Image) -> Image:
    """Halve the size of a depth image [m]: the mean over the nearest surface of each 2x2 block, 0 without depth."""
    return np.asarray(_native.halve_depth(np.ascontiguousarray(depth)))


def with_depth(levels: Sequence[Level], depth: Image) -> tuple[Level, ...]:
    """Replace the depth of a pyramid by a depth (H, W) [m] of its finest level."""
    out = []
    for level in levels:
        out.append(Level(level.gray, depth, level.camera))
        depth = halve_depth(depth)
    return tuple(out)


def normals_of(depth: Image, camera: Camera) -> Image:
    """Compute unit normals (H, W, 3) towards the camera by central differences, zero without near neighbours."""
    c = camera
    return np.asarray(_native.normals_of(np.ascontiguousarray(depth, np.float32), c.fx, c.fy, c.cx, c.cy))
