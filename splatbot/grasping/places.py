"""Targets from places: a pixel, a point, a mask, a rectangle."""

from __future__ import annotations

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
    ObservedView,
    PixelHint,
    PointHint,
    Target,
)
from splatbot.protocols import Array
from splatbot.rasterize.views import render_view
from splatbot.segmentation import MapObject, SegmentedMap
from splatbot.segmentation.objects import FEWEST, LARGEST
from splatbot.segmentation.parts import find_faces, nearest_of

NEAR = 0.02  # [m] around a point within which an object's Gaussian must be
_CLEAR = 0.6  # share of a mask's objects that one must have
_WITHIN = "it was pointed at within it, not at its surface"
_BESIDE, _PART = 0.01, 0.15  # [m] beside what a mask marks; share of what shows of an object and is farther, from
# where on what is marked is a thing of its own, as where it is less than half: masks are rough at their rims
_TOUCHING = "it hangs together with more in the map: what was marked is taken for it"
_UNSEGMENTED = "it is no object of its own: what was marked of its faces is taken for it"


class PlaceAffordance:
    """The segmented object at a place of a picture or of the world."""

    @property
    def name(self) -> str:
        """As results tell it."""
        return "place"

    def understands(self, hint: Hint) -> bool:
        """Pixels, points, masks and rectangles."""
        return isinstance(hint, PixelHint | PointHint | MaskHint | BoxHint)

    def locate(self, hint: Hint, scene: SegmentedMap) -> Target:
        """See :class:`splatbot.grasping.affordance.Affordance`."""
        if isinstance(hint, PointHint):
            return at_point(scene, _checked_point(hint.point))
        if isinstance(hint, PixelHint):
            return at_point(scene, point_at(scene, hint.view, hint.u, hint.v))
        if isinstance(hint, MaskHint):
            return _at_mask(scene, hint.view, np.asarray(hint.mask), exact=True)
        if isinstance(hint, BoxHint):
            return _at_mask(scene, hint.view, _rectangle(hint))
        raise InputError(f"is a {type(hint).__name__}.", field="hint", hint="give a pixel, point, mask or rectangle")


