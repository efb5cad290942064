"""glTF: round trips of all bits, poses of nodes, other readers, and hostile documents."""

from __future__ import annotations

import json
import logging
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from splatbot.errors import FormatError
from splatbot.formats import load_gaussians, save_gaussians
from splatbot.formats.glb import EXTENSION, load_glb, save_glb
from splatbot.geometry import quat_to_rotation, rotation_to_quat, so3_exp
from splatbot.rasterize.views import default_view, render_view
from tests.unit.formats.models import ROUNDING, detailed_model, errors, quat_errors

Json = dict[str, Any]


def parts(path: Path) -> tuple[Json, bytes]:
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def write(path: Path, document: object, binary: bytes) -> None:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    size = 28 + len(text) + len(binary)
    head = b"glTF" + struct.pack("<III", 2, size, len(text)) + b"JSON"
    path.write_bytes(head + text + struct.pack("<I", len(binary)) + b"BIN\0" + binary)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_a_written_model_is_read_back_with_all_bits(tmp_path: Path, degree: int) -> None:
    model = detailed_model(300, degree)
    save_gaussians(model, tmp_path / "map.glb")
    back = load_gaussians(tmp_path / "map.glb")
    kept = min(degree, 3)
    assert back.sh_degree == kept
    assert torch.equal(back.means, model.means)
    assert torch.equal(back.sh, model.sh[:, : (kept + 1) ** 2])
    assert errors(back.log_scales, model.log_scales).max() <= 5 * ROUNDING
    assert errors(back.opacities, model.opacities).max() <= ROUNDING
    assert quat_errors(back, model).max() <= ROUNDING


def test_the_file_has_the_layout_of_the_extension(tmp_path: Path) -> None:
    model = detailed_model(30, degree=1)
    save_glb(model, tmp_path / "map.glb")
    document, binary = parts(tmp_path / "map.glb")
    (primitive,) = document["meshes"][0]["primitives"]
    assert document["extensionsUsed"] == [EXTENSION]
    assert primitive["mode"] == 0
    assert primitive["extensions"][EXTENSION]["kernel"] == "ellipse"
    assert primitive["extensions"][EXTENSION]["colorSpace"] == "srgb_rec709_display"
    names = ["ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0", *(f"SH_DEGREE_1_COEF_{n}" for n in range(3))]
    assert set(primitive["attributes"]) == {"POSITION", "COLOR_0", *(f"{EXTENSION}:{name}" for name in names)}

    def values(name: str, components: int) -> np.ndarray:
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        start = view["byteOffset"]
        return np.frombuffer(binary[start : start + view["byteLength"]], "<f4").reshape(30, components)

    flip = np.array([-1, -1, 1])  # from right, down, forward to left, up, forward
    assert np.array_equal(values("POSITION", 3), model.means.numpy() * flip)
    assert values(f"{EXTENSION}:SCALE", 3) == pytest.approx(model.scales.numpy(), rel=1e-5)
    assert values(f"{EXTENSION}:OPACITY", 1)[:, 0] == pytest.approx(model.opacities.numpy(), abs=ROUNDING)
    x, y, z, w = values(f"{EXTENSION}:ROTATION", 4).T.astype(np.float64)
    R = quat_to_rotation(np.stack([w, x, y, z], axis=1))
    covariance = R * values(f"{EXTENSION}:SCALE", 3)[:, None] ** 2 @ R.transpose(0, 2, 1)
    own = quat_to_rotation(model.quats.numpy())
    wanted = np.diag(flip) @ (own * model.scales.numpy()[:, None] ** 2 @ own.transpose(0, 2, 1)) @ np.diag(flip)
    assert covariance == pytest.approx(wanted, abs=ROUNDING)
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert position["max"] == values("POSITION", 3).max(axis=0).tolist()
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])


