"""The surface of a target: what was measured, and the sides that nobody saw but what was seen implies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splatbot.collision.visibility import DepthView, evidence_at
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.relief import CELL, DISC, STEP, Relief, frame_along
from splatbot.grasping.surface import MOST, GraspSurface, measured_surface
from splatbot.grasping.volume import winding_numbers
from splatbot.protocols import Array
from splatbot.segmentation import SegmentedMap
from splatbot.segmentation.parts import nearest_of

_WITHIN = 0.45  # winding number, from where on a point is within what was seen
_FACING, _TURNED = 0.7, 0.1  # cosines between a direction and the normals of what faces it, and of what it still sees
_TURNED_AWAY = 0.7  # below it a normal is of another face
_FEW = 20  # points that are no face
_FLAT, _MOST_OF_IT = 0.97, 0.4  # cosine between the normals of a flat face; share of the target that it is
_NARROW = 0.005  # [m] standard deviation of places across a face, below which its normals tell better how it is turned
_MOST_TURNED = 0.47  # tangent of 25 degrees
_SLOPE = 0.7  # cosine between up and normals of a side
_LEANS = 0.17  # [rad] from where on a flat side leans
_BEHIND = 0.04  # [m] that sides reach behind a face of which nothing tells how deep it is
_SHOWN = 0.008  # [m] of depth that was seen, from where on it is all there is
_SPREAD = 1.65  # standard deviations, that 5 % of what is noisy are beyond
_TUBE = 0.003  # [m] around a line within which it meets a point, where none is left out
_SEEN = 0.006  # [m] around seen points of a side within which none is added
_ROWS = 0.003  # [m] between added points
_THROUGH = 2  # views that must see through a point that nobody saw
_HOLLOW = 0.03  # share of a face, but for its rim, that was seen through behind, from where on the thing ends
_RIM = 0.014  # [m] of a face, as far as depth images smear its edges outwards and evidence is in doubt
_COLUMNS = 300  # places of a face that are asked

_Points = tuple[Array, Array, Array]


def target_surface(
    scene: SegmentedMap,
    rows: NDArray[np.int64],
    *,
    observers: Array | None = None,
    views: Sequence[DepthView] = (),
    seed: int = 0,
    sharp: bool = False,
) -> GraspSurface:
    """The surface of the Gaussians ``rows`` (M,) of a scene, with the sides that go down from its top to the support,
    and back from the face that was seen in front.

    Args:
        scene: the map.
        rows: of the target.
        observers: (N, 3) where each Gaussian of the map was seen from [m, world], NaN where that is not known.
        views: depth that was measured; no side is implied where it saw through.
        seed: of which Gaussians are kept where there are more than 1800.
        sharp: see :func:`splatbot.grasping.surface.measured_surface`.
    """
    seen, areas = measured_surface(scene, rows, observers=observers, seed=seed, sharp=sharp)
    up = _along(seen, scene.up)
    leans = bool(up @ scene.up < np.cos(_LEANS / 2))
    floor = float(np.percentile(seen.points @ up, 1)) if leans else _floor(scene, seen, up)
    down = _sides(seen, up, floor)
    parts = [(*down, np.full(len(down[0]), _ROWS / 2))]
    faces = [_ImpliedFace(direction, seen) for direction in _directions(seen, up)]
    backs = []
    for face in faces:
        sides, back = _behind(seen, face, up, views)
        parts.append(sides)
        backs.append(back)
    points, normals, doubt = (np.concatenate([part[k] for part in parts]) for k in range(3))
    # Sides go down to the floor; so where those of a face that was seen in front end above it, there is no bottom.
    standing = np.flatnonzero((normals @ up > -_TURNED_AWAY) | (points @ up < floor + STEP))
    thin = np.unique(np.floor(points[standing] / _ROWS).astype(np.int64), axis=0, return_index=True)[1]
    every = 1 + len(thin) // MOST
    kept = standing[thin[::every]]
    for face, back in zip(faces, backs, strict=True):
        kept = kept[~face.hides(points[kept], back)]
    outer = winding_numbers(points[kept], seen.points, seen.normals, areas, softened=_ROWS) < _WITHIN
    evidence = evidence_at(points[kept], views)
    kept = kept[outer & ~(evidence.seen_through & (evidence.passes >= _THROUGH))]
    kept = kept[~_inside(points[kept], normals[kept], tube=_TUBE * np.sqrt(every))]
    return GraspSurface(
        np.concatenate([seen.points, points[kept]]),
        np.concatenate([seen.normals, normals[kept]]),
        np.concatenate([seen.half, np.zeros((len(kept), 3, 3))]),
        np.concatenate([seen.spread, np.full(len(kept), _ROWS / 2)]),
        np.concatenate([seen.seen, np.zeros(len(kept), np.bool_)]),
        np.concatenate([seen.doubt, doubt[kept]]),
        seen.center,
    )


class _ImpliedFace:
    """What of a target faces a direction (3,)."""

    def __init__(self, direction: Array, seen: GraspSurface) -> None:
        self.direction = direction
        self.points = seen.points[seen.normals @ direction > _FACING]
        self.across = frame_along(direction)
        self.flat = self.points @ self.across.T
        self.relief = Relief.of(self.flat) if len(self.points) >= _FEW else None

    def hides(self, points: Array, back: float) -> NDArray[np.bool_]:
        """Whether points (P, 3) are between it and its back, but for its rim (P,): there is no side."""
        if self.relief is None:
            return np.zeros(len(points), np.bool_)
        flat = points @ self.across.T
        behind = self.relief.inwards(flat) > _SEEN + DISC
        return np.asarray(behind & (flat[:, 2] > back + _SEEN) & (flat[:, 2] < np.percentile(self.flat[:, 2], 95)))

    def seen_through(self, views: Sequence[DepthView]) -> float:
        """Where along its direction [m, world] something behind it was seen through: what is flat in front ends before
        that.

        Minus infinity: nowhere within the depth that is implied at most. What is behind its rim is not asked.
        """
        if self.relief is None or not views:
            return -np.inf
        front = self.points[self.relief.inwards(self.flat) > _RIM]
        front = front[:: 1 + len(front) // _COLUMNS]
        if len(front) < _FEW:
            return -np.inf
        deep = np.arange(_ROWS, 2 * _BEHIND, _ROWS)
        evidence = evidence_at((front[None] - deep[:, None, None] * self.direction).reshape(-1, 3), views)
        through = (evidence.seen_through & (evidence.passes >= _THROUGH)).reshape(len(deep), len(front))
        ended = np.logical_or.accumulate(through, axis=0).mean(axis=1) >= _HOLLOW
        return float(np.median(front @ self.direction) - deep[ended.argmax()]) if ended.any() else -np.inf


def _behind(seen: GraspSurface, face: _ImpliedFace, up: Array, views: Sequence[DepthView]) -> tuple[_Points, float]:
    """Of the sides behind a face and of the back: points and normals (K, 3), their standard deviation (K,) [m]; and
    where the back is along the face's direction [m, world]; infinity: it is curved."""
    back, mirrored = _back(seen, face.direction, up)
    guess = _ROWS / 2
    along = seen.points @ face.direction
    if not mirrored and back < np.percentile(along, 5):  # nothing of the thing shows how deep it is
        back = max(back, face.seen_through(views))
        guess = max(guess, float(np.median(along) - back) / np.sqrt(12))  # all in between is as likely
    points, normals = _sides(seen, face.direction, back, closed=True, mirrored=mirrored)
    doubt = np.where(normals @ face.direction < -_TURNED_AWAY, guess, _ROWS / 2)
    return (points, normals, doubt), np.inf if mirrored else back


