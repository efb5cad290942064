"""Normals of measured surfaces, for Gaussians that are to lie in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera

_SAMPLES = 7  # along each side of the window
_SAME = 0.05  # share of its depth by which a pixel of the same surface differs at most
_AGREE = 2.5  # a sample farther from the first fit, in the fit's own RMS, is left out of the second
_LEAST = 8  # samples that a plane needs


def fitted_normals(
    depth: NDArray[np.float32], camera: Camera, rows: NDArray[np.int64], columns: NDArray[np.int64], reach: int
) -> NDArray[np.float64]:
    """Unit normals (P, 3), towards the camera, of the planes that fit the depth around pixels best; zero without any.

    The inverse depth of a plane is linear in the pixel's coordinates, and its noise is alike over a small window, so
    least squares there are linear. A difference of neighbouring pixels, in contrast, divides the sensor's noise by one
    pixel's width: at 2.5 m it says nothing.

    Args:
        depth: (H, W) [m], 0 missing.
        rows, columns: (P,) pixels with depth.
        reach: half the window's side [px].
    """
    at = np.unique(np.rint(np.linspace(-reach, reach, _SAMPLES)).astype(np.int64))
    down, right = (grid.ravel() for grid in np.meshgrid(at, at, indexing="ij"))
    v, u = rows[:, None] + down, columns[:, None] + right
    inside = (v >= 0) & (v < depth.shape[0]) & (u >= 0) & (u < depth.shape[1])
    z = np.where(inside, depth[np.where(inside, v, 0), np.where(inside, u, 0)], 0).astype(np.float64)
    center = depth[rows, columns].astype(np.float64)
    used = (z > 0) & (np.abs(z - center[:, None]) < _SAME * center[:, None])
    inverse = 1.0 / np.where(used, z, 1.0)
    x, y = right / camera.fx, down / camera.fy
    slope, at_center, residual = _fit(inverse, x, y, used)
    rms = np.sqrt((used * residual**2).sum(1) / np.maximum(used.sum(1), 1))
    used &= np.abs(residual) <= _AGREE * rms[:, None] + 1e-9
    slope, at_center, _ = _fit(inverse, x, y, used)
    here = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy], 1)
    normals = np.concatenate([slope, (at_center - (slope * here).sum(1))[:, None]], 1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    known = (used.sum(1, keepdims=True) >= _LEAST) & np.isfinite(length) & (length > 0)
    return np.where(known, -normals / np.where(known, length, 1.0), 0.0)


def _fit(
    value: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64], used: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Least squares of value (P, S) = c + a x + b y over the samples used: (a, b) (P, 2), c (P,), residuals (P, S)."""
    n = np.maximum(used.sum(1), 1)
    mx, my, mv = ((used * t).sum(1) / n for t in (x, y, value))
    dx, dy, dv = x - mx[:, None], y - my[:, None], value - mv[:, None]
    xx, xy, yy, xv, yv = ((used * a * b).sum(1) for a, b in ((dx, dx), (dx, dy), (dy, dy), (dx, dv), (dy, dv)))
    determinant = xx * yy - xy * xy
    known = determinant > 1e-6 * (xx + yy) ** 2  # or all samples lie on one line
    safe = np.where(known, determinant, 1.0)
    slope = np.where(known[:, None], np.stack([yy * xv - xy * yv, xx * yv - xy * xv], 1) / safe[:, None], np.nan)
    at_center = mv - slope[:, 0] * mx - slope[:, 1] * my
    residual = dv - slope[:, :1] * dx - slope[:, 1:] * dy
    return slope, at_center, residual
