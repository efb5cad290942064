"""SPZ of Niantic: 20 bytes a Gaussian of SH degree 0 before compression.

Source: README and `load-spz.cc` of github.com/nianticlabs/spz. Attributes follow each other, each for all Gaussians:

- positions: 3 x 24 bits, fixed point with a number of fractional bits that the header names;
- alphas: 8 bits, opacity times 255;
- colours: 3 x 8 bits of the DC term, 0.15 dc + 0.5;
- scales: 3 x 8 bits of the logarithm, from -10 in steps of 1/16;
- rotations: version 2: x y z of the unit quaternion in 3 x 8 bits, w >= 0. Later: 2 bits for the largest of x y z w,
  then a sign and 9 bits for each of the others;
- harmonics: 8 bits each, (byte - 128) / 128, by coefficient with colours last.

Versions 2 and 3 are one gzip stream with a header of 16 bytes. Version 4 has a header of 32 bytes, extensions, a table
of contents, and one zstd frame for each attribute. Axes are right, up, back, unless an extension names others.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError, InputError
from splatbot.formats.checks import Table, check_count, check_expansion, damaged, read_bytes
from splatbot.formats.conventions import (
    RUB,
    Signs,
    SplatArrays,
    logit,
    model_of,
    sigmoid,
    splats_of,
    to_wxyz,
    to_xyzw,
    turn,
    warn_limited,
)
from splatbot.formats.quantize import Array, Codes, from_smallest_three, to_smallest_three, to_steps
from splatbot.gaussians.model import GaussianModel

MAX_SH_DEGREE = 4
COLOR_SCALE = 0.15  # of the DC term
FRACTIONAL_BITS = 12  # of positions, as Niantic's encoder writes them

Version = Literal[2, 3, 4]

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, SH degree, fractional bits, flags, streams (version 4)
_HEADER_4_BYTES = 32
_IS_ANTIALIASED, _HAS_EXTENSIONS = 0x1, 0x2  # other flags are of other programs, which may append data
_COORDINATES = 0xADBE0003  # type of the extension that names the axes
_RIGHT_UP_BACK = 4  # its value for the axes without the extension
_MAX_EXTENSIONS = 2**16  # bytes
_LOWEST_SCALE, _SCALE_STEPS = -10.0, 16.0
_SMALLEST_STEPS = 511  # of one sign

_GZIP_LEVEL, _ZSTD_LEVEL = 6, 9
_FROM_NEWER = "export it as SPZ 4 or older"


class _Head(NamedTuple):
    version: int
    gaussians: int
    sh_degree: int
    fractional_bits: int
    flags: int
    streams: int

    def sizes(self) -> list[int]:
        """Return the bytes of positions, alphas, colours, scales, rotations and harmonics."""
        rotation = 3 if self.version == 2 else 4
        return [self.gaussians * each for each in (9, 1, 3, 3, rotation, 3 * ((self.sh_degree + 1) ** 2 - 1))]


def load_spz(path: str | Path) -> GaussianModel:
    """Read an SPZ file of version 2, 3 or 4.

    The size of the decoded data follows from the header, and is checked before any of it is decoded.

    Raises:
        FormatError: the file is missing, truncated or damaged, or of another version.
    """
    data = read_bytes(path)
    if data[:2] == b"\x1f\x8b":
        head, extensions, body = _inflate(path, data)
    else:
        head = _head(path, data, len(data))
        if head.version == 4:
            extensions, body = _read_streams(path, data, head)
        else:  # without gzip, as some converters write it
            body = data[_HEADER.size :][: sum(head.sizes())]
            extensions = data[_HEADER.size + len(body) :][:_MAX_EXTENSIONS]
    if len(body) != sum(head.sizes()):
        raise damaged(path, "attributes", f"{len(body)} bytes, expected {sum(head.sizes())}")
    if extensions and not head.flags & ~_IS_ANTIALIASED:
        raise damaged(path, "numPoints", f"more data than {head.gaussians} Gaussians")
    signs = _axes(path, extensions) if head.flags & _HAS_EXTENSIONS else RUB
    return model_of(path, turn(_decode(head, body), signs))


def save_spz(model: GaussianModel, path: str | Path, version: Version = 3) -> None:
    """Write an SPZ file. Every reader of version 4 reads version 3 too, which is the default for this reason.

    Errors are at most half a step. It is 1/8192 m for positions, and less if all are below 8 m: their 24 bits have more
    fractional bits then, and fewer above 2048 m. It is 1/510 for opacities, 1/76.5 for DC terms (-3.33..3.33), 1/32 for
    logarithms of scales (-10..5.9), 1/256 for harmonics (-1..0.99), and 0.0007 for components of quaternions. Version 2
    stores x y z of quaternions with errors of 0.004, and up to SH degree 3.

    Raises:
        InputError: the model is empty, a value is not finite, or a position is beyond 8,388,607 m.
    """
    splats = turn(splats_of(model, path, max_sh_degree=3 if version == 2 else MAX_SH_DEGREE), RUB)
    dc_limit = 0.5 / COLOR_SCALE
    warn_limited(path, "DC terms", splats.sh[:, 0], -dc_limit, dc_limit)
    warn_limited(path, "logarithms of scales", splats.log_scales, _LOWEST_SCALE, _LOWEST_SCALE + 255 / _SCALE_STEPS)
    warn_limited(path, "harmonics", splats.sh[:, 1:], -1.0, 1.0)
    extent = float(np.abs(splats.means).max())
    exponent = int(np.frexp(extent)[1])  # extent <= 2 ** exponent
    if exponent > 23:
        raise InputError(f"reach {extent:g} m.", file=path, field="means", hint="SPZ holds up to 8,388,607 m")
    bits = max(0, min(23 - exponent, max(FRACTIONAL_BITS, 15 - exponent), 23))
    parts = _encode(splats, version, bits)
    head = struct.pack("<II", version, len(splats.means)) + bytes([round(splats.sh.shape[1] ** 0.5) - 1, bits, 0])
    if version == 4:
        content = _write_streams(head, [part for part in parts if part])
    else:
        body = b"".join([_MAGIC, head, b"\0", *parts])
        content = gzip.compress(body, compresslevel=_GZIP_LEVEL, mtime=0)
    with atomic_write(path) as file:
        file.write(content)


def _head(path: str | Path, data: bytes, stored: int) -> _Head:
    """Return the checked header that begins ``data``; ``stored``: bytes of the whole file."""
    if len(data) < _HEADER.size:
        raise damaged(path, "header", f"{len(data)} bytes")
    magic, *numbers = _HEADER.unpack_from(data)
    head = _Head(*numbers)
    if magic != _MAGIC:
        raise FormatError("has no SPZ header.", file=path, field="magic", hint="give an .spz file, or unpack the gzip")
    if head.version not in (2, 3, 4):
        raise FormatError(f"is {head.version}, expected 2 to 4.", file=path, field="version", hint=_FROM_NEWER)
    check_count(path, head.gaussians, "numPoints")
    if head.sh_degree > MAX_SH_DEGREE:
        raise damaged(path, "shDegree", f"{head.sh_degree}, at most {MAX_SH_DEGREE}")
    if head.fractional_bits > 30:
        raise damaged(path, "fractionalBits", f"{head.fractional_bits}, at most 30")
    check_expansion(path, sum(head.sizes()), stored, "numPoints")
    return head


def _inflate(path: str | Path, data: bytes) -> tuple[_Head, bytes, bytes]:
    """Return header, extensions and attributes of a gzip stream, whose checksum zlib compares."""
    stream = zlib.decompressobj(wbits=31)
    try:
        head = _head(path, stream.decompress(data, _HEADER.size), len(data))
        body = stream.decompress(stream.unconsumed_tail, sum(head.sizes()))
        extensions = stream.decompress(stream.unconsumed_tail, _MAX_EXTENSIONS)
    except zlib.error as error:
        raise damaged(path, "gzip", error) from error
    if not stream.eof:
        raise damaged(path, "gzip", "the stream does not end where the header says")
    return head, extensions, body


def _read_streams(path: str | Path, data: bytes, head: _Head) -> tuple[bytes, bytes]:
    """Return extensions and attributes of version 4."""
    import zstandard

    sizes = [size for size in head.sizes() if size]
    if head.streams != len(sizes) or len(data) < _HEADER_4_BYTES:
        raise damaged(path, "numStreams", f"{head.streams}, expected {len(sizes)}")
    contents = int.from_bytes(data[16:20], "little")
    if not _HEADER_4_BYTES <= contents <= len(data) - 16 * len(sizes):
        raise damaged(path, "tocByteOffset", contents)
    start, body = contents + 16 * len(sizes), []
    for i, size in enumerate(sizes):
        stored, decoded = struct.unpack_from("<QQ", data, contents + 16 * i)
        frame = data[start : start + stored]
        start += len(frame)
        try:
            if decoded != size or len(frame) != stored or zstandard.frame_content_size(frame) not in (size, -1):
                raise damaged(path, f"stream {i}", f"{decoded} bytes in {stored}, expected {size}")
            body.append(zstandard.ZstdDecompressor().decompress(frame, max_output_size=size))
        except zstandard.ZstdError as error:
            raise damaged(path, f"stream {i}", error) from error
        if len(body[-1]) != size:
            raise damaged(path, f"stream {i}", f"{len(body[-1])} bytes, expected {size}")
    return data[_HEADER_4_BYTES:contents], b"".join(body)


def _write_streams(head: bytes, parts: list[bytes]) -> bytes:
    import zstandard

    frames = [zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(part) for part in parts]
    contents = [struct.pack("<QQ", len(frame), len(part)) for frame, part in zip(frames, parts, strict=True)]
    header = _MAGIC + head + bytes([len(parts)]) + struct.pack("<I", _HEADER_4_BYTES) + bytes(12)
    return b"".join([header, *contents, *frames])


def _axes(path: str | Path, extensions: bytes) -> Signs:
    """Return the signs between RDF and the axes that the extension records name: type, length, payload of each."""
    offset = 0
    while offset + 8 <= len(extensions):
        kind, length = struct.unpack_from("<II", extensions, offset)
        if kind == _COORDINATES and length == 4:
            value = int.from_bytes(extensions[offset + 8 : offset + 12], "little") or _RIGHT_UP_BACK
            if value > 8:  # y and z exchanged
                hint = "export it without the extension SPZ_ADOBE_coordinate_system"
                raise FormatError(f"are of kind {value}.", file=path, field="axes", hint=hint)
            # bits of value - 1: right, up, forward; those of right, down, forward (value 6) are 1, 0, 1
            right, up, forward = ((value - 1) >> bit & 1 for bit in range(3))
            return (1 if right else -1, -1 if up else 1, 1 if forward else -1)
        offset += 8 + length
    return RUB


def _decode(head: _Head, body: bytes) -> SplatArrays:
    """Return the attributes in the axes of the file."""
    splits = np.cumsum(head.sizes())[:-1]
    positions, alphas, colors, scales, rotations, rest = np.split(np.frombuffer(body, np.uint8), splits)
    fixed = np.zeros((head.gaussians, 3, 4), np.uint8)
    fixed[:, :, 1:] = positions.reshape(head.gaussians, 3, 3)
    means = (fixed.view("<i4")[:, :, 0] >> 8) / 2.0**head.fractional_bits  # the shift extends the sign
    dc = (colors.reshape(head.gaussians, 1, 3) / 255.0 - 0.5) / COLOR_SCALE
    sh = np.concatenate([dc, (rest.reshape(head.gaussians, -1, 3) - 128.0) / 128.0], axis=1)
    arrays = (
        means,
        to_wxyz(_first_three(rotations) if head.version == 2 else _smallest_three(rotations)),
        scales.reshape(head.gaussians, 3) / _SCALE_STEPS + _LOWEST_SCALE,
        logit(alphas / 255.0),
        sh,
    )
    return SplatArrays(*(values.astype(np.float32) for values in arrays))


def _first_three(codes: NDArray[np.uint8]) -> Array:
    """Return quaternions (N, 4) xyzw of version 2."""
    xyz = codes.reshape(-1, 3) / 127.5 - 1.0
    w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1, keepdims=True)))
    return np.concatenate([xyz, w], axis=1)


def _smallest_three(codes: NDArray[np.uint8]) -> Array:
    """Return quaternions (N, 4) xyzw of later versions."""
    words = codes.view("<u4")
    fields = np.stack([words >> 20, words >> 10, words], axis=1)
    size = (fields & 511) / float(_SMALLEST_STEPS)
    return from_smallest_three(words >> 30, np.where(fields & 512, -size, size))


def _encode(splats: SplatArrays, version: Version, bits: int) -> list[bytes]:
    """Return the attributes in the order of the file."""
    fixed = np.rint(splats.means.astype(np.float64) * 2.0**bits)
    positions = np.clip(fixed, -(2**23), 2**23 - 1).astype("<i4").view(np.uint8).reshape(-1, 3, 4)[:, :, :3]
    dc = splats.sh[:, 0] * COLOR_SCALE + 0.5
    scales = np.rint((splats.log_scales - _LOWEST_SCALE) * _SCALE_STEPS)
    quats = to_xyzw(splats.quats)
    attributes: list[Table | Codes | NDArray[np.uint8]] = [
        positions,
        to_steps(sigmoid(splats.opacity_logits), 0.0, 1.0, 255).astype(np.uint8),
        to_steps(dc, 0.0, 1.0, 255).astype(np.uint8),
        np.clip(scales, 0, 255).astype(np.uint8),
        _pack_first_three(quats) if version == 2 else _pack_smallest_three(quats),
        np.clip(np.rint(splats.sh[:, 1:] * 128.0) + 128.0, 0, 255).astype(np.uint8),
    ]
    return [values.tobytes() for values in attributes]


def _pack_first_three(quats: NDArray[np.floating]) -> NDArray[np.uint8]:
    sign = np.where(quats[:, 3:] < 0, -1.0, 1.0)
    return to_steps(quats[:, :3] * sign, -1.0, 1.0, 255).astype(np.uint8)


def _pack_smallest_three(quats: NDArray[np.floating]) -> Codes:
    largest, others = to_smallest_three(quats)
    size = to_steps(np.abs(others), 0.0, 1.0, _SMALLEST_STEPS)
    fields = np.where(others < 0, size | 512, size)
    return (largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]).astype("<u4")
