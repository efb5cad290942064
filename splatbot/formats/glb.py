"""Binary glTF 2.0 (.glb) with the extension KHR_gaussian_splatting, as ratified by Khronos in 2026.

Source: `extensions/2.0/Khronos/KHR_gaussian_splatting/README.md` of github.com/KhronosGroup/glTF. A primitive of points
has POSITION, and with the prefix `KHR_gaussian_splatting:` ROTATION (xyzw), SCALE (linear), OPACITY (0..1) and
SH_DEGREE_l_COEF_n. COLOR_0 holds linear colours for viewers without the extension. Axes are left, up, forward.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError
from splatbot.formats.checks import check_count, check_expansion, damaged, read_bytes
from splatbot.formats.conventions import (
    LUF,
    SplatArrays,
    colors_of,
    linear_scales,
    logit,
    model_of,
    place,
    sigmoid,
    splats_of,
    to_wxyz,
    to_xyzw,
    turn,
)
from splatbot.formats.quantize import to_steps
from splatbot.gaussians.model import GaussianModel
from splatbot.geometry import quat_to_rotation

MAX_SH_DEGREE = 3
EXTENSION = "KHR_gaussian_splatting"

Json = dict[str, Any]
Pose = NDArray[np.float64]

_MAGIC, _VERSION = b"glTF", 2
_JSON, _BINARY = b"JSON", b"BIN\0"
_POINTS, _ARRAY_BUFFER = 0, 34962
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_FLOAT, _UNSIGNED_BYTE = 5126, 5121
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MAX_PRIMITIVES = 10_000
_HINT = f"export the map as GLB with {EXTENSION} again"


def load_glb(path: str | Path) -> GaussianModel:
    """Read all primitives with KHR_gaussian_splatting of the default scene, at the poses of their nodes.

    Linear scales are those of the ratified extension. Files of earlier drafts hold logarithms, which are negative for
    most Gaussians: those are read too.

    Raises:
        FormatError: the file is missing, truncated or damaged, holds no splats, or a node stretches them unevenly.
    """
    data = read_bytes(path)
    document, binary = _chunks(path, data)
    try:
        placed = list(_primitives(path, document))
        if not placed:
            hint = "give a GLB of Gaussian splats; meshes hold no Gaussians"
            raise FormatError(f"has no primitive with {EXTENSION}.", file=path, field=EXTENSION, hint=hint)
        counts = [int(_accessor(path, document, primitive, "POSITION")["count"]) for _, primitive in placed]
        check_count(path, sum(counts), "POSITION")
        sizes = [_decoded_bytes(primitive) * count for (_, primitive), count in zip(placed, counts, strict=True)]
        check_expansion(path, sum(sizes), len(data), "POSITION")
        models = [
            model_of(path, turn(place(path, _read_splats(path, document, binary, primitive), T, "nodes"), LUF))
            for T, primitive in placed
        ]
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise damaged(path, "JSON", error) from error
    return models[0] if len(models) == 1 else GaussianModel.concatenate(models)


def save_glb(model: GaussianModel, path: str | Path) -> None:
    """Write a GLB with one primitive; all values are float32, harmonics up to degree 3.

    Means and harmonics are stored bit for bit. Scales, opacities (0..1) and unit quaternions keep float32 precision.

    Raises:
        InputError: the model is empty, or a value is not finite.
    """
    splats = turn(splats_of(model, path, max_sh_degree=MAX_SH_DEGREE), LUF)
    attributes = _attributes(splats)
    offsets = np.cumsum([0, *(values.nbytes for values in attributes.values())])
    document: Json = {
        "asset": {"version": "2.0", "generator": "splatbot"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [_primitive(list(attributes))]}],
        "buffers": [{"byteLength": int(offsets[-1])}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(offset), "byteLength": values.nbytes, "target": _ARRAY_BUFFER}
            for offset, values in zip(offsets, attributes.values(), strict=False)
        ],
        "accessors": [_describe(view, name, values) for view, (name, values) in enumerate(attributes.items())],
    }
    text = json.dumps(document, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + int(offsets[-1])
    with atomic_write(path) as file:
        file.write(_MAGIC + struct.pack("<II", _VERSION, size))
        file.write(struct.pack("<I", len(text)) + _JSON + text)
        file.write(struct.pack("<I", int(offsets[-1])) + _BINARY)
        for values in attributes.values():
            file.write(values.tobytes())


def _attributes(splats: SplatArrays) -> dict[str, NDArray[np.generic]]:
    """Return the attributes by name, each (N, components) and a multiple of 4 bytes."""
    colors, opacity = np.clip(colors_of(splats.sh), 0.0, 1.0), sigmoid(splats.opacity_logits)[:, None]
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)  # of sRGB
    attributes: dict[str, NDArray[np.generic]] = {
        "POSITION": splats.means,
        f"{EXTENSION}:ROTATION": to_xyzw(splats.quats),
        f"{EXTENSION}:SCALE": linear_scales(splats.log_scales),
        f"{EXTENSION}:OPACITY": opacity.astype(np.float32),
        "COLOR_0": to_steps(np.concatenate([linear, opacity], axis=1), 0.0, 1.0, 255).astype(np.uint8),
    }
    for degree in range(round(splats.sh.shape[1] ** 0.5)):
        for n in range(2 * degree + 1):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = splats.sh[:, degree**2 + n]
    return attributes


def _primitive(names: list[str]) -> Json:
    properties = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    return {
        "attributes": {name: index for index, name in enumerate(names)},
        "mode": _POINTS,
        "extensions": {EXTENSION: properties},
    }


def _describe(view: int, name: str, values: NDArray[np.generic]) -> Json:
    accessor: Json = {"bufferView": view, "count": len(values), "type": _TYPES[values.shape[1]]}
    accessor["componentType"] = _UNSIGNED_BYTE if values.dtype == np.uint8 else _FLOAT
    if values.dtype == np.uint8:
        accessor["normalized"] = True
    if name == "POSITION":
        accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
    return accessor


def _chunks(path: str | Path, data: bytes) -> tuple[Json, bytes]:
    """Return the document and the binary chunk."""
    if len(data) < 20 or data[:4] != _MAGIC:
        raise damaged(path, "header", f"{len(data)} bytes")
    version, size, length = struct.unpack_from("<III", data, 4)
    if version != _VERSION:
        raise FormatError(f"is {version}, expected 2.", file=path, field="version", hint=_HINT)
    if size != len(data) or data[16:20] != _JSON or length > size - 20:
        raise damaged(path, "length", f"{len(data)} bytes, {size} in the header")
    try:
        document = json.loads(data[20 : 20 + length].decode())
    except (ValueError, RecursionError) as error:
        raise damaged(path, "JSON", error) from error
    if not isinstance(document, dict):
        raise damaged(path, "JSON", "it is no object")
    rest = data[20 + length :]
    if len(rest) < 8:
        return document, b""
    length = int.from_bytes(rest[:4], "little")
    if rest[4:8] != _BINARY or length > len(rest) - 8:
        raise damaged(path, "BIN", f"{length} bytes, {len(rest) - 8} in the file")
    return document, rest[8 : 8 + length]


def _primitives(path: str | Path, document: Json) -> Iterator[tuple[Pose, Json]]:
    """Yield the primitives of splats with the poses of their nodes, (4, 4)."""
    nodes, visited, count = document.get("nodes", []), set[int](), 0
    splats = [
        [primitive for primitive in mesh["primitives"] if EXTENSION in primitive.get("extensions", {})]
        for mesh in document.get("meshes", [])
    ]
    scenes = document.get("scenes")
    scene = _entry(document, "scenes", document.get("scene", 0)) if scenes else {"nodes": range(len(nodes))}
    waiting = [(np.eye(4), index) for index in scene.get("nodes", [])]
    while waiting:
        T_world_parent, index = waiting.pop()
        node = _entry(document, "nodes", index)
        if index in visited:
            raise damaged(path, "nodes", f"node {index} has two parents")
        visited.add(index)
        T_world_node = T_world_parent @ _pose(node)
        waiting += [(T_world_node, child) for child in node.get("children", [])]
        for primitive in splats[node["mesh"]] if "mesh" in node else []:
            count += 1
            if count > _MAX_PRIMITIVES:
                raise damaged(path, "nodes", f"more than {_MAX_PRIMITIVES:,} primitives")
            _check_extension(path, primitive)
            yield T_world_node, primitive


def _check_extension(path: str | Path, primitive: Json) -> None:
    extension = primitive["extensions"][EXTENSION]
    if extension.get("kernel", "ellipse") != "ellipse" or extension.get("extensions"):
        found = ", ".join(extension.get("extensions", {})) or f"the kernel {extension['kernel']!r}"
        hint = "export the map as GLB without compression and with the kernel 'ellipse'"
        raise FormatError(f"needs {found}.", file=path, field=EXTENSION, hint=hint)


def _pose(node: Json) -> Pose:
    """Return T_parent_node (4, 4)."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    T = np.eye(4)
    rotation = np.array([node.get("rotation", [0.0, 0.0, 0.0, 1.0])], np.float64).reshape(1, 4)
    T[:3, :3] = quat_to_rotation(to_wxyz(rotation))[0] * np.array(node.get("scale", [1.0] * 3), np.float64).reshape(3)
    T[:3, 3] = np.array(node.get("translation", [0.0] * 3), np.float64).reshape(3)
    return T


