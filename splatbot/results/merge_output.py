"""The folder of a merge: checks by names, before any library is loaded, and its replacement once it is whole."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from splatbot.atomic import replace, sync_folder
from splatbot.checksums import NAME as SUMS
from splatbot.errors import InputError
from splatbot.layouts import MAP_NAME

RECORDINGS = "recordings.yaml"
"""List of the recordings of a merged run, in its folder."""
SUMMARY = "merge.json"
_ELSEWHERE = "name another folder"
_OF_RUNS = {
    *(MAP_NAME, "map.mapped.ply", "map.html", "config.yaml", "frames.jsonl", "trajectory.tum", "metrics.json"),
    *("audit.json", "measured_surface.npz", "report.html", SUMS, "state", RECORDINGS, SUMMARY),
}
"""Files and folders of a run that another run replaces; those of further cameras, ``trajectory-*.tum``, too."""


def check_merge(a: str | Path, b: str | Path, out: str | Path, *, overwrite: bool) -> None:
    """Check that two runs may be merged into a folder.

    Raises:
        InputError: A and B are one run, or the folder is one of them. The folder is or contains a mount point, or a
            killed merge left an earlier one next to it. It holds a file that the merge would remove, and ``overwrite``
            is not set.
    """
    folder, first, later = (Path(path).resolve() for path in (out, a, b))
    if first == later:
        raise InputError("A and B are one run.", file=b, field="B", hint="give two runs of the same place")
    if folder in (first, later):
        raise InputError("is one of the merged runs.", file=out, field="--out", hint=_ELSEWHERE)
    mount = next((path for path, _, _ in os.walk(folder) if os.path.ismount(path)), None)
    if mount is not None:
        raise InputError("is a mount point, which cannot be replaced.", file=mount, field="--out", hint=_ELSEWHERE)
    left = _earlier_of(folder)
    if left.exists():
        raise InputError("is left of a merge that was killed.", file=left, field="--out", hint="rename or delete it")
    found = earlier_run(folder)
    if found and not overwrite:
        hint = f"{_ELSEWHERE}, or give --overwrite to replace these files"
        raise InputError(f"holds a run already ({', '.join(found)}).", file=out, field="--out", hint=hint)


def earlier_run(out: str | Path) -> list[str]:
    """Return the names of the files and folders in ``out`` that a merge replaces or removes, sorted."""
    folder = Path(out)
    further = {path.name for path in folder.glob("trajectory-*.tum")}
    return sorted(further | {name for name in _OF_RUNS if os.path.lexists(folder / name)})


def draft_of(out: str | Path) -> Path:
    """Return the folder next to ``out`` in which a merge writes; one that a killed merge left there is replaced."""
    folder = Path(out).resolve()
    return folder.with_name(f".{folder.name}.draft")


def restore_run(out: str | Path) -> None:
    """Rename a folder back to ``out`` if a merge was killed after it renamed it, and before the merged run was there.

    Raises:
        OSError: it cannot be renamed.
    """
    folder = Path(out).resolve()
    earlier = _earlier_of(folder)
    if draft_of(out).exists() and earlier.exists() and not folder.exists():
        replace(earlier, folder)


def replace_run(draft: Path, out: str | Path) -> None:
    """Rename a finished run to ``out``. An earlier run there is removed; files of other commands stay, as scene.yaml.

    The draft first gets hard links to these files. ``out`` is then renamed, and the draft takes its name. A process
    that is killed between the two leaves an earlier folder for :func:`restore_run`. After an error, ``out`` is as it
    was, or the merged run.

    Raises:
        OSError: a file cannot be linked or copied, or a folder cannot be renamed.
    """
    folder = Path(out).resolve()
    if not folder.exists():
        replace(draft, folder)
        return
    replaced = earlier_run(folder)
    for path in folder.iterdir():
        if path.name not in replaced:
            _link_all(path, draft / path.name)
    sync_folder(draft)
    earlier = _earlier_of(folder)
    folder.rename(earlier)
    try:
        replace(draft, folder)
    finally:
        earlier.rename(draft if folder.exists() else folder)
    shutil.rmtree(draft, ignore_errors=True)


def _earlier_of(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.old")


def _link_all(path: Path, target: Path) -> None:
    """Link a file, or all files of a folder, under a further name."""
    if path.is_dir() and not path.is_symlink():
        shutil.copytree(path, target, symlinks=True, copy_function=_link)
    else:
        _link(path, target)


def _link(path: str | Path, target: str | Path) -> None:
    """Link a file under a further name; copy it on a file system without hard links."""
    try:
        os.link(path, target, follow_symlinks=False)
    except FileExistsError:
        raise
    except OSError:
        shutil.copy2(path, target, follow_symlinks=False)
