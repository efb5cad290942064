"""SPZ 2, 3 and 4: known values, the same scene in two formats, round trips within half a step, hostile headers."""

from __future__ import annotations

import gzip
import logging
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard

from splatbot.errors import FormatError, InputError
from splatbot.formats import load_gaussians, save_gaussians
from splatbot.formats.spz import Version, load_spz, save_spz
from tests.unit.formats.models import ROUNDING, detailed_model, errors, quat_errors, unit

VERSIONS: tuple[Version, ...] = (2, 3, 4)
COUNT = 8  # offset of the count in the headers of all versions


@pytest.mark.parametrize("name", ["minimal-v2", "minimal-v3", "minimal-v4", "minimal-raw"])
def test_the_minimal_files_have_the_values_of_their_bytes(data_root: Path, name: str) -> None:
    model = load_gaussians(data_root / "splats" / "minimal_fixtures" / f"{name}.spz")
    is_old = name in ("minimal-v2", "minimal-raw")  # z is stored with the other sign, colours with others
    z, low, high = (1.0, 0x55, 0xAA) if is_old else (-1.0, 0x69, 0x96)
    assert model.means.tolist() == [[-1, 0, z], [0, 0, z], [-1, 0, 0], [0, 0, 0]]
    assert model.log_scales.flatten().tolist() == pytest.approx([0x7B / 16 - 10] * 12)
    assert model.opacities.tolist() == pytest.approx([0xE6 / 255] * 4, abs=1e-6)
    dc = [(code / 255 - 0.5) / 0.15 for code in (high, low, 0x80)]
    assert model.sh[1, 0].tolist() == pytest.approx(dc, abs=1e-6)
    if is_old:  # 80 80 80 is the nearest code to x = y = z = 0
        assert unit(model.quats)[0].tolist() == pytest.approx([1, 1 / 255, -1 / 255, -1 / 255], abs=3e-5)
    else:
        assert np.abs(unit(model.quats)) == pytest.approx(np.tile([1, 0, 0, 0], (4, 1)))


def test_the_same_scene_agrees_with_its_compressed_ply(data_root: Path) -> None:
    spz, ply = (load_gaussians(data_root / "splats" / name) for name in ("biker_v4.spz", "biker.compressed.ply"))
    assert len(spz) == len(ply) == 152_746
    assert errors(spz.means, ply.means).max() <= 0.5 / 2**12 + ROUNDING
    stored = ply.log_scales.numpy() >= -10
    assert errors(spz.log_scales, ply.log_scales)[stored].max() <= 0.5 / 16 + ROUNDING
    assert spz.log_scales.numpy()[~stored].max() == -10
    assert errors(spz.opacities, ply.opacities).max() <= ROUNDING  # 8 bits in both
    assert errors(spz.sh, ply.sh).max() <= 0.5 / 255 / 0.15 + ROUNDING
    component = 0.5 / 511 / np.sqrt(2)
    assert quat_errors(spz, ply).max() <= 1.05 * 2 * np.sqrt(3) * component


def test_a_real_file_has_the_values_of_another_reader(data_root: Path) -> None:
    model = load_gaussians(data_root / "splats" / "biker_v4.spz")
    # by gsply 0.4.6, which keeps the axes right, up, back
    assert model.means[-1].tolist() == pytest.approx([0.1672363, -0.6030273, 0.3288574], abs=1e-6)
    assert model.log_scales[-1].tolist() == [-5.75, -4.8125, -7.625]
    assert unit(model.quats)[-1].tolist() == pytest.approx([0.9982541, 0.0401293, -0.0415131, 0.0124539], abs=1e-6)
    assert model.opacity_logits[-1].item() == pytest.approx(-2.8457396, abs=1e-5)
    assert model.sh[-1, 0].tolist() == pytest.approx([1.1111113, 1.0849675, 1.0588237], abs=1e-6)


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_a_written_model_is_read_back_within_half_a_step(tmp_path: Path, version: Version, degree: int) -> None:
    model = detailed_model(300, degree)
    save_spz(model, tmp_path / "map.spz", version)
    back = load_gaussians(tmp_path / "map.spz")
    kept = min(degree, 3) if version == 2 else degree
    assert (len(back), back.sh_degree) == (300, kept)
    assert errors(back.means, model.means).max() <= 0.5 / 2**14 + ROUNDING  # within 2 m: 14 fractional bits
    assert errors(back.log_scales, model.log_scales).max() <= 0.5 / 16 + ROUNDING
    assert errors(back.opacities, model.opacities).max() <= 0.5 / 255 + ROUNDING
    assert errors(back.sh[:, 0], model.sh[:, 0]).max() <= 0.5 / 255 / 0.15 + ROUNDING
    assert errors(back.sh[:, 1:], model.sh[:, 1 : (kept + 1) ** 2]).max(initial=0) <= 0.5 / 128 + ROUNDING
    if version > 2:
        assert quat_errors(back, model).max() <= 1.05 * 2 * np.sqrt(3) * 0.5 / 511 / np.sqrt(2)
        return
    p, q = unit(model.quats), back.quats.numpy()
    p *= np.sign(p[:, :1])
    assert np.abs(p[:, 1:] - q[:, 1:]).max() <= 1.01 / 255
    assert np.abs(p[:, 0] ** 2 - q[:, 0] ** 2).max() <= 1.01 * 2 * np.sqrt(3) / 255  # of w = √(1 - |xyz|²)


