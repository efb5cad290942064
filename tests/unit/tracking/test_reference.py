"""Sampled pixels of keyframes: on smooth surfaces, at image gradients, and about as many as configured."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.tracking.prepare import Level, prepare
from splatbot.tracking.reference import make_reference, sample_level
from tests.rgbd import CAMERA, small_config, tabletop, wall_depth, wall_frame

SLANTED = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])


def test_points_lie_on_the_surface_with_its_normal_and_the_grey_of_their_pixel() -> None:
    levels = prepare(wall_frame(np.eye(4), normal=SLANTED), small_config().tracking).levels
    reference = make_reference(levels, np.eye(4), 800)
    assert len(reference.levels) == len(levels)
    for level, sampled in zip(levels, reference.levels, strict=True):
        assert len(sampled.points) == len(sampled.normals) == len(sampled.gray) > 50
        np.testing.assert_allclose(sampled.points @ SLANTED, 1.0, atol=2e-3)  # halved depth is a mean
        np.testing.assert_allclose(sampled.normals, np.broadcast_to(-SLANTED, sampled.normals.shape), atol=5e-3)
        u, v = np.rint(level.camera.project(sampled.points)).astype(int).T
        assert np.array_equal(sampled.gray, level.gray[v, u])


@pytest.mark.parametrize("n_pixels", [100, 400, 1200, 4800])
def test_about_as_many_pixels_are_sampled_as_configured(n_pixels: int) -> None:
    level = prepare(wall_frame(np.eye(4)), small_config().tracking).levels[0]
    assert 0.6 * n_pixels <= len(sample_level(level, n_pixels).points) <= 1.2 * n_pixels


def test_no_point_lies_next_to_an_occlusion_boundary() -> None:
    frames, _ = tabletop()
    level = prepare(frames[0], small_config().tracking).levels[0]
    depth = np.full(level.depth.shape, 1.0, np.float32)
    depth[:, 80:] = 1.5
    sampled = sample_level(Level(level.gray, depth, level.camera), 6000)
    u = level.camera.project(sampled.points)[:, 0]
    assert len(u) > 2000
    assert np.abs(u - 79.5).min() > 1.0


def test_the_strongest_edge_of_a_tile_is_taken() -> None:
    gray = np.full((120, 160), 0.5, np.float32)
    gray[53, 37] = 1.0
    depth = wall_depth(CAMERA, np.eye(4), (0, 0, 1), 1.0).astype(np.float32)
    sampled = sample_level(Level(gray, depth, CAMERA), 100)
    pixels = CAMERA.project(sampled.points)
    assert np.abs(pixels - [37, 53]).max(axis=1).min() < 1.5  # next to the bright pixel, at its gradient


def test_a_level_without_depth_gives_no_points() -> None:
    level = prepare(wall_frame(np.eye(4)), small_config().tracking).levels[0]
    sampled = sample_level(Level(level.gray, np.zeros_like(level.depth), level.camera), 400)
    assert sampled.points.shape == sampled.normals.shape == (0, 3)
    assert sampled.gray.shape == (0,)
