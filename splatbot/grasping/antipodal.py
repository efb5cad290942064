"""Pairs of opposite places on a surface that two fingers can press: antipodal within the friction cone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.grasping.surface import GraspSurface
from splatbot.protocols import Array

PAD = 0.006  # [m] around a contact that its plane is fitted to
_BESIDE = 0.004  # [m] from the surface's points, as far as a contact counts as on it
_IMPLIED = 0.1  # weight of implied points beside seen ones
_LEAST = 3e-4  # [m] between two sides
_LEAN = 0.25  # [rad] that closing directions are varied by
_LEVEL = 0.05  # [rad] from which on a closing direction is not level
_STEPS = (1.0, 0.5, 0.25)  # of the rounds of refining
_TO_MIDDLE = 0.1  # weight of the middle of the contacts beside the lines of their normals
_CHUNK = 64

Array32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Pairs:
    """C pairs of contacts.

    Args:
        contacts: (C, 2, 3) on the surface [m, world]; the fingers move from the first to the second and back.
        normals: (C, 2, 3) unit, outwards.
        closure: (C,) 1 where both normals lie along the line between the contacts, 0 at the rim of the friction cone.
        seen: (C,) share of what the contacts' planes were fitted to that was measured, of the worse contact.
        doubt: (C,) how uncertain the surface is at the worse contact [m].
    """

    contacts: Array
    normals: Array
    closure: Array
    seen: Array
    doubt: Array

    def __len__(self) -> int:
        return len(self.contacts)

    @property
    def width(self) -> Array:
        """(C,) between the contacts [m]."""
        return np.asarray(np.linalg.norm(self.contacts[:, 1] - self.contacts[:, 0], axis=1))

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Pairs:
        """Those that are named."""
        return Pairs(
            self.contacts[chosen], self.normals[chosen], self.closure[chosen], self.seen[chosen], self.doubt[chosen]
        )


@dataclass(frozen=True, eq=False)
class PairSearch:
    """The pairs that were found, and how many were given up and why.

    Args:
        pairs: within the friction cone and no wider than the stroke.
        alone: closing directions that meet no opposite surface.
        too_wide: that meet it farther than the stroke.
        slipping: that meet it outside of the friction cone.
        narrowest: width of the narrowest that is too wide [m]; infinity: none is.
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
    """Opposite contacts from ``samples`` seeds on the surface, each refined.

    From a seed a finger closes against its normal, along a variation of that, and level where the cone allows it, for
    what is round and was seen from above shows its widest place at its rim alone; the first surface that faces the
    other way is the second contact (Nguyen 1988: the line between the contacts lies in both friction cones).
    Refining turns the line to the bisector of both normals, moves it to where these meet, as a chord of a ball to its
    diameter, and fits a plane to the Gaussians at each end, so that a contact is on the surface that they have in
    common.

    Args:
        surface: of the target.
        stroke: widest opening [m].
        friction: coefficient.
        samples: seeds; the knob of time against how much of the surface is tried.
        up: (3,) unit [world].
        seed: of their choice.
        near: (3,) [m, world] around which seeds are denser.
    """
    center = surface.center
    surface = replace(surface, points=surface.points - center, center=np.zeros(3))  # float32 is about the middle
    rng = np.random.default_rng(seed)
    chance = np.ones(len(surface)) if near is None else np.exp(-_distance(surface.points, near - center) / 0.03) + 0.05
    chance = chance * np.where(surface.seen, 1.0, 0.5)
    start = rng.choice(len(surface), min(samples, len(surface)), replace=False, p=chance / chance.sum())
    cone = np.arctan(friction)
    closing, of = _closings(surface.normals[start], cone, up, rng)
    origin = surface.points[start][of]
    end, away = _exits(surface, origin, closing, np.cos(cone))
    met, wide = np.isfinite(away), np.isfinite(away) & (away > stroke)
    narrowest = float(away[wide].min()) if wide.any() else np.inf
    use = met & ~wide
    pairs = _refined(surface, origin[use], end[use], cone)
    good = (pairs.closure > 0.0) & (pairs.width <= stroke) & (pairs.width > _LEAST)
    pairs = replace(pairs, contacts=pairs.contacts + center)
    return PairSearch(pairs.select(good), int((~met).sum()), int(wide.sum()), int((~good).sum()), narrowest)


