"""The `.ksplat` format of mkkellogg/GaussianSplats3D, version 0.1: 24 bytes a Gaussian of SH degree 0.

Source: `SplatBuffer.js` of github.com/mkkellogg/GaussianSplats3D. A header of 4096 bytes is followed by a header of
1024 bytes for each section, and then by the data of the sections:

- the lengths of the buckets that are not full (uint32), and the centres of all buckets (3 float32), full ones first;
- rows of mean (3), standard deviations (3, linear), quaternion wxyz (4), colour and opacity (4 bytes, 0..255), and
  harmonics beyond DC. The latter are by degree: all of red, then of green, then of blue.

The compression level of the file chooses the types of the values:

| level | mean | scales, quaternion | harmonics |
|---|---|---|---|
| 0 | float32 | float32 | float32 |
| 1 | uint16, from the centre of the bucket | float16 | float16 |
| 2 | uint16, from the centre of the bucket | float16 | 8 bits, within the range of the header |

A bucket holds Gaussians of one cube. Its side of 5 m has 65,534 steps.
"""

from __future__ import annotations

import struct
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError, InputError
from splatbot.formats.checks import Table, check_count, damaged, read_bytes
from splatbot.formats.conventions import (
    SplatArrays,
    colors_of,
    dc_of,
    from_channel_major,
    linear_scales,
    log_scales_of,
    logit,
    model_of,
    sigmoid,
    splats_of,
    to_channel_major,
    warn_limited,
)
from splatbot.formats.quantize import Array, from_steps, to_steps
from splatbot.gaussians.model import GaussianModel

MAX_SH_DEGREE = 2
BLOCK, STEPS = 5.0, 32767  # side of the cubes [m], and steps of half a side
BUCKET = 256  # Gaussians of a full bucket

Level = Literal[0, 1, 2]

_HEAD = struct.Struct("<BBxxIIIIHxx3fff")
_SECTION = struct.Struct("<IIIIfHxxIIIIHxx")
_HEAD_BYTES, _SECTION_BYTES, _CENTRE_BYTES = 4096, 1024, 12
_VERSION = (0, 1)
_HARMONICS = 1.5  # end of the range of level 2 if the header has 0
_TINY = 2.0**-126  # smallest normal float32
_HALF_MIN, _HALF_MAX = 2.0**-24, 65504.0  # of float16
_MAX_BYTES = 2**32 - 1  # of a section, whose header has 32 bits for them
_TYPES = {0: ("<f4", "<f4", "<f4"), 1: ("<u2", "<f2", "<f2"), 2: ("<u2", "<f2", "u1")}  # means, shapes, harmonics


class _FileHead(NamedTuple):
    major: int
    minor: int
    sections: int
    loaded_sections: int
    capacity: int
    gaussians: int
    level: int
    x: float  # centre of the scene, for viewers
    y: float
    z: float
    low: float  # range of the harmonics of level 2
    high: float


class _SectionHead(NamedTuple):
    gaussians: int
    capacity: int  # rows, of which the first ones are used
    bucket_size: int
    buckets: int
    block: float
    centre_bytes: int
    steps: int  # of half a side
    bytes: int
    full_buckets: int
    other_buckets: int
    sh_degree: int

    @property
    def bucket_bytes(self) -> int:
        """Bytes before the rows."""
        return 4 * self.other_buckets + self.centre_bytes * self.buckets

    def size(self, level: int) -> int:
        """Return the bytes of the data."""
        return self.bucket_bytes + self.capacity * _row(level, self.sh_degree).itemsize


def load_ksplat(path: str | Path) -> GaussianModel:
    """Read a .ksplat file of any level; its sections become one map.

    The sizes of all sections are checked against that of the file before a row is decoded.

    Raises:
        FormatError: the file is missing, truncated or damaged, or of another version, or a scale is negative.
    """
    data = read_bytes(path)
    head = _read_head(path, data)
    sections = [_read_section(path, data, head.level, number) for number in range(head.sections)]
    if sum(section.gaussians for section in sections) != head.gaussians:
        raise damaged(path, "splatCount", f"{head.gaussians}, unlike the sum of the sections")
    sizes = [section.size(head.level) for section in sections]
    ends = list(accumulate(sizes, initial=_HEAD_BYTES + _SECTION_BYTES * head.sections))
    if ends[-1] != len(data):
        raise damaged(path, "sections", f"{len(data)} bytes, expected {ends[-1]}")
    degree = max(section.sh_degree for section in sections)
    parts = [
        _decode(path, data[start:end], head, section, degree)
        for section, (start, end) in zip(sections, pairwise(ends), strict=True)
    ]
    means, quats, scales, rgba, rest = (np.concatenate(values) for values in zip(*parts, strict=True))
    sh = np.concatenate([dc_of(rgba[:, :3] / 255.0), rest], axis=1)
    arrays = (means, quats, log_scales_of(path, scales), logit(rgba[:, 3] / 255.0), sh)
    with np.errstate(over="ignore"):  # infinity is refused
        return model_of(path, SplatArrays(*(values.astype(np.float32) for values in arrays)))


