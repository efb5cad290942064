"""SBZ of splatbot: at most 10 bytes a Gaussian, and solids that contain those of the encoded map.

A collision field takes each Gaussian as its ellipsoid at ``n_sigma`` standard deviations. For every ``n_sigma`` of 1 or
more, each decoded ellipsoid contains the encoded one. A sphere that is free in the decoded map thus touches no
ellipsoid of the encoded map. Observations are exact, and no opacity falls below one of ``GATES`` that it passes, so a
field keeps each Gaussian that it kept before.

After a header, a file is one LZMA stream:

- the nodes of an octree whose leaves are the cells of the means (:mod:`splatbot.formats.octree`);
- columns of integers for the Gaussians along the Morton curve. Each is stored as planes of bytes, lowest bytes first,
  and its sign is the lowest bit;
- the low bits of the turns, which are noise: the lowest bit of all of them, then the next one, and so on.

Columns are whether a Gaussian is the first of its leaf, the integers of :mod:`splatbot.formats.enclosing`, and the
logit of the opacity. Luma, red - blue and green - magenta of the colour follow, then the bookkeeping.
"""

from __future__ import annotations

import lzma
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError, InputError
from splatbot.formats.checks import check_count, check_expansion, damaged, read_bytes
from splatbot.formats.conventions import SplatArrays, colors_of, dc_of, logit, model_of, splats_of
from splatbot.formats.enclosing import (
    MAX_CODE,
    MAX_VALUE,
    MIN_CODE,
    SCALE_FLOOR,
    SCALE_STEPS,
    Array,
    Ints,
    Shapes,
    Solids,
    decode,
    enclose,
    turn_bits,
)
from splatbot.formats.octree import (
    MAX_DEPTH,
    MAX_EXPONENT,
    MIN_EXPONENT,
    Grid,
    grid_order,
    read_octree,
    write_octree,
)
from splatbot.gaussians.model import GaussianModel
from splatbot.geometry import quat_to_rotation

Bytes = NDArray[np.uint8]

MAX_SH_DEGREE = 0
GATES = (1.0 / 255.0, 0.3)  # least opacities of the Gaussians of a collision field, and of objects
LOGIT_STEPS, COLOR_STEPS = 8, 64
UNCERTAINTY_STEPS = 2  # of an octave

_MAGIC, _VERSION = b"SBZ", 1
_HEADER = struct.Struct("<3sBIBhIII3f18B")
_COLUMNS = (
    *("is_first", "long", "long_mid", "mid_thin"),  # the long scale, and differences to the next ones
    *("x", "y", "t", "long_offset", "mid_offset", "thin_offset"),
    *("logit", "luma", "red_blue", "green_magenta"),
    *("observations", "anchors", "misses", "uncertainty"),
)
_HIGH_BITS = 5  # of turns, which neighbours share
_MAX_COLOR = 1000.0
_ONE_METRE, _MAX_UNCERTAINTY = 128, 200  # codes of uncertainty; that of 0 is 0
_LUMA = np.array([[0.25, 0.5, -0.25], [0.5, 0.0, 0.5], [0.25, -0.5, -0.25]])  # colours as rows, times this
_RGB = np.linalg.inv(_LUMA)
_DECODED_BYTES = 128  # of a Gaussian in memory, for the limit of the expansion
_FILTERS = [{"id": lzma.FILTER_LZMA1, "preset": 6, "lc": 0, "lp": 0, "pb": 0}]


class _Header(NamedTuple):
    magic: bytes
    version: int
    gaussians: int
    depth: int
    exponent: int
    nodes: int
    low_bytes: int
    checksum: int  # CRC-32 of the header with a checksum of 0, and of the stream
    corner: tuple[float, ...]
    widths: tuple[int, ...]  # bytes of the values of each column

    @property
    def size(self) -> int:
        """Bytes of the decoded stream."""
        return self.nodes + self.gaussians * sum(self.widths) + self.low_bytes

    def pack(self) -> bytes:
        return _HEADER.pack(*self[:8], *self.corner, *self.widths)

    def checked(self, stream: bytes) -> int:
        """Return the checksum of this header with a stream."""
        return zlib.crc32(stream, zlib.crc32(self._replace(checksum=0).pack()))