def test_other_readers_find_a_point_cloud_with_linear_colours(tmp_path: Path) -> None:
    model = detailed_model(30)
    save_glb(model, tmp_path / "map.glb")
    (cloud,) = trimesh.load_scene(tmp_path / "map.glb").geometry.values()
    assert isinstance(cloud, trimesh.PointCloud)
    assert np.array_equal(cloud.vertices, model.means.numpy() * (-1, -1, 1))
    srgb = model.colors.numpy().astype(np.float64)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    assert np.abs(cloud.colors[:, :3] / 255 - linear).max() <= 0.5 / 255 + ROUNDING
    assert np.abs(cloud.colors[:, 3] / 255 - model.opacities.numpy()).max() <= 0.5 / 255 + ROUNDING


def edited(path: Path, edit: Callable[[Json], object], degree: int = 1) -> Path:
    save_glb(detailed_model(100, degree), path)
    document, binary = parts(path)
    edit(document)
    write(path, document, binary)
    return path


def test_the_pose_of_a_node_moves_its_splats_and_their_colours(tmp_path: Path) -> None:
    model = detailed_model(100, degree=3)
    R, t, scale = so3_exp([0.2, 0.5, -0.9]), np.array([0.3, -0.2, 0.4]), 1.5
    w, x, y, z = rotation_to_quat(R)
    child = {"mesh": 0, "rotation": [x, y, z, w], "scale": [scale] * 3}

    def edit(document: Json) -> None:
        document["nodes"] = [{"children": [1], "translation": t.tolist()}, child]

    moved = load_glb(edited(tmp_path / "moved.glb", edit, degree=3))
    flip = np.diag([-1.0, -1, 1])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = scale * flip @ R @ flip, flip @ t
    camera, pose = default_view(model, width=96, height=72)
    here = render_view(model, camera, pose)
    seen = T @ pose  # the same view of the moved splats: their camera turns along, distances grow by the scale
    seen[:3, :3] = seen[:3, :3] / scale
    there = render_view(moved, camera, seen)
    assert here.max() > 0.5
    assert np.abs(here - there).max() < 1e-3


def test_a_matrix_is_read_by_columns(tmp_path: Path) -> None:
    shift = np.eye(4)
    shift[:3, 3] = [1.0, 2.0, 3.0]
    path = edited(tmp_path / "map.glb", lambda d: d["nodes"][0].update(matrix=shift.T.flatten().tolist()))
    wanted = detailed_model(100, 1).means.numpy() + np.array([-1, -2, 3])
    assert load_glb(path).means.numpy() == pytest.approx(wanted, abs=ROUNDING * 5)