def _read_splats(path: str | Path, document: Json, binary: bytes, primitive: Json) -> SplatArrays:
    """Return the Gaussians of a primitive in the axes of the file."""

    def read(name: str, components: int) -> NDArray[np.float64]:
        return _read_attribute(path, document, binary, primitive, name, components)

    means = read("POSITION", 3)
    degree = _sh_degree(primitive["attributes"])
    coefficients = [f"SH_DEGREE_{n}_COEF_{k}" for n in range(degree + 1) for k in range(2 * n + 1)]
    arrays = (
        means,
        to_wxyz(read(f"{EXTENSION}:ROTATION", 4)),
        _log_scales(path, read(f"{EXTENSION}:SCALE", 3)),
        logit(read(f"{EXTENSION}:OPACITY", 1)[:, 0]),
        np.stack([read(f"{EXTENSION}:{name}", 3) for name in coefficients], axis=1),
    )
    if len({len(values) for values in arrays}) > 1:
        raise damaged(path, "attributes", f"their counts are {[len(values) for values in arrays]}")
    return SplatArrays(*(values.astype(np.float32) for values in arrays))


def _sh_degree(attributes: Json) -> int:
    """Return the highest degree up to 3 of which there is a first coefficient."""
    degrees = [n for n in range(1, MAX_SH_DEGREE + 1) if f"{EXTENSION}:SH_DEGREE_{n}_COEF_0" in attributes]
    return max(degrees, default=0)


