"""Pictures of a scene for a model: from several sides, and one in which there is nothing to find."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, look_at, transform_points
from splatbot.grasping.affordance import ObservedView
from splatbot.grasping.vision.models import Picture
from splatbot.rasterize.views import colorize, render_view
from splatbot.segmentation import SegmentedMap

_STEEP = np.radians(50.0)  # of the cameras over the support
_FIELD = np.radians(50.0)  # horizontal
_SPREAD = np.radians(35.0)  # between neighbouring cameras, around the up axis
_ROOM = 1.35  # times the objects' extent that a picture shows


def scene_views(
    scene: SegmentedMap, count: int = 3, *, width: int = 640, height: int = 480
) -> tuple[ObservedView, ...]:
    """Cameras around the objects of a scene, from the base's side, that show all of them.

    Raises:
        InputError: the scene has no objects, or ``count`` is not above 0.
    """
    if not scene.objects or count < 1:
        raise InputError("has no objects, or no views are wanted.", field="scene", hint="map a scene with objects")
    focal = 0.5 * width / np.tan(_FIELD / 2)
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    rows = np.concatenate([o.rows for o in scene.objects])
    points = transform_points(inverse(scene.T_world_base), scene.model.means.detach().double().numpy()[rows])
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    reach = _ROOM * float(np.linalg.norm(points - center, axis=1).max())
    away = reach / np.sin(min(_FIELD, 2 * np.arctan(0.5 * height / focal)) / 2)
    behind = np.arctan2(-center[1], -center[0])  # from the objects to the base
    views = []
    for k in range(count):
        turn = behind + (k - (count - 1) / 2) * _SPREAD
        side = np.array([np.cos(turn) * np.cos(_STEEP), np.sin(turn) * np.cos(_STEEP), np.sin(_STEEP)])
        views.append(ObservedView(camera, scene.T_world_base @ look_at(center + away * side, center)))
    return tuple(views)


def picture_of(scene: SegmentedMap, view: ObservedView) -> Picture:
    """What a view saw, or how the map renders from there."""
    return view.rgb if view.rgb is not None else _rendered(scene.model, view)


def empty_picture(scene: SegmentedMap, view: ObservedView) -> Picture:
    """The map from a view, with all of its objects taken away: who still sees one is guessing."""
    return _rendered(scene.model.select(torch.from_numpy(scene.labels < 0)), view)


def _rendered(model: GaussianModel, view: ObservedView) -> Picture:
    picture: NDArray[np.uint8] = colorize(render_view(model, view.camera, view.T_world_camera), "rgb")
    return picture
