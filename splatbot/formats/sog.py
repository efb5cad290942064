"""SOG version 2 of PlayCanvas: lossless WebP images with one pixel a Gaussian, and meta.json that describes them.

Source: developer.playcanvas.com, Gaussian splatting, formats, SOG; `read-sog.ts` of splat-transform. A folder holds the
files, or a ZIP archive named `.sog`:

- means_l, means_u: low and high byte of 16 bits for x, y, z, over the ranges of sign(x) ln(|x| + 1) in meta.json;
- quats: three components times √2 in 8 bits over -1..1; alpha is 252 plus the index of the largest of w x y z;
- scales: index of each logarithm in a codebook of 256;
- sh0: index of each DC term in a codebook of 256; alpha is the opacity;
- shN_centroids, shN_labels: vectors of harmonics as indices in a codebook of 256, and each Gaussian's vector.

The axes are those of 3DGS PLY.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import atomic_write, replace_files, write_bytes
from splatbot.errors import FormatError
from splatbot.formats.checks import check_count, check_expansion, damaged, read_bytes
from splatbot.formats.codebooks import nearest_entries, number_codebook, vector_codebook
from splatbot.formats.conventions import SplatArrays, Table, logit, model_of, sigmoid, splats_of
from splatbot.formats.quantize import (
    Array,
    from_smallest_three,
    from_steps,
    morton_order,
    to_smallest_three,
    to_steps,
)
from splatbot.gaussians.model import GaussianModel

MAX_SH_DEGREE = 3
META = "meta.json"

Bytes = NDArray[np.uint8]
Reader = Callable[[str, int], bytes]  # content of a file by its name and largest size [bytes]

_HARMONICS = ("shN_centroids.webp", "shN_labels.webp")  # absent for SH degree 0
_LARGEST = 252  # alpha of a quaternion whose w is the largest
_PALETTE_COLUMNS = 64
_MAX_PALETTE = 2**16
_MAX_META = 2**22  # bytes
_LOSSLESS = 101  # quality beyond 100
_HINT = "export the map as SOG version 2 again"


def load_sog(path: str | Path) -> GaussianModel:
    """Read a SOG file of version 2: a ZIP archive (.sog), or the meta.json of a folder.

    The count in meta.json bounds the size of each image before it is decoded.

    Raises:
        FormatError: a file is missing, truncated or damaged, or of another version.
    """
    data = read_bytes(path)
    if data[:2] == b"PK":
        read, stored = _zip_reader(path, data), len(data)
        data = read(META, _MAX_META)
    else:
        folder = Path(path).parent
        read, stored = _folder_reader(folder), sum(file.stat().st_size for file in folder.iterdir() if file.is_file())
    try:
        return model_of(path, _decode(path, _meta(path, data), read, stored))
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise damaged(path, META, error) from error


def save_sog(model: GaussianModel, path: str | Path) -> None:
    """Write a SOG of version 2: a ZIP archive, or a folder if the name ends in `_sog`. Gaussians are in Morton order.

    Errors are at most 1/131,070 of the range of sign(x) ln(|x| + 1) for positions, 1/361 for components of quaternions
    and 1/510 for opacities. Logarithms of scales and DC terms become the nearest of 256 values. The DC term of a
    Gaussian whose opacity is stored as 0 is lost. Harmonics up to degree 3 share at most 65,536 vectors.

    Raises:
        InputError: the model is empty, or a value is not finite.
    """
    files = _encode(splats_of(model, path, max_sh_degree=MAX_SH_DEGREE))
    if is_sog_folder(path):
        writers = {name: write_bytes(content) for name, content in files.items()}
        replace_files(path, writers, remove=(META, *_HARMONICS))  # a folder without meta.json is no SOG
        return
    with atomic_write(path) as target, zipfile.ZipFile(target, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content)  # the fixed date keeps equal maps equal


def is_sog_folder(path: str | Path) -> bool:
    """Return whether the name of a new SOG is that of a folder."""
    return Path(path).name.lower().endswith("_sog")


def _zip_reader(path: str | Path, data: bytes) -> Reader:
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise damaged(path, "zip", error) from error

    def read(name: str, most: int) -> bytes:
        try:
            with archive.open(name) as member:
                content = member.read(most + 1)
        except KeyError as error:
            raise FormatError(f"has no {name}.", file=path, field=name, hint=_HINT) from error
        except Exception as error:  # zlib, lzma, encryption: zipfile passes on the errors of all its parts
            raise damaged(path, name, error) from error
        return _within(path, name, content, most)

    return read


def _folder_reader(folder: Path) -> Reader:
    def read(name: str, most: int) -> bytes:
        if Path(name).name != name:
            raise FormatError(f"names {name!r}.", file=folder / META, field="files", hint="name files of the folder")
        return _within(folder / name, name, read_bytes(folder / name), most)

    return read


def _within(path: str | Path, name: str, content: bytes, most: int) -> bytes:
    if len(content) > most:
        raise damaged(path, name, f"more than {most:,} bytes")
    return content


def _meta(path: str | Path, data: bytes) -> dict[str, Any]:
    try:
        meta = json.loads(data.decode())
    except (ValueError, RecursionError) as error:
        raise damaged(path, META, error) from error
    if not isinstance(meta, dict) or "means" not in meta:
        hint = "give an .sog file, or the meta.json of a folder of WebP images"
        raise FormatError("describes no SOG.", file=path, field=META, hint=hint)
    if meta.get("version") != 2:
        hint = "convert it to version 2 with splat-transform"
        raise FormatError(f"is {meta.get('version')}, expected 2.", file=path, field="version", hint=hint)
    return meta


def _decode(path: str | Path, meta: dict[str, Any], read: Reader, stored: int) -> SplatArrays:
    count = int(meta["count"])
    check_count(path, count, "count")
    bands = int(meta["shN"]["bands"]) if meta.get("shN") else 0
    check_expansion(path, 4 * (11 + 3 * (bands + 1) ** 2) * count, stored, "count")

    def pixels(part: str, index: int = 0) -> NDArray[np.int64]:
        image = _read_image(path, meta[part]["files"][index], read, most=2 * count + 4096)
        if len(image) < count:
            raise damaged(path, part, f"{len(image)} pixels for {count} Gaussians")
        return image[:count].astype(np.int64)

    low, high = (np.array(meta["means"][name], np.float64).reshape(3) for name in ("mins", "maxs"))
    fixed = pixels("means")[:, :3] | pixels("means", 1)[:, :3] << 8
    quats, color = pixels("quats"), pixels("sh0")
    if (quats[:, 3] < _LARGEST).any():
        raise damaged(path, "quats", f"row {int(np.argmax(quats[:, 3] < _LARGEST))} names no component")
    sh = _codebook(meta["sh0"])[color[:, None, :3]]
    if meta.get("shN"):
        rest = _decode_harmonics(path, meta["shN"], read, pixels("shN", 1), count)
        sh = np.concatenate([sh, rest], axis=1)
    arrays = (
        _exponential(from_steps(fixed, low, high, 65535)),
        from_smallest_three(quats[:, 3] - _LARGEST, quats[:, :3] / 127.5 - 1.0),
        _codebook(meta["scales"])[pixels("scales")[:, :3]],
        logit(color[:, 3] / 255.0),
        sh,
    )
    return SplatArrays(*(values.astype(np.float32) for values in arrays))


def _decode_harmonics(
    path: str | Path, part: dict[str, Any], read: Reader, labels: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    """Return harmonics beyond DC (N, K - 1, 3)."""
    bands, vectors = int(part["bands"]), int(part["count"])
    if not 1 <= bands <= MAX_SH_DEGREE or not 1 <= vectors <= _MAX_PALETTE:
        raise damaged(path, "shN", f"{vectors} vectors of degree {bands}")
    width = (bands + 1) ** 2 - 1
    rows = -(-vectors // _PALETTE_COLUMNS)
    name = part["files"][0]
    palette = _read_image(path, name, read, most=_PALETTE_COLUMNS * width * (rows + 64))
    index = labels[:, 0] | labels[:, 1] << 8
    if len(palette) < vectors * width or index.max() >= vectors:
        raise damaged(path, "shN", f"label {index.max()} of {len(palette) // width} vectors")
    return _codebook(part)[palette[: vectors * width, :3]].reshape(vectors, width, 3)[index]


def _codebook(part: dict[str, Any]) -> NDArray[np.float64]:
    entries = np.array(part["codebook"], np.float64).reshape(-1)[:256]
    return np.pad(entries, (0, 256 - len(entries)), mode="edge")


def _read_image(path: str | Path, name: object, read: Reader, *, most: int) -> Bytes:
    """Return the pixels (N, 4) RGBA of a WebP image of at most ``most`` pixels, row by row."""
    import cv2

    if not isinstance(name, str):
        raise damaged(path, "files", f"{name!r} is no name")
    content = read(name, 8 * most + 4096)
    width, height = _webp_size(path, name, content)
    if width * height > most:
        raise damaged(path, name, f"{width} x {height} pixels, expected at most {most:,}")
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.dtype != np.uint8 or image.shape[:2] != (height, width):
        raise damaged(path, name, "it is no colour image")
    code = cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGBA
    return np.asarray(cv2.cvtColor(image, code), np.uint8).reshape(-1, 4)


def _webp_size(path: str | Path, name: str, content: bytes) -> tuple[int, int]:
    """Return width and height of a lossless WebP image without decoding it."""
    if content[:4] != b"RIFF" or content[8:16] != b"WEBPVP8L" or len(content) < 25 or content[20] != 0x2F:
        raise FormatError("is no lossless WebP image.", file=path, field=name, hint=_HINT)
    (bits,) = struct.unpack_from("<I", content, 21)
    return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1


def _encode(splats: SplatArrays) -> dict[str, bytes]:
    """Return the files by name; meta.json is the last."""
    order = morton_order(splats.means)
    images, meta = _encode_attributes(SplatArrays(*(values[order] for values in splats)))
    count, harmonics = len(order), splats.sh.shape[1] - 1
    width = -(-int(np.ceil(np.sqrt(count))) // 4) * 4
    with ThreadPoolExecutor() as pool:
        jobs = {name: pool.submit(_write_image, values, width) for name, values in images.items()}
        if harmonics:  # while images are compressed
            palette, labels, meta["shN"] = _encode_harmonics(splats.sh[order, 1:])
            values = (palette, _PALETTE_COLUMNS * harmonics), (labels, width)
            jobs |= {name: pool.submit(_write_image, *each) for name, each in zip(_HARMONICS, values, strict=True)}
        return {name: job.result() for name, job in jobs.items()} | {META: json.dumps(meta).encode()}


def _encode_attributes(splats: SplatArrays) -> tuple[dict[str, NDArray[np.integer]], dict[str, Any]]:
    """Return the pixels of the images by name, and the content of meta.json, without harmonics beyond DC."""
    logarithms = _logarithm(splats.means)
    low, high = logarithms.min(axis=0), logarithms.max(axis=0)
    fixed = to_steps(logarithms, low, high, 65535)
    largest, others = to_smallest_three(splats.quats)
    dc, opacity = splats.sh[:, 0], to_steps(sigmoid(splats.opacity_logits), 0.0, 1.0, 255)[:, None]
    scales, colors = number_codebook(splats.log_scales, 256), number_codebook(dc, 256)
    images: dict[str, NDArray[np.integer]] = {
        "means_l.webp": fixed & 255,
        "means_u.webp": fixed >> 8,
        "scales.webp": nearest_entries(scales, splats.log_scales),
        "quats.webp": np.concatenate([to_steps(others, -1.0, 1.0, 255), largest[:, None] + _LARGEST], axis=1),
        # encoders may change the colour of transparent pixels; zeros keep it the same in all
        "sh0.webp": np.concatenate([np.where(opacity > 0, nearest_entries(colors, dc), 0), opacity], axis=1),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "splatbot"},
        "count": len(fixed),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.tolist(), "files": ["sh0.webp"]},
    }
    return images, meta


def _encode_harmonics(rest: Table) -> tuple[NDArray[np.integer], NDArray[np.integer], dict[str, Any]]:
    """Return the pixels of the palette and of the labels of harmonics (N, K - 1, 3), and their entry of meta.json."""
    codebook = number_codebook(rest, 256)
    vectors, labels = vector_codebook(codebook[nearest_entries(codebook, rest)].reshape(len(rest), -1), _MAX_PALETTE)
    entry = {
        "count": len(vectors),
        "bands": round((rest.shape[1] + 1) ** 0.5) - 1,
        "codebook": codebook.tolist(),
        "files": list(_HARMONICS),
    }
    palette = nearest_entries(codebook, vectors).reshape(-1, 3)
    return palette, np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1), entry


def _write_image(values: NDArray[np.integer], width: int) -> bytes:
    """Return rows of bytes (N, 3) RGB or (N, 4) RGBA as a lossless WebP image."""
    import cv2

    height = -(-len(values) // width)
    fill = 255 if values.shape[1] == 4 else 0  # of alpha, so that unused pixels are opaque
    pixels = np.full((width * height, values.shape[1]), fill, np.uint8)
    pixels[: len(values)] = values
    order = [2, 1, 0, 3][: values.shape[1]]
    image = np.ascontiguousarray(pixels[:, order].reshape(height, width, -1))
    return cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _LOSSLESS])[1].tobytes()


def _logarithm(means: Table) -> Array:
    values = means.astype(np.float64)
    return np.sign(values) * np.log1p(np.abs(values))


def _exponential(logarithms: Array) -> Array:
    return np.sign(logarithms) * np.expm1(np.abs(logarithms))
