"""A look from the wrist: the pose of the target before the fingers close, obstacles of the hand, and the empty place.

The map is some seconds old when the hand arrives. One depth image at the pre-grasp shows whether the target moved, and
one after the lift whether its place is empty.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy.spatial import cKDTree

from splatbot.collision import GaussianCollisionField
from splatbot.collision.visibility import DepthView, measured_depths
from splatbot.geometry import frame_along, inverse, transform_points
from splatbot.grasping.hands import Hands
from splatbot.grasping.measured import hand_penetration
from splatbot.grasping.surface import GraspSurface
from splatbot.protocols import Array, HandShape
from splatbot.segmentation import SegmentedMap

if TYPE_CHECKING:
    import open3d as o3d


@dataclass(frozen=True)
class LookConstants:
    """Constants of a look from the wrist.

    Args:
        max_shift: [m] largest motion of the target that is corrected.
        max_turn: [rad] largest rotation of the target that is corrected.
        starts: [m] offsets along both axes of the support from which the registration starts.
        reaches: [m] largest distance of a pair in each iteration of ICP.
        voxel: [m] spacing of the depth that ICP uses.
        close: [m] distance at which a surface point agrees with depth.
        min_points: least number of surface points that the image shows.
        min_share: least share of them that agree with depth.
        tie: ratio of RMS below which a shift counts more than none, and a turn more than a shift.
        noise: [m], [rad] smaller changes are noise, and nothing is corrected.
        support: [m] depth so close to a support is of the support.
        facing: least cosine between the normal of a surface point and the direction to the camera.
        around: [m] radius around the tool in which depth may be in the hand.
        new: [m] depth so far from the map is of something new; edge of the cells that it fills.
        neighbours: least number of other points within ``close`` of a point in the hand.
        gone: [m] depth so far behind a surface point shows that it is gone.
        min_gone: least share of the surface points that must be gone after a lift.
        max_penetration: [m] accepted depth of a point in the hand, with the noise of one image.
    """

    max_shift: float = 0.05
    max_turn: float = float(np.radians(25.0))
    starts: tuple[float, ...] = (0.0, -0.025, 0.025)
    reaches: tuple[float, ...] = (0.03, 0.03, 0.02, 0.02, 0.015, 0.015, 0.01, 0.01, 0.01, 0.01)
    voxel: float = 0.003
    close: float = 0.005
    min_points: int = 30
    min_share: float = 0.8
    tie: float = 0.93
    noise: tuple[float, float] = (0.002, float(np.radians(2.0)))
    support: float = 0.005
    facing: float = 0.2
    around: float = 0.3
    new: float = 0.01
    neighbours: int = 4
    gone: float = 0.015
    min_gone: float = 0.5
    max_penetration: float = 0.005


CONSTANTS = LookConstants()
_HIDDEN = "the image does not show it"


class WristCamera(Protocol):
    """A depth camera that the arm carries."""

    def look(self) -> DepthView:
        """Return the depth (H, W) [m] that the camera sees now, the camera, and T_world_camera (4, 4).

        Pixels of the arm itself are 0. The world is the frame of the map.
        """
        ...


@dataclass(frozen=True, eq=False)
class Relocation:
    """Where a look found the target.

    Args:
        T_now_before: (4, 4) motion of the target since it was mapped, in the world [m]; the identity within noise, and
            if it was not found.
        shift: distance by which its middle moved [m].
        turn: angle by which it turned [rad].
        share: share of the shown surface points that agree with depth.
        points: number of surface points that the image shows.
        reason: why the target was not found; empty if it was.
        shown: whether the image shows enough of the place.
    """

    T_now_before: Array
    shift: float
    turn: float
    share: float
    points: int
    reason: str = ""
    shown: bool = True

    @property
    def still(self) -> bool:
        """Return whether the target did not move beyond noise."""
        return bool(np.array_equal(self.T_now_before, np.eye(4)))


def relocate(scene: SegmentedMap, surface: GraspSurface, view: DepthView) -> Relocation:
    """Find a target in one depth image, near the place where it was mapped.

    1. Point-to-plane ICP (Chen and Medioni 1992) registers the surface points that face the camera to the depth. It
       estimates shifts alone, from nine offsets in the plane of the support.
    2. From the best shift, ICP with Tukey weights estimates a turn too. It counts only if it improves the fit, because
       round objects have no angle, and is at most 25 degrees.
    3. Changes within noise count as none, and large ones as another object.

    Args:
        scene: the segmented map.
        surface: surface of the target, from that map.
        view: the depth image, without the arm.
    """
    import open3d as o3d

    seen = _points(view)
    middle, radius = surface.points.mean(axis=0), np.ptp(surface.points, axis=0).max() / 2
    seen = seen[np.linalg.norm(seen - middle, axis=1) < radius + 1.5 * CONSTANTS.max_shift]
    own = transform_points(inverse(scene.T_world_base), seen)
    for support in scene.supports:
        above = np.abs(support.height(own)) > CONSTANTS.support
        seen, own = seen[above], own[above]
    to_camera = view[2][:3, 3] - surface.points
    cosine = (surface.normals * to_camera).sum(axis=1) / np.linalg.norm(to_camera, axis=1)
    source = surface.points[surface.observed & (cosine > CONSTANTS.facing)]
    if len(source) < CONSTANTS.min_points or len(seen) < CONSTANTS.min_points:
        return _unmoved(_Fit(np.eye(4), CONSTANTS.close, 0.0, min(len(source), len(seen))), _HIDDEN, shown=False)
    target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(seen)).voxel_down_sample(CONSTANTS.voxel)
    target.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=4 * CONSTANTS.voxel, max_nn=20))
    tree = cKDTree(np.asarray(target.points))
    shifts = _shifted(source, tree, np.asarray(target.normals), scene.up)
    shifted = min((_fit(T, source, tree, view) for T in shifts), key=lambda fit: fit.rms)
    best = _fit(np.eye(4), source, tree, view)
    turned = _fit(_turned(source, target, shifted.T), source, tree, view)
    for fit in (shifted, turned) if _angle(turned.T) <= CONSTANTS.max_turn else (shifted,):
        best = fit if fit.rms < CONSTANTS.tie * best.rms else best
    return _judged(best, middle)


def unexplained(scene: SegmentedMap, field: GaussianCollisionField, view: DepthView) -> Array:
    """Return balls (V, 4) = (x, y, z, radius) [m, world] around depth that neither the map nor a support explains.

    Args:
        scene: the segmented map.
        field: collision field of the whole map.
        view: the depth image, without the arm.
    """
    points = _points(view)
    own = transform_points(inverse(scene.T_world_base), points)
    new = np.ones(len(points), np.bool_)
    for support in scene.supports:
        new &= np.abs(support.height(own)) > CONSTANTS.new
    points = points[new]
    points = points[field.clearance(points, cut=CONSTANTS.new).distance >= CONSTANTS.new]
    cells, count = np.unique(np.floor(points / CONSTANTS.new).astype(np.int64), axis=0, return_counts=True)
    cells = cells[count > CONSTANTS.neighbours]
    return np.c_[(cells + 0.5) * CONSTANTS.new, np.full(len(cells), np.sqrt(3.0) / 2 * CONSTANTS.new)]


def in_the_way(hands: Hands, hand: HandShape, view: DepthView, retreat: float) -> float:
    """Return how deep [m] depth lies in a hand on its straight approach. Pixels without neighbours fly at edges.

    Args:
        hands: one hand at the grasp.
        hand: its shape.
        view: the depth image, without the arm.
        retreat: length of the approach [m].
    """
    points = _points(view)
    near = points[np.linalg.norm(points - hands.T[0, :3, 3], axis=1) < CONSTANTS.around + retreat]
    if not len(near):
        return 0.0
    tree = cKDTree(near)
    several = tree.query_ball_point(near, CONSTANTS.close, return_length=True) > CONSTANTS.neighbours
    return float(hand_penetration(hands, near[several], hand, retreat=retreat)[0])


def share_gone(points: Array, view: DepthView) -> float | None:
    """Return the share of surface points (P, 3) [m, world] behind which the image sees; None if it shows too few.

    Points that something nearer hides do not count.
    """
    _, measured, own = measured_depths(points, *view)
    shown = measured > own - CONSTANTS.gone
    if shown.sum() < CONSTANTS.min_points:
        return None
    return float((measured[shown] > own[shown] + CONSTANTS.gone).mean())


def _points(view: DepthView) -> Array:
    """Return the measured points (P, 3) of a depth image [m, world]."""
    depth, camera, T_world_camera = view
    known = np.isfinite(depth) & (depth > 0)
    return transform_points(T_world_camera, camera.backproject(depth)[known].astype(np.float64))


def _shifted(source: Array, tree: cKDTree, normals: Array, up: Array) -> list[Array]:
    """Register points (P, 3) to depth with normals (S, 3) by shifts alone; return a pose (4, 4) for each start."""
    in_plane = frame_along(up)[:, :2]
    poses = []
    for start in itertools.product(CONSTANTS.starts, CONSTANTS.starts):
        T = np.eye(4)
        T[:3, 3] = in_plane @ start
        for reach in CONSTANTS.reaches:
            away, nearest = tree.query(source + T[:3, 3], distance_upper_bound=reach)
            pairs = np.isfinite(away)
            n, q = normals[nearest[pairs]], tree.data[nearest[pairs]]
            residual = (n * (q - source[pairs] - T[:3, 3])).sum(axis=1)
            # The damping leaves a direction that no normal constrains as it is.
            T[:3, 3] += np.linalg.solve(n.T @ n + np.eye(3), n.T @ residual)
        poses.append(T)
    return poses


def _turned(source: Array, target: o3d.geometry.PointCloud, start: Array) -> Array:
    """Register points (P, 3) to depth by a rigid motion (4, 4), from a start."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    tukey = registration.TukeyLoss(k=2 * CONSTANTS.close)
    moving = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(source))
    estimation = registration.TransformationEstimationPointToPlane(tukey)
    return np.asarray(
        registration.registration_icp(moving, target, CONSTANTS.reaches[-1], start, estimation).transformation
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """Agreement with depth at a pose T (4, 4).

    ``rms`` is that of the distances [m], which count at most ``close``; ``share`` of the ``points`` are nearer.
    """

    T: Array
    rms: float
    share: float
    points: int


def _fit(T: Array, source: Array, tree: cKDTree, view: DepthView) -> _Fit:
    """Compare points (P, 3) at a pose with the depth of a view; points that something nearer hides do not count."""
    now = transform_points(T, source)
    rows, measured, own = measured_depths(now, *view)
    shown = rows[measured > own - CONSTANTS.gone]
    if len(shown) < CONSTANTS.min_points:
        return _Fit(T, CONSTANTS.close, 0.0, len(shown))
    away = tree.query(now[shown])[0]
    rms = float(np.sqrt(np.mean(np.minimum(away, CONSTANTS.close) ** 2)))
    return _Fit(T, rms, float((away < CONSTANTS.close).mean()), len(shown))


def _judged(fit: _Fit, middle: Array) -> Relocation:
    shift, turn = float(np.linalg.norm(transform_points(fit.T, middle) - middle)), _angle(fit.T)
    if fit.points < CONSTANTS.min_points:
        return _unmoved(fit, _HIDDEN, shown=False)
    if fit.share < CONSTANTS.min_share:
        return _unmoved(fit, f"only {100 * fit.share:.0f} % of its surface agrees with depth")
    if shift > CONSTANTS.max_shift:
        return _unmoved(fit, f"it moved by {1e3 * shift:.0f} mm")
    if shift <= CONSTANTS.noise[0] and turn <= CONSTANTS.noise[1]:
        return _unmoved(fit)
    return Relocation(fit.T, shift, turn, fit.share, fit.points)


def _unmoved(fit: _Fit, reason: str = "", *, shown: bool = True) -> Relocation:
    """Return a result that corrects nothing."""
    return Relocation(np.eye(4), 0.0, 0.0, fit.share, fit.points, reason, shown)


def _angle(T: Array) -> float:
    return float(np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