def save_ksplat(model: GaussianModel, path: str | Path, level: Level = 1) -> None:
    """Write a .ksplat file of one section, with harmonics up to degree 2.

    Errors are at most 1/510 for colours (0..1) and opacities. Level 0 stores all other values as float32, in order.
    Levels 1 and 2 sort Gaussians by cubes of 5 m. Errors of positions are at most 0.04 mm, plus the rounding of float32
    beyond 500 m. Scales, quaternions and harmonics are float16. Level 2 has 255 steps for harmonics within the range
    of their values, and zero is exact to the rounding of float32.

    Raises:
        InputError: the model is empty, a value is not finite, or the section exceeds 4 GiB.
    """
    splats = splats_of(model, path, max_sh_degree=MAX_SH_DEGREE)
    count, degree = len(splats.means), round(splats.sh.shape[1] ** 0.5) - 1
    if level == 0:
        centres, lengths = np.zeros((0, 3), np.float32), np.zeros(0, np.uint32)
    else:
        order, centres, lengths = _fill_buckets(splats.means)
        splats = SplatArrays(*(values[order] for values in splats))
    low, high = _range_of(splats.sh[:, 1:])
    full = int(np.count_nonzero(lengths == BUCKET))
    section = _SectionHead(
        count, count, BUCKET, len(lengths), BLOCK, _CENTRE_BYTES, STEPS, 0, full, len(lengths) - full, degree
    )
    size = section.size(level)
    if size > _MAX_BYTES:
        hint = "write level 1 or 2, or split the scene"
        raise InputError(f"takes {size:,} bytes, at most {_MAX_BYTES:,}.", file=path, field="model", hint=hint)
    rows = _encode(path, splats, level, low, high)
    rows["mean"] = splats.means if level == 0 else _to_codes(splats.means, np.repeat(centres, lengths, axis=0))
    head = _HEAD.pack(*_VERSION, 1, 1, count, count, level, 0.0, 0.0, 0.0, low, high)
    with atomic_write(path) as file:
        file.write(head.ljust(_HEAD_BYTES, b"\0"))
        file.write(_SECTION.pack(*section._replace(bytes=size)).ljust(_SECTION_BYTES, b"\0"))
        file.write(lengths[full:].tobytes() + centres.tobytes())
        file.write(rows.tobytes())


def _row(level: int, sh_degree: int) -> np.dtype[np.void]:
    """Return the type of a Gaussian."""
    position, shape, harmonic = _TYPES[level]
    rest = 3 * ((sh_degree + 1) ** 2 - 1)
    fields = [("mean", position, 3), ("scale", shape, 3), ("quat", shape, 4), ("rgba", "u1", 4)]
    return np.dtype([*fields, ("rest", harmonic, (rest,))])


def _read_head(path: str | Path, data: bytes) -> _FileHead:
    """Return the checked header of a file."""
    if len(data) < _HEAD_BYTES:
        raise damaged(path, "header", f"{len(data)} bytes, expected {_HEAD_BYTES}")
    head = _FileHead(*_HEAD.unpack_from(data))
    if (head.major, head.minor) != _VERSION:
        hint = "export it again with @mkkellogg/gaussian-splats-3d 0.4"
        raise FormatError(f"is {head.major}.{head.minor}, expected 0.1.", file=path, field="version", hint=hint)
    check_count(path, head.gaussians, "splatCount")
    if not 1 <= head.sections <= (len(data) - _HEAD_BYTES) // _SECTION_BYTES:
        raise damaged(path, "maxSectionCount", f"{head.sections} sections in {len(data)} bytes")
    if head.level not in _TYPES:
        raise damaged(path, "compressionLevel", f"{head.level}, at most 2")
    head = head._replace(low=head.low or -_HARMONICS, high=head.high or _HARMONICS)
    if not -np.inf < head.low <= head.high < np.inf:
        raise damaged(path, "minSphericalHarmonicsCoeff", f"{head.low:g} to {head.high:g}")
    return head


def _read_section(path: str | Path, data: bytes, level: int, number: int) -> _SectionHead:
    """Return a section whose header agrees with itself, except for the lengths of its buckets."""
    section = _SectionHead(*_SECTION.unpack_from(data, _HEAD_BYTES + number * _SECTION_BYTES))
    section = section._replace(steps=section.steps or STEPS)
    has_buckets = level > 0
    for field, value, is_sound in (
        ("sphericalHarmonicsDegree", section.sh_degree, section.sh_degree <= MAX_SH_DEGREE),
        ("splatCount", section.gaussians, section.gaussians <= section.capacity),
        ("bucketCount", section.buckets, section.buckets == section.full_buckets + section.other_buckets),
        ("bucketStorageSizeBytes", section.centre_bytes, not has_buckets or section.centre_bytes == _CENTRE_BYTES),
        ("bucketBlockSize", section.block, not has_buckets or 0.0 < section.block < np.inf),
    ):
        if not is_sound:
            raise damaged(path, f"section {number} {field}", value)
    return section


