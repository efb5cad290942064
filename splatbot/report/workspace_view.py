"""Rendered views of a workspace in its map: support plane, base, box and camera path."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
import torch

from splatbot.camera import Camera
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, look_at, transform_points
from splatbot.protocols import Array
from splatbot.rasterize.views import render_view, to_png
from splatbot.report.annotations import with_legend
from splatbot.report.robot_drawing import BACKGROUND
from splatbot.report.sphere_gaussians import sphere_gaussians
from splatbot.workspace import Workspace

_LEGEND = {
    "support plane, grid of 10 cm": (0.2, 0.75, 0.95),
    "workspace": (0.95, 0.6, 0.1),
    "camera path": (0.95, 0.2, 0.6),
    "base x": (0.9, 0.15, 0.15),
    "base y": (0.2, 0.8, 0.2),
    "base z, up": (0.3, 0.4, 1.0),
}
_SIDES = (np.array([-1.2, 0.9, 0.9]), np.array([0.0, -1.6, 0.12]))  # directions of the two cameras in the base frame


@dataclass(frozen=True)
class WorkspaceViewConstants:
    """Constants of the views of a workspace.

    Args:
        line_step: [m] distance between the dots of a line.
        line_radius: [m] radius of a dot.
        axis_length: [m] length of the axes of the base.
        grid_step: [m] distance between the lines on the plane.
        reach: [m] distance around the middle of the workspace in which the map is drawn.
        camera_distance: distance of the cameras, relative to the extent of the workspace.
    """

    line_step: float = 0.006
    line_radius: float = 0.0035
    axis_length: float = 0.25
    grid_step: float = 0.1
    reach: float = 1.5
    camera_distance: float = 1.5


CONSTANTS = WorkspaceViewConstants()


def workspace_png(
    model: GaussianModel, place: Workspace, path: Array | None = None, *, width: int = 1280, height: int = 520
) -> bytes:
    """Render the map from obliquely above and from the side, with the workspace drawn into it, and a legend.

    Args:
        model: the map.
        place: workspace with a base; its box may be unknown.
        path: (N, 3) positions of the camera [m, world]. If None, no path is drawn.
        width, height: of both views together [px].
    """
    T = place.T_world_base
    assert T is not None
    box = place.box if place.box is not None else np.array([[0.0, -0.5, 0.0], [1.0, 0.5, 0.8]])
    low, high = np.minimum(box[0, :2], 0.0), np.maximum(box[1, :2], 0.0)  # of the box and the base
    middle = transform_points(T, np.array([*(low + high) / 2, 0.15]))
    near = np.linalg.norm(model.means.double().numpy() - middle, axis=1) < CONSTANTS.reach
    parts = [model.select(torch.from_numpy(np.flatnonzero(near)))]
    for name, lines in _lines(box).items():
        dots = np.concatenate([_dots(a, b) for a, b in lines])
        parts.append(_drawn(transform_points(T, dots), name))
    if path is not None and len(path) > 1:
        dots = np.concatenate([_dots(a, b) for a, b in pairwise(path)])
        parts.append(_drawn(dots, "camera path"))
    scene = GaussianModel.concatenate(parts)
    half = width // 2
    camera = Camera(0.95 * half, 0.95 * half, (half - 1) / 2, (height - 1) / 2, half, height)
    at = transform_points(inverse(T), middle)
    distance = CONSTANTS.camera_distance * float(np.linalg.norm(high - low) / 2 + 0.4)
    views = []
    for side in _SIDES:
        eye = at + distance * side / np.linalg.norm(side)
        views.append(render_view(scene, camera, T @ look_at(eye, at), background=BACKGROUND))
    picture = np.ascontiguousarray(np.concatenate(views, axis=1))
    return to_png(with_legend(picture, list(_LEGEND.items())), "rgb")


def _lines(box: Array) -> dict[str, list[tuple[Array, Array]]]:
    """Return the end points of the lines in the base frame, by their name in the legend."""
    low, high = box
    grid = []
    for x in np.arange(low[0], high[0] + 1e-9, CONSTANTS.grid_step):
        grid.append((np.array([x, low[1], 0.0]), np.array([x, high[1], 0.0])))
    for y in np.arange(low[1], high[1] + 1e-9, CONSTANTS.grid_step):
        grid.append((np.array([low[0], y, 0.0]), np.array([high[0], y, 0.0])))
    corners = [np.array(corner) for corner in product(*zip(low, high, strict=True))]
    edges = [(a, b) for a in corners for b in corners if (a != b).sum() == 1 and (b > a).any()]
    axes = CONSTANTS.axis_length * np.eye(3)
    named = {name: [(np.zeros(3), axes[k])] for k, name in enumerate(("base x", "base y", "base z, up"))}
    return {"support plane, grid of 10 cm": grid, "workspace": edges, **named}


def _dots(a: Array, b: Array) -> Array:
    count = max(int(np.ceil(np.linalg.norm(b - a) / CONSTANTS.line_step)), 1)
    return a + np.linspace(0.0, 1.0, count + 1)[:, None] * (b - a)


def _drawn(dots: Array, name: str) -> GaussianModel:
    thick = 2.0 if name.startswith("base") else 1.0
    radii = np.full(len(dots), thick * CONSTANTS.line_radius)
    return sphere_gaussians(dots, radii, np.array(_LEGEND[name]), 0.9)
