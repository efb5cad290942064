"""Preparing a frame: depth that misleads is dropped, everything else stays, sizes and cameras belong together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.frame import Frame
from splatbot.geometry import so3_exp
from splatbot.tracking.prepare import (
    Level,
    gray_of_one_surface,
    halve,
    halve_depth,
    normals_of,
    prepare,
    valid_depth,
    valid_share,
    with_depth,
)
from tests.rgbd import CAMERA, rays_of, small_config, tabletop, wall_depth, wall_frame

NEAR, FAR = 0.2, 6.0


def two_walls(step_at: int = 80) -> NDArray[np.float32]:
    """Create the depth of a wall at 1 m on the left and one at 1.5 m on the right."""
    depth = np.full((120, 160), 1.0, np.float32)
    depth[:, step_at:] = 1.5
    return depth


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
def test_pixels_that_fly_between_two_surfaces_are_dropped_and_no_others(turned: bool, mirrored: bool) -> None:
    depth = two_walls()
    depth[:, 80] = 1.25
    flying = np.zeros(depth.shape, bool)
    flying[:, 80] = True
    if mirrored:
        depth, flying = depth[:, ::-1], flying[:, ::-1]
    if turned:
        depth, flying = depth.T, flying.T
    cleaned = valid_depth(np.ascontiguousarray(depth), NEAR, FAR)
    assert np.array_equal(cleaned == 0, flying)
    assert np.array_equal(cleaned[~flying], depth[~flying])


def test_a_sharp_step_loses_no_pixel() -> None:
    assert np.array_equal(valid_depth(two_walls(), NEAR, FAR), two_walls())


def test_one_missing_row_does_not_invalidate_its_neighbours() -> None:
    depth = wall_depth(CAMERA, np.eye(4), (0.0, -0.5, 0.9), 1.0).astype(np.float32)
    depth[60] = 0
    depth[:, 41] = 0
    assert np.array_equal(valid_depth(depth, NEAR, FAR), depth)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("near_first", [False, True])
def test_a_pixel_between_a_step_and_a_missing_neighbour_stays(near_first: bool, mirrored: bool) -> None:
    row = np.array([1.0, 1.0, 0.0, 1.0, 1.5, 1.5] if near_first else [1.5, 1.5, 0.0, 1.5, 1.0, 1.0], np.float32)
    depth = np.tile(row[::-1] if mirrored else row, (5, 1))
    assert np.array_equal(valid_depth(depth, NEAR, FAR), depth)


def test_depth_out_of_range_is_missing_and_the_bounds_belong_to_the_range() -> None:
    depth = np.full((4, 5), 1.0, np.float32)
    depth[0] = [0.2, 0.199, 6.0, 6.001, 0.0]
    expected = depth.copy()
    expected[0] = [0.2, 0, 6.0, 0, 0]
    assert np.array_equal(valid_depth(depth, 0.2, 6.0)[0] > 0, expected[0] > 0)


def test_half_depth_is_the_mean_of_the_nearest_surface_and_never_of_two() -> None:
    rng = np.random.default_rng(3)
    depth = rng.choice([0.0, 1.0, 1.3, 2.5], (61, 83)) * rng.uniform(1.0, 1.01, (61, 83))
    half = halve_depth(depth.astype(np.float32))
    assert half.shape == (30, 41)
    for v, u in np.ndindex(half.shape):
        block = depth[2 * v : 2 * v + 2, 2 * u : 2 * u + 2].astype(np.float32)
        block = block[block > 0]
        expected = block[block <= 1.05 * block.min()].astype(np.float64).mean() if len(block) else 0.0
        assert half[v, u] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("size", [(160, 120), (161, 121), (7, 5)])
def test_the_halved_camera_sees_the_middle_of_each_block(size: tuple[int, int]) -> None:
    camera = Camera(130.0, 125.0, 0.47 * size[0], 0.55 * size[1], *size)
    ones = np.ones(size[::-1], np.float32)
    half = halve(Level(ones, ones, camera))
    height, width = half.gray.shape
    assert (half.camera.width, half.camera.height) == (width, height) == (size[0] // 2, size[1] // 2)
    blocks = rays_of(camera)[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3)
    np.testing.assert_allclose(half.camera.backproject(half.depth), blocks.mean((1, 3)), atol=1e-6)


@pytest.mark.parametrize("slant", [(0.0, 0.0, 1.0), (0.5, 0.2, 0.8), (-0.6, 0.3, 0.7)])
def test_normals_of_a_plane_are_its_normal_towards_the_camera(slant: tuple[float, float, float]) -> None:
    normal = np.array(slant) / np.linalg.norm(slant)
    depth = wall_depth(CAMERA, np.eye(4), normal, 1.0)
    normals = normals_of(depth.astype(np.float32), CAMERA)
    np.testing.assert_allclose(normals[1:-1, 1:-1], np.broadcast_to(-normal, (118, 158, 3)), atol=2e-4)
    border = np.ones(depth.shape, bool)
    border[1:-1, 1:-1] = False
    assert (normals[border] == 0).all()


def test_normals_of_a_sphere_point_from_its_centre() -> None:
    centre, radius = np.array([0.05, -0.03, 1.2]), 0.4
    rays = rays_of(CAMERA)
    a, b = (rays**2).sum(-1), rays @ centre
    root = b**2 - a * (centre @ centre - radius**2)
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0.0)
    normals = normals_of(depth.astype(np.float32), CAMERA).astype(np.float64)
    true = (rays * depth[..., None] - centre) / radius
    facing = (true * -rays).sum(-1) / np.sqrt(a) > 0.5  # within 60° of the line of sight
    known = ((normals**2).sum(-1) > 0.25) & facing & (depth > 0)
    assert known.sum() > 0.9 * (facing & (depth > 0)).sum() > 1000
    cosines = (normals * true).sum(-1)[known]
    assert np.degrees(np.arccos(cosines.min())) < 1.5


def test_there_is_no_normal_where_a_neighbour_is_missing_or_on_another_surface() -> None:
    depth = two_walls()
    depth[30, 30] = 0
    normals = normals_of(depth, CAMERA)
    for v, u in [(30, 30), (29, 30), (31, 30), (30, 29), (30, 31), (60, 79), (60, 80)]:
        assert not normals[v, u].any(), (v, u)
    for v, u in [(29, 29), (60, 78), (60, 81)]:
        np.testing.assert_allclose(normals[v, u], [0, 0, -1], atol=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (2, 9), (9, 2), (3, 3)])
def test_a_normal_needs_a_pixel_with_four_measured_neighbours(shape: tuple[int, int]) -> None:
    camera = replace(CAMERA, width=shape[1], height=shape[0])
    normals = normals_of(np.ones(shape, np.float32), camera)
    assert normals.shape == (*shape, 3)
    assert (normals != 0).any(-1).sum() == max(0, shape[0] - 2) * max(0, shape[1] - 2)
    assert not normals_of(np.full(shape, np.nan, np.float32), camera).any()


def test_the_pyramid_halves_and_starts_with_at_most_the_configured_width() -> None:
    frames, _ = tabletop()
    config = small_config(tracking__max_width=100, tracking__n_levels=3).tracking
    levels = prepare(frames[0], config).levels
    assert [level.gray.shape for level in levels] == [(60, 80), (30, 40), (15, 20)]
    for level in levels:
        assert level.gray.shape == level.depth.shape == (level.camera.height, level.camera.width)
        assert level.gray.dtype == level.depth.dtype == np.float32
        assert 0.0 <= np.nanmin(level.gray) < np.nanmax(level.gray) <= 1.0
        assert level.camera.cx == pytest.approx((level.camera.width - 1) / 2)


def test_grey_is_left_out_on_both_sides_of_an_occluding_edge_and_nowhere_else() -> None:
    gray = np.full((120, 160), 0.5, np.float32)
    left_out = np.isnan(gray_of_one_surface(Level(gray, two_walls(), CAMERA), small_config().tracking))
    expected = np.zeros(left_out.shape, bool)
    expected[:, 79:81] = True
    assert np.array_equal(left_out, expected)


def test_grey_stays_on_slanted_surfaces_on_noisy_ones_and_next_to_holes(rng: np.random.Generator) -> None:
    R = np.eye(4)
    R[:3, :3] = so3_exp([0, 0.4, 0])
    depth = wall_depth(CAMERA, R, (0.0, 0.0, 1.0), 1.5)
    depth += np.where(depth > 0, (1e-3 + 2e-3 * depth**2) * rng.standard_normal(depth.shape).clip(-2, 2), 0)
    depth[40:60, 50:70] = 0
    gray = np.full(depth.shape, 0.5, np.float32)
    kept = gray_of_one_surface(Level(gray, depth.astype(np.float32), CAMERA), small_config().tracking)
    assert np.isnan(kept).mean() < 1e-3
    assert np.isfinite(kept[38:62, 48:72]).all()  # around the hole


def test_grey_stays_on_walls_seen_at_a_graze_in_a_small_image() -> None:
    """Both sides of a corridor: depth grows by up to a twentieth from one pixel to the next."""
    u = np.abs(np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    depth = np.tile((1.0 / np.maximum(u, 0.15)).astype(np.float32), (CAMERA.height, 1))
    assert np.abs(np.diff(np.log(depth[0]))).max() > 0.04
    gray = np.full(depth.shape, 0.5, np.float32)
    left_out = np.isnan(gray_of_one_surface(Level(gray, depth, CAMERA), small_config().tracking))
    assert not left_out.any()


def test_coarse_levels_keep_their_grey_at_edges_and_a_mask_stays_left_out() -> None:
    frame = wall_frame(np.eye(4))
    mask = np.ones(frame.depth.shape, bool)
    mask[20:40, 20:40] = False
    depth = frame.depth.copy()
    depth[:, 80:] *= 1.5
    levels = prepare(replace(frame, depth=depth, mask=mask), small_config().tracking).levels
    assert np.isnan(levels[0].gray[:, 79:81]).all()
    assert np.isnan(levels[0].gray[20:40, 20:40]).all()
    assert np.isfinite(levels[1].gray[:, 35:]).all()
    assert np.isnan(levels[1].gray[10:20, 10:20]).all()


@pytest.mark.parametrize(("size", "levels"), [((160, 120), 4), ((64, 48), 3), ((30, 16), 1), ((1, 1), 1)])
def test_the_pyramid_ends_before_its_levels_are_too_small_to_align(size: tuple[int, int], levels: int) -> None:
    width, height = size
    camera = Camera(50.0, 50.0, width / 2, height / 2, width, height)
    frame = wall_frame(np.eye(4), camera=camera)
    prepared = prepare(frame, small_config(tracking__n_levels=6).tracking)
    assert len(prepared.levels) == levels
    assert prepared.levels[0].gray.shape == (height, width)


def test_a_frame_of_nan_depth_is_prepared_as_one_without_depth() -> None:
    frame = wall_frame(np.eye(4))
    lost = Frame(0.0, frame.rgb, np.full_like(frame.depth, np.nan), CAMERA)
    prepared = prepare(lost, small_config().tracking)
    assert valid_share(prepared) == 0.0
    assert all((level.depth == 0).all() for level in prepared.levels)
    assert valid_share(prepare(frame, small_config().tracking)) == 1.0


def test_another_depth_reaches_every_level_and_leaves_grey_and_cameras_alone() -> None:
    levels = prepare(wall_frame(np.eye(4)), small_config().tracking).levels
    R = np.eye(4)
    R[:3, :3] = so3_exp([0.2, 0, 0])
    depth = wall_depth(CAMERA, R, (0.0, 0.0, 1.0), 2.0).astype(np.float32)
    changed = with_depth(levels, depth)
    assert np.array_equal(changed[0].depth, depth)
    assert np.array_equal(changed[2].depth, halve_depth(halve_depth(depth)))
    for before, after in zip(levels, changed, strict=True):
        assert after.gray is before.gray
        assert after.camera is before.camera
