"""A table, a shelf and ten objects of analytic shapes within a robot's reach, as truth and as Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot.gaussians import GaussianModel
from splatbot.geometry import rotation_to_quat

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TabletopConstants:
    """Constants of Gaussians on a table top.

    Args:
        normal_sigma: [m] standard deviation of a Gaussian along its normal.
        overlap: [spacing] tangential standard deviation of a Gaussian.
    """

    normal_sigma: float = 1.5e-3
    overlap: float = 0.55


CONSTANTS = TabletopConstants()


class Solid(Protocol):
    """A closed body with an exact signed distance."""

    def distance(self, points: Array) -> Array:
        """Return the signed distance (P,) [m] of points (P, 3)."""
        ...

    def patches(self) -> list[Patch]:
        """Return the patches of its surface."""
        ...


@dataclass(frozen=True, eq=False)
class Patch:
    """A rectangle of parameters (u, v) in [0, width] x [0, height] [m] mapped to a surface.

    ``at`` gives points (P, 3), unit tangents along u (P, 3), unit normals (P, 3) and whether each is on the surface.
    """

    width: float
    height: float
    at: _Map


class _Map(Protocol):
    def __call__(self, u: Array, v: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]: ...


@dataclass(frozen=True)
class Block:
    """An upright box: centre and size [m], turned about z by ``yaw``."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float = 0.0

    def _rotation(self) -> Array:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])

    def distance(self, points: Array) -> Array:
        """Return the exact signed distance (P,) [m] of points (P, 3)."""
        q = np.abs((points - np.asarray(self.center)) @ self._rotation()) - np.asarray(self.size) / 2
        return np.asarray(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0))

    def patches(self) -> list[Patch]:
        """Return the six faces."""
        R, half = self._rotation(), np.asarray(self.size) / 2
        found = []
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            for sign in (-1.0, 1.0):
                normal = sign * R[:, k]
                corner = np.asarray(self.center) + normal * half[k] - R[:, i] * half[i] - R[:, j] * half[j]
                found.append(Patch(self.size[i], self.size[j], _plane(corner, R[:, i], R[:, j], normal)))
        return found


@dataclass(frozen=True)
class Can:
    """An upright cylinder: centre of its foot, radius, height [m]."""

    foot: tuple[float, float, float]
    radius: float
    height: float

    def distance(self, points: Array) -> Array:
        """Return the exact signed distance (P,) [m] of points (P, 3)."""
        p = points - np.asarray(self.foot)
        q = np.stack(
            [np.hypot(p[:, 0], p[:, 1]) - self.radius, np.abs(p[:, 2] - self.height / 2) - self.height / 2], axis=1
        )
        return np.asarray(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0))

    def patches(self) -> list[Patch]:
        """Return the side and both lids."""
        foot, r = np.asarray(self.foot), self.radius

        def side(u: Array, v: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
            turn = u / r
            out = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
            along = np.stack([-np.sin(turn), np.cos(turn), np.zeros_like(turn)], axis=1)
            return foot + r * out + v[:, None] * [0, 0, 1.0], along, out, np.ones(len(u), bool)

        lids = []
        for sign, z in ((-1.0, 0.0), (1.0, self.height)):
            corner = foot + np.array([-r, -r, z])
            plane = _plane(corner, np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, sign]))
            lids.append(Patch(2 * r, 2 * r, _within(plane, foot + np.array([0, 0, z]), r)))
        return [Patch(2 * np.pi * r, self.height, side), *lids]


