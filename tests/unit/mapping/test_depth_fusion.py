"""Depth comparison against a brute-force computation in float64, and fusion against the information form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import shortest_axes
from splatbot.geometry import inverse, quat_multiply, se3_exp, transform_points
from splatbot.mapping.depth_fusion import (
    DepthComparison,
    DepthNoiseModel,
    compare_with_depth,
    fuse_depth,
    fuse_normals,
    initial_uncertainty,
    stable,
    update_visibility,
)
from splatbot.mapping.keyframes import Keyframe
from tests.rgbd import CAMERA, Array
from tests.unit.mapping.conftest import MakeKeyframe

NOISE = DepthNoiseModel(1e-3, 2e-3)
POSE = se3_exp([0.1, -0.2, 0.15, 0.1, -0.2, 0.3])
SLANTED = (0.2, 0.1, 0.97)


def flat(means: Array, normal_axis: int = 2, sigma: float = 0.0) -> GaussianModel:
    """Make discs whose shortest axis is an axis of the world."""
    scales = np.full((len(means), 3), 0.01)
    scales[:, normal_axis] = 0.001
    model = GaussianModel.from_activated(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (len(means), 1)),
        scales=scales,
        opacities=np.full(len(means), 0.8),
        colors=np.full((len(means), 3), 0.5),
    )
    model.uncertainty.fill_(sigma)
    return model


def weighed(model: GaussianModel, keyframe: Keyframe) -> DepthComparison:
    return compare_with_depth(model, keyframe.depth, keyframe.camera, keyframe.T_world_camera, NOISE)


def brute_force(model: GaussianModel, keyframe: Keyframe) -> tuple[list[bool], list[bool]]:
    """Compare one Gaussian at a time in float64."""
    supported, through = [], []
    depth = keyframe.depth.numpy()
    padded = np.pad(depth, 1, constant_values=np.inf)
    for mean, own in zip(model.means.double().numpy(), model.uncertainty.double().numpy(), strict=True):
        x, y, z = transform_points(inverse(keyframe.T_world_camera), mean)
        yes = no = False
        if z > 0.05:
            u = int(np.rint(CAMERA.fx * x / z + CAMERA.cx))
            v = int(np.rint(CAMERA.fy * y / z + CAMERA.cy))
            if 0 <= u < CAMERA.width and 0 <= v < CAMERA.height:
                d, around = float(depth[v, u]), float(padded[v : v + 3, u : u + 3].min())
                tolerance = max(3 * np.hypot(1e-3 + 2e-3 * d * d, own), 0.012 * d)
                yes = d > 0 and abs(z - d) < tolerance
                no = around > 0 and z + tolerance < around
        supported.append(yes)
        through.append(no)
    return supported, through


def test_evidence_equals_a_count_one_by_one(make_keyframe: MakeKeyframe) -> None:
    rng = np.random.default_rng(9)
    keyframe = make_keyframe(POSE, normal=SLANTED, distance=1.5)
    keyframe.depth[rng.random((120, 160)) < 0.05] = 0
    points = rng.uniform([-0.8, -0.6, -1.0], [0.8, 0.6, 2.5], (6000, 3))
    surface = CAMERA.backproject(keyframe.depth.numpy())[::3, ::3].reshape(-1, 3).astype(np.float64)
    model = flat(np.concatenate([transform_points(POSE, points), transform_points(POSE, surface)]))
    model.uncertainty = torch.from_numpy(rng.uniform(0, 0.02, len(model)).astype(np.float32))
    evidence = weighed(model, keyframe)
    supported, through = brute_force(model, keyframe)
    assert sum(supported) > 500
    assert sum(through) > 100
    # A centre within rounding of a pixel's edge may be read from either pixel.
    assert np.mean(evidence.supported.numpy() != supported) < 1e-3
    assert np.mean(evidence.seen_through.numpy() != through) < 1e-3
    assert not (evidence.supported & evidence.seen_through).any()


def test_an_empty_map_and_a_view_without_depth_have_no_evidence(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe()
    assert weighed(GaussianModel.empty(), keyframe).supported.shape == (0,)
    blind = replace(keyframe, depth=torch.zeros_like(keyframe.depth))
    evidence = weighed(flat(np.array([[0.0, 0.0, 1.0]])), blind)
    assert not evidence.supported.any()
    assert not evidence.seen_through.any()


def test_the_offset_is_the_distance_to_the_surface_along_the_normal_wherever_in_the_pixel(
    make_keyframe: MakeKeyframe,
) -> None:
    keyframe = make_keyframe(distance=1.0)
    rng = np.random.default_rng(2)
    means = np.column_stack([rng.uniform(-0.4, 0.4, 200), rng.uniform(-0.3, 0.3, 200), rng.uniform(0.995, 1.005, 200)])
    evidence = weighed(flat(means), keyframe)
    assert evidence.supported.all()
    signed = (evidence.offset[:, None] * evidence.normals)[:, 2].double().numpy()
    np.testing.assert_allclose(means[:, 2] + signed, 1.0, atol=1e-5)


def test_a_grazing_view_does_not_move_a_gaussian(make_keyframe: MakeKeyframe) -> None:
    evidence = weighed(flat(np.array([[0.0, 0.0, 1.004]]), normal_axis=0), make_keyframe(distance=1.0))
    assert evidence.supported.all()
    assert evidence.offset.item() == 0
    assert torch.isinf(evidence.variance).all()


def test_fusing_adds_information_and_moves_the_mean_by_its_share() -> None:
    model = flat(np.array([[0.0, 0.0, 1.0]]), sigma=4e-3)
    evidence = DepthComparison(
        torch.tensor([True]),
        torch.tensor([False]),
        torch.tensor([0.005]),
        torch.tensor([9e-6]),
        torch.tensor([[0.0, 0.0, 1.0]]),
        torch.zeros(1, 3),
    )
    fused = fuse_depth(model, evidence)
    information = 1 / 16e-6 + 1 / 9e-6
    assert float(fused.uncertainty) == pytest.approx(information**-0.5, rel=1e-5)
    assert float(fused.means[0, 2]) == pytest.approx(1.0 + 0.005 * (1 / 9e-6) / information, abs=1e-6)
    assert model.means[0, 2] == 1.0  # the one that readers hold


def test_many_observations_average_their_noise_and_never_reach_certainty(make_keyframe: MakeKeyframe) -> None:
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 20), np.linspace(-0.3, 0.3, 20)), -1).reshape(-1, 2)
    exact = make_keyframe(distance=1.0).depth
    model = flat(np.column_stack([grid, 1 + rng.normal(0, 3e-3, len(grid))]), sigma=3e-3)
    for _ in range(30):
        noisy = exact + torch.from_numpy(rng.normal(0, 3e-3, exact.shape).astype(np.float32))
        evidence = compare_with_depth(model, noisy, CAMERA, np.eye(4), NOISE)
        model = update_visibility(fuse_depth(model, evidence), evidence)
    assert float((model.means[:, 2] - 1).std()) < 1e-3
    assert abs(float((model.means[:, 2] - 1).mean())) < 2e-4
    assert 0.25 * 3e-3 < float(model.uncertainty.min()) <= float(model.uncertainty.max()) < 1.2e-3
    assert (model.observations >= 30).all()


def tilts(model: GaussianModel, normal: Array) -> Array:
    """Compute the angles (N,) [deg] from each disc's axis to a normal."""
    cosine = np.abs(shortest_axes(model).double().numpy() @ normal)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def test_observations_rotate_discs_into_the_surface_and_average_their_noise(make_keyframe: MakeKeyframe) -> None:
    rng = np.random.default_rng(5)
    keyframe = make_keyframe(POSE, normal=SLANTED, distance=1.5)
    normal = np.array(SLANTED) / np.linalg.norm(SLANTED)
    surface = CAMERA.backproject(keyframe.depth.numpy())[20:100:8, 20:140:8].reshape(-1, 3).astype(np.float64)
    model = flat(transform_points(POSE, surface), sigma=3e-3)
    upright = np.concatenate([np.ones((len(model), 1)), 0.1 * rng.standard_normal((len(model), 3))], 1)
    model.quats = torch.from_numpy(quat_multiply(upright, model.quats)).float()
    assert 10 < np.median(tilts(model, normal)) < tilts(model, normal).max() < 45
    for _ in range(12):
        noisy = keyframe.depth + torch.from_numpy(rng.normal(0, 4e-3, (120, 160)).astype(np.float32))
        evidence = compare_with_depth(model, noisy, CAMERA, POSE, NOISE)
        model = update_visibility(fuse_normals(fuse_depth(model, evidence), evidence), evidence)
    assert np.percentile(tilts(model, normal), 95) < 4


