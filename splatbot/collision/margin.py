"""How far a map's surfaces are from what its own depth images measured, and the margin that this calls for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.camera import Camera
from splatbot.collision.field import GaussianCollisionField
from splatbot.collision.inputs import rows
from splatbot.errors import InputError
from splatbot.geometry import transform_points
from splatbot.protocols import Array

_EACH = 5000  # points of one image
_CUT = 0.3  # [m]; what was measured farther from the map than this counts as this far


@dataclass(frozen=True, eq=False)
class SurfaceError:
    """How far measured points lie outside of a field's ellipsoids.

    A ball that reaches d [m] beyond a point of a surface is called a hit if that point is less than d outside of the
    ellipsoids; so no ball is called free that is deeper in a surface than the error there.

    Args:
        sorted: (P,) [m], ascending; 0 for points inside of an ellipsoid.
    """

    sorted: Array

    def share(self, share: float) -> float:
        """The error [m] that a share (0..1) of the points does not exceed."""
        if not 0.0 <= share <= 1.0:
            raise InputError(f"is {share}.", field="share", hint="give a value in 0..1, as 0.999")
        return float(np.quantile(self.sorted, share))


def surface_error(
    field: GaussianCollisionField,
    views: Iterable[tuple[NDArray[np.float32], Camera, Array]],
    *,
    around: ArrayLike | None = None,
) -> SurfaceError:
    """Ask the field at what was measured: up to 5,000 pixels of each view, evenly spaced.

    ``surface_error(field, views).share(0.999)`` is what ``RobotSpheres(margin=)`` may be set to where a touch in seen
    space must not happen: the depth's own noise is in it, so it is rather too large.

    Args:
        field: the map.
        views: depth (H, W) [m, 0 or NaN: none], camera and T_world_camera (4, 4) of each, as tracked.
        around: (x, y, z, radius) [m, world]: only what lies in this ball counts, as all that an arm reaches; None: all.

    Raises:
        InputError: a depth image is not of its camera's size, or no view has any depth there.
    """
    ball = None if around is None else rows(np.atleast_2d(np.asarray(around)), "around", 4, "(x, y, z, radius)")[0]
    found = []
    for depth, camera, T_world_camera in views:
        if depth.shape != (camera.height, camera.width):
            raise InputError(f"is {depth.shape}.", field="depth", hint=f"give ({camera.height}, {camera.width})")
        v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
        some = np.linspace(0, len(v) - 1, min(len(v), _EACH)).astype(np.int64)
        z = depth[v[some], u[some]].astype(np.float64)
        ray = np.stack([(u[some] - camera.cx) / camera.fx, (v[some] - camera.cy) / camera.fy, np.ones(len(some))], 1)
        points = transform_points(T_world_camera, ray * z[:, None])
        if ball is not None:
            points = points[np.linalg.norm(points - ball[:3], axis=1) <= ball[3]]
        found.append(np.clip(field.clearance(points, cut=_CUT).distance, 0.0, _CUT))
    if not sum(map(len, found)):
        raise InputError("have no depth.", field="views", hint="give the depth images that the map was made of")
    return SurfaceError(np.sort(np.concatenate(found)))
