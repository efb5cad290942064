"""Packed fields, against the ellipsoids that they were packed from."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from splatbot._native import available_isas, set_isa
from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.robots.panda import panda
from tests.unit.collision.oracle import Array, gaussians, local, random_gaussians, separation, signed_distances

FAR = np.array([900.0, -300.0, 20.0])  # [m]
STEADY, SHARE = 5e-5, 0.026  # [m] and of the longest semi-axis: largest reduction of a distance by packing


@pytest.fixture(params=available_isas())
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each instruction set that this CPU runs."""
    set_isa(request.param)
    yield request.param
    set_isa("")


def _mixture(n: int, rng: np.random.Generator) -> GaussianModel:
    """Return discs, needles and balls of 0.1 mm to 6 cm, some too large to be packed, some far from the origin.

    Some quaternions have four equal components, which is the worst case for leaving one out.
    """
    model = random_gaussians(n, rng, least=5e-5, most=0.03)
    model.log_scales[: n // 20] += 2.5
    model.means[n // 20 : n // 10] += torch.from_numpy(FAR).float()
    model.quats[n // 10 : n // 5] = torch.from_numpy(
        rng.choice([-0.5, 0.5], (n // 10, 4)) + rng.normal(0, 2e-3, (n // 10, 4))
    )
    return model


@pytest.mark.long
def test_packed_distances_never_exceed_those_of_the_ellipsoids_and_stay_within_the_stated_share(isa: str) -> None:
    rng = np.random.default_rng(0)
    model = _mixture(400, rng)
    points = np.concatenate([rng.uniform(-1.1, 1.1, (300, 3)), rng.uniform(-1, 1, (100, 3)) + FAR])
    found = GaussianCollisionField(model, packed=True).clearance(points).distance
    v, a = local(model, 2.0, points)
    truth = signed_distances(v, a)
    assert (found <= truth.min(axis=1)).all()
    # A packed Gaussian may be the nearest where another one is: its reduction is at most that of some Gaussian.
    slack = STEADY + SHARE * np.minimum(a.max(axis=1), 0.125) + 4e-6 * np.abs(v).sum(axis=-1)
    assert (found >= (truth - slack).min(axis=1)).all()


def test_packed_hits_are_never_unsafe_against_splat_navs_separation() -> None:
    rng = np.random.default_rng(1)
    unsafe = hits = 0
    for _ in range(60):  # one ellipsoid a field: every pair is decided by itself
        scales = np.exp(rng.uniform(np.log(5e-5), np.log(0.05), 3))
        quat = rng.normal(size=4) if rng.random() < 0.5 else rng.choice([-0.5, 0.5], 4) + rng.normal(0, 1e-3, 4)
        model = gaussians(rng.uniform(-3, 3, 3), scales, quat[None])
        direction = rng.normal(size=(1500, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        radii = rng.uniform(1e-4, 0.1, 1500)
        points = model.means.numpy() + direction * (radii + 2 * scales.max() * rng.uniform(0, 1.3, 1500))[:, None]
        hit = GaussianCollisionField(model, packed=True).in_collision(np.c_[points, radii])
        v, a = (x[..., 0, :] for x in np.broadcast_arrays(*local(model, 2.0, points)))
        unsafe += int((~hit & (separation(v, a, radii) <= 1)).sum())
        hits += int(hit.sum())
    assert unsafe == 0
    assert 10_000 < hits < 80_000


def test_the_grids_bound_of_a_packed_field_never_exceeds_the_distance() -> None:
    rng = np.random.default_rng(2)
    model = random_gaussians(400, rng, most=0.02)
    points = rng.uniform(-1.4, 1.4, (50_000, 3))
    bound = GaussianCollisionField(model, packed=True).native.grid_bounds(points)
    assert (bound <= np.maximum(GaussianCollisionField(model).clearance(points, cut=0.5).distance, 0)).all()
    assert (bound > 0.02).mean() > 0.05


def test_packed_fields_of_a_changing_map_give_the_answers_of_ones_built_anew() -> None:
    rng = np.random.default_rng(3)
    model = _mixture(1500, rng)
    field = GaussianCollisionField(Snapshot(model, 1), packed=True)
    points = rng.uniform(-1.2, 1.2, (2000, 3))
    for step in range(5):
        keep = np.flatnonzero(rng.random(len(model)) > 0.05)
        later = GaussianModel.concatenate([model.select(torch.from_numpy(keep)), random_gaussians(80, rng, most=0.03)])
        previous = np.concatenate([keep, np.full(80, -1)])
        changed = previous < 0
        moved = rng.choice(len(keep), 60, replace=False)
        later.means[moved] += torch.from_numpy(rng.normal(0, 0.2, (60, 3))).float()
        changed[moved] = True
        field = field.updated(Snapshot(later, 2 + step), changed, previous=previous)
        fresh = GaussianCollisionField(later, packed=True)
        a, b = field.clearance(points), fresh.clearance(points)
        np.testing.assert_array_equal(a.distance, b.distance)
        np.testing.assert_array_equal(a.index, b.index)
        assert (field.native.grid_bounds(points) <= np.maximum(a.distance + STEADY + SHARE * 0.125, 0)).all()
        assert len(field) == len(fresh)
        model = later


def test_a_packed_field_tells_what_is_new_since_an_earlier_one() -> None:
    rng = np.random.default_rng(4)
    model = tabletop().gaussians(5000)
    before = GaussianCollisionField(model, packed=True)
    later = GaussianModel.concatenate([model, gaussians(rng.uniform(0.3, 0.4, (50, 3)), 0.01)])
    now = before.updated(later, np.arange(len(later)) >= len(model))
    assert len(now.added_since(before)) == 50
    with pytest.raises(InputError, match="packed"):
        now.added_since(GaussianCollisionField(model))


def test_two_hundred_thousand_packed_gaussians_and_their_index_take_five_megabytes() -> None:
    model = tabletop().gaussians(200_000)
    field = GaussianCollisionField(model, packed=True)
    assert len(field) >= 199_000
    assert field.nbytes <= 5_000_000
    assert GaussianCollisionField(model).nbytes <= 16_000_000


def test_an_arm_is_free_of_a_packed_map_only_where_it_is_free_of_the_map() -> None:
    model = tabletop().gaussians(20_000)
    whole, packed = GaussianCollisionField(model), GaussianCollisionField(model, packed=True)
    arm = RobotSpheres(panda())
    q = panda().random(20_000, np.random.default_rng(5))
    exact, found = arm.check(whole, q).in_collision, arm.check(packed, q).in_collision
    assert not (exact & ~found).any()
    assert (found & ~exact).mean() < 2e-3
    start, end = q[:-1:20], q[1::20]
    certified = arm.certify(packed, start, end).in_collision
    assert not (arm.sample(whole, start, end, samples=65).in_collision & ~certified).any()


@pytest.mark.parametrize("n_sigma", [0.01, 0.5, 3.0])
def test_packing_is_safe_at_any_n_sigma(n_sigma: float) -> None:
    rng = np.random.default_rng(6)
    model = _mixture(100, rng)
    points: Array = rng.uniform(-1.1, 1.1, (300, 3))
    found = GaussianCollisionField(model, n_sigma, packed=True).clearance(points).distance
    assert (found <= signed_distances(*local(model, n_sigma, points)).min(axis=1)).all()
