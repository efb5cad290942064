"""`splatbot prepare`."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

import tyro

from splatbot.cli.paths import check_new, check_output
from splatbot.errors import InputError
from splatbot.layouts import COLMAP_DEPTH, colmap_model

_WRITTEN = ("images", "sparse", "colmap.log")
_REPLACED = (*_WRITTEN, "images_[0-9]*")  # the latter are smaller copies of earlier photographs


def prepare(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="VIDEO|IMAGES")],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    matching: Literal["auto", "exhaustive", "sequential"] = "auto",
    overwrite: bool = False,
    quiet: bool = False,
) -> int:
    """Estimate the poses of photographs or of a video by COLMAP, for `splatbot train`.

    The program `colmap` runs if it is installed, else pycolmap (pip install 'splatbot[colmap]'). DIR becomes a COLMAP
    scene: images/, sparse/0 and the output of COLMAP, colmap.log. Its unit of length is unknown, as of every scene from
    photographs alone. Photographs of one size share a camera. Ctrl-C leaves nothing.

    Examples:
        splatbot prepare garden.mp4 --out scenes/garden
        splatbot train scenes/garden --minutes 10
        splatbot prepare photographs --out scenes/shelf
        splatbot prepare walk.mov --frames 300 --out scenes/walk

    Args:
        source: a video, or a folder with .jpg and .png files.
        out: folder to write.
        frames: take the sharpest image of each of N equal intervals; by default 150 for a video, and all images of a
            folder.
        matching: compare all pairs of photographs, or those that are near in order. Auto is sequential for a video and
            exhaustive for a folder.
        overwrite: replace the scene in DIR.
        quiet: no progress and no summary, only errors.
    """
    if not source.exists():
        raise InputError("does not exist.", file=source, field="VIDEO|IMAGES", hint="check the path")
    check_output(out)
    _check_replaceable(source, out, overwrite=overwrite)

    from splatbot.cli.progress import shares
    from splatbot.run.interrupts import Interrupts
    from splatbot.training.datasets.colmap import colmap_dataset
    from splatbot.training.datasets.photographs import MAX_PHOTOGRAPHS, MIN_PHOTOGRAPHS, collect_photographs
    from splatbot.training.datasets.posing import find_colmap, pose_photographs

    if frames is not None and not MIN_PHOTOGRAPHS <= frames <= MAX_PHOTOGRAPHS:
        hint = f"give {MIN_PHOTOGRAPHS} to {MAX_PHOTOGRAPHS:,}"
        raise InputError(f"is {frames:,}.", field="--frames", hint=hint)
    colmap = find_colmap()
    if matching == "auto":
        matching = "exhaustive" if source.is_dir() else "sequential"
    home = out.resolve()
    home.parent.mkdir(parents=True, exist_ok=True)
    disk = home if home.exists() else home.parent  # so that the scene moves within one file system
    with (
        Interrupts() as interrupts,
        _hangup_as_termination(),
        shares(quiet) as on_share,
        TemporaryDirectory(prefix=f".{home.name}.", suffix=".draft", dir=disk) as draft,
    ):
        scene = Path(draft)
        with interrupts.interruptible():
            (scene / "images").mkdir()
            names = collect_photographs(source, scene / "images", frames, on_share)
            posed = pose_photographs(colmap, scene, names, matching, on_share)
            colmap_dataset(scene)  # opens as `splatbot train` opens it
        _replace(scene, home)
    if not quiet:
        print(f"{out}: poses of {posed.photographs} of {len(names)} photographs; next: splatbot train {out}")
    if posed.models > 1:
        print(f"{posed.models - 1} more models do not connect to it and were left out", file=sys.stderr)
    return 0


def _check_replaceable(source: Path, out: Path, *, overwrite: bool) -> None:
    """Refuse to write over the input, and over a folder that is no scene.

    Raises:
        InputError: the folder may not be replaced.
    """
    check_new(out, overwrite=overwrite)
    if out.resolve() in (source.resolve(), *source.resolve().parents):
        raise InputError("holds the input.", file=out, field="--out", hint="name another folder")
    if not out.exists():
        return
    if any(out.iterdir()) and colmap_model(out) is None:
        raise InputError("is no COLMAP scene.", file=out, field="--out", hint="name another folder, or empty it")
    depth = next((out / name for name in COLMAP_DEPTH if os.path.lexists(out / name)), None)
    if depth is not None:
        hint = "name another folder, or move it away: it belongs to the earlier photographs"
        raise InputError("is in the scene to replace.", file=depth, field="--out", hint=hint)
    mounted = next((place for place in _replaced(out) if place.lstat().st_dev != out.stat().st_dev), None)
    if mounted is not None:
        raise InputError("is on another disk.", file=mounted, field="--out", hint="unmount it, or name another folder")


def _replaced(out: Path) -> list[Path]:
    return [place for place in out.iterdir() if any(fnmatchcase(place.name, pattern) for pattern in _REPLACED)]


def _replace(scene: Path, out: Path) -> None:
    """Move a new scene from its draft, and the earlier one into the draft, with which it goes; an error restores it."""
    earlier = scene / "earlier"
    earlier.mkdir()
    out.mkdir(exist_ok=True)
    moves = [(place, earlier / place.name) for place in _replaced(out)]
    moves += [(scene / name, out / name) for name in _WRITTEN]
    with ExitStack() as undo:
        for source, target in moves:
            source.rename(target)
            undo.callback(target.rename, source)
        undo.pop_all()


@contextmanager
def _hangup_as_termination() -> Iterator[None]:
    """Handle SIGHUP, the end of the terminal, as SIGTERM, unless it is ignored (nohup)."""
    previous = signal.getsignal(signal.SIGHUP)
    if previous is signal.SIG_IGN or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGHUP, signal.getsignal(signal.SIGTERM))
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, previous)
