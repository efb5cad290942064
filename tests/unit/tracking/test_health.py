"""Health: the better pose scores better, and each verdict comes with its reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.frame import Frame
from splatbot.geometry import se3_exp
from splatbot.tracking.align import align
from splatbot.tracking.degeneracy import weak_directions
from splatbot.tracking.health import Health, measure, verdict_of
from splatbot.tracking.prepare import prepare
from splatbot.tracking.reference import Reference, make_reference
from tests.rgbd import Array, small_config, tabletop, wall_frame

CONFIG = small_config().tracking
GATE = CONFIG.sensor.max_depth_difference
GOOD = Health(overlap=0.9, photometric_inliers=0.9, edge_inliers=0.9, geometric_inliers=0.9, score=0.5, contrast=1.0)
KNOWN = np.eye(6)


def reference_of(frame: Frame, T_world_camera: Array) -> Reference:
    return make_reference(prepare(frame, CONFIG).levels, T_world_camera, CONFIG.n_pixels)


def health_at(frame: Frame, reference: Reference, T_world_camera: Array) -> Health:
    return measure(prepare(frame, CONFIG).levels[1], 1, [reference], T_world_camera, CONFIG)


OFFSETS = [[0.01, 0, 0, 0, 0, 0], [0, 0, 0.01, 0, 0, 0], [0, 0, 0, 0, 0.02, 0], [0.03, 0.03, 0, 0, 0, 0.03], [0.5] * 6]


@pytest.mark.parametrize("offset", OFFSETS)
def test_the_right_pose_scores_better_than_a_wrong_one(offset: list[float]) -> None:
    frames, poses = tabletop()
    reference = reference_of(frames[0], poses[0])
    right = health_at(frames[6], reference, poses[6])
    wrong = health_at(frames[6], reference, poses[6] @ se3_exp(offset))
    assert right.score < 0.8 * wrong.score
    assert verdict_of(right, KNOWN, None, CONFIG) == ("ok", ())


def test_the_score_grows_with_the_error() -> None:
    frames, poses = tabletop()
    reference = reference_of(frames[0], poses[0])
    shifts = [0.0, 0.01, 0.03, 0.1]
    scores = [health_at(frames[6], reference, poses[6] @ se3_exp([s, 0, 0, 0, 0, 0])).score for s in shifts]
    assert scores == sorted(scores)


def test_another_exposure_costs_the_right_pose_next_to_nothing() -> None:
    frames, poses = tabletop()
    reference = reference_of(frames[0], poses[0])
    dim = replace(frames[6], rgb=(frames[6].rgb // 2).astype(np.uint8))
    plain, dimmed = (health_at(frame, reference, poses[6]) for frame in (frames[6], dim))
    assert dimmed.score == pytest.approx(plain.score, abs=0.15)
    assert dimmed.contrast == pytest.approx(0.5 * plain.contrast, rel=0.1)
    assert verdict_of(dimmed, KNOWN, None, CONFIG)[0] == "ok"


def test_contrast_is_the_ratio_of_the_standard_deviations_of_grey() -> None:
    wall = wall_frame(np.eye(4))
    half = replace(wall, rgb=np.rint(60 + 0.4 * wall.rgb.astype(np.float64)).astype(np.uint8))
    reference = reference_of(wall, np.eye(4))
    assert health_at(wall, reference, np.eye(4)).contrast == pytest.approx(1.0, abs=1e-3)
    assert health_at(half, reference, np.eye(4)).contrast == pytest.approx(0.4, abs=5e-3)
    bare = wall_frame(np.eye(4), textured=False)
    assert health_at(bare, reference_of(bare, np.eye(4)), np.eye(4)).contrast == 1.0


def test_a_camera_that_looks_away_is_lost_for_want_of_overlap() -> None:
    frames, poses = tabletop()
    away = poses[0] @ se3_exp([0, 0, 0, 0, np.pi, 0])
    health = health_at(frames[1], reference_of(frames[0], poses[0]), away)
    assert health.overlap == 0.0
    assert health.score == 6.0
    verdict, reasons = verdict_of(health, KNOWN, None, CONFIG)
    assert verdict == "lost"
    assert "0% of the reference is seen" in reasons[0]


@pytest.mark.parametrize("colour", [0, 255, "noise"])
@pytest.mark.parametrize("has_depth", [False, True])
def test_a_blank_image_is_lost_though_the_exposure_fit_explains_it(colour: int | str, has_depth: bool) -> None:
    frames, poses = tabletop()
    frame = frames[1]
    rgb = np.full_like(frame.rgb, 0 if colour == "noise" else colour)
    if colour == "noise":
        rgb = np.random.default_rng(0).integers(0, 4, rgb.shape, dtype=np.uint8)
    blank = replace(frame, rgb=rgb, depth=frame.depth if has_depth else np.zeros_like(frame.depth))
    health = health_at(blank, reference_of(frames[0], poses[0]), poses[1])
    verdict, reasons = verdict_of(health, KNOWN, None, CONFIG)
    assert verdict == "lost"
    assert any("the image is blank" in reason for reason in reasons)


def test_residuals_that_do_not_agree_are_lost_with_their_share() -> None:
    frames, poses = tabletop()
    farther = replace(frames[1], depth=frames[1].depth + np.float32(0.03))
    health = health_at(farther, reference_of(frames[0], poses[0]), poses[1])
    assert health.geometric_inliers < 0.3
    assert health.photometric_inliers > 0.6
    verdict, reasons = verdict_of(health, KNOWN, None, CONFIG)
    assert verdict == "lost"
    assert "of the residuals are inliers" in reasons[0]


def test_without_depth_colour_alone_decides() -> None:
    frames, poses = tabletop()
    flat = replace(frames[1], depth=np.zeros_like(frames[1].depth))
    health = health_at(flat, reference_of(frames[0], poses[0]), poses[1])
    assert health.geometric_inliers == 1.0
    assert verdict_of(health, KNOWN, None, CONFIG)[0] == "ok"


def test_a_bare_wall_is_degraded_for_its_translation_is_hardly_constrained() -> None:
    bare = wall_frame(np.eye(4), textured=False)
    reference, levels = reference_of(bare, np.eye(4)), prepare(bare, CONFIG).levels
    found = align(levels, [reference], np.eye(4), CONFIG, photometric=True, finest=0, gate=GATE)
    weak = weak_directions(found.information, 1.0, CONFIG.min_eigen_ratio)
    verdict, reasons = verdict_of(health_at(bare, reference, found.T_world_camera), found.information, weak, CONFIG)
    assert verdict == "degraded"
    assert "hardly constrained" in reasons[0]


def test_a_textured_wall_is_ok() -> None:
    wall = wall_frame(np.eye(4))
    reference, levels = reference_of(wall, np.eye(4)), prepare(wall, CONFIG).levels
    found = align(levels, [reference], np.eye(4), CONFIG, photometric=True, finest=0, gate=GATE)
    weak = weak_directions(found.information, 1.0, CONFIG.min_eigen_ratio)
    assert verdict_of(health_at(wall, reference, found.T_world_camera), found.information, weak, CONFIG) == ("ok", ())


def test_a_shift_along_a_wall_with_one_poster_is_doubted_though_nearly_all_colours_agree() -> None:
    wall = wall_frame(np.eye(4), textured=False)
    rgb = np.full_like(wall.rgb, 128)
    height, width = rgb.shape[:2]
    rgb[9 * height // 20 : 12 * height // 20, 9 * width // 20 : 12 * width // 20] = 40
    frame = replace(wall, rgb=rgb)
    reference = reference_of(frame, np.eye(4))
    right, wrong = (health_at(frame, reference, se3_exp([x, x, 0, 0, 0, 0])) for x in (0.0, 0.1))
    assert right.edge_inliers > 0.9
    assert verdict_of(right, KNOWN, None, CONFIG) == ("ok", ())
    assert wrong.photometric_inliers > 0.8  # most of the wall is grey wherever it is taken to be
    assert wrong.edge_inliers < 0.5
    verdict, reasons = verdict_of(wrong, KNOWN, None, CONFIG)
    assert verdict == "degraded"
    assert "where there are edges" in reasons[0]


def test_where_grey_is_nowhere_steep_no_edge_speaks_against_a_pose() -> None:
    wall = wall_frame(np.eye(4), textured=False)
    even = replace(wall, rgb=np.full_like(wall.rgb, 128))
    assert health_at(even, reference_of(even, np.eye(4)), np.eye(4)).edge_inliers == 1.0


@pytest.mark.parametrize("name", ["overlap", "photometric_inliers", "geometric_inliers", "contrast"])
def test_a_share_that_is_nan_or_zero_is_lost_never_ok(name: str) -> None:
    for value in (np.nan, 0.0):
        verdict, reasons = verdict_of(replace(GOOD, **{name: value}), KNOWN, None, CONFIG)
        assert verdict == "lost"
        assert len(reasons) == 1


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_information_that_is_not_finite_is_lost(value: float) -> None:
    information = np.eye(6)
    information[1, 2] = value
    assert verdict_of(GOOD, information, None, CONFIG) == ("lost", ("the alignment is not finite",))


def test_a_pose_of_nan_is_lost_with_the_worst_score() -> None:
    frames, poses = tabletop()
    health = health_at(frames[1], reference_of(frames[0], poses[0]), np.full((4, 4), np.nan))
    assert (health.overlap, health.score) == (0.0, 6.0)
    assert verdict_of(health, KNOWN, None, CONFIG)[0] == "lost"


def test_references_without_points_are_lost() -> None:
    wall = wall_frame(np.eye(4))
    blind = reference_of(replace(wall, depth=np.zeros_like(wall.depth)), np.eye(4))
    health = health_at(wall, blind, np.eye(4))
    assert health.score == 6.0
    assert verdict_of(health, KNOWN, None, CONFIG)[0] == "lost"
