"""Features: the pose of a rendered view is found to a bound, or honestly not at all."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot import _native
from splatbot.geometry import inverse, se3_exp, transform_points
from splatbot.tracking.features import CONSTANTS, Expectation, FeaturePose, Features, detect, match_pose, spread
from splatbot.tracking.tracker import pose_distance
from tests.rgbd import CAMERA, Array, tabletop

WIDTH = 320


def view(index: int) -> tuple[Features, Array]:
    frames, poses = tabletop(width=WIDTH)
    frame = frames[index]
    return detect(frame.rgb, frame.depth, frame.camera, 800), poses[index]


def matched(current: Features, *keyframes: tuple[Features, Array]) -> FeaturePose | None:
    return match_pose(current, keyframes, tabletop(width=WIDTH)[0][0].camera)


def noise_image(seed: int) -> np.ndarray:
    """Create blocks of random grey, which have corners everywhere."""
    small = np.random.default_rng(seed).integers(0, 256, (30, 40, 1), dtype=np.uint8)
    return np.ascontiguousarray(np.kron(small, np.ones((4, 4, 3), np.uint8)))


@pytest.mark.parametrize("last", [4, 11])
def test_the_pose_between_two_rendered_views_is_found(last: int) -> None:
    current, truth = view(last)
    found = matched(current, view(0))
    assert found is not None
    moved, turned = pose_distance(truth, found.T_world_camera)
    assert moved < 8e-3
    assert turned < np.radians(0.6)
    assert len(found.points) == len(found.pixels) >= CONSTANTS.min_inliers
    assert found.matches >= len(found.points)


def test_the_matches_that_are_kept_agree_with_the_pose_to_three_pixels() -> None:
    found = matched(view(7)[0], view(0), view(3))
    assert found is not None
    camera = tabletop(width=WIDTH)[0][0].camera
    pixels = camera.project(transform_points(inverse(found.T_world_camera), found.points))
    errors = np.linalg.norm(pixels - found.pixels, axis=1)
    assert np.median(errors) < 1.0
    assert np.quantile(errors, 0.99) < 3.0  # all were within 3 px before the last refinement
    assert errors.max() < 5.0


def test_the_pose_is_the_same_bit_for_bit_in_a_second_call() -> None:
    first, second = (matched(view(6)[0], view(0), view(3)) for _ in range(2))
    assert first is not None
    assert second is not None
    assert np.array_equal(first.T_world_camera, second.T_world_camera)
    assert np.array_equal(first.points, second.points)


def test_a_third_of_false_matches_changes_little() -> None:
    features, T = view(0)
    rng = np.random.default_rng(0)
    points = features.points.copy()
    wrong = np.flatnonzero(rng.random(len(points)) < 0.33)
    points[wrong] = points[rng.permutation(wrong)]
    current, truth = view(6)
    found = matched(current, (replace(features, points=points), T))
    assert found is not None
    assert len(found.points) < 0.8 * found.matches
    assert pose_distance(truth, found.T_world_camera)[0] < 8e-3


def test_there_is_no_pose_from_an_unrelated_image_from_few_matches_or_without_keypoints() -> None:
    keyframe = view(0)
    camera = tabletop(width=WIDTH)[0][0].camera
    blank = detect(np.zeros((120, 160, 3), np.uint8), np.ones((120, 160), np.float32), CAMERA, 500)
    assert len(blank) == 0
    few = Features(*(getattr(view(5)[0], field.name)[: CONSTANTS.min_inliers - 1] for field in fields(Features)))
    other = detect(noise_image(0), np.ones((120, 160), np.float32), CAMERA, 500)
    assert len(other) > 100
    for current in (blank, few, other):
        assert match_pose(current, [keyframe], camera) is None
    assert match_pose(view(5)[0], [], camera) is None
    assert match_pose(view(5)[0], [(blank, np.eye(4))], camera) is None


def test_no_pose_is_made_up_from_many_matches_that_do_not_agree() -> None:
    features, T = view(0)
    anchored = np.flatnonzero(np.isfinite(features.points[:, 2]))
    points = features.points.copy()
    points[anchored] = np.random.default_rng(1).uniform([-0.5, -0.5, 0.5], [0.5, 0.5, 2.0], (len(anchored), 3))
    assert matched(features, (features, T)) is not None
    assert matched(features, (replace(features, points=points), T)) is None


def test_a_keyframe_without_depth_offers_nothing_to_match() -> None:
    frames, poses = tabletop(width=WIDTH)
    anchorless = detect(frames[0].rgb, np.zeros_like(frames[0].depth), frames[0].camera, 800)
    assert len(anchorless) > 100
    assert np.isnan(anchorless.points).all()
    assert matched(view(5)[0], (anchorless, poses[0])) is None


def test_points_project_to_their_pixels_at_the_measured_depth() -> None:
    features, _ = view(2)
    frame = tabletop(width=WIDTH)[0][2]
    anchored = np.isfinite(features.points[:, 2])
    assert anchored.mean() > 0.5
    np.testing.assert_allclose(frame.camera.project(features.points[anchored]), features.pixels[anchored], atol=1e-3)
    u, v = np.rint(features.pixels[anchored]).astype(int).T
    # The window is two pixels wide and spans at most 5 % of the depth.
    assert np.abs(features.points[anchored, 2] / frame.depth[v, u] - 1).max() < 0.05


def test_keypoints_whose_window_spans_two_surfaces_have_no_point() -> None:
    depth = np.full((120, 160), 1.0, np.float32)
    depth[:, 80:] = 1.5
    depth[:50] = 0.0
    features = detect(noise_image(5), depth, CAMERA, 2000)
    u, v = np.rint(features.pixels).astype(int).T
    across = (np.abs(u - 79.5) < 2) & (v > 52)
    missing = v < 47
    clear = (np.abs(u - 79.5) > 3) & (v > 52)
    assert min(across.sum(), missing.sum(), clear.sum()) >= 5
    assert np.isnan(features.points[across | missing]).all()
    np.testing.assert_allclose(features.points[clear, 2], np.where(u[clear] < 80, 1.0, 1.5))


def matches_by_brute_force(
    expected: Array, wanted: NDArray[np.uint8], found: Array, have: NDArray[np.uint8], radius: float
) -> NDArray[np.int32]:
    """Apply Lowe's ratio test to Hamming distances within a radius; each keypoint matches its nearest descriptor."""
    bits = np.unpackbits(wanted[:, None] ^ have[None], axis=-1).sum(-1).astype(int)
    bits[np.linalg.norm(expected[:, None] - found[None], axis=-1) > radius] = 257
    out = np.full(len(wanted), -1, np.int32)
    claims: dict[int, tuple[int, int]] = {}
    for i, row in enumerate(bits):
        order = np.argsort(row, kind="stable")
        best, second = row[order[0]], row[order[1]]
        if best <= 64 and best < 0.8 * second and best < claims.get(int(order[0]), (257, 0))[0]:
            claims[int(order[0])] = (int(best), i)
    for k, (_, i) in claims.items():
        out[i] = k
    return out


