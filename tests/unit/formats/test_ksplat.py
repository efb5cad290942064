""".ksplat: files of the published writer, an independent reader of written ones, damaged and hostile headers."""

from __future__ import annotations

import gzip
import json
import logging
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatbot.errors import FormatError, InputError
from splatbot.formats import load_gaussians
from splatbot.formats.ksplat import Level, load_ksplat, save_ksplat
from tests.unit.formats.models import ROUNDING, detailed_model, errors, quat_errors, unit

PUBLISHED = Path(__file__).parents[2] / "data" / "ksplat"  # of make.mjs there
LEVELS: tuple[Level, ...] = (0, 1, 2)
HALF = 2.0**-11  # relative error of float16
SECTION = 4096  # offset of the first section header

Array = NDArray[np.float64]


def published(level: Level) -> bytes:
    """Return a file of 21 Gaussians in two sections, of SH degree 2, by the published writer."""
    return gzip.decompress((PUBLISHED / f"level{level}.ksplat.gz").read_bytes())


@pytest.mark.parametrize("level", LEVELS)
def test_files_of_the_published_writer_have_the_values_of_the_published_reader(tmp_path: Path, level: Level) -> None:
    (tmp_path / "map.ksplat").write_bytes(published(level))
    model = load_gaussians(tmp_path / "map.ksplat")
    rows = json.loads(gzip.decompress((PUBLISHED / "decoded.json.gz").read_bytes()))[level]
    assert (len(model), model.sh_degree) == (len(rows), 2)

    def wanted(name: str) -> Array:
        return np.array([row[name] for row in rows])

    assert np.abs(model.means.numpy() - wanted("mean")).max() <= ROUNDING
    assert np.abs(model.scales.numpy() / wanted("scale") - 1).max() <= ROUNDING
    quats = wanted("wxyz") / np.linalg.norm(wanted("wxyz"), axis=1, keepdims=True)
    assert np.abs(unit(model.quats) - quats).max() <= ROUNDING
    assert np.abs(model.colors.numpy() - wanted("rgba")[:, :3] / 255).max() <= ROUNDING
    assert np.abs(model.opacities.numpy() - wanted("rgba")[:, 3] / 255).max() <= ROUNDING
    assert np.abs(model.sh[:, 1:].numpy() - wanted("harmonics").reshape(-1, 8, 3)).max() <= ROUNDING


def test_the_minimal_file_of_another_writer_is_the_same_scene_as_its_splat(data_root: Path) -> None:
    ksplat, splat = (
        load_gaussians(data_root / "splats" / "minimal_fixtures" / f"minimal.{name}") for name in ("ksplat", "splat")
    )
    assert ksplat.means.tolist() == [[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]]
    for name in ("means", "log_scales", "quats", "opacity_logits", "sh"):
        assert errors(getattr(ksplat, name), getattr(splat, name)).max() <= ROUNDING


def read_independently(data: bytes) -> Array:
    """Return rows of mean, scale, quaternion, rgba and harmonics of a file of one section, by the published layout."""
    count, level = struct.unpack_from("<I", data, 16)[0], struct.unpack_from("<H", data, 20)[0]
    low, high = struct.unpack_from("<ff", data, 36)
    rows_used, capacity, size, buckets, block, centre_bytes = struct.unpack_from("<IIIIfH", data, SECTION)
    steps, stored, full, others = struct.unpack_from("<IIII", data, SECTION + 24)
    (degree,) = struct.unpack_from("<H", data, SECTION + 40)
    assert rows_used == capacity == count
    assert buckets == full + others
    start = SECTION + 1024
    assert stored == len(data) - start
    lengths = [size] * full + list(struct.unpack_from(f"<{others}I", data, start))
    bucket_of = [bucket for bucket, length in enumerate(lengths) for _ in range(length)]
    harmonics = (0, 9, 24)[degree]
    row = struct.Struct(("<3f3f4f4B%df", "<3H3e4e4B%de", "<3H3e4e4B%dB")[level] % harmonics)
    table = []
    for i in range(count):
        values = list(row.unpack_from(data, start + 4 * others + centre_bytes * buckets + i * row.size))
        if level > 0:
            centre = struct.unpack_from("<3f", data, start + 4 * others + centre_bytes * bucket_of[i])
            values[:3] = [(v - steps) * (block / 2 / steps) + c for v, c in zip(values[:3], centre, strict=True)]
        if level == 2:
            values[14:] = [v / 255 * (high - low) + low for v in values[14:]]
        table.append(values)
    return np.array(table)


