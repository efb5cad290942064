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

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from splatbot.checksums import check_file
from splatbot.errors import FormatError
from splatbot.formats.checks import Table, check_finite, damaged, replace_degenerate
from splatbot.formats.conventions import from_channel_major, to_channel_major
from splatbot.formats.ply_file import Rows, read_ply, write_ply
from splatbot.gaussians.model import GaussianModel

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
            Bookkeeping below 0, or anchors below -1, are damage too.
    """
    check_file(path)
    vertex = _read_vertices(path)
    present = vertex.dtype.names or ()
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
    replace_degenerate(path, opacity, log_scales, quats)
    check_finite(path, table, names)
    sh = np.concatenate([dc[:, None, :], from_channel_major(f_rest)], axis=1)
    return GaussianModel(
        means=_tensor(means),
        quats=_tensor(quats),
        log_scales=_tensor(log_scales),
        opacity_logits=_tensor(opacity[:, 0]),
        sh=_tensor(sh),
        **{name: _column(path, vertex, name, default) for name, default in _BOOKKEEPING.items()},
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
    rest = to_channel_major(sh)
    columns = [
        (_MEANS, model.means.detach().numpy()),
        (_NORMALS if normals else [], np.zeros((n, 3 if normals else 0), np.float32)),
        (_DC, sh[:, 0]),
        ([f"f_rest_{i}" for i in range(rest.shape[1])], rest),
        (["opacity"], model.opacity_logits.detach().numpy()[:, None]),
        (_SCALES, model.log_scales.detach().numpy()),
        (_QUATS, model.quats.detach().numpy()),
    ]
    if bookkeeping:
        columns += [([name], getattr(model, name).detach().numpy()[:, None]) for name in _BOOKKEEPING]
    dtype = np.dtype([(name, values.dtype.newbyteorder("<")) for names, values in columns for name in names])
    words = np.concatenate([values.view(np.uint32) for _, values in columns], axis=1, dtype="<u4")
    write_ply(path, {"vertex": words.view(dtype).reshape(n)})


def _read_vertices(path: str | Path) -> Rows:
    elements = read_ply(path, ("chunk", "vertex"))
    if "chunk" in elements:
        raise FormatError("is a compressed PLY.", file=path, field="chunk", hint="load it with load_gaussians")
    if "vertex" not in elements:
        raise FormatError("has no element vertex.", file=path, field="vertex", hint="give a 3DGS PLY file")
    return elements["vertex"]


def _rest_names(path: str | Path, present: Sequence[str]) -> list[str]:
    count = sum(name.startswith("f_rest_") for name in present)
    if count not in _REST_COUNTS:
        raise FormatError(
            f"{count} coefficients make no SH degree; expected one of {_REST_COUNTS}.",
            file=path,
            field="f_rest",
            hint="export the map again",
        )
    return [f"f_rest_{i}" for i in range(count)]


def _table(vertex: Rows, names: list[str]) -> Table:
    """Return the named properties as columns (N, P), in one pass over memory if all have 4 bytes as float32 has."""
    kinds = [vertex.dtype[name] for name in vertex.dtype.names or ()]
    if {kind.itemsize for kind in kinds} == {4} and {vertex.dtype[name] for name in names} == {np.dtype("<f4")}:
        order = [list(vertex.dtype.names or ()).index(name) for name in names]
        return vertex.view("<f4").reshape(len(vertex), len(kinds))[:, order]
    return np.stack([vertex[name].astype(np.float32) for name in names], axis=1)


def _tensor(values: Table) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32, order="C"))  # astype copies: the table can be freed


def _column(path: str | Path, vertex: Rows, name: str, default: int) -> torch.Tensor:
    kind = np.float32 if name == "uncertainty" else np.int32
    if name not in (vertex.dtype.names or ()):
        return torch.from_numpy(np.full(len(vertex), default, kind))
    least = min(default, 0)
    if not ((vertex[name] >= least) & np.isfinite(vertex[name])).all():
        raise damaged(path, name, f"a value is not finite or below {least}")
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
