"""Distances between a reconstructed surface and the true one (Knapitsch et al. 2017, Sec. 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError

Array = NDArray[np.float64]
Surface = tuple[Array, NDArray[np.integer]]
"""Vertices (V, 3) [m] and triangles (T, 3) of their indices."""


@dataclass(frozen=True)
class MeshScore:
    """Distances of a reconstructed surface.

    Args:
        accuracy_m: mean distance of its points from the true surface [m].
        completeness_m: mean distance of the true points from it [m].
        precision, recall: shares of these distances below the tolerance, 0 to 1.
    """

    accuracy_m: float
    completeness_m: float
    precision: float
    recall: float

    @property
    def f_score(self) -> float:
        """Harmonic mean of precision and recall."""
        both = self.precision + self.recall
        return 2 * self.precision * self.recall / both if both > 0 else 0.0


def score_mesh(
    found: Surface, true: Surface, seen: Array, *, tolerance: float, samples: int = 100_000, seed: int = 0
) -> MeshScore:
    """Compare a surface with the true one, by points that are uniform on it and by given points on the true one.

    Args:
        found: the reconstructed surface.
        true: the true surface.
        seen: (P, 3) points of the true surface that the reconstruction can know [m].
        tolerance: distance of a correct point [m].
        samples: number of points on the reconstructed surface.
        seed: of these points.

    Raises:
        InputError: a surface has no area, or there is no point.
    """
    if not len(seen):
        raise InputError("has no point.", field="seen", hint="give points of the true surface")
    for name, (vertices, triangles) in (("found", found), ("true", true)):
        if not len(triangles) or not _areas(vertices, triangles).sum() > 0:
            raise InputError("has no area.", field=name, hint="give a triangle mesh")
    accuracy = _distances(points_on(found, samples, np.random.default_rng(seed)), true)
    completeness = _distances(seen, found)
    return MeshScore(
        float(accuracy.mean()),
        float(completeness.mean()),
        float((accuracy < tolerance).mean()),
        float((completeness < tolerance).mean()),
    )


def points_on(surface: Surface, count: int, random: np.random.Generator) -> Array:
    """Return points (count, 3) [m], uniform on a surface."""
    vertices, triangles = surface
    areas = _areas(vertices, triangles)
    chosen = triangles[random.choice(len(triangles), count, p=areas / areas.sum())]
    u, v = random.random((2, count, 1))
    beyond = u + v > 1
    u, v = np.where(beyond, 1 - u, u), np.where(beyond, 1 - v, v)
    a, b, c = (vertices[chosen[:, k]] for k in range(3))
    return np.asarray(a + u * (b - a) + v * (c - a))


def _areas(vertices: Array, triangles: NDArray[np.integer]) -> Array:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def _distances(points: Array, surface: Surface) -> Array:
    """Return the distances (P,) [m] of points (P, 3) from a surface, in float32."""
    import open3d as o3d

    vertices, triangles = surface
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(vertices, dtype=np.float32)),
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles, dtype=np.uint32)),
    )
    distances = scene.compute_distance(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, dtype=np.float32)))
    return np.asarray(distances.numpy(), dtype=np.float64)