def nearest(found: Array, wanted: Array) -> NDArray[np.intp]:
    """Return the row of ``found`` of each row of ``wanted``, by the position."""
    rows: NDArray[np.intp] = cKDTree(found[:, :3]).query(wanted[:, :3])[1]
    assert len(set(rows.tolist())) == len(wanted)
    return rows


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_written_file_has_the_published_layout(tmp_path: Path, level: Level, degree: int) -> None:
    model = detailed_model(1500, degree)
    model.means *= 4.0  # 12 m: several cubes, with full buckets
    save_ksplat(model, tmp_path / "map.ksplat", level)
    table = read_independently((tmp_path / "map.ksplat").read_bytes())
    kept = min(degree, 2)
    bands = [model.sh[:, n**2 : (n + 1) ** 2].transpose(1, 2).reshape(1500, -1).numpy() for n in range(1, kept + 1)]
    colors = np.column_stack([model.colors.numpy(), model.opacities.numpy()])
    given = [model.means.numpy(), model.scales.numpy(), unit(model.quats), 255 * colors, *bands]
    wanted = np.column_stack(given).astype(np.float64)
    off = np.abs(table[nearest(table, wanted)] - wanted)
    half = HALF if level else ROUNDING
    assert off[:, :3].max() <= (2.5 / 32767 / 2 if level else 0) + ROUNDING
    assert (off[:, 3:6] <= half * wanted[:, 3:6]).all()
    assert off[:, 6:10].max() <= half
    assert off[:, 10:14].max() <= 0.5 + 1e-4
    limit = max((np.abs(band).max() for band in bands), default=0.0)
    assert off[:, 14:].max(initial=0) <= (ROUNDING, HALF * limit, limit / 255 + ROUNDING)[level]


@pytest.mark.parametrize("level", LEVELS)
def test_a_written_model_is_read_back(tmp_path: Path, level: Level) -> None:
    model = detailed_model(600, degree=2)  # within 3 m: one cube, so in order
    save_ksplat(model, tmp_path / "map.ksplat", level)
    back = load_gaussians(tmp_path / "map.ksplat")
    assert (len(back), back.sh_degree) == (600, 2)
    assert errors(back.means, model.means).max() <= (2.5 / 32767 / 2 if level else 0) + ROUNDING
    assert errors(back.log_scales, model.log_scales).max() <= (1.01 * HALF if level else 5 * ROUNDING)
    assert errors(back.opacities, model.opacities).max() <= 0.5 / 255 + ROUNDING
    assert errors(back.colors, model.colors).max() <= 0.5 / 255 + ROUNDING
    assert quat_errors(back, model).max() <= 2 * HALF
    assert errors(back.sh[:, 1:], model.sh[:, 1:]).max() <= 0.3 / (255 if level == 2 else 2000)


@pytest.mark.parametrize("offset", [3e3, 1e20, 3e38])
def test_positions_far_away_have_the_precision_of_float32(tmp_path: Path, offset: float) -> None:
    model = detailed_model(40)
    model.means[::2, 1] += offset
    save_ksplat(model, tmp_path / "map.ksplat")
    means, wanted = load_ksplat(tmp_path / "map.ksplat").means.numpy(), model.means.numpy()
    found = np.concatenate([means[means[:, 1] < offset / 2], means[means[:, 1] > offset / 2]])
    wanted = np.concatenate([wanted[1::2], wanted[::2]])  # two cubes, each in order
    assert (np.abs(found - wanted) <= 1e-4 + 2.0**-22 * np.abs(wanted)).all()


