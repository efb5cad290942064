"""Views of a map: those of its recording, or virtual ones around it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.gaussians import GaussianModel
from splatbot.rasterize.views import default_view
from splatbot.spacing import evenly_spaced
from splatbot.training.datasets import TrainingData, TrainingView
from splatbot.training.images import ImageCache
from splatbot.training.options import TrainingOptions
from splatbot.training.scoring import score_held_out, summary

_VISIBLE_SHARE = 0.9  # of the Gaussians; the rest are mostly floaters
_LEAST_RADIUS = 0.05  # [m]
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))  # [rad]


@dataclass(frozen=True, eq=False)
class MapViews:
    """The recorded views of a map.

    Args:
        data: all views.
        mapped: views that the map was made from.
        held_out: the others.
        options: of the training; they name the background and how renders are scored.
        recording: source of the views: the URI of a log, or the folder of photographs.
    """

    data: TrainingData
    mapped: tuple[TrainingView, ...]
    held_out: tuple[TrainingView, ...]
    options: TrainingOptions
    recording: str

    def score(self, model: GaussianModel, most: int) -> dict[str, Any]:
        """Score a map on at most ``most`` held-out views, see :func:`splatbot.training.scoring.summary`."""
        images = ImageCache(evenly_spaced(self.held_out, most))
        return summary(score_held_out(model, images, self.options, self.data.scene_extent))


def around(
    model: GaussianModel, count: int, *, width: int = 640, height: int = 480
) -> list[tuple[Camera, NDArray[np.float64]]]:
    """Return virtual views from ``count`` directions, spread over a sphere, that see most of a map from outside.

    Args:
        model: the map.
        count: number of views.
        width, height: of the images [px].

    Returns:
        Camera and T_world_camera (4, 4) of each view.
    """
    camera, _ = default_view(model, width=width, height=height)
    means = model.means.double().numpy()
    centre = np.average(means, axis=0, weights=model.opacities.double().numpy())
    radius = np.quantile(np.linalg.norm(means - centre, axis=1), _VISIBLE_SHARE)
    distance = max(float(radius), _LEAST_RADIUS) * np.hypot(1.0, 2.0 * camera.fy / height)  # the ball fills the height
    heights = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    angles = _GOLDEN_ANGLE * np.arange(count)
    radii = np.sqrt(1.0 - heights**2)
    views = []
    for z in np.stack([radii * np.sin(angles), heights, radii * np.cos(angles)], axis=1):
        x = np.cross((0.0, 1.0, 0.0), z)  # level, as y points down in maps
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
        T[:3, 3] = centre - distance * z
        views.append((camera, T))
    return views
