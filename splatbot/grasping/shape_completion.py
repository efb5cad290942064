"""Shape completion: the observed surface of a target with inferred points on its unobserved sides.

Sides are extruded from the edges of observed faces: down from the top to the support, and backwards from front faces.
Measured depth that passes behind a face limits the inferred depth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splatbot.collision.visibility import DepthView, evidence_at
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.relief import CELL, DISC, STEP, Relief, frame_along
from splatbot.grasping.surface import MAX_POINTS, GraspSurface, measured_surface
from splatbot.grasping.volume import winding_numbers
from splatbot.protocols import Array
from splatbot.segmentation import SegmentedMap
from splatbot.segmentation.faces import nearest_of

_COMPLETION_WINDING = 0.45  # winding number above which a point is inside of the observed surface
_FACING_COSINE = 0.7  # minimum cosine between a direction and the normals of a face that points in it
_VISIBLE_COSINE = 0.1  # minimum cosine between a direction and the normals that are visible from it
_SAME_FACE_COSINE = 0.7  # between normals of one face
_MIN_FACE_POINTS = 20
_FLAT_COSINE = 0.97  # between normals of a flat face
_DOMINANT_FRACTION = 0.4  # of the target that a dominant flat face covers
_WIDTH_PRIOR_M = 0.005  # width of a face below which its normals determine its orientation better than its points
_MAX_ROTATION_TANGENT = 0.47  # of the correction of a face's orientation, 25 degrees
_SIDE_COSINE = 0.7  # maximum cosine between up and the normals of a side
_MIN_LEAN_RAD = 0.17  # angle from the vertical above which a flat face leans
_DEFAULT_DEPTH_M = 0.04  # half of the maximum depth that is inferred without an observation of the depth
_MIN_OBSERVED_DEPTH_M = 0.008  # observed depth above which it is the depth of the object
_NOISE_QUANTILE = 1.65  # standard deviations that 5 % of a normal distribution exceed
_TUBE_M = 0.003  # distance of a ray from a point that it meets, for the full point density
_OBSERVED_RADIUS_M = 0.006  # around observed points of a side in which no points are added
_SPACING_M = 0.003  # between added points
_MIN_THROUGH_VIEWS = 2  # views with depth behind an unobserved point that prove it free
_MAX_FREE_FRACTION = 0.03  # of a face, without its boundary, with free space behind it at the depth of the object
_BOUNDARY_M = 0.014  # at the edges of a face, where depth images smear and free space is uncertain
_MAX_COLUMNS = 300  # points of a face behind which free space is queried

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
    """Return the observed surface of a target, completed on its unobserved sides.

    Sides reach from the top down to the support, and from a face that was observed in front to its inferred back.

    Args:
        scene: the segmented map.
        rows: (M,) indices of the target's Gaussians.
        observers: (N, 3) camera centre from which each Gaussian was observed [m, world], NaN where unknown.
        views: measured depth images; no side is completed where they prove free space.
        seed: seed of the subsampling of more than 1800 Gaussians.
        sharp: see :func:`splatbot.grasping.surface.measured_surface`.
    """
    measured, areas = measured_surface(scene, rows, observers=observers, seed=seed, sharp=sharp)
    up = _along(measured, scene.up)
    leans = bool(up @ scene.up < np.cos(_MIN_LEAN_RAD / 2))
    floor = float(np.percentile(measured.points @ up, 1)) if leans else _floor(scene, measured, up)
    down = _extruded_sides(measured, up, floor)
    parts = [(*down, np.full(len(down[0]), _SPACING_M / 2))]
    faces = [_CompletedFace(direction, measured) for direction in _directions(measured, up)]
    backs = []
    for face in faces:
        sides, back = _behind(measured, face, up, views)
        parts.append(sides)
        backs.append(back)
    points, normals, normal_std = (np.concatenate([part[k] for part in parts]) for k in range(3))
    # Sides reach down to the floor, so downward points of a front face's sides above it are no bottom.
    standing = np.flatnonzero((normals @ up > -_SAME_FACE_COSINE) | (points @ up < floor + STEP))
    thin = np.unique(np.floor(points[standing] / _SPACING_M).astype(np.int64), axis=0, return_index=True)[1]
    every = 1 + len(thin) // MAX_POINTS
    kept = standing[thin[::every]]
    for face, back in zip(faces, backs, strict=True):
        kept = kept[~face.hides(points[kept], back)]
    winding = winding_numbers(points[kept], measured.points, measured.normals, areas, softened=_SPACING_M)
    evidence = evidence_at(points[kept], views)
    kept = kept[(winding < _COMPLETION_WINDING) & ~(evidence.seen_through & (evidence.passes >= _MIN_THROUGH_VIEWS))]
    kept = kept[~_inside(points[kept], normals[kept], tube=_TUBE_M * np.sqrt(every))]
    return GraspSurface(
        np.concatenate([measured.points, points[kept]]),
        np.concatenate([measured.normals, normals[kept]]),
        np.concatenate([measured.axes, np.zeros((len(kept), 3, 3))]),
        np.concatenate([measured.spread, np.full(len(kept), _SPACING_M / 2)]),
        np.concatenate([measured.observed, np.zeros(len(kept), np.bool_)]),
        np.concatenate([measured.normal_std, normal_std[kept]]),
        measured.center,
    )


class _CompletedFace:
    """Observed points of a target that face a direction (3,)."""

    def __init__(self, direction: Array, measured: GraspSurface) -> None:
        self.direction = direction
        self.points = measured.points[measured.normals @ direction > _FACING_COSINE]
        self.across = frame_along(direction)
        self.flat = self.points @ self.across.T
        self.relief = Relief.of(self.flat) if len(self.points) >= _MIN_FACE_POINTS else None

    def hides(self, points: Array, back: float) -> NDArray[np.bool_]:
        """Return which points (P, 3) are between the face and its back, away from the boundary: no side is there."""
        if self.relief is None:
            return np.zeros(len(points), np.bool_)
        flat = points @ self.across.T
        behind = self.relief.inwards(flat) > _OBSERVED_RADIUS_M + DISC
        top = np.percentile(self.flat[:, 2], 95)
        return np.asarray(behind & (flat[:, 2] > back + _OBSERVED_RADIUS_M) & (flat[:, 2] < top))

    def seen_through(self, views: Sequence[DepthView]) -> float:
        """Return the coordinate along the direction [m, world] at which measured depth proves free space behind it.

        A flat object ends in front of this coordinate. It is minus infinity if no free space was observed within the
        maximum inferred depth. Points behind the boundary of the face are not queried.
        """
        if self.relief is None or not views:
            return -np.inf
        front = self.points[self.relief.inwards(self.flat) > _BOUNDARY_M]
        front = front[:: 1 + len(front) // _MAX_COLUMNS]
        if len(front) < _MIN_FACE_POINTS:
            return -np.inf
        depths = np.arange(_SPACING_M, 2 * _DEFAULT_DEPTH_M, _SPACING_M)
        evidence = evidence_at((front[None] - depths[:, None, None] * self.direction).reshape(-1, 3), views)
        through = (evidence.seen_through & (evidence.passes >= _MIN_THROUGH_VIEWS)).reshape(len(depths), len(front))
        free = np.logical_or.accumulate(through, axis=0).mean(axis=1) >= _MAX_FREE_FRACTION
        return float(np.median(front @ self.direction) - depths[free.argmax()]) if free.any() else -np.inf


def _behind(
    measured: GraspSurface, face: _CompletedFace, up: Array, views: Sequence[DepthView]
) -> tuple[_Points, float]:
    """Infer the sides behind a face and its back.

    Returns:
        Points (K, 3), normals (K, 3) and standard deviations along the normal (K,) [m]. The last value is the
        coordinate of the back along the face's direction [m, world], infinity for a curved back.
    """
    back, mirrored = _back(measured, face.direction, up)
    back_std = _SPACING_M / 2
    along = measured.points @ face.direction
    if not mirrored and back < np.percentile(along, 5):  # no observation of the depth
        back = max(back, face.seen_through(views))
        back_std = max(back_std, float(np.median(along) - back) / np.sqrt(12))  # uniform distribution of the depth
    points, normals = _extruded_sides(measured, face.direction, back, closed=True, mirrored=mirrored)
    normal_std = np.where(normals @ face.direction < -_SAME_FACE_COSINE, back_std, _SPACING_M / 2)
    return (points, normals, normal_std), np.inf if mirrored else back


def _along(measured: GraspSurface, up: Array) -> Array:
    """Return the axis (3,) of the target: ``up``, or the steepest direction in a dominant flat face that leans.

    The back of a leaning object, such as a book against a wall, is parallel to its face. Its sides end in its own
    frame rather than at the support. Round objects and objects with several visible sides have no dominant face.
    """
    side = measured.normals[np.abs(measured.normals @ up) < _SIDE_COSINE]
    if len(side) < max(_MIN_FACE_POINTS, _DOMINANT_FRACTION * len(measured)):
        return up
    close = side @ side[:: max(1, len(side) // 100)].T > _FLAT_COSINE
    best = int(close.sum(axis=0).argmax())
    if close[:, best].sum() < _DOMINANT_FRACTION * len(measured):
        return up
    face = side[close[:, best]].mean(axis=0)
    face /= np.linalg.norm(face)
    lean = float(face @ up)
    if abs(lean) < np.sin(_MIN_LEAN_RAD):
        return up
    along = up - lean * face
    return np.asarray(along / np.linalg.norm(along))


def _directions(measured: GraspSurface, up: Array) -> list[Array]:
    """Return the horizontal directions of observed faces whose opposite side was not observed."""
    level = np.abs(measured.normals @ up) < 0.5
    left, points = measured.normals[level], measured.points[level]
    left = left - np.outer(left @ up, up)
    left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-12)
    min_points = max(_MIN_FACE_POINTS, 0.05 * len(measured))
    found: list[Array] = []
    while len(left) >= min_points and len(found) < 8:
        close = left @ left[:: max(1, len(left) // 100)].T > 0.9
        own = close[:, int(close.sum(axis=0).argmax())]
        if own.sum() < min_points:
            break
        face = left[own].mean(axis=0)
        face /= np.linalg.norm(face)
        found.append(_across(points[own], face, up))
        other = left @ face < _SAME_FACE_COSINE
        left, points = left[other], points[other]
    return [face for face in found if not any(face @ other < -_FACING_COSINE for other in found)]


def _across(points: Array, face: Array, up: Array) -> Array:
    """Correct the horizontal direction (3,) of a face by a line fit to its points (P, 3).

    Normals that were observed at a slant share an error of 10 degrees and more. The correction applies to planes alone:
    the fits to both halves must agree with the fit to the whole face. For steps and round faces the direction of the
    normals is kept.
    """
    aside = np.cross(up, face)
    local = points @ np.stack([aside, up, face], axis=1)
    left = local[:, 0] < np.median(local[:, 0])
    whole, *halves = (_slope(part) for part in (local, local[left], local[~left]))
    if abs(whole) > _MAX_ROTATION_TANGENT or min(np.sign(whole) * half for half in halves) < 0.5 * abs(whole):
        return face
    turned = face - whole * aside
    return np.asarray(turned / np.linalg.norm(turned))


def _slope(local: Array) -> float:
    """Fit the slope of depth over width to points (P, 3) = (width, height, depth) [m] by robust ridge regression.

    With A = (width, height), n points and the prior width s: slopes = (AᵀA + n s² I)⁻¹ Aᵀ depth. Three rounds reject
    residuals above three median absolute deviations. The prior shrinks the slope of narrow faces, whose normals
    are more accurate than the fit.
    """
    kept = np.ones(len(local), np.bool_)
    slopes = np.zeros(2)
    for _ in range(3):
        middle = local[kept] - local[kept].mean(axis=0)
        A, depth = middle[:, :2], middle[:, 2]
        slopes = np.linalg.solve(A.T @ A + len(A) * _WIDTH_PRIOR_M**2 * np.eye(2), A.T @ depth)
        residual = local[:, 2] - local[:, :2] @ slopes
        residual = np.abs(residual - np.median(residual))
        kept = residual <= max(3 * float(np.median(residual)), _SPACING_M)
    return float(slopes[0])


def _floor(scene: SegmentedMap, measured: GraspSurface, up: Array) -> float:
    """Return the height along ``up`` [m, world] of the support under the target."""
    low = float(np.percentile(measured.points @ up, 1))
    local = transform_points(inverse(scene.T_world_base), measured.points)
    support = scene.under(local)
    if support is None:
        return low - _DEFAULT_DEPTH_M
    under = float(np.percentile(support.height(local), 1))
    return low - under if 0.0 <= under < 0.03 else low - 0.01


def _back(measured: GraspSurface, face: Array, up: Array) -> tuple[float, bool]:
    """Return the coordinate of the back along ``face`` [m, world], and whether the back mirrors the front.

    A flat front is treated as that of a box whose other sides show its depth. A round front is mirrored, since its
    silhouette is half way to the back. Without an observation of the depth, the object is as deep as its smaller
    visible extent, at most 8 cm. Depth within the noise of the front does not count as observed.
    """
    across = measured.points @ np.stack([up, np.cross(up, face)], axis=1)
    along = measured.points @ face
    facing = measured.normals @ face > _FACING_COSINE
    bent, noise = _paraboloid(across[facing], along[facing])
    near, far = float(np.percentile(bent, 95)), float(np.percentile(along, 5))
    if near - far > _MIN_OBSERVED_DEPTH_M + _NOISE_QUANTILE * noise:
        flat = float((near - bent < _MIN_OBSERVED_DEPTH_M).mean()) > 0.7
        return (far, False) if flat else (max(2 * far - near, near - 2 * _DEFAULT_DEPTH_M), True)
    narrow = float(np.ptp(np.percentile(across, [2, 98], axis=0), axis=0).min())
    return near - min(narrow, 2 * _DEFAULT_DEPTH_M), False


def _paraboloid(at: Array, heights: Array) -> tuple[Array, float]:
    """Fit a paraboloid to heights (P,) [m] over points (P, 2); return its heights and the robust noise [m].

    z = a + b x + c y + d x² + e x y + f y² by least squares; noise = 1.48 median |residual|.
    """
    x, y = (at - at.mean(axis=0)).T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    bent = terms @ np.linalg.lstsq(terms, heights, rcond=None)[0]
    return bent, 1.48 * float(np.median(np.abs(heights - bent)))


def _extruded_sides(
    measured: GraspSurface, direction: Array, floor: float, *, closed: bool = False, mirrored: bool = False
) -> tuple[Array, Array]:
    """Extrude sides from the edges of the points that face ``direction``; keep only points on unobserved parts.

    Args:
        measured: observed surface.
        direction: (3,) unit direction of the face [world].
        floor: coordinate along the direction down to which sides reach [m, world].
        closed: add the back at ``floor``.
        mirrored: mirror the back at the middle between ``floor`` and the top.

    Returns:
        Points (K, 3) and normals (K, 3) [world].
    """
    none = np.zeros((0, 3)), np.zeros((0, 3))
    facing = measured.normals @ direction > _VISIBLE_COSINE
    if facing.sum() < _MIN_FACE_POINTS:
        return none
    across = frame_along(direction)
    flat = measured.points @ across.T  # the last coordinate is the height
    # A disc covers only its projection onto the plane of the map.
    relief = Relief.of(flat[facing], (measured.spread * (measured.normals @ direction))[facing])
    below = Relief.of(flat[measured.normals @ direction < -_VISIBLE_COSINE], like=relief).heights
    at, out, top, beyond = relief.edges()
    foot = np.maximum(floor, np.maximum(beyond, below[at[:, 0], at[:, 1]]))
    rows = [np.arange(h - _SPACING_M / 2, f, -_SPACING_M) for h, f in zip(top, foot, strict=True)]
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
    new = _unseen(points, normals, measured)
    return points[new], normals[new]


def _inside(points: Array, normals: Array, *, tube: float) -> NDArray[np.bool_]:
    """Return which points (P, 3) are inside of the target: the first point along their normal is met from behind.

    Args:
        points: (P, 3) [m, world].
        normals: (P, 3) outward unit normals.
        tube: radius around the ray along a normal in which it meets a point [m], at least the spacing of the points.
    """
    if not len(points):
        return np.zeros(0, np.bool_)
    p, n = (points - points.mean(axis=0)).astype(np.float32), normals.astype(np.float32)
    found, square = np.zeros(len(p), np.bool_), (p**2).sum(axis=1)
    for k in range(0, len(p), 256):
        a, d = p[k : k + 256], n[k : k + 256]
        ahead = d @ p.T - np.einsum("ij,ij->i", a, d)[:, None]
        aside = (a**2).sum(axis=1)[:, None] - 2 * (a @ p.T) + square - ahead**2
        ahead[(ahead < _OBSERVED_RADIUS_M) | (aside > tube**2)] = np.inf
        first = ahead.argmin(axis=1)
        hit = np.isfinite(ahead[np.arange(len(a)), first])
        found[k : k + 256] = hit & (np.einsum("ij,ij->i", n[first], d) > 0.3)
    return found


def _unseen(points: Array, normals: Array, measured: GraspSurface) -> NDArray[np.bool_]:
    """Return which points (P, 3) have no observed neighbour with a similar normal within 6 mm (P,)."""
    new = np.ones(len(points), np.bool_)
    reach = max(_OBSERVED_RADIUS_M, 2.0 * float(np.median(measured.spread)))
    for axis in (*np.eye(3), *-np.eye(3)):
        queried, known = normals @ axis > 0.5, measured.normals @ axis > 0.3
        if queried.any() and known.any():
            nearest, square = nearest_of(measured.points[known], points[queried])
            similar = np.einsum("ij,ij->i", measured.normals[known][nearest], normals[queried]) > 0.5
            new[np.flatnonzero(queried)[similar & (square < reach**2)]] = False
    return new