def load_sbz(path: str | Path) -> GaussianModel:
    """Read an SBZ file. Gaussians are sorted along a Morton curve, and their axes from long to thin.

    Raises:
        FormatError: the file is missing, truncated or damaged, or of another version.
    """
    data = read_bytes(path)
    head = _read_header(path, data)
    stream = np.frombuffer(_read_stream(path, data, head), np.uint8)
    nodes, planes, low = np.split(stream, [head.nodes, len(stream) - head.low_bytes])
    columns = dict(zip(_COLUMNS, _join_planes(planes, head.gaussians, head.widths), strict=True))
    leaves = _leaf_of_each(path, read_octree(path, nodes, head.depth, head.gaussians), columns["is_first"])
    centres = Grid(np.array(head.corner), head.exponent, head.depth).centres(leaves)
    means, quats, log_scales = decode(_shapes(path, columns, low), centres)
    colors = _rows(columns, "luma", "red_blue", "green_magenta") @ _RGB / COLOR_STEPS
    arrays = (means, quats, log_scales, columns["logit"] / LOGIT_STEPS, dc_of(colors))
    counts = {name: torch.from_numpy(columns[name].astype(np.int32)) for name in ("observations", "anchors", "misses")}
    return replace(
        model_of(path, SplatArrays(*(values.astype(np.float32) for values in arrays))),
        uncertainty=torch.from_numpy(_uncertainty(path, columns["uncertainty"])),
        **counts,
    )


def save_sbz(model: GaussianModel, path: str | Path) -> None:
    """Write an SBZ file, without harmonics beyond DC.

    Ellipsoids grow by about a tenth. Opacities shrink as the areas grow, so that images stay as bright.

    Raises:
        InputError: the model is empty, a value is not finite, an uncertainty is negative, or a mean or scale is above
            1e6 m.
    """
    splats = splats_of(model, path, max_sh_degree=MAX_SH_DEGREE)
    means = splats.means.astype(np.float64)
    scales = np.maximum(np.exp(splats.log_scales.astype(np.float64)), SCALE_FLOOR)
    _check_values(path, means, scales, model.uncertainty.detach().numpy())
    grid, order, leaves = grid_order(means)
    sorted_model = model.select(torch.from_numpy(order))
    solids = _solids(means[order], splats.quats[order], scales[order])
    shapes = enclose(solids, grid.centres(leaves))
    high, low = _split_bits(shapes.turns, turn_bits(shapes.scales))
    is_first = np.diff(leaves, prepend=-1) > 0
    growth = np.prod(2.0 ** (shapes.scales[:, :2] / SCALE_STEPS) / solids.scales[:, :2], axis=1)
    colors = np.clip(colors_of(splats.sh[order]), -_MAX_COLOR, _MAX_COLOR)
    columns = [
        *(is_first, shapes.scales[:, 0] - MIN_CODE, *-np.diff(shapes.scales, axis=1).T),
        *(*high.T, *shapes.offsets.T),
        *(_logit_codes(sorted_model, growth), *np.rint(COLOR_STEPS * colors @ _LUMA).T),
        *(getattr(sorted_model, name).numpy() for name in ("observations", "anchors", "misses")),
        _uncertainty_codes(sorted_model.uncertainty.detach().numpy()),
    ]
    widths, planes = _split_planes(columns)
    nodes = write_octree(leaves[is_first], grid.depth)
    stream = b"".join([nodes, *planes, low])
    head = _Header(
        magic=_MAGIC,
        version=_VERSION,
        gaussians=len(means),
        depth=grid.depth,
        exponent=grid.exponent,
        nodes=len(nodes),
        low_bytes=len(low),
        checksum=0,
        corner=tuple(grid.corner),
        widths=tuple(widths),
    )
    with atomic_write(path) as file:
        file.write(head._replace(checksum=head.checked(stream)).pack())
        file.write(lzma.compress(stream, lzma.FORMAT_RAW, filters=_FILTERS))


