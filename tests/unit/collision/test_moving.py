"""Space of dynamic objects: cells that depth images hit at times and passed later, without edges of static surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, VisibilityEvidence, find_moving, gather_evidence
from splatbot.collision.moving import with_balls
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, look_at, transform_points

CAMERA = Camera(200.0, 200.0, 80.0, 60.0, 161, 121)
RADIUS = 0.05
STILL = np.array([0.05, 0.12, 0.06])  # a ball that stays, [m]
EYES = [np.array([0.5 * np.cos(a), 0.5 * np.sin(a), 0.7]) for a in np.linspace(0.0, 1.5, 8)]


def _depth(eye: np.ndarray, balls: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Render exact depth of a table at z = 0 and balls; return it with T_world_camera."""
    T = look_at(eye, np.zeros(3))
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1) @ T[:3, :3].T
    z = -eye[2] / rays[..., 2]
    for center in balls:
        a, b = (rays**2).sum(axis=-1), rays @ (eye - center)
        root = b**2 - a * (((eye - center) ** 2).sum() - RADIUS**2)
        z = np.where(root > 0, np.minimum(z, (-b - np.sqrt(np.maximum(root, 0.0))) / a), z)
    return z.astype(np.float32), T


def _model(points: np.ndarray) -> GaussianModel:
    n = len(points)
    return GaussianModel.from_activated(
        means=points, quats=np.tile([1.0, 0, 0, 0], (n, 1)), scales=np.full((n, 3), 0.003), opacities=np.full(n, 0.9),
        colors=np.full((n, 3), 0.5),
    )  # fmt: skip


def _mapped(where: list[np.ndarray], flying: float = 0.0) -> tuple[GaussianModel, VisibilityEvidence]:
    """Return Gaussians at every other pixel of each image, and the evidence of all images.

    ``flying``: share of pixels at the still ball's edge that are somewhere behind it.
    """
    rng, views, points = np.random.default_rng(0), [], []
    for eye, center in zip(EYES, where, strict=True):
        depth, T = _depth(eye, [STILL, center])
        own = np.abs(np.linalg.norm(transform_points(inverse(T), STILL[None])[0])) - depth > -0.02
        edge = own & ~np.roll(own, 1, axis=1)
        depth = np.where(edge & (rng.random(depth.shape) < flying), depth + 0.03, depth).astype(np.float32)
        views.append((depth, CAMERA, T))
        at = CAMERA.backproject(depth)[::2, ::2].reshape(-1, 3).astype(np.float64)
        points.append(transform_points(T, at))
    model = _model(np.concatenate(points))
    return model, gather_evidence(model, views)


def test_where_a_ball_went_is_covered_and_no_ball_is_elsewhere_though_pixels_fly_at_edges() -> None:
    where = [np.array([-0.20 + 0.05 * k, -0.10, 0.10]) for k in range(len(EYES))]
    model, evidence = _mapped(where, flying=0.5)
    balls = find_moving(model, evidence)
    tops = [center + np.array([0.0, 0.0, RADIUS]) for center in where]
    inside = [(np.linalg.norm(balls[:, :3] - top, axis=1) < balls[:, 3]).any() for top in tops]
    assert all(inside)
    line = np.clip(balls[:, 0], where[0][0], where[-1][0])
    away = np.linalg.norm(
        balls[:, :3] - np.stack([line, *np.broadcast_to([[-0.10], [0.10]], (2, len(line)))], 1), axis=1
    )
    assert away.max() < RADIUS + 0.03


def test_where_nothing_moved_there_is_nothing_though_pixels_fly_at_edges() -> None:
    still = [np.array([-0.1, -0.1, 0.1])] * len(EYES)
    for flying in (0.0, 0.5):
        assert find_moving(*_mapped(still, flying)).shape == (0, 4)


def test_what_left_and_was_never_looked_at_again_is_not_said_to_move() -> None:
    model, evidence = _mapped([np.array([-0.20 + 0.05 * k, -0.10, 0.10]) for k in range(len(EYES))])
    blind = VisibilityEvidence(evidence.hits, np.zeros_like(evidence.passes))
    assert not len(find_moving(model, blind))


def test_evidence_of_another_map_and_negative_room_are_refused() -> None:
    model = _model(np.zeros((3, 3)))
    none = VisibilityEvidence(np.zeros(2, np.int32), np.zeros(2, np.int32))
    with pytest.raises(InputError, match="evidence"):
        find_moving(model, none)
    with pytest.raises(InputError, match="around"):
        find_moving(_model(np.zeros((2, 3))), none, around=-0.01)


@pytest.mark.parametrize("n_sigma", [1.0, 2.0])
def test_balls_are_obstacles_of_their_radius_whatever_the_field_takes_for_a_surface(n_sigma: float) -> None:
    balls = np.array([[0.0, 0.0, 1.0, 0.04], [0.5, 0.0, 1.0, 0.02]])
    model = with_balls(_model(np.zeros((4, 3))), balls, n_sigma=n_sigma, observations=3)
    field = GaussianCollisionField(model, n_sigma, min_observations=3)
    away = field.clearance(torch.tensor([[0.0, 0.0, 1.1], [0.5, 0.1, 1.0]])).distance
    np.testing.assert_allclose(away, [0.06, 0.08], atol=1e-4)
    assert len(field) == 2  # those of one keyframe are air
