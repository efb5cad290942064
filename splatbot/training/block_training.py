"""Training of a scene in blocks: a process for each block, then the merge, the files and the scores of a training."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from math import ceil
from statistics import fmean
from typing import Any

import numpy as np

from splatbot.atomic import sweep_drafts
from splatbot.errors import FormatError, InputError
from splatbot.formats.ply import save_ply
from splatbot.gaussians import GaussianModel
from splatbot.training.blocks import SceneBlock, cut_scene, merged, start_of
from splatbot.training.datasets import TrainingData
from splatbot.training.folder import ProgressRow, TrainingFolder, TrainingSettings
from splatbot.training.helpers import Helper, check_helpers, started_helpers
from splatbot.training.images import ImageCache, check_memory, pixels
from splatbot.training.initialize import initial_model
from splatbot.training.scoring import score_held_out, summary
from splatbot.training.session import CONSTANTS, Pictures
from splatbot.trajectory import Trajectory

_POLL_S = 0.1
_LEAST_MINUTES = 0.01
_OF_ONE_BLOCK = {
    "refine_poses": "refine poses",
    "refine_intrinsics": "refine intrinsics",
    "exposure": "compensate exposures",
}
"""Options that a training in blocks refuses."""


class BlockTraining:
    """Trains the blocks of a scene, some at a time, and merges them.

    Each block is a training of its own in ``blocks/N`` of the folder, with its settings, start and checkpoint.

    Args:
        data: the dataset.
        folder: where the results go.
        settings: of the run.
        start: the Gaussians of the start; None for the points of the dataset, or random ones.
        resume: continue with the blocks of the folder, if it has any.

    Raises:
        InputError: the scene cannot be cut into these blocks, or an option estimates values of views.
    """

    def __init__(
        self,
        data: TrainingData,
        folder: TrainingFolder,
        settings: TrainingSettings,
        *,
        start: GaussianModel | None = None,
        resume: bool = False,
    ) -> None:
        for name, problem in _OF_ONE_BLOCK.items():
            if getattr(settings.options, name):
                hint = "leave one out; the values of a view would differ between its blocks"
                raise InputError(f"cannot {problem}.", field="--blocks", hint=hint)
        self.data = data
        self.folder = folder
        self.train, self.held_out = data.split(settings.held_out_every)
        self.settings = replace(settings, options=settings.options.capped(pixels(self.train)))
        if resume:
            sweep_drafts(folder.path)
        if not (resume and folder.blocks.exists()):
            self._cut(start, resume=resume)

    def _cut(self, start: GaussianModel | None, *, resume: bool) -> None:
        """Write the settings and the start of each block, all or none."""
        options = self.settings.options
        if start is None:
            assert options.max_gaussians is not None
            if not len(self.data.points):
                check_memory(self.data.folder, self.train)  # random points need the images
            start = initial_model(
                self.data,
                ImageCache(self.train),
                most=options.max_gaussians,
                seed=options.seed,
                surfels=options.surfels,
            )
        blocks = cut_scene(start.means.double().numpy(), self.train, self.settings.blocks)
        if not resume:
            self.folder.begin(self.settings)
        draft = self.folder.path / ".blocks.draft"
        for number, block in enumerate(blocks):
            part, of_block = TrainingFolder(draft / str(number)), start_of(start, block, self.train, options.seed)
            part.begin(self._settings_of(block, len(of_block) / len(start)))
            save_ply(of_block, part.start, bookkeeping=True)
        draft.rename(self.folder.blocks)

    def _settings_of(self, block: SceneBlock, share: float) -> TrainingSettings:
        """Return the settings of a block: steps by its share of the views, Gaussians by its share of the start."""
        options = self.settings.options
        if options.iterations is not None:
            iterations = ceil(options.iterations * len(block.views) / len(self.train))
            options = replace(options, iterations=iterations)
        if options.minutes is not None:
            options = replace(options, minutes=max(_LEAST_MINUTES, options.minutes / self.settings.blocks))
        if options.max_gaussians is not None:
            options = replace(options, max_gaussians=ceil(options.max_gaussians * share))
        return replace(self.settings, options=options, blocks=1, block=block)

    @property
    def _parts(self) -> list[TrainingFolder]:
        return [TrainingFolder(self.folder.blocks / str(number)) for number in range(self.settings.blocks)]

    def run(
        self,
        at_once: int = 1,
        *,
        checkpoint_s: float = 60.0,
        log: str | None = None,
        report: Callable[[str], None] = lambda line: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Train the blocks that are not finished, and return whether all are now.

        Args:
            at_once: number of blocks that are trained at the same time, each in its own process.
            checkpoint_s: time between two checkpoints of a block [s].
            log: where the recording of a run is now, if it was moved.
            report: receives a line when a block begins or ends.
            stop: called some times a second; the blocks in training are saved once it returns True.

        Raises:
            LostProcessError: the process of a block failed.
            InputError: an input of a block cannot be used, or the images of blocks at a time do not fit into memory.
        """
        more = ["--quiet", "--checkpoint-every", str(checkpoint_s), *(() if log is None else ("--log", log))]
        waiting = [part for part in self._parts if not _is_complete(part)]
        running: list[Helper] = []
        at_once = min(at_once, len(waiting))
        self._check_views(waiting, at_once, report)
        with started_helpers(max(1, at_once)) as start:
            while waiting or running:
                if stop():
                    for helper in running:
                        helper.process.terminate()
                    for helper in running:
                        helper.process.wait()
                    return False
                check_helpers(
                    running, f"`splatbot train --resume {self.folder.path}` continues with the unfinished blocks"
                )
                for helper in [helper for helper in running if helper.process.poll() == 0]:
                    running.remove(helper)
                    report(f"{helper.name} is trained")
                while waiting and len(running) < at_once:
                    part = waiting.pop(0)
                    name = f"block {int(part.path.name) + 1} of {self.settings.blocks}"
                    words = ["train", str(self.settings.dataset), "--resume", str(part.path), *more]
                    report(f"{name} begins")
                    running.append(start(name, words, part.path / "train.log", {}))
                time.sleep(_POLL_S)
        return True

    def _check_views(self, waiting: list[TrainingFolder], at_once: int, report: Callable[[str], None]) -> None:
        """Check the memory of the largest blocks that can train at the same time, and report views that train none."""
        names = {part.path: set(_block_of(part).views) for part in self._parts}
        missing = {view.name for view in self.train}.difference(*names.values())
        if missing:
            report(f"{len(missing)} of {len(self.train)} views see no point of the start, and train no block")
        held = [[view for view in self.train if view.name in names[part.path]] for part in waiting]
        check_memory(self.data.folder, *sorted(held, key=pixels, reverse=True)[:at_once])

    def merge(self) -> GaussianModel:
        """Return the map of all blocks, and save it with the poses of its images."""
        keeps_rows = self.settings.options.strategy == "fixed"
        parts = [(_block_of(part), part.map, part.start if keeps_rows else None) for part in self._parts]
        model = merged(parts)
        poses = np.stack([view.T_world_camera for view in self.train])
        self.folder.save_map(model, Trajectory(np.arange(float(len(poses))), poses))
        return model

    def score(
        self,
        model: GaussianModel,
        pictures: Pictures = lambda rows, scores: {},
        report: Callable[[str], None] = lambda line: None,
    ) -> dict[str, Any]:
        """Score all held-out views of the merged map; write the scores and the pictures; return the scores."""
        report("scoring")
        options, shown = self.settings.options, CONSTANTS.shown_views
        scores = score_held_out(model, ImageCache(self.held_out), options, self.data.scene_extent, shown=shown)
        result = summary(scores)
        parts = [json.loads(part.scores.read_text()) for part in self._parts]
        rows = [json.loads(part.progress.read_text().splitlines()[-1]) for part in self._parts]
        result |= {
            "iterations": sum(part["iterations"] for part in parts),
            "seconds": round(sum(part["seconds"] for part in parts), 1),
            "gaussians": len(model),
            "sh_degree": model.sh_degree,
            "complete": True,
        }
        loss = fmean(row["loss"] for row in rows)
        row = ProgressRow(result["iterations"], result["seconds"], loss, result["psnr_db"], len(model))
        self.folder.save_scores([row], result, pictures([row], scores))
        return result


def _block_of(part: TrainingFolder) -> SceneBlock:
    block = part.load_settings().block
    if block is None:
        raise FormatError(
            "is no block of a scene.", file=part.settings, field="block", hint="train again (--overwrite)"
        )
    return block


def _is_complete(part: TrainingFolder) -> bool:
    return part.scores.exists() and bool(json.loads(part.scores.read_text())["complete"])
