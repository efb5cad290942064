"""The compressed PLY of SuperSplat and PlayCanvas, 16 bytes a Gaussian of SH degree 0.

Source: developer.playcanvas.com, Gaussian splatting, formats, PLY; `compressed-chunk.ts` of splat-transform. Elements:

- chunk: for each 256 Gaussians the least and largest position, log scale and (in newer files) colour, float32;
- packed_position and packed_scale of vertex: 11, 10, 11 bits for x, y, z of the chunk's range;
- packed_rotation of vertex: 2 bits for the largest of w x y z, and 10 bits for each of the others;
- packed_color of vertex: 8 bits for each of r, g, b and opacity;
- sh, if there are harmonics: f_rest_* as 8 bits over -4..4, channel-major.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.checksums import check_file
from splatbot.errors import FormatError
from splatbot.formats.checks import check_count, damaged
from splatbot.formats.conventions import (
    SplatArrays,
    Table,
    colors_of,
    dc_of,
    from_channel_major,
    logit,
    model_of,
    sigmoid,
    splats_of,
    to_channel_major,
    warn_limited,
)
from splatbot.formats.ply_file import Rows, read_ply, write_ply
from splatbot.formats.quantize import (
    Array,
    Codes,
    from_smallest_three,
    from_steps,
    morton_order,
    to_smallest_three,
    to_steps,
)
from splatbot.gaussians.model import GaussianModel

CHUNK = 256
MAX_SH_DEGREE = 3
SH_LIMIT = 4.0  # of the range of stored harmonics

_BITS = (11, 10, 11)
_PACKED = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]


def _limits(names: str, prefix: str = "") -> tuple[list[str], list[str]]:
    return [f"min_{prefix}{name}" for name in names], [f"max_{prefix}{name}" for name in names]


_POSITION, _SCALE, _COLOR = _limits("xyz"), _limits("xyz", "scale_"), _limits("rgb")


def load_compressed_ply(path: str | Path) -> GaussianModel:
    """Read a compressed PLY.

    Raises:
        FormatError: no such file, truncated, damaged, or a property is missing.
    """
    check_file(path)
    ply = read_ply(path, ("chunk", "vertex", "sh"))
    vertex, chunk = _element(path, ply, "vertex", _PACKED), _element(path, ply, "chunk", [])
    count = len(vertex)
    check_count(path, count, "vertex")
    if len(chunk) * CHUNK < count:
        raise damaged(path, "chunk", f"{len(chunk)} chunks for {count} Gaussians")
    position, rotation, scale, color = (vertex[name].astype(np.uint32) for name in _PACKED)
    rgba = _unpack(color, (8, 8, 8, 8))
    colors = rgba[:, :3] / 255.0
    if _COLOR[0][0] in (chunk.dtype.names or ()):
        colors = _spread(path, chunk, _COLOR, rgba[:, :3], np.array([255, 255, 255]))
    others = _unpack(rotation, (10, 10, 10)) / 1023.0 * 2.0 - 1.0
    steps = 2 ** np.array(_BITS) - 1
    sh = np.concatenate([dc_of(colors), _harmonics(path, ply, count)], axis=1)
    arrays = (
        _spread(path, chunk, _POSITION, _unpack(position, _BITS), steps),
        from_smallest_three(rotation >> 30, others),
        _spread(path, chunk, _SCALE, _unpack(scale, _BITS), steps),
        logit(rgba[:, 3] / 255.0),
        sh,
    )
    return model_of(path, SplatArrays(*(values.astype(np.float32) for values in arrays)))


def save_compressed_ply(model: GaussianModel, path: str | Path) -> None:
    """Write a compressed PLY; Gaussians are put in Morton order, so that chunks are small.

    Errors are at most half a step. Positions and log scales have 2047 steps of their chunk's range in x and z and 1023
    in y, colours 255. The step is 0.0014 for components of quaternions, 1/255 for opacities and 1/32 for harmonics.
    Harmonics are limited to -4..4, next to which the error is a whole step, and to degree 3.

    Raises:
        InputError: the model is empty, or a value is not finite.
    """
    splats = splats_of(model, path, max_sh_degree=MAX_SH_DEGREE)
    warn_limited(path, "harmonics", splats.sh[:, 1:], -SH_LIMIT, SH_LIMIT)
    order = morton_order(splats.means)
    means, quats, log_scales, logits, sh = (values[order] for values in splats)
    colors = colors_of(sh).astype(np.float32)
    largest, others = to_smallest_three(quats)
    position, position_limits = _squeeze(means, _BITS)
    scale, scale_limits = _squeeze(log_scales, _BITS)
    color, color_limits = _squeeze(colors, (8, 8, 8))
    smallest, opacity = to_steps(others, -1.0, 1.0, 1023), to_steps(sigmoid(logits), 0.0, 1.0, 255)
    rotation = _pack(np.concatenate([largest[:, None].astype(np.uint32), smallest], axis=1), (2, 10, 10, 10))
    color = _pack(np.concatenate([color, opacity[:, None]], axis=1), (8, 8, 8, 8))
    chunks = np.concatenate([position_limits, scale_limits, color_limits], axis=1)
    rest = to_channel_major(sh)
    limits = [name for part in (_POSITION, _SCALE, _COLOR) for names in part for name in names]
    packed = np.stack((_pack(position, _BITS), rotation, _pack(scale, _BITS), color), axis=1)
    elements = {
        "chunk": _rows(chunks, "<f4", limits),
        "vertex": _rows(packed, "<u4", _PACKED),
    }
    if rest.shape[1]:
        codes = np.clip(np.floor((rest / (2 * SH_LIMIT) + 0.5) * 256), 0, 255)
        elements["sh"] = _rows(codes, "u1", [f"f_rest_{i}" for i in range(rest.shape[1])])
    write_ply(path, elements)


def _rows(table: NDArray[np.generic], kind: str, names: list[str]) -> Rows:
    """Return a table (N, P) as N rows of named numbers of one type."""
    return table.astype(kind, order="C").view([(name, kind) for name in names]).reshape(len(table))


def _element(path: str | Path, ply: dict[str, Rows], name: str, properties: list[str]) -> Rows:
    if name not in ply:
        hint = "give a compressed PLY file of splats"
        raise FormatError(f"has no element {name}.", file=path, field=name, hint=hint)
    rows = ply[name]
    for wanted in properties:
        _check_property(path, rows, wanted)
    return rows


def _check_property(path: str | Path, rows: Rows, name: str) -> None:
    if name not in (rows.dtype.names or ()) or rows.dtype[name].kind not in "uif":
        raise FormatError(f"has no numbers {name}.", file=path, field=name, hint="export the map again")


def _harmonics(path: str | Path, ply: dict[str, Rows], count: int) -> Table:
    """Return the harmonics beyond DC (N, K - 1, 3) of the element sh."""
    if "sh" not in ply:
        return np.zeros((count, 0, 3), np.float32)
    rows = ply["sh"]
    names = rows.dtype.names or ()
    if len(rows) != count or len(names) not in (9, 24, 45):
        raise damaged(path, "sh", f"{len(rows)} rows of {len(names)} harmonics for {count} Gaussians")
    for i in range(len(names)):
        _check_property(path, rows, f"f_rest_{i}")
    codes = np.stack([rows[f"f_rest_{i}"].astype(np.uint8) for i in range(len(names))], axis=1)
    table = (np.arange(256) + 0.5) / 256.0  # a cell's middle, except for the outermost cells
    table[[0, 255]] = 0.0, 1.0
    return from_channel_major(((table - 0.5) * 2 * SH_LIMIT).astype(np.float32)[codes])


def _unpack(words: Codes, bits: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the fields (N, len(bits)) of words whose last field is in the lowest bits."""
    shifts = np.cumsum((0, *bits[:0:-1]))[::-1]
    fields = [(words >> int(shift)) & (2**width - 1) for shift, width in zip(shifts, bits, strict=True)]
    return np.stack(fields, axis=1).astype(np.int64)