def test_values_beyond_the_ranges_are_limited_with_warnings(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model = detailed_model(5, degree=1)
    model.sh[0, 0, 0], model.sh[0, 3, 0], model.log_scales[0, 0], model.log_scales[1, 0] = 9.0, -1e5, -40.0, 15.0
    with caplog.at_level(logging.WARNING):
        save_ksplat(model, tmp_path / "map.ksplat")
    assert [record.getMessage().split(": ")[1] for record in caplog.records] == [
        "1 of 15 colours were limited to 0..1",
        "2 of 15 logarithms of scales were limited to -16.6..11.1",
        "1 of 45 harmonics were limited to -6.55e+04..6.55e+04",
    ]
    back = load_ksplat(tmp_path / "map.ksplat")
    assert back.sh[0, 3, 0].item() == -65504
    assert back.scales[:2, 0].tolist() == pytest.approx([2.0**-24, 65504])


@pytest.mark.parametrize("level", LEVELS)
def test_a_read_file_is_written_again_without_a_warning(
    tmp_path: Path, level: Level, caplog: pytest.LogCaptureFixture
) -> None:
    model = detailed_model(300, degree=2)
    model.sh[:100, 0], model.sh[100:200, 0] = 10.0, -10.0  # white and black
    save_ksplat(model, tmp_path / "map.ksplat", level)
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        save_ksplat(load_ksplat(tmp_path / "map.ksplat"), tmp_path / "again.ksplat", level)
    assert not caplog.records


@pytest.mark.parametrize("level", LEVELS)
def test_harmonics_of_zero_stay_zero(tmp_path: Path, level: Level) -> None:
    model = detailed_model(5, degree=2)
    model.sh[:, 1:] = 0.0
    save_ksplat(model, tmp_path / "map.ksplat", level)
    assert load_ksplat(tmp_path / "map.ksplat").sh[:, 1:].abs().max() <= ROUNDING


@pytest.mark.parametrize("values", [(0.3,), (-0.3,), (0.3, -0.3), (0.3, -0.01), (0.01, -0.3)])
def test_zero_harmonics_stay_zero_next_to_others(tmp_path: Path, values: tuple[float, ...]) -> None:
    model = detailed_model(5, degree=2)
    model.sh[:, 1:] = 0.0
    for row, value in enumerate(values):
        model.sh[row, 1, 0] = value
    save_ksplat(model, tmp_path / "map.ksplat", 2)
    back = load_ksplat(tmp_path / "map.ksplat")
    assert back.sh[model.sh == 0.0].abs().max() <= ROUNDING
    assert errors(back.sh[:, 1:], model.sh[:, 1:]).max() <= (max(*values, 0.0) - min(*values, 0.0)) / 510 + ROUNDING


def test_a_section_beyond_4_gib_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatbot.formats.ksplat._MAX_BYTES", 1000)
    with pytest.raises(InputError, match="2,200 bytes, at most 1,000"):
        save_ksplat(detailed_model(50), tmp_path / "map.ksplat", 0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("level", LEVELS)
def test_equal_maps_are_equal_files(tmp_path: Path, level: Level) -> None:
    for name in ("a", "b"):
        save_ksplat(detailed_model(50), tmp_path / name, level)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def refusal(path: Path, content: bytes) -> FormatError:
    path.write_bytes(content)
    with pytest.raises(FormatError) as caught:
        load_ksplat(path)
    assert caught.value.file == str(path)
    assert caught.value.hint
    return caught.value


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("keep", [0, 3, 44, 4095, 4096, 5000, 6144, -1])
def test_a_truncated_file_is_named(tmp_path: Path, level: Level, keep: int) -> None:
    assert refusal(tmp_path / "map.ksplat", published(level)[:keep]).field


def test_more_bytes_than_the_sections_take_are_refused(tmp_path: Path) -> None:
    assert refusal(tmp_path / "map.ksplat", published(1) + b"\0").field == "sections"


@pytest.mark.parametrize(
    ("offset", "value", "field"),
    [
        (0, b"\1", "version"),
        (1, b"\2", "version"),
        (4, struct.pack("<I", 0), "maxSectionCount"),
        (4, struct.pack("<I", 2**32 - 1), "maxSectionCount"),
        (16, struct.pack("<I", 0), "splatCount"),
        (16, struct.pack("<I", 20), "splatCount"),
        (16, struct.pack("<I", 2**32 - 1), "splatCount"),
        (20, struct.pack("<H", 3), "compressionLevel"),
        (36, struct.pack("<f", np.nan), "minSphericalHarmonicsCoeff"),
        (36, struct.pack("<f", 2.0), "minSphericalHarmonicsCoeff"),
        (40, struct.pack("<f", np.inf), "minSphericalHarmonicsCoeff"),
        (SECTION, struct.pack("<I", 14), "section 0 splatCount"),
        (SECTION, struct.pack("<I", 12), "splatCount"),
        (SECTION + 4, struct.pack("<I", 14), "sections"),
        (SECTION + 4, struct.pack("<I", 2**32 - 1), "sections"),
        (SECTION + 8, struct.pack("<I", 2**32 - 1), "buckets"),
        (SECTION + 12, struct.pack("<I", 2**32 - 1), "section 0 bucketCount"),
        (SECTION + 16, struct.pack("<f", 0.0), "section 0 bucketBlockSize"),
        (SECTION + 16, struct.pack("<f", np.nan), "section 0 bucketBlockSize"),
        (SECTION + 20, struct.pack("<H", 65535), "section 0 bucketStorageSizeBytes"),
        (SECTION + 32, struct.pack("<I", 2**32 - 1), "section 0 bucketCount"),
        (SECTION + 40, struct.pack("<H", 3), "section 0 sphericalHarmonicsDegree"),
        (SECTION + 2048, struct.pack("<I", 2**32 - 1), "buckets"),  # the length of a bucket
    ],
)
def test_a_wrong_header_field_is_named(tmp_path: Path, offset: int, value: bytes, field: str) -> None:
    data = published(2)
    assert refusal(tmp_path / "map.ksplat", data[:offset] + value + data[offset + len(value) :]).field == field


def test_a_claim_of_many_buckets_takes_no_memory(tmp_path: Path) -> None:
    data = bytearray(published(1))
    struct.pack_into("<I", data, SECTION + 12, 2**32 - 2)
    struct.pack_into("<II", data, SECTION + 32, 2**32 - 2, 0)
    assert refusal(tmp_path / "map.ksplat", bytes(data)).field == "sections"


def edited(tmp_path: Path, offset: int, value: float) -> Path:
    """Write a file of level 0 whose first row has another float at an offset."""
    path = tmp_path / "map.ksplat"
    save_ksplat(detailed_model(3), path, 0)
    data = bytearray(path.read_bytes())
    struct.pack_into("<f", data, SECTION + 1024 + offset, value)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("offset", "value", "field"), [(0, np.nan, "means"), (12, -0.1, "scale"), (12, np.inf, "log_scales")]
)
def test_nan_infinity_and_negative_scales_are_refused(tmp_path: Path, offset: int, value: float, field: str) -> None:
    with pytest.raises(FormatError, match="row 0") as caught:
        load_ksplat(edited(tmp_path, offset, value))
    assert caught.value.field == field


def test_a_scale_of_zero_is_replaced_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        model = load_ksplat(edited(tmp_path, 12, 0.0))
    assert model.scales[0, 0].item() == pytest.approx(1e-9, rel=1e-5)
    assert "1 scales of 0 became" in caplog.text