def _closings(normals: Array, cone: float, up: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    """Unit directions (C, 3) for seeds with normals (S, 3), and which seed each is of (C,)."""
    lean = rng.normal(0.0, _LEAN, normals.shape)
    level = -normals + np.outer(normals @ up, up)
    steep = np.arcsin(np.clip(np.abs(normals @ up), 0.0, 1.0))
    slanted = np.flatnonzero((steep > _LEVEL) & (steep < cone))
    closing = np.concatenate([-normals, -normals + lean, level[slanted]])
    every = np.arange(len(normals))
    return _unit(closing), np.concatenate([every, every, slanted])


def _exits(surface: GraspSurface, origin: Array, closing: Array, cosine: float) -> tuple[Array, Array]:
    """Where lines (C, 3) leave the surface (C, 3), and how far that is (C,) [m]; infinity: nowhere."""
    p, n = surface.points.astype(np.float32), surface.normals.astype(np.float32)
    tube = _tube(surface)
    end, away = np.zeros_like(origin), np.full(len(origin), np.inf)
    for k in range(0, len(origin), _CHUNK):
        o, c = origin[k : k + _CHUNK].astype(np.float32), closing[k : k + _CHUNK].astype(np.float32)
        along = c @ p.T - np.einsum("ij,ij->i", c, o)[:, None]
        square = ((o**2).sum(axis=1)[:, None] - 2 * (o @ p.T)) + (p**2).sum(axis=1)[None]
        hit = (square - along**2 < tube) & (along > _LEAST) & (c @ n.T > cosine)
        along[~hit] = np.inf
        nearest = along.argmin(axis=1)
        away[k : k + _CHUNK] = along[np.arange(len(nearest)), nearest]
        end[k : k + _CHUNK] = surface.points[nearest]
    return end, away


def _tube(surface: GraspSurface) -> Array32:
    """Squares of how near lines have to pass by points (M,) to meet the surface [m²]."""
    return np.asarray(np.maximum(0.0025, 1.2 * np.minimum(surface.spread, 0.006)) ** 2, dtype=np.float32)


def _refined(surface: GraspSurface, first: Array, second: Array, cone: float) -> Pairs:
    """Contacts on planes fitted at both ends, the line moved and turned to both normals as far as that is better.

    What is not gets a smaller step in the next round. Better contacts where less was seen are not better.
    """
    found = _fitted(surface, first, second, cone)
    for step in _STEPS:
        middle = found.contacts.mean(axis=1)
        through = (middle + step * (_between(found) - middle))[:, None]
        line = (1.0 - step) * _unit(found.contacts[:, 1] - found.contacts[:, 0])
        line = _unit(line + step * _unit(found.normals[:, 1] - found.normals[:, 0]))
        along = np.einsum("ckj,cj->ck", found.contacts - through, line)[..., None]
        first, second = np.moveaxis(through + along * line[:, None], 1, 0)
        other = _fitted(surface, first, second, cone)
        better = other.closure + other.seen > found.closure + found.seen
        pick = better[:, None, None]
        found = Pairs(
            np.where(pick, other.contacts, found.contacts),
            np.where(pick, other.normals, found.normals),
            np.where(better, other.closure, found.closure),
            np.where(better, other.seen, found.seen),
            np.where(better, other.doubt, found.doubt),
        )
    return found


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def _between(pairs: Pairs) -> Array:
    """The points (C, 3) nearest to the lines of both normals: of a ball's chord its centre, of a can's a point of its
    axis. Normals along one line leave it open where on it; so they are the middle of the contacts as far as it is."""
    middle = pairs.contacts.mean(axis=1)
    across = np.eye(3) - pairs.normals[..., :, None] * pairs.normals[..., None, :]
    aside = np.einsum("ckij,ckj->ci", across, pairs.contacts - middle[:, None])
    return np.asarray(middle + np.linalg.solve(across.sum(axis=1) + _TO_MIDDLE * np.eye(3), aside[..., None])[..., 0])


def _fitted(surface: GraspSurface, first: Array, second: Array, cone: float) -> Pairs:
    line = _unit(second - first)
    ends = [_plane(surface, at, out) for at, out in ((first, -line), (second, line))]
    contacts, normals = (np.stack([end[k] for end in ends], axis=1) for k in range(2))
    across = _unit(contacts[:, 1] - contacts[:, 0])
    cosines = np.minimum(np.einsum("ij,ij->i", normals[:, 1], across), -np.einsum("ij,ij->i", normals[:, 0], across))
    closure = 1.0 - np.arccos(np.clip(cosines, -1.0, 1.0)) / cone
    seen, doubt = np.minimum(ends[0][2], ends[1][2]), np.maximum(ends[0][3], ends[1][3])
    return Pairs(contacts, normals, closure, seen, doubt)


def _plane(surface: GraspSurface, at: Array, out: Array) -> tuple[Array, Array, Array, Array]:
    """Where lines through ``at`` (C, 3) along ``out`` (C, 3) cross the plane of the Gaussians around, its normal,
    the share of them that was seen, and their doubt; a line that does not meet the surface itself, as beyond the edge
    of a face, keeps its place and is of no use."""
    p, n = surface.points.astype(np.float32), surface.normals.astype(np.float32)
    tube = np.maximum(_tube(surface), _BESIDE**2)
    trust = np.where(surface.seen, 1.0, _IMPLIED).astype(np.float32)
    values = np.c_[surface.points, surface.normals, surface.seen, surface.doubt]
    total, meets = np.zeros((len(at), values.shape[1] + 1)), np.zeros(len(at), np.bool_)
    for k in range(0, len(at), _CHUNK):
        a, o = at[k : k + _CHUNK].astype(np.float32), out[k : k + _CHUNK].astype(np.float32)
        square = (a**2).sum(axis=1)[:, None] - 2 * (a @ p.T) + (p**2).sum(axis=1)[None]
        facing = o @ n.T > 0.3
        beside = square - (o @ p.T - np.einsum("ij,ij->i", o, a)[:, None]) ** 2
        meets[k : k + _CHUNK] = (facing & (beside < tube) & (square < (2 * PAD) ** 2)).any(axis=1)
        weight = trust * np.exp(np.minimum(-0.5 / PAD**2 * square, 0.0)) * facing
        weight[square > (2.5 * PAD) ** 2] = 0.0
        total[k : k + _CHUNK] = np.c_[weight @ values.astype(np.float32), weight.sum(axis=1)]
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
