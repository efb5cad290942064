"""Targets from pixels, points, masks and rectangles, and the order of backends."""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np
import pytest

from splatbot.bench.tabletop import Block
from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.geometry import inverse, look_at, transform_points
from splatbot.grasping.affordance import (
    AffordanceError,
    BoxHint,
    Hint,
    MaskHint,
    MasksHint,
    NameHint,
    ObservedView,
    PixelHint,
    PointHint,
    Target,
    find_target,
)
from splatbot.grasping.language import LanguageAffordance
from splatbot.grasping.spatial import SpatialAffordance, point_at
from splatbot.rasterize.views import render_view
from splatbot.segmentation import SegmentedMap, segment
from tests.unit.grasping.objects import BALL, BIG, BOX, CAN, colored, scene, target_of

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
VIEW = ObservedView(CAMERA, look_at(np.array([0.0, -0.4, 0.6]), np.array([0.5, 0.0, 0.0])))
PLACE = [SpatialAffordance()]


def _pixel(point: tuple[float, float, float]) -> tuple[float, float]:
    u, v = CAMERA.project(transform_points(inverse(VIEW.T_world_camera), np.array(point)))
    return float(u), float(v)


def test_a_pixel_shows_the_point_that_is_there() -> None:
    top = (0.50, -0.15, 0.12)
    np.testing.assert_allclose(point_at(scene(), VIEW, *_pixel(top)), top, atol=4e-3)


@pytest.mark.parametrize("solid", [BOX, CAN, BALL])
def test_a_pixel_and_a_point_on_an_object_select_its_gaussians(solid: object) -> None:
    wanted = target_of(scene(), solid, "it")  # type: ignore[arg-type]
    middle = np.median(scene().model.means.double().numpy()[wanted.rows], axis=0)
    high = tuple(scene().model.means.double().numpy()[wanted.rows].max(axis=0)[2:3])
    at = (float(middle[0]), float(middle[1]), float(high[0]))
    for hint in (PixelHint(*_pixel(at), VIEW), PointHint(np.array(at))):
        found = find_target(hint, scene(), PLACE)
        assert found.number == wanted.number
        assert found.backend == "place"
        np.testing.assert_array_equal(found.rows, wanted.rows)


def test_a_point_inside_of_an_object_selects_it_with_a_note() -> None:
    found = SpatialAffordance().locate(PointHint(np.array(BIG.center)), scene())
    assert found.number == target_of(scene(), BIG, "big").number
    assert "inside" in found.notes[0]


def test_a_mask_and_a_rectangle_select_the_object_that_fills_them() -> None:
    wanted = target_of(scene(), CAN, "can")
    u, v = np.array(
        [_pixel((0.50 + dx, -0.15 + dy, z)) for dx in (-0.02, 0.02) for dy in (-0.02, 0.02) for z in (0.03, 0.12)]
    ).T
    box = BoxHint(u.min(), v.min(), u.max(), v.max(), VIEW)
    mask = np.zeros((240, 320), bool)
    mask[int(v.min()) : int(v.max()), int(u.min()) : int(u.max())] = True
    for hint in (box, MaskHint(mask, VIEW)):
        found = find_target(hint, scene(), PLACE)
        assert found.number == wanted.number
        assert found.score > 0.6


def test_a_mask_over_two_objects_is_refused_and_names_both() -> None:
    mask = np.zeros((240, 320), bool)
    for top in ((0.45, 0.10, 0.12), (0.50, -0.15, 0.12)):
        u, v = (round(x) for x in _pixel(top))
        mask[v - 3 : v + 4, u - 5 : u + 6] = True
    with pytest.raises(AffordanceError, match="about equally") as caught:
        find_target(MaskHint(mask, VIEW), scene(), PLACE)
    assert len(caught.value.candidates) >= 2


