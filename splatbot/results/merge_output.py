"""The folder of a merge: checks by names, before any library is loaded, and its replacement once it is whole."""

from __future__ import annotations

import os
import secrets
import shutil
from pathlib import Path

from splatbot.atomic import replace
from splatbot.checksums import NAME as SUMS
from splatbot.errors import InputError
from splatbot.layouts import MAP_NAME

RECORDINGS = "recordings.yaml"
"""List of the recordings of a merged run, in its folder."""
SUMMARY = "merge.json"
_STATE = "state"
_OF_RUNS = {
    *(MAP_NAME, "map.mapped.ply", "map.html", "config.yaml", "frames.jsonl", "metrics.json", "audit.json"),
    *("report.html", SUMS, _STATE, RECORDINGS, SUMMARY),
}
"""Files and folders of a run that another run replaces; those of its cameras, ``trajectory*.tum``, too."""


def check_merge(a: str | Path, b: str | Path, out: str | Path, *, overwrite: bool) -> None:
    """Check that two runs may be merged into a folder.

    Raises:
        InputError: A and B are one run, the folder is one of them, a mount point, or it holds a run and ``overwrite``
            is not set.
    """
    folder, first, later = (Path(path).resolve() for path in (out, a, b))
    if first == later:
        raise InputError("A and B are one run.", file=b, field="B", hint="give two runs of the same place")
    if folder in (first, later):
        raise InputError("is one of the merged runs.", file=out, field="--out", hint="name another folder")
    if os.path.ismount(folder):
        raise InputError(
            "is a mount point, which cannot be replaced.", file=out, field="--out", hint="name a folder in it"
        )
    found = [name for name in (MAP_NAME, "metrics.json", _STATE, RECORDINGS) if (folder / name).exists()]
    if found and not overwrite:
        hint = "name another folder, or give --overwrite to replace it"
        raise InputError(f"holds a run already ({', '.join(found)}).", file=out, field="--out", hint=hint)


def draft_of(out: str | Path) -> Path:
    """Return the folder next to ``out`` in which a merge writes; one that a killed merge left there is replaced."""
    folder = Path(out).resolve()
    return folder.with_name(f".{folder.name}.draft")


def replace_run(draft: Path, out: str | Path) -> None:
    """Rename a finished run to ``out``. An earlier run there is removed; files of other commands stay, as scene.yaml.

    Until the last rename, ``out`` is the earlier run; after an error too.

    Raises:
        OSError: a folder cannot be renamed.
    """
    folder = Path(out).resolve()
    earlier = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.old")
    if not folder.exists():
        replace(draft, folder)
        return
    folder.rename(earlier)
    try:
        replace(draft, folder)
    except OSError:
        earlier.rename(folder)
        raise
    for path in earlier.iterdir():
        if path.name not in _OF_RUNS and not path.match("trajectory*.tum"):
            path.rename(folder / path.name)
    shutil.rmtree(earlier)
