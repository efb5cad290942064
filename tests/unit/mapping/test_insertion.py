"""Insertion: new Gaussians lie on measured surfaces and only where the map does not explain them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, se3_exp, transform_points
from splatbot.mapping.insertion import (
    ModelView,
    guess_depth,
    guessed_gaussians,
    model_depth,
    new_gaussians,
    unexplained,
    view_of,
)
from splatbot.mapping.keyframes import Keyframe
from tests.rgbd import CAMERA, small_config, wall_depth
from tests.unit.mapping.conftest import MakeKeyframe

CONFIG = small_config().mapping
POSE = se3_exp([0.4, -0.2, 0.3, 0.1, 0.2, -0.3])
SLANTED = np.array([0.5, -0.3, 0.9]) / np.linalg.norm([0.5, -0.3, 0.9])
EVERYWHERE = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)


def fused(keyframe: Keyframe) -> GaussianModel:
    """Map a single keyframe."""
    return new_gaussians(keyframe, keyframe.depth > 0, CONFIG)


def axes(model: GaussianModel) -> NDArray[np.float64]:
    """Compute orientations (N, 3, 3): columns are the axes in the world."""
    return np.asarray(Rotation.from_quat(model.quats.double().numpy(), scalar_first=True).as_matrix())


def test_new_gaussians_lie_on_the_measured_surface_at_the_pixels_of_the_grid(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe(POSE, normal=SLANTED, distance=1.5)
    model = fused(keyframe)
    s = CONFIG.stride
    assert len(model) == len(range(s // 2, 120, s)) * len(range(s // 2, 160, s))
    means = model.means.double().numpy()
    np.testing.assert_allclose(means @ SLANTED, 1.5, atol=2e-6)
    pixels = CAMERA.project(transform_points(inverse(POSE), means))
    offset = (pixels - s // 2) / s
    np.testing.assert_allclose(offset, np.rint(offset), atol=1e-3)


def test_their_shortest_axis_is_the_surface_normal(make_keyframe: MakeKeyframe) -> None:
    model = fused(make_keyframe(POSE, normal=SLANTED, distance=1.5))
    assert (model.log_scales.argmin(1) == 2).all()
    known = np.abs(axes(model)[:, :, 2] @ SLANTED)
    assert np.quantile(known, 0.05) > 1 - 1e-5  # but those on the image's border, which have no normal


def test_their_disc_is_the_footprint_of_the_grid_stretched_by_the_slant(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe(POSE, normal=SLANTED, distance=1.5)
    model = fused(keyframe)
    points = transform_points(inverse(POSE), model.means.double().numpy())
    inner = (np.abs(CAMERA.project(points) - [80, 60]) < [75, 55]).all(1)  # with a normal
    normal = SLANTED @ POSE[:3, :3]
    cosine = np.abs(points @ normal) / np.linalg.norm(points, axis=1)
    across = 0.5 * CONFIG.stride * points[:, 2] / CAMERA.fx
    expected = np.stack([across / cosine, across, 0.2 * across], 1)
    np.testing.assert_allclose(model.scales.double().numpy()[inner], expected[inner], rtol=2e-3)
    # The long axis lies in the plane that the line of sight and the normal span.
    toward = (points / np.linalg.norm(points, axis=1, keepdims=True)) @ POSE[:3, :3].T
    sideways = np.cross(toward, SLANTED)
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    assert np.abs((axes(model)[:, :, 0] * sideways).sum(1))[inner].max() < 0.02


def test_neighbouring_discs_touch_at_one_sigma_whatever_the_slant(make_keyframe: MakeKeyframe) -> None:
    model = fused(make_keyframe(normal=(0, 0, 1), distance=2.0))
    distances, _ = cKDTree(model.means.numpy()).query(model.means.numpy(), k=2)
    np.testing.assert_allclose(distances[:, 1], 2 * model.scales[:, 1].numpy(), rtol=0.02)


def test_a_grazing_surface_stretches_at_most_three_times(make_keyframe: MakeKeyframe) -> None:
    grazing = np.array([0.0, 1.0, 0.05]) / np.linalg.norm([0.0, 1.0, 0.05])
    keyframe = make_keyframe()
    depth = wall_depth(CAMERA, np.eye(4), grazing, 0.3)
    keyframe.depth = torch.from_numpy(np.where((depth > 0.2) & (depth < 6), depth, 0).astype(np.float32))
    model = fused(keyframe)
    assert len(model) > 100
    ratio = model.scales[:, 0] / model.scales[:, 1]
    assert float(ratio.max()) <= 3.0 + 1e-4
    assert float(ratio.max()) > 2.5


def test_a_pixel_without_a_normal_faces_the_camera(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe(POSE)
    lonely = torch.zeros_like(keyframe.depth)
    lonely[61, 70] = 1.3
    assert (61 - 1) % 3 == 0
    assert (70 - 1) % 3 == 0
    keyframe.depth = lonely
    model = fused(keyframe)
    assert len(model) == 1
    ray = model.means[0].double().numpy() - POSE[:3, 3]
    assert abs(axes(model)[0, :, 2] @ ray) == pytest.approx(np.linalg.norm(ray), rel=1e-5)


def test_they_carry_the_colour_the_opacity_and_the_number_of_their_keyframe(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe(number=7)
    model = fused(keyframe)
    s = CONFIG.stride
    colors = keyframe.rgb[s // 2 :: s, s // 2 :: s].reshape(-1, 3).float() / 255
    torch.testing.assert_close(model.colors, colors, atol=1e-6, rtol=0)
    torch.testing.assert_close(model.opacities, torch.full((len(model),), CONFIG.initial_opacity))
    assert (model.anchors == 7).all()
    assert (model.observations == 1).all()


def test_no_pixel_chosen_makes_no_gaussian(make_keyframe: MakeKeyframe) -> None:
    assert len(new_gaussians(make_keyframe(), torch.zeros_like(EVERYWHERE), CONFIG)) == 0


def test_a_view_of_an_empty_map_is_blank_and_everything_measured_is_unexplained(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    keyframe.depth[:30] = 0
    view = view_of(GaussianModel.empty(), CAMERA, POSE)
    assert view.rgb.shape == (120, 160, 3)
    assert not view.rgb.any()
    assert not view.depth.any()
    assert not view.alpha.any()
    assert torch.equal(unexplained(view, keyframe.depth, CONFIG), keyframe.depth > 0)


def test_the_view_that_made_the_map_is_explained_by_it_to_a_millimetre(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe(POSE, normal=SLANTED, distance=1.5)
    view = view_of(fused(keyframe), CAMERA, POSE)
    inner = (slice(4, -4), slice(4, -4))
    assert not unexplained(view, keyframe.depth, CONFIG)[inner].any()
    assert float((view.depth - keyframe.depth).abs()[inner].max()) < 1e-3
    assert len(new_gaussians(keyframe, unexplained(view, keyframe.depth, CONFIG), CONFIG)) < 0.02 * len(fused(keyframe))


def test_something_in_front_of_the_map_is_unexplained_and_something_behind_it_is_not(
    make_keyframe: MakeKeyframe,
) -> None:
    keyframe = make_keyframe()
    view = view_of(fused(keyframe), CAMERA, np.eye(4))
    depth = keyframe.depth.clone()
    depth[40:60, 50:80] = 0.9
    depth[70:90, 50:80] = 1.2
    lacking = unexplained(view, depth, CONFIG)[4:-4, 4:-4]
    box = torch.zeros_like(EVERYWHERE)
    box[40:60, 50:80] = True
    assert torch.equal(lacking, box[4:-4, 4:-4])


def test_a_difference_within_the_tolerance_is_the_same_surface(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    view = ModelView(torch.zeros(120, 160, 3), torch.full((120, 160), 1.0), torch.ones(120, 160))
    for nearer, new in ((0.97, False), (0.95, True)):
        lacking = unexplained(view, torch.full_like(keyframe.depth, nearer), CONFIG)
        assert bool(lacking.all()) is new
        assert bool(lacking.any()) is new


def test_model_depth_is_the_measured_one_where_the_map_is_not_solid_or_contradicts_it() -> None:
    depth = torch.tensor([[1.0, 1.01, 1.2, 1.0, 0.0]])
    alpha = torch.tensor([[0.95, 0.5, 0.95, 0.95, 0.0]])
    measured = np.array([[1.0, 1.0, 1.0, 0.0, 1.0]], np.float32)
    merged = model_depth(ModelView(torch.zeros(1, 5, 3), depth, alpha), measured, CONFIG)
    np.testing.assert_allclose(merged, [[1.0, 1.0, 1.0, 0.0, 1.0]])
    assert merged.dtype == np.float32


def test_model_depth_has_the_detail_of_the_map_at_the_measured_distance() -> None:
    rng = np.random.default_rng(3)
    v, u = np.mgrid[0:240, 0:320]
    surface = 1.2 + 0.3 * u / 320 + 0.004 * np.sin(u / 3) * np.sin(v / 4)
    shown = torch.from_numpy(0.998 * surface).float()  # all of it too near, as a blend of many layers is
    measured = np.asarray(surface + 0.003 * rng.standard_normal(surface.shape), np.float32)
    measured[100:140, 50:90] = 0
    view = ModelView(torch.zeros(240, 320, 3), shown, torch.ones(240, 320))
    error = (model_depth(view, measured, CONFIG) - surface)[measured > 0]
    assert np.abs(error).max() < 3e-5


def test_strays_within_the_gate_do_not_move_model_depth() -> None:
    measured = np.full((60, 80), 1.5, np.float32)
    measured[:, :20] = 1.54  # a quarter of the image is 4 cm behind the rest
    view = ModelView(torch.zeros(60, 80, 3), torch.full((60, 80), 1.49), torch.ones(60, 80))
    found = model_depth(view, measured, CONFIG)
    np.testing.assert_allclose(found, 1.5, atol=1e-6)


def test_a_guess_is_the_depth_of_the_nearest_measured_pixel() -> None:
    rng = np.random.default_rng(5)
    depth = np.where(rng.random((40, 50)) < 0.02, rng.uniform(0.5, 3, (40, 50)), 0).astype(np.float32)
    guess = guess_depth(torch.from_numpy(depth)).numpy()
    known, missing = np.argwhere(depth > 0), np.argwhere(depth == 0)
    assert not guess[depth > 0].any()
    assert (guess[depth == 0] > 0).all()
    nearest, _ = cKDTree(known).query(missing)
    values = depth[depth > 0]
    for (v, u), least in zip(missing, nearest, strict=True):
        distance = np.linalg.norm(known[values == guess[v, u]] - (v, u), axis=1).min()
        assert distance <= 1.05 * least  # the transform's 5x5 mask is exact to 2 % or so


def test_nothing_is_guessed_where_everything_or_nothing_was_measured() -> None:
    for depth in (torch.ones(6, 8), torch.zeros(6, 8)):
        assert not guess_depth(depth).any()


def test_guessed_gaussians_have_no_observation_and_lie_only_where_neither_depth_nor_map_is(
    make_keyframe: MakeKeyframe,
) -> None:
    keyframe = make_keyframe()
    keyframe.depth[40:80, 60:100] = 0
    seen = make_keyframe()
    seen.depth[:, 80:] = 0
    view = view_of(fused(seen), CAMERA, np.eye(4))  # the map knows the left half
    guessed = guessed_gaussians(view, keyframe, CONFIG)
    assert len(guessed) > 50
    assert (guessed.observations == 0).all()
    u, v = CAMERA.project(guessed.means.double().numpy()).T
    assert u.min() > 78
    assert u.max() < 100
    assert v.min() > 39
    assert v.max() < 80
    np.testing.assert_allclose(guessed.means[:, 2], 1.0, atol=1e-6)


def test_a_keyframe_without_depth_explains_and_guesses_nothing(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    blind = replace(keyframe, depth=torch.zeros_like(keyframe.depth))
    view = view_of(fused(keyframe), CAMERA, np.eye(4))
    assert not unexplained(view, blind.depth, CONFIG).any()
    assert len(guessed_gaussians(view, blind, CONFIG)) == 0
