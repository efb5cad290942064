"""All formats alike: detection by content, choice by suffix, and images before and after."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from splatbot.errors import FormatError, InputError
from splatbot.formats import FORMATS, WRITTEN, find_format, load_gaussians, save_gaussians
from splatbot.gaussians import GaussianModel
from splatbot.layouts import MAP_SUFFIXES, is_map, map_file
from splatbot.rasterize.views import default_view, render_view
from tests.unit.formats.models import detailed_model

SUFFIXES = [entry.suffix for entry in FORMATS]

# [dB] of images of colours in 0..1. Errors of opacities are at most 1/510, those of log scales 1/32 in SPZ and less in
# the others. So weights change by 3 % in SPZ and by 1 % in the others, on average. Colours differ by 0.4, so pixels by
# 0.012 (38 dB) and 0.004 (48 dB). The bounds leave room for a factor of 1.5.
# Axes grow by a tenth in SBZ, and opacities shrink to match: edges of Gaussians change by a few hundredths (30 dB).
LEAST_PSNR = {".sbz": 30.0, ".spz": 34.5}
LEAST_PSNR |= dict.fromkeys((".compressed.ply", ".sog", "_sog", ".splat", ".ksplat"), 44.5)


def name_of(suffix: str) -> str:
    return f"map{suffix}"


def files_of(path: Path) -> list[Path]:
    return sorted(path.iterdir()) if path.is_dir() else [path]


@pytest.fixture(scope="module")
def scene() -> GaussianModel:
    return detailed_model(1500, degree=2)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_image_after_a_round_trip_is_that_of_before(scene: GaussianModel, tmp_path: Path, suffix: str) -> None:
    wanted = scene
    if suffix in (".splat", ".sbz"):  # have no harmonics beyond DC
        wanted = scene.clone()
        wanted.sh = scene.sh[:, :1].contiguous()
    save_gaussians(wanted, tmp_path / name_of(suffix))
    back = load_gaussians(tmp_path / name_of(suffix))
    camera, pose = default_view(scene, width=160, height=120)
    before, after = (render_view(model, camera, pose) for model in (wanted, back))
    assert before.std() > 0.1
    if suffix == ".ply":
        assert np.array_equal(before, after)
        return
    psnr = -10 * np.log10(np.mean((before - after) ** 2))
    assert psnr > LEAST_PSNR.get(suffix, 90.0), f"{psnr:.1f} dB"


@pytest.mark.parametrize("suffix", [suffix for suffix in SUFFIXES if suffix not in (".splat", "_sog")])
def test_a_format_is_detected_whatever_its_name(tmp_path: Path, suffix: str) -> None:
    save_gaussians(detailed_model(20), tmp_path / name_of(suffix))
    shutil.copy(tmp_path / name_of(suffix), tmp_path / "map.bin")
    assert len(load_gaussians(tmp_path / "map.bin")) == 20


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_of_every_format_are_maps(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / name_of(suffix)
    save_gaussians(detailed_model(20), path)
    assert is_map(path)
    assert len(GaussianModel.load(map_file(path))) == 20
    assert map_file(path) == (path / "meta.json" if suffix == "_sog" else path)


def test_the_suffixes_of_maps_are_those_of_the_formats() -> None:
    assert set(MAP_SUFFIXES) == {Path(f"map{suffix}").suffix for suffix in SUFFIXES if suffix.startswith(".")}
    others = {"splat", "ksplat", "spz", "sbz", "sog", "glb", "usd", "usda", "usdc", "usdz"}
    assert set(WRITTEN) == {"ply", "compressed.ply"} | others


@pytest.mark.parametrize(
    ("name", "wanted"),
    [("a.PLY", "ply"), ("a.b.compressed.ply", "compressed_ply"), ("a.Splat", "splat"), ("x/scene_sog", "sog")],
)
def test_the_suffix_names_the_format(name: str, wanted: str) -> None:
    assert find_format(name).module == wanted


@pytest.mark.parametrize("name", ["map.obj", "map", "map.usd.gz", "map.gz"])
def test_an_unknown_suffix_lists_the_known_ones(name: str) -> None:
    with pytest.raises(FormatError, match=r"Fix: use .*\.spz.*\.glb") as caught:
        find_format(name)
    assert caught.value.field == "format"


@pytest.mark.parametrize("suffix", [suffix for suffix in SUFFIXES if suffix != ".ply"])
def test_an_empty_map_is_for_ply_only(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match=r"\.ply"):
        save_gaussians(GaussianModel.empty(), tmp_path / name_of(suffix))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_failed_write_leaves_the_old_map_and_no_litter(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name_of(suffix)
    save_gaussians(detailed_model(20), path)
    before = {file: file.read_bytes() for file in files_of(path)}

    def fail(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OSError, match="No space") as caught:
        save_gaussians(detailed_model(30), path)
    assert str(path) in str(caught.value.filename)
    assert {file: file.read_bytes() for file in files_of(path)} == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_tensors_are_contiguous_and_of_the_type_of_maps(tmp_path: Path, suffix: str) -> None:
    save_gaussians(detailed_model(20, degree=1), tmp_path / name_of(suffix))
    back = load_gaussians(tmp_path / name_of(suffix))
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        values = getattr(back, name)
        assert values.dtype == torch.float32
        assert values.is_contiguous()
    if suffix != ".sbz":
        assert back.observations.tolist() == [1] * 20
        assert back.anchors.tolist() == [-1] * 20
