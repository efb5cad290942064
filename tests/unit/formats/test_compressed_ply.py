"""Compressed PLY: values of a reference reader, round trips within half a step, damaged files."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch

from splatbot.errors import FormatError
from splatbot.formats import load_gaussians, save_gaussians
from splatbot.formats.compressed_ply import CHUNK, load_compressed_ply, save_compressed_ply
from splatbot.formats.quantize import morton_order
from splatbot.gaussians import GaussianModel
from tests.unit.formats.models import ROUNDING, detailed_model, errors, quat_errors, unit

# Decoded by gsply 0.4.6: row, mean, log scale, quaternion, opacity logit, DC.
GSPLY = {
    "biker.compressed.ply": (
        (0, 152_746),
        [-0.1045368, -2.3878982, -0.360811],
        [-6.068917, -4.206543, -7.050748],
        [0.4610364, -0.0629, 0.8848552, 0.0228099],
        -2.5776885,
        [0.5478684, 0.5222843, 0.5681518],
    ),
    "guitar.compressed.ply": (
        (90_853, 90_854),
        [0.4553929, -0.6415753, 0.7538047],
        [-11.707035, -3.780728, -5.108385],
        [0.628309, 0.7114119, -0.2177308, -0.2274078],
        -2.1756256,
        [-0.9081724, -1.0647291, -1.0610977],
    ),
}


@pytest.mark.parametrize("name", sorted(GSPLY))
def test_real_files_have_the_values_of_another_reader(data_root: Path, name: str) -> None:
    (row, count), mean, log_scale, quat, logit, dc = GSPLY[name]
    model = load_gaussians(data_root / "splats" / name)
    assert (len(model), model.sh_degree) == (count, 0)
    assert model.means[row].tolist() == pytest.approx(mean, abs=1e-6)
    assert model.log_scales[row].tolist() == pytest.approx(log_scale, abs=1e-5)
    assert unit(model.quats)[row].tolist() == pytest.approx(quat, abs=1e-6)
    assert model.opacity_logits[row].item() == pytest.approx(logit, abs=1e-5)
    assert model.sh[row, 0].tolist() == pytest.approx(dc, abs=1e-6)


def half_steps(values: torch.Tensor, steps: tuple[int, int, int]) -> np.ndarray:
    """Return half a step of each value (N, 3): of the range of its chunk."""
    array = values.numpy().astype(np.float64)
    chunks = [array[i : i + CHUNK] for i in range(0, len(array), CHUNK)]
    return np.concatenate([np.ones((len(c), 1)) * np.ptp(c, axis=0) / steps / 2 for c in chunks])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [1, 256, 700])
def test_a_written_model_is_read_back_within_half_a_step(tmp_path: Path, degree: int, n: int) -> None:
    model = detailed_model(n, degree)
    save_compressed_ply(model, tmp_path / "map.compressed.ply")
    back = load_gaussians(tmp_path / "map.compressed.ply")
    wanted = model.select(torch.from_numpy(morton_order(model.means.numpy())))
    assert (len(back), back.sh_degree) == (n, degree)
    for name, steps in (("means", (2047, 1023, 2047)), ("log_scales", (2047, 1023, 2047))):
        was = getattr(wanted, name)
        assert (errors(getattr(back, name), was) <= half_steps(was, steps) + 10 * ROUNDING).all(), name
    colors = (255, 255, 255)
    assert (errors(back.sh[:, 0], wanted.sh[:, 0]) <= half_steps(wanted.sh[:, 0], colors) + 10 * ROUNDING).all()
    assert errors(back.opacities, wanted.opacities).max() <= 0.5 / 255 + ROUNDING
    component = 1 / 1023 / np.sqrt(2)
    assert quat_errors(back, wanted).max() <= 1.05 * 2 * np.sqrt(3) * component
    if degree:
        assert errors(back.sh[:, 1:], wanted.sh[:, 1:]).max() <= 0.5 / 32 + ROUNDING


def test_harmonics_are_limited_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model = detailed_model(10, degree=1)
    model.sh[0, 1:] = 9.0
    model.sh[1, 1:] = -9.0
    with caplog.at_level(logging.WARNING):
        save_compressed_ply(model, tmp_path / "map.compressed.ply")
    assert "18 of 90 harmonics were limited to -4..4" in caplog.text
    back = load_compressed_ply(tmp_path / "map.compressed.ply")
    assert (back.sh[:, 1:].max(), back.sh[:, 1:].min()) == (4.0, -4.0)


def test_the_fourth_degree_is_dropped(tmp_path: Path) -> None:
    save_gaussians(detailed_model(10, degree=4), tmp_path / "map.compressed.ply")
    assert load_compressed_ply(tmp_path / "map.compressed.ply").sh_degree == 3


def edit(path: Path, element: str, drop: str = "", keep: int | None = None) -> None:
    """Write a compressed PLY without a property, or with fewer rows, of an element."""
    elements = []
    for part in plyfile.PlyData.read(str(path), mmap=False).elements:
        data = part.data
        if part.name == element:
            data = data[[name for name in data.dtype.names if name != drop]][:keep]
            data = np.array(data.tolist(), dtype=[(name, data.dtype[name]) for name in data.dtype.names])
        elements.append(plyfile.PlyElement.describe(data, part.name))
    plyfile.PlyData(elements, byte_order="<").write(str(path))


@pytest.mark.parametrize(
    ("element", "drop"),
    [("chunk", "max_scale_y"), ("chunk", "min_x"), ("chunk", "max_b"), ("vertex", "packed_color"), ("sh", "f_rest_8")],
)
def test_a_missing_property_is_named(tmp_path: Path, element: str, drop: str) -> None:
    path = tmp_path / "map.compressed.ply"
    save_compressed_ply(detailed_model(300, degree=1), path)
    edit(path, element, drop)
    with pytest.raises(FormatError) as caught:
        load_gaussians(path)
    assert caught.value.file == str(path)
    assert caught.value.field in (drop, element)


@pytest.mark.parametrize(("element", "keep"), [("chunk", 1), ("sh", 7)])
def test_too_few_rows_are_named(tmp_path: Path, element: str, keep: int) -> None:
    path = tmp_path / "map.compressed.ply"
    save_compressed_ply(detailed_model(300, degree=1), path)
    edit(path, element, keep=keep)
    with pytest.raises(FormatError) as caught:
        load_gaussians(path)
    assert caught.value.field == element


def test_files_without_colours_of_chunks_hold_them_in_0_to_1(tmp_path: Path) -> None:
    path = tmp_path / "map.compressed.ply"
    model = GaussianModel.from_activated(
        means=[[0, 0, 0], [1, 1, 1]],
        quats=[[1, 0, 0, 0]] * 2,
        scales=[[0.1] * 3] * 2,
        opacities=[1.0, 0.5],
        colors=[[0, 0, 0], [1, 1, 1]],  # the range of the chunk, so that codes are the same without it
    )
    save_compressed_ply(model, path)
    for name in [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]:
        edit(path, "chunk", name)
    assert errors(load_gaussians(path).colors, model.colors).max() <= ROUNDING
