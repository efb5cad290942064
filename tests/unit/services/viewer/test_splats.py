"""A map in pieces for a browser."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import look_at, quat_to_rotation
from splatbot.services.viewer.splats import COLORINGS, Splats, colors, pieces


def _model(rng: np.random.Generator, n: int = 2000, size: float = 1.0) -> GaussianModel:
    return GaussianModel.from_activated(
        means=rng.uniform(-size, size, (n, 3)),
        quats=rng.normal(size=(n, 4)),
        scales=rng.uniform(0.002, 0.05, (n, 3)),
        opacities=rng.uniform(0.1, 0.9, n),
        colors=rng.uniform(0, 1, (n, 3)),
    )


def test_the_pieces_hold_every_gaussian_once_where_it_is(rng: np.random.Generator) -> None:
    model = _model(rng)
    found = pieces(model)
    assert len(found) > 30
    for key, splats in found.items():
        assert (np.floor(splats.centers / 0.5) == key).all()
    whole = np.concatenate([s.centers for s in found.values()])
    np.testing.assert_array_equal(whole[np.lexsort(whole.T)], model.means.numpy()[np.lexsort(model.means.numpy().T)])


def test_covariances_are_those_of_the_gaussians(rng: np.random.Generator) -> None:
    model = _model(rng, 1)
    (splats,) = pieces(model).values()
    R = quat_to_rotation(model.quats[0].numpy())
    expected = R @ np.diag(model.scales[0].numpy().astype(float) ** 2) @ R.T
    np.testing.assert_allclose(splats.covariances[0], expected, atol=2e-7)
    np.testing.assert_allclose(splats.opacities[0], model.opacities[0])


def test_only_the_piece_in_which_something_changed_differs(rng: np.random.Generator) -> None:
    model = _model(rng)
    before = {key: splats.digest for key, splats in pieces(model).items()}
    moved = model.clone()
    moved.opacity_logits[17] += 0.5
    after = {key: splats.digest for key, splats in pieces(moved).items()}
    changed = {key for key in before if before[key] != after[key]}
    assert changed == {tuple(np.floor(model.means[17].numpy() / 0.5).astype(int).tolist())}


def test_a_wide_map_has_no_more_pieces_than_a_browser_bears(rng: np.random.Generator) -> None:
    assert 32 < len(pieces(_model(rng, 5000, size=50.0))) <= 256


def test_the_thinnest_gaussian_survives_16_bit_floats() -> None:
    flat = GaussianModel.from_activated(
        means=[[0, 0, 0.0]], quats=[[1, 0, 0, 0.0]], scales=[[0.01, 0.01, 1e-6]], opacities=[0.5], colors=[[1, 1, 1.0]]
    )
    (splats,) = pieces(flat).values()
    assert np.linalg.eigvalsh(splats.covariances.astype(np.float16)[0].astype(float)).min() > 0


def test_surfels_of_all_sizes_stay_discs_in_16_bit_floats(rng: np.random.Generator) -> None:
    sizes = np.geomspace(1e-3, 3.0, 500)[:, None] * rng.uniform(0.2, 1.0, (500, 2))
    model = GaussianModel.from_activated(
        means=np.zeros((500, 3)),
        quats=rng.normal(size=(500, 4)),
        scales=np.column_stack([sizes, np.full(500, 1e-9)]),
        opacities=np.full(500, 0.5),
        colors=np.ones((500, 3)),
    )
    (found,) = pieces(model).values()
    drawn = np.linalg.eigvalsh(found.covariances.astype(np.float16).astype(float))
    longest = sizes.max(1)
    assert drawn[:, 0].min() > 0  # viser's shader leaves out others
    assert (np.sqrt(drawn[:, 0]) < 0.04 * longest + 5e-4).all()
    np.testing.assert_allclose(np.sqrt(drawn[:, 2]), longest, rtol=2e-3, atol=3e-4)


@pytest.mark.parametrize("coloring", COLORINGS)
def test_every_colouring_gives_colours(coloring: str, rng: np.random.Generator) -> None:
    model = _model(rng, 50)
    model.uncertainty = torch.rand(50)
    rgb = colors(model, coloring)  # type: ignore[arg-type]
    assert rgb.shape == (50, 3)
    assert (rgb >= 0).all()
    assert (rgb <= 1).all()
    assert rgb.std(0).min() > 0.01


def test_depth_is_red_near_the_camera_and_blue_far_from_it(rng: np.random.Generator) -> None:
    model = _model(rng, 500)
    T = look_at(np.array([0.0, -5.0, 0.1]), np.zeros(3))
    rgb = colors(model, "depth", T_world_camera=T)
    depth = model.means.numpy()[:, 1]
    near, far = rgb[np.argmin(depth)], rgb[np.argmax(depth)]
    assert near[0] > near[2]
    assert far[2] > far[0]


def test_nothing_is_drawn_of_nothing_and_an_unknown_colouring_is_refused() -> None:
    assert pieces(GaussianModel.empty()) == {}
    with pytest.raises(InputError, match="rgb, depth"):
        colors(GaussianModel.empty(), "pink")  # type: ignore[arg-type]
    assert isinstance(Splats(*(np.zeros((0, 3), np.float32),) * 4).digest, bytes)
