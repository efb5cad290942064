"""Rendered views of a grasp in the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.harmonics import rgb_to_sh
from splatbot.geometry import inverse, look_at, transform_points
from splatbot.grasping.types import Grasp
from splatbot.protocols import Array, HasHand, RobotKinematics
from splatbot.rasterize.views import render_view, to_png
from splatbot.report.sphere_gaussians import sphere_gaussians
from splatbot.segmentation import SegmentedMap

_HAND, _PREGRASP = np.array([0.15, 0.45, 0.9]), np.array([0.6, 0.75, 0.95])
_CONTACT, _TARGET = np.array([0.1, 0.9, 0.2]), np.array([0.95, 0.5, 0.1])


@dataclass(frozen=True)
class GraspViewConstants:
    """Constants of the view of a grasp.

    Args:
        camera_distance: [m] distance from the camera to the target.
        crop_radius: [m] radius of the map around the target that is drawn.
    """

    camera_distance: float = 0.5
    crop_radius: float = 0.6


CONSTANTS = GraspViewConstants()


_SIDES = (np.array([-0.8, 0.35, 0.6]), np.array([-0.25, -0.9, 0.45]))  # camera directions in the base frame


def grasp_png(
    scene: SegmentedMap,
    rows: NDArray[np.int64],
    robot: RobotKinematics,
    grasp: Grasp,
    *,
    width: int = 1280,
    height: int = 480,
) -> bytes:
    """Render two views of the tinted target with the hand at the grasp and the pre-grasp, and contacts in green.

    Args:
        scene: the map.
        rows: (M,) indices of the target's Gaussians.
        robot: kinematics with a hand.
        grasp: the grasp to draw.
        width, height: of both views together [px].
    """
    model = _tinted(scene.model, rows)
    middle = grasp.contacts.mean(axis=0)
    near = np.linalg.norm(model.means.double().numpy() - middle, axis=1) < CONSTANTS.crop_radius
    parts = [model.select(torch.from_numpy(np.flatnonzero(near)))]
    parts.append(_hand(robot, grasp.T_world_pregrasp, grasp.opening, _PREGRASP, 0.2))
    parts.append(_hand(robot, grasp.T_world_tcp, grasp.opening, _HAND, 0.6))
    parts.append(sphere_gaussians(grasp.contacts, np.full(2, 0.006), _CONTACT, 0.95))
    steps = np.linspace(0.004, 0.03, 8)[:, None]
    for contact, normal in zip(grasp.contacts, grasp.normals, strict=True):
        parts.append(sphere_gaussians(contact + steps * normal, np.full(8, 0.0025), _CONTACT, 0.95))
    drawn = GaussianModel.concatenate(parts)
    half = width // 2
    camera = Camera(0.9 * half, 0.9 * half, (half - 1) / 2, (height - 1) / 2, half, height)
    at = transform_points(inverse(scene.T_world_base), middle)
    views = []
    for side in _SIDES:
        T = scene.T_world_base @ look_at(at + CONSTANTS.camera_distance * side / np.linalg.norm(side), at)
        views.append(render_view(drawn, camera, T, background=(0.09, 0.1, 0.12)))
    return to_png(np.ascontiguousarray(np.concatenate(views, axis=1)), "rgb")


def _hand(robot: RobotKinematics, T_world_tcp: Array, opening: float, color: Array, opacity: float) -> GaussianModel:
    assert isinstance(robot, HasHand)
    spheres = robot.spheres(opening)
    own = spheres.link == len(robot.chain)
    T = T_world_tcp @ inverse(robot.T_link_tcp)
    return sphere_gaussians(transform_points(T, spheres.centers[own]), spheres.radii[own], color, opacity)


def _tinted(model: GaussianModel, rows: NDArray[np.int64]) -> GaussianModel:
    """Return the map with the target's colours blended towards orange."""
    tinted = model.clone()
    index = torch.from_numpy(rows)
    colors = 0.55 * model.colors[index] + 0.45 * torch.from_numpy(_TARGET).to(model.means.dtype)
    tinted.sh[index, 0] = rgb_to_sh(colors)
    return tinted
