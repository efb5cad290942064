"""Images of a scene for a vision-language model: from several sides, and one without objects."""

from __future__ import annotations

from dataclasses import dataclass

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


@dataclass(frozen=True)
class ViewConstants:
    """Constants of the cameras around a scene.

    Args:
        elevation: [rad] elevation of the cameras over the support.
        field_of_view: [rad] horizontal field of view.
        azimuth_step: [rad] angle between neighbouring cameras.
        extent_factor: visible extent relative to that of the objects.
    """

    elevation: float = float(np.radians(50.0))
    field_of_view: float = float(np.radians(50.0))
    azimuth_step: float = float(np.radians(35.0))
    extent_factor: float = 1.35


CONSTANTS = ViewConstants()


def scene_views(
    scene: SegmentedMap, count: int = 3, *, width: int = 640, height: int = 480
) -> tuple[ObservedView, ...]:
    """Return cameras on the robot's side of the objects that show all of them.

    Raises:
        InputError: the scene has no objects, or ``count`` is not above 0.
    """
    if not scene.objects or count < 1:
        raise InputError("has no objects, or no views are wanted.", field="scene", hint="map a scene with objects")
    focal = 0.5 * width / np.tan(CONSTANTS.field_of_view / 2)
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    rows = np.concatenate([o.rows for o in scene.objects])
    points = transform_points(inverse(scene.T_world_base), scene.model.means.detach().double().numpy()[rows])
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    reach = CONSTANTS.extent_factor * float(np.linalg.norm(points - center, axis=1).max())
    away = reach / np.sin(min(CONSTANTS.field_of_view, 2 * np.arctan(0.5 * height / focal)) / 2)
    behind = np.arctan2(-center[1], -center[0])  # from the objects to the base
    views = []
    for k in range(count):
        turn = behind + (k - (count - 1) / 2) * CONSTANTS.azimuth_step
        side = np.array(
            [
                np.cos(turn) * np.cos(CONSTANTS.elevation),
                np.sin(turn) * np.cos(CONSTANTS.elevation),
                np.sin(CONSTANTS.elevation),
            ]
        )
        views.append(ObservedView(camera, scene.T_world_base @ look_at(center + away * side, center)))
    return tuple(views)


def picture_of(scene: SegmentedMap, view: ObservedView) -> Picture:
    """Return the image of a view, or a rendering of the map from its pose."""
    return view.rgb if view.rgb is not None else _rendered(scene.model, view)


def empty_picture(scene: SegmentedMap, view: ObservedView) -> Picture:
    """Render the map without its objects: a model that still finds an object in it is guessing."""
    return _rendered(scene.model.select(torch.from_numpy(scene.labels < 0)), view)


def _rendered(model: GaussianModel, view: ObservedView) -> Picture:
    picture: NDArray[np.uint8] = colorize(render_view(model, view.camera, view.T_world_camera), "rgb")
    return picture
