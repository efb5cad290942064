"""Datasets of `splatbot train` and `splatbot eval`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from splatbot.errors import InputError
from splatbot.layouts import dataset_kind

if TYPE_CHECKING:
    from splatbot.training.datasets import TrainingData


def open_training_data(folder: Path, scale: int, log: str | None = None) -> TrainingData:
    """Open the photographs of a dataset, or the frames of a run with its robot masked.

    Args:
        folder: the dataset, or the folder of a run.
        scale: the images are reduced to 1/``scale`` of their size.
        log: present location of the log of a run, if it was moved.

    Raises:
        SplatbotError: it is no dataset, or damaged; or a log is given without a run.
    """
    from splatbot.results.folder import RunFolder
    from splatbot.robots.in_view import reopen_log
    from splatbot.training.datasets import open_dataset

    if dataset_kind(folder) == "run":
        return open_dataset(folder, scale=scale, log=reopen_log(RunFolder(folder), uri=log))
    if log is not None:
        raise InputError("is for a run.", field="--log", hint="leave it out")
    return open_dataset(folder, scale=scale)
