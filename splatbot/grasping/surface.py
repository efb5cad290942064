"""What was measured of a target's surface, as oriented points: its Gaussians."""

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

MOST = 1800  # points that are looked at
_OFTEN = 0.2  # of the keyframes that the best Gaussians are supported by
_SMOOTH = 0.006  # [m] over which normals are averaged
_SAME_SIDE, _ALIKE = 0.3, 0.8  # cosines between normals that are averaged; where rims are to stay sharp
_LONELY = 4.0  # times the usual area of a point; those with more are strays


@dataclass(frozen=True, eq=False)
class GraspSurface:
    """M oriented points on a target.

    Args:
        points: (M, 3) [m, world].
        normals: (M, 3) unit, outwards.
        half: (M, 3, 3) principal axes as columns, each as long as its standard deviation [m]; 0 of what is implied.
        spread: (M,) the largest of them [m]; of what is implied, half of the distance between its points.
        seen: (M,) whether it was measured; the others are implied.
        doubt: (M,) standard deviation of where the point is along its normal [m]; of a back whose depth is guessed,
            that of the guess.
        center: (3,) middle of its box [m, world].
    """

    points: Array
    normals: Array
    half: Array
    spread: Array
    seen: NDArray[np.bool_]
    doubt: Array
    center: Array

    def __len__(self) -> int:
        return len(self.points)

    def select(self, chosen: NDArray[np.int64]) -> GraspSurface:
        """The points that are named, about the same centre."""
        columns = (self.points, self.normals, self.half, self.spread)
        points, normals, half, spread = (column[chosen] for column in columns)
        return GraspSurface(points, normals, half, spread, self.seen[chosen], self.doubt[chosen], self.center)


def measured_surface(
    scene: SegmentedMap,
    rows: NDArray[np.int64],
    *,
    observers: Array | None = None,
    seed: int = 0,
    sharp: bool = False,
) -> tuple[GraspSurface, Array]:
    """The Gaussians ``rows`` (M,) of a scene as points, strays left out, and the area each stands for (K,) [m²].

    Normals are the Gaussians' flat axes, averaged over 6 mm, turned to who saw them, or else away from the middle.

    Args:
        scene: the map.
        rows: of the target.
        observers: (N, 3) where each Gaussian of the map was seen from [m, world], NaN where that is not known.
        seed: of which Gaussians are kept where there are more than 1800.
        sharp: average normals with those alike alone: noisier, but the rim of what is low is not rounded by its top.
    """
    rng = np.random.default_rng(seed)
    seen_by = scene.model.observations.numpy()[rows]  # what few keyframes saw is often smeared beyond an edge
    rows = rows[seen_by >= _OFTEN * np.percentile(seen_by, 90)] if len(rows) else rows
    chosen = rows if len(rows) <= MOST else np.sort(rng.choice(rows, MOST, replace=False))
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
    normals, areas = _smoothed(points, normals, flatness, cosine=_ALIKE if sharp else _SAME_SIDE)
    doubt = _doubts(model, scales)
    half = (rotations(model) * model.scales[:, None, :]).detach().double().numpy()
    kept = np.flatnonzero(areas < _LONELY * np.median(areas))
    apart = np.sqrt(areas)
    spread = np.where(apart > 2 * scales[:, 2], 1.2 * apart, scales[:, 2])  # where only some of many are looked at
    seen = GraspSurface(points, normals, half, spread, np.ones(len(points), np.bool_), doubt, center)
    return seen.select(kept), areas[kept]


def _doubts(model: GaussianModel, scales: Array) -> Array:
    """By the depth fused into them, or of a map from elsewhere their thickness."""
    fused = model.uncertainty.detach().double().numpy()
    return np.where(fused > 0, fused, scales[:, 0])


def _middle(scene: SegmentedMap, points: Array) -> Array:
    """Half way between the highest point and what the target stands on."""
    local = transform_points(inverse(scene.T_world_base), points)
    low, high = np.percentile(local, [1, 99], axis=0)
    support = scene.under(local)
    if support is not None:
        low[2] -= np.clip(float(np.percentile(support.height(local), 1)), 0.0, 0.03)
    return transform_points(scene.T_world_base, (low + high) / 2)


def _smoothed(points: Array, normals: Array, flatness: Array, *, cosine: float) -> tuple[Array, Array]:
    """Normals averaged with those of neighbours alike, and the area that each point stands for (M,) [m²].

    Round Gaussians have little to say.
    """
    p, n = (points - points.mean(axis=0)).astype(np.float32), normals.astype(np.float32)
    square = (p**2).sum(axis=1)
    weight = np.maximum(square[:, None] + square[None] - 2 * (p @ p.T), 0.0)
    np.exp(weight * (-0.5 / _SMOOTH**2), out=weight)
    crowd = weight.sum(axis=1)
    weight *= n @ n.T > cosine
    weight *= np.maximum(flatness, 0.05).astype(np.float32)
    mean = (weight @ n).astype(np.float64)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return mean, np.asarray(2 * np.pi * _SMOOTH**2 / crowd, dtype=np.float64)
