"""SOG 2: values of a reference reader, round trips within half a step, exact images, hostile archives."""

from __future__ import annotations

import io
import json
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from splatbot.errors import FormatError
from splatbot.formats import load_gaussians, save_gaussians
from splatbot.formats.quantize import morton_order
from splatbot.formats.sog import load_sog, save_sog
from splatbot.gaussians import GaussianModel
from tests.unit.formats.models import ROUNDING, detailed_model, errors, quat_errors, unit


@pytest.fixture(scope="module")
def flowers(data_root: Path) -> GaussianModel:
    return load_gaussians(data_root / "splats" / "flowers_lod3_sog")


def test_a_real_folder_has_the_values_of_another_reader(flowers: GaussianModel) -> None:
    assert (len(flowers), flowers.sh_degree) == (26_895, 2)
    row = 20_000  # by gsply 0.4.6
    assert flowers.means[row].tolist() == pytest.approx([0.2711264, 0.0171247, -0.2872601], abs=1e-6)
    assert flowers.log_scales[row].tolist() == pytest.approx([-12.279035, -12.565486, -12.279035], abs=1e-5)
    quat = [-0.2467941, 0.8956257, -0.3022535, -0.2135185]
    assert unit(flowers.quats)[row].tolist() == pytest.approx(quat, abs=1e-6)
    assert flowers.opacity_logits[row].item() == pytest.approx(-1.5953861, abs=1e-5)
    assert flowers.sh[row, 0].tolist() == pytest.approx([0.7640386, 0.9298276, -1.3937851], abs=1e-6)
    assert flowers.sh[row, 1].tolist() == pytest.approx([-0.0001433, 0.0277406, 0.0256256], abs=1e-6)
    assert flowers.sh[row, 8].tolist() == pytest.approx([0.0597342, 0.074568, -0.0561947], abs=1e-6)


def test_a_zipped_folder_reads_as_the_folder(flowers: GaussianModel, data_root: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "flowers.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        for file in (data_root / "splats" / "flowers_lod3_sog").iterdir():
            archive.write(file, file.name)
    zipped = load_gaussians(tmp_path / "flowers.sog")
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        assert torch.equal(getattr(zipped, name), getattr(flowers, name)), name


def test_a_real_scene_written_again_keeps_codebooks_and_harmonics(flowers: GaussianModel, tmp_path: Path) -> None:
    save_sog(flowers, tmp_path / "again.sog")
    again, order = load_sog(tmp_path / "again.sog"), torch.from_numpy(morton_order(flowers.means.numpy()))
    assert torch.equal(again.log_scales, flowers.log_scales[order])  # at most 256 distinct values
    assert torch.equal(again.sh[:, 1:], flowers.sh[order][:, 1:])
    seen = flowers.opacities[order] > 0.5 / 255
    assert torch.equal(again.sh[:, 0][seen], flowers.sh[order][:, 0][seen])
    assert errors(again.opacities, flowers.opacities[order]).max() <= ROUNDING


def check_codes(back: torch.Tensor, wanted: torch.Tensor, codebook: list[float]) -> None:
    """Check that each value became the nearest entry of a codebook."""
    entries = np.array(codebook)
    values = wanted.numpy().astype(np.float64)
    nearest = np.abs(values[..., None] - entries).min(axis=-1)
    assert np.abs(back.numpy() - values).max() <= nearest.max() + ROUNDING
    assert (np.abs(back.numpy() - values) <= nearest + ROUNDING).all()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [1, 5, 700])
def test_a_written_model_is_read_back_within_half_a_step(tmp_path: Path, degree: int, n: int) -> None:
    model, folder = detailed_model(n, degree), tmp_path / "map_sog"
    save_gaussians(model, folder)
    meta = json.loads((folder / "meta.json").read_text())
    back = load_gaussians(folder)
    wanted = model.select(torch.from_numpy(morton_order(model.means.numpy())))
    assert (len(back), back.sh_degree) == (n, degree)
    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    limit = (1 + np.abs(wanted.means.numpy())) * (0.5 * (high - low) / 65535) * 1.001 + ROUNDING
    assert (errors(back.means, wanted.means) <= limit).all()
    assert quat_errors(back, wanted).max() <= 1.05 * 2 * np.sqrt(3) / 255 / np.sqrt(2)
    assert errors(back.opacities, wanted.opacities).max() <= 0.5 / 255 + ROUNDING
    check_codes(back.log_scales, wanted.log_scales, meta["scales"]["codebook"])
    check_codes(back.sh[:, 0], wanted.sh[:, 0], meta["sh0"]["codebook"])
    if degree:
        check_codes(back.sh[:, 1:], wanted.sh[:, 1:], meta["shN"]["codebook"])


