"""Changes between two recordings of a place: surface that one measured and the other saw through, as objects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.collision.confirmed import find_confirmed
from splatbot.collision.visibility import DepthView, measured_depths, passing_distance
from splatbot.geometry import nearest_rotation
from splatbot.protocols import Array
from splatbot.segmentation.clusters import clusters
from splatbot.spacing import evenly_spaced

Colors = Sequence[NDArray[np.uint8]]
Kind = Literal["appeared", "removed", "moved"]


@dataclass(frozen=True)
class ChangeConstants:
    """Constants of changes.

    Args:
        views: largest number of views of each recording, evenly spaced. The work grows with its square.
        confirming_views: number of other views of the same recording that measure a surface point.
        passing_views: number of views of the other recording that see through it; none of them may hit it.
        spacing: [m] edge of the voxels that keep one point each.
        apart: [m] distance of two objects.
        least_points: number of voxels of the smallest object.
        least_size: [m] its largest side.
        reach: [px] half the side of the window in which a view must see through a point, and may not hit it. It covers
            the errors of poses.
        same_size: largest difference of the sides [share of the side] of an object that moved, if its colours are
            equal. Other objects of a place may be as similar by chance.
        same_color: [0..1] the same of its colours, if its sides are equal.
        color_quantiles: quantiles of each channel that describe the colours of an object.
    """

    views: int = 40
    confirming_views: int = 1
    passing_views: int = 2
    spacing: float = 0.01
    apart: float = 0.03
    least_points: int = 12
    least_size: float = 0.03
    reach: int = 1
    same_size: float = 0.39
    same_color: float = 0.078
    color_quantiles: tuple[float, ...] = (0.1, 0.3, 0.5, 0.7, 0.9)


CONSTANTS = ChangeConstants()


@dataclass(frozen=True, eq=False)
class ChangedObject:
    """An object that differs between two recordings, A and the later B.

    Args:
        kind: "appeared" is only in B, "removed" only in A, "moved" in both at other places.
        center: (3,) centre of its box [m, world of A]; of an object that moved, the one in B.
        size: (3,) sides of its box, largest first [m].
        axes: (3, 3) directions of the sides, as columns.
        shades: (5, 3) quantiles of each channel of its colour in 0..1, darkest first; the third is the median.
        points: number of voxels of its surface.
        previous: the removed object of A that it is, if it moved; None for others.
    """

    kind: Kind
    center: Array
    size: Array
    axes: Array
    shades: Array
    points: int
    previous: ChangedObject | None = None


def find_changes(
    views_a: Sequence[DepthView],
    colors_a: Colors,
    views_b: Sequence[DepthView],
    colors_b: Colors,
    *,
    floor: float,
    quad: float,
    report: Callable[[float], None] = lambda _share: None,
) -> list[ChangedObject]:
    """Find the objects that differ between two recordings, largest first.

    Surface counts if two views of its recording measure it. It is gone if two views of the other recording see through
    it and none of them measures it. So space that one of them did not see is no change. A removed object and an
    appeared one of the same size and colour are one that moved.

    Args:
        views_a, views_b: depth (H, W) [m], 0 where missing, camera, and T_world_camera (4, 4) in one world.
        colors_a, colors_b: (H, W, 3) colour of each view, of the size of its depth.
        floor, quad: σ = ``floor`` + ``quad`` z² of depth, in [m] and [1/m].
        report: called with the finished share of the work.

    Raises:
        InputError: the size of a depth image differs from its camera's.
    """
    parts = ((views_a, colors_a, views_b), (views_b, colors_b, views_a))
    found: list[list[ChangedObject]] = []
    for kind, (views, colors, others) in zip(("removed", "appeared"), parts, strict=True):
        views, others = (evenly_spaced(some, CONSTANTS.views) for some in (views, others))
        points, shades = _seen_through(views, evenly_spaced(colors, CONSTANTS.views), others, floor, quad)
        found.append(_objects(kind, points, shades))  # type: ignore[arg-type]
        report(0.5 * len(found))
    return sorted(_with_moved(*found), key=lambda change: -float(np.prod(change.size)))


def _seen_through(
    views: Sequence[DepthView], colors: Colors, others: Sequence[DepthView], floor: float, quad: float
) -> tuple[Array, Array]:
    """Return confirmed surface points (P, 3) [m] of views that other views see through, and their colours (P, 3)."""
    space = find_confirmed(views, floor=floor, quad=quad, agreeing_views=CONSTANTS.confirming_views)
    passes, hits = evidence_around(space.surface, others)
    gone = np.flatnonzero((passes >= CONSTANTS.passing_views) & (hits == 0))
    column, row = space.pixel[gone].T
    shades = np.array([colors[v][y, x] for v, y, x in zip(space.view[gone], row, column, strict=True)]).reshape(-1, 3)
    cells = np.floor(space.surface[gone] / CONSTANTS.spacing).astype(np.int64)
    first = np.unique(cells, axis=0, return_index=True)[1]
    return space.surface[gone][first], shades[first] / 255.0


def evidence_around(points: Array, views: Sequence[DepthView]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Count the views that see through points (P, 3) [m, world], and those that hit them.

    All pixels of a window must see through a point, and one of them hits it. So errors of poses by a pixel do not make
    the edge of an object vanish.
    """
    passes, hits = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    window = np.ones((2 * CONSTANTS.reach + 1,) * 2, np.uint8)
    for depth, camera, T_world_camera in views:
        known = np.where(depth > 0, depth, np.float32(0))
        nearest = _float(cv2.erode(known, window))  # 0 where a pixel of the window is unknown
        rows, measured, z = measured_depths(points, nearest, camera, T_world_camera)
        passes[rows[measured - z > passing_distance(z)]] += 1
        farthest = _float(cv2.dilate(known, window))
        least = np.where(farthest > 0, _float(cv2.erode(np.where(known > 0, known, farthest.max()), window)), 0)
        rows, below, z = measured_depths(points, least, camera, T_world_camera)
        _, above, _ = measured_depths(points, farthest, camera, T_world_camera)
        tolerance = passing_distance(z)
        hits[rows[(below <= z + tolerance) & (above >= z - tolerance)]] += 1
    return passes, hits


