"""Check the collision field of trained maps: `python -m experiments.trained_solids RUN|TRAINING|MAP ...`.

It draws spheres next to points on the ellipsoids of a map. The centre of a sphere lies on the normal of its point, so
that the gap is exact. Half of the spheres overlap, by 1 nm to 5 mm. A test of spheres and ellipsoids in float64, which
shares no code with the field, decides whether a sphere touches any other ellipsoid.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from splatbot.collision import GaussianCollisionField
from splatbot.collision.solids import SCALE_FLOOR, SolidGate
from splatbot.gaussians import GaussianModel
from splatbot.layouts import map_file

Array = NDArray[np.float64]

N_SIGMAS = (1.0, 2.0, 3.0)
_BATCH = 2_000  # spheres
_LEAST_GAP, _LARGEST_GAP = 1e-9, 5e-3  # [m]
_LEAST_RADIUS, _LARGEST_RADIUS = 1e-3, 0.05  # [m]
_HALVINGS = 60


@dataclass(frozen=True)
class Verdict:
    """Answers of a field next to those of the test in float64.

    Args:
        solids: number of ellipsoids.
        spheres: number of spheres.
        touching: spheres that touch an ellipsoid.
        false_free: touching spheres that the field reports as free.
        false_hits: free spheres that the field reports as touching.
        widest: largest gap of these [m]; 0 if there are no false hits.
    """

    solids: int
    spheres: int
    touching: int
    false_free: int
    false_hits: int
    widest: float


@dataclass(frozen=True)
class Ellipsoids:
    """N ellipsoids in float64.

    Args:
        centres: (N, 3) [m, world].
        rotations: (N, 3, 3), from the axes to the world.
        axes: (N, 3), semi-axes [m].
    """

    centres: Array
    rotations: Array
    axes: Array

    @staticmethod
    def of(model: GaussianModel, n_sigma: float) -> Ellipsoids:
        """Return the ellipsoids of the solid Gaussians of a map."""
        solid = SolidGate().solid(model)
        rotations = Rotation.from_quat(model.quats.double().numpy()[solid], scalar_first=True).as_matrix()
        scales = np.exp(model.log_scales.double().numpy()[solid])
        return Ellipsoids(model.means.double().numpy()[solid], rotations, n_sigma * np.maximum(scales, SCALE_FLOOR))

    def spheres(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw spheres (S, 4) next to the surfaces.

        Returns:
            the spheres (x, y, z, radius) [m, world], and the gap (S,) of each to its ellipsoid [m]. Below 0 they
            overlap.
        """
        chosen = rng.integers(0, len(self.axes), count)
        axes, rotations = self.axes[chosen], self.rotations[chosen]
        unit = rng.normal(size=(count, 3))
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        normals = unit / axes
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        radii = _log_uniform(rng, _LEAST_RADIUS, _LARGEST_RADIUS, count)
        gaps = _log_uniform(rng, _LEAST_GAP, _LARGEST_GAP, count) * np.where(np.arange(count) % 2, 1.0, -1.0)
        gaps = np.maximum(gaps, -0.5 * radii)  # the centre stays outside, where the normal meets it
        local = axes * unit + (radii + gaps)[:, None] * normals
        centres = self.centres[chosen] + np.einsum("nij,nj->ni", rotations, local)
        return np.column_stack([centres, radii]), gaps

    def distances(self, points: Array) -> Array:
        """Return distances (P,) of points (P, 3) to the nearest ellipsoid of any, 0 inside; infinite beyond 0.1 m."""
        least = np.full(len(points), 0.1)
        octaves = np.floor(np.log2(self.axes.max(axis=1)))
        for octave in np.unique(octaves):
            members = np.flatnonzero(octaves == octave)
            near = cKDTree(self.centres[members]).query_ball_point(points, 2.0 ** (octave + 1) + least)
            point = np.repeat(np.arange(len(points)), [len(found) for found in near])
            solid = members[np.concatenate([np.asarray(found, np.int64) for found in near])]
            local = np.einsum("nji,nj->ni", self.rotations[solid], points[point] - self.centres[solid])
            np.minimum.at(least, point, point_distances(local, self.axes[solid]))
        return np.where(least < 0.1, least, np.inf)


def point_distances(points: Array, axes: Array) -> Array:
    """Return distances (P,) of points (P, 3) to ellipsoids along the axes, with semi-axes (P, 3); 0 inside.

    The nearest point is a² v / (a² + t) at the root t of Σ (a v / (a² + t))² = 1, found by bisection.
    """
    squares, products = axes**2, axes * points
    low, high = np.zeros(len(points)), axes.max(axis=1, initial=0.0) * np.linalg.norm(points, axis=1)
    for _ in range(_HALVINGS):
        t = 0.5 * (low + high)
        is_below = ((products / (squares + t[:, None])) ** 2).sum(axis=1) > 1.0
        low, high = np.where(is_below, t, low), np.where(is_below, high, t)
    return np.linalg.norm(low[:, None] * points / (squares + low[:, None]), axis=1)


def judge(model: GaussianModel, n_sigma: float, count: int) -> Verdict:
    """Compare the field of a map with the test in float64, for ``count`` spheres."""
    field, solids = GaussianCollisionField(model, n_sigma), Ellipsoids.of(model, n_sigma)
    spheres, own_gaps = solids.spheres(count, np.random.default_rng(0))
    batches = np.array_split(spheres[:, :3], -(-count // _BATCH))
    gaps = np.minimum(np.concatenate([solids.distances(batch) for batch in batches]) - spheres[:, 3], own_gaps)
    touches, hits = gaps <= 0.0, field.in_collision(spheres)
    false_hits = hits & ~touches
    return Verdict(
        solids=len(solids.axes),
        spheres=count,
        touching=int(touches.sum()),
        false_free=int((touches & ~hits).sum()),
        false_hits=int(false_hits.sum()),
        widest=float(gaps[false_hits].max(initial=0.0)),
    )


def _log_uniform(rng: np.random.Generator, low: float, high: float, count: int) -> Array:
    return np.exp(rng.uniform(np.log(low), np.log(high), count))


def main(argv: Sequence[str]) -> None:
    """Print a line for each map and number of sigmas, with 100,000 spheres."""
    for name in argv:
        model = GaussianModel.load(map_file(Path(name)))
        for n_sigma in N_SIGMAS:
            v = judge(model, n_sigma, 100_000)
            print(f"{name}, {n_sigma:g} sigma, {v.solids:,} ellipsoids: {v.touching:,} of {v.spheres:,} spheres touch,")
            print(f"    {v.false_free} of these are free in the field; {v.false_hits} false hits, gap {v.widest:.1e} m")


if __name__ == "__main__":
    main(sys.argv[1:])
