"""A picture of the objects of a map, each tinted and labelled with its number."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from splatbot.camera import Camera
from splatbot.gaussians.harmonics import rgb_to_sh
from splatbot.geometry import inverse, look_at, transform_points
from splatbot.grasping.object_list import ListedObject
from splatbot.rasterize.views import render_view, to_png
from splatbot.report.annotations import GREY, fitting, legend_size, with_legend, with_numbers, with_scale
from splatbot.report.robot_drawing import BACKGROUND
from splatbot.segmentation import SegmentedMap


@dataclass(frozen=True)
class ObjectsViewConstants:
    """Constants of the picture.

    Args:
        tint: share of an object's colour that is replaced by its own hue.
        direction: direction from the objects to the camera, in the base frame.
        distance: distance of the camera, relative to the radius of the objects.
        min_radius: [m] least radius that the picture shows.
        min_size: [m] longest side below which a piece is not drawn.
    """

    tint: float = 0.5
    direction: tuple[float, float, float] = (-0.75, 0.35, 0.75)
    distance: float = 2.6
    min_radius: float = 0.2
    min_size: float = 0.04


CONSTANTS = ObjectsViewConstants()
_LEFT_OUT = "{} pieces of structure, on no support or below {:.0f} mm are only in the list"


def objects_png(scene: SegmentedMap, found: Sequence[ListedObject], *, width: int = 1280, height: int = 800) -> bytes:
    """Render the map obliquely from above, each object numbered in its own hue; a legend gives labels and sizes.

    Structure and fragments are left out: pieces below 4 cm, and those on no support if another piece stands on one.

    Args:
        scene: the segmented map.
        found: its objects.
        width, height: of the picture [px].
    """
    listed, found = len(found), drawn_objects(found)
    model = scene.model.clone()
    for item in found:
        index = torch.from_numpy(scene.objects[item.number].rows)
        colors = (1 - CONSTANTS.tint) * model.colors[index] + CONSTANTS.tint * torch.tensor(_hue(item.number))
        model.sh[index, 0] = rgb_to_sh(colors.to(model.means.dtype))
    centers = np.array([item.at_base for item in found]).reshape(-1, 3)
    middle = np.median(centers, axis=0) if len(centers) else np.median(scene.points, axis=0)
    radius = float(np.linalg.norm(centers - middle, axis=1).max()) if len(centers) else 0.0
    radius = max(radius + 0.1, CONSTANTS.min_radius)
    near = np.linalg.norm(scene.points - middle, axis=1) < 3.0 * radius
    side = np.array(CONSTANTS.direction)
    T = scene.T_world_base @ look_at(middle + CONSTANTS.distance * radius * side / np.linalg.norm(side), middle)
    camera = Camera(0.95 * width, 0.95 * width, (width - 1) / 2, (height - 1) / 2, width, height)
    shown = model.select(torch.from_numpy(np.flatnonzero(near)))
    image = render_view(shown, camera, T, background=BACKGROUND)
    hues = {item.number: _hue(item.number) for item in found}
    seen = {item.number: transform_points(inverse(T), item.at_world) for item in found}
    places = {
        n: np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        for n, (x, y, z) in seen.items()
        if z > 0
    }
    left_out = [(_LEFT_OUT.format(listed - len(found), 1e3 * CONSTANTS.min_size), GREY)] if len(found) < listed else []
    rows = fitting([(_described(item), hues[item.number]) for item in found], height, last=left_out)
    image = with_numbers(image, places, hues, free_of=legend_size(rows))
    image = with_legend(image, rows)
    return to_png(with_scale(image, camera, CONSTANTS.distance * radius, "in the middle"), "rgb")


def drawn_objects(found: Sequence[ListedObject]) -> list[ListedObject]:
    """Return the objects that the picture shows: those on a support, or all without a support.

    Structure and pieces below 4 cm are left out.
    """
    objects = [item for item in found if not item.structure]
    standing = [item for item in objects if item.on_support] or objects
    return [item for item in standing if item.size.max() >= CONSTANTS.min_size]


def _described(item: ListedObject) -> str:
    return f"{item.number}: {item.label}, " + " x ".join(f"{1e3 * x:.0f}" for x in item.size) + " mm"


def _hue(number: int) -> tuple[float, float, float]:
    return colorsys.hsv_to_rgb((0.61803 * number) % 1.0, 0.8, 0.95)