def point_at(scene: SegmentedMap, view: ObservedView, u: float, v: float) -> Array:
    """What the pixel (u, v) of a view shows of the map (3,) [m, world].

    Raises:
        InputError: the pixel is not in the picture.
        AffordanceError: there is nothing of the map.
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
        raise AffordanceError(f"({u:g}, {v:g}) shows nothing of the map.", field="pixel", hint="point at a thing")
    ray = np.array([(u - c.cx) / c.fx, (v - c.cy) / c.fy, 1.0])
    return transform_points(view.T_world_camera, z * ray)


def at_point(scene: SegmentedMap, point: Array, *, backend: str = "place", label: str = "") -> Target:
    """The object whose Gaussian is nearest to a point (3,) [m, world], or the face of what was not segmented there.

    Raises:
        AffordanceError: nothing is within 2 cm but what things stand on; what is there is said.
    """
    means = scene.model.means.detach().double().numpy()
    away = [float(np.linalg.norm(means[o.rows] - point, axis=1).min()) for o in scene.objects]
    if away and min(away) <= NEAR:
        k = int(np.argmin(away))
        found = scene.objects[k]
        others = [a for i, a in enumerate(away) if i != k]
        score = 1.0 if not others else float(np.clip((min(others) - away[k]) / NEAR, 0.0, 1.0))
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
    """The smallest object in whose box a point is, as within a cup of which only the rim was mapped."""
    local = transform_points(inverse(scene.T_world_base), point)
    found = []
    for thing in scene.objects:
        low, high = scene.points[thing.rows].min(axis=0), scene.points[thing.rows].max(axis=0)
        if ((local > low) & (local < high)).all():
            found.append((float(np.prod(high - low)), thing.number))
    return scene.objects[min(found)[1]] if found else None


def _face_at(scene: SegmentedMap, point: Array) -> NDArray[np.int64]:
    """The Gaussians around a point, if they are a face of their own, as that of a book in a shelf."""
    local = transform_points(inverse(scene.T_world_base), point)
    rows = np.flatnonzero(scene.solid & (np.abs(scene.points - local) < LARGEST / 2).all(axis=1))
    rows = rows[scene.labels[rows] >= -1]
    if len(rows) < FEWEST:
        return rows[:0]
    faces = find_faces(scene.points[rows], fewest=FEWEST)
    away = np.linalg.norm(scene.points[rows] - local, axis=1)
    k = int(np.argmin(away))
    own = rows[faces.owner == faces.owner[k]]
    if away[k] > NEAR or faces.owner[k] < 0 or np.ptp(scene.points[own], axis=0).max() > 0.9 * LARGEST:
        return rows[:0]
    return own


def _at_mask(scene: SegmentedMap, view: ObservedView, mask: NDArray[np.bool_], *, exact: bool = False) -> Target:
    """The object that a mask shows; of an ``exact`` one that leaves out much of it, what is marked."""
    c = view.camera
    if mask.shape != (c.height, c.width) or mask.dtype != np.bool_:
        raise InputError(f"is {mask.dtype} {mask.shape}.", field="mask", hint=f"give ({c.height}, {c.width}) booleans")
    seeds = _visible(scene, view, mask)
    if not len(seeds):
        raise AffordanceError("shows nothing of the map.", field="mask", hint="mark a thing in the picture")
    labels = scene.labels[seeds]
    votes = np.bincount(labels[labels >= 0], minlength=len(scene.objects))
    share = votes / len(seeds)
    if not len(votes) or share.sum() < _CLEAR / 2:
        rows = scene.grown(seeds)
        if not len(rows):
            raise AffordanceError("shows no object, only what they stand on.", field="mask", hint="mark a thing")
        return Target(rows, None, "what was marked", "place", 0.5, (_UNSEGMENTED,))
    k = int(np.argmax(votes))
    if votes[k] < _CLEAR * votes.sum():
        names = tuple(o.name or f"object {o.number}" for o in scene.objects if votes[o.number] > 0.2 * votes.sum())
        raise AffordanceError(
            f"shows {len(names)} objects about equally.", field="mask", hint="mark one of them", candidates=names
        )
    found = scene.objects[k]
    label, score = found.name or f"object {k}", float(votes[k] / votes.sum())
    if exact and votes[k] >= FEWEST:
        shown = _visible(scene, view, np.ones_like(mask))
        shown = shown[scene.labels[shown] == k]
        own, other = seeds[labels == k], np.setdiff1d(shown, seeds)
        beside = nearest_of(scene.points[own], scene.points[other])[1] > _BESIDE**2 if len(other) else np.zeros(0)
        if beside.sum() > _PART * len(shown) or 2 * len(own) < len(shown):
            rows = _nearer(scene.points, found.rows, own, other)
            return Target(rows, None, f"part of {label}", "place", score, (_TOUCHING,), k)
    return Target(found.rows, None, label, "place", score, (), k)


def _nearer(
    points: Array, rows: NDArray[np.int64], own: NDArray[np.int64], other: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Those of ``rows`` of points (N, 3) that are nearer to one of the rows ``own`` than to any of ``other``."""
    away = [nearest_of(points[some], points[rows])[1] for some in (own, other)]
    return rows[away[0] < away[1]]


def _visible(scene: SegmentedMap, view: ObservedView, mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows of the solid Gaussians that show in the marked pixels."""
    c = view.camera
    depth = render_view(scene.model, c, view.T_world_camera, "depth")
    rows = np.flatnonzero(scene.solid)
    at = transform_points(inverse(view.T_world_camera), scene.model.means.detach().double().numpy()[rows])
    rows, at = rows[at[:, 2] > 0.01], at[at[:, 2] > 0.01]
    u, v = np.rint(c.project(at)).astype(np.int64).T
    inside = (u >= 0) & (u < c.width) & (v >= 0) & (v < c.height)
    rows, at, u, v = rows[inside], at[inside], u[inside], v[inside]
    return rows[mask[v, u] & (np.abs(depth[v, u] - at[:, 2]) < NEAR)]


def _rectangle(hint: BoxHint) -> NDArray[np.bool_]:
    c = hint.view.camera
    low_u, high_u, low_v, high_v = (
        min(hint.u0, hint.u1),
        max(hint.u0, hint.u1),
        min(hint.v0, hint.v1),
        max(hint.v0, hint.v1),
    )
    if not (high_u >= 0 and high_v >= 0 and low_u <= c.width - 1 and low_v <= c.height - 1):
        raise InputError("is out of the picture.", field="box", hint=f"give pixels of {c.width}x{c.height}")
    v, u = np.mgrid[: c.height, : c.width]
    return np.asarray((u >= low_u) & (u <= high_u) & (v >= low_v) & (v <= high_v))


def _cropped(c: Camera, u: int, v: int) -> Camera:
    """The camera with only 9 pixels around (u, v), which renders in no time."""
    return Camera(c.fx, c.fy, c.cx - u + 4, c.cy - v + 4, 9, 9)


def _checked_point(point: Array) -> Array:
    p = np.asarray(point, dtype=np.float64)
    if p.shape != (3,) or not np.isfinite(p).all():
        raise InputError(f"is {p.shape}, or not finite.", field="point", hint="give x y z in metres")
    return p
