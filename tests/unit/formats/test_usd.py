"""OpenUSD: the layout of the schema, round trips, axes and units, validity, and files that are refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils, UsdValidation, UsdVol, Vt

from splatbot.errors import FormatError, InputError
from splatbot.formats import load_gaussians, save_gaussians
from splatbot.formats.usd import load_usd, save_usd
from splatbot.gaussians import GaussianModel
from tests.unit.formats.models import ROUNDING, detailed_model, errors, quat_errors

SUFFIXES = ["usd", "usda", "usdc", "usdz"]
TURN = np.diag([1.0, -1.0, -1.0])  # from right, down, forward to right, up, back


def one_prim(path: Path) -> Usd.Prim:
    """Return the prim of a written file; its stage stays open with it."""
    stage = Usd.Stage.Open(Sdf.Layer.OpenAsAnonymous(str(path)))
    (prim,) = [prim for prim in stage.Traverse() if prim.IsA(UsdVol.ParticleField3DGaussianSplat)]
    prim.stage_kept = stage
    return prim


def write_usda(path: Path, *, up: str = "Y", unit: str = "metersPerUnit = 1", body: str = "", outer: str = "") -> Path:
    """Write one Gaussian at (1, 2, 3) as text of the published schema, below a transform."""
    path.write_text(
        f'#usda 1.0\n(\n{unit}\nupAxis = "{up}"\n)\n'
        f'def Xform "World"\n{{\n{outer}\n'
        'def ParticleField3DGaussianSplat "Splats"\n{\n'
        "point3f[] positions = [(1, 2, 3)]\n"
        f"{body}\n}}\n}}\n"
    )
    return path


DETAILS = """
quatf[] orientations = [(0.5, 0.5, 0.5, 0.5)]
float3[] scales = [(0.1, 0.2, 0.4)]
float[] opacities = [0.75]
uniform int radiance:sphericalHarmonicsDegree = 1
float3[] radiance:sphericalHarmonicsCoefficients = [(1, 2, 3), (4, 5, 6), (7, 8, 9), (10, 11, 12)]
"""


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_written_model_is_read_back(tmp_path: Path, suffix: str) -> None:
    model = detailed_model(50, degree=3)
    path = tmp_path / f"map.{suffix}"
    save_gaussians(model, path)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    back = load_gaussians(path)
    assert torch.equal(back.means, model.means)
    assert torch.equal(back.sh, model.sh)
    assert errors(back.log_scales, model.log_scales).max() <= 5 * ROUNDING
    assert errors(back.opacities, model.opacities).max() <= ROUNDING
    assert quat_errors(back, model).max() <= ROUNDING


@pytest.mark.parametrize("suffix", ["usda", "usdz"])
def test_pixars_library_finds_the_values_of_the_schema(tmp_path: Path, suffix: str) -> None:
    model = detailed_model(20, degree=2)
    save_usd(model, tmp_path / f"map.{suffix}")
    prim = one_prim(tmp_path / f"map.{suffix}")
    stage = prim.GetStage()
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    assert stage.GetDefaultPrim() == prim
    means = model.means.numpy() @ TURN
    assert np.array_equal(np.array(prim.GetAttribute("positions").Get()), means.astype(np.float32))
    for got, mean, quat, scale in zip(
        prim.GetAttribute("orientations").Get(),
        prim.GetAttribute("scales").Get(),
        model.quats.numpy(),
        model.scales.numpy(),
        strict=True,
    ):
        assert np.allclose(mean, scale, rtol=1e-6)
        w, x, y, z = (float(value) for value in quat / np.linalg.norm(quat))
        wanted = TURN @ np.array(Gf.Matrix3d(Gf.Quatd(w, x, y, z))).T @ TURN  # OpenUSD multiplies rows
        assert np.allclose(np.array(Gf.Matrix3d(Gf.Quatd(got))).T, wanted, atol=1e-6)
    assert np.allclose(np.array(prim.GetAttribute("opacities").Get()), model.opacities.numpy(), atol=1e-6)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 2
    terms = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()).reshape(20, 9, 3)
    assert np.array_equal(terms[:, 0], model.sh[:, 0].numpy())
    assert np.array_equal(terms[:, 1:4], model.sh[:, 1:4].numpy() * np.array([-1, -1, 1])[:, None])  # y, z, x
    low, high = np.array(prim.GetAttribute("extent").Get())
    assert (low < means.min(axis=0)).all()
    assert (high > means.max(axis=0)).all()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_written_file_is_valid(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map.{suffix}"
    save_usd(detailed_model(20, degree=1), path)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    stage = Usd.Stage.Open(str(path))
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert not [(error.GetName(), error.GetMessage()) for error in found]
    prim = stage.GetDefaultPrim()
    prim.GetAttribute("positions").Set(Vt.Vec3fArray(1))
    prim.SetMetadata("typeName", "ParticleField")  # without radiance
    stage.GetRootLayer().ClearDefaultPrim()
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert found  # the validators see an error


def test_a_text_of_the_schema_is_read(tmp_path: Path) -> None:
    model = load_usd(write_usda(tmp_path / "a.usda", body=DETAILS))
    assert model.means.tolist() == [[1, -2, -3]]
    assert model.quats[0].tolist() == pytest.approx([0.5, 0.5, -0.5, -0.5])
    assert model.scales[0].tolist() == pytest.approx([0.1, 0.2, 0.4])
    assert model.opacities.item() == pytest.approx(0.75)
    assert model.sh[0].tolist() == [[1, 2, 3], [-4, -5, -6], [-7, -8, -9], [10, 11, 12]]


def test_attributes_of_half_precision_are_read(tmp_path: Path) -> None:
    text = "\n".join(line.replace("float", "half").replace("quatf", "quath") for line in DETAILS.splitlines())
    for name in ("orientations", "scales", "opacities", "sphericalHarmonicsCoefficients"):
        text = text.replace(f"{name} =", f"{name}h =")
    path = write_usda(tmp_path / "a.usda", body=text)
    path.write_text(path.read_text().replace("point3f[] positions =", "point3h[] positionsh ="))
    model = load_usd(path)
    assert model.means.tolist() == [[1, -2, -3]]
    assert model.scales[0].tolist() == pytest.approx([0.1, 0.2, 0.4], rel=1e-3)
    assert model.quats[0].tolist() == [0.5, 0.5, -0.5, -0.5]
    assert model.sh[0, 3].tolist() == [10, 11, 12]


def test_absent_attributes_have_the_values_of_the_schema(tmp_path: Path) -> None:
    model = load_usd(write_usda(tmp_path / "a.usda"))
    assert model.quats.tolist() == [[1, 0, 0, 0]]
    assert model.scales.tolist() == [[1, 1, 1]]
    assert model.opacities.item() == pytest.approx(1.0, abs=1e-5)
    assert model.colors.tolist() == [[0.5, 0.5, 0.5]]


def test_poses_units_and_axes_are_applied(tmp_path: Path) -> None:
    outer = (
        "double3 xformOp:translate = (10, 20, 30)\nfloat xformOp:rotateZ = 90\nfloat3 xformOp:scale = (2, 2, 2)\n"
        'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ", "xformOp:scale"]'
    )
    # In the stage: scale to (2, 4, 6), rotate about z to (-4, 2, 6), translate to (6, 22, 36).
    unit = "metersPerUnit = 0.5"
    y_up = load_usd(write_usda(tmp_path / "y.usda", unit=unit, outer=outer, body=DETAILS))
    z_up = load_usd(write_usda(tmp_path / "z.usda", up="Z", unit=unit, outer=outer, body=DETAILS))
    assert y_up.means[0].tolist() == pytest.approx([3, -11, -18], rel=1e-6)  # right, down, forward
    assert z_up.means[0].tolist() == pytest.approx([3, -18, 11], rel=1e-6)  # up was z, forward was y
    for model in (y_up, z_up):
        assert model.scales[0].tolist() == pytest.approx([0.1, 0.2, 0.4], rel=1e-6)
    # The Gaussian turns x to y, y to z and z to x. The pose turns x to y and y to -x. So its axes are -x, z and y.
    for model, axes in ((y_up, [[-1, 0, 0], [0, 0, -1], [0, -1, 0]]), (z_up, [[-1, 0, 0], [0, -1, 0], [0, 0, 1]])):
        w, x, y, z = (float(value) for value in model.quats[0] / model.quats[0].norm())
        rotation = np.array(Gf.Matrix3d(Gf.Quatd(w, x, y, z)))  # rows are the axes
        covariance = rotation.T @ np.diag([0.01, 0.04, 0.16]) @ rotation
        wanted = np.array(axes, float).T @ np.diag([0.01, 0.04, 0.16]) @ np.array(axes, float)
        assert np.allclose(covariance, wanted, atol=1e-6)
    centimetres = load_usd(write_usda(tmp_path / "c.usda", unit=""))
    assert centimetres.means[0].tolist() == pytest.approx([0.01, -0.02, -0.03])


def test_several_prims_become_one_map(tmp_path: Path) -> None:
    path = write_usda(tmp_path / "a.usda", body=DETAILS)
    text = path.read_text()
    path.write_text(text + text[text.index("def Xform") :].replace('"World"', '"Other"'))
    assert load_usd(path).means.tolist() == [[1, -2, -3]] * 2


@pytest.mark.parametrize("own", [True, False])
def test_invisible_prims_are_skipped(tmp_path: Path, own: bool) -> None:
    hidden = 'token visibility = "invisible"'
    path = write_usda(tmp_path / "a.usda", body=hidden if own else "", outer="" if own else hidden)
    with pytest.raises(FormatError, match="no visible prim"):
        load_usd(path)
    shown = write_usda(tmp_path / "b.usda").read_text()
    path.write_text(path.read_text() + shown[shown.index("def Xform") :].replace('"World"', '"Other"'))
    assert len(load_usd(path)) == 1


def test_each_instance_of_a_prim_is_read_at_its_pose(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    instance = (
        'def Xform "I{0}" (\ninstanceable = true\nreferences = </_Shelf>\n)\n{{\n'
        'double3 xformOp:translate = ({0}, 0, 0)\nuniform token[] xformOpOrder = ["xformOp:translate"]\n}}\n'
    )
    path.write_text(
        '#usda 1.0\n(\nmetersPerUnit = 1\nupAxis = "Y"\n)\nclass Xform "_Shelf"\n{\n'
        'def ParticleField3DGaussianSplat "Splats"\n{\npoint3f[] positions = [(1, 2, 3)]\n}\n}\n'
        + instance.format(10)
        + instance.format(20)
    )
    assert sorted(load_usd(path).means.tolist()) == [[11, -2, -3], [21, -2, -3]]


def test_absent_harmonics_have_degree_0(tmp_path: Path) -> None:
    assert load_usd(write_usda(tmp_path / "a.usda")).sh.shape == (1, 1, 3)


def test_the_decoded_size_of_all_prims_together_is_bounded(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usdc"))
    for index in range(70):  # 78 MB of zeros together, which the file stores once
        prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/Splats{index}").GetPrim()
        prim.GetAttribute("positions").Set(Vt.Vec3fArray(20_000))
    stage.Save()
    with pytest.raises(FormatError, match=f"claims {70 * 20_000 * (3 + 4 + 3 + 1 + 3) * 4:,} bytes") as caught:
        load_usd(tmp_path / "a.usdc")
    assert caught.value.field == "positions"


def test_a_module_in_the_current_folder_does_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_usda(tmp_path / "a.usda")
    (tmp_path / "resource.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    assert len(load_usd(path)) == 1
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "positions", ["point3f positions = (1, 2, 3)", "float positions = 1", "float[] positions = [1]"]
)
def test_positions_that_are_no_array_of_points_are_refused(tmp_path: Path, positions: str) -> None:
    path = write_usda(tmp_path / "a.usda")
    path.write_text(path.read_text().replace("point3f[] positions = [(1, 2, 3)]", positions))
    with pytest.raises(FormatError, match="damaged") as caught:
        load_gaussians(path)
    assert (caught.value.file, caught.value.field) == (str(path), "/World/Splats.positions")


SCALED = 'float3 xformOp:scale = ({}, 1, 2)\nuniform token[] xformOpOrder = ["xformOp:scale"]'


@pytest.mark.parametrize(
    ("body", "outer", "field", "problem"),
    [
        ("float3[] scales = []\nuniform int radiance:sphericalHarmonicsDegree = 9", "", "Degree", "is 9"),
        ("uniform int radiance:sphericalHarmonicsDegree = -1", "", "Degree", "is -1"),
        ("float3[] radiance:sphericalHarmonicsCoefficients = [(1, 2, 3)]", "", "Coefficients", "3 of 48 numbers"),
        ("float3[] scales = [(nan, 1, 1)]", "", "log_scales", "NaN"),
        ("float3[] scales = [(-1, 1, 1)]", "", "log_scales", "NaN"),
        (
            "",
            SCALED.format(1),
            "/World",
            "unevenly",
        ),
        (
            "",
            SCALED.format(-1),
            "/World",
            "mirrors",
        ),
        ("unfinished", "", "prims", r"damaged or truncated \(a.usda:\d+:\d+: "),
    ],
)
def test_unusable_values_are_named(tmp_path: Path, body: str, outer: str, field: str, problem: str) -> None:
    path = write_usda(tmp_path / "a.usda", body=body, outer=outer)
    with pytest.raises(FormatError, match=problem) as caught:
        load_gaussians(path)
    assert caught.value.file == str(path)
    assert field in (caught.value.field or "")
    assert caught.value.hint


def test_files_without_gaussians_and_files_that_need_others_are_refused(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "points.usda"))
    UsdGeom.Points.Define(stage, "/Points")
    stage.Save()
    with pytest.raises(FormatError, match="no visible prim ParticleField3DGaussianSplat"):
        load_gaussians(tmp_path / "points.usda")
    save_usd(detailed_model(3), tmp_path / "map.usdc")
    for arc in ("subLayers = [@./map.usdc@]", "subLayers = [@/etc/passwd@]"):
        (tmp_path / "other.usda").write_text(f"#usda 1.0\n(\n{arc}\n)\n")
        with pytest.raises(FormatError, match="needs the file") as caught:
            load_gaussians(tmp_path / "other.usda")
        assert caught.value.field == "references"
    (tmp_path / "other.usda").write_text('#usda 1.0\ndef "A" (references = @./map.usdc@)\n{\n}\n')
    with pytest.raises(FormatError, match="needs the file"):
        load_gaussians(tmp_path / "other.usda")


def test_a_file_that_aborts_openusd_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "map.usdc"
    save_usd(detailed_model(80, degree=1), path)
    sound = path.read_bytes()
    for cut in (60, len(sound) // 2, len(sound) - 100):
        path.write_bytes(sound[:cut])
        with pytest.raises(FormatError, match="damaged or truncated") as caught:
            load_gaussians(path)
        assert (caught.value.file, caught.value.field) == (str(path), "prims")
        assert not any(words in str(caught.value) for words in ("/map.usd@", "NoneType"))


def test_without_the_extra_one_sentence_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_usda(tmp_path / "a.usda")
    monkeypatch.setitem(sys.modules, "pxr.UsdVol", None)
    for attempt in (lambda: load_usd(path), lambda: save_usd(detailed_model(3), tmp_path / "b.usdz")):
        with pytest.raises(InputError, match=r"Fix: pip install 'splatbot\[usd\]'"):
            attempt()
    assert not (tmp_path / "b.usdz").exists()


def test_convert_writes_a_package_and_reads_it(tmp_path: Path) -> None:
    GaussianModel.save(detailed_model(10, degree=1), tmp_path / "map.ply")
    for source, target in (("map.ply", "map.usdz"), ("map.usdz", "back.ply")):
        words = [sys.executable, "-m", "splatbot", "convert", str(tmp_path / source), str(tmp_path / target)]
        subprocess.run(words, check=True, capture_output=True, timeout=120)
    assert torch.equal(load_gaussians(tmp_path / "back.ply").means, detailed_model(10, degree=1).means)
    assert UsdUtils.ExtractExternalReferences(str(tmp_path / "map.usdz")) == ([], [], [])
