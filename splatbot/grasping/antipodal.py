"""Antipodal contact pairs: opposite surface points whose connecting line lies in both friction cones."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.grasping.surface import GraspSurface
from splatbot.protocols import Array

PAD = 0.006  # [m] standard deviation of the kernel that fits a tangent plane at a contact


@dataclass(frozen=True)
class AntipodalConstants:
    """Constants of contact pair sampling.

    Args:
        on_surface: [m] a closing line meets a surface point within this distance.
        completed_weight: weight of completed points relative to observed points in the plane fit.
        min_width: [m] minimum distance between the two contacts.
        direction_std: [rad] standard deviation of the random change of closing directions.
        level: [rad] a closing direction with less inclination counts as horizontal.
        step_sizes: step sizes of the rounds of refinement.
        midpoint_weight: weight of the contacts' midpoint relative to the lines along their normals.
        lines_per_chunk: number of lines that are tested at once; it bounds memory.
    """

    on_surface: float = 0.004
    completed_weight: float = 0.1
    min_width: float = 3e-4
    direction_std: float = 0.25
    level: float = 0.05
    step_sizes: tuple[float, ...] = (1.0, 0.5, 0.25)
    midpoint_weight: float = 0.1
    lines_per_chunk: int = 64


CONSTANTS = AntipodalConstants()


Array32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Pairs:
    """C antipodal contact pairs.

    Args:
        contacts: (C, 2, 3) points on the surface [m, world]; the fingers close along the line between them.
        normals: (C, 2, 3) outward unit normals.
        closure: (C,) force-closure margin 1 - max_i angle_i / atan(mu), with the angle between a normal and the line of
            the contacts. It is 1 for normals along the line and 0 on the friction cone.
        observed: (C,) weighted fraction of observed points in the plane fit, minimum of both contacts.
        normal_std: (C,) standard deviation of the surface along its normal [m], maximum of both contacts.
    """

    contacts: Array
    normals: Array
    closure: Array
    observed: Array
    normal_std: Array

    def __len__(self) -> int:
        return len(self.contacts)

    @property
    def width(self) -> Array:
        """(C,) distances between the contacts [m]."""
        return np.asarray(np.linalg.norm(self.contacts[:, 1] - self.contacts[:, 0], axis=1))

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Pairs:
        """Return the chosen pairs."""
        return Pairs(
            self.contacts[chosen],
            self.normals[chosen],
            self.closure[chosen],
            self.observed[chosen],
            self.normal_std[chosen],
        )


@dataclass(frozen=True, eq=False)
class PairSearch:
    """Antipodal pairs, and the number of rejected candidates by reason.

    Args:
        pairs: pairs within the friction cone and the stroke.
        alone: number of closing directions that meet no opposite surface.
        too_wide: number of pairs that are wider than the stroke.
        slipping: number of pairs outside of the friction cone.
        narrowest: smallest width among the pairs that are too wide [m]; infinity if there is no such pair.
    """

    pairs: Pairs
    alone: int
    too_wide: int
    slipping: int
    narrowest: float


def antipodal_pairs(
    surface: GraspSurface,
    *,
    stroke: float,
    friction: float,
    samples: int,
    up: Array,
    seed: int = 0,
    near: Array | None = None,
) -> PairSearch:
    """Sample antipodal contact pairs from seeds on the surface and refine each.

    A pair has the contacts p1, p2, the outward normals n1, n2 and the line d = (p2 - p1) / |p2 - p1|. It is antipodal
    (Nguyen 1988) if the line lies in both friction cones::

        angle(-n1, d) <= atan(mu)   and   angle(n2, d) <= atan(mu)

    At a seed a finger closes along -n, along a random variation of -n, and horizontally where the friction cone
    contains that direction. The horizontal direction finds the widest section of a round object that was only observed
    from above. The second contact is the first point on the line whose normal faces away from the seed.

    Refinement rotates the line to the bisector of both normals and moves it to their intersection. On a ball this turns
    a chord into a diameter. A tangent plane is fitted at both ends, so that noise of single Gaussians averages out.

    Args:
        surface: surface of the target.
        stroke: maximum finger opening [m].
        friction: friction coefficient mu.
        samples: number of seeds; more take longer and cover more of the surface.
        up: (3,) unit up axis [world].
        seed: seed of the random generator.
        near: (3,) point [m, world] around which seeds are denser. If None, their density is uniform.
    """
    center = surface.center
    surface = replace(surface, points=surface.points - center, center=np.zeros(3))  # float32 needs small coordinates
    rng = np.random.default_rng(seed)
    chance = np.ones(len(surface)) if near is None else np.exp(-_distance(surface.points, near - center) / 0.03) + 0.05
    chance = chance * np.where(surface.observed, 1.0, 0.5)
    start = rng.choice(len(surface), min(samples, len(surface)), replace=False, p=chance / chance.sum())
    cone = np.arctan(friction)
    closing, of = _closings(surface.normals[start], cone, up, rng)
    origin = surface.points[start][of]
    end, away = _exits(surface, origin, closing, np.cos(cone))
    met, wide = np.isfinite(away), np.isfinite(away) & (away > stroke)
    narrowest = float(away[wide].min()) if wide.any() else np.inf
    use = met & ~wide
    pairs = _refined(surface, origin[use], end[use], cone)
    good = (pairs.closure > 0.0) & (pairs.width <= stroke) & (pairs.width > CONSTANTS.min_width)
    pairs = replace(pairs, contacts=pairs.contacts + center)
    return PairSearch(pairs.select(good), int((~met).sum()), int(wide.sum()), int((~good).sum()), narrowest)


def _closings(normals: Array, cone: float, up: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    """Return unit closing directions (C, 3) for seeds with normals (S, 3), and the index of the seed of each (C,)."""
    noise = rng.normal(0.0, CONSTANTS.direction_std, normals.shape)
    level = -normals + np.outer(normals @ up, up)
    steep = np.arcsin(np.clip(np.abs(normals @ up), 0.0, 1.0))
    slanted = np.flatnonzero((steep > CONSTANTS.level) & (steep < cone))
    closing = np.concatenate([-normals, -normals + noise, level[slanted]])
    every = np.arange(len(normals))
    return _unit(closing), np.concatenate([every, every, slanted])


def _exits(surface: GraspSurface, origin: Array, closing: Array, cosine: float) -> tuple[Array, Array]:
    """Return the points (C, 3) at which lines leave the surface, and their distances (C,) [m].

    The distance is infinite for a line that meets no opposite surface.
    """
    p, n = surface.points.astype(np.float32), surface.normals.astype(np.float32)
    tube = _tube(surface)
    end, away = np.zeros_like(origin), np.full(len(origin), np.inf)
    for k in range(0, len(origin), CONSTANTS.lines_per_chunk):
        o, c = (
            origin[k : k + CONSTANTS.lines_per_chunk].astype(np.float32),
            closing[k : k + CONSTANTS.lines_per_chunk].astype(np.float32),
        )
        along = c @ p.T - np.einsum("ij,ij->i", c, o)[:, None]
        square = ((o**2).sum(axis=1)[:, None] - 2 * (o @ p.T)) + (p**2).sum(axis=1)[None]
        hit = (square - along**2 < tube) & (along > CONSTANTS.min_width) & (c @ n.T > cosine)
        along[~hit] = np.inf
        nearest = along.argmin(axis=1)
        away[k : k + CONSTANTS.lines_per_chunk] = along[np.arange(len(nearest)), nearest]
        end[k : k + CONSTANTS.lines_per_chunk] = surface.points[nearest]
    return end, away


def _tube(surface: GraspSurface) -> Array32:
    """Return squared distances (M,) [m²] within which a line meets a surface point."""
    return np.asarray(np.maximum(0.0025, 1.2 * np.minimum(surface.spread, 0.006)) ** 2, dtype=np.float32)


def _refined(surface: GraspSurface, first: Array, second: Array, cone: float) -> Pairs:
    """Refine pairs in rounds of decreasing step size; keep a step only if closure plus observed fraction increases."""
    found = _fitted(surface, first, second, cone)
    for step in CONSTANTS.step_sizes:
        middle = found.contacts.mean(axis=1)
        through = (middle + step * (_between(found) - middle))[:, None]
        line = (1.0 - step) * _unit(found.contacts[:, 1] - found.contacts[:, 0])
        line = _unit(line + step * _unit(found.normals[:, 1] - found.normals[:, 0]))
        along = np.einsum("ckj,cj->ck", found.contacts - through, line)[..., None]
        first, second = np.moveaxis(through + along * line[:, None], 1, 0)
        other = _fitted(surface, first, second, cone)
        better = other.closure + other.observed > found.closure + found.observed
        pick = better[:, None, None]
        found = Pairs(
            np.where(pick, other.contacts, found.contacts),
            np.where(pick, other.normals, found.normals),
            np.where(better, other.closure, found.closure),
            np.where(better, other.observed, found.observed),
            np.where(better, other.normal_std, found.normal_std),
        )
    return found


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def _between(pairs: Pairs) -> Array:
    """Return the points (C, 3) nearest to the lines along both normals, by regularized least squares.

    With P_k = I - n_k n_kᵀ, the contacts p_k, their midpoint m and the weight w, the point x solves::

        (P_1 + P_2 + w I) (x - m) = P_1 (p_1 - m) + P_2 (p_2 - m)

    It is the centre of a ball, and a point on the axis of a cylinder. The regularization selects the midpoint where
    parallel normals leave x undetermined.
    """
    middle = pairs.contacts.mean(axis=1)
    across = np.eye(3) - pairs.normals[..., :, None] * pairs.normals[..., None, :]
    aside = np.einsum("ckij,ckj->ci", across, pairs.contacts - middle[:, None])
    return np.asarray(
        middle + np.linalg.solve(across.sum(axis=1) + CONSTANTS.midpoint_weight * np.eye(3), aside[..., None])[..., 0]
    )


def _fitted(surface: GraspSurface, first: Array, second: Array, cone: float) -> Pairs:
    line = _unit(second - first)
    ends = [_plane(surface, at, out) for at, out in ((first, -line), (second, line))]
    contacts, normals = (np.stack([end[k] for end in ends], axis=1) for k in range(2))
    across = _unit(contacts[:, 1] - contacts[:, 0])
    cosines = np.minimum(np.einsum("ij,ij->i", normals[:, 1], across), -np.einsum("ij,ij->i", normals[:, 0], across))
    closure = 1.0 - np.arccos(np.clip(cosines, -1.0, 1.0)) / cone
    observed, normal_std = np.minimum(ends[0][2], ends[1][2]), np.maximum(ends[0][3], ends[1][3])
    return Pairs(contacts, normals, closure, observed, normal_std)


def _plane(surface: GraspSurface, at: Array, out: Array) -> tuple[Array, Array, Array, Array]:
    """Fit tangent planes at ``at`` (C, 3), and intersect them with the lines along ``out`` (C, 3).

    Returns:
        The intersections (C, 3), the plane normals (C, 3), the weighted fractions of observed points (C,), and the mean
        standard deviations along the normal (C,) [m]. A line that misses the surface beyond the edge of a face keeps
        its point. Its normal is ``-out``, so that its closure is negative.
    """
    p, n = surface.points.astype(np.float32), surface.normals.astype(np.float32)
    tube = np.maximum(_tube(surface), CONSTANTS.on_surface**2)
    trust = np.where(surface.observed, 1.0, CONSTANTS.completed_weight).astype(np.float32)
    values = np.c_[surface.points, surface.normals, surface.observed, surface.normal_std]
    total, meets = np.zeros((len(at), values.shape[1] + 1)), np.zeros(len(at), np.bool_)
    for k in range(0, len(at), CONSTANTS.lines_per_chunk):
        a, o = (
            at[k : k + CONSTANTS.lines_per_chunk].astype(np.float32),
            out[k : k + CONSTANTS.lines_per_chunk].astype(np.float32),
        )
        square = (a**2).sum(axis=1)[:, None] - 2 * (a @ p.T) + (p**2).sum(axis=1)[None]
        facing = o @ n.T > 0.3
        offset = square - (o @ p.T - np.einsum("ij,ij->i", o, a)[:, None]) ** 2
        meets[k : k + CONSTANTS.lines_per_chunk] = (facing & (offset < tube) & (square < (2 * PAD) ** 2)).any(axis=1)
        weight = trust * np.exp(np.minimum(-0.5 / PAD**2 * square, 0.0)) * facing
        weight[square > (2.5 * PAD) ** 2] = 0.0
        total[k : k + CONSTANTS.lines_per_chunk] = np.c_[weight @ values.astype(np.float32), weight.sum(axis=1)]
    count = np.maximum(total[:, -1:], 1e-9)
    mean = total[:, :-1] / count
    normal = _unit(mean[:, 3:6])
    tilt = np.einsum("ij,ij->i", normal, out)
    ahead = np.einsum("ij,ij->i", mean[:, :3] - at, normal) / np.maximum(tilt, 0.2)
    ahead = np.where(meets, np.clip(ahead, -2 * PAD, 2 * PAD), 0.0)
    normal = np.where(meets[:, None], normal, -out)
    return at + ahead[:, None] * out, normal, mean[:, 6], mean[:, 7]


def _distance(points: Array, to: Array) -> Array:
    return np.asarray(np.linalg.norm(points - to, axis=1))
