"""Scores of a run: its trajectory against the reference, its map against held-out frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.evaluation import (
    AbsoluteError,
    Consistency,
    RelativeError,
    absolute_error,
    depth_error,
    nees,
    psnr,
    relative_error,
    ssim,
)
from splatbot.gaussians import GaussianModel
from splatbot.geometry import se3_log, transform_points
from splatbot.logs import Log
from splatbot.rasterize.views import colorize, render_view
from splatbot.trajectory import Trajectory

MIN_EXTENT = 0.05  # [m] extent of the shortest paths whose sizes are compared
N_SHOWN = 3  # views whose images are kept; keeping all would make memory grow with the log


@dataclass(frozen=True)
class TrajectoryScore:
    """A trajectory against its reference.

    Args:
        absolute: ATE, with the M associated frames.
        relative: RPE; None with fewer than two of them.
        consistency: NEES with the camera's fitted pose on the body of the reference; None with fewer than ten of them,
            or where covariances are not known.
        consistency_as_given: NEES with the reference as it is.
        estimate: (M, 3) [m] their camera centres, aligned to the reference.
        reference: (K, 3) [m] camera centres of the reference over the time of the run.
    """

    absolute: AbsoluteError
    relative: RelativeError | None
    consistency: Consistency | None
    consistency_as_given: Consistency | None
    estimate: NDArray[np.float64]
    reference: NDArray[np.float64]

    @property
    def reference_scale(self) -> float | None:
        """Size of the reference path relative to the estimate; None for paths too short to compare."""
        sizes = [float(np.sqrt(path.var(axis=0).sum())) for path in (self.reference, self.estimate)]
        return sizes[0] / sizes[1] if min(sizes) > MIN_EXTENT / 4 else None


def score_trajectory(
    estimate: Trajectory, reference: Trajectory | None, covariances: NDArray[np.float64] | None = None
) -> TrajectoryScore | None:
    """Compare trajectories after SE(3) alignment.

    Args:
        estimate: estimated poses.
        reference: true poses. If None, there is no score.
        covariances: (N, 6, 6) of the estimated poses, see :func:`splatbot.evaluation.nees`.

    Returns:
        The score, or None if no stamps match or there is no reference.
    """
    if reference is None or len(estimate) == 0:
        return None
    try:
        absolute = absolute_error(reference, estimate)
    except InputError:  # the reference covers another time span than this part of the log
        return None
    associated = np.isin(estimate.stamps, absolute.stamps)
    during = (reference.stamps >= estimate.stamps[0] - 0.1) & (reference.stamps <= estimate.stamps[-1] + 0.1)
    several = len(absolute.errors) > 1
    return TrajectoryScore(
        absolute=absolute,
        relative=relative_error(reference, estimate) if several else None,
        consistency=_consistency(reference, estimate, covariances, fit_mount=True),
        consistency_as_given=_consistency(reference, estimate, covariances, fit_mount=False),
        estimate=transform_points(absolute.T_reference_estimate, estimate.positions[associated]),
        reference=reference.positions[during],
    )


def _consistency(
    reference: Trajectory, estimate: Trajectory, covariances: NDArray[np.float64] | None, *, fit_mount: bool
) -> Consistency | None:
    """Return the NEES; None where it is not defined, with too few frames or without usable covariances."""
    if covariances is None:
        return None
    try:
        return nees(reference, estimate, covariances, fit_mount=fit_mount)
    except InputError:
        return None


def trajectory_metrics(score: TrajectoryScore | None) -> dict[str, float | None]:
    """Return the trajectory's part of ``metrics.json``, with None for each value without a reference."""
    relative = score.relative if score else None
    fitted = score.consistency if score else None
    given = score.consistency_as_given if score else None
    mount = se3_log(fitted.T_reference_camera) if fitted else None
    return {
        "ate_rmse_m": score.absolute.rmse if score else None,
        "ate_mean_m": score.absolute.mean if score else None,
        "ate_median_m": score.absolute.median if score else None,
        "ate_max_m": score.absolute.max if score else None,
        "reference_scale": score.reference_scale if score else None,
        "ate_frames": len(score.absolute.errors) if score else 0,
        "rpe_trans_rmse_m": relative.trans_rmse if relative else None,
        "nees": fitted.mean if fitted else None,
        "nees_within_3_sigma": fitted.within_three_sigma if fitted else None,
        "nees_as_given": given.mean if given else None,
        "reference_mount_m": float(np.linalg.norm(mount[:3])) if mount is not None else None,
        "reference_mount_deg": float(np.rad2deg(np.linalg.norm(mount[3:]))) if mount is not None else None,
        "rpe_rot_rmse_deg": float(np.rad2deg(relative.rot_rmse)) if relative else None,
    }


