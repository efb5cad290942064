"""A whole training: from a dataset to a folder, with checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np

from splatbot.atomic import sweep_drafts
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.training.datasets import TrainingData
from splatbot.training.distributed import ALONE, TrainingGroup, check_same, numerics
from splatbot.training.folder import ProgressRow, TrainingFolder, TrainingSettings
from splatbot.training.images import ImageCache, check_memory, pixels
from splatbot.training.initialize import initial_model
from splatbot.training.intrinsics import RefinedCamera, with_refined
from splatbot.training.options import TrainingOptions
from splatbot.training.scoring import HeldOutScore, score_held_out, summary
from splatbot.training.trainer import Trainer
from splatbot.trajectory import Trajectory

Pictures = Callable[[list[ProgressRow], list[HeldOutScore]], dict[str, bytes]]
"""Draws pictures of a training by file name: a function of a higher layer."""

StepObserver = Callable[[float], None]
"""Receives the loss of each step, after it. It may look at the session, and changes nothing that a step depends on."""


@dataclass(frozen=True)
class SessionConstants:
    """Constants of a training session.

    Args:
        scored_times: number of times that the held-out views are scored in the course of a run.
        scored_views: most views of each such time; at the end all are scored.
        shown_views: number of held-out views in the pictures.
        report_s: [s] time between two reports of progress.
    """

    scored_times: int = 10
    scored_views: int = 8
    shown_views: int = 4
    report_s: float = 0.25


CONSTANTS = SessionConstants()


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of a training.

    Args:
        row: the latest values.
        share: of the run that is done, 0 to 1.
        remaining_s: estimated rest of the run [s].
        doing: "training", "saving", or "scoring" with its progress.
    """

    row: ProgressRow
    share: float
    remaining_s: float
    doing: str