def test_several_primitives_make_one_map(tmp_path: Path) -> None:
    def edit(document: Json) -> None:
        document["nodes"].append({"mesh": 0, "translation": [0, 1, 0]})
        document["scenes"][0]["nodes"] = [0, 1]
        document["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}})  # a mesh, not splats

    assert len(load_glb(edited(tmp_path / "map.glb", edit))) == 200


def quantized(path: Path, name: str, dtype: str, code: int, factor: float, *, normalized: bool) -> None:
    """Replace an attribute of a file by integers."""
    document, binary = parts(path)
    index = document["meshes"][0]["primitives"][0]["attributes"][f"{EXTENSION}:{name}"]
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    start = view["byteOffset"]
    floats = np.frombuffer(binary[start : start + view["byteLength"]], "<f4").reshape(accessor["count"], -1)
    rows = np.rint(floats * factor).astype(dtype)
    step = -(-rows[0].nbytes // 4) * 4
    content = b"".join(row.tobytes().ljust(step, b"\0") for row in rows)
    document["bufferViews"].append(
        {"buffer": 0, "byteOffset": len(binary), "byteLength": len(content), "byteStride": step}
    )
    accessor.update(bufferView=len(document["bufferViews"]) - 1, componentType=code, normalized=normalized)
    document["buffers"][0]["byteLength"] = len(binary) + len(content)
    write(path, document, binary + content)


def test_integers_with_a_stride_are_read(tmp_path: Path) -> None:
    path, model = tmp_path / "map.glb", detailed_model(100)
    model.log_scales += 4.0  # integers of metres would be zeros
    save_glb(model, path)
    quantized(path, "ROTATION", "<i2", 5122, 32767, normalized=True)
    quantized(path, "OPACITY", "<u1", 5121, 255, normalized=True)
    quantized(path, "SCALE", "<u2", 5123, 1, normalized=False)
    back = load_glb(path)
    assert quat_errors(back, model).max() <= 2 / 32767
    assert errors(back.opacities, model.opacities).max() <= 0.5 / 255 + ROUNDING
    scales = torch.round(model.scales)
    assert errors(back.scales, torch.clamp(scales, min=1e-9)).max() <= 1e-4


def test_logarithms_of_earlier_drafts_are_read_and_single_negative_scales_refused(tmp_path: Path) -> None:
    path, model = tmp_path / "map.glb", detailed_model(100)
    save_glb(model, path)
    document, binary = parts(path)
    view = document["bufferViews"][document["meshes"][0]["primitives"][0]["attributes"][f"{EXTENSION}:SCALE"]]
    start, end = view["byteOffset"], view["byteOffset"] + view["byteLength"]
    write(path, document, binary[:start] + model.log_scales.numpy().tobytes() + binary[end:])
    assert torch.equal(load_glb(path).log_scales, model.log_scales)
    write(path, document, binary[:start] + struct.pack("<f", -0.1) + binary[start + 4 :])
    with pytest.raises(FormatError, match="row 0 is negative") as caught:
        load_glb(path)
    assert caught.value.field == "SCALE"


def of_accessor(name: str, **values: object) -> Callable[[Json], object]:
    def edit(document: Json) -> None:
        index = document["meshes"][0]["primitives"][0]["attributes"][name]
        document["accessors"][index].update(values)

    return edit


def drop(name: str) -> Callable[[Json], object]:
    return lambda document: document["meshes"][0]["primitives"][0]["attributes"].pop(f"{EXTENSION}:{name}")


def of_extension(**values: object) -> Callable[[Json], object]:
    return lambda document: document["meshes"][0]["primitives"][0]["extensions"][EXTENSION].update(values)


def instances(document: Json) -> None:
    document["meshes"][0]["primitives"] *= 1000
    document["nodes"] = [{"mesh": 0}] * 1000
    document["scenes"][0]["nodes"] = list(range(1000))


OPACITY = f"{EXTENSION}:OPACITY"
DAMAGE: dict[str, tuple[Callable[[Json], object], str]] = {
    "a huge count": (of_accessor("POSITION", count=2**40), "POSITION"),
    "a negative count": (of_accessor("POSITION", count=-3), "POSITION"),
    "an infinite count": (of_accessor("POSITION", count=float("inf")), "JSON"),
    "NaN as count": (of_accessor("POSITION", count=float("nan")), "JSON"),
    "another count": (of_accessor(OPACITY, count=99), "attributes"),
    "too large a count": (of_accessor(OPACITY, count=101), OPACITY),
    "a view beyond the list": (of_accessor(OPACITY, bufferView=99), "JSON"),
    "a negative view": (of_accessor(OPACITY, bufferView=-1), "JSON"),
    "an offset": (of_accessor(OPACITY, byteOffset=2**60), OPACITY),
    "a negative offset": (of_accessor(OPACITY, byteOffset=-4), OPACITY),
    "an unknown component": (of_accessor(OPACITY, componentType=5124), "JSON"),
    "another type": (of_accessor(OPACITY, type="VEC4"), OPACITY),
    "sparse values": (of_accessor(OPACITY, sparse={"count": 1}), OPACITY),
    "no rotation": (drop("ROTATION"), f"{EXTENSION}:ROTATION"),
    "half a degree": (drop("SH_DEGREE_1_COEF_2"), f"{EXTENSION}:SH_DEGREE_1_COEF_2"),
    "another kernel": (of_extension(kernel="box"), EXTENSION),
    "compression": (of_extension(extensions={"KHR_gaussian_splatting_compression_spz_2": {}}), EXTENSION),
    "a stride of nothing": (lambda d: d["bufferViews"][3].update(byteStride=1), OPACITY),
    "a view beyond the buffer": (lambda d: d["bufferViews"][3].update(byteOffset=2**40), OPACITY),
    "another file": (lambda d: d["buffers"][0].update(uri="http://x/y.bin"), "POSITION"),
    "a mesh alone": (lambda d: d["meshes"][0]["primitives"][0].pop("extensions"), EXTENSION),
    "no mesh": (lambda d: d["nodes"][0].pop("mesh"), EXTENSION),
    "a loop of nodes": (lambda d: d["nodes"][0].update(children=[0]), "nodes"),
    "a missing node": (lambda d: d["nodes"][0].update(children=[7]), "JSON"),
    "a mirroring node": (lambda d: d["nodes"][0].update(scale=[-1, 1, 1]), "nodes"),
    "an uneven node": (lambda d: d["nodes"][0].update(scale=[1, 2, 1]), "nodes"),
    "a node without size": (lambda d: d["nodes"][0].update(scale=[0, 0, 0]), "nodes"),
    "a zero rotation": (lambda d: d["nodes"][0].update(rotation=[0, 0, 0, 0]), "JSON"),
    "a text as matrix": (lambda d: d["nodes"][0].update(matrix="abc"), "JSON"),
    "lists for objects": (lambda d: d.update(nodes=[[], []]), "JSON"),
    "a million instances": (instances, "nodes"),
}


@pytest.mark.parametrize("kind", sorted(DAMAGE))
def test_a_damaged_document_names_file_and_field(tmp_path: Path, kind: str) -> None:
    edit, field = DAMAGE[kind]
    path = edited(tmp_path / "map.glb", edit)
    with pytest.raises(FormatError) as caught:
        load_gaussians(path)
    assert (caught.value.file, caught.value.field) == (str(path), field)
    assert caught.value.hint


@pytest.mark.parametrize("document", [[], None, 1, {"meshes": 5}, {"nodes": {}}, {"scenes": [1]}, {}])
def test_a_document_of_something_else_is_refused(tmp_path: Path, document: object) -> None:
    write(tmp_path / "map.glb", document, b"")
    with pytest.raises(FormatError):
        load_gaussians(tmp_path / "map.glb")


def test_a_deep_document_is_refused(tmp_path: Path) -> None:
    text = b"[" * 100_000
    path = tmp_path / "map.glb"
    path.write_bytes(b"glTF" + struct.pack("<III", 2, 20 + len(text), len(text)) + b"JSON" + text)
    with pytest.raises(FormatError):
        load_gaussians(path)


@pytest.mark.parametrize("keep", [0.001, 0.1, 0.5, 0.999])
def test_a_truncated_file_is_named(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "map.glb"
    save_glb(detailed_model(300), path)
    content = path.read_bytes()
    path.write_bytes(content[: max(4, int(keep * len(content)))])
    with pytest.raises(FormatError, match="damaged or truncated") as caught:
        load_gaussians(path)
    assert caught.value.file == str(path)


def test_opacities_of_exactly_0_and_1_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model = detailed_model(3)
    model.opacity_logits[:] = torch.tensor([-200.0, 0.0, 200.0])
    save_glb(model, tmp_path / "map.glb")
    with caplog.at_level(logging.WARNING):
        back = load_glb(tmp_path / "map.glb")
    assert back.opacities.tolist() == pytest.approx([0, 0.5, 1], abs=2e-6)
    assert torch.isfinite(back.opacity_logits).all()
