"""3DGS PLY: bit-identical storage, and errors for damaged files."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch

from splatbot.errors import FormatError, InputError
from splatbot.formats import load_gaussians, save_gaussians
from splatbot.formats.ply import load_ply, save_ply
from splatbot.gaussians import GaussianModel
from splatbot.rasterize.views import default_view, render_view

STORED = ("means", "quats", "log_scales", "opacity_logits", "sh")


def random_model(n: int = 50, degree: int = 0, seed: int = 0) -> GaussianModel:
    g = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh": ((degree + 1) ** 2, 3)}
    arrays = {name: torch.randn(n, *shape, generator=g) for name, shape in shapes.items()}
    counts = torch.arange(n, dtype=torch.int32)
    return GaussianModel(**arrays, observations=counts + 2, anchors=counts - 1)


def columns(vertex: plyfile.PlyElement, *names: str) -> np.ndarray:
    return np.stack([vertex[name] for name in names], axis=-1)


def edit(path: Path, **values: float) -> None:
    """Set property `name` of row 7 to a value, for each keyword."""
    ply = plyfile.PlyData.read(str(path), mmap=False)
    for name, value in values.items():
        ply["vertex"].data[name][7] = value
    ply.write(str(path))


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("normals", [True, False])
def test_a_written_model_reads_back_bit_for_bit(tmp_path: Path, degree: int, normals: bool) -> None:
    model = random_model(degree=degree)
    save_ply(model, tmp_path / "map.ply", normals=normals)
    back = load_ply(tmp_path / "map.ply")
    assert back.sh_degree == degree
    for name in STORED:
        assert torch.equal(getattr(back, name), getattr(model, name)), name
        assert getattr(back, name).is_contiguous()
    assert (back.observations == 1).all()
    assert (back.anchors == -1).all()


def test_plyfile_finds_every_value_under_its_standard_name(tmp_path: Path) -> None:
    model = random_model(degree=3)
    save_gaussians(model, tmp_path / "map.ply")
    ply = plyfile.PlyData.read(str(tmp_path / "map.ply"))
    vertex = ply["vertex"]
    assert ply.byte_order == "<"
    assert not ply.text
    standard = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    standard += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    assert [p.name for p in vertex.properties] == standard
    assert np.array_equal(columns(vertex, "x", "y", "z"), model.means.numpy())
    assert np.array_equal(columns(vertex, "f_dc_0", "f_dc_1", "f_dc_2"), model.sh[:, 0].numpy())
    assert np.array_equal(vertex["opacity"], model.opacity_logits.numpy())
    assert np.array_equal(columns(vertex, "scale_0", "scale_1", "scale_2"), model.log_scales.numpy())
    assert np.array_equal(columns(vertex, "rot_0", "rot_1", "rot_2", "rot_3"), model.quats.numpy())
    for channel in range(3):  # channel-major: 15 of red, 15 of green, 15 of blue
        names = [f"f_rest_{15 * channel + k}" for k in range(15)]
        assert np.array_equal(columns(vertex, *names), model.sh[:, 1:, channel].numpy())


@pytest.mark.parametrize("degree", [0, 3])
def test_what_plyfile_reads_renders_to_the_identical_image(tmp_path: Path, degree: int) -> None:
    model = random_model(degree=degree)
    save_gaussians(model, tmp_path / "map.ply")
    vertex = plyfile.PlyData.read(str(tmp_path / "map.ply"))["vertex"]
    k = model.sh.shape[1] - 1  # coefficients beyond DC, channel by channel
    rest = [vertex[f"f_rest_{i}"] for i in range(3 * k)]
    dc = columns(vertex, "f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    sh = np.concatenate([dc, np.reshape(rest, (3, k, len(model))).transpose(2, 1, 0)], axis=1)
    read = replace(
        model,
        means=torch.from_numpy(columns(vertex, "x", "y", "z")),
        quats=torch.from_numpy(columns(vertex, "rot_0", "rot_1", "rot_2", "rot_3")),
        log_scales=torch.from_numpy(columns(vertex, "scale_0", "scale_1", "scale_2")),
        opacity_logits=torch.from_numpy(np.array(vertex["opacity"])),
        sh=torch.from_numpy(sh.astype(np.float32)),
    )
    camera, pose = default_view(model, width=160, height=120)
    image = render_view(model, camera, pose)
    assert (image > 0.1).mean() > 0.05  # something is seen
    assert np.array_equal(render_view(read, camera, pose), image)


def test_an_empty_model_reads_back_empty(tmp_path: Path) -> None:
    GaussianModel.empty(sh_degree=1).save(tmp_path / "map.ply")
    back = GaussianModel.load(tmp_path / "map.ply")
    assert len(back) == 0
    assert back.sh_degree == 1


def test_bookkeeping_is_kept_on_request_and_ignored_by_plyfile_readers(tmp_path: Path) -> None:
    model = random_model(degree=1)
    model.uncertainty = 0.01 * torch.rand(len(model))
    model.misses = torch.arange(len(model), dtype=torch.int32)
    bookkeeping = ["observations", "anchors", "uncertainty", "misses"]
    save_ply(model, tmp_path / "map.ply", bookkeeping=True)
    back = load_ply(tmp_path / "map.ply")
    for name in (*STORED, *bookkeeping):
        assert torch.equal(getattr(back, name), getattr(model, name)), name
    vertex = plyfile.PlyData.read(str(tmp_path / "map.ply"))["vertex"]
    assert [p.name for p in vertex.properties][-4:] == bookkeeping
    assert np.array_equal(columns(vertex, "rot_0", "rot_1", "rot_2", "rot_3"), model.quats.numpy())


@pytest.mark.parametrize("layout", ["text", "big_endian", "double", "shuffled"])
def test_other_encodings_of_the_same_values_read_alike(tmp_path: Path, layout: str) -> None:
    model = random_model(degree=1)
    path = tmp_path / "map.ply"
    save_ply(model, path)
    data = plyfile.PlyData.read(str(path), mmap=False)["vertex"].data
    names = list(data.dtype.names)
    if layout == "shuffled":
        names = names[::-1]
    kind = "f8" if layout in ("double", "text") else "f4"
    other = np.empty(len(data), dtype=[(name, kind) for name in names])
    for name in names:
        other[name] = data[name]
    order = ">" if layout == "big_endian" else "<"
    element = plyfile.PlyElement.describe(other, "vertex")
    plyfile.PlyData([element], text=layout == "text", byte_order="=" if layout == "text" else order).write(str(path))
    back = load_ply(path)
    for name in STORED:
        assert torch.equal(getattr(back, name), getattr(model, name)), name


@pytest.mark.parametrize(("name", "count", "degree"), [("donut_sh0.ply", 45_624, 0), ("kacy_sh3_9080.ply", 9_080, 3)])
def test_real_splats_load_as_plyfile_reads_them(data_root: Path, name: str, count: int, degree: int) -> None:
    path = data_root / "splats" / name
    model = load_gaussians(path)
    vertex = plyfile.PlyData.read(str(path))["vertex"]
    assert (len(model), model.sh_degree) == (count, degree)
    assert np.array_equal(model.means.numpy(), columns(vertex, "x", "y", "z"))
    assert np.array_equal(model.quats.numpy(), columns(vertex, "rot_0", "rot_1", "rot_2", "rot_3"))
    last = (degree + 1) ** 2 - 1
    for channel in range(3 if degree else 0):
        stored = vertex[f"f_rest_{channel * last + last - 1}"]
        assert np.array_equal(model.sh[:, last, channel].numpy(), stored)


def test_real_splats_are_written_back_unchanged(data_root: Path, tmp_path: Path) -> None:
    path = data_root / "splats" / "donut_sh0.ply"
    save_ply(load_ply(path), tmp_path / "copy.ply", normals=False)
    assert (tmp_path / "copy.ply").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("keep", [0.05, 0.5, 0.999])
def test_a_truncated_file_is_named_with_the_fix(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "map.ply"
    save_ply(random_model(), path)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(FormatError, match=r"truncated.*Fix: ") as caught:
        load_gaussians(path)
    assert caught.value.file == str(path)
    assert caught.value.field == "vertex"
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("missing", ["opacity", "rot_3", "f_dc_0", "scale_1"])
def test_a_missing_property_is_named(tmp_path: Path, missing: str) -> None:
    path = tmp_path / "map.ply"
    save_ply(random_model(), path)
    data = plyfile.PlyData.read(str(path), mmap=False)["vertex"].data
    kept = [name for name in data.dtype.names if name != missing]
    rest = np.empty(len(data), dtype=[(name, "f4") for name in kept])
    for name in kept:
        rest[name] = data[name]
    plyfile.PlyData([plyfile.PlyElement.describe(rest, "vertex")]).write(str(path))
    with pytest.raises(FormatError, match="no " + missing) as caught:
        load_ply(path)
    assert caught.value.field == missing
    assert caught.value.hint


def test_rows_with_nan_are_counted_and_the_first_is_named(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    save_ply(random_model(), path)
    edit(path, y=float("nan"), opacity=float("nan"))
    with pytest.raises(FormatError, match="1 of 50 rows hold NaN or infinity, the first is row 7") as caught:
        load_ply(path)
    assert caught.value.field == "y"
    assert caught.value.hint


@pytest.mark.parametrize("name", ["x", "f_dc_1", "scale_0", "rot_2"])
def test_infinite_values_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "map.ply"
    save_ply(random_model(), path)
    edit(path, **{name: float("inf")})
    with pytest.raises(FormatError) as caught:
        load_ply(path)
    assert caught.value.field == name


def test_zero_quaternions_become_the_identity_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "map.ply"
    save_ply(random_model(), path)
    edit(path, rot_0=0, rot_1=0, rot_2=-0.0, rot_3=0)
    with caplog.at_level(logging.WARNING):
        model = load_ply(path)
    assert model.quats[7].tolist() == [1, 0, 0, 0]
    assert "1 zero quaternions" in caplog.text
    assert str(path) in caplog.text


def test_opacity_of_exactly_one_and_scale_of_exactly_zero_become_finite(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "map.ply"
    save_ply(random_model(), path)
    edit(path, opacity=float("inf"), scale_1=float("-inf"))
    with caplog.at_level(logging.WARNING):
        model = load_ply(path)
    assert model.opacities[7].item() == pytest.approx(1.0, abs=2e-6)
    assert model.scales[7, 1].item() == pytest.approx(1e-9, rel=1e-5)
    assert torch.isfinite(model.opacity_logits).all()
    assert len(caplog.records) == 2


@pytest.mark.parametrize(
    ("name", "value"),
    [("uncertainty", np.nan), ("uncertainty", np.inf), ("uncertainty", -1), ("observations", -1), ("misses", -1)],
)
def test_impossible_bookkeeping_is_refused(tmp_path: Path, name: str, value: float) -> None:
    path = tmp_path / "map.ply"
    save_ply(random_model(), path, bookkeeping=True)
    edit(path, **{name: value})
    with pytest.raises(FormatError, match="damaged") as caught:
        load_ply(path)
    assert (caught.value.file, caught.value.field) == (str(path), name)


def test_an_impossible_number_of_coefficients_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    save_ply(random_model(degree=1), path)
    data = path.read_bytes().replace(b"f_rest_8\n", b"f_last_8\n")
    path.write_bytes(data)
    with pytest.raises(FormatError, match="8 coefficients") as caught:
        load_ply(path)
    assert caught.value.field == "f_rest"


def test_compressed_ply_is_told_apart(data_root: Path) -> None:
    with pytest.raises(FormatError, match="compressed"):
        load_ply(data_root / "splats" / "biker.compressed.ply")


@pytest.mark.parametrize(("name", "content"), [("map.bin", b"\0" * 32), ("map.ply", b""), ("map.splat", b"")])
def test_an_unknown_format_lists_the_known_ones(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(FormatError, match=r"Fix: .*PLY") as caught:
        load_gaussians(path)
    assert caught.value.file == str(path)


def test_a_missing_file_and_an_unknown_suffix_are_format_errors(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="No such file"):
        load_gaussians(tmp_path / "none.ply")
    with pytest.raises(FormatError, match="directory"):
        load_gaussians(tmp_path)
    with pytest.raises(FormatError, match=r"\.ply"):
        save_gaussians(random_model(), tmp_path / "map.obj")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", [-5, 50_000_001, 40_000_000, 2**40, 10**30])
@pytest.mark.parametrize("property_", ["float x", "list uchar float x"])
def test_a_count_that_the_file_cannot_hold_is_refused_before_it_is_read(
    tmp_path: Path, kind: str, count: int, property_: str
) -> None:
    path = tmp_path / "map.ply"
    header = f"ply\nformat {kind} 1.0\nelement vertex {count}\nproperty {property_}\nend_header\n1 2 3\n"
    path.write_text(header)
    with pytest.raises(FormatError, match=f"claims {count:,} rows") as caught:
        load_gaussians(path)
    assert (caught.value.file, caught.value.field) == (str(path), "vertex")


def test_any_damage_of_the_header_is_a_format_error_or_harmless(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "map.ply"
    save_ply(random_model(n=3), path)
    sound = path.read_bytes()
    header = sound.index(b"end_header")
    refused = 0
    for _ in range(500):
        data = bytearray(sound)
        for at in rng.integers(4, header, size=3):
            data[at] = rng.integers(0, 256)
        path.write_bytes(data)
        try:
            load_gaussians(path)
        except InputError as caught:
            refused += 1
            error = caught
        else:
            continue
        assert error.file == str(path)
        assert error.hint
    assert refused > 250


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "map.ply"
    save_ply(random_model(seed=1), path)
    before = path.read_bytes()

    def fail(draft: Path, target: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("splatbot.atomic.replace", fail)
    with pytest.raises(KeyboardInterrupt):
        save_ply(random_model(seed=2), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