@pytest.mark.parametrize("radius", [0.0, 5.0, 40.0, np.inf])
def test_matches_near_to_their_place_are_those_of_brute_force(radius: float, rng: np.random.Generator) -> None:
    found = rng.uniform([0, 0], [160, 120], (300, 2)).astype(np.float32)
    have = rng.integers(0, 256, (300, 32), np.uint8)
    chosen = rng.integers(0, 300, 200)  # some twice
    flips = np.packbits(rng.random((200, 256)) < 0.15, axis=-1)
    expected = (found[chosen] + rng.normal(0, 4, (200, 2))).astype(np.float32)
    wanted = have[chosen] ^ flips
    got = _native.match_near(expected, wanted, found, have, radius, 64, 0.8)
    want = matches_by_brute_force(expected.astype(float), wanted, found.astype(float), have, radius)
    np.testing.assert_array_equal(got, want)
    assert (got >= 0).any() == (radius > 0)


def test_a_place_that_is_not_finite_has_no_match() -> None:
    have = np.zeros((3, 32), np.uint8)
    places = np.array([[np.nan, 1], [np.inf, 1], [1, 1]], np.float32)
    assert _native.match_near(places, have, places, have, 1e9, 64, 0.8)[:2].tolist() == [-1, -1]


def test_matches_at_the_edge_of_the_search_are_not_believed() -> None:
    camera = tabletop(width=WIDTH)[0][0].camera
    current, truth = view(4)
    views = [view(0)]
    right = match_pose(current, views, camera, Expectation(truth, 12.0))
    assert right is not None
    assert pose_distance(right.T_world_camera, truth)[0] < 1.5e-2
    shifted = truth @ se3_exp([0, 0, 0, 0, 10.0 / camera.fx, 0])  # everything is expected 10 px to one side
    assert match_pose(current, views, camera, Expectation(shifted, 12.0)) is None


