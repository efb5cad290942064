"""Fields of a map that changes, against newly built fields."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.robots.panda import panda
from tests.unit.collision.oracle import Array, gaussians, random_gaussians


def _same(updated: GaussianCollisionField, fresh: GaussianCollisionField, points: Array) -> None:
    """Check that the results are bit-identical, rows included."""
    spheres = np.c_[points, np.full(len(points), 0.03)]
    np.testing.assert_array_equal(updated.in_collision(spheres), fresh.in_collision(spheres))
    a, b = updated.clearance(points), fresh.clearance(points)
    np.testing.assert_array_equal(a.distance, b.distance)
    np.testing.assert_array_equal(a.index, b.index)
    m, n = updated.mahalanobis(points), fresh.mahalanobis(points)
    np.testing.assert_array_equal(m.distance, n.distance)
    np.testing.assert_array_equal(m.index, n.index)
    assert len(updated) == len(fresh)


def _bounds_hold(field: GaussianCollisionField, points: Array) -> None:
    bound = field.native.grid_bounds(points)
    assert (bound <= np.maximum(field.clearance(points).distance, 0)).all()


def test_insertion_removal_and_movement_give_the_answers_of_a_field_built_anew() -> None:
    rng = np.random.default_rng(0)
    model = random_gaussians(2000, rng, most=0.03)
    field = GaussianCollisionField(Snapshot(model, 1))
    points = rng.uniform(-1.2, 1.2, (3000, 3))
    for step in range(6):
        n = len(model)
        keep = np.flatnonzero(rng.random(n) > 0.05)
        added = random_gaussians(80, rng, most=0.03)
        later = GaussianModel.concatenate([model.select(torch.from_numpy(keep)), added])
        previous = np.concatenate([keep, np.full(80, -1)])
        changed = previous < 0
        moved = rng.choice(len(keep), 60, replace=False)
        later.means[moved] += torch.from_numpy(rng.normal(0, 0.2, (60, 3))).float()
        faded = rng.choice(len(keep), 30, replace=False)
        later.opacity_logits[faded] = torch.where(later.opacity_logits[faded] < 0, 2.0, -9.0)
        changed[moved] = changed[faded] = True
        field = field.updated(Snapshot(later, 2 + step), changed, previous=previous)
        assert field.map_version == 2 + step
        _same(field, GaussianCollisionField(later), points)
        _bounds_hold(field, points)
        model = later


def test_a_local_change_shares_the_other_blocks_and_leaves_the_earlier_field_as_it_was() -> None:
    model = tabletop().gaussians(20_000)
    before = GaussianCollisionField(model)
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 0.8, (500, 3))
    expected = before.clearance(points).distance
    box = gaussians(rng.uniform(0.3, 0.4, (200, 3)), 0.01)
    later = GaussianModel.concatenate([model, box])
    changed = np.arange(len(later)) >= len(model)
    after = before.updated(later, changed)
    np.testing.assert_array_equal(before.clearance(points).distance, expected)
    assert after.native.shared_bytes(before.native) > 0.9 * before.native.shared_bytes(before.native)
    _same(after, GaussianCollisionField(later), points)
    added = after.added_since(before)
    assert len(added) == 200
    assert len(before.added_since(after)) == 0
    assert added.clearance([[0.35, 0.35, 0.35]]).index[0] >= len(model)


def test_a_map_that_grows_beyond_its_grid_gets_a_new_one() -> None:
    rng = np.random.default_rng(2)
    model = random_gaussians(500, rng, most=0.02)
    field = GaussianCollisionField(model)
    far = random_gaussians(500, rng, most=0.02)
    far.means += 3.0
    later = GaussianModel.concatenate([model, far])
    grown = field.updated(later, np.arange(1000) >= 500)
    points = rng.uniform(-1, 4, (2000, 3))
    _same(grown, GaussianCollisionField(later), points)
    _bounds_hold(grown, points)
    assert (grown.native.grid_bounds(rng.uniform(2, 4, (2000, 3))) > 0).any()


def test_a_map_that_loses_everything_is_free_and_one_that_was_empty_fills_up() -> None:
    rng = np.random.default_rng(3)
    model = random_gaussians(100, rng)
    field = GaussianCollisionField(model)
    none = field.updated(GaussianModel.empty(), np.zeros(0, bool), previous=np.zeros(0, int))
    assert len(none) == 0
    assert not none.in_collision([[0.0, 0, 0, 5.0]]).any()
    again = none.updated(model, np.ones(100, bool))
    _same(again, field, rng.uniform(-1, 1, (200, 3)))


def test_a_path_is_asked_only_about_what_is_new() -> None:
    model = tabletop().gaussians(20_000)
    before = GaussianCollisionField(model)
    arm = RobotSpheres(panda())
    rng = np.random.default_rng(4)
    q = panda().random(4000, rng)
    start = q[~arm.check(before, q).in_collision][:600]
    end = start + 0.2 * rng.normal(size=start.shape)
    free = ~arm.certify(before, start, end).in_collision
    start, end = start[free], end[free]
    obstacle = gaussians(rng.normal([0.3, 0.3, 0.6], 0.05, (300, 3)), 0.01)
    later = GaussianModel.concatenate([model, obstacle])
    now = before.updated(later, np.arange(len(later)) >= len(model))
    still, anew = arm.still_free(before, now, start, end), arm.certify(now, start, end)
    np.testing.assert_array_equal(still.in_collision, anew.in_collision)
    assert 0 < still.in_collision.mean() < 0.9
    assert not arm.still_free(now, before, start, end).in_collision.any()  # removed Gaussians block no path


@pytest.mark.parametrize(
    ("changed", "previous", "message"),
    [
        (np.zeros(4, bool), None, r"changed: is bool \(4,\)"),
        (np.zeros(5), None, "changed: is float64"),
        (np.zeros(5, bool), [0, 1, 2, 3, 5], "previous"),
        (np.zeros(5, bool), [0, 1, 2, 3, 3], "twice"),
    ],
)
def test_a_delta_that_does_not_fit_is_refused(changed: Array, previous: list[int] | None, message: str) -> None:
    model = random_gaussians(5, np.random.default_rng(0))
    with pytest.raises(InputError, match=message):
        GaussianCollisionField(model).updated(model, changed, previous=previous)


def test_a_damaged_gaussian_in_a_delta_is_named() -> None:
    model = random_gaussians(10, np.random.default_rng(0))
    field = GaussianCollisionField(model)
    later = model.clone()
    later.means[7] = torch.nan
    with pytest.raises(InputError, match="means: row 7"):
        field.updated(later, np.arange(10) == 7)
