"""The surface of a target, as oriented points: its Gaussians, and the sides that nobody saw but its top implies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.collision.evidence import DepthView, evidence_at
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import rotations, shortest_axes
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.volume import winding_numbers
from splatbot.protocols import Array
from splatbot.segmentation import MapScene
from splatbot.segmentation.parts import nearest_of

MOST = 1800  # points that are looked at
_OFTEN = 0.2  # of the keyframes that the best Gaussians are supported by
_SMOOTH = 0.006  # [m] over which normals are averaged
_LONELY = 4.0  # times the usual area of a point; those with more are strays
_WITHIN = 0.45  # winding number, from where on a point is within what was seen
_CELL = 0.002  # [m] of the picture of a face
_DISC, _OVERHANG = 0.004, 0.5  # [m] that a Gaussian covers of it at most; standard deviations
_GAP = 5  # cells between Gaussians that are no edge
_STEP = 0.006  # [m] from where on a difference in height is an edge
_FACING, _TURNED = 0.7, 0.1  # cosines between a direction and the normals of what faces it, and of what it still sees
_TURNED_AWAY = 0.7  # below it a normal is of another face
_FEW = 20  # points that are no face
_FLAT, _MOST_OF_IT = 0.97, 0.4  # cosine between the normals of a flat face; share of the target that it is
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


@dataclass(frozen=True, eq=False)
class Surface:
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

    def select(self, chosen: NDArray[np.int64]) -> Surface:
        """The points that are named, about the same centre."""
        columns = (self.points, self.normals, self.half, self.spread)
        points, normals, half, spread = (column[chosen] for column in columns)
        return Surface(points, normals, half, spread, self.seen[chosen], self.doubt[chosen], self.center)


def target_surface(
    scene: MapScene,
    rows: NDArray[np.int64],
    *,
    observers: Array | None = None,
    views: Sequence[DepthView] = (),
    seed: int = 0,
) -> Surface:
    """The surface of the Gaussians ``rows`` (M,) of a scene.

    Normals are the Gaussians' flat axes, averaged over 6 mm, turned to who saw them, or else away from the middle.

    Args:
        scene: the map.
        rows: of the target.
        observers: (N, 3) where each Gaussian of the map was seen from [m, world], NaN where that is not known.
        views: depth that was measured; no side is implied where it saw through.
        seed: of which Gaussians are kept where there are more than 1800.
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
    normals, areas = _smoothed(points, normals, flatness=1.0 - scales[:, 0] / np.maximum(scales[:, 1], 1e-12))
    doubt = _doubts(model, scales)
    half = (rotations(model) * model.scales[:, None, :]).detach().double().numpy()
    kept = np.flatnonzero(areas < _LONELY * np.median(areas))
    apart = np.sqrt(areas)
    spread = np.where(apart > 2 * scales[:, 2], 1.2 * apart, scales[:, 2])  # where only some of many are looked at
    seen = Surface(points, normals, half, spread, np.ones(len(points), np.bool_), doubt, center)
    return _completed(scene, seen.select(kept), areas[kept], views)


def _doubts(model: GaussianModel, scales: Array) -> Array:
    """By the depth fused into them, or of a map from elsewhere their thickness."""
    fused = model.uncertainty.detach().double().numpy()
    return np.where(fused > 0, fused, scales[:, 0])


def _middle(scene: MapScene, points: Array) -> Array:
    """Half way between the highest point and what the target stands on."""
    local = transform_points(inverse(scene.T_world_base), points)
    low, high = np.percentile(local, [1, 99], axis=0)
    support = scene.under(local)
    if support is not None:
        low[2] -= np.clip(float(np.percentile(support.height(local), 1)), 0.0, 0.03)
    return transform_points(scene.T_world_base, (low + high) / 2)


def _smoothed(points: Array, normals: Array, flatness: Array) -> tuple[Array, Array]:
    """Normals averaged with those of neighbours on the same side, and the area that each point stands for (M,) [m²].

    Round Gaussians have little to say.
    """
    p, n = (points - points.mean(axis=0)).astype(np.float32), normals.astype(np.float32)
    square = (p**2).sum(axis=1)
    weight = np.maximum(square[:, None] + square[None] - 2 * (p @ p.T), 0.0)
    np.exp(weight * (-0.5 / _SMOOTH**2), out=weight)
    crowd = weight.sum(axis=1)
    weight *= n @ n.T > 0.3
    weight *= np.maximum(flatness, 0.05).astype(np.float32)
    mean = (weight @ n).astype(np.float64)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return mean, np.asarray(2 * np.pi * _SMOOTH**2 / crowd, dtype=np.float64)


