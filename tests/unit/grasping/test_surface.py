"""What nobody saw of a thing: how deep it is taken to be."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.bench.tabletop import Block, Can
from splatbot.camera import Camera
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import shortest_axes
from splatbot.geometry import look_at
from splatbot.grasping.surface import Surface, target_surface
from splatbot.segmentation import segment
from tests.unit.grasping.things import colored

EYE = np.array([-0.4, 0.0, 0.06])
BLOCK = Block((0.5, 0.0, 0.06), (0.10, 0.06, 0.12))


def _front(solid: Block | Can, noise: float) -> tuple[GaussianModel, np.ndarray]:
    """A table and what a camera at EYE sees of a solid, its top left out; off by ``noise`` [m] along the view."""
    full = colored({"it": solid}, 40_000, {})
    points, normals = full.means.double().numpy(), shortest_axes(full).double().numpy()
    own = (np.abs(solid.distance(points)) < 1e-4) & (points[:, 2] > 2e-3)
    outward = normals * np.sign(np.einsum("ij,ij->i", normals, points - [0.5, 0.0, 0.06]))[:, None]
    front = own & (np.abs(normals[:, 2]) < 0.5) & (np.einsum("ij,ij->i", outward, EYE - points) > 0)
    model = full.select(torch.from_numpy(np.flatnonzero(front | (np.abs(points[:, 2]) < 1e-3))))
    rows = np.flatnonzero(model.means[:, 2].numpy() > 2e-3)
    model.means[rows, 0] += torch.from_numpy(np.random.default_rng(0).normal(0, noise, len(rows))).float()
    return model, rows


def _surface(model: GaussianModel, rows: np.ndarray, **options: object) -> Surface:
    scene = segment(model, np.eye(4))
    return target_surface(scene, rows, observers=np.tile(EYE, (len(model), 1)), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_a_flat_front_alone_is_taken_to_be_as_deep_as_it_is_narrow_noisy_or_not(noise: float) -> None:
    found = _surface(*_front(BLOCK, noise))
    back = found.points[~found.seen & (found.normals[:, 0] > 0.9)]
    assert len(back) > 100
    depth = np.median(back[:, 0]) - (BLOCK.center[0] - BLOCK.size[0] / 2)
    assert depth == pytest.approx(BLOCK.size[1], abs=0.012)


def test_a_round_front_has_its_mirror_image_behind_it() -> None:
    can = Can((0.5, 0.0, 0.0), 0.03, 0.12)
    found = _surface(*_front(can, 0.001))
    back = found.points[~found.seen & (found.normals[:, 0] > 0.6)]
    assert len(back) > 100
    assert np.percentile(back[:, 0], 95) == pytest.approx(0.53, abs=0.008)


def test_no_back_is_implied_where_depth_was_measured_behind_it() -> None:
    model, rows = _front(BLOCK, 0.0)
    camera = Camera(500, 500, 160, 120, 321, 241)
    aside = look_at(np.array([0.53, 0.6, 0.06]), np.array([0.53, 0.0, 0.06]))  # sees all but the first centimetres
    views = [(np.full((241, 321), 2.0, np.float32), camera, aside)] * 2
    free, full = _surface(model, rows, views=views), _surface(model, rows)
    assert (~full.seen & (full.points[:, 0] > 0.50)).sum() > 100
    assert not (~free.seen & (free.points[:, 0] > 0.50)).any()
