"""Meshes of a map against the sphere that its discs lie on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import look_at
from splatbot.rasterize.meshes import METHODS, MeshMethod, map_mesh

CAMERA = Camera(220.0, 220.0, 95.5, 95.5, 192, 192)
RADIUS = 0.5


def ball(count: int = 5000, thickness: float = 0.0) -> GaussianModel:
    """Return discs that are spread over a sphere."""
    number = np.arange(count) + 0.5
    height, angle = 1 - 2 * number / count, np.pi * (1 + np.sqrt(5)) * number
    radius = np.sqrt(1 - height**2)
    normals = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    quats = np.column_stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(count)])  # z to the normal
    size = RADIUS * np.sqrt(4 * np.pi / count)
    return GaussianModel.from_activated(
        means=RADIUS * normals,
        quats=quats,
        scales=np.tile([0.8 * size, 0.8 * size, thickness], (count, 1)),
        opacities=np.full(count, 0.99),
        colors=np.full((count, 3), 0.5),
    )


def views(count: int = 10) -> list[tuple[Camera, Any]]:
    """Return views from a sphere around the ball."""
    rng = np.random.default_rng(0)
    eyes = rng.normal(size=(count, 3))
    return [(CAMERA, look_at(1.4 * eye / np.linalg.norm(eye), np.zeros(3))) for eye in eyes]


@pytest.mark.parametrize(
    "method", ["median", pytest.param("depth", marks=pytest.mark.long), pytest.param("poisson", marks=pytest.mark.long)]
)
def test_the_mesh_of_discs_on_a_sphere_is_the_sphere(method: MeshMethod) -> None:
    mesh = map_mesh(ball(), views(), 0.01, method)
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    away = np.abs(np.linalg.norm(vertices, axis=1) - RADIUS)
    assert len(vertices) > 1000
    assert np.median(away) < 0.003
    assert np.quantile(away, 0.98) < 0.01
    outwards = (normals * vertices).sum(axis=1) / np.linalg.norm(vertices, axis=1)
    assert np.median(outwards) > 0.95


def test_gaussians_have_a_mesh_of_their_expected_depth() -> None:
    away = np.linalg.norm(np.asarray(map_mesh(ball(thickness=1e-3), views(6), 0.02).vertices), axis=1) - RADIUS
    assert np.median(np.abs(away)) < 0.01


def test_median_depth_of_gaussians_and_views_of_nothing_are_refused() -> None:
    with pytest.raises(InputError, match="surfels"):
        map_mesh(ball(50, thickness=0.01), views(), 0.02, "median")
    away = [(camera, T @ np.diag([1.0, -1.0, -1.0, 1.0])) for camera, T in views(2)]
    for method in METHODS:
        with pytest.raises(InputError, match="no surface"):
            map_mesh(ball(50), away, 0.02, method)
    with pytest.raises(InputError, match="method"):
        map_mesh(ball(50), views(), 0.02, "other")  # type: ignore[arg-type]
