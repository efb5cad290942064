"""Structure in the list of objects: long pieces, and pieces of walls, posts and tables that are cut off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.collision.visibility import DepthView, passing_distance
from splatbot.gaussians.shape import shortest_axes
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array
from splatbot.segmentation import MapObject, SegmentedMap, clusters
from splatbot.segmentation.faces import nearest_of
from splatbot.segmentation.objects import least_gap


@dataclass(frozen=True)
class StructureConstants:
    """Constants of structure.

    Args:
        max_length: [m] longest side of an object.
        min_seam: length of the seam at which a piece continues, relative to the side along it, from which it is a part.
        surface_gap: largest gap of a surface, relative to the distance between objects.
        min_cosine: smallest cosine between the normals of surfaces in line.
        max_offset: [m] largest distance of one from the plane of the other.
        border: [1] share of the width of an image within which its edge cuts a piece.
        min_seen: share of a piece's Gaussians at measured depth from which a view sees it.
        max_cut: share of its Gaussians beyond the edge up to which a view sees the whole piece.
    """

    max_length: float = 0.3
    min_seam: float = 0.67
    surface_gap: float = 2.0
    min_cosine: float = 0.8
    max_offset: float = 0.006
    border: float = 0.02
    min_seen: float = 0.2
    max_cut: float = 0.05


CONSTANTS = StructureConstants()


def find_structures(scene: SegmentedMap, views: Sequence[DepthView] = ()) -> dict[int, str]:
    """Return which objects of a map are structure, by number, and why.

    An object is structure if one of these holds. Objects with names in the scene file are not.

    1. It is longer than 30 cm.
    2. It continues in line into surface that belongs to no object and no support, as a piece of a wall. Both together
       are longer than 30 cm. The seam is at least two thirds of a side. One along a whole side has a share g / l of the
       Gaussians, with the gap g between objects and the longest side l.
    3. Each view that sees it shows a part of it beyond its edge, so that its extent is unknown.

    Args:
        scene: the segmented map.
        views: depth images of the recording. Without them, the last rule does not apply.
    """
    solid = scene.solid
    normals = shortest_axes(scene.model).double().numpy() @ scene.T_world_base[:3, :3]
    rest = np.flatnonzero(solid & (scene.labels == -1))
    gap = least_gap(scene.model, np.flatnonzero(solid))
    surfaces = [rest[part] for part in clusters(scene.points[rest], apart=CONSTANTS.surface_gap * gap)]
    found = {}
    for item in scene.objects:
        if item.name:
            continue
        share = _continued(scene.points, normals, item.rows[solid[item.rows]], surfaces, gap)
        if item.size[0] > CONSTANTS.max_length:
            found[item.number] = f"longer than {CONSTANTS.max_length:g} m"
        elif share >= CONSTANTS.min_seam * gap / max(item.size):
            found[item.number] = f"{share:.0%} continues in other surface"
        elif _is_cut(scene, item, views):
            found[item.number] = "cut by the edge of each view of it"
    return found


def _continued(
    points: Array, normals: Array, rows: NDArray[np.int64], surfaces: Sequence[NDArray[np.int64]], gap: float
) -> float:
    """Return the share of a piece (``rows``) that is within ``gap`` [m] of a Gaussian of a surface in line with it.

    Only surfaces count that are longer than an object, together with the piece.
    """
    low, high = points[rows].min(axis=0), points[rows].max(axis=0)
    found = [np.zeros(0, np.int64)]
    for part in surfaces:
        length = np.maximum(points[part].max(axis=0), high) - np.minimum(points[part].min(axis=0), low)
        if length.max() > CONSTANTS.max_length:
            found.append(part[((points[part] > low - gap) & (points[part] < high + gap)).all(axis=1)])
    near = np.concatenate(found)
    if not len(near):
        return 0.0
    nearest, square = nearest_of(points[near], points[rows])
    other = near[nearest]
    between = points[other] - points[rows]
    cosine = np.abs((normals[rows] * normals[other]).sum(axis=1))
    offset = np.abs(np.stack([(between * normals[of]).sum(axis=1) for of in (rows, other)])).max(axis=0)
    in_line = (square < gap**2) & (cosine > CONSTANTS.min_cosine) & (offset < CONSTANTS.max_offset)
    return float(in_line.mean())


def _is_cut(scene: SegmentedMap, item: MapObject, views: Sequence[DepthView]) -> bool:
    """Return whether views see a piece, and none of them sees all of it."""
    means = scene.model.means.detach().double().numpy()[item.rows]
    cut = [share for depth, camera, T in views if (share := _share_beyond(means, (depth, camera, T))) is not None]
    return bool(cut) and min(cut) > CONSTANTS.max_cut


def _share_beyond(means: Array, view: DepthView) -> float | None:
    """Return the share of points (P, 3) [m, world] beyond the edge of a view, or None if it does not see them."""
    depth, camera, T_world_camera = view
    p = transform_points(inverse(T_world_camera), means)
    ahead = p[:, 2] > 0.0
    z = np.where(ahead, p[:, 2], 1.0)
    u, v = camera.fx * p[:, 0] / z + camera.cx, camera.fy * p[:, 1] / z + camera.cy
    most, border = np.array([camera.width - 1, camera.height - 1]), CONSTANTS.border * camera.width
    at = np.stack([u, v], axis=1)
    inside = ahead & ((at >= 0) & (at <= most)).all(axis=1)
    pixels = np.rint(at[inside]).astype(np.int64)
    measured = depth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    hits = (measured > 0) & (np.abs(measured - z[inside]) <= passing_distance(z[inside]))
    if hits.sum() < CONSTANTS.min_seen * len(means):
        return None
    whole = ahead & ((at >= border) & (at <= most - border)).all(axis=1)
    return float((~whole).mean())