@dataclass(frozen=True)
class ViewScore:
    """The map rendered at the pose of one held-out frame, over the whole image.

    Args:
        index: position in the log.
        psnr_db, ssim: colour; unmasked. Infinite for equal images. None for SSIM of images smaller than its window.
        depth_l1_m, depth_median_m: [m] over the pixels that have depth in both; None without any.
        coverage: share of the sensor's depth pixels for which the map has a depth, 0..1.
    """

    index: int
    psnr_db: float
    ssim: float | None
    depth_l1_m: float | None
    depth_median_m: float | None
    coverage: float | None


@dataclass(frozen=True)
class ShownView:
    """Images of one held-out view: rgb (H, W, 3) uint8 and depth (H, W) [m], observed and rendered."""

    score: ViewScore
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    rendered_rgb: NDArray[np.uint8]
    rendered_depth: NDArray[np.float32]


@dataclass(frozen=True)
class ViewScores:
    """Scores of all held-out views, and the images of a few."""

    scores: list[ViewScore] = field(default_factory=list)
    shown: list[ShownView] = field(default_factory=list)

    def metrics(self) -> dict[str, float | None]:
        """Return the views' part of ``metrics.json``: the median over views for the median depth error, else means."""
        return {
            "psnr_holdout_db": _mean([s.psnr_db for s in self.scores]),
            "ssim_holdout": _mean([s.ssim for s in self.scores]),
            "depth_l1_m": _mean([s.depth_l1_m for s in self.scores]),
            "depth_median_m": _median([s.depth_median_m for s in self.scores]),
            "depth_coverage": _mean([s.coverage for s in self.scores]),
        }


def score_views(
    log: Log,
    model: GaussianModel,
    poses: Mapping[int, NDArray[np.float64]],
    on_view: Callable[[int], None] | None = None,
) -> ViewScores:
    """Render the map at ``poses`` (T_world_camera (4, 4) by position in the log) and compare with the frames there.

    Frames are read again one by one, so memory does not grow with the log.

    Args:
        log, model, poses: recording, map and poses.
        on_view: called with the number of scored views before each view.

    Raises:
        LogError: a frame can no longer be read.
    """
    result = ViewScores()
    indices = sorted(poses)
    chosen = {indices[round(i)] for i in np.linspace(0, len(indices) - 1, min(N_SHOWN, len(indices)))}
    for number, index in enumerate(indices):
        if on_view is not None:
            on_view(number)
        view = _score_view(log, model, index, poses[index])
        result.scores.append(view.score)
        if index in chosen:
            result.shown.append(view)
    return result


def _score_view(log: Log, model: GaussianModel, index: int, T_world_camera: NDArray[np.float64]) -> ShownView:
    frame = log[index]
    rgb = render_view(model, frame.camera, T_world_camera, "rgb")
    depth = render_view(model, frame.camera, T_world_camera, "depth")
    error = depth_error(depth, frame.depth)
    score = ViewScore(
        index=index,
        psnr_db=psnr(rgb, frame.rgb),
        ssim=ssim(rgb, frame.rgb) if min(frame.depth.shape) >= 11 else None,
        depth_l1_m=error.l1,
        depth_median_m=error.median,
        coverage=error.coverage,
    )
    return ShownView(score, frame.rgb, frame.depth, colorize(rgb, "rgb"), depth)


def _mean(values: list[float | None] | list[float]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def _median(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else None
