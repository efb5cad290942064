"""Conventions of formats: half turns, rotations of harmonics, logits, and refused values."""

from __future__ import annotations

import itertools
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatbot.errors import FormatError, InputError
from splatbot.formats.conventions import (
    LUF,
    RUB,
    SplatArrays,
    from_channel_major,
    logit,
    model_of,
    move,
    rotate_harmonics,
    sigmoid,
    splats_of,
    to_channel_major,
    to_wxyz,
    to_xyzw,
    turn,
    warn_limited,
)
from splatbot.geometry import quat_to_rotation, so3_exp
from splatbot.rasterize.harmonics import harmonics_basis
from tests.unit.formats.models import ROUNDING, detailed_model

SIGNS = list(itertools.product((1, -1), repeat=3))


def splats(degree: int = 4, n: int = 20) -> SplatArrays:
    return splats_of(detailed_model(n, degree), "map", max_sh_degree=4)


def colors(arrays: SplatArrays, directions: np.ndarray) -> np.ndarray:
    """Return colours (N, D, 3) towards directions (D, 3), by harmonics that are independent of the formats."""
    basis = harmonics_basis(torch.from_numpy(directions), round(arrays.sh.shape[1] ** 0.5) - 1).numpy()
    return np.einsum("dk,nkc->ndc", basis, arrays.sh)


def covariances(arrays: SplatArrays) -> np.ndarray:
    R = quat_to_rotation(arrays.quats)
    return R * np.exp(2 * arrays.log_scales.astype(np.float64))[:, None] @ R.transpose(0, 2, 1)


@pytest.fixture
def directions(rng: np.random.Generator) -> np.ndarray:
    values = rng.normal(size=(50, 3))
    return values / np.linalg.norm(values, axis=1, keepdims=True)


@pytest.mark.parametrize("signs", SIGNS)
def test_a_turn_moves_means_shapes_and_colours_alike(signs: tuple[int, int, int], directions: np.ndarray) -> None:
    before, S = splats(), np.diag(signs).astype(np.float64)
    after = turn(before, signs)
    assert np.array_equal(after.means, before.means @ S.astype(np.float32))
    assert np.allclose(covariances(after), S @ covariances(before) @ S, atol=1e-9)
    assert np.allclose(colors(after, directions @ S), colors(before, directions), atol=ROUNDING)


@pytest.mark.parametrize("signs", [RUB, LUF])
def test_the_turns_of_formats_are_rotations_and_their_own_inverse(signs: tuple[int, int, int]) -> None:
    assert np.prod(signs) == 1
    before = splats()
    after = turn(turn(before, signs), signs)
    assert all(np.array_equal(a, b) for a, b in zip(after, before, strict=True))
    rotated = rotate_harmonics(before.sh, np.diag(signs).astype(np.float64))
    assert np.allclose(rotated, turn(before, signs).sh, atol=ROUNDING)


def test_a_move_takes_means_shapes_and_colours_along(directions: np.ndarray) -> None:
    before = splats()
    R, t, scale = so3_exp([0.3, -1.1, 0.7]), np.array([1.0, -2.0, 0.5]), 2.5
    after = move(before, R, t, scale)
    assert np.allclose(after.means, scale * before.means @ R.T + t, atol=5 * ROUNDING)
    assert np.allclose(covariances(after), scale**2 * R @ covariances(before) @ R.T, rtol=1e-5, atol=1e-9)
    assert np.allclose(colors(after, directions @ R.T), colors(before, directions), atol=5 * ROUNDING)


def test_logits_of_opacities_invert_and_stay_finite() -> None:
    opacities = np.linspace(0, 1, 256)
    logits = logit(opacities)
    assert np.isfinite(logits).all()
    assert np.abs(sigmoid(logits.astype(np.float32)) - opacities).max() <= 1.1e-6  # the bound of opacities in maps
    assert sigmoid(np.array([-200.0, 200.0], np.float32)).tolist() == [0.0, 1.0]


def test_channel_major_harmonics_and_orders_of_quaternions_invert() -> None:
    sh = np.arange(2 * 9 * 3, dtype=np.float32).reshape(2, 9, 3)
    rest = to_channel_major(sh)
    assert rest[0, :8].tolist() == sh[0, 1:, 0].tolist()  # all of red first
    assert np.array_equal(from_channel_major(rest), sh[:, 1:])
    assert to_xyzw(np.array([[1.0, 2, 3, 4]])).tolist() == [[2, 3, 4, 1]]
    assert to_wxyz(to_xyzw(np.array([[1.0, 2, 3, 4]]))).tolist() == [[1, 2, 3, 4]]


def test_splats_of_a_model_have_unit_quaternions_and_few_harmonics() -> None:
    model = detailed_model(5, degree=3)
    model.quats[0] = torch.tensor([0.0, 0, 0, 0])
    model.quats[1] = torch.tensor([2.0, 0, 0, 0])
    arrays = splats_of(model, "map", max_sh_degree=1)
    assert arrays.sh.shape == (5, 4, 3)
    assert arrays.quats[:2].tolist() == [[1, 0, 0, 0], [1, 0, 0, 0]]
    assert np.allclose(np.linalg.norm(arrays.quats, axis=1), 1, atol=ROUNDING)


@pytest.mark.parametrize("field", SplatArrays._fields)
def test_values_that_are_not_finite_are_named(field: str) -> None:
    model = detailed_model(5)
    getattr(model, field)[3] = float("nan")
    with pytest.raises(InputError) as refused:
        splats_of(model, "map.spz", max_sh_degree=0)
    assert (refused.value.file, refused.value.field) == ("map.spz", field)
    arrays = splats_of(detailed_model(5), "map.spz", max_sh_degree=0)
    broken = np.array(getattr(arrays, field))
    broken[3] = np.nan
    with pytest.raises(FormatError, match="the first is row 3") as caught:
        model_of("map.spz", arrays._replace(**{field: broken}))
    assert (caught.value.file, caught.value.field) == ("map.spz", field)


def test_an_empty_model_is_refused_with_the_fix() -> None:
    with pytest.raises(InputError, match=r"no Gaussians.*\.ply"):
        splats_of(replace(detailed_model(2)).select(torch.zeros(2, dtype=torch.bool)), "map.spz", max_sh_degree=0)


def test_values_beyond_a_range_are_counted_in_a_warning(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    with caplog.at_level(logging.WARNING):
        warn_limited(tmp_path, "colours", np.array([-1e-7, 0.0, 1.0 + 1e-7]), 0.0, 1.0)
        assert not caplog.records
        warn_limited(tmp_path, "colours", np.array([-0.1, 0.5, 2.0]), 0.0, 1.0)
    assert "2 of 3 colours were limited to 0..1" in caplog.text