def _log_scales(path: str | Path, scales: NDArray[np.float64]) -> NDArray[np.float64]:
    negative = (scales < 0).any(axis=1)
    if 2 * negative.sum() > len(scales):
        return scales
    if negative.any():
        hint = "export the map with linear scales"
        raise FormatError(f"row {int(np.argmax(negative))} is negative.", file=path, field="SCALE", hint=hint)
    with np.errstate(divide="ignore"):  # a scale of 0 becomes the least one
        return np.log(scales)


def _decoded_bytes(primitive: Json) -> int:
    """Return the bytes of a Gaussian in memory: 11 values, and 3 for each coefficient of the harmonics."""
    return 4 * (11 + 3 * sum(name.startswith(f"{EXTENSION}:SH_DEGREE") for name in primitive["attributes"]))


def _accessor(path: str | Path, document: Json, primitive: Json, name: str) -> Json:
    if name not in primitive["attributes"]:
        raise FormatError(f"the primitive has no {name}.", file=path, field=name, hint=_HINT)
    return _entry(document, "accessors", primitive["attributes"][name])


def _read_attribute(
    path: str | Path, document: Json, binary: bytes, primitive: Json, name: str, components: int
) -> NDArray[np.float64]:
    """Return an attribute (N, components) as floats; normalized integers are in -1..1 or 0..1."""
    accessor = _accessor(path, document, primitive, name)
    if "sparse" in accessor or "bufferView" not in accessor or accessor.get("type") != _TYPES[components]:
        raise damaged(path, name, f"expected a plain {_TYPES[components]} in a buffer")
    view = _entry(document, "bufferViews", accessor["bufferView"])
    if _entry(document, "buffers", view["buffer"]).get("uri") is not None:
        raise FormatError("is in another file.", file=path, field=name, hint="export a GLB that holds its buffers")
    dtype = np.dtype(_DTYPES[accessor["componentType"]])
    count, width = int(accessor["count"]), dtype.itemsize * components
    begin, step = int(accessor.get("byteOffset", 0)), int(view.get("byteStride", width))
    start, size = int(view.get("byteOffset", 0)), int(view["byteLength"])
    end = begin + (count - 1) * step + width
    if min(begin, start, size) < 0 or count < 1 or step < width or end > size or start + size > len(binary):
        raise damaged(path, name, f"{count:,} values in {size:,} bytes")
    shape, strides = (count, components), (step, dtype.itemsize)
    values: NDArray[Any] = np.ndarray(shape, dtype, binary, start + begin, strides)
    floats = values.astype(np.float64)
    if accessor.get("normalized") and dtype.kind != "f":
        return np.maximum(floats / np.iinfo(dtype).max, -1.0)
    return floats


def _entry(document: Json, kind: str, index: object) -> Json:
    """Return the object of a list of the document; a wrong index is a LookupError."""
    entries = document[kind]
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(entries):
        raise IndexError(f"{kind} has no entry {index!r}")
    entry: Json = entries[index]
    return entry
