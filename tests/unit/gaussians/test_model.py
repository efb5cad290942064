"""GaussianModel: physical units in and out, and its errors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.harmonics import rgb_to_sh, sh_to_rgb


def arrays(n: int = 6, seed: int = 0) -> dict[str, Any]:
    r = np.random.default_rng(seed)
    return {
        "means": r.normal(size=(n, 3)),
        "quats": r.normal(size=(n, 4)),
        "scales": r.uniform(0.001, 0.1, (n, 3)),
        "opacities": r.uniform(0.01, 0.99, n),
        "colors": r.uniform(0, 1, (n, 3)),
    }


def test_physical_units_come_back_as_given() -> None:
    given = arrays()
    model = GaussianModel.from_activated(**given)
    assert len(model) == 6
    assert model.sh_degree == 0
    for name in ("means", "quats", "scales", "opacities", "colors"):
        np.testing.assert_allclose(getattr(model, name).numpy(), given[name], rtol=2e-6, atol=1e-7)
    assert all(t.dtype == torch.float32 for t in (model.means, model.sh, model.opacity_logits))
    assert (model.observations == 1).all()
    assert (model.anchors == -1).all()


def test_opacity_of_zero_and_one_and_scale_of_zero_have_finite_parameters() -> None:
    given = arrays(2) | {"opacities": [0.0, 1.0], "scales": np.zeros((2, 3))}
    model = GaussianModel.from_activated(**given)
    assert torch.isfinite(model.opacity_logits).all()
    assert torch.isfinite(model.log_scales).all()
    assert model.opacities.tolist() == pytest.approx([0, 1], abs=2e-6)


def test_the_input_is_copied_not_shared() -> None:
    means = torch.zeros(6, 3)
    model = GaussianModel.from_activated(**arrays() | {"means": means})
    means += 1
    assert not model.means.any()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"means": np.full((6, 3), np.nan)}, "means"),
        ({"quats": np.zeros((6, 4))}, "quats"),
        ({"scales": np.full((6, 3), -0.1)}, "scales"),
        ({"opacities": np.full(6, 1.5)}, "opacities"),
        ({"colors": np.full((6, 3), 255.0)}, "colors"),
        ({"quats": np.ones((5, 4))}, "quats"),
        ({"scales": np.ones((6, 2))}, "log_scales"),
        ({"opacities": np.full((6, 1), 0.5)}, "opacity_logits"),
    ],
)
def test_values_that_make_no_gaussian_are_named(change: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as caught:
        GaussianModel.from_activated(**arrays() | change)
    assert caught.value.field == field


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_an_empty_model_has_the_asked_degree(degree: int) -> None:
    model = GaussianModel.empty(degree)
    assert (len(model), model.sh_degree, model.nbytes) == (0, degree, 0)


def test_harmonics_of_no_known_degree_are_refused() -> None:
    model = GaussianModel.from_activated(**arrays())
    with pytest.raises(InputError) as caught:
        GaussianModel(
            means=model.means,
            quats=model.quats,
            log_scales=model.log_scales,
            opacity_logits=model.opacity_logits,
            sh=torch.zeros(6, 3, 3),
            observations=model.observations,
            anchors=model.anchors,
        )
    assert caught.value.field == "sh"


def test_models_of_several_degrees_are_joined_with_zeros_for_the_missing_harmonics() -> None:
    flat = GaussianModel.from_activated(
        means=np.zeros((2, 3)), quats=np.eye(4)[:2], scales=np.ones((2, 3)), opacities=[0.5, 0.6], colors=np.eye(3)[:2]
    )
    rich = replace(flat, sh=torch.arange(2 * 9 * 3, dtype=torch.float32).reshape(2, 9, 3))
    joined = GaussianModel.concatenate([flat, rich, GaussianModel.empty(1)])
    assert (len(joined), joined.sh_degree) == (4, 2)
    torch.testing.assert_close(joined.sh[:2, :1], flat.sh)
    assert not joined.sh[:2, 1:].any()
    torch.testing.assert_close(joined.sh[2:], rich.sh)


def test_select_and_concatenate_are_inverse() -> None:
    model = GaussianModel.from_activated(**arrays())
    mask = torch.tensor([True, False, True, True, False, False])
    parts = GaussianModel.concatenate([model.select(mask), model.select(~mask)])
    assert torch.equal(parts.means, torch.cat([model.means[mask], model.means[~mask]]))
    assert len(model.select(torch.tensor([3, 3, 0]))) == 3


def test_clones_and_selections_share_no_memory() -> None:
    model = GaussianModel.from_activated(**arrays())
    before = model.means.clone()
    model.clone().means.zero_()
    model.select(torch.ones(6, dtype=torch.bool)).means.zero_()
    assert torch.equal(model.means, before)


def test_bytes_are_those_of_all_arrays() -> None:
    assert GaussianModel.from_activated(**arrays(10)).nbytes == 10 * 4 * (3 + 4 + 3 + 1 + 3 + 4)


def test_grey_has_no_dc_coefficient_and_colours_come_back() -> None:
    assert not rgb_to_sh(torch.full((1, 3), 0.5)).any()
    colors = torch.rand(20, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(sh_to_rgb(rgb_to_sh(colors)), colors, atol=1e-6, rtol=0)
    assert rgb_to_sh(torch.ones(1)).item() == pytest.approx(np.sqrt(np.pi))  # 0.5 / (1 / (2 √π))