def _read_header(path: str | Path, data: bytes) -> _Header:
    if len(data) < _HEADER.size:
        raise damaged(path, "header", f"{len(data)} bytes")
    magic, version, count, depth, exponent, nodes, low, checksum, *rest = _HEADER.unpack_from(data)
    head = _Header(magic, version, count, depth, exponent, nodes, low, checksum, tuple(rest[:3]), tuple(rest[3:]))
    if head.magic != _MAGIC:
        raise FormatError("has no SBZ header.", file=path, field="magic", hint="give an .sbz file")
    if head.version != _VERSION:
        hint = "read it with the splatbot that wrote it"
        raise FormatError(f"is {head.version}, expected {_VERSION}.", file=path, field="version", hint=hint)
    check_count(path, head.gaussians, "count")
    if head.depth > MAX_DEPTH or not MIN_EXPONENT <= head.exponent <= MAX_EXPONENT:
        raise damaged(path, "octree", f"depth {head.depth}, exponent {head.exponent}")
    if max(head.widths) > 4:
        raise damaged(path, "columns", f"values of {max(head.widths)} bytes")
    check_expansion(path, max(head.size, _DECODED_BYTES * head.gaussians), len(data), "count")
    return head


def _read_stream(path: str | Path, data: bytes, head: _Header) -> bytes:
    try:
        stream = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_FILTERS).decompress(data[_HEADER.size :], head.size)
    except (lzma.LZMAError, EOFError) as error:
        raise damaged(path, "columns", error) from error
    if len(stream) != head.size:
        raise damaged(path, "columns", f"{len(stream)} bytes, expected {head.size}")
    if head.checked(stream) != head.checksum:
        raise damaged(path, "checksum", "the content has another one")
    return stream


def _leaf_of_each(path: str | Path, leaves: Ints, is_first: Ints) -> Ints:
    """Return the leaf (N,) of each Gaussian of sorted distinct leaves."""
    if is_first[0] != 1 or not np.isin(is_first, (0, 1)).all() or is_first.sum() != len(leaves):
        raise damaged(path, "octree", f"{len(leaves)} leaves for {is_first.sum()} groups of Gaussians")
    return leaves[np.cumsum(is_first) - 1]


