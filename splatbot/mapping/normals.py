"""Surface normals, estimated from depth images."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera


@dataclass(frozen=True)
class NormalConstants:
    """Constants of normal estimation.

    Args:
        window_samples: samples along each side of the window.
        same_surface_share: [share of depth] samples with a larger depth difference belong to another surface.
        outlier_rms: [RMS of the first fit] samples with a larger residual are excluded from the second fit.
        flat_share: [share of depth] a window with a larger RMS distance from its plane holds several surfaces.
        least_samples: samples that a plane needs.
        least_coverage: share of the window that needs depth.
    """

    window_samples: int = 7
    same_surface_share: float = 0.05
    outlier_rms: float = 2.5
    flat_share: float = 0.01
    least_samples: int = 8
    least_coverage: float = 0.5


CONSTANTS = NormalConstants()


def smooth_normals(
    depth: NDArray[np.float32], camera: Camera, rows: NDArray[np.int64], columns: NDArray[np.int64], reach: int
) -> NDArray[np.float64]:
    """Compute unit normals (P, 3) at pixels, towards the camera; zero for a window with an edge or too little depth.

    It fits the planes of :func:`fitted_normals` to all pixels of the window, by box filters.

    Args:
        depth: (H, W) [m], 0 missing.
        rows, columns: (P,) pixels.
        reach: half the window's side [px].
    """
    side = (2 * reach + 1,) * 2
    known = depth > 0
    value = np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0).astype(np.float64)
    y, x = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]].astype(np.float64)
    x, y = (x - camera.cx) / camera.fx * known, (y - camera.cy) / camera.fy * known

    def total(image: NDArray[np.float64]) -> NDArray[np.float64]:
        summed = cv2.boxFilter(image, -1, side, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed, dtype=np.float64)[rows, columns]

    count = total(known.astype(np.float64))
    n = np.maximum(count, 1)
    mx, my, mv = total(x) / n, total(y) / n, total(value) / n
    xv, yv, vv = total(x * value) - n * mx * mv, total(y * value) - n * my * mv, total(value * value) - n * mv * mv
    moments = total(x * x) - n * mx * mx, total(x * y) - n * mx * my, total(y * y) - n * my * my
    slope = _slope(*moments, xv, yv)
    rms = np.sqrt(np.maximum(vv - slope[..., 0] * xv - slope[..., 1] * yv, 0.0) / n)
    at = depth[rows, columns]
    flat = (at > 0) & (count > CONSTANTS.least_coverage * side[0] ** 2) & (rms * at < CONSTANTS.flat_share)
    normals = _from_inverse_depth(slope, mv - slope[..., 0] * mx - slope[..., 1] * my)
    return np.where(flat[..., None], normals, 0.0)


def fitted_normals(
    depth: NDArray[np.float32], camera: Camera, rows: NDArray[np.int64], columns: NDArray[np.int64], reach: int
) -> NDArray[np.float64]:
    """Compute unit normals (P, 3), towards the camera, of planes fitted to the depth around pixels; zero without a fit.

    The inverse depth of a plane is linear in the pixel coordinates, 1/z = c + a x/z + b y/z. Its noise is nearly
    constant over a small window, so linear least squares fits it. The difference of neighboring pixels, in contrast,
    divides the sensor noise by the width of one pixel and is useless at 2.5 m.

    Args:
        depth: (H, W) [m], 0 missing.
        rows, columns: (P,) pixels with depth.
        reach: half the window's side [px].
    """
    at = np.unique(np.rint(np.linspace(-reach, reach, CONSTANTS.window_samples)).astype(np.int64))
    down, right = (grid.ravel() for grid in np.meshgrid(at, at, indexing="ij"))
    v, u = rows[:, None] + down, columns[:, None] + right
    inside = (v >= 0) & (v < depth.shape[0]) & (u >= 0) & (u < depth.shape[1])
    z = np.where(inside, depth[np.where(inside, v, 0), np.where(inside, u, 0)], 0).astype(np.float64)
    center = depth[rows, columns].astype(np.float64)
    used = (z > 0) & (np.abs(z - center[:, None]) < CONSTANTS.same_surface_share * center[:, None])
    inverse = 1.0 / np.where(used, z, 1.0)
    x, y = right / camera.fx, down / camera.fy
    here = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy], 1)
    _, _, residual = _fit(inverse, x, y, used)
    rms = np.sqrt((used * residual**2).sum(1) / np.maximum(used.sum(1), 1))
    used &= np.abs(residual) <= CONSTANTS.outlier_rms * rms[:, None] + 1e-9
    slope, at_center, _ = _fit(inverse, x, y, used)
    normals = _from_inverse_depth(slope, at_center - (slope * here).sum(1))
    normals[used.sum(1) < CONSTANTS.least_samples] = 0.0
    return normals


def _fit(
    value: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64], used: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fit value (P, S) = c + a x + b y to the used samples; return (a, b) (P, 2), c (P,) and residuals (P, S)."""
    n = np.maximum(used.sum(1), 1)
    mx, my, mv = ((used * t).sum(1) / n for t in (x, y, value))
    dx, dy, dv = x - mx[:, None], y - my[:, None], value - mv[:, None]
    xx, xy, yy, xv, yv = ((used * a * b).sum(1) for a, b in ((dx, dx), (dx, dy), (dy, dy), (dx, dv), (dy, dv)))
    slope = _slope(xx, xy, yy, xv, yv)
    at_center = mv - slope[:, 0] * mx - slope[:, 1] * my
    residual = dv - slope[:, :1] * dx - slope[:, 1:] * dy
    return slope, at_center, residual


def _slope(
    xx: NDArray[np.float64],
    xy: NDArray[np.float64],
    yy: NDArray[np.float64],
    xv: NDArray[np.float64],
    yv: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Compute the slopes (..., 2) of least squares from central moments (...); NaN if all samples are collinear."""
    determinant = xx * yy - xy * xy
    known = determinant > 1e-6 * (xx + yy) ** 2
    safe = np.where(known, determinant, np.nan)
    return np.stack([(yy * xv - xy * yv) / safe, (xx * yv - xy * xv) / safe], -1)


def _from_inverse_depth(slope: NDArray[np.float64], at_axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute unit normals (..., 3) towards the camera of planes 1/z = at_axis + slope · (x/z, y/z); zero for NaN."""
    normals = -np.concatenate([slope, at_axis[..., None]], -1)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    known = np.isfinite(length) & (length > 0)
    return np.where(known, normals / np.where(known, length, 1.0), 0.0)