def test_more_vectors_than_the_palette_holds_share_means(tmp_path: Path) -> None:
    model = detailed_model(70_000, degree=1)
    save_sog(model, tmp_path / "map.sog")
    back = load_sog(tmp_path / "map.sog")
    wanted = model.sh[torch.from_numpy(morton_order(model.means.numpy()))][:, 1:]
    with zipfile.ZipFile(tmp_path / "map.sog") as archive:
        assert json.loads(archive.read("meta.json"))["shN"]["count"] == 65_536
    # two vectors of a group are neighbours: their distance is far below that of two random ones
    assert errors(back.sh[:, 1:], wanted).mean() < 0.1 * wanted.std().item()


def test_invisible_gaussians_lose_their_colour_only(tmp_path: Path) -> None:
    model = detailed_model(64)
    model.opacity_logits[:10] = -20.0
    save_sog(model, tmp_path / "map.sog")
    back, order = load_sog(tmp_path / "map.sog"), torch.from_numpy(morton_order(model.means.numpy()))
    assert errors(back.opacities, model.opacities[order]).max() <= 0.5 / 255 + ROUNDING
    assert errors(back.log_scales, model.log_scales[order]).max() <= ROUNDING  # fewer than 256 distinct values
    seen = model.opacities[order] > 0.5 / 255
    assert errors(back.sh[seen], model.sh[order][seen]).max() <= ROUNDING


def test_lossless_webp_of_this_opencv_is_bit_exact(rng: np.random.Generator) -> None:
    for channels in (3, 4):
        image = rng.integers(0, 256, (37, 64, channels), dtype=np.uint8)
        image[..., 3:] |= 1  # transparent pixels may lose their colour
        content = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 101])[1]
        assert np.array_equal(np.asarray(cv2.imdecode(content, cv2.IMREAD_UNCHANGED)), image)


def test_equal_maps_are_equal_archives_and_a_rewritten_folder_holds_no_old_files(tmp_path: Path) -> None:
    save_sog(detailed_model(50, degree=1), tmp_path / "a.sog")
    save_sog(detailed_model(50, degree=1), tmp_path / "b.sog")
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()
    save_gaussians(detailed_model(50, degree=1), tmp_path / "x_sog")
    save_gaussians(detailed_model(50), tmp_path / "x_sog")
    names = {file.name for file in (tmp_path / "x_sog").iterdir()}
    assert names == {"meta.json", "means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp"}


Edit = Callable[[dict[str, bytes], dict[str, Any]], object]


def archive(path: Path, edit: Edit) -> Path:
    """Write a SOG whose files and meta.json are edited."""
    save_sog(detailed_model(100, degree=1), path)
    with zipfile.ZipFile(path) as sound:
        files = {name: sound.read(name) for name in sound.namelist()}
    meta = json.loads(files.pop("meta.json"))
    edit(files, meta)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as damaged:
        for name, content in {"meta.json": json.dumps(meta).encode(), **files}.items():
            damaged.writestr(name, content)
    return path


def of_size(width: int, height: int) -> bytes:
    """Return the header of a lossless WebP image."""
    body = b"\x2f" + struct.pack("<I", (width - 1) | (height - 1) << 14) + bytes(64)
    return b"RIFF" + struct.pack("<I", len(body) + 12) + b"WEBPVP8L" + struct.pack("<I", len(body)) + body


