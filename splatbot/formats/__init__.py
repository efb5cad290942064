"""Map and trajectory files. Readers detect the format from the content, writers from the suffix."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from splatbot.errors import FormatError

if TYPE_CHECKING:  # importing torch takes seconds, and trajectories do not need it
    from splatbot.gaussians import GaussianModel

__all__ = ["WRITTEN", "load_gaussians", "save_gaussians"]

WRITTEN = ("ply",)
"""Suffixes of the formats in which maps are written."""

_KNOWN = "3DGS PLY (.ply)"


def load_gaussians(path: str | Path) -> GaussianModel:
    """Read a map of any supported format.

    Raises:
        FormatError: the file is missing, damaged or of an unknown format.
    """
    try:
        with Path(path).open("rb") as file:
            magic = file.read(4)
    except OSError as error:
        raise FormatError(f"cannot be read ({error.strerror}).", file=path, hint="give a map file") from error
    if magic[:3] == b"ply":
        from splatbot.formats.ply import load_ply

        return load_ply(path)
    found = f"begins with {magic!r}" if magic else "is empty"
    raise FormatError(f"{found}, which is no known format.", file=path, field="format", hint=f"known formats: {_KNOWN}")


def save_gaussians(model: GaussianModel, path: str | Path) -> None:
    """Write a map in the format of the suffix; ``path`` is replaced only once the file is complete.

    Raises:
        FormatError: the suffix is unknown.
    """
    if Path(path).suffix.lower().removeprefix(".") not in WRITTEN:
        raise FormatError("the suffix names no known format.", file=path, field="format", hint=f"use {_KNOWN}")
    from splatbot.formats.ply import save_ply

    save_ply(model, path)