def _along(seen: GraspSurface, up: Array) -> Array:
    """The direction (3,) in which the target stands: ``up``, or along the flat face that is most of it and leans.

    What leans, as a book on a wall, has its back parallel to its face, and its sides end where they do in its own
    frame, not below; what is round, or has several sides, shows no single face that is most of it.
    """
    side = seen.normals[np.abs(seen.normals @ up) < _SLOPE]
    if len(side) < max(_FEW, _MOST_OF_IT * len(seen)):
        return up
    close = side @ side[:: max(1, len(side) // 100)].T > _FLAT
    best = int(close.sum(axis=0).argmax())
    if close[:, best].sum() < _MOST_OF_IT * len(seen):
        return up
    face = side[close[:, best]].mean(axis=0)
    face /= np.linalg.norm(face)
    lean = float(face @ up)
    if abs(lean) < np.sin(_LEANS):
        return up
    along = up - lean * face
    return np.asarray(along / np.linalg.norm(along))


def _directions(seen: GraspSurface, up: Array) -> list[Array]:
    """Level directions that many of what was seen face, unless the opposite side was seen as well."""
    level = np.abs(seen.normals @ up) < 0.5
    left, points = seen.normals[level], seen.points[level]
    left = left - np.outer(left @ up, up)
    left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-12)
    few = max(_FEW, 0.05 * len(seen))
    found: list[Array] = []
    while len(left) >= few and len(found) < 8:
        close = left @ left[:: max(1, len(left) // 100)].T > 0.9
        own = close[:, int(close.sum(axis=0).argmax())]
        if own.sum() < few:
            break
        face = left[own].mean(axis=0)
        face /= np.linalg.norm(face)
        found.append(_across(points[own], face, up))
        other = left @ face < _TURNED_AWAY
        left, points = left[other], points[other]
    return [face for face in found if not any(face @ other < -_FACING for other in found)]


def _across(points: Array, face: Array, up: Array) -> Array:
    """The level direction (3,) across the places (P, 3) of what looks to ``face`` (3,): normals that were seen at a
    slant are off together, by 10 degrees and more. Both halves of a plane are turned like all of it, those of a step or
    of what is round are not, and leave the normals' direction."""
    aside = np.cross(up, face)
    local = points @ np.stack([aside, up, face], axis=1)
    left = local[:, 0] < np.median(local[:, 0])
    whole, *halves = (_slope(part) for part in (local, local[left], local[~left]))
    if abs(whole) > _MOST_TURNED or min(np.sign(whole) * half for half in halves) < 0.5 * abs(whole):
        return face
    turned = face - whole * aside
    return np.asarray(turned / np.linalg.norm(turned))


def _slope(local: Array) -> float:
    """Of depth over width in places (P, 3) = (width, height, depth) [m], without what lies beside their plane; the
    smaller, the narrower they are, for there normals tell better."""
    kept = np.ones(len(local), np.bool_)
    slopes = np.zeros(2)
    for _ in range(3):
        middle = local[kept] - local[kept].mean(axis=0)
        A, depth = middle[:, :2], middle[:, 2]
        slopes = np.linalg.solve(A.T @ A + len(A) * _NARROW**2 * np.eye(2), A.T @ depth)
        off = local[:, 2] - local[:, :2] @ slopes
        off = np.abs(off - np.median(off))
        kept = off <= max(3 * float(np.median(off)), _ROWS)
    return float(slopes[0])


def _floor(scene: SegmentedMap, seen: GraspSurface, up: Array) -> float:
    """Height along ``up`` [m, world] where the target stands."""
    low = float(np.percentile(seen.points @ up, 1))
    local = transform_points(inverse(scene.T_world_base), seen.points)
    support = scene.under(local)
    if support is None:
        return low - _BEHIND
    under = float(np.percentile(support.height(local), 1))
    return low - under if 0.0 <= under < 0.03 else low - 0.01


def _back(seen: GraspSurface, face: Array, up: Array) -> tuple[float, bool]:
    """Where along ``face`` [m, world] the target ends behind, and whether its back is the mirror image of its front.

    A flat front is that of a box, as deep as its other sides show; a round one turns away half way to its back. Where
    nothing of either was seen, a thing is taken to be as deep as it is narrow. Noise of the front shows no depth.
    """
    across = seen.points @ np.stack([up, np.cross(up, face)], axis=1)
    along = seen.points @ face
    facing = seen.normals @ face > _FACING
    bent, noise = _bowl(across[facing], along[facing])
    near, far = float(np.percentile(bent, 95)), float(np.percentile(along, 5))
    if near - far > _SHOWN + _SPREAD * noise:
        flat = float((near - bent < _SHOWN).mean()) > 0.7
        return (far, False) if flat else (max(2 * far - near, near - 2 * _BEHIND), True)
    narrow = float(np.ptp(np.percentile(across, [2, 98], axis=0), axis=0).min())
    return near - min(narrow, 2 * _BEHIND), False


def _bowl(at: Array, heights: Array) -> tuple[Array, float]:
    """Heights (P,) as a paraboloid over places (P, 2) has them, and the standard deviation from it [m]."""
    x, y = (at - at.mean(axis=0)).T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    bent = terms @ np.linalg.lstsq(terms, heights, rcond=None)[0]
    return bent, 1.48 * float(np.median(np.abs(heights - bent)))


def _sides(
    seen: GraspSurface, direction: Array, floor: float, *, closed: bool = False, mirrored: bool = False
) -> tuple[Array, Array]:
    """Points and normals (K, 3) of the sides behind the edges of what faces ``direction``, where none was seen.

    ``closed``: and of the back, at ``floor``, or mirrored at the middle between it and the top.
    """
    none = np.zeros((0, 3)), np.zeros((0, 3))
    facing = seen.normals @ direction > _TURNED
    if facing.sum() < _FEW:
        return none
    across = frame_along(direction)
    flat = seen.points @ across.T  # the last is the height
    # A disc that is nearly seen from its edge reaches no farther across than that.
    relief = Relief.of(flat[facing], (seen.spread * (seen.normals @ direction))[facing])
    below = Relief.of(flat[seen.normals @ direction < -_TURNED], like=relief).heights
    at, out, top, beyond = relief.edges()
    foot = np.maximum(floor, np.maximum(beyond, below[at[:, 0], at[:, 1]]))
    rows = [np.arange(h - _ROWS / 2, f, -_ROWS) for h, f in zip(top, foot, strict=True)]
    count = np.array([len(row) for row in rows])
    if not count.sum():
        return none
    plane = relief.at(at) + out * (CELL / 2)
    points = np.c_[np.repeat(plane, count, axis=0), np.concatenate(rows)] @ across
    normals = np.repeat(np.c_[out, np.zeros(len(out))] @ across, count, axis=0)
    if closed:
        known = np.isfinite(relief.heights) & (relief.heights > floor + STEP)
        cells = np.argwhere(known & ~np.isfinite(below))[::2]
        top = relief.heights[cells[:, 0], cells[:, 1]]
        depth = np.maximum(floor + np.percentile(top, 95) - top, floor) if mirrored and len(cells) else floor
        back = np.c_[relief.at(cells), np.broadcast_to(depth, len(cells))] @ across
        points = np.concatenate([points, back])
        normals = np.concatenate([normals, np.tile(-direction, (len(back), 1))])
    new = _unseen(points, normals, seen)
    return points[new], normals[new]


def _inside(points: Array, normals: Array, *, tube: float) -> NDArray[np.bool_]:
    """Whether what points (P, 3) face first is another of them from behind (P,): they are within the target.

    ``tube``: [m] around where they look, as wide as points are apart, for nobody looks out between them.
    """
    if not len(points):
        return np.zeros(0, np.bool_)
    p, n = (points - points.mean(axis=0)).astype(np.float32), normals.astype(np.float32)
    found, square = np.zeros(len(p), np.bool_), (p**2).sum(axis=1)
    for k in range(0, len(p), 256):
        a, d = p[k : k + 256], n[k : k + 256]
        ahead = d @ p.T - np.einsum("ij,ij->i", a, d)[:, None]
        aside = (a**2).sum(axis=1)[:, None] - 2 * (a @ p.T) + square - ahead**2
        ahead[(ahead < _SEEN) | (aside > tube**2)] = np.inf
        first = ahead.argmin(axis=1)
        hit = np.isfinite(ahead[np.arange(len(a)), first])
        found[k : k + 256] = hit & (np.einsum("ij,ij->i", n[first], d) > 0.3)
    return found


def _unseen(points: Array, normals: Array, seen: GraspSurface) -> NDArray[np.bool_]:
    """Whether nothing that was seen within 6 mm of each of points (P, 3) faces the same way (P,)."""
    new = np.ones(len(points), np.bool_)
    reach = max(_SEEN, 2.0 * float(np.median(seen.spread)))
    for way in (*np.eye(3), *-np.eye(3)):
        asked, known = normals @ way > 0.5, seen.normals @ way > 0.3
        if asked.any() and known.any():
            nearest, square = nearest_of(seen.points[known], points[asked])
            alike = np.einsum("ij,ij->i", seen.normals[known][nearest], normals[asked]) > 0.5
            new[np.flatnonzero(asked)[alike & (square < reach**2)]] = False
    return new
