"""The recorded views of a map that a command names."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from splatbot.layouts import TRAINING_NAME

if TYPE_CHECKING:
    from splatbot.training.map_views import MapViews


def recorded_views(path: Path, log: str | None = None) -> MapViews | None:
    """Open the views of a run or a training, or of the one whose folder holds a map file; None without any.

    Args:
        path: a folder, or a map file in it.
        log: where the recording of a run is now, if it was moved.

    Raises:
        SplatbotError: the recording is missing or damaged.
    """
    from splatbot.cli.datasets import open_training_data
    from splatbot.results.folder import RunFolder
    from splatbot.training.folder import TrainingFolder
    from splatbot.training.intrinsics import with_refined
    from splatbot.training.map_views import MapViews
    from splatbot.training.options import USUAL, TrainingOptions

    folder = path if path.is_dir() else path.parent
    if (folder / TRAINING_NAME).is_file():
        settings = TrainingFolder(folder).load_settings()
        cameras = TrainingFolder(folder).load_cameras()
        data = open_training_data(settings.dataset, settings.scale, log)
        every, options = settings.held_out_every, settings.options
    elif (folder / "metrics.json").is_file():
        data = open_training_data(folder, 1, log)
        cameras = []
        every, options = (8 if data.held_out_names else 0), TrainingOptions(**USUAL["run"])
    else:
        return None
    mapped, held_out = (with_refined(part, cameras) for part in data.split(every))
    recording = str(data.folder.resolve())
    if data.kind == "run":
        recording = str(RunFolder(data.folder).load_metrics()["log"]["uri"])
    return MapViews(data, mapped, held_out, options, recording)