def lossy() -> bytes:
    return cv2.imencode(".webp", np.zeros((16, 16, 3), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()


DAMAGE: dict[str, tuple[Edit, str]] = {
    "a huge count": (lambda files, meta: meta.update(count=2**40), "count"),
    "a negative count": (lambda files, meta: meta.update(count=-5), "count"),
    "a count above the images": (lambda files, meta: meta.update(count=1000), "means"),
    "a count of zeros": (lambda files, meta: meta.update(count=10_000_000), "count"),
    "no count": (lambda files, meta: meta.pop("count"), "meta.json"),
    "a text as count": (lambda files, meta: meta.update(count="many"), "meta.json"),
    "no version": (lambda files, meta: meta.pop("version"), "version"),
    "version 3": (lambda files, meta: meta.update(version=3), "version"),
    "an empty codebook": (lambda files, meta: meta["scales"].update(codebook=[]), "meta.json"),
    "NaN in a codebook": (lambda files, meta: meta["scales"].update(codebook=[float("nan")] * 256), "log_scales"),
    "a codebook of texts": (lambda files, meta: meta["sh0"].update(codebook=["x"]), "meta.json"),
    "ranges of two axes": (lambda files, meta: meta["means"].update(mins=[0, 0]), "meta.json"),
    "an infinite range": (lambda files, meta: meta["means"].update(maxs=[1e300] * 3), "means"),
    "no image": (lambda files, meta: files.pop("quats.webp"), "quats.webp"),
    "a number as name": (lambda files, meta: meta["quats"].update(files=[7]), "files"),
    "a lossy image": (lambda files, meta: files.update({"sh0.webp": lossy()}), "sh0.webp"),
    "an empty image": (lambda files, meta: files.update({"sh0.webp": b""}), "sh0.webp"),
    "an image of 16383 x 16383": (lambda files, meta: files.update({"sh0.webp": of_size(16383, 16383)}), "sh0.webp"),
    "an image of zeros": (lambda files, meta: files.update({"sh0.webp": of_size(12, 12)}), "sh0.webp"),
    "a large file": (lambda files, meta: files.update({"sh0.webp": bytes(10**7)}), "sh0.webp"),
    "four bands": (lambda files, meta: meta["shN"].update(bands=4), "shN"),
    "a huge palette": (lambda files, meta: meta["shN"].update(count=2**30), "shN"),
    "a small palette": (lambda files, meta: meta["shN"].update(count=3), "shN"),
    "a wrong quaternion": (lambda files, meta: files.update({"quats.webp": files["means_l.webp"]}), ""),
}


@pytest.mark.parametrize("kind", sorted(DAMAGE))
def test_a_damaged_archive_names_file_and_field(tmp_path: Path, kind: str) -> None:
    edit, field = DAMAGE[kind]
    path = archive(tmp_path / "map.sog", edit)
    if not field:  # opaque: every alpha is 255, which names z as the largest component
        assert len(load_gaussians(path)) == 100
        return
    with np.errstate(over="ignore", invalid="ignore"), pytest.raises(FormatError) as caught:
        load_gaussians(path)
    assert (caught.value.file, caught.value.field) == (str(path), field)
    assert caught.value.hint


def test_a_quaternion_that_names_no_component_is_refused(tmp_path: Path) -> None:
    def edit(files: dict[str, bytes], meta: dict[str, Any]) -> None:
        image = np.full((12, 12, 4), 251, np.uint8)
        files["quats.webp"] = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()

    with pytest.raises(FormatError, match="row 0 names no component"):
        load_gaussians(archive(tmp_path / "map.sog", edit))


@pytest.mark.parametrize("name", ["../secret.webp", "/etc/passwd", "a/b.webp", ".."])
def test_names_outside_of_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "map_sog"
    save_gaussians(detailed_model(20), folder)
    meta = json.loads((folder / "meta.json").read_text())
    (tmp_path / "secret.webp").write_bytes((folder / "sh0.webp").read_bytes())  # a valid image outside
    meta["sh0"]["files"] = [name]
    (folder / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(FormatError, match="names") as caught:
        load_gaussians(folder)
    assert caught.value.hint


@pytest.mark.parametrize("content", [b"PK", b"PK\x03\x04" + bytes(100), b"{", b"[1]", b'{"a": 1}', b"{" * 100_000])
def test_other_archives_and_documents_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "meta.json"
    path.write_bytes(content)
    with pytest.raises(FormatError) as caught:
        load_gaussians(path)
    assert caught.value.file == str(path)


def test_a_zip_bomb_is_not_inflated(tmp_path: Path) -> None:
    path = tmp_path / "map.sog"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as bomb, bomb.open("meta.json", "w") as member:
        for _ in range(20):
            member.write(bytes(2**20))
    with pytest.raises(FormatError, match="more than") as caught:
        load_gaussians(path)
    assert caught.value.field == "meta.json"


def test_an_archive_without_meta_json_is_named(tmp_path: Path) -> None:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as other:
        other.writestr("photo.txt", "x" * 40)
    path = tmp_path / "map.sog"
    path.write_bytes(content.getvalue())
    with pytest.raises(FormatError, match=r"no meta\.json"):
        load_gaussians(path)


def test_a_failed_write_leaves_the_old_folder_readable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "map_sog"
    save_gaussians(detailed_model(20), folder)

    def fail(descriptor: int) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="space"):
        save_gaussians(detailed_model(30), folder)
    assert len(load_gaussians(folder)) == 20
