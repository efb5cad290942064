"""Objects that are hard to grasp: a grasp, or a stated reason."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.bench.tabletop import Block, Can, Solid
from splatbot.gaussians import GaussianModel
from splatbot.grasping.affordance import Target
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import GraspResult, NoGraspError
from splatbot.robots.panda import panda
from splatbot.segmentation import segment
from tests.unit.grasping.objects import colored

COUNT = 60_000


def _grasp(solid: Solid, *, without: np.ndarray | None = None) -> tuple[GraspResult, Target]:
    model = colored({"it": solid}, COUNT, {})
    if without is not None:
        model = model.select(torch.from_numpy(np.flatnonzero(~without[: len(model)])))
    return _of(model, solid)


def _of(model: GaussianModel, solid: Solid) -> tuple[GraspResult, Target]:
    scene = segment(model, np.eye(4))
    points = model.means.double().numpy()
    own = np.flatnonzero((np.abs(solid.distance(points)) < 3e-3) & (points[:, 2] > 2e-3))
    target = Target(own, None, "it", "test", 1.0)
    return GraspSampler(scene, panda()).sample(target, GraspOptions(samples=400)), target


def _sound(result: GraspResult, solid: Solid) -> None:
    """Check that each grasp is on the object and fits the hand; without a grasp, that the reasons are counted."""
    for g in result.grasps:
        assert np.abs(solid.distance(g.contacts)).max() < 3e-3
        assert g.width <= g.opening <= 0.08
        assert np.isfinite(g.total)
    if not result.grasps:
        assert sum(result.rejected.values()) > 0
        with pytest.raises(NoGraspError, match=r"cannot be grasped: .*\d+ (hands|pairs|closing)"):
            result.unwrap()


def test_a_flat_tile_is_taken_across_or_refused_with_counts() -> None:
    tile = Block((0.45, 0.0, 0.006), (0.08, 0.05, 0.012))
    result, _ = _grasp(tile)
    _sound(result, tile)


def test_a_card_of_a_millimetre_that_stands_is_pinched_at_its_thickness() -> None:
    card = Block((0.45, 0.0, 0.05), (0.10, 0.001, 0.10))
    result, _ = _grasp(card)
    _sound(result, card)
    assert result.unwrap().width < 4e-3


def test_a_bottle_with_a_transparent_band_is_held_where_it_was_seen() -> None:
    """No Gaussians at all in the middle third of its height."""
    can = Can((0.45, 0.0, 0.0), 0.03, 0.15)
    model = colored({"it": can}, COUNT, {})
    z, r = model.means[:, 2].numpy(), np.hypot(model.means[:, 0].numpy() - 0.45, model.means[:, 1].numpy())
    result, _ = _grasp(can, without=(r < 0.031) & (z > 0.05) & (z < 0.10))
    _sound(result, can)
    assert result.grasps


def test_a_screw_of_a_centimetre_is_taken_or_refused_with_counts() -> None:
    screw = Can((0.45, 0.0, 0.0), 0.004, 0.012)
    result, target = _grasp(screw)
    assert len(target.rows) < 100
    _sound(result, screw)


@pytest.mark.parametrize("size", [0.09, 0.30])
def test_what_is_larger_than_the_hand_is_refused_with_its_width(size: float) -> None:
    cube = Block((0.55, 0.0, size / 2), (size, size, size))
    result, _ = _grasp(cube)
    assert not result.grasps
    told = rf"{1e3 * size:.0f} mm apart" if size < 0.2 else r"farther apart than the hand opens"
    with pytest.raises(NoGraspError, match=rf"{told}.*and the hand opens 80 mm"):
        result.unwrap()


def test_a_single_gaussian_is_no_surface_and_is_refused() -> None:
    block = Block((0.45, 0.0, 0.05), (0.05, 0.05, 0.10))
    model = colored({"it": block}, 20_000, {})
    scene = segment(model, np.eye(4))
    one = Target(scene.objects[0].rows[:1], None, "speck", "test", 1.0)
    result = GraspSampler(scene, panda()).sample(one)
    assert not result.grasps
    with pytest.raises(NoGraspError, match="speck: cannot be grasped"):
        result.unwrap()


def test_gaussians_of_no_thickness_and_of_a_metre_do_not_break_the_search() -> None:
    block = Block((0.45, 0.0, 0.05), (0.05, 0.05, 0.10))
    model = colored({"it": block}, 20_000, {})
    points = model.means.double().numpy()
    own = np.flatnonzero((np.abs(block.distance(points)) < 1e-4) & (points[:, 2] > 2e-3))
    model.log_scales[own[::7], 2] = -20.0
    model.log_scales[own[3], 0] = 0.0
    result, _ = _of(model, block)
    _sound(result, block)
    for g in result.grasps:
        assert all(np.isfinite(value) for value in g.terms.values())
