"""Checks of a merge by the names of its folders, before any library is loaded."""

from __future__ import annotations

from pathlib import Path

from splatbot.errors import InputError
from splatbot.layouts import MAP_NAME

RECORDINGS = "recordings.yaml"
"""List of the recordings of a merged run, in its folder."""


def check_merge(a: str | Path, b: str | Path, out: str | Path, *, overwrite: bool) -> None:
    """Check that two runs may be merged into a folder.

    Raises:
        InputError: A and B are one run, the folder is one of them, or it holds a run and ``overwrite`` is not set.
    """
    folder, first, later = (Path(path).resolve() for path in (out, a, b))
    if first == later:
        raise InputError("A and B are one run.", file=b, field="B", hint="give two runs of the same place")
    if folder in (first, later):
        raise InputError("is one of the merged runs.", file=out, field="--out", hint="name another folder")
    found = [name for name in (MAP_NAME, "metrics.json", "state", RECORDINGS) if (folder / name).exists()]
    if found and not overwrite:
        hint = "name another folder, or give --overwrite to replace it"
        raise InputError(f"holds a run already ({', '.join(found)}).", file=out, field="--out", hint=hint)
