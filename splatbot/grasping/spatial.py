"""Targets from spatial hints: a pixel, a point, a mask or a rectangle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.affordance import (
    AffordanceError,
    BoxHint,
    Hint,
    MaskHint,
    MasksHint,
    ObservedView,
    PixelHint,
    PointHint,
    Target,
)
from splatbot.protocols import Array
from splatbot.rasterize.views import render_view
from splatbot.segmentation import MapObject, SegmentedMap
from splatbot.segmentation.clusters import clusters
from splatbot.segmentation.faces import find_faces, nearest_of
from splatbot.segmentation.objects import CONSTANTS as SEGMENTATION


@dataclass(frozen=True)
class SpatialConstants:
    """Constants of targets by place.

    Args:
        max_distance: [m] maximum distance between an indicated point and a Gaussian of the object.
        min_mask_majority: least fraction of a mask's object pixels that belong to the selected object.
        mask_margin: [m] margin around a mask; smaller differences are errors at its boundary.
        min_marked_fraction: least fraction of a mask's Gaussians in each connected piece of a marked part.
        min_outside_fraction: a mask selects a part if more than this fraction of the visible object is outside.
    """

    max_distance: float = 0.02
    min_mask_majority: float = 0.6
    mask_margin: float = 0.01
    min_marked_fraction: float = 0.05
    min_outside_fraction: float = 0.15


CONSTANTS = SpatialConstants()


_WITHIN = "the point is inside of the object, not on its surface"
_TOUCHING = "the object is connected with others in the map; the target is the marked part"
_MARKED = "the target is the part of the map that the masks show"
_UNSEGMENTED = "it is not a segmented object; the target is the marked part"


class SpatialAffordance:
    """Finds the segmented object at a position in an image or in the world."""

    name = "place"

    def understands(self, hint: Hint) -> bool:
        """Return whether the hint is a pixel, point, mask or rectangle."""
        return isinstance(hint, PixelHint | PointHint | MaskHint | MasksHint | BoxHint)

    def locate(self, hint: Hint, scene: SegmentedMap) -> Target:
        """Find the object at the position; see :class:`splatbot.grasping.affordance.Affordance`."""
        if isinstance(hint, PointHint):
            return at_point(scene, _checked_point(hint.point))
        if isinstance(hint, PixelHint):
            return at_point(scene, point_at(scene, hint.view, hint.u, hint.v))
        if isinstance(hint, MaskHint):
            return _at_mask(scene, hint.view, np.asarray(hint.mask), exact=True)
        if isinstance(hint, MasksHint):
            return _at_masks(scene, hint)
        if isinstance(hint, BoxHint):
            return _at_mask(scene, hint.view, _rectangle(hint))
        raise InputError(f"is a {type(hint).__name__}.", field="hint", hint="give a pixel, point, mask or rectangle")


def point_at(scene: SegmentedMap, view: ObservedView, u: float, v: float) -> Array:
    """Backproject the pixel (u, v) with the rendered depth of the map to a point (3,) [m, world].

    Raises:
        InputError: the pixel is outside of the image.
        AffordanceError: the pixel shows no part of the map.
    """
    c = view.camera
    if not (-0.5 <= u < c.width - 0.5 and -0.5 <= v < c.height - 0.5):
        raise InputError(
            f"is ({u:g}, {v:g}) in a picture of {c.width}x{c.height}.",
            field="pixel",
            hint="count from 0, right and down",
        )
    window = _cropped(c, round(u), round(v))
    depth = render_view(scene.model, window, view.T_world_camera, "depth")
    z = float(depth[depth.shape[0] // 2, depth.shape[1] // 2])
    if z <= 0.0:
        raise AffordanceError(f"({u:g}, {v:g}) shows nothing of the map.", field="pixel", hint="point at an object")
    ray = np.array([(u - c.cx) / c.fx, (v - c.cy) / c.fy, 1.0])
    return transform_points(view.T_world_camera, z * ray)


def at_point(scene: SegmentedMap, point: Array, *, backend: str = "place", label: str = "") -> Target:
    """Return the object with the Gaussian nearest to a point (3,) [m, world], or an unsegmented face there.

    Raises:
        AffordanceError: no object or face is within 2 cm; the message names the distance of the nearest object.
    """
    means = scene.model.means.detach().double().numpy()
    away = [float(np.linalg.norm(means[o.rows] - point, axis=1).min()) for o in scene.objects]
    if away and min(away) <= CONSTANTS.max_distance:
        k = int(np.argmin(away))
        found = scene.objects[k]
        others = [a for i, a in enumerate(away) if i != k]
        score = 1.0 if not others else float(np.clip((min(others) - away[k]) / CONSTANTS.max_distance, 0.0, 1.0))
        return Target(found.rows, point, label or found.name or f"object {k}", backend, score, (), k)
    around = _around(scene, point)
    if around is not None:
        return Target(
            around.rows,
            point,
            label or around.name or f"object {around.number}",
            backend,
            0.5,
            (_WITHIN,),
            around.number,
        )
    rows = _face_at(scene, point)
    if len(rows):
        return Target(rows, point, label or "face", backend, 0.5, (_UNSEGMENTED,))
    where = ", ".join(f"{x:.3f}" for x in point)
    nearest = f"; the nearest object is {100 * min(away):.1f} cm away" if away else "; there are no objects"
    raise AffordanceError(f"at ({where}) there is no object{nearest}.", field="target", hint="point at an object")


def _around(scene: SegmentedMap, point: Array) -> MapObject | None:
    """Return the smallest object whose bounding box contains a point, for example a cup with only its rim mapped."""
    local = transform_points(inverse(scene.T_world_base), point)
    found = []
    for candidate in scene.objects:
        low, high = scene.points[candidate.rows].min(axis=0), scene.points[candidate.rows].max(axis=0)
        if ((local > low) & (local < high)).all():
            found.append((float(np.prod(high - low)), candidate.number))
    return scene.objects[min(found)[1]] if found else None


def _face_at(scene: SegmentedMap, point: Array) -> NDArray[np.int64]:
    """Return the Gaussians of the separate face at a point, such as the spine of a book in a shelf; else no rows."""
    local = transform_points(inverse(scene.T_world_base), point)
    rows = np.flatnonzero(scene.solid & (np.abs(scene.points - local) < SEGMENTATION.max_extent / 2).all(axis=1))
    rows = rows[scene.labels[rows] >= -1]
    if len(rows) < SEGMENTATION.min_gaussians:
        return rows[:0]
    faces = find_faces(scene.points[rows], fewest=SEGMENTATION.min_gaussians)
    away = np.linalg.norm(scene.points[rows] - local, axis=1)
    k = int(np.argmin(away))
    own = rows[faces.owner == faces.owner[k]]
    if (
        away[k] > CONSTANTS.max_distance
        or faces.owner[k] < 0
        or np.ptp(scene.points[own], axis=0).max() > 0.9 * SEGMENTATION.max_extent
    ):
        return rows[:0]
    return own


def _at_mask(scene: SegmentedMap, view: ObservedView, mask: NDArray[np.bool_], *, exact: bool = False) -> Target:
    """Return the object that a mask shows; an ``exact`` mask that covers only a part of an object selects the part."""
    mask = _checked_mask(mask, view)
    seeds = _visible(scene, view, mask)
    if not len(seeds):
        raise AffordanceError("shows nothing of the map.", field="mask", hint="mark an object in the image")
    labels = scene.labels[seeds]
    votes = np.bincount(labels[labels >= 0], minlength=len(scene.objects))
    share = votes / len(seeds)
    if not len(votes) or share.sum() < CONSTANTS.min_mask_majority / 2:
        rows = _marked_part(scene, seeds, _visible(scene, view, ~mask)) if exact else scene.grown(seeds)
        if not len(rows):
            raise AffordanceError("shows supports, or too little of an object.", field="mask", hint="mark an object")
        return Target(rows, None, "marked part", "place", 0.5, (_UNSEGMENTED,))
    k = int(np.argmax(votes))
    if votes[k] < CONSTANTS.min_mask_majority * votes.sum():
        names = tuple(o.name or f"object {o.number}" for o in scene.objects if votes[o.number] > 0.2 * votes.sum())
        raise AffordanceError(
            f"shows {len(names)} objects about equally.", field="mask", hint="mark one of them", candidates=names
        )
    found = scene.objects[k]
    label, score = found.name or f"object {k}", float(votes[k] / votes.sum())
    if exact and votes[k] >= SEGMENTATION.min_gaussians:
        shown = _visible(scene, view, np.ones_like(mask))
        shown = shown[scene.labels[shown] == k]
        own, other = seeds[labels == k], np.setdiff1d(shown, seeds)
        outside = (
            nearest_of(scene.points[own], scene.points[other])[1] > CONSTANTS.mask_margin**2
            if len(other)
            else np.zeros(0)
        )
        if outside.sum() > CONSTANTS.min_outside_fraction * len(shown) or 2 * len(own) < len(shown):
            rows = _nearer(scene.points, found.rows, own, other)
            return Target(rows, None, f"part of {label}", "place", score, (_TOUCHING,), k)
    return Target(found.rows, None, label, "place", score, (), k)


def _at_masks(scene: SegmentedMap, hint: MasksHint) -> Target:
    """Return the part of the map that more masks show than exclude, with the hidden Gaussians that belong to it.

    Supports belong to no object. Masks may separate objects that touch, so segmented objects do not matter.
    """
    shown, excluded = (np.zeros(len(scene.model), np.int32) for _ in range(2))
    for one in hint.masks:
        mask = _checked_mask(one.mask, one.view)
        shown[_visible(scene, one.view, mask)] += 1
        excluded[_visible(scene, one.view, ~mask)] += 1
    if not shown.any():
        raise AffordanceError("show nothing of the map.", field="masks", hint="mark an object in the images")
    rows = _marked_part(scene, np.flatnonzero(shown > excluded), np.flatnonzero((excluded > 0) & (excluded >= shown)))
    if not len(rows):
        raise AffordanceError("show no object.", field="masks", hint="mark one object, in each image the same")
    return Target(rows, None, "marked object", "place", 1.0, (_MARKED,))


def _marked_part(scene: SegmentedMap, seeds: NDArray[np.int64], excluded: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the Gaussians that belong to marked ones, such as those of an object in a pile.

    They are connected with the marked Gaussians, and nearer to them than to all excluded ones.

    Args:
        scene: the map; Gaussians of supports are left out.
        seeds: rows of the marked Gaussians.
        excluded: rows of Gaussians that are visible next to the mask.
    """
    own = seeds[scene.labels[seeds] >= -1]
    if len(own) < SEGMENTATION.min_gaussians:
        return own[:0]
    low, high = np.percentile(scene.points[own], [2, 98], axis=0)
    low, high = low - SEGMENTATION.seed_margin, high + SEGMENTATION.seed_margin
    near = ((scene.points > low) & (scene.points < high)).all(axis=1)
    rows = np.flatnonzero(scene.solid & (scene.labels >= -1) & near)
    other = excluded[near[excluded]]
    rows = _nearer(scene.points, rows, own, other) if len(other) else rows
    connected = [rows[part] for part in clusters(scene.points[rows], apart=SEGMENTATION.object_distance)]
    marked = [part for part in connected if np.isin(part, own).sum() >= CONSTANTS.min_marked_fraction * len(own)]
    return np.sort(np.concatenate(marked)) if marked else own[:0]