def _completed(scene: MapScene, seen: Surface, areas: Array, views: Sequence[DepthView]) -> Surface:
    """With the sides that go down from its top to the support, and back from the face that was seen in front."""
    up = _along(seen, scene.up)
    leans = bool(up @ scene.up < np.cos(_LEANS / 2))
    floor = float(np.percentile(seen.points @ up, 1)) if leans else _floor(scene, seen, up)
    down = _sides(seen, up, floor)
    parts = [(*down, np.full(len(down[0]), _ROWS / 2))]
    fronts = []
    for face in _faces(seen.normals, up):
        *part, back = _behind(seen, face, up, views)
        parts.append((part[0], part[1], part[2]))
        fronts.append((face, back))
    points, normals, doubt = (np.concatenate([part[k] for part in parts]) for k in range(3))
    # Sides go down to the floor; so where those of a face that was seen in front end above it, there is no bottom.
    standing = np.flatnonzero((normals @ up > -_TURNED_AWAY) | (points @ up < floor + _STEP))
    thin = np.unique(np.floor(points[standing] / _ROWS).astype(np.int64), axis=0, return_index=True)[1]
    every = 1 + len(thin) // MOST
    kept = standing[thin[::every]]
    for face, back in fronts:
        kept = kept[~_between(points[kept], seen, face, back)]
    outer = winding_numbers(points[kept], seen.points, seen.normals, areas, softened=_ROWS) < _WITHIN
    evidence = evidence_at(points[kept], views)
    kept = kept[outer & ~(evidence.seen_through & (evidence.passes >= _THROUGH))]
    kept = kept[~_inside(points[kept], normals[kept], tube=_TUBE * np.sqrt(every))]
    return Surface(
        np.concatenate([seen.points, points[kept]]),
        np.concatenate([seen.normals, normals[kept]]),
        np.concatenate([seen.half, np.zeros((len(kept), 3, 3))]),
        np.concatenate([seen.spread, np.full(len(kept), _ROWS / 2)]),
        np.concatenate([seen.seen, np.zeros(len(kept), np.bool_)]),
        np.concatenate([seen.doubt, doubt[kept]]),
        seen.center,
    )


def _behind(seen: Surface, face: Array, up: Array, views: Sequence[DepthView]) -> tuple[Array, Array, Array, float]:
    """Points and normals (K, 3) of the sides behind a face and of the back, their standard deviation (K,) [m], and
    where the back is along ``face`` [m, world]; infinity: it is curved."""
    back, mirrored = _back(seen, face, up)
    guess = _ROWS / 2
    if not mirrored and back < np.percentile(seen.points @ face, 5):  # nothing of the thing shows how deep it is
        back = max(back, _seen_behind(seen, face, views))
        guess = max(guess, float(np.median(seen.points @ face) - back) / np.sqrt(12))  # all in between is as likely
    points, normals = _sides(seen, face, back, closed=True, mirrored=mirrored)
    doubt = np.where(normals @ face < -_TURNED_AWAY, guess, _ROWS / 2)
    return points, normals, doubt, np.inf if mirrored else back


def _between(points: Array, seen: Surface, face: Array, back: float) -> NDArray[np.bool_]:
    """Whether points (P, 3) are between what faces ``face`` and its back, but for its rim (P,): there is no side."""
    front = seen.points[seen.normals @ face > _FACING]
    if len(front) < _FEW:
        return np.zeros(len(points), np.bool_)
    across = _frame(face)
    flat, own = points @ across.T, front @ across.T
    heights, low = _picture(own, None)
    inwards = _inwards(heights)
    cell = np.floor((flat[:, :2] - low) / _CELL).astype(int)
    on = np.asarray(((cell >= 0) & (cell < heights.shape)).all(axis=1))
    cell = np.where(on[:, None], cell, 0)
    behind = on & (inwards[cell[:, 0], cell[:, 1]] > _SEEN + _DISC)
    return np.asarray(behind & (flat[:, 2] > back + _SEEN) & (flat[:, 2] < np.percentile(own[:, 2], 95)))


def _inwards(heights: Array) -> Array:
    """How far each cell of a picture (H, W) of a face is from its rim [m], holes closed; 0 beside it."""
    known = cv2.morphologyEx(np.isfinite(heights).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((_GAP, _GAP), np.uint8))
    return np.asarray(cv2.distanceTransform(known, cv2.DIST_L2, 5) * _CELL, dtype=np.float64)


