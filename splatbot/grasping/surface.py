"""Observed surface of a target as oriented points: the means and shortest axes of its Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import rotations, shortest_axes
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array
from splatbot.segmentation import SegmentedMap


@dataclass(frozen=True)
class SurfaceConstants:
    """Constants of the observed surface."""

    min_support: float = 0.2
    """Smallest number of observations [1] of a Gaussian, as a share of the 90th percentile. A larger one removes more
    floaters, and sides that few frames show."""
    smoothing_cosine: float = 0.3
    """Smallest cosine [1] between normals that are averaged. A larger one keeps more noise."""
    sharp_cosine: float = 0.8
    """Smallest cosine [1] between normals that are averaged where edges stay sharp. A smaller one rounds them."""
    max_area_ratio: float = 4.0
    """Ratio [1] to the median area above which a point is a stray. A larger one keeps isolated points."""
    max_points: int = 1800
    """Largest number of points [1] on a surface; more are subsampled. Smoothing takes quadratically longer with more of
    them."""
    smoothing: float = 0.006
    """Standard deviation [m] of the kernel that averages normals. A larger one flattens small objects."""


CONSTANTS = SurfaceConstants()


@dataclass(frozen=True, eq=False)
class GraspSurface:
    """M oriented points on a target.

    Args:
        points: (M, 3) [m, world].
        normals: (M, 3) outward unit normals.
        axes: (M, 3, 3) principal axes as columns, each as long as its standard deviation [m]; 0 for completed points.
        spread: (M,) largest standard deviation [m]; for completed points half of their spacing.
        observed: (M,) True for observed points, False for completed points.
        normal_std: (M,) standard deviation of the point along its normal [m]. It includes the uncertainty of the
            object's depth for points of a completed back.
        center: (3,) centre of the bounding box [m, world].
    """

    points: Array
    normals: Array
    axes: Array
    spread: Array
    observed: NDArray[np.bool_]
    normal_std: Array
    center: Array

    def __len__(self) -> int:
        return len(self.points)

    def select(self, chosen: NDArray[np.int64]) -> GraspSurface:
        """Return the chosen points with the same centre."""
        columns = (self.points, self.normals, self.axes, self.spread)
        points, normals, axes, spread = (column[chosen] for column in columns)
        return GraspSurface(points, normals, axes, spread, self.observed[chosen], self.normal_std[chosen], self.center)


def measured_surface(
    scene: SegmentedMap,
    rows: NDArray[np.int64],
    *,
    observers: Array | None = None,
    seed: int = 0,
    sharp: bool = False,
) -> tuple[GraspSurface, Array]:
    """Return the Gaussians ``rows`` (M,) of a scene as oriented points without strays, and their areas (K,) [m²].

    A normal is the shortest axis of its Gaussian, averaged over neighbours with a Gaussian kernel of 6 mm. It points to
    the camera that observed the Gaussian, or away from the centre of the target if that camera is unknown.

    Args:
        scene: the segmented map.
        rows: (M,) indices of the target's Gaussians.
        observers: (N, 3) camera centre from which each Gaussian was observed [m, world], NaN where unknown.
        seed: seed of the subsampling of more than 1800 Gaussians.
        sharp: average only nearly parallel normals. Normals are noisier, but the edge of a low object is not rounded
            by its top.
    """
    rng = np.random.default_rng(seed)
    # Gaussians with few observations are often flying pixels next to a depth edge.
    support = scene.model.observations.numpy()[rows]
    rows = rows[support >= CONSTANTS.min_support * np.percentile(support, 90)] if len(rows) else rows
    chosen = (
        rows if len(rows) <= CONSTANTS.max_points else np.sort(rng.choice(rows, CONSTANTS.max_points, replace=False))
    )
    model = scene.model.select(torch.from_numpy(chosen))
    points = model.means.detach().double().numpy()
    scales = np.sort(model.scales.detach().double().numpy(), axis=1)
    center = _middle(scene, points)
    outward = points - center
    if observers is not None:
        outward = np.where(np.isfinite(observers[chosen]), observers[chosen] - points, outward)
    normals = shortest_axes(model).detach().double().numpy()
    normals = normals * np.where(np.einsum("ij,ij->i", normals, outward) < 0, -1.0, 1.0)[:, None]
    flatness = 1.0 - scales[:, 0] / np.maximum(scales[:, 1], 1e-12)
    normals, areas = _smoothed(
        points, normals, flatness, cosine=CONSTANTS.sharp_cosine if sharp else CONSTANTS.smoothing_cosine
    )
    normal_std = _normal_stds(model, scales)
    axes = (rotations(model) * model.scales[:, None, :]).detach().double().numpy()
    kept = np.flatnonzero(areas < CONSTANTS.max_area_ratio * np.median(areas))
    spacing = np.sqrt(areas)
    spread = np.where(spacing > 2 * scales[:, 2], 1.2 * spacing, scales[:, 2])  # cover the gaps of a subsample
    surface = GraspSurface(points, normals, axes, spread, np.ones(len(points), np.bool_), normal_std, center)
    return surface.select(kept), areas[kept]


def _normal_stds(model: GaussianModel, scales: Array) -> Array:
    """Return standard deviations along the normal (M,) [m]: from depth fusion, else the thickness of the Gaussian."""
    fused = model.uncertainty.detach().double().numpy()
    return np.where(fused > 0, fused, scales[:, 0])


def _middle(scene: SegmentedMap, points: Array) -> Array:
    """Return the centre (3,) [m, world] of the box around the points, extended down to the support plane."""
    local = transform_points(inverse(scene.T_world_base), points)
    low, high = np.percentile(local, [1, 99], axis=0)
    support = scene.under(local)
    if support is not None:
        low[2] -= np.clip(float(np.percentile(support.height(local), 1)), 0.0, 0.03)
    return transform_points(scene.T_world_base, (low + high) / 2)


def _smoothed(points: Array, normals: Array, flatness: Array, *, cosine: float) -> tuple[Array, Array]:
    """Average normals with those of similar neighbours, and estimate the area of each point (M,) [m²].

    The weight of a neighbour is w_ij = exp(-|p_i - p_j|² / 2s²) * max(flatness_j, 0.05), so that round Gaussians, whose
    shortest axis is uncertain, count little. With the kernel density the area is A_i = 2 pi s² / sum_j exp(...).
    """
    p, n = (points - points.mean(axis=0)).astype(np.float32), normals.astype(np.float32)
    square = (p**2).sum(axis=1)
    weight = np.maximum(square[:, None] + square[None] - 2 * (p @ p.T), 0.0)
    np.exp(weight * (-0.5 / CONSTANTS.smoothing**2), out=weight)
    density = weight.sum(axis=1)
    weight *= n @ n.T > cosine
    weight *= np.maximum(flatness, 0.05).astype(np.float32)
    mean = (weight @ n).astype(np.float64)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return mean, np.asarray(2 * np.pi * CONSTANTS.smoothing**2 / density, dtype=np.float64)
