"""Shift of depth on colour and the time between both, from the edges that both images show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.calibration.estimate import Estimate
from splatbot.evaluation.registration import edge_correlation
from splatbot.frame import Frame

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DepthTimingConstants:
    """Constants of the estimation of shift and delay."""

    shift_range: float = 0.02
    """Largest shift in each direction [share of width]."""
    delay_range: float = 0.05
    """Largest delay in each direction [s]."""
    delay_step: float = 1e-3
    """Step of the searched delays [s]; a parabola interpolates between them."""
    reach: float = 0.1
    """Largest displacement by shift and motion [share of width]."""
    blocks: int = 8
    """Blocks of consecutive frames of the jackknife [1]."""
    min_edges: int = 2000
    """Edge pixels [1] of all frames."""
    shift_floor: float = 0.4
    """Standard deviation [px] that more frames do not reduce: depth sensors widen near objects."""
    delay_floor: float = 3e-4
    """Standard deviation [s] that more frames do not reduce, of the velocities."""
    min_travel: float = 0.25
    """Path of the image over the log [share of width]. The edges of a single view favour one side of objects."""
    largest_shift_sigma: float = 1.0
    """Standard deviation [px] above which the shift is refused."""
    largest_delay_sigma: float = 3e-3
    """Standard deviation [s] above which the delay is refused: 3 px at 120 °/s."""


CONSTANTS = DepthTimingConstants()


@dataclass(frozen=True)
class DepthTiming:
    """Result of the estimation.

    Args:
        right: shift that moves depth onto its colour, to the right [px].
        down: the same shift, downwards [px].
        delay: time by which depth is later than colour [s].
    """

    right: Estimate
    down: Estimate
    delay: Estimate


def estimate_depth_timing(frames: Sequence[Frame], twists: Mapping[int, Array]) -> DepthTiming:
    """Estimate shift and delay of depth from frames and the twists (6,) [m/s, rad/s] of some of them.

    Depth that is τ seconds late is displaced by τ c_k, where c_k is the image velocity of its edges. A shift of
    d_k = (right, down) - (τ + τ_k) c_k aligns the depth of frame k, where τ_k is the difference of its two stamps. The
    estimate maximises the sum over all frames of the correlation of depth edges, shifted by d_k, with the gradient
    magnitude of colour. A jackknife over blocks of frames gives the covariance (Efron and Stein 1981).
    """
    p = CONSTANTS
    chosen = [k for k in sorted(twists) if k < len(frames)]
    volumes, edges = [], 0
    for block in np.array_split(chosen, p.blocks):
        parts = [_scores(frames[k], twists[k]) for k in block.tolist()]
        volumes.append(sum((volume for volume, _ in parts), np.zeros(1)))
        edges += sum(count for _, count in parts)
    need = "turn the camera at changing speed past objects in front of a background"
    if edges < p.min_edges or any(volume.ndim == 1 for volume in volumes):
        refused = [Estimate(0.0, np.inf, unit, f"too few depth edges: {need}") for unit in ("px", "px", "s")]
        return DepthTiming(*refused)
    total = np.asarray(sum(volumes, np.zeros(1)), dtype=np.float64)
    best = _peak(total, frames[0])
    others = np.array([_peak(total - volume, frames[0]) for volume in volumes])
    spread = (p.blocks - 1) / p.blocks * ((others - others.mean(0)) ** 2).sum(0)
    sigma = np.sqrt(spread + np.array([p.delay_floor, p.shift_floor, p.shift_floor]) ** 2)
    sigma = np.where(_is_at_border(best, frames[0]), np.inf, sigma)
    velocities = np.array([image_velocity(frames[k], twists[k]) for k in chosen])
    if velocities.std(0).max() * p.largest_delay_sigma < p.shift_floor:
        sigma[0] = np.inf
    gaps = np.diff([frame.stamp for frame in frames])
    if np.linalg.norm(velocities, axis=1).sum() * float(np.median(gaps)) < p.min_travel * frames[0].camera.width:
        sigma[:] = np.inf
    return DepthTiming(
        Estimate.limited(float(best[2]), float(sigma[2]), "px", p.largest_shift_sigma, need),
        Estimate.limited(float(best[1]), float(sigma[1]), "px", p.largest_shift_sigma, need),
        Estimate.limited(float(best[0]), float(sigma[0]), "s", p.largest_delay_sigma, need),
    )


def image_velocity(frame: Frame, twist: Array) -> Array:
    """Return the mean velocity (2,) [px/s] of the depth pixels of a frame by the twist (6,) of the camera."""
    depth = frame.depth[::8, ::8].astype(np.float64)
    rows, columns = np.nonzero(depth)
    if not len(rows):
        return np.zeros(2)
    z, u, v = depth[rows, columns], 8.0 * columns, 8.0 * rows
    c = frame.camera
    points = np.stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z], axis=1)
    later = points - 1e-3 * (twist[:3] + np.cross(twist[3:], points))
    return np.asarray((c.project(later) - c.project(points)).mean(0) / 1e-3, dtype=np.float64)


def _delays() -> Array:
    count = round(CONSTANTS.delay_range / CONSTANTS.delay_step)
    return np.asarray(CONSTANTS.delay_step * np.arange(-count, count + 1), dtype=np.float64)


def _shift_radius(frame: Frame) -> int:
    return max(2, round(CONSTANTS.shift_range * frame.camera.width))


def _scores(frame: Frame, twist: Array) -> tuple[Array, int]:
    """Return the correlation at each delay and shift (T, 2R + 1, 2R + 1) of one frame, and its number of edges."""
    reach = min(round(CONSTANTS.reach * frame.camera.width), (min(frame.depth.shape) - 1) // 2 - 1)
    surface, edges = edge_correlation(frame, reach)
    velocity, radius = image_velocity(frame, twist), _shift_radius(frame)
    size = 2 * radius + 1
    layers = []
    for delay in _delays():
        at = (
            np.array([reach - radius, reach - radius]) - (delay + frame.depth_delay) * velocity
        )  # corner (u, v) in the surface
        M = np.array([[1.0, 0.0, at[0]], [0.0, 1.0, at[1]]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        layers.append(cv2.warpAffine(surface, M, (size, size), flags=flags, borderMode=cv2.BORDER_CONSTANT))
    return np.array(layers, dtype=np.float64), edges


def _peak(volume: Array, frame: Frame) -> Array:
    """Return delay [s], shift down and shift right [px] of the maximum, by a parabola along each axis."""
    at = np.array(np.unravel_index(volume.argmax(), volume.shape))
    exact = at.astype(np.float64)
    for axis, k in enumerate(at):
        if 0 < k < volume.shape[axis] - 1:
            before, here, after = (volume[tuple(at + d * (np.arange(3) == axis))] for d in (-1, 0, 1))
            bend = before - 2 * here + after
            exact[axis] += 0.5 * (before - after) / bend if bend < 0 else 0.0
    radius = _shift_radius(frame)
    return np.array([(exact[0] - len(volume) // 2) * CONSTANTS.delay_step, exact[1] - radius, exact[2] - radius])


def _is_at_border(peak: Array, frame: Frame) -> Array:
    limits = np.array([CONSTANTS.delay_range, *[_shift_radius(frame)] * 2])
    return np.asarray(np.abs(peak) > 0.95 * limits)