@pytest.mark.parametrize(("extent", "bits"), [(0.3, 16), (2.0, 13), (100.0, 12), (5000.0, 10), (8e6, 0)])
def test_fractional_bits_follow_the_extent(tmp_path: Path, extent: float, bits: int) -> None:
    model = detailed_model(50)
    model.means *= extent / model.means.abs().max()
    save_spz(model, tmp_path / "map.spz", 4)
    assert (tmp_path / "map.spz").read_bytes()[13] == bits
    assert errors(load_spz(tmp_path / "map.spz").means, model.means).max() <= 0.5 / 2**bits + ROUNDING * extent


def test_a_scene_too_large_is_refused(tmp_path: Path) -> None:
    model = detailed_model(5)
    model.means[0, 0] = 1e7
    with pytest.raises(InputError, match=r"1e\+07 m"):
        save_gaussians(model, tmp_path / "map.spz")
    assert not list(tmp_path.iterdir())


def test_values_beyond_the_ranges_are_limited_with_warnings(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model = detailed_model(5, degree=1)
    model.sh[0, 0, 0], model.sh[0, 3, 0], model.log_scales[0, 0] = 9.0, -2.0, -12.0
    with caplog.at_level(logging.WARNING):
        save_spz(model, tmp_path / "map.spz")
    assert len(caplog.records) == 3
    back = load_spz(tmp_path / "map.spz")
    assert back.sh[0, 0, 0].item() == pytest.approx(0.5 / 0.15)
    assert (back.sh[0, 3, 0].item(), back.log_scales[0, 0].item()) == (-1.0, -10.0)


def test_equal_maps_are_equal_files(tmp_path: Path) -> None:
    for version in VERSIONS:
        save_spz(detailed_model(50), tmp_path / "a.spz", version)
        save_spz(detailed_model(50), tmp_path / "b.spz", version)
        assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


def with_extension(content: bytes, kind: int, payload: bytes) -> bytes:
    """Add an extension record to a file of version 4."""
    record = struct.pack("<II", kind, len(payload)) + payload
    header = bytearray(content[:32])
    header[14] |= 2
    header[16:20] = struct.pack("<I", 32 + len(record))
    return bytes(header) + record + content[32:]


@pytest.mark.parametrize(
    ("payload", "signs"),
    [
        ((0xADBE0003, 4), (1, -1, -1)),
        ((0xADBE0003, 6), (1, 1, 1)),
        ((0xADBE0003, 7), (-1, -1, 1)),
        ((7, 6), (1, -1, -1)),
    ],
)
def test_an_extension_names_other_axes(tmp_path: Path, payload: tuple[int, int], signs: tuple[int, ...]) -> None:
    path, model = tmp_path / "map.spz", detailed_model(20)
    save_spz(model, path, 4)
    path.write_bytes(with_extension(path.read_bytes(), payload[0], struct.pack("<I", payload[1])))
    stored = model.means.numpy() * (1, -1, -1)
    assert np.abs(load_spz(path).means.numpy() - stored * signs).max() <= 0.5 / 2**12


def test_axes_with_y_and_z_exchanged_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.spz"
    save_spz(detailed_model(20), path, 4)
    path.write_bytes(with_extension(path.read_bytes(), 0xADBE0003, struct.pack("<I", 16)))
    with pytest.raises(FormatError, match="kind 16") as caught:
        load_spz(path)
    assert caught.value.field == "axes"


def test_gzip_files_end_with_extensions(tmp_path: Path) -> None:
    path, model = tmp_path / "map.spz", detailed_model(20)
    save_spz(model, path, 3)
    inner = bytearray(gzip.decompress(path.read_bytes()))
    inner[14] |= 2
    path.write_bytes(gzip.compress(bytes(inner) + struct.pack("<III", 0xADBE0003, 4, 6)))
    assert np.abs(load_spz(path).means.numpy() - model.means.numpy() * (1, -1, -1)).max() <= 0.5 / 2**12


def edited(version: Version, path: Path, edit: Callable[[bytearray], None]) -> Path:
    """Write a file whose header is edited."""
    save_spz(detailed_model(30), path, version)
    content = bytearray(gzip.decompress(path.read_bytes()) if version < 4 else path.read_bytes())
    edit(content)
    path.write_bytes(gzip.compress(bytes(content)) if version < 4 else bytes(content))
    return path


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("count", [0, 29, 31, 1_000_000, 2**31, 2**32 - 1])
def test_a_wrong_count_is_refused(tmp_path: Path, version: Version, count: int) -> None:
    path = edited(version, tmp_path / "map.spz", lambda data: struct.pack_into("<I", data, COUNT, count))
    with pytest.raises(FormatError) as caught:
        load_gaussians(path)
    assert caught.value.file == str(path)
    assert caught.value.field
    assert caught.value.hint


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(
    ("offset", "value", "field"),
    [(4, 5, "version"), (4, 1, "version"), (12, 5, "shDegree"), (13, 31, "fractionalBits")],
)
def test_a_wrong_header_field_is_named(tmp_path: Path, version: Version, offset: int, value: int, field: str) -> None:
    def edit(data: bytearray) -> None:
        data[offset] = value

    with pytest.raises(FormatError) as caught:
        load_gaussians(edited(version, tmp_path / "map.spz", edit))
    assert caught.value.field == field


def test_a_gzip_bomb_is_refused_before_it_is_inflated(tmp_path: Path) -> None:
    path = tmp_path / "map.spz"
    header = b"NGSP" + struct.pack("<IIBBBB", 3, 4_000_000, 0, 12, 0, 0)
    path.write_bytes(gzip.compress(header + bytes(20 * 4_000_000)))
    assert path.stat().st_size < 100_000
    with pytest.raises(FormatError, match="claims 80,000,000 bytes") as caught:
        load_gaussians(path)
    assert caught.value.field == "numPoints"


@pytest.mark.parametrize("frame", ["larger than the contents say", "of an unknown size"])
def test_a_zstd_bomb_is_refused_before_it_is_decoded(tmp_path: Path, frame: str) -> None:
    path = tmp_path / "map.spz"
    save_spz(detailed_model(30), path, 4)
    content = path.read_bytes()
    bomb = zstandard.ZstdCompressor(write_content_size=frame.startswith("larger")).compress(bytes(50_000_000))
    (stored,) = struct.unpack_from("<Q", content, 32)
    start = 32 + 5 * 16
    path.write_bytes(content[:32] + struct.pack("<Q", len(bomb)) + content[40:start] + bomb + content[start + stored :])
    with pytest.raises(FormatError) as caught:
        load_gaussians(path)
    assert caught.value.field == "stream 0"


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("keep", [0.02, 0.3, 0.7, 0.999])
def test_a_truncated_file_is_named(tmp_path: Path, version: Version, keep: float) -> None:
    path = tmp_path / "map.spz"
    save_spz(detailed_model(300), path, version)
    content = path.read_bytes()
    path.write_bytes(content[: max(4, int(keep * len(content)))])
    with pytest.raises(FormatError, match=r"damaged or truncated.*Fix: ") as caught:
        load_gaussians(path)
    assert caught.value.file == str(path)


def test_a_flipped_bit_of_a_gzip_file_is_found_by_its_checksum(tmp_path: Path) -> None:
    path = tmp_path / "map.spz"
    save_spz(detailed_model(300), path, 3)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)
    with pytest.raises(FormatError) as caught:
        load_gaussians(path)
    assert caught.value.field in ("gzip", "attributes")


def test_a_gzip_file_of_something_else_is_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "map.spz"
    path.write_bytes(gzip.compress(b"no splats in this file"))
    with pytest.raises(FormatError, match="no SPZ header") as caught:
        load_gaussians(path)
    assert caught.value.field == "magic"
