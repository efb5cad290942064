"""Outcome of a run after its last frame: files, scores and report."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot import __version__
from splatbot.calibration.timing import SensorTiming
from splatbot.errors import SplatbotError
from splatbot.gaussians import GaussianModel
from splatbot.results.audit import RunAudit, audit_metrics, audit_run
from splatbot.results.cameras import camera_metrics
from splatbot.results.folder import FrameRow, RunFolder
from splatbot.results.metrics import without_nan
from splatbot.results.scoring import TrajectoryScore, ViewScores, score_views, trajectory_metrics
from splatbot.run.interrupts import Interrupts
from splatbot.run.loop import FrameLoop
from splatbot.tracking.rectify import RectifiedLog
from splatbot.trajectory import Trajectory

MapPage = Callable[[GaussianModel, Trajectory], str]
"""Makes an interactive page of a map and the camera trajectory."""

_log = logging.getLogger(__name__)


@dataclass
class RunOutcome:
    """Results of a run after its last frame."""

    loop: FrameLoop
    source: dict[str, Any]
    effects: list[Any]
    interrupts: Interrupts
    model: GaussianModel
    rows: list[FrameRow]
    costs: dict[str, Any]
    trajectories: dict[str, Trajectory]
    track: TrajectoryScore | None
    views: ViewScores = field(default_factory=ViewScores)
    finished: bool = False
    localised_in: str | None = None
    map_page: MapPage | None = None
    report: bool = True
    audit: RunAudit | None = None
    timing: SensorTiming | None = None

    def save(self, folder: RunFolder) -> None:
        """Save the results, then score and report; a signal after the end of the mapping skips both."""
        with self.interrupts.noted():
            self.loop.progress("saving")
        self.save_files(folder)
        mapping_cut = self.interrupts.requested is not None
        try:
            with self.interrupts.interruptible(after=int(mapping_cut)):
                self._score(folder)
                if self.report:
                    self._audit_and_report(folder)
        except KeyboardInterrupt:
            folder.save_metrics(self.metrics())

    def save_files(self, folder: RunFolder) -> None:
        """Write the files that need no scoring."""
        folder.save(
            config=self.loop.config,
            rows=self.rows,
            trajectories=self.trajectories,
            model=self.model,
            metrics=self.metrics(),
        )

    def _score(self, folder: RunFolder) -> None:
        self.loop.progress("scoring")
        poses = self._poses()
        held_out = {i: poses[i] for i in sorted(self.loop.held_out) if i in poses}
        log = RectifiedLog(self.loop.source.log, self.loop.config, self.trajectories)
        self.views = score_views(
            log,
            self.model,
            held_out,
            lambda number: self.loop.progress("scoring", step=number, steps=len(held_out)),
        )
        folder.save_metrics(self.metrics())

    def _audit_and_report(self, folder: RunFolder) -> None:
        self.audit = audit_run(folder, self.loop.source.log) if self._poses() else None
        folder.save_metrics(self.metrics())
        if self.audit is not None:
            folder.save_audit(self.audit.summary())
        self.loop.progress("reporting")
        from splatbot.report.page import report_html  # loads matplotlib, which nothing else of a run needs

        map_page = self._save_map_page(folder)
        folder.save_report(
            report_html(
                rows=self.rows,
                metrics=self.metrics(),
                config=self.loop.config,
                trajectory=self.trajectories[""],
                track=self.track,
                views=self.views,
                map_page=map_page,
                audit=self.audit,
            )
        )

    def _poses(self) -> dict[int, NDArray[np.float64]]:
        """Return the poses of the tracked frames by their index."""
        return {r.index: r.T_world_camera for r in self.loop.slam.results if r.T_world_camera is not None}

    def _save_map_page(self, folder: RunFolder) -> str | None:
        """Write the map page; return its name for the report, or None if it was not written."""
        if self.map_page is None or not len(self.model):
            return None
        try:
            folder.save_map_page(self.map_page(self.model, self.trajectories[""]))
        except (SplatbotError, OSError) as error:
            _log.warning("the report has no interactive map: %s", error)
            return None
        return folder.map_page.name

    def metrics(self) -> dict[str, Any]:
        """Return the contents of ``metrics.json``."""
        log, error = self.loop.source.log, self.loop.error or self.loop.crash
        values = {
            **self.costs,
            **trajectory_metrics(self.track),
            **self.views.metrics(),
            **audit_metrics(self.audit),
            "cameras": camera_metrics(self.rows, self.loop.slam.further_cameras),
            "gaussians": len(self.model),
            "map_bytes": self.model.nbytes,
            "paced": self.loop.source.pace,
            "effects": self.effects,
            "sensor_timing": None if self.timing is None else self.timing.metrics(),
            "memory": self.loop.slam.memory,
            "loops": self.loop.slam.loop_counts,
            "skipped_gradients": self.loop.slam.skipped_gradients,
            "finished": self.finished,
            "localised_in": self.localised_in,
            "saves": self.loop.saver.cost if self.loop.saver is not None else None,
            "interrupted": self.interrupts.requested is not None,
            "cut": self.loop.cut,
            "frames_planned": self.loop.source.total - self.loop.begin if self.loop.source.total else None,
            "error": str(error) if error else None,
            "log": {"name": log.name, "frames": len(log), "uri": _absolute(log.uri), **self.source},
            "splatbot": __version__,
        }
        return without_nan(values)


def _absolute(uri: str) -> str:
    """Return an address whose path exists with its absolute path, valid in other working directories; others as is."""
    path, mark, options = (uri, "", "") if Path(uri).exists() else uri.partition("?")
    return f"{Path(path).resolve()}{mark}{options}" if Path(path).exists() else uri
