"""A picture of the objects that differ between two maps: both from one pose, with a box around each object."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.collision.changes import ChangedObject
from splatbot.collision.visibility import DepthView
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array
from splatbot.rasterize.views import render_view, to_png
from splatbot.report.annotations import with_legend, with_numbers
from splatbot.report.robot_drawing import BACKGROUND

COLORS = {"appeared": (0.25, 0.85, 0.45), "removed": (0.95, 0.30, 0.35), "moved": (0.30, 0.60, 1.00)}
_NEAR = 0.05  # [m] boxes that reach closer to the camera are not drawn
_SIDES = [(a, b) for a, b in combinations(range(8), 2) if bin(a ^ b).count("1") == 1]

Boxes = dict[int, ChangedObject]


def changes_png(
    before: GaussianModel,
    after: GaussianModel,
    T_a_b: Array,
    changes: Sequence[ChangedObject],
    views: Sequence[DepthView],
    *,
    width: int = 800,
) -> bytes:
    """Render map A on the left and map B on the right, from the view that shows most of the changed objects.

    Args:
        before, after: maps A and B, each in its own world.
        T_a_b: (4, 4) pose of the world of B in that of A.
        changes: the objects, numbered from 1 in their order, in the world of A.
        views: cameras and poses in the world of A to choose from.
        width: of each of the two images [px].
    """
    _, camera, T = max(views, key=lambda view: _shown(changes, view))
    camera = camera.resized(width, round(width * camera.height / camera.width))
    numbered = dict(enumerate(changes, 1))
    old = {n: change.previous or change for n, change in numbered.items() if change.kind != "appeared"}
    new = {n: change for n, change in numbered.items() if change.kind != "removed"}
    left = _panel(render_view(before, camera, T, background=BACKGROUND), old, numbered, camera, T)
    right = _panel(render_view(after, camera, inverse(T_a_b) @ T, background=BACKGROUND), new, numbered, camera, T)
    kinds = [kind for kind in COLORS if any(change.kind == kind for change in changes)]
    legend = [("A", (0.9, 0.9, 0.9)), *((kind, COLORS[kind]) for kind in kinds)]
    both = np.concatenate([with_legend(left, legend), with_legend(right, [("B", (0.9, 0.9, 0.9))])], axis=1)
    return to_png(both, "rgb")


def _shown(changes: Sequence[ChangedObject], view: DepthView) -> tuple[int, float]:
    """Return how many centres of objects a view has in its image, and how near they are."""
    _, camera, T = view
    p = transform_points(inverse(T), np.array([change.center for change in changes]).reshape(-1, 3))
    ahead = p[p[:, 2] > _NEAR]
    pixels = camera.project(ahead)
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    return int(inside.sum()), -float(ahead[inside, 2].sum())


def _panel(
    image: NDArray[np.float32], boxes: Boxes, numbered: Boxes, camera: Camera, T_world_camera: Array
) -> NDArray[np.float32]:
    """Return an image (H, W, 3) in 0..1 with the boxes and numbers of objects in the colours of their kinds."""
    marked, places = image.copy(), {}
    for number, change in boxes.items():
        signs = np.array(list(product((-0.5, 0.5), repeat=3)))
        corners = change.center + (signs * change.size) @ change.axes.T
        p = transform_points(inverse(T_world_camera), corners)
        if p[:, 2].min() < _NEAR:
            continue
        pixels = camera.project(p)
        color = COLORS[numbered[number].kind]
        for a, b in _SIDES:
            ends = [(round(float(u)), round(float(v))) for u, v in pixels[[a, b]]]
            cv2.line(marked, ends[0], ends[1], color, 2, cv2.LINE_AA)
        places[number] = pixels.mean(axis=0)
    return with_numbers(marked, places, {number: COLORS[numbered[number].kind] for number in boxes})