def _nearer(
    points: Array, rows: NDArray[np.int64], own: NDArray[np.int64], other: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the ``rows`` of points (N, 3) that are nearer to a point of ``own`` than to all points of ``other``."""
    away = [nearest_of(points[some], points[rows])[1] for some in (own, other)]
    return rows[away[0] < away[1]]


def _visible(scene: SegmentedMap, view: ObservedView, mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the rows of the solid Gaussians that are visible in the marked pixels."""
    c = view.camera
    depth = render_view(scene.model, c, view.T_world_camera, "depth") if view.depth is None else view.depth
    rows = np.flatnonzero(scene.solid)
    at = transform_points(inverse(view.T_world_camera), scene.model.means.detach().double().numpy()[rows])
    rows, at = rows[at[:, 2] > 0.01], at[at[:, 2] > 0.01]
    u, v = np.rint(c.project(at)).astype(np.int64).T
    inside = (u >= 0) & (u < c.width) & (v >= 0) & (v < c.height)
    rows, at, u, v = rows[inside], at[inside], u[inside], v[inside]
    return rows[mask[v, u] & (np.abs(depth[v, u] - at[:, 2]) < CONSTANTS.max_distance)]


def _checked_mask(mask: NDArray[np.bool_], view: ObservedView) -> NDArray[np.bool_]:
    mask, shape = np.asarray(mask), (view.camera.height, view.camera.width)
    if mask.shape != shape or mask.dtype != np.bool_:
        raise InputError(f"is {mask.dtype} {mask.shape}.", field="mask", hint=f"give {shape} booleans")
    return mask


def _rectangle(hint: BoxHint) -> NDArray[np.bool_]:
    c = hint.view.camera
    low_u, high_u, low_v, high_v = (
        min(hint.u0, hint.u1),
        max(hint.u0, hint.u1),
        min(hint.v0, hint.v1),
        max(hint.v0, hint.v1),
    )
    if not (high_u >= 0 and high_v >= 0 and low_u <= c.width - 1 and low_v <= c.height - 1):
        raise InputError("is outside of the image.", field="box", hint=f"give pixels of {c.width}x{c.height}")
    v, u = np.mgrid[: c.height, : c.width]
    return np.asarray((u >= low_u) & (u <= high_u) & (v >= low_v) & (v <= high_v))


def _cropped(c: Camera, u: int, v: int) -> Camera:
    """Return the camera cropped to 9 x 9 pixels around (u, v), which is fast to render."""
    return Camera(c.fx, c.fy, c.cx - u + 4, c.cy - v + 4, 9, 9)


def _checked_point(point: Array) -> Array:
    p = np.asarray(point, dtype=np.float64)
    if p.shape != (3,) or not np.isfinite(p).all():
        raise InputError(f"is {p.shape}, or not finite.", field="point", hint="give x y z in metres")
    return p
