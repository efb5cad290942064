"""Scoring of a finished run from its folder and its log."""

from __future__ import annotations

from typing import Any

from splatbot.errors import FormatError
from splatbot.gaussians import GaussianModel
from splatbot.logs import Log
from splatbot.results.folder import RunFolder
from splatbot.results.metrics import without_nan
from splatbot.results.scoring import score_trajectory, score_views, trajectory_metrics
from splatbot.results.views import rectified_log
from splatbot.trajectory import Trajectory


def rescore(folder: RunFolder, log: Log, reference: Trajectory | None = None) -> dict[str, Any]:
    """Compute the accuracy figures of ``metrics.json`` again.

    Args:
        folder: the run.
        log: the recording that it mapped.
        reference: poses to compare with. If None, the ground truth of the log is used.

    Raises:
        FormatError: a file of the run is missing or damaged, or the log is too short to be the one that was mapped.
    """
    rows = folder.load_frames()
    if rows and rows[-1].index >= len(log):
        raise FormatError(
            f"has frame {rows[-1].index}, the log {log.name} has only {len(log)} frames.",
            file=folder.frames,
            field="index",
            hint="name the log that was mapped: --log LOG",
        )
    poses = folder.load_poses()
    track = (
        score_trajectory(
            folder.load_trajectory(),
            reference if reference is not None else log.ground_truth,
            folder.load_covariances(),
        )
        if poses
        else None
    )
    held_out = {row.index: poses[row.index] for row in rows if row.held_out and row.index in poses}
    model = GaussianModel.load(folder.map)
    rectified = rectified_log(folder, log)
    views = score_views(rectified, model, held_out)
    counts = {
        "frames": sum(row.processed for row in rows),
        "tracked": len(poses),
        "lost": sum(row.verdict == "lost" for row in rows),
        "held_out": len(views.scores),
        "gaussians": len(model),
    }
    return without_nan({**counts, **trajectory_metrics(track), **views.metrics()})