def test_matches_in_one_corner_of_the_image_are_believed_only_when_searched_for_everywhere() -> None:
    camera = tabletop(width=WIDTH)[0][0].camera
    current, truth = view(2)
    distance = np.abs(current.pixels[:, None] - current.pixels[None]).max(-1)
    near = distance[(distance < 25).sum(1).argmax()] < 25  # the most crowded 50 pixels
    corner = replace(
        current, pixels=current.pixels[near], descriptors=current.descriptors[near], points=current.points[near]
    )
    views = [view(0), view(1)]
    assert match_pose(corner, views, camera) is not None
    assert match_pose(corner, views, camera, Expectation(truth, 12.0)) is None
    assert match_pose(current, views, camera, Expectation(truth, 12.0)) is not None


def test_keypoints_are_spread_although_one_object_has_the_strongest_of_all() -> None:
    rng = np.random.default_rng(0)
    crowd, others = rng.uniform([80, 80], [159, 159], (2000, 2)), rng.uniform([0, 0], [640, 480], (2000, 2))
    pixels = np.concatenate([crowd, others]).astype(np.float32)
    strengths = np.r_[rng.uniform(2, 3, 2000), rng.uniform(0, 1, 2000)]
    chosen = spread(pixels, strengths, np.ones(4000, np.bool_), 640, 480)
    assert len(chosen) == len(np.unique(chosen)) == 480
    tiles = np.unique((pixels[chosen] // 80).astype(int), axis=0, return_counts=True)
    assert len(tiles[0]) == 48
    assert tiles[1].max() == 20  # twice a tile's share of 480 in 48; without a limit all 480 would be of one tile
    weakest = strengths[chosen][(pixels[chosen] // 80 == 1).all(axis=1)].min()
    left_out = np.setdiff1d(np.flatnonzero((pixels // 80 == 1).all(axis=1)), chosen)
    assert strengths[left_out].max() <= weakest  # of a tile the strongest are taken


def test_keypoints_without_depth_come_after_those_that_have_one() -> None:
    pixels = np.tile(np.array([[10, 10], [300, 200]], np.float32), (50, 1))
    known = np.arange(100) % 2 == 1
    chosen = spread(pixels, np.where(known, 1.0, 9.0), known, 640, 60)
    assert known[chosen[:50]].all()
    assert not known[chosen[50:]].any()


def test_few_keypoints_are_all_kept() -> None:
    pixels = np.array([[1, 1], [2, 2], [600, 400]], np.float32)
    assert set(spread(pixels, np.arange(3.0), np.ones(3, np.bool_), 640, 500)) == {0, 1, 2}
    assert len(spread(pixels[:0], np.zeros(0), np.zeros(0, np.bool_), 640, 500)) == 0
