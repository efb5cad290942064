"""Shape completion: the observed surface of a target with inferred points on its unobserved sides.

Sides are extruded from the edges of observed faces: down from the top to the support, and backwards from front faces.
Measured depth that passes behind a face limits the inferred depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.collision.visibility import DepthView, evidence_at
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.relief import CONSTANTS as RELIEF
from splatbot.grasping.relief import Relief, frame_along
from splatbot.grasping.surface import CONSTANTS as SURFACE
from splatbot.grasping.surface import GraspSurface, measured_surface
from splatbot.grasping.volume import winding_numbers
from splatbot.protocols import Array
from splatbot.segmentation import SegmentedMap
from splatbot.segmentation.faces import nearest_of


@dataclass(frozen=True)
class CompletionConstants:
    """Constants of shape completion.

    Args:
        completion_winding: winding number above which a point is inside of the observed surface.
        facing_cosine: minimum cosine between a direction and the normals of a face that points in it.
        visible_cosine: minimum cosine between a direction and the normals that are visible from it.
        same_face_cosine: minimum cosine between normals of one face.
        min_face_points: minimum number of points of a face.
        flat_cosine: minimum cosine between normals of a flat face.
        dominant_fraction: fraction of the target that a dominant flat face covers.
        width_prior: [m] normals determine the orientation of a narrower face better than its points.
        max_rotation_tangent: maximum tangent of the correction of a face's orientation, 25 degrees.
        side_cosine: maximum cosine between up and the normals of a side.
        min_lean: [rad] a flat face with a larger angle from the vertical leans.
        default_depth: [m] half of the maximum depth that is inferred without an observation of the depth.
        min_observed_depth: [m] a larger observed depth is the depth of the object.
        noise_quantile: standard deviations that 5 % of a normal distribution exceed.
        tube: [m] distance of a ray from a point that it meets, at the full point density.
        observed_radius: [m] no points are added within this distance of observed points of a side.
        spacing: [m] distance between added points.
        min_through_views: number of views with depth behind an unobserved point that prove it free.
        max_free_fraction: a face ends where more than this fraction of it has free space behind it.
        boundary: [m] width of the edges of a face at which depth images smear and free space is uncertain.
        max_columns: maximum number of points of a face behind which free space is queried.
    """

    completion_winding: float = 0.45
    facing_cosine: float = 0.7
    visible_cosine: float = 0.1
    same_face_cosine: float = 0.7
    min_face_points: int = 20
    flat_cosine: float = 0.97
    dominant_fraction: float = 0.4
    width_prior: float = 0.005
    max_rotation_tangent: float = 0.47
    side_cosine: float = 0.7
    min_lean: float = 0.17
    default_depth: float = 0.04
    min_observed_depth: float = 0.008
    noise_quantile: float = 1.65
    tube: float = 0.003
    observed_radius: float = 0.006
    spacing: float = 0.003
    min_through_views: int = 2
    max_free_fraction: float = 0.03
    boundary: float = 0.014
    max_columns: int = 300


CONSTANTS = CompletionConstants()


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
    leans = bool(up @ scene.up < np.cos(CONSTANTS.min_lean / 2))
    floor = float(np.percentile(measured.points @ up, 1)) if leans else _floor(scene, measured, up)
    down = _extruded_sides(measured, up, floor)
    parts = [(*down, np.full(len(down[0]), CONSTANTS.spacing / 2))]
    faces = [_CompletedFace(direction, measured) for direction in _directions(measured, up)]
    backs = []
    for face in faces:
        sides, back = _behind(measured, face, up, views)
        parts.append(sides)
        backs.append(back)
    points, normals, normal_std = (np.concatenate([part[k] for part in parts]) for k in range(3))
    # Sides reach down to the floor, so downward points of a front face's sides above it are no bottom.
    standing = np.flatnonzero((normals @ up > -CONSTANTS.same_face_cosine) | (points @ up < floor + RELIEF.min_step))
    thin = np.unique(np.floor(points[standing] / CONSTANTS.spacing).astype(np.int64), axis=0, return_index=True)[1]
    every = 1 + len(thin) // SURFACE.max_points
    kept = standing[thin[::every]]
    for face, back in zip(faces, backs, strict=True):
        kept = kept[~face.hides(points[kept], back)]
    winding = winding_numbers(points[kept], measured.points, measured.normals, areas, softened=CONSTANTS.spacing)
    evidence = evidence_at(points[kept], views)
    kept = kept[
        (winding < CONSTANTS.completion_winding)
        & ~(evidence.seen_through & (evidence.passes >= CONSTANTS.min_through_views))
    ]
    kept = kept[~_inside(points[kept], normals[kept], tube=CONSTANTS.tube * np.sqrt(every))]
    return GraspSurface(
        np.concatenate([measured.points, points[kept]]),
        np.concatenate([measured.normals, normals[kept]]),
        np.concatenate([measured.axes, np.zeros((len(kept), 3, 3))]),
        np.concatenate([measured.spread, np.full(len(kept), CONSTANTS.spacing / 2)]),
        np.concatenate([measured.observed, np.zeros(len(kept), np.bool_)]),
        np.concatenate([measured.normal_std, normal_std[kept]]),
        measured.center,
    )


class _CompletedFace:
    """Observed points of a target that face a direction (3,)."""

    def __init__(self, direction: Array, measured: GraspSurface) -> None:
        self.direction = direction
        self.points = measured.points[measured.normals @ direction > CONSTANTS.facing_cosine]
        self.across = frame_along(direction)
        self.flat = self.points @ self.across.T
        self.relief = Relief.of(self.flat) if len(self.points) >= CONSTANTS.min_face_points else None

    def hides(self, points: Array, back: float) -> NDArray[np.bool_]:
        """Return which points (P, 3) are between the face and its back, away from the boundary: no side is there."""
        if self.relief is None:
            return np.zeros(len(points), np.bool_)
        flat = points @ self.across.T
        behind = self.relief.inwards(flat) > CONSTANTS.observed_radius + RELIEF.max_disc
        top = np.percentile(self.flat[:, 2], 95)
        return np.asarray(behind & (flat[:, 2] > back + CONSTANTS.observed_radius) & (flat[:, 2] < top))

    def seen_through(self, views: Sequence[DepthView]) -> float:
        """Return the coordinate along the direction [m, world] at which measured depth proves free space behind it.

        A flat object ends in front of this coordinate. It is minus infinity if no free space was observed within the
        maximum inferred depth. Points behind the boundary of the face are not queried.
        """
        if self.relief is None or not views:
            return -np.inf
        front = self.points[self.relief.inwards(self.flat) > CONSTANTS.boundary]
        front = front[:: 1 + len(front) // CONSTANTS.max_columns]
        if len(front) < CONSTANTS.min_face_points:
            return -np.inf
        depths = np.arange(CONSTANTS.spacing, 2 * CONSTANTS.default_depth, CONSTANTS.spacing)
        evidence = evidence_at((front[None] - depths[:, None, None] * self.direction).reshape(-1, 3), views)
        through = (evidence.seen_through & (evidence.passes >= CONSTANTS.min_through_views)).reshape(
            len(depths), len(front)
        )
        free = np.logical_or.accumulate(through, axis=0).mean(axis=1) >= CONSTANTS.max_free_fraction
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
    back_std = CONSTANTS.spacing / 2
    along = measured.points @ face.direction
    if not mirrored and back < np.percentile(along, 5):  # no observation of the depth
        back = max(back, face.seen_through(views))
        back_std = max(back_std, float(np.median(along) - back) / np.sqrt(12))  # uniform distribution of the depth
    points, normals = _extruded_sides(measured, face.direction, back, closed=True, mirrored=mirrored)
    normal_std = np.where(normals @ face.direction < -CONSTANTS.same_face_cosine, back_std, CONSTANTS.spacing / 2)
    return (points, normals, normal_std), np.inf if mirrored else back


def _along(measured: GraspSurface, up: Array) -> Array:
    """Return the axis (3,) of the target: ``up``, or the steepest direction in a dominant flat face that leans.

    The back of a leaning object, such as a book against a wall, is parallel to its face. Its sides end in its own
    frame rather than at the support. Round objects and objects with several visible sides have no dominant face.
    """
    side = measured.normals[np.abs(measured.normals @ up) < CONSTANTS.side_cosine]
    if len(side) < max(CONSTANTS.min_face_points, CONSTANTS.dominant_fraction * len(measured)):
        return up
    close = side @ side[:: max(1, len(side) // 100)].T > CONSTANTS.flat_cosine
    best = int(close.sum(axis=0).argmax())
    if close[:, best].sum() < CONSTANTS.dominant_fraction * len(measured):
        return up
    face = side[close[:, best]].mean(axis=0)
    face /= np.linalg.norm(face)
    lean = float(face @ up)
    if abs(lean) < np.sin(CONSTANTS.min_lean):
        return up
    along = up - lean * face
    return np.asarray(along / np.linalg.norm(along))


def _directions(measured: GraspSurface, up: Array) -> list[Array]:
    """Return the horizontal directions of observed faces whose opposite side was not observed."""
    level = np.abs(measured.normals @ up) < 0.5
    left, points = measured.normals[level], measured.points[level]
    left = left - np.outer(left @ up, up)
    left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-12)
    min_points = max(CONSTANTS.min_face_points, 0.05 * len(measured))
    found: list[Array] = []
    while len(left) >= min_points and len(found) < 8:
        close = left @ left[:: max(1, len(left) // 100)].T > 0.9
        own = close[:, int(close.sum(axis=0).argmax())]
        if own.sum() < min_points:
            break
        face = left[own].mean(axis=0)
        face /= np.linalg.norm(face)
        found.append(_across(points[own], face, up))
        other = left @ face < CONSTANTS.same_face_cosine
        left, points = left[other], points[other]
    return [face for face in found if not any(face @ other < -CONSTANTS.facing_cosine for other in found)]


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
    if abs(whole) > CONSTANTS.max_rotation_tangent or min(np.sign(whole) * half for half in halves) < 0.5 * abs(whole):
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
        slopes = np.linalg.solve(A.T @ A + len(A) * CONSTANTS.width_prior**2 * np.eye(2), A.T @ depth)
        residual = local[:, 2] - local[:, :2] @ slopes
        residual = np.abs(residual - np.median(residual))
        kept = residual <= max(3 * float(np.median(residual)), CONSTANTS.spacing)
    return float(slopes[0])


def _floor(scene: SegmentedMap, measured: GraspSurface, up: Array) -> float:
    """Return the height along ``up`` [m, world] of the support under the target."""
    low = float(np.percentile(measured.points @ up, 1))
    local = transform_points(inverse(scene.T_world_base), measured.points)
    support = scene.under(local)
    if support is None:
        return low - CONSTANTS.default_depth
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
    facing = measured.normals @ face > CONSTANTS.facing_cosine
    bent, noise = _paraboloid(across[facing], along[facing])
    near, far = float(np.percentile(bent, 95)), float(np.percentile(along, 5))
    if near - far > CONSTANTS.min_observed_depth + CONSTANTS.noise_quantile * noise:
        flat = float((near - bent < CONSTANTS.min_observed_depth).mean()) > 0.7
        return (far, False) if flat else (max(2 * far - near, near - 2 * CONSTANTS.default_depth), True)
    narrow = float(np.ptp(np.percentile(across, [2, 98], axis=0), axis=0).min())
    return near - min(narrow, 2 * CONSTANTS.default_depth), False


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
    facing = measured.normals @ direction > CONSTANTS.visible_cosine
    if facing.sum() < CONSTANTS.min_face_points:
        return none
    across = frame_along(direction)
    flat = measured.points @ across.T  # the last coordinate is the height
    # A disc covers only its projection onto the plane of the map.
    relief = Relief.of(flat[facing], (measured.spread * (measured.normals @ direction))[facing])
    below = Relief.of(flat[measured.normals @ direction < -CONSTANTS.visible_cosine], like=relief).heights
    at, out, top, beyond = relief.edges()
    foot = np.maximum(floor, np.maximum(beyond, below[at[:, 0], at[:, 1]]))
    rows = [np.arange(h - CONSTANTS.spacing / 2, f, -CONSTANTS.spacing) for h, f in zip(top, foot, strict=True)]
    count = np.array([len(row) for row in rows])
    if not count.sum():
        return none
    plane = relief.at(at) + out * (RELIEF.cell / 2)
    points = np.c_[np.repeat(plane, count, axis=0), np.concatenate(rows)] @ across
    normals = np.repeat(np.c_[out, np.zeros(len(out))] @ across, count, axis=0)
    if closed:
        known = np.isfinite(relief.heights) & (relief.heights > floor + RELIEF.min_step)
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
        ahead[(ahead < CONSTANTS.observed_radius) | (aside > tube**2)] = np.inf
        first = ahead.argmin(axis=1)
        hit = np.isfinite(ahead[np.arange(len(a)), first])
        found[k : k + 256] = hit & (np.einsum("ij,ij->i", n[first], d) > 0.3)
    return found


def _unseen(points: Array, normals: Array, measured: GraspSurface) -> NDArray[np.bool_]:
    """Return which points (P, 3) have no observed neighbour with a similar normal within 6 mm (P,)."""
    new = np.ones(len(points), np.bool_)
    reach = max(CONSTANTS.observed_radius, 2.0 * float(np.median(measured.spread)))
    for axis in (*np.eye(3), *-np.eye(3)):
        queried, known = normals @ axis > 0.5, measured.normals @ axis > 0.3
        if queried.any() and known.any():
            nearest, square = nearest_of(measured.points[known], points[queried])
            similar = np.einsum("ij,ij->i", measured.normals[known][nearest], normals[queried]) > 0.5
            new[np.flatnonzero(queried)[similar & (square < reach**2)]] = False
    return new
