"""Posed photographs for offline training: COLMAP, Blender and Nerfstudio scenes, and folders of runs."""

from __future__ import annotations

from pathlib import Path

from splatbot.errors import InputError
from splatbot.layouts import dataset_kind
from splatbot.logs import Log
from splatbot.training.datasets.base import TrainingData, TrainingView
from splatbot.training.datasets.colmap import colmap_dataset
from splatbot.training.datasets.run import open_run_log, run_dataset
from splatbot.training.datasets.transforms import blender_dataset, nerfstudio_dataset

__all__ = ["TrainingData", "TrainingView", "open_dataset"]


def open_dataset(folder: Path, *, scale: int = 1, log: Log | None = None) -> TrainingData:
    """Open posed photographs; the images are decoded only when a view is read.

    Args:
        folder: a COLMAP scene (`sparse/0` and `images`), a Blender scene (`transforms_train.json`), a Nerfstudio or
            instant-ngp scene (`transforms.json`), or a folder that `splatbot map` wrote.
        scale: factor by which width and height of the images are reduced.
        log: the log of a run, already opened. If None, the log that the run names is opened.

    Raises:
        InputError: the folder is of no known kind, the scale is below 1, or a log is given without a run.
        FormatError: a file of the dataset is damaged.
        LogError: an image is missing or damaged, or the log of a run cannot be opened.
    """
    if scale < 1:
        raise InputError(f"is {scale}.", field="scale", hint="give 1 for full size, or 2, 4, 8")
    kind = dataset_kind(folder)
    if log is not None and kind != "run":
        raise InputError(f"is given with a {kind} scene.", file=folder, field="log", hint="give a log with a run only")
    if kind == "run":
        return run_dataset(folder, log if log is not None else open_run_log(folder), scale)
    openers = {"colmap": colmap_dataset, "blender": blender_dataset, "nerfstudio": nerfstudio_dataset}
    return openers[kind](folder, scale)
