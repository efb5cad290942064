"""A picture of the objects of a map, each tinted and labelled with its number."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.gaussians.harmonics import rgb_to_sh
from splatbot.geometry import inverse, look_at, transform_points
from splatbot.grasping.object_list import ListedObject
from splatbot.protocols import Array
from splatbot.rasterize.views import render_view, to_png
from splatbot.segmentation import SegmentedMap


@dataclass(frozen=True)
class ObjectsViewConstants:
    """Constants of the picture.

    Args:
        tint: share of an object's colour that is replaced by its own hue.
        direction: direction from the objects to the camera, in the base frame.
        distance: distance of the camera, relative to the radius of the objects.
        min_radius: [m] least radius that the picture shows.
    """

    tint: float = 0.5
    direction: tuple[float, float, float] = (-0.75, 0.35, 0.75)
    distance: float = 2.6
    min_radius: float = 0.2


CONSTANTS = ObjectsViewConstants()


def objects_png(scene: SegmentedMap, found: Sequence[ListedObject], *, width: int = 1280, height: int = 800) -> bytes:
    """Render the map obliquely from above with each object in its own hue, with its number and label."""
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
    image = render_view(shown, camera, T, background=(0.09, 0.1, 0.12))
    return to_png(_labelled(image, camera, T, found), "rgb")


def _hue(number: int) -> tuple[float, float, float]:
    return colorsys.hsv_to_rgb((0.61803 * number) % 1.0, 0.8, 0.95)


def _labelled(
    image: NDArray[np.float32], camera: Camera, T_world_camera: Array, found: Sequence[ListedObject]
) -> NDArray[np.float32]:
    """Return the image (H, W, 3) in 0..1 with labels that do not overlap."""
    marked = (255 * np.clip(image, 0, 1)).round().astype(np.uint8)
    taken: list[tuple[int, int, int, int]] = []
    for item in found:
        x, y, z = transform_points(inverse(T_world_camera), item.at_world)
        if z <= 0:
            continue
        u, v = round(camera.fx * x / z + camera.cx), round(camera.fy * y / z + camera.cy)
        text = f"{item.number}: {item.label}"
        (wide, tall), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
        left = int(np.clip(u - wide // 2, 4, camera.width - wide - 4))
        top = int(np.clip(v - 60, 8 + tall, camera.height - 8))
        while any(left < r and left + wide > a and top - tall < d and top > b for a, b, r, d in taken):
            top += tall + 10
        taken.append((left - 6, top - tall - 6, left + wide + 6, top + 6))
        cv2.line(marked, (u, v), (left + wide // 2, top + 4), (235, 235, 235), 1, cv2.LINE_AA)
        cv2.rectangle(marked, (left - 5, top - tall - 5), (left + wide + 5, top + 6), (25, 28, 32), -1)
        color = [round(255 * c) for c in _hue(item.number)]
        cv2.putText(marked, text, (left, top), cv2.FONT_HERSHEY_SIMPLEX, 0.55, color, 1, cv2.LINE_AA)
    return marked.astype(np.float32) / 255.0
