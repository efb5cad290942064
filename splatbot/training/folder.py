"""The folder of a training run: settings, checkpoint, map, scores and the course of the training."""

from __future__ import annotations

import io
import json
import pickle
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from splatbot.atomic import atomic_write, replace_files, sweep_drafts, write_bytes, write_text
from splatbot.errors import CameraError, FormatError, InputError
from splatbot.formats.ply import save_ply
from splatbot.gaussians import GaussianModel
from splatbot.layouts import MAP_NAME, TRAINING_NAME
from splatbot.results.metrics import without_nan
from splatbot.training.blocks import Cut, SceneBlock
from splatbot.training.intrinsics import RefinedCamera
from splatbot.training.options import TrainingOptions
from splatbot.trajectory import Trajectory

_FORMAT = 1
_PICTURES = ("course.png", "held_out.jpg")
_HINT = "give a folder that `splatbot train` wrote"


@dataclass(frozen=True)
class TrainingSettings:
    """Dataset and options of a training run; ``--resume`` needs nothing else.

    Args:
        dataset: folder of the images, absolute.
        scale: the images are 1/``scale`` of their size.
        held_out_every: see :meth:`TrainingData.split`.
        options: of the trainer.
        blocks: number of blocks that are trained apart.
        block: the block of a training that is one of them.
    """

    dataset: Path
    scale: int
    held_out_every: int
    options: TrainingOptions
    blocks: int = 1
    block: SceneBlock | None = None


@dataclass(frozen=True)
class ProgressRow:
    """One line of ``progress.jsonl``.

    Args:
        iteration: iterations done.
        seconds: time of training [s], without evaluations.
        loss: mean loss since the last row.
        psnr_db: mean over at most eight held-out views, the same in each row [dB]; None if they were not scored.
        gaussians: number of Gaussians.
    """

    iteration: int
    seconds: float
    loss: float
    psnr_db: float | None
    gaussians: int