def test_a_mask_of_a_part_of_connected_objects_selects_that_part() -> None:
    """Two boxes a centimetre apart are one object in a map that is too coarse to separate them."""
    low, high = Block((0.45, 0.0, 0.03), (0.06, 0.06, 0.06)), Block((0.525, 0.0, 0.03), (0.08, 0.06, 0.06))
    one = segment(colored({"low": low, "high": high}, 24_000, {}), np.eye(4), apart=0.03, cut=False)
    (both,) = one.objects
    corners = np.array([_pixel((0.45 + dx, dy, 0.06)) for dx in (-0.03, 0.03) for dy in (-0.03, 0.03)])
    mask = np.zeros((240, 320), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(corners).astype(np.int32)), 1)
    found = find_target(MaskHint(mask > 0, VIEW), one, PLACE)
    means = one.model.means.double().numpy()[found.rows]
    own = np.abs(low.distance(means)) < 2e-3
    assert own.mean() > 0.7  # includes the occluded side of the other box
    assert len(found.rows) > 0.5 * (np.abs(low.distance(one.model.means.double().numpy()[both.rows])) < 2e-3).sum()
    assert "is connected" in found.notes[0]
    u, v = _pixel((0.45, 0.0, 0.06))
    rectangle = find_target(BoxHint(u - 5, v - 5, u + 5, v + 5, VIEW), one, PLACE)
    np.testing.assert_array_equal(rectangle.rows, both.rows)  # a hand-drawn rectangle may be smaller than the object


@pytest.mark.parametrize("rough", [0.0, 0.003, 0.006])
def test_a_mask_that_leaves_out_a_neighbour_means_the_larger_one_and_a_rough_one_means_all(rough: float) -> None:
    low, high = Block((0.45, 0.0, 0.03), (0.06, 0.06, 0.06)), Block((0.525, 0.0, 0.03), (0.08, 0.06, 0.06))
    one = segment(colored({"low": low, "high": high}, 24_000, {}), np.eye(4), apart=0.03, cut=False)
    (both,) = one.objects

    def marked(x0: float, x1: float) -> MaskHint:
        ends = (x0 + rough, x1 - rough), (rough - 0.03, 0.03 - rough), (rough, 0.06)
        corners = np.array([_pixel(corner) for corner in product(*ends)])
        mask = np.zeros((240, 320), np.uint8)
        cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(corners).astype(np.int32)), 1)
        return MaskHint(mask > 0, VIEW)

    part = find_target(marked(0.485, 0.565), one, PLACE)
    means = one.model.means.double().numpy()
    assert (np.abs(high.distance(means[part.rows])) < 2e-3).mean() > 0.7  # includes the occluded side of the other box
    assert "is connected" in part.notes[0]
    whole = find_target(marked(0.42, 0.565), one, PLACE)
    np.testing.assert_array_equal(whole.rows, both.rows)


LOW, HIGH = Block((0.45, 0.0, 0.03), (0.06, 0.06, 0.06)), Block((0.485, 0.055, 0.04), (0.06, 0.05, 0.08))
AROUND = [
    look_at(np.array([0.45 + 0.5 * np.cos(a), 0.5 * np.sin(a), 0.45]), np.array([0.46, 0.02, 0.03])) for a in range(6)
]


def touching() -> SegmentedMap:
    """Return two touching boxes, which are one cluster that is too large for an object."""
    long = Block((0.45, -0.21, 0.03), (0.06, 0.36, 0.06))
    return segment(colored({"low": LOW, "high": HIGH, "long": long}, 40_000, {}), np.eye(4), apart=0.012, cut=False)


def silhouette(block: Block, others: list[Block], T_world_camera: np.ndarray) -> np.ndarray:
    """Return the pixels (H, W) at which a box is in front of others, by rays against the slabs of each box."""
    rays = (
        CAMERA.backproject(np.ones((240, 320), np.float32)).reshape(-1, 3).astype(np.float64) @ T_world_camera[:3, :3].T
    )
    reach = []
    for one in (block, *others):
        low, high = np.array(one.center) - np.array(one.size) / 2, np.array(one.center) + np.array(one.size) / 2
        with np.errstate(divide="ignore"):
            a, b = ((side - T_world_camera[:3, 3]) / rays for side in (low, high))
        enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        reach.append(np.where(enter < leave, enter, np.inf))
    return (np.isfinite(reach[0]) & (reach[0] <= np.min(reach, axis=0))).reshape(240, 320)


def test_masks_in_several_views_separate_objects_that_touch() -> None:
    one = touching()
    means = one.model.means.double().numpy()
    for block, other in ((LOW, HIGH), (HIGH, LOW)):
        masks = tuple(MaskHint(silhouette(block, [other], T), ObservedView(CAMERA, T)) for T in AROUND)
        found = find_target(MasksHint(masks), one, PLACE)
        own = (np.abs(block.distance(means)) < 2e-3) & (one.labels >= -1)
        only = own & (np.abs(other.distance(means)) > 6e-3)
        assert np.isin(found.rows, np.flatnonzero(own)).mean() > 0.9
        assert np.isin(np.flatnonzero(only), found.rows).mean() > 0.8
        assert "masks show" in found.notes[0]
        alone = find_target(masks[0], one, PLACE)  # hidden sides are guessed from one view
        assert np.isin(alone.rows, np.flatnonzero(own)).mean() > 0.8


