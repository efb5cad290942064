"""Weak directions of a frame are detected, reported, and taken from the prediction."""

from __future__ import annotations

import numpy as np

from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.tracking.align import Alignment
from splatbot.tracking.degeneracy import weak_directions
from splatbot.tracking.health import Health
from splatbot.tracking.hypothesis import Hypothesis, ScoredHypothesis
from splatbot.tracking.motion_model import Prediction
from splatbot.tracking.priors import fill_weak_directions
from splatbot.tracking.uncertainty import alignment_covariance
from tests.rgbd import Array

RATIO = 0.02


def planes(*normals: tuple[float, float, float], distance: float = 2.0) -> Array:
    """Compute the information (6, 6) of point-to-plane residuals on planes around the camera."""
    H = np.zeros((6, 6))
    for normal in normals:
        n = np.asarray(normal) / np.linalg.norm(normal)
        across = np.linalg.svd(n[None])[2][1:]
        for a in np.linspace(-1, 1, 9):
            for b in np.linspace(-1, 1, 9):
                p = distance * n + a * across[0] + b * across[1]
                row = np.concatenate([n, np.cross(p, n)]) / 1e-3
                H += np.outer(row, row)
    return H


def scored(information: Array, T_world_camera: Array) -> ScoredHypothesis:
    alignment = Alignment(T_world_camera, information, information, information, 48, 525.0)
    weak = weak_directions(information, 2.0, RATIO)
    health = Health(1.0, 1.0, 1.0, 1.0, 0.5, 1.0)
    hypothesis = Hypothesis("direct", alignment, [])
    return ScoredHypothesis(hypothesis, health, "degraded", (), weak, alignment_covariance(alignment))


def test_a_corridor_is_weak_along_its_axis_and_the_reason_names_it() -> None:
    weak = weak_directions(planes((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)), 2.0, RATIO)
    assert weak is not None
    np.testing.assert_allclose(np.abs(weak.direction), [0, 0, 1], atol=1e-9)
    assert "along (+0.00, +0.00," in weak.reason
    np.testing.assert_allclose(weak.strong, np.diag([1, 1, 0, 1, 1, 1]), atol=1e-9)


def test_one_wall_is_weak_in_both_of_its_directions_and_in_rotation_about_its_normal() -> None:
    weak = weak_directions(planes((0, 0, 1)), 2.0, RATIO)
    assert weak is not None
    np.testing.assert_allclose(weak.strong, np.diag([0, 0, 1, 1, 1, 0]), atol=1e-9)


def test_a_corner_of_three_walls_is_not_weak() -> None:
    assert weak_directions(planes((1, 0, 0), (0, 1, 0), (0, 0, 1)), 2.0, RATIO) is None


def test_in_weak_directions_the_pose_and_its_covariance_are_those_of_the_prediction() -> None:
    pose = scored(planes((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)), se3_exp([0.01, 0.02, 0.5, 0.01, 0, 0.02]))
    spread = np.diag([1e-4, 1e-4, 4e-4, 1e-4, 1e-4, 1e-4])
    predicted = pose.T_world_camera @ se3_exp([0.03, -0.02, 0.1, 0.0, 0.0, 0.0])
    filled = fill_weak_directions(pose, Prediction(predicted, spread))
    moved = se3_log(inverse(pose.T_world_camera) @ filled.T_world_camera)
    np.testing.assert_allclose(moved, [0, 0, 0.1, 0, 0, 0], atol=1e-9)
    assert np.isclose(filled.covariance[2, 2], 4e-4)
    assert filled.covariance[0, 0] < 1e-6


def test_a_pose_without_weak_directions_is_unchanged() -> None:
    pose = scored(planes((1, 0, 0), (0, 1, 0), (0, 0, 1)), np.eye(4))
    assert fill_weak_directions(pose, Prediction(se3_exp([0.1] * 6), np.eye(6))) is pose