class TrainingFolder:
    """Paths of a training run's files, with reading and writing. Every file is replaced atomically."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.settings = self.path / TRAINING_NAME
        self.checkpoint = self.path / "checkpoint.pt"
        self.map = self.path / MAP_NAME
        self.trajectory = self.path / "trajectory.tum"
        self.cameras = self.path / "cameras.json"
        self.exposures = self.path / "exposures.json"
        self.progress = self.path / "progress.jsonl"
        self.scores = self.path / "scores.json"
        self.start = self.path / "start.ply"  # of a block
        self.blocks = self.path / "blocks"

    def begin(self, settings: TrainingSettings) -> None:
        """Create the folder for a new training; all files of an earlier one are removed.

        Raises:
            InputError: the folder cannot be written.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            sweep_drafts(self.path)
            pictures = [self.path / name for name in _PICTURES]
            estimates = self.trajectory, self.cameras, self.exposures
            for file in (self.scores, self.checkpoint, self.map, *estimates, self.progress, *pictures):
                file.unlink(missing_ok=True)
            if self.blocks.exists():
                shutil.rmtree(self.blocks)
            self.save_settings(settings)
        except OSError as error:
            hint = "name another folder"
            raise InputError(
                f"cannot be written ({error.strerror}).", file=self.path, field="--out", hint=hint
            ) from error

    def save_settings(self, settings: TrainingSettings) -> None:
        """Write ``training.json``."""
        values = {"format": _FORMAT} | asdict(settings) | {"dataset": str(settings.dataset)}
        with atomic_write(self.settings) as file:
            file.write(json.dumps(values, indent=2).encode())

    def load_settings(self) -> TrainingSettings:
        """Read ``training.json``.

        Raises:
            FormatError: it is missing or damaged.
        """
        try:
            values = json.loads(self.settings.read_text())
            if values["format"] != _FORMAT:
                raise FormatError(
                    f"is {values['format']!r}.", file=self.settings, field="format", hint="use a matching version"
                )
            options = TrainingOptions(**values["options"])
            block = values.get("block")
            if block is not None:
                cuts = tuple(Cut(**cut) for cut in block["cuts"])
                block = SceneBlock(cuts, float(block["margin"]), tuple(block["views"]))
            dataset, scale, every = Path(values["dataset"]), int(values["scale"]), int(values["held_out_every"])
            return TrainingSettings(dataset, scale, every, options, int(values.get("blocks", 1)), block)
        except OSError as error:
            raise FormatError(f"cannot be read ({error.strerror}).", file=self.settings, hint=_HINT) from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise FormatError(f"is damaged ({error}).", file=self.settings, hint=_HINT) from error

    def save_checkpoint(self, state: Mapping[str, Any]) -> None:
        """Write all that the next iterations depend on."""
        buffer = io.BytesIO()
        torch.save(dict(state), buffer)
        with atomic_write(self.checkpoint) as file:
            file.write(buffer.getbuffer())

    def load_checkpoint(self) -> dict[str, Any]:
        """Read the checkpoint; only tensors and plain values are read, no code.

        Raises:
            FormatError: it is missing or damaged.
        """
        try:
            state = torch.load(self.checkpoint, map_location="cpu", weights_only=True)
        except OSError as error:
            why = "the run ended before its first checkpoint" if self.settings.is_file() else error.strerror
            hint = f"train again: splatbot train DATASET --out {self.path} --overwrite"
            raise FormatError(f"cannot be read ({why}).", file=self.checkpoint, hint=hint) from error
        except (RuntimeError, pickle.UnpicklingError, ValueError, EOFError, KeyError) as error:
            hint = f"train again: splatbot train DATASET --out {self.path} --overwrite"
            raise FormatError("is damaged.", file=self.checkpoint, field="checkpoint", hint=hint) from error
        if not isinstance(state, dict) or "iteration" not in state:
            raise FormatError("is no checkpoint of a training.", file=self.checkpoint, hint=_HINT)
        return state

    def save_map(
        self,
        model: GaussianModel,
        trajectory: Trajectory,
        cameras: Sequence[RefinedCamera] = (),
        exposures: Mapping[str, Sequence[Sequence[float]]] | None = None,
    ) -> None:
        """Write the map, the poses of its images, refined cameras, and transforms (3, 4) of exposures by image."""
        writers: dict[str, Callable[[Path], None]] = {
            self.map.name: lambda path: save_ply(model, path, bookkeeping=True),
            self.trajectory.name: trajectory.save,
        }
        if cameras:
            values = {"format": _FORMAT, "cameras": [camera.to_json() for camera in cameras]}
            writers[self.cameras.name] = write_text(json.dumps(values, indent=2))
        if exposures is not None:
            writers[self.exposures.name] = write_text(json.dumps(dict(exposures), indent=2))
        replace_files(self.path, writers, remove=(self.scores.name,))

    def load_cameras(self) -> list[RefinedCamera]:
        """Read the refined cameras; empty if the training did not refine them.

        Raises:
            FormatError: the file is damaged.
        """
        if not self.cameras.exists():
            return []
        try:
            rows = json.loads(self.cameras.read_text())["cameras"]
            return [RefinedCamera.from_json(row) for row in rows]
        except (OSError, ValueError, KeyError, TypeError, CameraError) as error:
            hint = f"write it again: splatbot train --resume {self.path}"
            raise FormatError(f"is damaged ({error}).", file=self.cameras, field="cameras", hint=hint) from error

    def save_scores(
        self, rows: Sequence[ProgressRow], scores: Mapping[str, Any], pictures: Mapping[str, bytes]
    ) -> None:
        """Write the course of the training, the scores, and pictures by name."""
        lines = "".join(json.dumps(without_nan(asdict(row)), allow_nan=False) + "\n" for row in rows)
        writers = {
            self.progress.name: write_text(lines),
            self.scores.name: write_text(json.dumps(dict(scores), indent=2, allow_nan=False)),
        }
        replace_files(self.path, writers | {name: write_bytes(data) for name, data in pictures.items()})

    def check_free(self, *, overwrite: bool) -> None:
        """Check that the folder holds no run, and no other training unless that may be replaced.

        Raises:
            InputError: it does.
        """
        if not self.settings.exists() and any((self.path / name).exists() for name in (MAP_NAME, "metrics.json")):
            hint = "name another folder; `splatbot train RUN` without --out improves the map of a run"
            raise InputError("holds a map already.", file=self.path, field="--out", hint=hint)
        if self.settings.exists() and not overwrite:
            hint = f"continue it (--resume {self.path}), replace it (--overwrite), or name another folder"
            raise InputError("holds a training already.", file=self.path, field="--out", hint=hint)
