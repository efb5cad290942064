"""Map and trajectory files. Readers detect the format from the content, writers from the suffix."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from splatbot.errors import FormatError

if TYPE_CHECKING:  # importing torch takes seconds, and trajectories do not need it
    from splatbot.gaussians import GaussianModel

__all__ = ["FORMATS", "WRITTEN", "MapFormat", "find_format", "load_gaussians", "save_gaussians"]


@dataclass(frozen=True)
class MapFormat:
    """Map format that is read and written.

    Args:
        name: name for users.
        suffix: end of the names of written files.
        module: module of this package that has ``load_MODULE`` and ``save_MODULE``.
        max_sh_degree: the highest SH degree that it stores.
        rounded: the values that it does not store as float32, for users.
        has_bookkeeping: whether it stores observations, anchors, uncertainty and misses.
    """

    name: str
    suffix: str
    module: str
    max_sh_degree: int
    rounded: str = ""
    has_bookkeeping: bool = False

    def load(self, path: str | Path) -> GaussianModel:
        """Read a file that is of this format."""
        function: Callable[[str | Path], GaussianModel] = self._function("load")
        return function(path)

    def save(self, model: GaussianModel, path: str | Path) -> None:
        """Write a file of this format."""
        self._function("save")(model, path)

    def _function(self, verb: str) -> Callable[..., GaussianModel]:
        module = importlib.import_module(f"splatbot.formats.{self.module}")
        function: Callable[..., GaussianModel] = getattr(module, f"{verb}_{self.module}")
        return function


_ALL = "positions, scales, rotations, colours, opacities"
FORMATS = (
    MapFormat("compressed PLY", ".compressed.ply", "compressed_ply", 3, _ALL),
    MapFormat("3DGS PLY", ".ply", "ply", 4, has_bookkeeping=True),
    MapFormat(".splat", ".splat", "splat", 0, "rotations, colours, opacities"),
    MapFormat(".ksplat", ".ksplat", "ksplat", 2, _ALL),
    MapFormat("SPZ", ".spz", "spz", 4, _ALL),
    MapFormat("SBZ", ".sbz", "sbz", 0, f"{_ALL}, uncertainty", has_bookkeeping=True),
    MapFormat("SOG", ".sog", "sog", 3, _ALL),
    MapFormat("SOG folder", "_sog", "sog", 3, _ALL),
    MapFormat("glTF with KHR_gaussian_splatting", ".glb", "glb", 3),
    MapFormat("OpenUSD", ".usd", "usd", 3),
    MapFormat("OpenUSD text", ".usda", "usd", 3),
    MapFormat("OpenUSD binary", ".usdc", "usd", 3),
    MapFormat("OpenUSD package", ".usdz", "usd", 3),
)
"""Formats of maps; a name has the format of the first suffix that it ends in."""

WRITTEN = tuple(entry.suffix[1:] for entry in FORMATS if entry.suffix.startswith("."))
"""Suffixes, without the dot, of the formats in which a map is one file."""

_KNOWN = ", ".join(f"{entry.name} ({entry.suffix})" for entry in FORMATS)
_BY_MODULE = {entry.module: entry for entry in reversed(FORMATS)}
_MAGIC = {b"ply": "ply", b"NGSP": "spz", b"SBZ": "sbz", b"\x1f\x8b": "spz", b"PK": "sog", b"{": "sog", b"glTF": "glb"}
_MAGIC |= {b"#usd": "usd", b"PXR-": "usd", b"\0\1\0\0": "ksplat"}


def load_gaussians(path: str | Path) -> GaussianModel:
    """Read a map of any supported format: a file, or the folder of a SOG.

    Raises:
        FormatError: the file is missing, damaged or of an unknown format.
    """
    place = Path(path)
    if (place / "meta.json").is_file():
        place = place / "meta.json"
    try:
        with place.open("rb") as file:
            magic = file.read(4)
    except OSError as error:
        raise FormatError(f"cannot be read ({error.strerror}).", file=path, hint="give a map file") from error
    module = next((module for start, module in _MAGIC.items() if magic.startswith(start)), None)
    if magic and place.suffix.lower() == ".splat":  # without a magic number: its first float may equal one of another
        module = "splat"
    elif module == "ply" and _has_chunks(place):
        module = "compressed_ply"
    elif magic[:2] == b"PK" and _begins_with_usd(place):
        module = "usd"
    if module is None:
        found = f"begins with {magic!r}" if magic else "is empty"
        hint = f"known formats: {_KNOWN}"
        raise FormatError(f"{found}, which is no known format.", file=path, field="format", hint=hint)
    return _BY_MODULE[module].load(place)


def save_gaussians(model: GaussianModel, path: str | Path) -> None:
    """Write a map in the format of the suffix; ``path`` is replaced only once the file is complete.

    Other formats than 3DGS PLY drop values that they cannot store: see :data:`FORMATS` and docs/guide/formats.md.

    Raises:
        FormatError: the suffix is unknown.
        InputError: the format cannot store the model.
    """
    find_format(path).save(model, path)


def find_format(path: str | Path) -> MapFormat:
    """Return the format in which a file of a name is written.

    Raises:
        FormatError: the suffix is unknown.
    """
    name = Path(path).name.lower()
    for entry in FORMATS:
        if name.endswith(entry.suffix):
            return entry
    raise FormatError("the suffix names no known format.", file=path, field="format", hint=f"use {_KNOWN}")


def _has_chunks(path: Path) -> bool:
    from splatbot.formats.ply_file import read_ply_header

    return any(element.name == "chunk" for element in read_ply_header(path).elements)


def _begins_with_usd(path: Path) -> bool:
    """Return whether the first file of a ZIP archive is an OpenUSD file, as in a package."""
    with path.open("rb") as file:
        header = file.read(30)
        return file.read(int.from_bytes(header[26:28], "little")).endswith((b".usd", b".usda", b".usdc"))