def test_a_disc_of_another_surface_or_at_an_edge_is_not_turned(make_keyframe: MakeKeyframe) -> None:
    keyframe = make_keyframe(distance=1.0)
    keyframe.depth[:, 80:] = 1.3
    model = flat(np.array([[0.2, 0.0, 1.3], [-0.3, 0.0, 1.0], [-0.012, 0.0, 1.0]]))
    model.quats[1] = torch.tensor([np.cos(0.5), np.sin(0.5), 0.0, 0.0])  # turned by 57 degrees
    evidence = weighed(model, keyframe)
    assert evidence.supported.tolist() == [True, True, True]
    turned = fuse_normals(model, evidence)
    assert torch.equal(turned.quats[1:], model.quats[1:])
    assert not torch.isnan(turned.quats).any()


def test_three_misses_remove_a_gaussian_and_support_in_between_keeps_it() -> None:
    model = flat(np.zeros((3, 3)), sigma=1e-3)
    model.observations[:] = 3
    nothing = (torch.zeros(3), torch.full((3,), torch.inf), torch.zeros(3, 3), torch.zeros(3, 3))
    looks = [([0, 0, 1], [1, 1, 0])] * 2 + [([0, 1, 1], [1, 0, 0])]
    for supported, through in looks:
        model = update_visibility(
            model, DepthComparison(torch.tensor(supported) > 0, torch.tensor(through) > 0, *nothing)
        )
    assert model.misses.tolist() == [3, 1, 0]
    assert model.opacities[0] < 1e-3
    assert model.opacities[1] > 0.3
    assert model.opacities[2] == pytest.approx(0.8)


def test_an_unstable_gaussian_is_removed_one_miss_earlier_than_a_stable_one() -> None:
    model = flat(np.zeros((3, 3)), sigma=1e-3)
    model.observations[:] = torch.tensor([3, 2, 3])
    model.uncertainty[2] = 6e-3  # of a disc of 1 cm
    assert stable(model).tolist() == [True, False, False]
    away = DepthComparison(
        torch.zeros(3) > 0,
        torch.ones(3) > 0,
        torch.zeros(3),
        torch.full((3,), torch.inf),
        torch.zeros(3, 3),
        torch.zeros(3, 3),
    )
    once = update_visibility(model, away)
    twice = update_visibility(once, away)
    assert (once.opacities > 0.5).all()
    assert (twice.opacities > 0.1).tolist() == [True, False, False]


def test_a_new_gaussian_is_as_uncertain_as_the_sensor_and_a_guess_far_more() -> None:
    model = flat(np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0]]))
    model.observations[1] = 0
    assert initial_uncertainty(model, np.eye(4), NOISE).tolist() == pytest.approx([9e-3, 0.1])
