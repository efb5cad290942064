"""The PLY layout of 3D Gaussian Splatting (Kerbl et al. 2023), which every viewer opens.

The `vertex` element has these float32 properties:

- x y z: mean;
- nx ny nz: always zero;
- f_dc_0..2, f_rest_*: spherical harmonics, channel-major (all of red, then green, then blue);
- opacity: logit;
- scale_0..2: natural logarithm;
- rot_0..3: quaternion wxyz.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyParseError

from splatbot.atomic import atomic_write
from splatbot.checksums import check_file
from splatbot.errors import FormatError
from splatbot.gaussians.model import OPACITY_MAX, OPACITY_MIN, SCALE_MIN, GaussianModel

Table = NDArray[np.float32]

_log = logging.getLogger(__name__)

_MEANS, _NORMALS = ["x", "y", "z"], ["nx", "ny", "nz"]
_DC = [f"f_dc_{i}" for i in range(3)]
_SCALES, _QUATS = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
_REST_COUNTS = (0, 9, 24, 45, 72)  # 3 ((degree + 1)² - 1)
_BOOKKEEPING = {"observations": 1, "anchors": -1, "uncertainty": 0, "misses": 0}  # with the value if absent


def load_ply(path: str | Path) -> GaussianModel:
    """Read a 3DGS PLY of SH degree 0 to 4, with or without normals; other properties are ignored.

    Zero quaternions become the identity. Infinite opacities, and scales of exactly 0 (logarithm -inf), become the
    nearest finite ones. Each replacement logs a warning. A map with bookkeeping, which splatbot saved, has no zero
    quaternions unless it is damaged.

    Raises:
        FormatError: no such file, truncated, damaged, a property is missing, or a value is NaN or infinite.
    """
    check_file(path)
    vertex = _read_vertices(path)
    present = [p.name for p in vertex.properties]
    rest = _rest_names(path, present)
    names = [*_MEANS, *_DC, *rest, "opacity", *_SCALES, *_QUATS]
    missing = [name for name in names if name not in present]
    if missing:
        raise FormatError(
            f"the vertices have no {', '.join(missing)}.",
            file=path,
            field=missing[0],
            hint="export the map as an uncompressed 3DGS PLY; point clouds and meshes hold no Gaussians",
        )
    table = _table(vertex, names)
    n_rest = len(rest)
    means, dc, f_rest, opacity, log_scales, quats = np.split(table, np.cumsum([3, 3, n_rest, 1, 3]), axis=1)
    if "observations" in present:
        _check_quats(path, quats)
    _replace_degenerate(path, opacity, log_scales, quats)
    _check_finite(path, table, names)
    sh = np.concatenate([dc[:, None, :], f_rest.reshape(len(table), 3, n_rest // 3).transpose(0, 2, 1)], axis=1)
    return GaussianModel(
        means=_tensor(means),
        quats=_tensor(quats),
        log_scales=_tensor(log_scales),
        opacity_logits=_tensor(opacity[:, 0]),
        sh=_tensor(sh),
        **{name: _column(vertex, present, name, default) for name, default in _BOOKKEEPING.items()},
    )


def save_ply(model: GaussianModel, path: str | Path, *, normals: bool = True, bookkeeping: bool = False) -> None:
    """Write a binary little-endian 3DGS PLY that stores the values of ``model`` bit for bit.

    Args:
        normals: write nx ny nz (zero) as the original does, because readers of a fixed layout expect them.
        bookkeeping: append int `observations`, `anchors` and `misses` and float `uncertainty`. Readers that use the
            header skip them. Readers that assume the original layout fail on them, hence the default.
    """
    n = len(model)
    sh = model.sh.detach().numpy()
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (sh.shape[1] - 1))
    columns = [
        (_MEANS, model.means.detach().numpy()),
        (_NORMALS if normals else [], np.zeros((n, 3 if normals else 0), np.float32)),
        (_DC, sh[:, 0]),
        ([f"f_rest_{i}" for i in range(rest.shape[1])], rest),
        (["opacity"], model.opacity_logits.detach().numpy()[:, None]),
        (_SCALES, model.log_scales.detach().numpy()),
        (_QUATS, model.quats.detach().numpy()),
    ]
    dtype = [(name, "<f4") for names, _ in columns for name in names]
    rows = np.concatenate([values for _, values in columns], axis=1, dtype="<f4").view(np.uint8)
    if bookkeeping:
        for name in _BOOKKEEPING:
            values = getattr(model, name).detach().numpy()[:, None]
            dtype.append((name, "<f4" if values.dtype == np.float32 else "<i4"))
            rows = np.concatenate([rows, values.astype(dtype[-1][1]).view(np.uint8)], axis=1)
    element = PlyElement.describe(rows.view(np.dtype(dtype)).reshape(n), "vertex")
    with atomic_write(path) as file:
        PlyData([element], byte_order="<").write(file)


def _read_vertices(path: str | Path) -> PlyElement:
    try:
        ply = PlyData.read(str(path))
    except OSError as error:
        raise FormatError(f"cannot be read ({error.strerror}).", file=path, hint="give a 3DGS PLY file") from error
    except (PlyParseError, ValueError, MemoryError) as error:  # the latter two from a damaged header
        raise FormatError(
            f"is damaged or truncated ({error}).", file=path, field="vertex", hint="copy or export the file again"
        ) from error
    names = [element.name for element in ply.elements]
    if "chunk" in names:
        raise FormatError(
            "is a compressed PLY.", file=path, field="chunk", hint="export it as an uncompressed 3DGS PLY"
        )
    if "vertex" not in names:
        raise FormatError(f"has elements {names}, no vertex.", file=path, field="vertex", hint="give a 3DGS PLY file")
    return ply["vertex"]


def _rest_names(path: str | Path, present: list[str]) -> list[str]:
    count = sum(name.startswith("f_rest_") for name in present)
    if count not in _REST_COUNTS:
        raise FormatError(
            f"{count} coefficients make no SH degree; expected one of {_REST_COUNTS}.",
            file=path,
            field="f_rest",
            hint="export the map again",
        )
    return [f"f_rest_{i}" for i in range(count)]


def _table(vertex: PlyElement, names: list[str]) -> Table:
    """Return the named properties as columns (N, P), in one pass over memory if all properties are float32."""
    data = vertex.data
    if {data.dtype[name] for name in data.dtype.names} == {np.dtype("<f4")}:
        order = [data.dtype.names.index(name) for name in names]
        return data.view("<f4").reshape(len(data), len(data.dtype.names))[:, order]
    return np.stack([data[name].astype(np.float32) for name in names], axis=1)


def _tensor(values: Table) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32, order="C"))  # astype copies: the table can be freed


def _column(vertex: PlyElement, present: list[str], name: str, default: int) -> torch.Tensor:
    kind = np.float32 if name == "uncertainty" else np.int32
    if name not in present:
        return torch.from_numpy(np.full(vertex.count, default, kind))
    return torch.from_numpy(vertex[name].astype(kind))


def _check_quats(path: str | Path, quats: Table) -> None:
    zero = ~quats.any(axis=1)
    if zero.any():
        first = int(np.argmax(zero))
        raise FormatError(
            f"is damaged: {int(zero.sum())} of {len(quats)} rows have a zero quaternion, the first is row {first}.",
            file=path,
            field="rot_0",
            hint="restore the file from a copy, or map the log again",
        )


def _replace_degenerate(path: str | Path, opacity: Table, log_scales: Table, quats: Table) -> None:
    """Replace degenerate values with a clear meaning in place: zero quaternions, zero scales, infinite opacities."""
    zero = ~quats.any(axis=1)
    flat = np.isneginf(log_scales)
    sure = np.isinf(opacity)
    quats[zero] = (1.0, 0.0, 0.0, 0.0)
    log_scales[flat] = np.log(SCALE_MIN)
    bound = np.log(OPACITY_MAX / (1.0 - OPACITY_MAX)), np.log(OPACITY_MIN / (1.0 - OPACITY_MIN))
    opacity[sure] = np.where(opacity[sure] > 0, *bound)
    for count, replacement in (
        (zero.sum(), "zero quaternions became the identity"),
        (flat.sum(), f"scales of 0 became {SCALE_MIN} m"),
        (sure.sum(), "infinite opacities became the nearest finite ones"),
    ):
        if count:
            _log.warning("%s: %d %s", path, count, replacement)


def _check_finite(path: str | Path, table: Table, names: list[str]) -> None:
    finite = np.isfinite(table)
    if finite.all():
        return
    bad = ~finite.all(axis=1)
    row = int(np.argmax(bad))
    raise FormatError(
        f"{int(bad.sum())} of {len(table)} rows hold NaN or infinity, the first is row {row}.",
        file=path,
        field=names[int(np.argmin(finite[row]))],
        hint="remove those rows, or export the map again",
    )