def _float(image: cv2.typing.MatLike) -> NDArray[np.float32]:
    return np.asarray(image, np.float32)


def _objects(kind: Kind, points: Array, colors: Array) -> list[ChangedObject]:
    """Return the clusters of points (P, 3) [m] that are large enough, each in its smallest box."""
    found = []
    for rows in clusters(points, apart=CONSTANTS.apart):
        if len(rows) < CONSTANTS.least_points:
            continue
        axes = _box_axes(points[rows])
        low, high = (points[rows] @ axes).min(axis=0), (points[rows] @ axes).max(axis=0)
        order = np.argsort(low - high)
        size, center = (high - low)[order], axes @ ((low + high) / 2)
        shades = np.quantile(colors[rows], CONSTANTS.color_quantiles, axis=0)
        if size[0] >= CONSTANTS.least_size:
            found.append(ChangedObject(kind, center, size, axes[:, order], shades, len(rows)))
    return found


def _box_axes(points: Array) -> Array:
    """Return the directions (3, 3) of the sides of the smallest box around points (P, 3), as columns."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):  # it warns of rounded rotations
        return nearest_rotation(cloud.get_minimal_oriented_bounding_box(robust=True).R)


def _with_moved(removed: Sequence[ChangedObject], appeared: Sequence[ChangedObject]) -> list[ChangedObject]:
    """Return all objects, with each appeared one and the removed one that is most like it as one that moved."""
    left, found = list(removed), []
    for new in appeared:
        old = min(left, key=lambda old: _difference(old, new), default=None)
        if old is None or _difference(old, new) > 1:
            found.append(new)
            continue
        left = [other for other in left if other is not old]
        found.append(replace(new, kind="moved", previous=old))
    return [*found, *left]


def _difference(old: ChangedObject, new: ChangedObject) -> float:
    """Return the difference of two objects in size and colour; up to 1 they may be the same.

    The colours differ by the mean distance of their distributions along each channel (1-D Wasserstein).
    """
    sides = float((np.abs(old.size - new.size) / np.maximum(old.size, new.size)).max())
    return sides / CONSTANTS.same_size + float(np.abs(old.shades - new.shades).mean()) / CONSTANTS.same_color