def _shapes(path: str | Path, columns: dict[str, Ints], low: Bytes) -> Shapes:
    steps = _rows(columns, "long", "long_mid", "mid_thin")
    scales = np.cumsum(steps * (1, -1, -1), axis=1) + MIN_CODE
    if steps.min() < 0 or scales.min() < MIN_CODE or scales.max() > MAX_CODE:
        raise damaged(path, "scales", f"codes of {scales.min()} to {scales.max()}")
    bits = turn_bits(scales)
    if len(low) != -(-int(np.maximum(bits - _HIGH_BITS, 0).sum()) // 8):
        raise damaged(path, "turns", f"{len(low)} bytes")
    turns = _join_bits(_rows(columns, "x", "y", "t"), low, bits)
    return Shapes(scales, turns, _rows(columns, "long_offset", "mid_offset", "thin_offset"))


def _rows(columns: dict[str, Ints], *names: str) -> Ints:
    return np.stack([columns[name] for name in names], axis=1)


def _check_values(path: str | Path, means: Array, scales: Array, uncertainty: NDArray[np.float32]) -> None:
    for name, values in (("means", means), ("log_scales", scales)):
        if np.abs(values).max() > MAX_VALUE:
            raise InputError(f"exceed {MAX_VALUE:g} m.", file=path, field=name, hint="give metres")
    if not (np.isfinite(uncertainty).all() and (uncertainty >= 0).all()):
        raise InputError("is negative or not finite.", file=path, field="uncertainty", hint="give metres, 0 or more")


def _solids(means: Array, quats: NDArray[np.float32], scales: Array) -> Solids:
    by_length = np.argsort(-scales, axis=1, kind="stable")
    axes = np.take_along_axis(quat_to_rotation(quats), by_length[:, None, :], axis=2)
    return Solids(means, axes, np.take_along_axis(scales, by_length, axis=1))


def _split_planes(columns: list[NDArray[np.generic]]) -> tuple[list[int], list[bytes]]:
    """Return the bytes of each value of columns (N,), and the planes of these bytes, the lowest first."""
    widths, planes = [], []
    for values in columns:
        signed = values.astype(np.int64)
        folded = np.where(signed < 0, ~signed << 1 | 1, signed << 1)
        widths.append(-(-int(folded.max()).bit_length() // 8))
        planes += [(folded >> 8 * plane).astype(np.uint8).tobytes() for plane in range(widths[-1])]
    return widths, planes


def _join_planes(planes: Bytes, count: int, widths: tuple[int, ...]) -> list[Ints]:
    """Return the columns of :func:`_split_planes`."""
    columns, rows = [], planes.reshape(sum(widths), count)
    for width, end in zip(widths, np.cumsum(widths), strict=True):
        folded = np.zeros(count, np.int64)
        for plane in range(width):
            folded |= rows[end - width + plane].astype(np.int64) << 8 * plane
        columns.append(np.where(folded & 1, ~(folded >> 1), folded >> 1))
    return columns


def _split_bits(turns: Ints, bits: Ints) -> tuple[Ints, bytes]:
    """Return the high bits of turns (N, 3), as if all had at least ``_HIGH_BITS``, and the others as bytes."""
    more = np.maximum(bits - _HIGH_BITS, 0)
    low = [turns[more > place] >> place & 1 for place in range(more.max())]
    packed = np.packbits(np.concatenate([*low, np.zeros(0, np.int64)]).astype(np.uint8))
    return turns >> more << np.maximum(_HIGH_BITS - bits, 0), packed.tobytes()


def _join_bits(high: Ints, low: Bytes, bits: Ints) -> Ints:
    """Return the turns (N, 3) of :func:`_split_bits`."""
    more = np.maximum(bits - _HIGH_BITS, 0)
    turns, stored = high >> np.maximum(_HIGH_BITS - bits, 0) << more, np.unpackbits(low)
    for place in range(more.max()):
        has = more > place
        here, stored = np.split(stored, [np.count_nonzero(has)])
        turns[has] |= here.astype(np.int64) << place
    return turns


def _logit_codes(model: GaussianModel, growth: Array) -> Ints:
    """Return codes of opacities (N,) that shrink by the growth (N,) of areas, but below none of ``GATES``."""
    opacities = model.opacities.detach()
    codes = np.rint(LOGIT_STEPS * logit(opacities.numpy() / growth)).astype(np.int64)
    for gate in GATES:
        least = int(np.ceil(LOGIT_STEPS * logit(gate)))
        codes = np.where((opacities >= gate).numpy(), np.maximum(codes, least), codes)
    return codes


def _uncertainty_codes(values: NDArray[np.float32]) -> Ints:
    """Return codes of uncertainties (N,) [m], which are rounded up."""
    codes = np.ceil(UNCERTAINTY_STEPS * np.log2(np.where(values > 0, values, 1.0)) - 1e-5) + _ONE_METRE
    return np.where(values > 0, np.clip(codes, 1, _MAX_UNCERTAINTY), 0).astype(np.int64)


def _uncertainty(path: str | Path, codes: Ints) -> NDArray[np.float32]:
    """Return the uncertainties (N,) [m] of codes."""
    if codes.min() < 0 or codes.max() > _MAX_UNCERTAINTY:
        raise damaged(path, "uncertainty", f"codes of {codes.min()} to {codes.max()}")
    return np.where(codes > 0, 2.0 ** ((codes - _ONE_METRE) / UNCERTAINTY_STEPS), 0.0).astype(np.float32)