def _decode(
    path: str | Path, data: bytes, head: _FileHead, section: _SectionHead, sh_degree: int
) -> tuple[NDArray[np.generic], ...]:
    """Return means, quaternions, scales, colours and opacities, and harmonics beyond DC of a section."""
    rows = np.frombuffer(data, _row(head.level, section.sh_degree), section.gaussians, section.bucket_bytes)
    means, rest = rows["mean"], rows["rest"]
    if head.level > 0:
        offsets = (means.astype(np.float64) - section.steps) * (0.5 * section.block / section.steps)
        means = offsets + _centres(path, data, section)[: section.gaussians]
    if head.level == 2:
        rest = from_steps(rest, head.low, head.high, 255)
    harmonics = np.zeros((section.gaussians, (sh_degree + 1) ** 2 - 1, 3), np.float32)
    for degree in range(1, section.sh_degree + 1):
        here = slice(degree**2 - 1, (degree + 1) ** 2 - 1)
        harmonics[:, here] = from_channel_major(rest[:, 3 * here.start : 3 * here.stop])
    return means, rows["quat"], rows["scale"], rows["rgba"], harmonics


def _centres(path: str | Path, data: bytes, section: _SectionHead) -> NDArray[np.float32]:
    """Return the centre of the bucket of each row (capacity, 3)."""
    others = np.frombuffer(data, "<u4", section.other_buckets)
    centres = np.frombuffer(data, "<f4", 3 * section.buckets, others.nbytes).reshape(-1, 3)
    lengths = np.concatenate([np.full(section.full_buckets, section.bucket_size), others.astype(np.int64)])
    if lengths.sum() != section.capacity:
        raise damaged(path, "buckets", f"{lengths.sum()} Gaussians, expected {section.capacity}")
    return np.repeat(centres, lengths, axis=0)


def _fill_buckets(means: Table) -> tuple[NDArray[np.int64], Table, NDArray[np.uint32]]:
    """Group means (N, 3) by cubes of 5 m, in buckets of at most ``BUCKET``.

    Returns:
        the order of the Gaussians (N,), and the centres (B, 3) and lengths (B,) of the buckets; full ones are first.
    """
    low = means.min(axis=0).astype(np.float64)
    cubes, cube, counts = np.unique(np.floor((means - low) / BLOCK), axis=0, return_inverse=True, return_counts=True)
    centres = (low + (cubes + 0.5) * BLOCK).astype("<f4")
    order = np.argsort(cube, kind="stable")
    rank = np.arange(len(means)) - np.repeat(np.cumsum(counts) - counts, counts)
    full, rest = np.divmod(counts, BUCKET)
    is_full = rank < np.repeat(full * BUCKET, counts)
    lengths = np.concatenate([np.full(full.sum(), BUCKET), rest[rest > 0]]).astype("<u4")
    centres = np.concatenate([np.repeat(centres, full, axis=0), centres[rest > 0]])
    return np.concatenate([order[is_full], order[~is_full]]), centres, lengths


def _to_codes(means: Table, centres: Table) -> Array:
    offsets = means.astype(np.float64) - centres
    return np.clip(np.rint(offsets * (2 * STEPS / BLOCK)) + STEPS, 0, 2 * STEPS + 1)


def _range_of(harmonics: Table) -> tuple[float, float]:
    """Return the ends of 255 steps, one of which ends at zero. Values are at most half a step beyond them.

    An end at zero is a tiny number, because 0 in the header means the default.
    """
    least, most = float(harmonics.min(initial=0.0)), float(harmonics.max(initial=0.0))
    if least == most:
        least, most = -_HARMONICS, _HARMONICS
    step = (most - least) / 255
    below = round(-least / step)
    return -below * step or -_TINY, (255 - below) * step or _TINY


def _encode(path: str | Path, splats: SplatArrays, level: int, low: float, high: float) -> NDArray[np.void]:
    """Return rows whose means are not yet set; ``low`` and ``high``: ends of the harmonics of level 2."""
    degree = round(splats.sh.shape[1] ** 0.5) - 1
    colors, scales = colors_of(splats.sh), linear_scales(splats.log_scales)
    bands = [to_channel_major(splats.sh[:, n**2 - 1 : (n + 1) ** 2]) for n in range(1, degree + 1)]
    rest = np.concatenate([np.zeros((len(scales), 0), np.float32), *bands], axis=1)
    warn_limited(path, "colours", colors, 0.0, 1.0)
    if level > 0:
        warn_limited(path, "logarithms of scales", splats.log_scales, np.log(_HALF_MIN), np.log(_HALF_MAX))
        scales = np.clip(scales, _HALF_MIN, _HALF_MAX)
    if level == 1:
        warn_limited(path, "harmonics", rest, -_HALF_MAX, _HALF_MAX)
        rest = np.clip(rest, -_HALF_MAX, _HALF_MAX)
    rows = np.empty(len(scales), _row(level, degree))
    rows["scale"], rows["quat"] = scales, splats.quats
    rows["rgba"][:, :3] = to_steps(colors, 0.0, 1.0, 255)
    rows["rgba"][:, 3] = to_steps(sigmoid(splats.opacity_logits), 0.0, 1.0, 255)
    rows["rest"] = to_steps(rest, low, high, 255) if level == 2 else rest
    return rows
