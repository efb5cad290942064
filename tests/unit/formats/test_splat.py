""".splat: known rows, round trips within half a step, damaged files."""

from __future__ import annotations

import logging
import struct
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import FormatError
from splatbot.formats import load_gaussians
from splatbot.formats.splat import load_splat, save_splat
from tests.unit.formats.models import ROUNDING, detailed_model, errors, quat_errors, unit


def test_a_row_of_the_minimal_file_is_what_the_format_says(data_root: Path) -> None:
    model = load_gaussians(data_root / "splats" / "minimal_fixtures" / "minimal.splat")
    assert model.means.tolist() == [[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]]
    assert model.scales.flatten().tolist() == pytest.approx([0.1] * 12, rel=1e-6)
    assert model.opacities.tolist() == pytest.approx([0xE6 / 255] * 4, abs=1e-6)
    assert model.colors[1].tolist() == pytest.approx([0xAA / 255, 0x55 / 255, 0x80 / 255], abs=1e-6)
    assert unit(model.quats)[0].tolist() == [0, 0, 0, 1]  # bytes 80 80 80 FF: w x y z


@pytest.mark.parametrize(("name", "count"), [("n3dv_room.splat", 124_495), ("armchair.splat", 59_436)])
def test_real_files_are_read_and_written_back_unchanged(
    data_root: Path, tmp_path: Path, name: str, count: int, caplog: pytest.LogCaptureFixture
) -> None:
    path = data_root / "splats" / name
    model = load_gaussians(path)
    assert len(model) == count
    with caplog.at_level(logging.WARNING):
        save_splat(model, tmp_path / "copy.splat")
    row = np.dtype([("floats", "<f4", 6), ("rgba", "u1", 4), ("rotation", "u1", 4)])
    was, now = (np.frombuffer(file.read_bytes(), row) for file in (path, tmp_path / "copy.splat"))
    assert np.array_equal(was["floats"][:, :3], now["floats"][:, :3])
    assert np.array_equal(was["rgba"], now["rgba"])
    visible = was["floats"][:, 3:] > 1e-9
    assert (np.abs(was["floats"][:, 3:] / now["floats"][:, 3:] - 1)[visible] < 1e-5).all()
    assert quat_errors(load_splat(tmp_path / "copy.splat"), model).max() <= np.sqrt(4) / 128


def test_a_written_model_is_read_back_within_half_a_step(tmp_path: Path) -> None:
    model = detailed_model(500, degree=2)
    save_splat(model, tmp_path / "map.splat")
    assert (tmp_path / "map.splat").stat().st_size == 500 * 32
    back = load_gaussians(tmp_path / "map.splat")
    assert back.sh_degree == 0
    assert np.array_equal(back.means.numpy(), model.means.numpy())
    assert errors(back.log_scales, model.log_scales).max() <= 5 * ROUNDING
    assert errors(back.opacities, model.opacities).max() <= 0.5 / 255 + ROUNDING
    assert errors(back.colors, model.colors).max() <= 0.5 / 255 + ROUNDING
    # half a step in three components, and a whole one in a fourth next to 1
    assert quat_errors(back, model).max() <= 1.05 * np.sqrt(3 * (1 / 256) ** 2 + (1 / 128) ** 2)


def test_colours_beyond_white_are_limited_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model = detailed_model(4)
    model.sh[1, 0] = 5.0
    with caplog.at_level(logging.WARNING):
        save_splat(model, tmp_path / "map.splat")
    assert "3 of 12 colours were limited" in caplog.text
    assert load_splat(tmp_path / "map.splat").colors[1].tolist() == pytest.approx([1, 1, 1])


def row(scale: float = 0.1, mean: float = 0.0, rotation: bytes = b"\xff\x80\x80\x80") -> bytes:
    return struct.pack("<6f", mean, 0, 0, scale, 0.1, 0.1) + bytes([128, 128, 128, 255]) + rotation


def test_a_truncated_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "map.splat"
    path.write_bytes(row() * 3 + row()[:-1])
    with pytest.raises(FormatError, match="127 bytes are no multiple of 32") as caught:
        load_gaussians(path)
    assert (caught.value.file, caught.value.field) == (str(path), "rows")


def test_a_negative_scale_and_nan_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.splat"
    path.write_bytes(row() + row(scale=-0.1))
    with pytest.raises(FormatError, match="row 1 has a negative scale") as caught:
        load_gaussians(path)
    assert caught.value.field == "scale"
    path.write_bytes(row() + row(mean=float("nan")))
    with pytest.raises(FormatError, match="the first is row 1") as caught:
        load_gaussians(path)
    assert caught.value.field == "means"


def test_zero_scales_and_zero_quaternions_are_replaced(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "map.splat"
    path.write_bytes(row(scale=0.0) + row(rotation=b"\x80" * 4))
    with caplog.at_level(logging.WARNING):
        model = load_gaussians(path)
    assert model.scales[0, 0].item() == pytest.approx(1e-9, rel=1e-5)
    assert model.quats[1].tolist() == [1, 0, 0, 0]
    assert len(caplog.records) == 2


@pytest.mark.parametrize("first", [b"{", b"PK", b"\x1f\x8b", b"ply", b"NGSP"])
def test_a_first_float_that_looks_like_another_format_is_read_as_splat(first: bytes, tmp_path: Path) -> None:
    path = tmp_path / "map.splat"
    path.write_bytes(first + (row() * 2)[len(first) :])
    assert len(load_gaussians(path)) == 2