def test_masks_count_only_where_measured_depth_agrees() -> None:
    """A mask that lacks the pixels behind the robot's arm excludes nothing there, if depth has a hole at the arm."""
    one = touching()
    hints = []
    for T in AROUND:
        mask = silhouette(LOW, [HIGH], T)
        view = find_depth(one, T)
        arm = np.zeros_like(mask)
        arm[:, : int(np.nonzero(mask)[1].mean())] = True  # the arm covers half of the object
        hints.append(MaskHint(mask & ~arm, ObservedView(CAMERA, T, None, np.where(arm, np.float32(0), view))))
    seen = find_target(MasksHint(tuple(hints)), one, PLACE)
    blind = find_target(
        MasksHint(tuple(MaskHint(h.mask, ObservedView(CAMERA, h.view.T_world_camera)) for h in hints)), one, PLACE
    )
    own = np.flatnonzero((np.abs(LOW.distance(one.model.means.double().numpy())) < 2e-3) & (one.labels >= -1))
    assert np.isin(own, seen.rows).mean() > 0.7
    assert np.isin(own, blind.rows).mean() < np.isin(own, seen.rows).mean() - 0.1


def find_depth(one: SegmentedMap, T_world_camera: np.ndarray) -> np.ndarray:
    return render_view(one.model, CAMERA, T_world_camera, "depth")


def test_masks_of_the_table_or_of_nothing_are_refused() -> None:
    sky, table = np.zeros((240, 320), bool), np.zeros((240, 320), bool)
    sky[:3, :3] = True
    u, v = (round(x) for x in _pixel((0.30, -0.05, 0.0)))
    table[v - 5 : v + 6, u - 5 : u + 6] = True
    away = ObservedView(CAMERA, look_at(np.array([0.0, -0.4, 0.6]), np.array([-5.0, -9.0, 3.0])))
    for mask, view, message in ((sky, away, "nothing of the map"), (table, VIEW, "no object")):
        with pytest.raises(AffordanceError, match=message):
            find_target(MasksHint((MaskHint(mask, view),)), scene(), PLACE)
    with pytest.raises(InputError, match="booleans"):
        find_target(MasksHint((MaskHint(np.ones((2, 2), bool), VIEW),)), scene(), PLACE)


def test_the_table_is_no_target() -> None:
    with pytest.raises(AffordanceError, match=r"there is no object; the nearest object is [\d.]+ cm away"):
        find_target(PointHint(np.array([0.30, -0.05, 0.0])), scene(), PLACE)


@pytest.mark.parametrize(
    ("hint", "message"),
    [
        (PixelHint(320.0, 10.0, VIEW), "pixel: is \\(320, 10\\) in a picture of 320x240"),
        (PixelHint(float("nan"), 10.0, VIEW), "pixel"),
        (PointHint(np.array([np.nan, 0.0, 0.0])), "point"),
        (MaskHint(np.ones((2, 2), bool), VIEW), "mask"),
        (BoxHint(400.0, 0.0, 500.0, 10.0, VIEW), "box"),
    ],
)
def test_hints_that_make_no_sense_are_refused(hint: Hint, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_target(hint, scene(), PLACE)


def test_a_pixel_that_shows_nothing_is_an_error() -> None:
    up = ObservedView(CAMERA, look_at(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 3.0])))
    with pytest.raises(AffordanceError, match="shows nothing of the map"):
        find_target(PixelHint(10.0, 10.0, up), scene(), PLACE)


class _Unsure:
    name = "unsure"

    def understands(self, hint: Hint) -> bool:
        return True

    def locate(self, hint: Hint, scene: SegmentedMap) -> Target:
        raise AffordanceError("cannot tell.", field="target")


def test_the_next_backend_is_queried_and_the_target_names_its_backend() -> None:
    found = find_target(NameHint("red box"), scene(), [_Unsure(), LanguageAffordance()])
    assert found.backend == "rules"
    assert any("unsure: target: cannot tell." in note for note in found.notes)


def test_without_a_target_the_error_of_every_backend_is_quoted() -> None:
    with pytest.raises(AffordanceError, match=r"unsure: .*cannot tell.*\| rules: "):
        find_target(NameHint("flying saucer"), scene(), [_Unsure(), LanguageAffordance()])
    with pytest.raises(AffordanceError, match="none of 1 backends understands"):
        find_target(NameHint("box"), scene(), PLACE)