def _along(seen: Surface, up: Array) -> Array:
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


def _faces(normals: Array, up: Array) -> list[Array]:
    """Level directions that many normals (M, 3) have, 45 degrees apart, unless the opposite side was seen as well."""
    left = normals[np.abs(normals @ up) < 0.5]
    left = left - np.outer(left @ up, up)
    left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-12)
    few = max(_FEW, 0.05 * len(normals))
    found: list[Array] = []
    while len(left) >= few and len(found) < 8:
        close = left @ left[:: max(1, len(left) // 100)].T > 0.9
        best = int(close.sum(axis=0).argmax())
        if close[:, best].sum() < few:
            break
        face = left[close[:, best]].mean(axis=0)
        face /= np.linalg.norm(face)
        found.append(face)
        left = left[left @ face < _TURNED_AWAY]
    return [face for face in found if not any(face @ other < -_FACING for other in found)]


def _floor(scene: MapScene, seen: Surface, up: Array) -> float:
    """Height along ``up`` [m, world] where the target stands."""
    low = float(np.percentile(seen.points @ up, 1))
    local = transform_points(inverse(scene.T_world_base), seen.points)
    support = scene.under(local)
    if support is None:
        return low - _BEHIND
    under = float(np.percentile(support.height(local), 1))
    return low - under if 0.0 <= under < 0.03 else low - 0.01


def _back(seen: Surface, face: Array, up: Array) -> tuple[float, bool]:
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


def _seen_behind(seen: Surface, face: Array, views: Sequence[DepthView]) -> float:
    """Where along ``face`` [m, world] something behind it was seen through: what is flat in front ends before that.

    Minus infinity: nowhere within the depth that is implied at most. What is behind the rim of a face is not asked.
    """
    facing = seen.normals @ face > _FACING
    if facing.sum() < _FEW or not views:
        return -np.inf
    front = seen.points[facing]
    flat = front @ _frame(face).T
    heights, low = _picture(flat, None)
    cells = np.floor((flat[:, :2] - low) / _CELL).astype(int)
    front = front[_inwards(heights)[cells[:, 0], cells[:, 1]] > _RIM]
    front = front[:: 1 + len(front) // _COLUMNS]
    if len(front) < _FEW:
        return -np.inf
    deep = np.arange(_ROWS, 2 * _BEHIND, _ROWS)
    evidence = evidence_at((front[None] - deep[:, None, None] * face).reshape(-1, 3), views)
    through = (evidence.seen_through & (evidence.passes >= _THROUGH)).reshape(len(deep), len(front))
    ended = np.logical_or.accumulate(through, axis=0).mean(axis=1) >= _HOLLOW
    return float(np.median(front @ face) - deep[ended.argmax()]) if ended.any() else -np.inf


def _bowl(at: Array, heights: Array) -> tuple[Array, float]:
    """Heights (P,) as a paraboloid over places (P, 2) has them, and the standard deviation from it [m]."""
    x, y = (at - at.mean(axis=0)).T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    bent = terms @ np.linalg.lstsq(terms, heights, rcond=None)[0]
    return bent, 1.48 * float(np.median(np.abs(heights - bent)))


def _sides(
    seen: Surface, direction: Array, floor: float, *, closed: bool = False, mirrored: bool = False
) -> tuple[Array, Array]:
    """Points and normals (K, 3) of the sides behind the edges of what faces ``direction``, where none was seen.

    ``closed``: and of the back, at ``floor``, or mirrored at the middle between it and the top.
    """
    none = np.zeros((0, 3)), np.zeros((0, 3))
    facing = seen.normals @ direction > _TURNED
    if facing.sum() < _FEW:
        return none
    across = _frame(direction)
    flat = seen.points @ across.T  # the last is the height
    # A disc that is nearly seen from its edge reaches no farther across than that.
    heights, low = _picture(flat[facing], (seen.spread * (seen.normals @ direction))[facing])
    below, _ = _picture(flat[seen.normals @ direction < -_TURNED], None, like=(heights.shape, low))
    edges = _edges(heights)
    if not len(edges[0]):
        return none
    at, out, top, beyond = edges
    foot = np.maximum(floor, np.maximum(beyond, below[at[:, 0], at[:, 1]]))
    rows = [np.arange(h - _ROWS / 2, f, -_ROWS) for h, f in zip(top, foot, strict=True)]
    count = np.array([len(row) for row in rows])
    if not count.sum():
        return none
    plane = low + (at + 0.5) * _CELL + out * (_CELL / 2)
    points = np.c_[np.repeat(plane, count, axis=0), np.concatenate(rows)] @ across
    normals = np.repeat(np.c_[out, np.zeros(len(out))] @ across, count, axis=0)
    if closed:
        cells = np.argwhere(np.isfinite(heights) & (heights > floor + _STEP) & ~np.isfinite(below))[::2]
        top = heights[cells[:, 0], cells[:, 1]]
        depth = np.maximum(floor + np.percentile(top, 95) - top, floor) if mirrored and len(cells) else floor
        back = np.c_[low + (cells + 0.5) * _CELL, np.broadcast_to(depth, len(cells))] @ across
        points = np.concatenate([points, back])
        normals = np.concatenate([normals, np.tile(-direction, (len(back), 1))])
    new = _unseen(points, normals, seen)
    return points[new], normals[new]


def _frame(direction: Array) -> Array:
    """(3, 3) rows: two unit vectors across the direction, and itself."""
    side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(direction, side), direction])


def _picture(
    flat: Array, spread: Array | None, *, like: tuple[tuple[int, ...], Array] | None = None
) -> tuple[Array, Array]:
    """Greatest height in each cell [m], -inf where there is none, and the low corner (2,) [m].

    ``flat`` (P, 3) are coordinates across and along; each point covers a disc.
    """
    if like is None:
        low = flat[:, :2].min(axis=0) - 3 * _CELL - _DISC
        shape = tuple(np.ceil((flat[:, :2].max(axis=0) + 3 * _CELL + _DISC - low) / _CELL).astype(int) + 1)
    else:
        shape, low = like
    picture = np.full(shape, -np.inf)
    if not len(flat):
        return picture, low
    at = np.floor((flat[:, :2] - low) / _CELL).astype(int)
    reach = np.full(len(flat), _DISC) if spread is None else np.minimum(_OVERHANG * spread, _DISC)
    radius = int(_DISC / _CELL)
    for i in range(-radius, radius + 1):
        for j in range(-radius, radius + 1):
            covers = np.hypot(i, j) * _CELL <= reach
            cell = at[covers] + [i, j]
            inside = ((cell >= 0) & (cell < shape)).all(axis=1)
            np.maximum.at(picture, tuple(cell[inside].T), flat[covers, 2][inside])
    return picture, low


def _edges(heights: Array) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Cells (E, 2) at which a face ends, the way out (E, 2), its height there (E,) and that beyond (E,)."""
    kernel = np.ones((_GAP, _GAP), np.uint8)
    known = np.isfinite(heights).astype(np.uint8)
    closed = cv2.morphologyEx(known, cv2.MORPH_CLOSE, kernel)
    filled = np.where(np.isfinite(heights), heights, -np.inf)
    holes = (closed == 1) & (known == 0)
    if holes.any():
        spread = cv2.dilate(np.where(np.isfinite(filled), filled, -1e9), kernel)
        filled = np.where(holes, spread, filled)
    found, outs, tops, beyonds = [], [], [], []
    padded = np.pad(filled, 1, constant_values=-np.inf)
    blurred = cv2.GaussianBlur(closed.astype(np.float64), (0, 0), 2.0)
    slope = np.stack(np.gradient(blurred), axis=-1)
    for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        beyond = padded[1 + i : padded.shape[0] - 1 + i, 1 + j : padded.shape[1] - 1 + j]
        with np.errstate(invalid="ignore"):
            edge = np.isfinite(filled) & (filled > -1e8) & ((filled - beyond > _STEP) | ~np.isfinite(beyond))
        cells = np.argwhere(edge)
        way = -slope[cells[:, 0], cells[:, 1]]
        length = np.linalg.norm(way, axis=1, keepdims=True)
        way = np.where(length > 1e-3, way / np.maximum(length, 1e-12), [[i, j]])
        good = way @ [i, j] > 0.3
        found.append(cells[good])
        outs.append(way[good])
        tops.append(filled[edge][good])
        beyonds.append(beyond[edge][good])
    return np.concatenate(found), np.concatenate(outs), np.concatenate(tops), np.concatenate(beyonds)


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


def _unseen(points: Array, normals: Array, seen: Surface) -> NDArray[np.bool_]:
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
