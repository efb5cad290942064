"""Poses of photographs by COLMAP (Schoenberger and Frahm 2016): the program, or else pycolmap."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

from splatbot.errors import InputError, LogError
from splatbot.formats.colmap import read_images
from splatbot.training.datasets import colmap_steps
from splatbot.training.datasets.images import photo_size

LOG_NAME = "colmap.log"

_OVERLAP = "take more photographs, each of which shares most of its view with its neighbours"

Matching = Literal["exhaustive", "sequential"]


class Posed(NamedTuple):
    """Result of COLMAP: numbers of photographs with a pose, and of models that do not connect."""

    photographs: int
    models: int


def find_colmap() -> list[str]:
    """Return the beginning of a command line for the steps of COLMAP.

    Raises:
        InputError: neither `colmap` nor pycolmap is installed.
    """
    program = shutil.which("colmap")
    if program is not None:
        return [program]
    if importlib.util.find_spec("pycolmap") is not None:
        return [sys.executable, "-P", str(colmap_steps.__file__)]
    hint = "pip install 'splatbot[colmap]', or install the program (https://colmap.github.io/install.html)"
    raise InputError("is not installed.", field="colmap", hint=hint)


def pose_photographs(
    colmap: list[str], scene: Path, names: list[str], matching: Matching, report: Callable[[str, float], None]
) -> Posed:
    """Write the sparse model of `images/` of a scene into `sparse/0`, and the output of COLMAP into `colmap.log`.

    Photographs of one size share a camera. If several models do not connect, the one with most photographs stays.

    Args:
        colmap: beginning of the command line, of :func:`find_colmap`.
        scene: folder with `images/`.
        names: of the photographs.
        matching: whether all pairs of photographs are compared, or those that are near in order.
        report: is called with the name of the step and the finished share of all steps.

    Raises:
        LogError: COLMAP fails, or finds no poses.
    """
    images, models, database = scene / "images", scene / "sparse", scene / "database.db"
    models.mkdir()
    one_camera = len({photo_size(images / name) for name in names}) == 1
    source, camera = ["--image_path", str(images)], ["--ImageReader.single_camera", str(int(one_camera))]
    steps = {
        "feature_extractor": [*source, *camera],
        f"{matching}_matcher": [],
        "mapper": [*source, "--output_path", str(models)],
    }
    for index, (step, options) in enumerate(steps.items()):
        report(f"COLMAP {step}", index / len(steps))
        _run([*colmap, step, "--database_path", str(database), *options], scene / LOG_NAME, step)
    database.unlink(missing_ok=True)
    files = [file for suffix in (".bin", ".txt") for file in models.glob(f"*/images{suffix}")]
    found = {file.parent: len(read_images(file)) for file in files}
    if not found:
        raise LogError("finds no poses.", field="colmap", hint=_OVERLAP)
    best = max(sorted(found), key=lambda model: found[model])
    for other in {place for place in models.iterdir() if place.is_dir()} - {best}:
        shutil.rmtree(other)
    best.rename(models / "0")
    return Posed(found[best], len(found))


def _run(words: list[str], log: Path, step: str) -> None:
    with (
        log.open("ab") as output,
        subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        ) as process,
    ):
        try:
            code = process.wait()
        except BaseException:  # of Ctrl-C
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # `colmap` may be a script that starts the program
            process.wait()
            raise
    if code:
        last = log.read_text(errors="replace").strip().rpartition("\n")[2][-300:]
        problem = f"ends with {code} in the step {step}: {last}" if last else f"ends with {code} in the step {step}"
        hint = _OVERLAP if step == "mapper" else "check the installation of COLMAP (`colmap` on the PATH, or pycolmap)"
        raise LogError(f"{problem}.", field="colmap", hint=hint)