@dataclass(frozen=True)
class Ball:
    """A sphere: centre, radius [m]."""

    center: tuple[float, float, float]
    radius: float

    def distance(self, points: Array) -> Array:
        """Return the exact signed distance (P,) [m] of points (P, 3)."""
        return np.asarray(np.linalg.norm(points - np.asarray(self.center), axis=1) - self.radius)

    def patches(self) -> list[Patch]:
        """Return the surface by Lambert's equal-area map, in which z is uniform."""
        r = self.radius

        def globe(u: Array, v: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
            turn, z = u / r, np.clip(v / r - 1, -1, 1)
            ring = np.sqrt(1 - z**2)
            out = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
            along = np.stack([-np.sin(turn), np.cos(turn), np.zeros_like(turn)], axis=1)
            return np.asarray(self.center) + r * out, along, out, np.ones(len(u), bool)

        return [Patch(2 * np.pi * r, 2 * r, globe)]


def _plane(corner: Array, along: Array, across: Array, normal: Array) -> _Map:
    def at(u: Array, v: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        n = len(u)
        points = corner + u[:, None] * along + v[:, None] * across
        return points, np.tile(along, (n, 1)), np.tile(normal, (n, 1)), np.ones(n, bool)

    return at


def _within(plane: _Map, center: Array, radius: float) -> _Map:
    def at(u: Array, v: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        points, along, normal, _ = plane(u, v)
        return points, along, normal, np.asarray(np.linalg.norm(points - center, axis=1) <= radius)

    return at


@dataclass(frozen=True)
class Tabletop:
    """The solids around the robot, whose base is the origin."""

    solids: tuple[Solid, ...]

    def distance(self, points: Array) -> Array:
        """Return the signed distance (P,) [m] to the union; exact outside, inside that to the deepest solid."""
        return np.asarray(np.min([solid.distance(points) for solid in self.solids], axis=0))

    def gaussians(self, count: int, seed: int = 0) -> GaussianModel:
        """Sample about ``count`` discs on the surfaces, on jittered grids, each 1.5 mm thick."""
        rng = np.random.default_rng(seed)
        patches = [patch for solid in self.solids for patch in solid.patches()]
        area = sum(p.width * p.height for p in patches)
        spacing = np.sqrt(area / count)
        parts = [_sample(patch, spacing, rng) for patch in patches]
        points, along, normal = (np.concatenate([part[k] for part in parts]) for k in range(3))
        across = np.cross(normal, along)
        n = len(points)
        return GaussianModel.from_activated(
            means=points,
            quats=rotation_to_quat(np.stack([along, across, normal], axis=-1)),
            scales=np.tile([CONSTANTS.overlap * spacing, CONSTANTS.overlap * spacing, CONSTANTS.normal_sigma], (n, 1)),
            opacities=np.full(n, 0.9),
            colors=np.full((n, 3), 0.5),
        )


def _sample(patch: Patch, spacing: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    columns, lines = (max(1, int(np.ceil(size / spacing))) for size in (patch.width, patch.height))
    i, j = (x.ravel() for x in np.meshgrid(np.arange(columns), np.arange(lines), indexing="ij"))
    jitter = rng.uniform(-0.25, 0.25, (2, len(i)))
    u, v = (i + 0.5 + jitter[0]) * patch.width / columns, (j + 0.5 + jitter[1]) * patch.height / lines
    points, along, normal, on = patch.at(u, v)
    return points[on], along[on], normal[on]


def tabletop() -> Tabletop:
    """Build a table top with a shelf and ten objects in front of a robot."""
    table = Block((0.625, 0.0, -0.02), (0.95, 1.8, 0.04))
    shelf = [
        Block((0.60, 0.45, 0.20), (0.30, 0.02, 0.40)),
        Block((0.60, 0.75, 0.20), (0.30, 0.02, 0.40)),
        Block((0.60, 0.60, 0.21), (0.30, 0.28, 0.02)),
        Block((0.60, 0.60, 0.41), (0.30, 0.32, 0.02)),
    ]
    objects: list[Solid] = [
        Block((0.45, 0.10, 0.06), (0.10, 0.07, 0.12), 0.4),
        Block((0.60, -0.25, 0.09), (0.08, 0.12, 0.18), -0.3),
        Block((0.35, -0.30, 0.03), (0.14, 0.09, 0.06), 0.9),
        Block((0.75, 0.10, 0.125), (0.10, 0.10, 0.25), 0.2),
        Can((0.50, -0.08, 0.0), 0.035, 0.12),
        Can((0.65, 0.05, 0.0), 0.030, 0.20),
        Can((0.40, 0.32, 0.0), 0.045, 0.10),
        Can((0.30, 0.20, 0.0), 0.030, 0.15),
        Ball((0.55, 0.22, 0.05), 0.05),
        Ball((0.70, -0.10, 0.04), 0.04),
    ]
    return Tabletop((table, *shelf, *objects))
