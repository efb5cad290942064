"""Rendered views of a grasp in the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.harmonics import rgb_to_sh
from splatbot.geometry import inverse, look_at, transform_points
from splatbot.grasping.types import Grasp
from splatbot.protocols import Array
from splatbot.rasterize.views import to_png
from splatbot.report.annotations import Color, with_arrows, with_legend, with_scale
from splatbot.report.robot_drawing import DrawnPart, draw_robot, map_view
from splatbot.segmentation import SegmentedMap

_MEASURED, _IMPLIED, _TARGET = (0.1, 0.9, 0.2), (1.0, 0.9, 0.1), (0.95, 0.5, 0.1)
_LEGEND: list[tuple[str, Color]] = [
    ("target, as the map has it", _TARGET),
    ("contact at measured depth, and its normal, in front of the hand", _MEASURED),
    ("implied contact, not measured", _IMPLIED),
    ("hand at the grasp; paler at the pre-grasp", (0.6, 0.62, 0.65)),
]


@dataclass(frozen=True)
class GraspViewConstants:
    """Constants of the view of a grasp.

    Args:
        camera_distance: [m] distance from the camera to the target.
        crop_radius: [m] radius of the map around the target that is drawn.
        normal_length: [m] length of the arrows along the normals of the contacts.
    """

    camera_distance: float = 0.5
    crop_radius: float = 0.6
    normal_length: float = 0.03


CONSTANTS = GraspViewConstants()


_SIDES = (np.array([-0.8, 0.35, 0.6]), np.array([-0.25, -0.9, 0.45]))  # camera directions in the base frame


def grasp_png(
    scene: SegmentedMap,
    rows: NDArray[np.int64],
    grasp: Grasp,
    hand: Sequence[DrawnPart],
    T_link_tcp: Array,
    *,
    width: int = 1280,
    height: int = 480,
) -> bytes:
    """Render two views: the tinted target, the hand at grasp and pre-grasp (transparent), and contacts in front.

    Args:
        scene: the map.
        rows: (M,) indices of the target's Gaussians.
        grasp: the grasp to draw.
        hand: appearance of the last link with its hand.
        T_link_tcp: (4, 4) pose of the tool on the last link [m].
        width, height: of both views together [px].
    """
    model = _tinted(scene.model, rows)
    middle = grasp.contacts.mean(axis=0)
    near = np.linalg.norm(model.means.double().numpy() - middle, axis=1) < CONSTANTS.crop_radius
    shown = model.select(torch.from_numpy(np.flatnonzero(near)))
    colors = [_IMPLIED if implied else _MEASURED for implied in grasp.implied or (False, False)]
    tips = grasp.contacts + CONSTANTS.normal_length * grasp.normals
    parts = [replace(part, link=0) for part in hand]
    half = width // 2
    camera = Camera(0.9 * half, 0.9 * half, (half - 1) / 2, (height - 1) / 2, half, height)
    at = transform_points(inverse(scene.T_world_base), middle)
    views = []
    for side in _SIDES:
        T = scene.T_world_base @ look_at(at + CONSTANTS.camera_distance * side / np.linalg.norm(side), at)
        view, depth = map_view(shown, camera, T)
        for T_world_tcp, opacity in ((grasp.T_world_tcp, 1.0), (grasp.T_world_pregrasp, 0.25)):
            draw_robot(view, depth, camera, T, parts, (T_world_tcp @ inverse(T_link_tcp))[None], opacity=opacity)
        ends = (camera.project(transform_points(inverse(T), points)) for points in (grasp.contacts, tips))
        view = with_arrows(view, list(zip(*ends, colors, strict=True)))
        views.append(with_scale(view, camera, CONSTANTS.camera_distance, "at the target"))
    picture = np.ascontiguousarray(np.concatenate(views, axis=1))
    return to_png(with_legend(picture, _LEGEND), "rgb")


def _tinted(model: GaussianModel, rows: NDArray[np.int64]) -> GaussianModel:
    """Return the map with the target's colours blended towards orange."""
    tinted = model.clone()
    index = torch.from_numpy(rows)
    colors = 0.55 * model.colors[index] + 0.45 * torch.tensor(_TARGET, dtype=model.means.dtype)
    tinted.sh[index, 0] = rgb_to_sh(colors)
    return tinted
