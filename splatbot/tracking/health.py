"""Is this pose to be believed? A score to choose between candidates and a verdict with reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from splatbot.config import TrackingConfig
from splatbot.geometry import inverse
from splatbot.tracking.align import residuals
from splatbot.tracking.degeneracy import WeakDirections
from splatbot.tracking.prepare import Level
from splatbot.tracking.reference import Reference

Array = NDArray[np.float64]
Verdict = Literal["ok", "degraded", "lost"]

_SATURATION = 6.0  # a residual of this many σ, or none at all, counts as an outlier
_INLIER = 3.0  # [σ]
# A frame of less contrast than this share of the reference's shows nothing: a covered lens, the dark, a lost image. The
# exposure fit would explain it by a gain near 0, at any pose.
_MIN_CONTRAST = 0.1
# On a table, or before a wall, depth agrees wherever the camera slides along it; colour does not. Nor does most of
# what has little texture disagree, so what counts is where grey is steep.
_FEW_PHOTOMETRIC = 0.55
_FEW_EDGES = 0.5
# With fewer inliers of any kind, another pose may explain the frame better.
_EXPLAINED = 0.6


@dataclass(frozen=True)
class Health:
    """How well a pose explains the frame.

    Args:
        overlap: share of the reference points that the frame sees, by colour or depth.
        photometric_inliers: share of those whose grey agrees within 3 σ.
        edge_inliers: the same, each point weighed by how steep grey is there; 1 where it is nowhere steep.
        geometric_inliers: share of those with depth whose depth agrees within 3 σ; 1 where none has depth.
        score: mean residual [σ], saturated; smaller is better, comparable between poses of one frame.
        contrast: standard deviation of the frame's grey at those points over that of the reference's; 1 where the
            reference has none.
    """

    overlap: float
    photometric_inliers: float
    edge_inliers: float
    geometric_inliers: float
    score: float
    contrast: float


def is_explained(health: Health) -> bool:
    """Whether a pose explains the frame so well that no other need be looked for."""
    return min(health.photometric_inliers, health.edge_inliers, health.geometric_inliers) >= _EXPLAINED


def measure(
    level: Level, index: int, references: Sequence[Reference], T_world_camera: Array, config: TrackingConfig
) -> Health:
    """Score a pose of a frame against references on one level; only exposure is fitted."""
    T_camera_world = inverse(T_world_camera)
    photo, depth, slope, here, there = [], [], [], [], []
    for reference in references:
        points = reference.levels[index]
        found = residuals(level, points, T_camera_world @ reference.T_world_camera, config)
        photo.append(np.abs(found.photometric))
        depth.append(np.abs(found.geometric))
        slope.append(points.slope)
        seen = np.isfinite(found.photometric)
        there.append(points.gray[seen].astype(np.float64))
        here.append(found.photometric[seen] * config.sensor.sigma_gray + found.gain * there[-1] + found.offset)
    r_photo, r_depth = np.concatenate(photo), np.concatenate(depth)
    seen, ranged = np.isfinite(r_photo), np.isfinite(r_depth)
    agree, steep = r_photo[seen] < _INLIER, np.concatenate(slope)[seen].astype(np.float64)
    return Health(
        overlap=float(seen.mean()) if len(seen) else 0.0,
        photometric_inliers=float(agree.mean()) if len(agree) else 0.0,
        edge_inliers=float(steep @ agree / steep.sum()) if steep.sum() > 0 else 1.0,
        geometric_inliers=float((r_depth[ranged] < _INLIER).mean()) if ranged.any() else 1.0,
        score=float(np.mean([_saturated(r_photo), _saturated(r_depth)])) if len(seen) else _SATURATION,
        contrast=_contrast(np.concatenate(here), np.concatenate(there)),
    )


def _saturated(residuals: NDArray[np.floating[Any]]) -> float:
    return float(np.fmin(residuals, _SATURATION).mean())  # NaN, too, is saturated


def _contrast(gray: Array, reference_gray: Array) -> float:
    """Ratio of the standard deviations of grey values (N,); 1 where the reference is of one colour."""
    spread = float(reference_gray.std()) if len(reference_gray) else 0.0
    return float(gray.std()) / spread if spread > 1e-6 else 1.0


def verdict_of(
    health: Health, information: Array, weak: WeakDirections | None, config: TrackingConfig
) -> tuple[Verdict, tuple[str, ...]]:
    """The verdict and what speaks against a pose that was found with an information matrix (6, 6)."""
    lost, doubts = [], []
    # Comparisons are written so that NaN speaks against the pose.
    if not health.overlap >= config.min_overlap:
        lost.append(f"only {health.overlap:.0%} of the reference is seen")
    inliers = float(np.min([health.photometric_inliers, health.geometric_inliers]))
    if not inliers >= config.min_inliers:
        lost.append(f"only {inliers:.0%} of the residuals are inliers")
    if not health.contrast >= _MIN_CONTRAST:
        lost.append(f"the image is blank: {health.contrast:.0%} of the reference's contrast")
    if not health.photometric_inliers >= _FEW_PHOTOMETRIC:
        doubts.append(f"only {health.photometric_inliers:.0%} of the colours agree")
    elif not health.edge_inliers >= _FEW_EDGES:
        doubts.append(f"only {health.edge_inliers:.0%} of the colours agree where there are edges")
    if not np.isfinite(information).all():
        lost.append("the alignment is not finite")
    elif weak is not None:
        doubts.append(weak.reason)
    if lost:
        return "lost", tuple(lost)
    return ("degraded", tuple(doubts)) if doubts else ("ok", ())
