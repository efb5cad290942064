"""Segmentation of a map into supports and objects."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.bench.tabletop import Block, Can, Tabletop
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import pose_from_quat
from splatbot.grasping.obstacles import around_target
from splatbot.segmentation import clusters, segment
from splatbot.segmentation.faces import split_at_steps
from splatbot.workspace import NamedPlace

TABLE = Block((0.5, 0.0, -0.02), (0.7, 0.9, 0.04))
BOX = Block((0.45, 0.15, 0.05), (0.10, 0.06, 0.10), 0.4)
CAN = Can((0.55, -0.15, 0.0), 0.03, 0.08)


def _map(*solids: Block | Can, count: int = 20_000) -> GaussianModel:
    return Tabletop((TABLE, *solids)).gaussians(count)


def test_objects_on_a_table_are_separated_with_their_sizes() -> None:
    found = segment(_map(BOX, CAN), np.eye(4))
    assert found.support is not None
    assert abs(found.support.offset) < 1e-3
    assert len(found.objects) == 2
    box, can = found.objects
    np.testing.assert_allclose(sorted(box.size), sorted(BOX.size), atol=5e-3)
    np.testing.assert_allclose(can.size, [0.06, 0.06, 0.08], atol=6e-3)
    assert (found.labels[box.rows] == 0).all()
    assert (found.labels == -2).sum() > 5000


def test_a_map_in_another_frame_gives_the_same_objects() -> None:
    T = pose_from_quat([0.3, -0.2, 1.0], [0.6, -0.3, 0.2, 0.7])
    model = _map(BOX, CAN)
    moved = model.clone()
    import torch

    moved.means = (model.means.double() @ torch.from_numpy(T[:3, :3].T) + torch.from_numpy(T[:3, 3])).float()
    here, there = segment(model, np.eye(4)), segment(moved, T)
    assert [len(o.rows) for o in here.objects] == [len(o.rows) for o in there.objects]
    np.testing.assert_allclose(there.up, T[:3, 2], atol=1e-9)


def test_an_object_on_a_stool_is_separated_and_the_stool_is_a_support() -> None:
    stool = Can((0.5, 0.0, 0.0), 0.16, 0.20)
    cup = Can((0.5, 0.05, 0.20), 0.03, 0.08)
    found = segment(_map(stool, cup, count=30_000), np.eye(4))
    assert len(found.supports) == 2
    assert found.supports[1].offset == pytest.approx(0.20, abs=2e-3)
    cups = [o for o in found.objects if abs(o.center[2] - 0.24) < 0.01]
    assert len(cups) == 1
    np.testing.assert_allclose(cups[0].size[:2], 0.06, atol=6e-3)
    assert found.under(found.points[cups[0].rows]) is found.supports[1]


def _steps(count: int) -> np.ndarray:
    """Sample two plates of ``count`` points each, one 3 cm above the other, and the step between them."""
    rng = np.random.default_rng(0)
    low = np.c_[rng.uniform(0.0, 0.1, count), rng.uniform(0, 0.1, count), rng.normal(0.05, 3e-4, count)]
    high = np.c_[rng.uniform(0.1, 0.2, count), rng.uniform(0, 0.1, count), rng.normal(0.08, 3e-4, count)]
    edge = np.c_[np.full(count // 10, 0.1), rng.uniform(0, 0.1, count // 10), rng.uniform(0.05, 0.08, count // 10)]
    return np.concatenate([low, high, edge])


def test_two_boxes_that_touch_are_cut_at_their_step() -> None:
    parts = split_at_steps(_steps(600), fewest=40)
    assert len(parts) == 2
    sides = [rows < 600 for rows in parts]
    assert {round(float(side.mean())) for side in sides} == {0, 1}


def test_points_too_sparse_for_normals_are_not_split() -> None:
    (whole,) = split_at_steps(_steps(100), fewest=20)
    assert len(whole) == 210


def test_a_mallet_is_one_object_without_splitting() -> None:
    handle = Block((0.5, 0.0, 0.025), (0.18, 0.026, 0.026))
    head, knob = Block((0.6, 0.0, 0.025), (0.035, 0.07, 0.05)), Block((0.4, 0.0, 0.025), (0.02, 0.05, 0.05))
    top = Block((0.5, 0.0, -0.02), (0.7, 0.9, 0.04))
    model = Tabletop((top, handle, head, knob)).gaussians(30_000)
    assert len(segment(model, np.eye(4)).objects) > 1  # split at the step from its handle to its knob
    found = segment(model, np.eye(4), cut=False)
    assert len(found.supports) == 1
    (whole,) = found.objects
    np.testing.assert_allclose(np.sort(whole.size), [0.05, 0.07, 0.2275], atol=0.01)


def test_a_box_seen_from_three_sides_stays_whole() -> None:
    points = Tabletop((BOX,)).gaussians(3000).means.double().numpy()
    assert len(split_at_steps(points[points[:, 2] > 1e-3], fewest=40)) == 1


def test_names_go_to_the_objects_at_their_places() -> None:
    names = (NamedPlace("tin", np.array([0.55, -0.15, 0.08]), ("can",)), NamedPlace("ghost", np.array([0.0, 0.0, 2.0])))
    found = segment(_map(BOX, CAN), np.eye(4), names=names)
    assert [o.name for o in found.objects] == ["", "tin"]
    assert found.objects[1].aliases == ("can",)


def test_faint_gaussians_around_an_object_belong_to_it() -> None:
    model = _map(BOX, CAN, count=60_000)
    on_can = np.flatnonzero(np.abs(CAN.distance(model.means.double().numpy())) < 1e-3)[::3]
    model.opacity_logits[on_can] = -3.0
    found = segment(model, np.eye(4))
    high = on_can[model.means[on_can, 2].numpy() > 0.01]
    assert (found.labels[high] == found.labels[high[0]]).mean() > 0.95


def test_a_support_of_blobs_is_flat_for_the_hand_and_the_target_is_left_out() -> None:
    model = _map(BOX, CAN)
    flat = np.flatnonzero((model.means[:, 2].abs() < 1e-4).numpy())
    model.log_scales[flat] = float(np.log(0.008))
    found = segment(model, np.eye(4))
    around = around_target(found, found.objects[0].rows)
    assert len(around) == len(model) - len(found.objects[0].rows)
    table = (around.means[:, 2].abs() < 1e-3) & (around.means[:, 0] < 0.84)
    assert float(around.scales[table].amin(dim=1).max()) <= 1.01e-3


def test_an_empty_part_of_the_map_is_refused() -> None:
    with pytest.raises(InputError, match="has nothing between"):
        segment(_map(BOX), np.eye(4), box=[[5, 5, 5], [6, 6, 6]])


def test_no_points_are_no_clusters() -> None:
    assert clusters(np.zeros((0, 3))) == []
