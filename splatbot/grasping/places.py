"""Targets from places: a pixel, a point, a mask, a rectangle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.geometry import transform_points
from splatbot.grasping.affordance import (
    AffordanceError,
    BoxHint,
    Hint,
    MaskHint,
    PixelHint,
    PointHint,
    Target,
    View,
)
from splatbot.protocols import Array
from splatbot.rasterize.views import render_view
from splatbot.segmentation import MapScene

NEAR = 0.02  # [m] around a point within which an object's Gaussian must be
_CLEAR = 0.6  # share of a mask's points that one object must have


class PlaceAffordance:
    """The segmented object at a place of a picture or of the world."""

    @property
    def name(self) -> str:
        """As results tell it."""
        return "place"

    def understands(self, hint: Hint) -> bool:
        """Pixels, points, masks and rectangles."""
        return isinstance(hint, PixelHint | PointHint | MaskHint | BoxHint)

    def locate(self, hint: Hint, scene: MapScene) -> Target:
        """See :class:`splatbot.grasping.affordance.Affordance`."""
        if isinstance(hint, PointHint):
            return at_point(scene, _checked_point(hint.point))
        if isinstance(hint, PixelHint):
            return at_point(scene, point_at(scene, hint.view, hint.u, hint.v))
        if isinstance(hint, MaskHint):
            return _at_mask(scene, hint.view, np.asarray(hint.mask))
        if isinstance(hint, BoxHint):
            return _at_mask(scene, hint.view, _rectangle(hint))
        raise InputError(f"is a {type(hint).__name__}.", field="hint", hint="give a pixel, point, mask or rectangle")


def point_at(scene: MapScene, view: View, u: float, v: float) -> Array:
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


def at_point(scene: MapScene, point: Array, *, backend: str = "place") -> Target:
    """The object whose Gaussian is nearest to a point (3,) [m, world].

    Raises:
        AffordanceError: no object is within 2 cm; what is there is said.
    """
    means = scene.model.means.detach().double().numpy()
    away = [float(np.linalg.norm(means[o.rows] - point, axis=1).min()) for o in scene.objects]
    if not away or min(away) > NEAR:
        where = ", ".join(f"{x:.3f}" for x in point)
        nearest = f"; the nearest object is {100 * min(away):.1f} cm away" if away else "; there are no objects"
        raise AffordanceError(f"at ({where}) there is no object{nearest}.", field="target", hint="point at an object")
    k = int(np.argmin(away))
    found = scene.objects[k]
    others = sorted(a for i, a in enumerate(away) if i != k)
    score = 1.0 if not others else float(np.clip((others[0] - away[k]) / NEAR, 0.0, 1.0))
    return Target(found.rows, point, found.name or f"object {k}", backend, score, (), k)


def _at_mask(scene: MapScene, view: View, mask: NDArray[np.bool_]) -> Target:
    c = view.camera
    if mask.shape != (c.height, c.width) or mask.dtype != np.bool_:
        raise InputError(f"is {mask.dtype} {mask.shape}.", field="mask", hint=f"give ({c.height}, {c.width}) booleans")
    depth = render_view(scene.model, c, view.T_world_camera, "depth")
    v, u = np.nonzero(mask & (depth > 0))
    if not len(u):
        raise AffordanceError("shows nothing of the map.", field="mask", hint="mark a thing in the picture")
    pick = np.linspace(0, len(u) - 1, min(len(u), 2000)).astype(np.int64)
    u, v = u[pick], v[pick]
    z = depth[v, u].astype(np.float64)
    points = transform_points(view.T_world_camera, np.stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z], axis=1))
    votes = _votes(scene, points)
    if not votes.any():
        raise AffordanceError("shows no object, only what they stand on.", field="mask", hint="mark a thing")
    k = int(np.argmax(votes))
    share = float(votes[k] / votes.sum())
    if share < _CLEAR:
        names = tuple(o.name or f"object {o.number}" for o in scene.objects if votes[o.number] > 0.2 * votes.sum())
        raise AffordanceError(
            f"shows {len(names)} objects about equally.", field="mask", hint="mark one of them", candidates=names
        )
    found = scene.objects[k]
    return Target(found.rows, None, found.name or f"object {k}", "place", share, (), k)


def _votes(scene: MapScene, points: Array) -> Array:
    """How many of the points (P, 3) are at each object (K,)."""
    rows = np.flatnonzero(scene.labels >= 0)
    votes = np.zeros(len(scene.objects))
    if not len(rows):
        return votes
    means = scene.model.means.detach().double().numpy()[rows]
    for k in range(0, len(points), 256):
        away = np.linalg.norm(points[k : k + 256, None] - means[None], axis=2)
        nearest = away.argmin(axis=1)
        near = away[np.arange(len(nearest)), nearest] <= NEAR
        votes += np.bincount(scene.labels[rows[nearest[near]]], minlength=len(votes))
    return votes


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
