"""Kinds of datasets, recognized by the names of their files."""

from __future__ import annotations

from pathlib import Path

from splatbot.errors import InputError
from splatbot.layouts import colmap_model
from splatbot.training.datasets.base import DatasetKind

_RUN_FILES = ("map.ply", "trajectory.tum", "config.yaml")
_EXPECTED = (
    "give a folder with sparse/0/{cameras,images,points3D}.bin or .txt (COLMAP), transforms_train.json (Blender), "
    "transforms.json (Nerfstudio, instant-ngp), or one that `splatbot map` wrote"
)


def dataset_kind(folder: Path) -> DatasetKind:
    """Return the kind of a dataset.

    Raises:
        InputError: the folder does not exist or is of no known kind.
    """
    if not folder.is_dir():
        problem = "is no folder" if folder.exists() else "does not exist"
        raise InputError(f"{problem}.", file=folder, field="dataset", hint=_EXPECTED)
    if colmap_model(folder) is not None:
        return "colmap"
    if (folder / "transforms_train.json").is_file():
        return "blender"
    if (folder / "transforms.json").is_file():
        return "nerfstudio"
    if all((folder / name).is_file() for name in _RUN_FILES):
        return "run"
    raise InputError("holds no dataset of a known kind.", file=folder, field="dataset", hint=_EXPECTED)