def _pack(fields: Codes, bits: tuple[int, ...]) -> Codes:
    words = np.zeros(len(fields), np.uint32)
    for column, width in enumerate(bits):
        words = (words << np.uint32(width)) | fields[:, column]
    return words


def _spread(
    path: str | Path,
    chunk: Rows,
    names: tuple[list[str], list[str]],
    codes: NDArray[np.int64],
    steps: NDArray[np.int64],
) -> Array:
    """Return codes (N, 3) as values in the range of each Gaussian's chunk."""
    for name in (*names[0], *names[1]):
        _check_property(path, chunk, name)
    low, high = (np.stack([chunk[name] for name in part], axis=1).astype(np.float64) for part in names)
    index = np.arange(len(codes)) // CHUNK
    return from_steps(codes, low[index], high[index], steps)


def _squeeze(values: Table, bits: tuple[int, int, int]) -> tuple[Codes, Table]:
    """Return values (N, 3) as codes (N, 3) of their chunk's range, and the ranges (chunks, 6)."""
    starts = np.arange(0, len(values), CHUNK)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    index = np.arange(len(values)) // CHUNK
    codes = [to_steps(values[:, i], low[index, i], high[index, i], 2**width - 1) for i, width in enumerate(bits)]
    return np.stack(codes, axis=1), np.concatenate([low, high], axis=1)