class TrainingSession:
    """Trains until an end of the options, or until ``stop`` returns True; saves, and scores.

    Args:
        data: the dataset.
        folder: where the results and checkpoints go.
        settings: of the run.
        start: the Gaussians of the start; None for the points of the dataset, or random ones.
        checkpoint_s: time between two checkpoints [s].
        resume: continue from the checkpoint of the folder; without one, the training begins again.
        group: the processes that train together; the first one's start, checkpoint, time and folder count.

    Raises:
        FormatError: the checkpoint is damaged.
        LostProcessError: another process of the group is gone.
        InputError: the images do not fit into memory, or are not those of the checkpoint or of the first process. Its
            options, software and vector instructions count too.
    """

    def __init__(
        self,
        data: TrainingData,
        folder: TrainingFolder,
        settings: TrainingSettings,
        *,
        start: GaussianModel | None = None,
        checkpoint_s: float = 60.0,
        resume: bool = False,
        group: TrainingGroup = ALONE,
    ) -> None:
        self.folder = folder
        self.group = group
        if resume and group.leads:
            sweep_drafts(folder.path)
        train, held_out = data.split(settings.held_out_every)
        if settings.block is not None:
            train, held_out = tuple(view for view in train if view.name in settings.block.views), ()
        check_memory(data.folder, *[train + held_out, *[train] * (group.local - 1)][: group.local])
        self.options: TrainingOptions = settings.options.capped(pixels(train))
        self.images, self.held_out = ImageCache(train), ImageCache(held_out)
        saved = folder.load_checkpoint() if group.leads and resume and folder.checkpoint.exists() else None
        if saved is not None:
            self._check_views(saved["views"], data)
            start = GaussianModel(**saved["trainer"]["model"])
        elif not group.leads:
            start = GaussianModel.empty()  # until that of the first process arrives
        elif start is None:
            o = self.options
            assert o.max_gaussians is not None
            start = initial_model(data, self.images, most=o.max_gaussians, seed=o.seed, surfels=o.surfels)
        self.trainer = Trainer(start, self.images, self.options, data.scene_extent, group)
        self.seconds = 0.0
        self.rows: list[ProgressRow] = []
        self._checkpoint_s = checkpoint_s
        self._losses: list[float] = []
        if saved is not None:
            self._restore(saved)
        if group.size > 1:
            first = group.broadcast(self._state() | {"setup": self._setup()})
            self._check_views(first["views"], data)
            check_same(self._setup(), first["setup"])
            self._restore(first)

    def _check_views(self, views: list[str], data: TrainingData) -> None:
        if views != self._views():
            hint = "restore the images, or give their place: splatbot train --resume RUN DATASET"
            raise InputError("has other images than at the start.", file=data.folder, field="--resume", hint=hint)

    def _state(self) -> dict[str, Any]:
        """Return all that the rest of the run depends on."""
        return {
            "iteration": self.trainer.iteration,
            "trainer": self.trainer.state(),
            "views": self._views(),
            "seconds": self.seconds,
            "rows": [vars(row) for row in self.rows],
            "losses": self._losses,
        }

    def _setup(self) -> dict[str, Any]:
        """Return the values that must be the same in all processes of the group."""
        return {**vars(self.options), "scene extent": self.trainer.extent, **numerics()}

    def _restore(self, state: dict[str, Any]) -> None:
        """Go back to a :meth:`_state`."""
        self.trainer.restore(state["trainer"])
        self.seconds, self._losses = state["seconds"], state["losses"]
        self.rows = [ProgressRow(**row) for row in state["rows"]]

    def _views(self) -> list[str]:
        """Return name and size of each training view."""
        return [f"{view.name} {view.camera.width}x{view.camera.height}" for view in self.images.views]

    @property
    def share(self) -> float:
        """Return the share of the run that is done, 0 to 1."""
        done = self.trainer.iteration / self.options.iterations if self.options.iterations else 0.0
        clock = self.seconds / (60 * self.options.minutes) if self.options.minutes else 0.0
        return min(1.0, max(done, clock))

    @property
    def remaining_s(self) -> float:
        """Return the estimated rest of the run [s]; 0 before the first step."""
        share = self.share
        return self.seconds * (1 - share) / share if share > 0 else 0.0

    def run(
        self,
        *,
        report: Callable[[TrainingProgress], None] = lambda progress: None,
        stop: Callable[[], bool] = lambda: False,
        observe: StepObserver = lambda loss: None,
    ) -> None:
        """Train, and save the checkpoint and the map; of a group, the first process saves, scores and reports.

        Args:
            report: receives the progress some times a second.
            stop: called before each iteration; training ends once it returns True, and can be resumed.
            observe: called by the first process after each step; its time is not time of training.

        Raises:
            LostProcessError: another process of the group is gone.
        """
        saved = reported = time.monotonic()
        while not self._ended(stop()):
            began = time.perf_counter()
            loss = self.trainer.step(self.share)
            self._losses.append(loss)
            self.seconds += time.perf_counter() - began
            if not self.group.leads:
                continue
            observe(loss)
            if self.share >= (len(self.rows) + 1) / CONSTANTS.scored_times and self.share < 1.0:
                report(self._progress("scoring"))
                self._note(self._some_psnr())
            now = time.monotonic()
            if now - reported > CONSTANTS.report_s:
                reported = now
                report(self._progress("training"))
            if now - saved > self._checkpoint_s:
                report(self._progress("saving"))
                self.save_checkpoint()
                saved = time.monotonic()
        if self.group.leads:
            self.save_checkpoint()
            self.save_map()

    def _ended(self, stop: bool) -> bool:
        """Return whether the run ends here; all processes of the group return the same."""
        self.seconds, stop = self.group.agree(self.seconds, stop)
        return stop or self.share >= 1.0

    def save_checkpoint(self) -> None:
        """Write the state of the run to the folder."""
        self.folder.save_checkpoint(self._state())

    def save_map(self) -> None:
        """Write the map, the poses of its images, and their cameras and exposures if those were estimated."""
        trainer = self.trainer
        poses = trainer.poses.poses()
        exposures = None
        if trainer.exposures is not None:
            names = [view.name for view in self.images.views]
            exposures = dict(zip(names, trainer.exposures.transforms.tolist(), strict=True))
        trajectory = Trajectory(np.arange(float(len(poses))), poses)
        self.folder.save_map(trainer.model, trajectory, self._cameras(), exposures)

    def _cameras(self) -> list[RefinedCamera]:
        """Return the cameras with their intrinsics as refined so far; empty if they are not refined."""
        return [] if self.trainer.intrinsics is None else self.trainer.intrinsics.cameras()

    def _held_out_now(self) -> ImageCache:
        """Return the held-out images with the intrinsics of their cameras as refined so far."""
        return self.held_out.with_views(with_refined(self.held_out.views, self._cameras()))

    def score(
        self, pictures: Pictures = lambda rows, scores: {}, report: Callable[[TrainingProgress], None] = lambda _: None
    ) -> dict[str, Any]:
        """Score all held-out views; write the scores and the pictures; return the scores."""
        scores = score_held_out(
            self.trainer.model,
            self._held_out_now(),
            self.options,
            self.trainer.extent,
            shown=CONSTANTS.shown_views,
            report=lambda done: report(self._progress(f"scoring {done + 1}/{len(self.held_out.views)}")),
        )
        model, result = self.trainer.model, summary(scores)
        some = scores[:: self._scored_every]
        rows = [*self.rows, self._row(fmean(score.psnr_db for score in some) if some else None)]
        result |= {
            "iterations": self.trainer.iteration,
            "seconds": round(self.seconds, 1),
            "gaussians": len(model),
            "sh_degree": model.sh_degree,
            "complete": self.share >= 1.0,
        }
        self.folder.save_scores(rows, result, pictures(rows, scores))
        return result

    @property
    def _scored_every(self) -> int:
        """Return the distance of the views that are scored in the course of the run."""
        return max(1, -(-len(self.held_out.views) // CONSTANTS.scored_views))

    def _some_psnr(self) -> float | None:
        """Return the mean PSNR of some held-out views; None with refined poses, whose alignment takes long."""
        if not self.held_out.views or self.options.refine_poses:
            return None
        scores = score_held_out(
            self.trainer.model,
            self._held_out_now(),
            self.options,
            self.trainer.extent,
            every=self._scored_every,
            psnr_only=True,
        )
        return fmean(score.psnr_db for score in scores) if scores else None

    def _note(self, psnr_db: float | None) -> None:
        self.rows.append(self._row(psnr_db))
        self._losses = []

    def _row(self, psnr_db: float | None) -> ProgressRow:
        loss = fmean(self._losses) if self._losses else (self.rows[-1].loss if self.rows else 0.0)
        model = self.trainer.model
        return ProgressRow(self.trainer.iteration, round(self.seconds, 2), loss, psnr_db, len(model))

    def _progress(self, doing: str) -> TrainingProgress:
        psnr_db = next((row.psnr_db for row in reversed(self.rows) if row.psnr_db is not None), None)
        return TrainingProgress(self._row(psnr_db), self.share, self.remaining_s, doing)
